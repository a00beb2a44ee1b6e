"""Statistics of a user study: summaries of ratings, rank correlations with intervals, Friedman and
Wilcoxon."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from scipy import stats

SCALE = np.arange(1, 6)
DRAWS = 10_000


class StudyError(ValueError):
    """A file that cannot be used: the message names it, the line and what is allowed."""


@dataclass(frozen=True)
class Summary:
    """A box of a box plot: quartiles by linear interpolation, whiskers at the extremes."""

    n: int
    mean: float
    median: float
    q1: float
    q3: float
    min: float
    max: float

    @staticmethod
    def of(values: np.ndarray) -> "Summary":
        """Of (N,) ratings."""
        low, q1, median, q3, high = np.quantile(values, [0, 0.25, 0.5, 0.75, 1]).tolist()
        return Summary(len(values), float(np.mean(values)), median, q1, q3, low, high)

    @staticmethod
    def of_counts(counts: np.ndarray) -> "Summary":
        """Of (5,) counts of the ratings 1 to 5."""
        return Summary.of(np.repeat(SCALE, counts))


@dataclass(frozen=True)
class Correlation:
    """A rank correlation over methods.

    Attributes:
        rho: Spearman's.
        measured: 95 % interval if the same methods were measured again; None for values that are
            no rates.
        others: 95 % interval for other methods (Bonett and Wright 2000); None below 4 methods.
        p: over all permutations, or a sample of them.
    """

    rho: float
    measured: tuple[float, float] | None
    others: tuple[float, float] | None
    p: float


@dataclass(frozen=True)
class Test:
    """Friedman's test over all methods, and Wilcoxon's signed-rank test of every pair, adjusted by
    Bonferroni."""

    participants: int
    chi2: float
    p: float
    pairs: tuple[tuple[str, str, float, float], ...]  # a, b, p, adjusted p


def spearman(
    x: Sequence[float], y: Sequence[float], *, counts: tuple[int, int] | None = None, seed: int = 0
) -> Correlation:
    """Rank correlation of two values of N methods.

    Args:
        x: (N,) values, N 3 or more.
        y: (N,) values.
        counts: trials behind each x and each y, if they are success rates in percent.
        seed: of the samples.
    """
    a, b = np.asarray(x, np.float64), np.asarray(y, np.float64)
    n = len(a)
    if n < 3 or len(b) != n:
        raise StudyError(
            f"a rank correlation needs 3 or more methods in both tables, there are {min(n, len(b))}"
        )
    rho = _rho(a[None], b[None])[0]
    random = np.random.default_rng(seed)
    orders = _orders(n, random)
    shuffled = _rho(np.broadcast_to(a, orders.shape), b[orders])
    p = float((np.abs(shuffled) >= abs(rho) - 1e-12).mean())
    measured = None
    if counts is not None:
        draws = [
            random.binomial(k, np.clip(v / 100, 0, 1), (DRAWS, n)) / k
            for k, v in zip(counts, (a, b))
        ]
        measured = _ends(np.nan_to_num(_rho(*draws)))
    others = None
    if n > 3:
        half = 1.959964 * np.sqrt((1 + rho**2 / 2) / (n - 3))
        z = np.arctanh(np.clip(rho, -1 + 1e-12, 1 - 1e-12))
        others = float(np.tanh(z - half)), float(np.tanh(z + half))
    return Correlation(float(rho), measured, others, p)


def _rho(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(D,) Spearman's rho of the rows of (D, N); 0 if all values of a row are equal."""
    ra, rb = stats.rankdata(a, axis=1), stats.rankdata(b, axis=1)
    ra, rb = ra - ra.mean(1, keepdims=True), rb - rb.mean(1, keepdims=True)
    size = np.sqrt((ra**2).sum(1) * (rb**2).sum(1))
    return np.where(size > 0, (ra * rb).sum(1) / np.where(size > 0, size, 1), 0.0)


def _orders(n: int, random: np.random.Generator) -> np.ndarray:
    if n <= 7:
        return np.array(list(permutations(range(n))))
    return np.argsort(random.random((DRAWS, n)), axis=1)


def _ends(values: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)


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


def random_pairings(
    counts: np.ndarray, *, draws: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Deal ratings to people at random: what counts alone say about a test within subjects.

    Args:
        counts: (methods, 5) how often each of 1..5 was given.
        draws: number of deals.
        seed: of the deals.

    Returns:
        Median, lower and upper end of the 95 % range of Friedman's chi2.
    """
    columns = [np.repeat(SCALE, c) for c in counts]
    random = np.random.default_rng(seed)
    found = [
        stats.friedmanchisquare(*(random.permutation(c) for c in columns))[0] for _ in range(draws)
    ]
    return float(np.median(found)), *_ends(np.array(found))
