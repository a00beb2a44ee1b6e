"""Shares of rows: rates that are no part of SR, each an entry here. Tables (md, csv, json), pages, LaTeX and
comparisons show those that a row has."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.config import BORDERLINE_M
from r2h_batch.plugins import Registry
from r2h_batch.report.statistics.codes import codes
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import SPLITS, Outcome


@dataclass(frozen=True)
class Share:
    """A rate of some of a method's rows.

    Attributes:
        heading: in tables.
        caption: what is counted, of which rows; a sentence.
        needs: stored columns of trials that it is made of; rows of older versions have null there.
        of: a table with these columns -> (N,) bool, whether the row counts; null: the row is not of those. None: no
            stored column says it (`report.picks`).
    """

    heading: str
    caption: str
    needs: tuple[str, ...] = ()
    of: Callable[[pa.Table], pa.ChunkedArray] | None = None


def _presented(rows: pa.Table) -> pa.ChunkedArray:
    return rows["presented"]


def _body_met(rows: pa.Table) -> pa.ChunkedArray:
    return pc.less(rows["body_m"], 0)


def _through(rows: pa.Table) -> pa.ChunkedArray:
    """By more than float32's doubt."""
    success = pc.equal(rows["outcome"].cast(pa.string()), Outcome.SUCCESS.name.lower())
    return pc.if_else(success, pc.less(rows["margin_plan_m"], -BORDERLINE_M), None)


THROUGH = "through"
PICK = "pick"

SHARES: Registry[Share] = Registry(
    "share",
    {
        "presented": Share("Presented", "Presented (not in SR).", ("presented",), _presented),
        "body_met": Share(
            "Body met",
            "Motions that meet the receiver's arm or torso (part of Safe with --receiver body, as in r2h-v2).",
            ("body_m",),
            _body_met,
        ),
        THROUGH: Share(
            "Through",
            "Successes whose path passes through something by more than 0.1 mm between two samples (edge_check moveit).",
            ("outcome", "margin_plan_m"),
            _through,
        ),
        PICK: Share(
            "Pick posture",
            "Trials of a method that sees in which some posture takes the object up where it lay (not in SR).",
        ),
    },
)
"""Key in csv and json -> share: ours, and those that packages name as `share.NAME`."""


def counted_shares() -> dict[str, Share]:
    """Those that stored columns say."""
    return {name: SHARES[name] for name in SHARES if SHARES[name].of is not None}


def with_shares(rows: pa.Table) -> pa.Table:
    """The rows with a column for each of `counted_shares`, under its name.

    Args:
        rows: with the columns that they need.

    Raises:
        ValueError: a share has not one bool or null for each row.
    """
    found = {}
    for name, share in counted_shares().items():
        assert share.of is not None
        found[name] = share.of(rows)
        if len(found[name]) != len(rows) or found[name].type not in (pa.bool_(), pa.null()):
            what = f"{len(found[name])} values of type {found[name].type} for {len(rows)} rows"
            raise ValueError(f"share {name}: {what}; it must be a bool or null for each row")
    for name, column in found.items():
        if name in rows.column_names:
            rows = rows.drop_columns([name])
        rows = rows.append_column(name, column.cast(pa.bool_()))
    return rows


def hits_on(
    run: Run, method: str, trials: Mapping[str, int]
) -> dict[tuple[str, str], tuple[int, int]]:
    """(split, share) -> rows that count, and rows that it is of, among the first trials of each split.

    Args:
        run: what `load_run` gives.
        method: its name in the run.
        trials: split -> number of its first trials.
    """
    found: dict[tuple[str, str], tuple[int, int]] = {}
    every = run.planned(method) == trials
    limits = np.array([trials.get(split, 0) for split in SPLITS])
    needs = {column for share in counted_shares().values() for column in share.needs}
    for shard in run.shards("trials", method, sorted({"trial_id", "split"} | needs)):
        split = codes(shard, "split", SPLITS)
        rows = with_shares(shard)
        # a plan is the first N trials of each split; their ids count them (schedule.py)
        kept = every | (rows["trial_id"].to_numpy() // len(SPLITS) < limits[split])
        for k, word in enumerate(SPLITS):
            own = rows.filter(pa.array(kept & (split == k)))
            for name in counted_shares():
                hits, of = found.get((word, name), (0, 0))
                known = len(own) - own[name].null_count
                found[word, name] = (hits + (pc.sum(own[name]).as_py() or 0), of + known)
    return found
