"""People's comfort with the objects that they were handed, beside a run's measures of the same objects."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from r2h_batch.base.errors import FileError
from r2h_batch.report.statistics.tally import tally
from r2h_batch.report.text import NA, aligned, legend, notes_list, plain, short_names
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.study.table_file import NAME, number, read_table

COLUMNS = {
    **dict.fromkeys(("object", "capture"), NAME),
    "handover": number(0, 1e6, whole=True),
    **dict.fromkeys(("giver", "receiver"), number(0, 10)),
}
"""Columns of comfort.csv, as `import objects --from hoh` writes it."""

LEAST = 5
"""Objects below which no correlation is printed."""
DRAWS = 2000
NOTES = (
    "rho: Spearman's rank correlation over objects, between the mean rating of an object's receivers (higher: more comfortable)"
    " and the method's measure of that object; brackets: 95 %, bootstrap over objects.",
    "People rated handovers between people, so a correlation says whether objects that people take with comfort are those that a"
    " method hands over well. It says nothing about comfort with the robot.",
)


def comfort_report(folder: Path, file: Path) -> str:
    """How the receivers' comfort with an object goes with each method's measures of it, as text.

    Args:
        folder: a run with the rated objects.
        file: CSV with the columns of `COLUMNS`.

    Raises:
        FileError: the run has fewer than two of the rated objects.
    """
    ratings: dict[str, list[float]] = {}
    for row in read_table(file, COLUMNS):
        ratings.setdefault(row["object"], []).append(row["receiver"])
    run = load_run(folder)
    short = short_names(run.methods)
    lines = []
    for method in run.methods:
        cells = [c for c in tally(run, method).by("object") if c["object"] in ratings]
        if len(cells) < 2:
            there = ", ".join(list(ratings)[:10])
            raise FileError(
                f"{folder}: has {len(cells)} of the rated objects ({there}); sweep with --objects"
            )
        rated = np.array([np.mean(ratings[c["object"]]) for c in cells])
        rates = np.array([100 * c["successes"] / c["n"] for c in cells])
        shown = [c["presented_count"] > 0 for c in cells]
        faced = np.array(
            [100 * c["presented_sum"] / c["presented_count"] for c, s in zip(cells, shown) if s]
        )
        number_of = sum(len(ratings[c["object"]]) for c in cells)
        line = [
            plain(short[method]),
            str(len(cells)),
            str(number_of),
            f"{rated.mean():.2f}",
            f"{rates.mean():.1f}",
        ]
        lines.append(
            [*line, _rank_correlation(rated, rates), _rank_correlation(rated[shown], faced)]
        )
    head = ["Method", "objects", "ratings", "rating", "SR", "rho with SR", "rho with Presented"]
    return f"{aligned(head, lines, 1)}\n\n{notes_list([*map(plain, legend(short)), *NOTES])}\n"


def _rank_correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> str:
    """`RHO [LOW, HIGH]` over objects; n/a with too few objects, or where all are equal."""
    if len(a) < LEAST or not np.ptp(a) or not np.ptp(b):
        return NA
    found = stats.bootstrap(
        (a, b), lambda x, y: stats.spearmanr(x, y).statistic, paired=True, vectorized=False, n_resamples=DRAWS,
        method="percentile", rng=np.random.default_rng(0),
    )  # fmt: skip
    low, high = found.confidence_interval
    return f"{stats.spearmanr(a, b).statistic:+.2f} [{low:+.2f}, {high:+.2f}]"
