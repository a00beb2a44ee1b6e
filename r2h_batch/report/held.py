"""Rates of objects that the closed gripper holds under their weight for 1 s, where `results held` has stored them."""

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from r2h_batch.report.statistics.aggregate import Rate, rate_of
from r2h_batch.runs.store import Run

FOLDER = "held"
"""Folder of a run that holds METHOD.parquet."""
MADE_OF = b"r2h_batch held"
"""Key of the Parquet file's metadata: the digest of the rows, and the code."""


def held_rates(run: Run) -> dict[tuple[str, str], Rate]:
    """(split, method) -> the share of the rows past Stability whose object stays in the closed gripper for 1 s.

    A file that was made of other rows than the run's is left out.

    Args:
        run: what `load_run` or `join` gives.
    """
    rates = {}
    for entry in run.entries:
        path = entry.folder / FOLDER / f"{entry.slug}.parquet"
        if not path.is_file() or rows_of(path, MADE_OF) != run.digest(entry.name):
            continue
        table = pq.read_table(path, columns=["split", "held"])
        for split in pc.unique(table["split"]).to_pylist():
            held = table.filter(pc.equal(table["split"], split))["held"]
            rates[split, entry.name] = rate_of(pc.sum(held).as_py() or 0, len(held))
    return rates


def rows_of(path: Path, made_of: bytes) -> str | None:
    """Digest of the rows that a file was made of, None: it is no such file.

    Args:
        path: of a Parquet file.
        made_of: key of its metadata.
    """
    try:
        return str(json.loads(pq.read_schema(path).metadata[made_of])["rows"])
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError):
        return None
