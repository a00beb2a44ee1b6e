"""`report --by-people`: success by age, stature, hand, sex and seat, and the people whom no method serves; who could
receive the object, where `results reception` has stored that."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from r2h_batch.base.table import Column, Table, document, plain
from r2h_batch.report.text import hits_fields, legend, short_names
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import Outcome

Mask = NDArray[np.bool_]

BINS: dict[str, tuple[str, str, float, tuple[float, ...]]] = {
    "age_years": ("age, years", "{:.0f}", 1.0, (13.0, 18.0, 40.0, 65.0)),
    "stature_m": ("stature, m", "{:.1f}", 1.0, (1.2, 1.4, 1.6, 1.8)),
    "hand_length_m": ("hand, cm", "{:.0f}", 100.0, (0.15, 0.17, 0.19, 0.21)),
}
"""Column -> its heading, how a bound is written and by what it is multiplied there, and the bounds between groups [choice]."""
ADULT_YEARS = (18.0, 65.0)
MEDIAN_M = 0.05
"""A median adult stands, and is not farther than this from the median stature of the run's adults of the same sex."""
SERVED = 0.5
"""An object is served if every method succeeds in at least this share of its trials with median adults [choice]."""
SHOWN = 20
RATE = "{value:.1f} ({low:.0f}-{high:.0f})"
_GROUP = (Column("by", "By", left=True), Column("group", "Group", left=True))
RECEPTION, RECEIVED = "reception", "received"
"""Folder of a run that holds METHOD.parquet, and its column."""
COLUMNS = (
    "trial_id",
    "object",
    "outcome",
    "age_years",
    "sex",
    "stature_m",
    "hand_length_m",
    "seated",
    "redrawn",
)


@dataclass(frozen=True)
class Served:
    """The trials of a run that all methods have, in one order. `success` (methods, n)."""

    methods: tuple[str, ...]
    success: NDArray[np.bool_]
    columns: Mapping[str, NDArray[Any]]
    later: Mapping[str, Mapping[str, NDArray[np.float64]]]
    """`received` -> method -> (n,) 1 or 0 of a trial, NaN: not stored"""

    def groups(self) -> list[tuple[str, str, Mask]]:
        """(what divides, group, its trials); groups without trials are left out."""
        found: list[tuple[str, str, Mask]] = []
        for name, (heading, form, scale, bounds) in BINS.items():
            place = np.digitize(self.columns[name].astype(np.float64), bounds)
            words = _bin_names([form.format(scale * bound) for bound in bounds])
            found += [(heading, word, place == k) for k, word in enumerate(words)]
        sex, seated = self.columns["sex"], self.columns["seated"].astype(bool)
        found += [("sex", str(word), sex == word) for word in np.unique(sex)]
        found += [("seat", "standing", ~seated), ("seat", "seated", seated)]
        return [group for group in found if group[2].any()]

    def median_adults(self) -> Mask:
        """(n,) the trials with median adults."""
        age, stature = (self.columns[k].astype(np.float64) for k in ("age_years", "stature_m"))
        adult, sex = (age >= ADULT_YEARS[0]) & (age < ADULT_YEARS[1]), self.columns["sex"]
        found = np.zeros(len(age), bool)
        for word in np.unique(sex[adult]):
            own = adult & (sex == word)
            found |= own & (np.abs(stature - np.median(stature[own])) <= MEDIAN_M)
        return np.asarray(found & ~self.columns["seated"].astype(bool))

    def served_objects(self) -> list[str]:
        """Objects that every method hands to median adults, by `SERVED`."""
        median, objects = self.median_adults(), self.columns["object"]
        return [
            str(name)
            for name in np.unique(objects[median])
            if (self.success[:, median & (objects == name)].mean(1) >= SERVED).all()
        ]


def _bin_names(bounds: Sequence[str]) -> list[str]:
    """The groups below, between and above bounds, in words."""
    between = (f"{a} to {b}" for a, b in pairwise(bounds))
    return [f"below {bounds[0]}", *between, f"{bounds[-1]} and more"]


def served(run: Run) -> Served:
    """The trials with people that every method of a run has.

    Raises:
        ValueError: the run was swept without people, or is of a version that does not store them.
    """
    tables = [pa.concat_tables(list(run.shards("trials", m, COLUMNS))) for m in run.methods]
    tables = [t.sort_by("trial_id") for t in tables]
    ids = [t["trial_id"].to_numpy() for t in tables]
    if any(not np.array_equal(ids[0], other) for other in ids[1:]):
        raise ValueError(
            "the methods have different trials; --by-people needs one run, completely swept"
        )
    if tables[0]["age_years"].null_count == len(ids[0]):
        raise ValueError(
            "this run has no people; sweep with --people adults, children, elderly, all, wheelchair or a .csv"
        )
    # answers that are missing have no person in their rows: another method's row knows
    columns: dict[str, NDArray[Any]] = {}
    for name in COLUMNS:
        values = tables[0][name].combine_chunks()
        for other in tables[1:]:
            values = pc.coalesce(values, other[name].combine_chunks())
        columns[name] = np.asarray(values.to_pylist())
    won = Outcome.SUCCESS.name.lower()
    success = np.array([[o == won for o in t["outcome"].to_pylist()] for t in tables])
    known = np.array([x is not None for x in columns["age_years"].tolist()])
    columns = {k: v[known] for k, v in columns.items()}
    later = {
        what: {method: values[known] for method, values in of.items()}
        for what, of in _later(run, ids[0]).items()
    }
    return Served(tuple(run.methods), success[:, known], columns, later)


def _later(run: Run, trial_id: NDArray[np.int64]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """`Served.later` of all trials, in their order."""
    found: dict[str, dict[str, NDArray[np.float64]]] = {}
    for method in run.methods:
        got = _received(run, method, trial_id)
        if got is not None:
            found.setdefault(RECEIVED, {})[method] = got
    return found


def _received(run: Run, method: str, trial_id: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """1 or 0 of each trial that `results reception` has judged, else NaN; None without its answers."""
    table = run.side(method, RECEPTION)
    if table is None:
        return None
    names = ("trial_id", "evaluated", "received")
    ids, asked, got = (table[k].to_numpy(zero_copy_only=False) for k in names)
    place = np.searchsorted(trial_id, ids)
    found = np.full(len(trial_id), np.nan)
    found[place] = np.where(asked.astype(bool), got.astype(np.float64), np.nan)
    return found


def people_lines(run: Run, fmt: str = "md", *, full: bool = True) -> str:
    """Success by groups of people, and whom no method serves.

    Args:
        run: what `load_run` gives.
        fmt: md, csv or json.
        full: md: also who received the object and whom no method serves.

    Raises:
        ValueError: no such format, or the run has no people.
    """
    found = served(run)
    if fmt == "md":
        return _md(found, full=full)
    records = [
        {
            "by": by,
            "group": group,
            "method": method,
            "n": int(rows.sum()),
            "successes": int(found.success[k, rows].sum()),
            "no_method": int((~found.success[:, rows].any(0)).sum()),
            "redrawn": int(found.columns["redrawn"][rows].astype(np.int64).sum()),
            **{
                what.replace(", ", "_"): _mean(of[method][rows])
                for what, of in found.later.items()
                if method in of
            },
        }
        for by, group, rows in [
            ("all", "all", np.ones(found.success.shape[1], bool)),
            *found.groups(),
        ]
        for k, method in enumerate(found.methods)
    ]
    if fmt == "csv":
        return Table((), records).csv()
    if fmt == "json":
        return Table((), records).json(served_objects=found.served_objects())
    raise ValueError(f"no table of people in format {fmt!r}; allowed are md, csv, json")


def _md(found: Served, *, full: bool) -> str:
    names = short_names(found.methods)
    n = found.success.shape[1]
    groups = [("all", "", np.ones(n, bool)), *found.groups()]
    median = found.median_adults()
    if median.any():
        groups.append(("median adults", "", median))
    records = []
    for by, group, rows in groups:
        none = ~np.any(found.success[:, rows], axis=0)
        rates = {m: found.success[k, rows] for k, m in enumerate(found.methods)}
        redrawn = int(found.columns["redrawn"][rows].astype(np.int64).sum())
        record: dict[str, Any] = {
            "by": by,
            "group": group,
            "n": int(rows.sum()),
            "redrawn": redrawn,
        }
        for name, hits in (rates | {"no_method": none}).items():
            record |= hits_fields(name, hits)
        records.append(record)
    columns = [
        *(*_GROUP, Column("n", "N")),
        *(Column(m, names[m], RATE) for m in found.methods),
        *(Column("no_method", "No method", RATE), Column("redrawn", "Redrawn")),
    ]
    if not full:
        more = (
            "SR in % (95 %, Wilson). Whom no method serves: r2h-batch report RUN --by-people --full"
        )
        return document([Table(columns, records, [more])])
    notes = [
        *map(plain, legend(names)),
        "SR in % with its 95 % interval (Wilson). No method: trials in which no method succeeds.",
        "Redrawn: people for whom no posture fitted; the trial took the next one.",
    ]
    tables = [Table(columns, records, notes), *_later_tables(found, groups, names)]
    return document([*tables, *_not_served(found)])


def _later_tables(
    found: Served, groups: Sequence[tuple[str, str, Mask]], names: Mapping[str, str]
) -> list[Table]:
    """A table of received, where that is stored."""
    if not found.later:
        return []
    cells = {
        f"{names[m]}: {what}": own for what, of in found.later.items() for m, own in of.items()
    }
    records = [
        {"by": by, "group": group} | {head: _mean(own[rows]) for head, own in cells.items()}
        for by, group, rows in groups
    ]
    columns = [*_GROUP, *(Column(head, form="{value:.1f}", scale=100, none="-") for head in cells)]
    note = "Received (results reception), % of the group's trials for which it is stored: those with a pose. Not in SR."
    return [Table(columns, records, [note])]


def _mean(values: NDArray[np.float64]) -> float | None:
    """The mean of the numbers that are there; None: there are none."""
    there = values[~np.isnan(values)]
    return float(there.mean()) if len(there) else None


def _not_served(found: Served) -> Sequence[Table | str]:
    """The people whom no method hands an object that every method hands to median adults."""
    objects = found.served_objects()
    if not objects:
        return [
            "Not served: no object is handed to median adults by every method, or the run has no adults."
        ]
    failed = (
        np.isin(found.columns["object"], objects) & ~found.success.any(0) & ~found.median_adults()
    )
    keys = ("trial_id", "object", "sex", "age_years", "stature_m", "hand_length_m", "seated")
    records = [{key: found.columns[key][i] for key in keys} for i in np.flatnonzero(failed)[:SHOWN]]
    columns = [
        *(Column("trial_id", "Trial", left=True), Column("object", "Object", left=True)),
        *(Column("sex", "Sex", left=True), Column("age_years", "Age", "{value:.0f}")),
        Column("stature_m", "Stature, m", "{value:.2f}"),
        Column("hand_length_m", "Hand, cm", "{value:.1f}", scale=100),
        Column("seated", "Seat", lambda r: "seated" if r["seated"] else "standing"),
    ]
    share = 100 * failed.sum() / max(1, int(np.isin(found.columns["object"], objects).sum()))
    title = (
        f"Not served: {failed.sum()} people ({share:.1f} % of the trials with these objects) get from no method an object"
        f" that every method hands to median adults ({', '.join(objects)})."
    )
    return [title, Table(columns, records)]
