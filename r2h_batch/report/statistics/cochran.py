"""Cochran's test that several treatments of the same trials succeed equally often, by strata of trials."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from r2h_batch.base.validate import array, check_arguments


@dataclass(frozen=True)
class Cochran:
    """Cochran's Q added up over strata.

    Attributes:
        q: the statistic.
        freedom: its degrees of freedom: treatments less one, of each stratum with a trial that differs.
        p: of the chi-squared distribution.
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
    treatments = len(success)
    solved = success.sum(0)
    q, freedom = 0.0, 0
    for place in np.unique(stratum):
        own = stratum == place
        # trials with one outcome under all treatments say nothing; the variance is that of the others' permutations
        differing = float((solved[own] * (treatments - solved[own])).sum())
        if differing:
            sums = success[:, own].sum(1).astype(np.float64)
            spread = float(((sums - sums.mean()) ** 2).sum())
            q += treatments * (treatments - 1) * spread / differing
            freedom += treatments - 1
    return Cochran(q, freedom, float(chdtrc(freedom, q)) if freedom else 1.0)
