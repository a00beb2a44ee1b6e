"""Trials of somebody's own: which object meets which hand, and where that hand stands.
`--trials-file FILE.npz|.parquet|.csv|.json`.

| name | npz | Parquet | meaning |
|---|---|---|---|
| `object` | (N,) text | text | the object's name |
| `T_world_hand` | (N, 4, 4) float | list of 16 float, row by row | the hand's frame in the world,
metres |
| `hand` | (N,) whole numbers | int | row of the hand set, right hands first |
| `pose`, `shape`, `side` | (N, 48), (N, 10), (N,) | lists of 48 and 10, int | instead of `hand`;
side 0 right, 1 left |
| `hand`, `skin`, `skin_side`, `T_hand_palm`, `skin_faces`, `skin_piece` | (N,), (H, V, 3), (H,),
(H, 4, 4), (F, 3), (F,) | - | hands that are meshes: `make_skin_set` of scene/hand.py; `hand` is a
row of `skin` |
| `receiver` | (N, 5, 4) float | list of 20 | optional: the receiver's arm and torso, as `Trials.receiver` |
| `person` | (N, 5) float | list of 5 | optional, with `receiver`: years, 0 male or 1 female, stature and
hand length in metres, 0 standing or 1 seated |
| `id`, `variant` | (N,) text | text | optional: what its owner calls the trial, and the method behind
it |

`frame` (world, base_link or base), `length_unit` and `angle_unit` (of `pose`) may be declared (r2h_batch/base/declared.py).

A .json holds the arrays of the .npz by name, as lists. A .csv has the columns object, hand,
T_world_hand_0 to _15, and receiver_0 to _19, person_0 to _4, id and variant if they are said.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base.declared import Declared, taken
from r2h_batch.base.errors import FileError
from r2h_batch.base.io.arrays import RIGID, Spec, check_arrays, check_poses
from r2h_batch.base.io.read import printable, read_npz
from r2h_batch.base.io.tables import read_csv_arrays, read_json_arrays
from r2h_batch.scene.hand import MAX_SKIN_PIECES, HandSet, make_hand_set, make_skin_set
from r2h_batch.scene.hand_file import check_postures
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.types import PERSON, Trials
from r2h_batch.verdicts import SPLITS

MAX_BYTES, MAX_ROW_BYTES = 256 << 20, 2048
MAX_TRIALS = 1_000_000
FARTHEST_M = 10.0

POSTURE = ("pose", "shape", "side")
WIDTH = {"T_world_hand": 16, "pose": 48, "shape": 10, "receiver": 20, "person": 5}
BODY = ("receiver", "person")
LABELS = ("id", "variant")
DECLARES = ("frame", "length_unit", "angle_unit")
TEXTS = ("object", *LABELS, *DECLARES)
SKIN: dict[str, Spec] = {
    "skin": ("f", ("H", "V", 3)), "T_hand_palm": ("f", ("H", 4, 4)), "skin_faces": ("iu", ("F", 3)),
    "skin_piece": ("iu", ("F",)), "skin_side": ("iu", ("H",)),
}  # fmt: skip
SPECS: dict[str, Spec] = {
    "object": ("U", ("N",)), "T_world_hand": ("f", ("N", 4, 4)), "hand": ("iu", ("N",)),
    "pose": ("f", ("N", 48)), "shape": ("f", ("N", 10)), "side": ("iu", ("N",)),
    "receiver": ("f", ("N", 5, 4)), "person": ("f", ("N", 5)), **dict.fromkeys(LABELS, ("U", ("N",))),
}  # fmt: skip
CSV = {
    **dict.fromkeys(TEXTS, ("string", 1)), "hand": ("int64", 1), "T_world_hand": ("float64", 16),
    "receiver": ("float64", 20), "person": ("float64", 5),
}  # fmt: skip

Labels = dict[int, tuple[str, str]]
"""Trial id -> what its owner calls the trial, and the method behind it (or "")."""
Columns = dict[str, NDArray[Any]]


def read_trials_file(
    path: Path, objects: Sequence[ObjectModel], hand_set: HandSet
) -> tuple[Trials, HandSet, Labels | None]:
    """The trials, S0 before S1, each split in the file's order (its i-th has the id 2 i or 2 i +
    1), their hands, and their texts if they have any.

    Raises `FileError`, one line, for anything that is not as the table above says.
    """
    where = printable(path)
    if path.suffix not in READERS:
        raise FileError(f"{where}: trials are an {', '.join(READERS)} file")
    columns = READERS[path.suffix](path)
    if "T_obj_ee" in columns:
        flag = "--motions" if "q" in columns else "--predictions"
        raise FileError(
            f"{where}: holds a method's answers (T_obj_ee), no trials; give it as {flag}"
        )
    _convert(columns, taken(columns, where, DECLARES))
    if "skin" in columns:
        hand_set = _skins(columns, where)
    _check_columns(columns, where)
    check_poses(f"{where}: T_world_hand", columns["T_world_hand"])
    T = np.ascontiguousarray(columns["T_world_hand"], np.float32)
    object_index = _objects(columns["object"], objects, where)
    if "hand" in columns:
        hand = columns["hand"]  # compared as it is: what does not fit int64 would wrap
        if hand.min() < 0 or hand.max() >= len(hand_set):
            raise FileError(
                f"{where}: hand goes from {hand.min()} to {hand.max()}; the hand set has 0 to {len(hand_set) - 1}"
            )
        hand = hand.astype(np.int64)
    else:
        hand_set, hand = _own_hands(columns, hand_set, where)
    split = np.array([SPLITS.index(o.split) for o in objects])[object_index]
    order = np.argsort(split, kind="stable")
    ids = np.concatenate([2 * np.arange((split == k).sum()) + k for k in range(len(SPLITS))])
    receiver, person = _bodies(columns, T, where)
    trials = Trials(
        trial_id=torch.from_numpy(ids.astype(np.int64)),
        object_index=torch.from_numpy(object_index[order].astype(np.int32)),
        hand_index=torch.from_numpy(hand[order].astype(np.int32)),
        T_world_hand=torch.from_numpy(T[order]),
        receiver=None if receiver is None else torch.from_numpy(receiver[order]),
        person=None if person is None else torch.from_numpy(person[order]),
    )
    return trials, hand_set, _labels(columns, ids, order, where)


def _convert(columns: Columns, declared: Declared) -> None:
    """Take the columns into our conventions, in place."""
    if declared.frame == "hand":
        raise FileError(
            f"{declared.where}: frame is 'hand', which these trials define; allowed are world, base_link, base"
        )
    for name in columns.keys() & {"T_world_hand", "T_hand_palm"}:
        columns[name] = declared.poses(name, columns[name])
    if "T_world_hand" in columns:
        columns["T_world_hand"] = declared.in_world(columns["T_world_hand"])
    if "pose" in columns:
        columns["pose"] = declared.angles(columns["pose"])
    if "skin" in columns:
        columns["skin"] = declared.lengths(columns["skin"])
    for name in columns.keys() & {"receiver", "person"}:
        if columns[name].dtype.kind == "f" and columns[name].shape[1:] == SPECS[name][1][1:]:
            columns[name] = _converted_body(name, columns[name].astype(np.float64), declared)


def _converted_body(name: str, value: NDArray[Any], declared: Declared) -> NDArray[Any]:
    """`receiver` or `person` in our conventions."""
    if name == "person":
        value[:, 2:4] = declared.lengths(value[:, 2:4])  # stature, hand length
        return value
    value[:, :, :3] = declared.lengths(value[:, :, :3])
    value[:, :2, 3] = declared.lengths(value[:, :2, 3])  # radii
    value[:, :4, :3] = declared.in_world(value[:, :4, :3])
    if declared.frame == "base":
        value[:, 3:, 3] *= -1  # the way the torso faces
    return value


def _bodies(
    columns: Columns, T_world_hand: NDArray[np.float32], where: str
) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """`Trials.receiver` and `Trials.person` of a file that has them: numbers that a body can have."""
    receiver, person = columns.get("receiver"), columns.get("person")
    if receiver is not None:
        receiver = receiver.astype(np.float64)
        _lengths(f"{where}: receiver: {{}} of trial {{}}", receiver, T_world_hand)
        _place_of_torso(f"{where}: receiver: {{}} of trial {{}}", receiver)
        receiver = np.ascontiguousarray(receiver, np.float32)
    if person is not None:
        if receiver is None:
            raise FileError(f"{where}: has person and no receiver; give both, or receiver alone")
        for k, (name, values, unit) in enumerate(WHO):
            low, high = values[0], values[-1]
            x = person[:, k].astype(np.float64)
            ok = np.isin(x, values) if unit == "" else (x >= low) & (x <= high)
            if not ok.all():
                row = int((~ok).argmax())
                allowed = f"{low:g} or {high:g}" if unit == "" else f"{low:g} to {high:g} {unit}"
                raise FileError(
                    f"{where}: person: {name} of trial {row} is {x[row]:g}; allowed is {allowed}"
                )
        assert receiver is not None
        _proportions(f"{where}: person: {{}} of trial {{}}", receiver, person)
        none = np.zeros((len(person), len(PERSON) - len(WHO)))  # nobody was drawn before
        person = np.ascontiguousarray(np.concatenate([person, none], 1), np.float32)
    return receiver, person


WHO: tuple[tuple[str, tuple[float, float], str], ...] = (
    ("age", (0.0, 120.0), "years"),
    ("female", (0.0, 1.0), ""),
    ("stature", (0.6, 2.35), "m"),
    ("hand length", (0.08, 0.26), "m"),
    ("seated", (0.0, 1.0), ""),
)
"""Columns of `person`: what they are, their range or the two values that are allowed, and the unit."""
LIMB_M, RADIUS_M, HALF_M, WRIST_M = (0.05, 0.60), (0.01, 0.20), (0.03, 0.60), 0.30
"""Lengths of upper arm and forearm, radii, half sizes of the torso; how far the wrist may lie from the hand's frame [choice]."""
SHOULDER_M, FROM_BASE_M = 0.20, 0.15
"""How far a shoulder may lie from its torso's box, and how near the box may come to the robot's axis at the origin [choice].
Drawn people: at most 0.09, at least 0.47."""
ARM_SHARE, HAND_SHARE = (0.22, 0.42), (0.08, 0.16)
"""Upper arm and forearm, and the hand, as shares of the stature [choice]. Drawn people: 0.28 to 0.34, 0.106 to 0.134."""


def _lengths(what: str, receiver: NDArray[np.float64], T_world_hand: NDArray[np.float32]) -> None:
    """Refuse receivers whose numbers no body has."""
    bone = np.linalg.norm(np.diff(receiver[:, :3, :3], axis=1), axis=2)
    for name, values, (low, high) in (
        ("upper arm", bone[:, 0], LIMB_M),
        ("forearm", bone[:, 1], LIMB_M),
        ("radius of the upper arm", receiver[:, 0, 3], RADIUS_M),
        ("radius of the forearm", receiver[:, 1, 3], RADIUS_M),
        *((f"half size {k} of the torso", receiver[:, 4, k], HALF_M) for k in range(3)),
        (
            "distance of the wrist from the hand's frame",
            np.linalg.norm(receiver[:, 2, :3] - T_world_hand[:, :3, 3], axis=1),
            (0.0, WRIST_M),
        ),
        (
            "distance of the torso from the robot",
            np.abs(receiver[:, 3, :3]).max(1),
            (0.0, FARTHEST_M),
        ),
    ):
        if (bad := ~((values >= low) & (values <= high))).any():
            row = int(bad.argmax())
            raise FileError(
                f"{what.format(name, row)} is {values[row]:.3g} m; allowed is {low:g} to {high:g} m"
            )
    facing = np.abs(np.linalg.norm(receiver[:, 3:, 3], axis=1) - 1.0)
    if (facing > RIGID).any():
        row = int((facing > RIGID).argmax())
        raise FileError(
            f"{what.format('facing', row)} (last number of the rows 3 and 4) is no unit vector"
        )


def _place_of_torso(what: str, receiver: NDArray[np.float64]) -> None:
    """Refuse torsos that their arm does not hang on, and those around the robot."""
    if (odd := receiver[:, 2, 3] != 0).any():
        row = int(odd.argmax())
        raise FileError(
            f"{what.format('last number of the wrist', row)} is {receiver[row, 2, 3]:.3g}; it must be 0"
        )
    half, box = receiver[:, 4, :3], receiver[:, 3, :3]
    cos, sin = receiver[:, 3, 3], receiver[:, 4, 3]

    def outside(point: NDArray[np.float64], axes: int) -> NDArray[np.float64]:
        """Distance of points from the boxes along their first so many axes."""
        d = point - box
        d = np.stack([cos * d[:, 0] + sin * d[:, 1], cos * d[:, 1] - sin * d[:, 0], d[:, 2]], 1)
        return np.asarray(np.linalg.norm(np.maximum(np.abs(d) - half, 0.0)[:, :axes], axis=1))

    off, near = outside(receiver[:, 0, :3], 3), outside(np.zeros_like(box), 2)
    for name, values, bad, words in (
        ("distance of the shoulder from the torso", off, off > SHOULDER_M, f"at most {SHOULDER_M:g}"),
        ("distance of the torso from the robot's axis", near, near < FROM_BASE_M, f"{FROM_BASE_M:g} or more"),
    ):  # fmt: skip
        if bad.any():
            row = int(bad.argmax())
            raise FileError(
                f"{what.format(name, row)} is {values[row]:.3g} m; allowed is {words} m"
            )


def _proportions(what: str, receiver: NDArray[np.float64], person: NDArray[Any]) -> None:
    """Refuse people whose arm or hand is that of another stature."""
    bones = np.linalg.norm(np.diff(receiver[:, :3, :3].astype(np.float64), axis=1), axis=2)
    stature = person[:, 2].astype(np.float64)
    for name, values, (low, high) in (
        ("arm", bones.sum(1), ARM_SHARE),
        ("hand length", person[:, 3].astype(np.float64), HAND_SHARE),
    ):
        share = values / stature
        if (bad := ~((share >= low) & (share <= high))).any():
            row = int(bad.argmax())
            raise FileError(
                f"{what.format(name, row)} is {values[row]:.3g} m, {100 * share[row]:.0f} % of the stature of"
                f" {stature[row]:.3g} m; allowed is {100 * low:.0f} to {100 * high:.0f} %"
            )


def _labels(columns: Columns, ids: NDArray[Any], order: NDArray[Any], where: str) -> Labels | None:
    if "id" not in columns:
        return None
    texts = columns["id"][order].tolist()
    if len(set(texts)) < len(texts):
        twice = next(t for t, k in Counter(texts).items() if k > 1)
        raise FileError(f"{where}: two trials have the id {printable(twice)[:80]!r}")
    variants = columns.get("variant", np.full(len(ids), ""))[order].tolist()
    return {int(i): pair for i, pair in zip(ids, zip(texts, variants))}


def listed_with_ids(listed: Trials, trial_id: torch.Tensor) -> Trials:
    """The listed trials of these ids, in this order; ValueError for one that the list has not."""
    ids, order = torch.sort(listed.trial_id)
    wanted = trial_id.to(ids.device)
    at = torch.searchsorted(ids, wanted).clamp(max=len(ids) - 1)
    if bool((ids[at] != wanted).any()):
        raise ValueError(
            f"trial id {int(wanted[ids[at] != wanted][0])} is not in the list of {len(ids)} trials"
        )
    return listed[order[at]]


def _check_columns(columns: Columns, where: str) -> None:
    """Names, kinds and shapes; all of one length."""
    hands = [n for n in POSTURE if n in columns]
    if ("hand" in columns) == bool(hands):
        raise FileError(f"{where}: give either hand (rows of the hand set) or pose, shape and side")
    optional = (*LABELS, *BODY, *(POSTURE if "hand" in columns else ("hand",)))
    n = check_arrays(columns, SPECS, where, optional=optional, only=True)["N"]
    if not 1 <= n <= MAX_TRIALS:
        raise FileError(f"{where}: {n} trials; 1 to {MAX_TRIALS} are allowed")


def _objects(given: NDArray[Any], objects: Sequence[ObjectModel], where: str) -> NDArray[np.int64]:
    known = {o.name: i for i, o in enumerate(objects)}
    names, at = np.unique(given, return_inverse=True)
    for name in names:
        if str(name) not in known:
            raise FileError(
                f"{where}: no object is called {printable(name)[:80]!r}; there are {', '.join(known)}"
            )
    return np.array([known[str(n)] for n in names], np.int64)[at.reshape(-1)]


def _own_hands(columns: Columns, base: HandSet, where: str) -> tuple[HandSet, NDArray[np.int64]]:
    """A set of the postures that the trials have, on the same hand, and each trial's row of it."""
    if not np.isin(columns["side"], (0, 1)).all():
        raise FileError(f"{where}: side must be 0 (right) or 1 (left)")
    side = columns["side"].astype(np.int64)
    # sorted by the first column: right hands first, as a set has them
    rows = np.concatenate([side[:, None], columns["pose"], columns["shape"]], 1).astype(np.float32)
    unique, at = np.unique(rows, axis=0, return_inverse=True)
    try:
        check_postures(columns["pose"], columns["shape"])
        side, pose, shape = unique[:, 0].astype(np.int8), unique[:, 1:49], unique[:, 49:]
        own = make_hand_set(base.model, pose, shape, side, ["listed"] * len(unique))
    except ValueError as error:
        raise FileError(f"{where}: {printable(error).replace('of hand', 'of trial', 1)}") from None
    return own, at.reshape(-1)


def _skins(columns: Columns, where: str) -> HandSet:
    """Hands that are meshes; their columns leave."""
    a = {k: columns.pop(k) for k in SKIN if k in columns}
    lengths = check_arrays(a, SKIN, where)
    if not all(lengths.values()):
        raise FileError(f"{where}: skin has no hand, vertex or face")
    v = lengths["V"]
    if max(np.abs(a[k]).max() for k in ("skin", "T_hand_palm")) > FARTHEST_M:
        raise FileError(f"{where}: skin or T_hand_palm holds numbers beyond {FARTHEST_M:g} m")
    least = min(a[k].min() for k in ("skin_faces", "skin_piece", "skin_side"))
    if least < 0 or a["skin_faces"].max() >= v or a["skin_side"].max() > 1:
        raise FileError(f"{where}: skin_faces, skin_piece or skin_side name a missing row")
    pieces = np.unique(a["skin_piece"])
    if len(pieces) != pieces[-1] + 1 or len(pieces) > MAX_SKIN_PIECES:
        raise FileError(
            f"{where}: skin_piece names {len(pieces)} pieces; need 0 to {MAX_SKIN_PIECES - 1}"
        )
    check_poses(f"{where}: T_hand_palm", a["T_hand_palm"])
    try:
        return make_skin_set(*a.values())
    except ValueError as error:
        raise FileError(f"{where}: {printable(error)}") from None


def _parquet(path: Path) -> Columns:
    """The columns of a Parquet file, whose sizes are checked before anything is read."""
    from r2h_batch.base.io.parquet import read_parquet_arrays

    columns, counts = read_parquet_arrays(
        path, most=1 << 30, rows=MAX_TRIALS, text=TEXTS, row_bytes=MAX_ROW_BYTES
    )
    for name in columns.keys() & WIDTH.keys():
        width = WIDTH[name]
        if not (counts.get(name, np.zeros(1)) == width).all():
            raise FileError(f"{printable(path)}: {name} must be a list of {width} numbers a row")
        columns[name] = columns[name].reshape(-1, *SPECS[name][1][1:])
    return columns


def _csv(path: Path) -> Columns:
    found = read_csv_arrays(path, CSV)
    if "T_world_hand" in found:
        found["T_world_hand"] = found["T_world_hand"].reshape(-1, 4, 4)
    if "receiver" in found:
        found["receiver"] = found["receiver"].reshape(-1, 5, 4)
    return found


READERS: dict[str, Callable[[Path], Columns]] = {
    ".npz": lambda path: read_npz(path, most=MAX_BYTES),
    ".parquet": _parquet,
    ".csv": _csv,
    ".json": read_json_arrays,
}
