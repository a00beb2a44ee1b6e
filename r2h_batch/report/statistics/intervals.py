"""95 % intervals over clusters (objects, or categories of them): for the mean over all clusters there are, and for the mean
of a few new ones. Pure functions; docs/statistics.md has their coverage."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit, stdtr, stdtrit

CONFIDENCE = 0.95
BORROWED = 0.05
"""Weight, in clusters, of the largest variance that clusters can have: that of clusters whose trials all agree. A few clusters
that happen to be alike say little about the others. In the populations of tests/support/interval_coverage.py a smaller weight
covers less where it covers least, and a larger one covers more than 97 % where it covers most."""


@dataclass(frozen=True)
class Clustered:
    """A mean over clusters.

    Attributes:
        value: sum(x) / sum(n).
        counts: clusters of each stratum.
        own: what each stratum's clusters add to the variance of `value`, as they vary.
        wide: the same with `BORROWED` of the largest variance; as `own` where the trials' variance is not known.
        freedom: clusters minus strata.
    """

    value: float
    counts: tuple[int, ...]
    own: tuple[float, ...]
    wide: tuple[float, ...]
    freedom: int

    @property
    def quantile(self) -> float:
        """How many standard errors half of an interval is, by Student's t."""
        return float(stdtrit(self.freedom, 0.5 + CONFIDENCE / 2))

    def half(self, few: int | None = None, *, own: bool = False) -> float:
        """Half of the t interval of the mean over all clusters, or of the mean of `few` new ones of each stratum: then the
        variance of the new ones' mean comes on top, t s sqrt(1 / C + 1 / few).

        Args:
            few: number of new clusters.
            own: without borrowed variance.
        """
        parts = self.own if own else self.wide
        more = (1.0 if few is None else 1 + c / few for c in self.counts)
        return self.quantile * float(np.sqrt(sum(p * m for p, m in zip(parts, more, strict=True))))

    @property
    def p(self) -> float:
        """Two-sided p value of Student's test that the mean over all clusters is 0."""
        if self.value == 0:
            return 1.0
        deviation = float(np.sqrt(sum(self.wide)))
        return float(2 * stdtr(self.freedom, -abs(self.value) / deviation)) if deviation else 0.0

    def shrunk(self, few: int | None) -> float:
        """How much less the trials of `few` new clusters and of these together say than these alone: 1 / (1 + C / few)."""
        return 1.0 if few is None else 1 / (1 + sum(self.counts) / (few * len(self.counts)))

    def rate_ends(self, few: int | None = None) -> tuple[float, float]:
        """The interval of a rate, whose value lies in [0, 1].

        It is a t interval of the log odds: their error is that of the rate over p (1 - p). So it leaves more room on the side
        of 1/2, and misses on both sides alike. Of few new clusters the mean can lie at 0 or 1, where log odds end: at each end
        that prediction interval is the wider one of this and of the t interval of the rate.
        """
        p = self.value
        if not 0 < p < 1:
            return p, p
        half = self.half(few) / (p * (1 - p))
        low, high = expit(logit(p) - half), expit(logit(p) + half)
        if few is not None:
            plain = self.half(few, own=True)
            low, high = min(low, p - plain), max(high, p + plain)
        return float(low), float(high)

    def ends(self, few: int | None = None) -> tuple[float, float]:
        """The t interval of a difference of rates, which lies in [-1, 1]."""
        half = self.half(few)
        return max(self.value - half, -1.0), min(self.value + half, 1.0)


def over_clusters(
    strata: Sequence[tuple[np.ndarray, np.ndarray]], spread: float = 0.0
) -> Clustered | None:
    """The ratio sum(x) / sum(n) over clusters with its variance.

    The variance is the linearised one: that of the residuals x - ratio n between the clusters of each stratum.

    Args:
        strata: (x, n) of each stratum: (K,) sums and trials of its clusters; empty clusters do not count.
        spread: variance of a single trial's value: p (1 - p) of a rate. Were clusters all or nothing, it would be theirs too,
            the largest that they can have.

    Returns:
        What was found, or None if a stratum has fewer than two clusters.

    Source: Cochran 1977, Sampling Techniques, chapter 6.
    """
    pairs = [(x[n > 0], np.asarray(n[n > 0], np.float64)) for x, n in strata]
    if min((len(n) for _, n in pairs), default=0) < 2:
        return None
    total = float(sum(n.sum() for _, n in pairs))
    value = float(sum(x.sum() for x, _ in pairs) / total)
    freedom = sum(len(n) - 1 for _, n in pairs)
    weight = BORROWED if spread > 0 else 0.0
    own, wide = [], []
    for x, n in pairs:
        residual, k = x - value * n, len(n)
        own.append(float(k / (k - 1) * np.sum((residual - residual.mean()) ** 2)) / total**2)
        largest = spread * float(np.sum(n**2)) / total**2
        wide.append((freedom * own[-1] + weight * largest) / (freedom + weight))
    return Clustered(value, tuple(len(n) for _, n in pairs), tuple(own), tuple(wide), freedom)


def paired_score_interval(
    only_a: float, only_b: float, trials: float, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """The score interval of the difference of two rates on the same trials: it speaks about more trials with the same objects.

    It is to paired differences what Wilson's is to rates, so it has a width where no trial differs.

    Args:
        only_a: trials that only the first method solves.
        only_b: trials that only the second method solves.
        trials: number of all.
        confidence: between 0 and 1.

    Returns:
        Lower and upper end as fractions in [-1, 1].

    Source: Tango 1998, Equivalence test and confidence interval for the difference in proportions for the paired-sample
    design, Statistics in Medicine 17.
    """
    from scipy.optimize import brentq
    from scipy.special import ndtri

    z, found = float(ndtri(0.5 + confidence / 2)), (only_a - only_b) / trials

    def beyond(delta: float) -> float:
        """Above 0 where the score test refuses this difference."""
        # the share of trials that only b solves, by maximum likelihood under this difference
        linear = (2 * trials - only_a + only_b) * delta - only_a - only_b
        root = np.sqrt(max(linear**2 + 8 * trials * only_b * delta * (1 - delta), 0.0))
        share = (root - linear) / (4 * trials)
        variance = trials * (2 * share + delta * (1 - delta))
        return float((only_a - only_b - trials * delta) ** 2 - z**2 * variance)

    ends = []
    for limit in (-1.0, 1.0):
        # where the difference is the largest possible one, so is the end
        inside = found + np.copysign(
            1e-9, limit
        )  # at the difference that was found the variance can be 0
        outside = found != limit and beyond(limit) > 0
        ends.append(float(brentq(beyond, inside, limit, xtol=1e-12)) if outside else limit)
    return ends[0], ends[1]
