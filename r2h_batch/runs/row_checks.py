"""Whether stored rows can be true: the planned trials in the planned order, and verdicts that agree with themselves."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from r2h_batch.config import BORDERLINE_M, FARTHEST_M
from r2h_batch.io.read import printable
from r2h_batch.runs.columns import PATTERNS, codes, pattern, pattern_outcomes, verdicts
from r2h_batch.runs.rows import OUTCOME_NAMES, TRIAL_SCHEMA
from r2h_batch.turns import PROTOCOLS, hands_in_turn, objects_in_turn, trial_ids
from r2h_batch.verdicts import CRITERIA, MOST_SECONDS, SIDES, SPLITS, Outcome

SECONDS = ("t_plan_s", "t_exec_s", "t_method_s")
CHECKED = (
    "trial_id", "split", "outcome", *(f"passed_{c}" for c in CRITERIA), *(f"margin_{c}_m" for c in CRITERIA), *SECONDS,
)  # fmt: skip
"""Columns of the trials that are looked at."""

TOUCHING = ("stability", "reach")
"""Criteria that a margin of 0 passes (`judge.metrics`)."""
ENDLESS = ("stability", "plan")
"""Criteria whose failure may have no size, -inf: nothing that the shake left, no path."""
MOST_PASSED_M = 1.0
"""No margin of a pass is larger, but Reach's, which is the ball's radius at most: clearances count
5 cm, Stability 1 cm."""


def inconsistent(header: Mapping[str, Any], table: pa.Table) -> str | None:
    """What is wrong with a row of the trials (`CHECKED`) that can be no verdict; None if all
    can."""
    for name in CHECKED:
        if table.schema.field(name).type != TRIAL_SCHEMA.field(name).type:
            return f"column {name!r} is of another type than the format says"
    ids = table["trial_id"].to_numpy()
    if not len(ids):
        return None
    try:
        outcome, split = (
            codes(table, *c).astype(np.int16)
            for c in (("outcome", OUTCOME_NAMES), ("split", SPLITS))
        )
    except (ValueError, IndexError) as error:
        return printable(error)[:200]
    judged = verdicts(table)
    number = pattern(
        {c: given.view(np.uint8) + passed.view(np.uint8) for c, (given, passed) in judged.items()}
    )
    allowed = _outcomes()
    fits = allowed.reshape(-1)[(outcome * len(SPLITS) + split) * allowed.shape[2] + number]
    if not fits.all():
        row = int(fits.argmin())
        said = [OUTCOME_NAMES[k] for k in np.flatnonzero(allowed[:, split[row], number[row]])]
        means = (
            f"its criteria say {' or '.join(said)}"
            if said
            else "its criteria say nothing that can be"
        )
        return f"trial {ids[row]}: outcome is {OUTCOME_NAMES[outcome[row]]!r}, {means}"
    for criterion, (given, passed) in judged.items():
        margin = table[f"margin_{criterion}_m"].to_numpy()
        odd = _first_odd(header, criterion, given, passed, margin)
        if odd is not None:
            verdict = ("is not evaluated", "fails", "passes")[int(given[odd]) + int(passed[odd])]
            return f"trial {ids[odd]}: {criterion} {verdict} with a margin of {margin[odd]:g} m"
    for name in SECONDS:
        seconds = table[name].to_numpy()
        if np.fmin.reduce(seconds) < 0 or np.fmax.reduce(seconds) > MOST_SECONDS:
            row = int(((seconds < 0) | (seconds > MOST_SECONDS)).argmax())
            return f"trial {ids[row]}: {seconds[row]:g} s in {name}; 0 to {MOST_SECONDS:g} s are allowed"
    return None


@lru_cache(maxsize=1)
def _outcomes() -> np.ndarray:
    """(9, 2, 243) whether an outcome goes with a split and a pattern: the first failure, or nothing
    evaluated."""
    found = np.zeros((len(OUTCOME_NAMES), len(SPLITS), len(PATTERNS)), bool)
    for k in range(len(OUTCOME_NAMES)):
        if k < Outcome.INVALID_INPUT:
            found[k] = pattern_outcomes() == k
        else:
            found[k, :, 0] = True
    return found


def _first_odd(
    header: Mapping[str, Any],
    criterion: str,
    given: np.ndarray,
    passed: np.ndarray,
    margin: np.ndarray,
) -> int | None:
    """The first row whose margin has not the sign or size of its verdict; NaN is none."""
    configuration = header["configuration"]
    most, least = MOST_PASSED_M, -1.01 * FARTHEST_M
    if criterion == "reach":
        most = (configuration.get("thresholds") or {}).get(
            "reach_radius_m", FARTHEST_M
        ) + BORDERLINE_M
    if criterion == "plan":
        # planned paths are clear to within the tolerance that clearances are located with; between
        # samples anything is
        sampled = (configuration.get("plan") or {}).get("edge_check") == "moveit"
        good = margin > np.float32(-MOST_PASSED_M if sampled else -BORDERLINE_M)
    else:
        good = margin >= 0 if criterion in TOUCHING else margin > 0
    smallest, largest = np.fmin.reduce(margin), np.fmax.reduce(margin)
    endless = criterion in ENDLESS and np.isneginf(smallest)
    if (
        np.array_equal(good, passed)
        and np.array_equal(margin == margin, given)
        and not largest > most
        and (endless or not smallest < least)
    ):
        return None
    size = (margin > most) | ((margin < least) & ~(np.isneginf(margin) & (criterion in ENDLESS)))
    wrong = (good != passed) | ((margin == margin) != given) | size
    return int(wrong.argmax()) if wrong.any() else None


_COMPARED = {
    "trials": ("trial_id", "object", "split", "side"),
    "details": ("trial_id", "hand_index"),
    "failures": ("trial_id", "object", "hand_index"),
}
"""Columns of stored files that the plan decides; of the other kinds the trial's id alone."""


def not_as_planned(
    header: Mapping[str, Any], first: int, last: int, table: pa.Table, *, every: bool
) -> str | None:
    """What differs from positions first..last-1 of the plan, None if nothing; `every`: all of them
    are there.

    Of a run of another protocol nothing is known.
    """
    if header["protocol"] not in PROTOCOLS:
        return None
    if "objects" not in header:
        return "cannot be compared with the plan: run.json names no objects"
    planned = trial_ids(header["trials"], first, last)
    ids = table["trial_id"].to_numpy()
    if np.array_equal(planned, ids):
        return _other_names(header, ids, table)
    order = np.argsort(planned)
    place = (
        order[np.searchsorted(planned[order], ids).clip(max=len(planned) - 1)]
        if len(planned)
        else order
    )
    strange = np.flatnonzero(planned[place] != ids) if len(planned) else np.arange(len(ids))
    if len(strange):
        return f"trial_id {ids[strange[0]]} is not planned here"
    if (np.diff(place) <= 0).any():
        row = int(np.argmax(np.diff(place) <= 0)) + 1
        return f"trial_id {ids[row]} is not where the plan has it"
    if every and len(ids) != len(planned):
        return f"{len(planned) - len(ids)} planned trials are missing"
    return _other_names(header, ids, table)


def _other_names(header: Mapping[str, Any], ids: NDArray[np.int64], table: pa.Table) -> str | None:
    """Object, split, hand and side of the hand, where the table has them; the hand where run.json
    lists the set's sides."""
    names, splits = ([o[k] for o in header["objects"]] for k in ("name", "split"))
    try:
        objects, side = objects_in_turn(ids, splits)
    except ValueError as error:
        return f"cannot be compared with the plan: {error}"
    sides = np.array([SIDES.index(s) for s in header.get("hands", ())], np.int64)
    if (
        len(sides) and (sides == sides[0]).all()
    ):  # a set of one side gives that one whoever's turn it is
        side = np.full_like(side, sides[0])
    for column, words, expected in (
        ("object", names, objects),
        ("split", SPLITS, ids & 1),
        ("side", SIDES, side),
    ):
        if column not in table.column_names:
            continue
        found = _codes(table[column], words)
        if (wrong := np.flatnonzero(found != expected)).size:
            row = int(wrong[0])
            said = printable(table[column][row].as_py())[:80]
            return f"trial {ids[row]}: {column} is {said!r}, planned is {words[expected[row]]!r}"
    if "hand_index" in table.column_names and len(sides):
        if table.schema.field("hand_index").type != pa.int32() or table["hand_index"].null_count:
            return "column 'hand_index' is not of whole numbers"
        hand, planned = (
            table["hand_index"].to_numpy(),
            hands_in_turn(ids, side, sides, header["protocol"]),
        )
        if (wrong := np.flatnonzero(hand != planned)).size:
            row = int(wrong[0])
            return f"trial {ids[row]}: hand_index is {hand[row]}, planned is {planned[row]}"
    return None


def _codes(column: pa.ChunkedArray, words: Sequence[str]) -> NDArray[np.int64]:
    """(N,) places of a column's words in `words`; -1 for other ones and for none."""
    place = {word: i for i, word in enumerate(words)}
    whole = column.combine_chunks()
    encoded = whole if pa.types.is_dictionary(whole.type) else whole.dictionary_encode()
    known = np.array([*(place.get(w, -1) for w in encoded.dictionary.to_pylist()), -1], np.int64)
    return known[encoded.indices.fill_null(len(known) - 1).to_numpy()]


def stored_wrong(
    header: Mapping[str, Any], first: int, last: int, kind: str, file: Path
) -> str | None:
    """What is wrong with the rows of a stored file: not the plan's, or no verdicts. Only the
    columns it takes are read."""
    known = header["protocol"] in PROTOCOLS
    columns = [
        *(_COMPARED.get(kind, ("trial_id",)) if known else ()),
        *(CHECKED if kind == "trials" else ()),
    ]
    try:
        with pq.ParquetFile(file) as stored:
            rows = stored.metadata.num_rows
            if rows > last - first or (kind == "trials" and rows != last - first):
                return f"holds {rows} rows, planned were {last - first}"
            if missing := [c for c in columns if c not in stored.schema_arrow.names]:
                return f"column {missing[0]!r} is missing"
            table = stored.read(columns=list(dict.fromkeys(columns)))
        if columns and (
            table.schema.field("trial_id").type != pa.int64() or table["trial_id"].null_count
        ):
            return "column 'trial_id' is not of whole numbers"
        wrong = (
            not_as_planned(header, first, last, table, every=kind == "trials") if known else None
        )
        return wrong or (inconsistent(header, table) if kind == "trials" else None)
    except (OSError, pa.ArrowException) as error:
        return f"cannot be read ({printable(error)[:300]})"
