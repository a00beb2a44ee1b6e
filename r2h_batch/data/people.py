"""Tables of people: the built-in one (`assets/people`), made from the free body model Anny, and files of lengths.

A person has sex, age, stature, a hand and the lengths that `trials/draw/receivers.py` places a body from.
`import people` checks a file; a benchmark's `people` field and `sweep --people` read it.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable, read_file
from r2h_batch.base.validate import parse_number
from r2h_batch.scene.arrays import arrays_digest, asset, read_arrays, stored_arrays
from r2h_batch.scene.hand import HandModel, HandSet, make_hand_set
from r2h_batch.verdicts import SEXES

F64 = NDArray[np.float64]

GROUPS = ("adults", "children", "elderly")
"""Built-in people by age: 18 to 65, 6 to 12, 70 to 90 years."""
ALL, WHEELCHAIR = "all", "wheelchair"
WORDS = (*GROUPS, ALL, WHEELCHAIR)
"""`wheelchair`: the adults, each in a wheelchair (`trials/draw/wheelchair.py`)."""

LENGTHS_M: dict[str, tuple[float, float]] = {
    "acromial_height": (0.45, 1.95),
    "biacromial_breadth": (0.12, 0.60),
    "acromion_radiale": (0.10, 0.50),
    "radiale_stylion": (0.08, 0.42),
    "chest_depth": (0.08, 0.60),
    "chest_breadth": (0.10, 0.60),
    "biceps_circumference": (0.08, 0.80),
    "forearm_circumference": (0.08, 0.60),
    "wrist_circumference": (0.06, 0.60),
    "iliac_height": (0.30, 1.45),
    "popliteal_height": (0.15, 0.65),
    "seated_shoulder": (0.22, 0.85),
    "stature": (0.60, 2.35),
    "hand_length": (0.08, 0.26),
}
"""Column of a file -> the least and the greatest length that a body has, m. [choice]: 10 % beyond toddlers and the
tallest people on record, so that other units are found."""
MOST_AGE = 120.0
MOST_BYTES, MOST_PEOPLE = 64 << 20, 100_000
STRIDE = 77
"""Hand i of a side has the size of place STRIDE i modulo their number: it has no common factor with 200, so that
sizes spread over the six postures."""
HAND_OFF_M = 0.003
"""How far a file's hand_length may lie from the nearest hand of the built-in people."""


@dataclass(frozen=True, eq=False)
class People:
    """P people.

    Attributes:
        name: a word of `WORDS`, or the file.
        sex: (P,) 0 male, 1 female.
        age: (P,) years.
        lengths: (P,) each, m, by the names of `LENGTHS_M`.
        hand_shape: (P, 10) shape numbers of the built-in people's hand (`people_hand`).
        wheelchair: whether they sit in wheelchairs.
    """

    name: str
    sex: NDArray[np.int8]
    age: F64
    lengths: Mapping[str, F64]
    hand_shape: NDArray[np.float32]
    wheelchair: bool = False

    def __len__(self) -> int:
        return len(self.age)

    @cached_property
    def digest(self) -> str:
        """sha256 (hex) over all numbers."""
        own: dict[str, NDArray[Any]] = {
            "sex": self.sex,
            "age": self.age,
            "hand_shape": self.hand_shape,
        }
        if self.wheelchair:
            own["wheelchair"] = np.array(1, np.int8)
        return arrays_digest(own | dict(self.lengths))

    @cached_property
    def by_hand(self) -> NDArray[np.int64]:
        """(P,) the people, smallest hand first."""
        return np.argsort(self.lengths["hand_length"], kind="stable")


@lru_cache(maxsize=8)
def built_in_people(word: str = ALL) -> People:
    """The built-in people of a word of `WORDS`."""
    group = GROUPS[0] if word == WHEELCHAIR else word
    stored = read_arrays(asset("people", "people.npz"))
    rows = np.flatnonzero(
        np.isin(stored["group"], [k for k, g in enumerate(GROUPS) if group in (g, ALL)])
    )
    return People(
        word,
        stored["sex"][rows],
        stored["age"][rows].astype(np.float64),
        {name: stored[name][rows].astype(np.float64) for name in LENGTHS_M},
        stored["hand_shape"][rows].astype(np.float32),
        wheelchair=word == WHEELCHAIR,
    )


@lru_cache(maxsize=1)
def people_hand() -> HandModel:
    """The hand of the built-in people, in MANO's joint tree; shape 0 is the adults' mean hand."""
    return HandModel.from_arrays(read_arrays(asset("people", "hand.npz")))


@lru_cache(maxsize=4)
def people_hand_set(people: People) -> HandSet:
    """The 400 receiving postures on the hands of people, from the smallest to the largest of each side."""
    stored = read_arrays(asset("people", "postures.npz"))
    shape = np.zeros((len(stored["side"]), 10), np.float32)
    for side in (0, 1):
        members = np.flatnonzero(stored["side"] == side)
        place = (np.arange(len(members)) * STRIDE) % len(members)
        middle = ((place + 0.5) / len(members) * len(people)).astype(np.int64)
        shape[members] = people.hand_shape[people.by_hand[middle]]
    return make_hand_set(
        people_hand(), stored["pose"], shape, stored["side"], stored["posture"].tolist(),
        hulls=stored_hulls() if people is built_in_people(ALL) else None,
    )  # fmt: skip


def stored_hulls() -> tuple[NDArray[np.int32], NDArray[np.int32]] | None:
    """The stored hulls of the hands of all built-in people, as `hulls_of` finds them: r2h-v2 has one digest on any machine.
    None before they are built."""
    found = stored_arrays("people", "hulls.npz")
    if not found:
        return None
    pieces = [piece.numpy() for piece in people_hand().pieces]
    first = np.cumsum([0] + [len(piece) for piece in pieces])[:-1]
    on = np.unpackbits(found["on_hull"], axis=1, count=sum(map(len, pieces))).astype(bool)
    counts = np.add.reduceat(on, first, axis=1, dtype=np.int32)
    ids = np.broadcast_to(np.concatenate(pieces), on.shape)[on]
    return ids.astype(np.int32), np.cumsum([0, *counts.reshape(-1)]).astype(np.int32)


def read_people(path: str | Path) -> People:
    """The people of a .csv file: one a row, lengths in metres (docs/benchmark.md).

    Columns: `sex` (male, female), `age` (years), and those of `LENGTHS_M`. Others are ignored. A hand is the built-in
    one of the nearest length.

    Raises:
        FileError: one line that names the column, and the row counted from the first person.
    """
    where = printable(path)
    if Path(path).suffix.lower() != ".csv":
        raise FileError(f"{where}: people are a .csv file, one person a row")
    try:
        text = read_file(Path(path), MOST_BYTES).decode("utf-8-sig")
        reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
        rows = list(reader)
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{where}: is no .csv in UTF-8: {printable(error)}") from None
    if not 1 <= len(rows) <= MOST_PEOPLE:
        raise FileError(f"{where}: {len(rows)} people; 1 to {MOST_PEOPLE} are allowed")
    there = list(reader.fieldnames or ())
    if twice := [name for name in there if there.count(name) > 1]:
        raise FileError(f"{where}: column {printable(twice[0])[:40]} is there twice; leave one out")
    for k, row in enumerate(
        rows
    ):  # csv fills a short row with None, and keeps what is over under None
        cells = sum(v is not None for v in row.values()) - (None in row)
        over = len(row.get(None) or ())
        if cells + over != len(there):
            words = f"person {k + 1} has {cells + over} cells, the header has {len(there)}"
            raise FileError(f"{where}: {words}; write one cell for each column")
    if missing := [name for name in ("sex", "age", *LENGTHS_M) if name not in there]:
        raise FileError(
            f"{where}: has no column {missing[0]}; it has {', '.join(map(printable, there[:20]))}"
        )
    sex = np.array([_sex(row["sex"], k, where) for k, row in enumerate(rows)], np.int8)
    age = _numbers(rows, "age", 0.0, MOST_AGE, "years", where)
    lengths = {
        name: _numbers(rows, name, *bounds, "m", where) for name, bounds in LENGTHS_M.items()
    }
    _check_proportions(lengths, where)
    return People(Path(path).name, sex, age, lengths, _hands(lengths["hand_length"], sex, where))


def _sex(word: str | None, row: int, where: str) -> int:
    if word not in SEXES:
        raise FileError(
            f"{where}: sex of person {row + 1} is {printable(repr(word))[:40]}; allowed are male, female"
        )
    return SEXES.index(word)


def _numbers(
    rows: list[dict[str, str]], name: str, low: float, high: float, unit: str, where: str
) -> F64:
    values = np.full(len(rows), np.nan)
    for k, row in enumerate(rows):
        try:
            values[k] = parse_number(row[name].strip())
        except ValueError as error:
            raise FileError(f"{where}: {name} of person {k + 1}: {error}") from None
    if (bad := ~((values >= low) & (values <= high))).any():
        k = int(bad.argmax())
        how = ". From millimetres multiply by 0.001" if unit == "m" and values[k] > 10 else ""
        raise FileError(
            f"{where}: {name} of person {k + 1} is {values[k]:g}; a body's is {low:g} to {high:g} {unit}{how}"
        )
    return values


def _check_proportions(lengths: Mapping[str, F64], where: str) -> None:
    """Heights of one body must be in their order."""
    for low, high in (
        ("popliteal_height", "iliac_height"),
        ("iliac_height", "acromial_height"),
        ("acromial_height", "stature"),
    ):
        if (bad := lengths[low] >= lengths[high]).any():
            k = int(bad.argmax())
            raise FileError(
                f"{where}: {low} of person {k + 1} is {lengths[low][k]:g} m and {high} {lengths[high][k]:g} m;"
                f" {low} must be less"
            )


def _hands(length: F64, sex: NDArray[np.int8], where: str) -> NDArray[np.float32]:
    """(P, 10) shapes of the hands of these lengths: those of the built-in people of this sex with the nearest hand."""
    known = built_in_people(ALL)
    out = np.zeros((len(length), known.hand_shape.shape[1]), np.float32)
    for s in range(len(SEXES)):
        members = np.flatnonzero(known.sex == s)
        there = known.lengths["hand_length"][members]
        mine = np.flatnonzero(sex == s)
        off = np.abs(length[mine, None] - there)
        nearest = off.argmin(1)
        if (bad := off.min(1) > HAND_OFF_M).any():
            k = int(mine[bad.argmax()])
            raise FileError(
                f"{where}: hand_length of person {k + 1} is {length[k]:g} m; hands of {SEXES[s]} people are"
                f" {there.min():.3f} to {there.max():.3f} m"
            )
        out[mine] = known.hand_shape[members[nearest]]
    return out


YEARS = 1.5
"""How far the age of a built-in person may lie from the one that is asked for."""


def hand_of_age(age: float, sex: str | None = None) -> dict[str, NDArray[Any]]:
    """The arrays of a hand.npz whose shape 0 is the median hand of built-in people of an age.

    Args:
        age: years.
        sex: a word of `SEXES`; None: either.

    Raises:
        FileError: nobody is of this age.
    """
    people = built_in_people(ALL)
    near = np.abs(people.age - age) <= YEARS
    if sex is not None:
        near &= people.sex == SEXES.index(sex)
    if not near.any():
        raise FileError(
            f"--age {age:g}: the built-in people are 6 to 12, 18 to 65 and 70 to 90 years old"
        )
    rows = np.flatnonzero(near)
    order = rows[np.argsort(people.lengths["hand_length"][rows], kind="stable")]
    shape = people.hand_shape[order[len(order) // 2]].astype(np.float64)
    found: dict[str, NDArray[Any]] = dict(read_arrays(asset("people", "hand.npz")))
    for rest, basis in (("vertices", "shape_basis"), ("joints_rest", "joint_shape_basis")):
        found[rest] = np.asarray(found[rest] + found[basis].astype(np.float64) @ shape, np.float32)
    return found


def hand_lengths(model: HandModel, shape: NDArray[np.float32]) -> F64:
    """(H,) from the wrist to the tip of the straight middle finger of hands with these shapes, m."""
    tip = int(model.tip_vertices[1])
    rest = (model.vertices[tip] - model.joints_rest[0]).double().numpy()
    moves = (model.shape_basis[tip] - model.joint_shape_basis[0]).double().numpy()
    way = rest + np.einsum("kc,hc->hk", moves, shape.astype(np.float64))
    return np.asarray(np.sqrt((way * way).sum(1)))
