"""Whether stored rows can be true: the planned trials in order, and verdicts that agree with
themselves.

sha256 finds damage; these checks find rows that somebody wrote with receipt and sha256 to match. A
forged row can still hold another verdict with the margins that go with it: `results reevaluate`
finds that.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from r2h_batch.config import BORDERLINE_M, FARTHEST_M
from r2h_batch.io.read import FileError, printable
from r2h_batch.io.tables import check_decoded_size
from r2h_batch.runs.columns import codes, pattern, pattern_outcomes, verdicts
from r2h_batch.runs.rows import KINDS, OUTCOME_NAMES, PATH_SCHEMA, POSE_SCHEMA, TRIAL_SCHEMA
from r2h_batch.schedule import PROTOCOLS, assign_hands, assign_objects, trial_ids
from r2h_batch.verdicts import CRITERIA, MOST_SECONDS, REGISTRY, SIDES, SPLITS, Outcome

SECONDS = ("t_plan_s", "t_exec_s", "t_method_s")
CHECKED = (
    *("trial_id", "split", "outcome"),
    *(f"passed_{c}" for c in CRITERIA),
    *(f"margin_{c}_m" for c in CRITERIA),
    *SECONDS,
)
"""Columns of the trials that `inconsistent` looks at, and `KIND_COLUMNS` where a run has them."""

KIND_COLUMNS = tuple(f"margin_kind_{c}" for c in CRITERIA)
MOTION_COLUMNS = {"poses": ("T_obj_ee", "T_world_ee"), "paths": ("time_s", "q")}

PLANNED = {
    "trials": ("trial_id", "object", "split", "side"),
    "details": ("trial_id", "hand_index"),
    "failures": ("trial_id", "object", "hand_index"),
}
"""Columns that the trial list decides; of other tables the trial id alone."""

FOREIGN = "r2handoversim"
"""Protocol of runs that hold somebody else's verdicts (`import results`): without margins."""
MOST_HANDS = 10**6
MOST_PASSED_M = 1.0
"""No margin of a pass is larger, except Reach's: clearances count up to 5 cm, Stability 1 cm."""


def not_as_planned(
    header: Mapping[str, Any], first: int, last: int, table: pa.Table, *, every: bool
) -> str | None:
    """How rows differ from positions `first` to `last` - 1 of the trial list; None: they do not.

    Args:
        header: run.json. Nothing is known of runs of other protocols.
        first: first position.
        last: position after the last one.
        table: rows with `trial_id` and some columns of `PLANNED`.
        every: whether every planned trial must have a row.
    """
    if header["protocol"] not in PROTOCOLS:
        return None
    if "objects" not in header:
        return "cannot be compared with the plan: run.json names no objects"
    planned, ids = trial_ids(header["trials"], first, last), table["trial_id"].to_numpy()
    if not np.array_equal(planned, ids):
        if len(strange := ids[~np.isin(ids, planned)]):
            return f"trial_id {strange[0]} is not planned here"
        ordered = planned[np.isin(planned, ids)]
        if not np.array_equal(ordered, ids):
            n = min(len(ordered), len(ids))
            at = int(np.append(ordered[:n] != ids[:n], True).argmax())
            return f"trial_id {ids[min(at, len(ids) - 1)]} is not where the plan has it"
        if every:
            return f"{len(planned) - len(ids)} planned trials are missing"
    try:
        for name, words, expected in _planned_columns(header, ids, table.column_names):
            column = table[name]
            if words is not None:
                found = _places(column, words)
            elif column.type != pa.int32() or column.null_count:
                return f"column {name!r} is not of whole numbers"
            else:
                found = column.to_numpy()
            if (wrong := np.flatnonzero(found != expected)).size:
                row = int(wrong[0])
                stored, right = column[row].as_py(), expected[row]
                if words is not None:
                    stored, right = repr(printable(stored)[:80]), repr(words[right])
                return f"trial {ids[row]}: {name} is {stored}, planned is {right}"
    except ValueError as error:
        return f"cannot be compared with the plan: {error}"
    return None


def _planned_columns(
    header: Mapping[str, Any], ids: NDArray[np.int64], names: list[str]
) -> Iterator[tuple[str, Any, NDArray[Any]]]:
    """(column, its words or None, (N,) the planned code of each trial)."""
    objects, side = assign_objects(ids, [o["split"] for o in header["objects"]])
    hands = _sides(header.get("hands", ()))
    if len(hands) and (hands == hands[0]).all():  # a set of one side gives that side every time
        side = np.full_like(side, hands[0])
    if "object" in names:
        yield "object", [o["name"] for o in header["objects"]], objects
    if "split" in names:
        yield "split", SPLITS, ids & 1
    if "side" in names:
        yield "side", SIDES, side
    if "hand_index" in names and len(hands):
        yield "hand_index", None, assign_hands(ids, side, hands, header["protocol"])


def _sides(runs: Sequence[Any]) -> NDArray[np.int64]:
    """(H,) side of each hand, from (side, number of hands) or, in older folders, each hand's side."""
    pairs = [(run, 1) if isinstance(run, str) else run for run in runs]
    if sum(n for _, n in pairs) > MOST_HANDS:
        raise ValueError(f"run.json names more than {MOST_HANDS} hands")
    sides = [SIDES.index(side) for side, _ in pairs]
    return np.repeat(np.array(sides, np.int64), np.array([n for _, n in pairs], np.int64))


def _places(column: pa.ChunkedArray, words: Any) -> NDArray[np.int64]:
    """(N,) places of a column's words in `words`; -1 for other words and for none."""
    place = {word: i for i, word in enumerate(words)}
    whole = column.combine_chunks()
    encoded = whole if pa.types.is_dictionary(whole.type) else whole.dictionary_encode()
    known = np.array([*(place.get(w, -1) for w in encoded.dictionary.to_pylist()), -1], np.int64)
    return known[encoded.indices.fill_null(len(known) - 1).to_numpy()]


def inconsistent(header: Mapping[str, Any], table: pa.Table) -> str | None:
    """What no verdict can say in a row of the trials (`CHECKED`); None: every row is possible.

    The outcome must be the first failure, a margin must have the sign of its verdict and a
    possible size, a time must be between 0 and 30 years.
    """
    for name in (*CHECKED, *(c for c in KIND_COLUMNS if c in table.column_names)):
        if table.schema.field(name).type != TRIAL_SCHEMA.field(name).type:
            return f"column {name!r} is of another type than the format says"
    ids = table["trial_id"].to_numpy()
    if not len(ids):
        return None
    try:
        outcome = codes(table, "outcome", OUTCOME_NAMES)
        split = codes(table, "split", SPLITS)
    except (ValueError, IndexError) as error:
        return printable(error)[:200]
    judged = verdicts(table)
    states = {c: given.view(np.uint8) + good.view(np.uint8) for c, (given, good) in judged.items()}
    number = pattern(states)
    says = pattern_outcomes()[split, number]
    fits = np.where(outcome < Outcome.INVALID_INPUT, says == outcome, number == 0)
    if not fits.all():
        row = int(fits.argmin())
        means = OUTCOME_NAMES[says[row]] if says[row] >= 0 else "nothing that can be"
        found = OUTCOME_NAMES[outcome[row]]
        return f"trial {ids[row]}: outcome is {found!r}, its criteria say {means}"
    for name, (given, passed) in judged.items():
        margin = table[f"margin_{name}_m"].to_numpy()
        if header.get("protocol") == FOREIGN and np.isnan(margin).all():
            continue
        wrong = _wrong_margins(header["configuration"], name, given, passed, margin)
        if wrong.any():
            row = int(wrong.argmax())
            verdict = ("is not evaluated", "fails", "passes")[states[name][row]]
            return f"trial {ids[row]}: {name} {verdict} with a margin of {margin[row]:g} m"
        if (column := f"margin_kind_{name}") in table.column_names:
            wrong = _wrong_kinds(table[column], margin)
            if wrong.any():
                row = int(wrong.argmax())
                said = printable(table[column][row].as_py())
                return f"trial {ids[row]}: {column} is {said} for a margin of {margin[row]:g} m"
    for name in SECONDS:
        seconds = table[name].to_numpy()
        wrong = (seconds < 0) | (seconds > MOST_SECONDS)
        if wrong.any():
            row = int(wrong.argmax())
            bounds = f"0 to {MOST_SECONDS:g} s are allowed"
            return f"trial {ids[row]}: {seconds[row]:g} s in {name}; {bounds}"
    return None


def _wrong_margins(
    configuration: Mapping[str, Any],
    name: str,
    given: NDArray[np.bool_],
    passed: NDArray[np.bool_],
    margin: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """(N,) whether a margin has another sign or size than its verdict allows; NaN: no margin."""
    entry = REGISTRY[CRITERIA.index(name)]
    most, least = MOST_PASSED_M, -1.01 * FARTHEST_M
    good = margin >= 0 if entry.touching_passes else margin > 0
    if name == "reach":
        thresholds = configuration.get("thresholds") or {}
        most = thresholds.get("reach_radius_m", FARTHEST_M) + BORDERLINE_M
    if name == "plan":
        # A certified path is clear to within the tolerance of a clearance. A path that is checked
        # at samples only may pass through something between them. A failure's margin may be as deep.
        sampled = (configuration.get("plan") or {}).get("edge_check") == "moveit"
        deepest = np.float32(-MOST_PASSED_M if sampled else -BORDERLINE_M)
        good = np.where(passed, margin > deepest, margin > 0)
    small = (margin < least) & ~(np.isneginf(margin) & entry.unbounded)
    return (good != passed) | (np.isnan(margin) == given) | (margin > most) | small


def _wrong_kinds(column: pa.ChunkedArray, margin: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(N,) whether a kind is none of a margin's: a bound is below 0, -inf is a cap, NaN has none.

    A column without any word is that of an older run and claims nothing.
    """
    kind = _places(column, KINDS)
    bound, cap = (KINDS.index(word) for word in ("bound", "cap"))
    fits = np.where(
        np.isneginf(margin), kind == cap, (kind >= 0) & ((kind != bound) | (margin < 0))
    )
    fits = np.where(np.isnan(margin), column.is_null().to_numpy(), fits)
    return ~fits & (column.null_count < len(column))


def _wrong_motions(kind: str, table: pa.Table, refused: NDArray[np.int64]) -> str | None:
    """What no row of poses or paths can hold; None: nothing.

    Poses and paths are numbers, except those of the trials `refused` (outcome `invalid_input`). A
    path has waypoints and a time for each.
    """
    schema = POSE_SCHEMA if kind == "poses" else PATH_SCHEMA
    for name in MOTION_COLUMNS[kind]:
        if table[name].type != schema.field(name).type or table[name].null_count:
            return f"column {name!r} is of another type than the format says"
    ids, arrays = (
        table["trial_id"].to_numpy(),
        [table[name].combine_chunks() for name in MOTION_COLUMNS[kind]],
    )
    if kind == "poses":
        broken = np.any([~_finite(a, np.arange(len(ids) + 1) * 16) for a in arrays], 0)
        if (broken := broken & ~np.isin(ids, refused)).any():
            row = int(broken.argmax())
            return f"trial {ids[row]}: its pose has a number that is none, and it was judged"
        return None
    if (postures := arrays[1].flatten()).null_count:
        return "column 'q' has empty postures"
    time, q = (a.offsets.to_numpy() - a.offsets[0].as_py() for a in arrays)
    broken = (np.diff(time) < 1) | (np.diff(time) != np.diff(q))
    odd = ~_finite(arrays[0], time) | ~_finite(postures, q * 6)
    broken |= odd & ~np.isin(ids, refused)
    if broken.any():
        row = int(broken.argmax())
        return f"trial {ids[row]}: its path is empty or has a number that is none"
    return None


def _refused(trials: Path) -> NDArray[np.int64]:
    """trial_id of the rows of a file of trials whose outcome is `invalid_input`."""
    with pq.ParquetFile(trials) as stored:
        check_decoded_size(stored, 1 << 30, "its trials", ("trial_id", "outcome"))
        table = stored.read(columns=["trial_id", "outcome"])
    return table["trial_id"].to_numpy()[_places(table["outcome"], ["invalid_input"]) == 0]


def _finite(lists: pa.Array, offsets: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(N,) whether all numbers of each list are finite; those of list i start at `offsets[i]`."""
    numbers = np.asarray(lists.flatten().cast(pa.float32()).fill_null(np.nan))
    bad = np.append(0, np.cumsum(~np.isfinite(numbers)))
    return bad[offsets[1:]] == bad[offsets[:-1]]


def most_decoded(kind: str, trials: int) -> int:
    """Largest memory, bytes, that the columns of a shard may take."""
    return (16 << 20) + (1 << 17 if kind == "paths" else 1 << 13) * trials


def wrong_rows(
    header: Mapping[str, Any], receipt: Mapping[str, Any], kind: str, file: Path
) -> str | None:
    """What is wrong with the rows of a stored file; None: nothing. Reads the checked columns."""
    first, last = receipt["first"], receipt["last"]
    exact = last - first
    if kind in ("details", "poses"):  # a row of each trial that was answered
        exact -= sum(counts.get("missing", 0) for counts in receipt["outcomes"].values())
    known, trials = header["protocol"] in PROTOCOLS, kind == "trials"
    columns = [
        *(PLANNED.get(kind, ("trial_id",)) if known else ()),
        *(CHECKED if trials else ()),
        *(("trial_id", *MOTION_COLUMNS[kind]) if kind in MOTION_COLUMNS else ()),
    ]
    try:
        with pq.ParquetFile(file) as stored:
            rows = stored.metadata.num_rows
            if rows > exact or (kind in ("trials", "details", "poses") and rows != exact):
                return f"holds {rows} rows, planned were {exact}"
            if missing := [c for c in columns if c not in stored.schema_arrow.names]:
                return f"column {missing[0]!r} is missing"
            columns += [c for c in KIND_COLUMNS if trials and c in stored.schema_arrow.names]
            most = most_decoded(kind, last - first)
            check_decoded_size(stored, most, "its rows", columns)
            table = stored.read(columns=list(dict.fromkeys(columns)))
        refused = np.array([], np.int64)
        if kind in MOTION_COLUMNS:
            refused = _refused(file.parents[2] / receipt["files"]["trials"]["path"])
    except (FileError, OSError, pa.ArrowException) as error:
        return f"cannot be read ({printable(error)[:300]})"
    if columns:
        ids = table["trial_id"]
        if ids.type != pa.int64() or ids.null_count:
            return "column 'trial_id' is not of whole numbers"
    wrong = not_as_planned(header, first, last, table, every=trials) if known else None
    if kind in MOTION_COLUMNS:
        wrong = wrong or _wrong_motions(kind, table, refused)
    return wrong or (inconsistent(header, table) if trials else None)
