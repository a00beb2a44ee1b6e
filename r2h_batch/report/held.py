"""Rates of physically stable grasps, where `results held` has stored them."""

from dataclasses import dataclass
from pathlib import Path

import pyarrow.compute as pc
import pyarrow.parquet as pq

from r2h_batch.base.io.log import LOG
from r2h_batch.report.statistics.aggregate import Rate, rate_of
from r2h_batch.runs.side import about_side, side_path
from r2h_batch.runs.store import Run

FOLDER = "held"
"""Folder of a run that holds METHOD.parquet."""
MADE_OF = b"r2h_batch held"
"""Key of the Parquet file's metadata: the digest of the rows, and the code."""

NOTE = "physically stable, percent of those past Stability"


@dataclass(frozen=True)
class Stable:
    """How many grasps past Stability hold in physics.

    Attributes:
        rate: of the physically stable.
        undecided: of those that are too near a limit to say.
    """

    rate: Rate
    undecided: Rate


def stable_rates(run: Run) -> dict[tuple[str, str], Stable]:
    """(split, method) -> the share of the rows past Stability whose object the closed gripper holds: after closing, and
    while its weight acts for 1 s.

    A file that was made of other rows than the run's is left out, and one of a version that did not tell what closing
    loses from what the weight pulls out (no column `lost`).

    Args:
        run: what `load_run` or `join` gives.
    """
    rates = {}
    for entry in run.entries:
        path = side_path(entry, FOLDER)
        if rows_of(path, MADE_OF) is None or rows_of(path, MADE_OF) != run.digest(entry.name):
            continue
        if "lost" not in pq.read_schema(path).names:
            LOG.info(f"{path}: an older version made it; r2h-batch results held makes it anew")
            continue
        table = run.side(entry.name, FOLDER)
        assert table is not None
        for split in pc.unique(table["split"]).to_pylist():
            own = table.filter(pc.equal(table["split"], split))
            held, undecided = (pc.sum(own[k]).as_py() or 0 for k in ("held", "undecided"))
            rates[split, entry.name] = Stable(rate_of(held, len(own)), rate_of(undecided, len(own)))
    return rates


def rows_of(path: Path, made_of: bytes) -> str | None:
    """Digest of the rows that a file was made of, None: it is no such file.

    Args:
        path: of the file; it may be missing.
        made_of: key of its metadata.
    """
    rows = about_side(path, made_of).get("rows")
    return None if rows is None else str(rows)
