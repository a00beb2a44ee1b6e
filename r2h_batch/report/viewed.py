"""How much of the receiver's region the receiver sees, where `results viewed` has stored it."""

import numpy as np
from scipy.special import stdtrit

from r2h_batch.report.statistics.aggregate import Rate
from r2h_batch.runs.side import rows_of, side_path
from r2h_batch.runs.store import Run

FOLDER = "viewed"
"""Folder of a run that holds METHOD.parquet."""
MADE_OF = b"r2h_batch viewed"
"""Key of the Parquet file's metadata: the digest of the rows, and the code."""


def view_rates(run: Run) -> dict[tuple[str, str], Rate]:
    """(split, method) -> the mean share of the region that the receiver's eyes see. A file that was made of other rows than the
    run's is left out.

    Args:
        run: what `load_run` or `join` gives.
    """
    rates = {}
    for entry in run.entries:
        if rows_of(side_path(entry, FOLDER), MADE_OF) != run.digest(entry.name):
            continue
        table = run.side(entry.name, FOLDER)
        assert table is not None
        split = np.array(table["split"].to_pylist(), object)
        for word in dict.fromkeys(split.tolist()):
            rates[word, entry.name] = mean_share(table["viewed"].to_numpy()[split == word])
    return rates


def mean_share(share: np.ndarray) -> Rate:
    """The mean of shares in percent with its t interval; of one share from 0 to 100.

    Args:
        share: (N,) between 0 and 1, one or more.
    """
    n, mean = len(share), 100 * float(share.mean(dtype=np.float64))
    half = np.inf
    if n > 1:
        half = float(stdtrit(n - 1, 0.975) * 100 * share.std(ddof=1, dtype=np.float64) / np.sqrt(n))
    return Rate(mean, max(mean - half, 0.0), min(mean + half, 100.0), None, n)
