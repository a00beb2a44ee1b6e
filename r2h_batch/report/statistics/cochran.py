"""Cochran's test that several treatments of the same trials succeed equally often, by strata of trials."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from r2h_batch.base.validate import array, check_arguments

FEW_TRIALS = 30
"""Up to so many trials that differ, the p value is that of permutations: chi-squared is too small by half for three of them."""
PERMUTATIONS = 9_999


@dataclass(frozen=True)
class Cochran:
    """Cochran's Q added up over strata.

    Attributes:
        q: the statistic.
        freedom: its degrees of freedom: treatments less one, of each stratum with a trial that differs.
        p: of the chi-squared distribution; where few trials differ, the share of permutations of the treatments within each
            trial that give as large a statistic (the seed is fixed).
    """

    q: float
    freedom: int
    p: float


@check_arguments(
    success=array("b", 2, "successes (T, N): treatments by trials"),
    stratum=array("iu", 1, "a stratum (N,) of each trial"),
)
def stratified_cochran(success: np.ndarray, stratum: np.ndarray) -> Cochran:
    """The test that in no stratum the success rate depends on the treatment.

    Differences of opposite sign in two strata add up here, where the rate of all trials may stay the same.

    Args:
        success: (T, N) bool, each trial under each of T treatments.
        stratum: (N,) int, such as the trial's object.

    Source: Cochran 1950, The comparison of percentages in matched samples; sums of independent chi-squared variables.
    """
    treatments, solved = len(success), success.sum(0)
    # trials with one outcome under all treatments say nothing; the variance is that of the others' permutations
    differs = (solved > 0) & (solved < treatments)
    if not differs.any():
        return Cochran(0.0, 0, 1.0)
    rows, place = success[:, differs].T, np.unique(stratum[differs], return_inverse=True)[1]
    q = float(_statistic(rows[None], place)[0])
    freedom = (treatments - 1) * (int(place.max()) + 1)
    if len(rows) > FEW_TRIALS:
        return Cochran(q, freedom, float(chdtrc(freedom, q)))
    random = np.random.default_rng(0)
    drawn = random.permuted(np.broadcast_to(rows, (PERMUTATIONS, *rows.shape)), axis=2)
    as_large = int((_statistic(drawn, place) >= q - 1e-9).sum())
    return Cochran(q, freedom, (1 + as_large) / (1 + PERMUTATIONS))


def _statistic(rows: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(D,) sums over strata of Cochran's Q, for D draws (D, N, T) of trials that differ; `place` (N,) numbers the strata."""
    treatments = rows.shape[2]
    solved = rows[0].sum(1)
    q = np.zeros(len(rows))
    for k in range(int(place.max()) + 1):
        own = place == k
        sums = rows[:, own].sum(1).astype(np.float64)
        spread = ((sums - sums.mean(1, keepdims=True)) ** 2).sum(1)
        q += (
            treatments
            * (treatments - 1)
            * spread
            / (solved[own] * (treatments - solved[own])).sum()
        )
    return q
