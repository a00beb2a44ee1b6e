"""Shares of rows (`rates.shares`): rates that are no part of SR. Tables (md, csv, json), pages, LaTeX and comparisons show those
that a row has."""

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.base.user_code import raised
from r2h_batch.plugins import PackageError
from r2h_batch.report.statistics.codes import codes
from r2h_batch.report.statistics.rates import RATES, Share, shares
from r2h_batch.runs.store import Run
from r2h_batch.strangers import stranger
from r2h_batch.verdicts import SPLITS


def counted_shares() -> dict[str, Share]:
    """Those that stored columns say."""
    return {name: share for name, share in shares().items() if share.of is not None}


def with_shares(rows: pa.Table) -> pa.Table:
    """The rows with a column for each of `counted_shares`, under its name.

    Args:
        rows: with the columns that they need.

    Raises:
        PackageError: a share has not one bool or null for each row.
    """
    found = {}
    for name, share in counted_shares().items():
        assert share.of is not None
        whose = RATES.entry(name)
        try:
            with stranger(whose, share.of.__module__):
                column = share.of(rows)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # SystemExit too
            raise PackageError(f"{whose}: {raised(error)}") from error
        if not isinstance(column, (pa.Array, pa.ChunkedArray)):
            shown = f"a {type(column).__name__}"
        else:
            shown = f"{len(column)} values of type {column.type}"
            if len(column) == len(rows) and column.type in (pa.bool_(), pa.null()):
                found[name] = column
                continue
        what = f"answers {shown} for {len(rows)} rows"
        raise PackageError(
            f"{whose}: {what}; it must be a column of pyarrow, a bool or null for each row"
        )
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
