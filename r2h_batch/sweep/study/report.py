"""Ratings and their tests (Friedman and Wilcoxon) as texts, and rank correlations with intervals."""

from collections.abc import Mapping, Sequence
from itertools import combinations, permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from r2h_batch.base.errors import FileError, UsageError
from r2h_batch.base.table import Table, document, of_lines
from r2h_batch.sweep.study.table_file import LINE, NAME, number, read_table

DRAWS = 10_000

RATING_COLUMNS = {
    **dict.fromkeys(("participant", "method", "dimension"), NAME),
    "rating": number(1, 5, whole=True),
}

Ratings = tuple[np.ndarray, list[str], int]
"""(participants, methods) ratings of complete participants, the methods, participants left out."""

People = dict[str, dict[str, int]]
"""Participant -> method -> rating."""


def read_ratings(path: Path) -> dict[str, Ratings]:
    """Dimension -> its ratings, from columns participant, method, dimension, rating (1 to 5)."""
    rows = read_table(path, RATING_COLUMNS)
    methods = list(dict.fromkeys(r["method"] for r in rows))
    if len(methods) < 2:
        raise FileError(f"{path}: all ratings are of {methods[0]}; two or more methods are needed")
    return {
        dimension: _complete(people, methods, f"{path}: {dimension}")
        for dimension, people in _by_dimension(rows, path).items()
    }


def _by_dimension(rows: Sequence[Mapping[str, Any]], path: Path) -> dict[str, People]:
    """Dimension -> the ratings of each participant; refuses two of one participant for one method."""
    found: dict[str, People] = {}
    for r in rows:
        person = found.setdefault(r["dimension"], {}).setdefault(r["participant"], {})
        if r["method"] in person:
            words = f"{r['participant']} rates {r['method']} twice for {r['dimension']}"
            raise FileError(f"{path}: line {r[LINE]}: participant {words}")
        person[r["method"]] = r["rating"]
    return found


def _complete(people: People, methods: list[str], where: str) -> Ratings:
    """The ratings of those who rated every method; two of them at least."""
    complete = [[p[m] for m in methods] for p in people.values() if len(p) == len(methods)]
    if len(complete) < 2:
        counts = {m: sum(m in p for p in people.values()) for m in methods}
        rated = ", ".join(f"{m} {n}" for m, n in counts.items())
        raise FileError(
            f"{where}: {len(complete)} participants rated every method; two are needed."
            f" Ratings by method: {rated}; mend a misspelt name, or leave it out"
        )
    return np.array(complete), methods, len(people) - len(complete)


def rating_report(ratings: Mapping[str, Ratings]) -> str:
    """Summaries and tests of every dimension."""
    keys = ("mean", "median", "q1", "q3", "min", "max")
    parts: list[Table | str] = []
    order = [0.5, 0.25, 0.75, 0, 1]  # of the quantiles, after the mean
    for dimension, (table, methods, left_out) in ratings.items():
        test, lines = rating_tests(table, methods), []
        for method, column in zip(methods, table.T, strict=True):
            figures = [column.mean(), *np.quantile(column, order)]
            numbers = [f"{value:.2f}".rstrip("0").rstrip(".") for value in figures]
            lines.append([method, str(len(column)), *numbers])
        friedman = "Friedman's test needs three methods; with two, Wilcoxon's stands alone."
        if len(methods) > 2:
            friedman = f"Friedman: chi2({len(methods) - 1}) = {test.chi2:.2f}, p = {test.p:.2g}"
        pairs = [[a, b, f"{p:.2g}", f"{adjusted:.2g}"] for a, b, p, adjusted in test.pairs]
        parts += [
            f"{dimension}: {test.participants} complete participants, {left_out} left out",
            of_lines(["Method", "n", *keys], lines),
            friedman,
            of_lines(["A", "B", "Wilcoxon p", "Bonferroni p"], pairs, left=2),
        ]
    return document(parts)


class Correlation(NamedTuple):
    """Spearman's rank correlation over methods."""

    rho: float
    measured: tuple[float, float]  # 95 % interval if the same methods were measured again
    p: float  # over all permutations, or a sample of them


class Test(NamedTuple):
    """Friedman's test over all methods, and Wilcoxon's signed-rank test of every pair, adjusted by
    Bonferroni."""

    participants: int
    chi2: float
    p: float
    pairs: tuple[tuple[str, str, float, float], ...]  # a, b, p, adjusted p


def spearman(x: Sequence[float], y: Sequence[float], *, counts: tuple[int, int]) -> Correlation:
    """Rank correlation of two success rates of N methods.

    Args:
        x: (N,) percent, N 3 or more.
        y: (N,) percent.
        counts: trials behind each x and each y.
    """
    a, b = np.asarray(x, np.float64), np.asarray(y, np.float64)
    n = len(a)
    random = np.random.default_rng(0)
    orders = np.argsort(random.random((DRAWS, n)), axis=1)
    if n <= 7:
        orders = np.array(list(permutations(range(n))))
    rho = _rho(a[None], b[None])[0]
    shuffled = _rho(np.broadcast_to(a, orders.shape), b[orders])
    p = float((np.abs(shuffled) >= abs(rho) - 1e-12).mean())
    draws = [
        random.binomial(k, np.clip(v / 100, 0, 1), (DRAWS, n)) / k for k, v in zip(counts, (a, b))
    ]
    low, high = np.quantile(np.nan_to_num(_rho(*draws)), [0.025, 0.975])
    return Correlation(float(rho), (float(low), float(high)), p)


def _rho(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(D,) Spearman's rho of the rows of (D, N); 0 if all values of a row are equal."""
    ra, rb = stats.rankdata(a, axis=1), stats.rankdata(b, axis=1)
    ra, rb = ra - ra.mean(1, keepdims=True), rb - rb.mean(1, keepdims=True)
    size = np.sqrt((ra**2).sum(1) * (rb**2).sum(1))
    return np.where(size > 0, (ra * rb).sum(1) / np.where(size > 0, size, 1), 0.0)


def rating_tests(rows: np.ndarray, methods: Sequence[str]) -> Test:
    """Friedman's test (NaN for two methods) and Wilcoxon's of every pair.

    Args:
        rows: (participants, methods) ratings.
        methods: their names.
    """
    if rows.ndim != 2 or rows.shape[0] < 2 or rows.shape[1] < 2:
        words = "tests of ratings need 2 participants and 2 methods or more"
        raise UsageError(f"{words}, given are {rows.shape}")
    if rows.shape[1] == 2:
        chi2, p = float("nan"), float("nan")
    elif (rows == rows[:, :1]).all():
        chi2, p = 0.0, 1.0
    else:
        chi2, p = stats.friedmanchisquare(*rows.T)
    pairs = []
    count = rows.shape[1] * (rows.shape[1] - 1) // 2
    for i, j in combinations(range(rows.shape[1]), 2):
        equal = (rows[:, i] == rows[:, j]).all()
        raw = 1.0 if equal else float(stats.wilcoxon(rows[:, i], rows[:, j]).pvalue)
        pairs.append((methods[i], methods[j], raw, min(raw * count, 1.0)))
    return Test(rows.shape[0], float(chi2), float(p), tuple(pairs))
