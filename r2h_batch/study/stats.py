"""Statistics of a user study: rank correlations with intervals, Friedman and Wilcoxon."""

from collections.abc import Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from scipy import stats

SCALE = np.arange(1, 6)
DRAWS = 10_000


class StudyError(ValueError):
    """A file that cannot be used: the message names it, the line and what is allowed."""


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


def spearman(
    x: Sequence[float], y: Sequence[float], *, counts: tuple[int, int], seed: int = 0
) -> Correlation:
    """Rank correlation of two success rates of N methods.

    Args:
        x: (N,) percent, N 3 or more.
        y: (N,) percent.
        counts: trials behind each x and each y.
        seed: of the samples.
    """
    a, b = np.asarray(x, np.float64), np.asarray(y, np.float64)
    n = len(a)
    random = np.random.default_rng(seed)
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
        raise StudyError(
            f"tests of ratings need 2 participants and 2 methods or more, given are {rows.shape}"
        )
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
