"""Which method is better, decided on the same trials: McNemar, Holm, intervals and ranks over objects drawn again."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from r2h_batch.results.reading import Run
from r2h_batch.statistics.aggregate import Verdicts, verdicts
from r2h_batch.verdicts import SPLITS, Outcome

ALPHA = 0.05
DRAWS = 10_000

SAME = ("protocol", "trials", "digests", "configuration")
"""Fields of run.json that must agree: else two methods were not asked, or not judged, the same."""


@dataclass(frozen=True)
class Paired:
    """Several methods on the same trials: success (M, N), split and object codes (N,)."""

    names: tuple[str, ...]
    success: np.ndarray
    split: np.ndarray
    object: np.ndarray


@dataclass(frozen=True)
class Pair:
    """Two methods: SR difference in points with its clustered interval (None: one object), exact McNemar, Holm.

    `verdict`: "better" or "worse" (of `a`) where Holm's p is below 0.05 and the interval, which speaks about new objects,
    leaves out 0; "better here", "worse here" where only the first holds (these objects); "tied" where it does not.
    """

    a: str
    b: str
    difference: float
    low: float | None
    high: float | None
    only_a: int
    only_b: int
    p: float
    p_holm: float
    verdict: str


@dataclass(frozen=True)
class Comparison:
    """All pairs of a group of trials, and (M, M) probability that method i has rank j + 1 among new objects."""

    group: str
    n: int
    names: tuple[str, ...]
    rates: tuple[float, ...]
    pairs: tuple[Pair, ...]
    rank: np.ndarray | None


def mcnemar(only_a: int, only_b: int) -> float:
    """Two-sided exact p value of McNemar's test: are the trials that only one of two methods solves split evenly?"""
    from scipy import stats  # half a second: only where a test is asked for

    # Trials on which both agree say nothing about which is better: given n that differ, a fair coin splits them
    # (McNemar 1947), and its exact tail needs no large n
    n = only_a + only_b
    return 1.0 if n == 0 else float(stats.binomtest(only_a, n, 0.5).pvalue)


def holm(p: Sequence[float]) -> np.ndarray:
    """p values adjusted for looking at all of them (Holm 1979)."""
    values = np.asarray(p, np.float64)
    order = np.argsort(values)
    # The i-th smallest of m is compared with alpha / (m - i); as adjusted values, made monotone from the smallest on
    factors = len(values) - np.arange(len(values))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(values[order] * factors), 1.0)
    return adjusted


def pair_up(runs: Sequence[Run]) -> Paired:
    """All methods of the runs, paired on the trial id; an error where runs were not asked the same."""
    first = runs[0]
    for run in runs[1:]:
        for key in SAME:
            mine, other = first.header.get(key), run.header.get(key)
            if mine != other:
                what = key
                if isinstance(mine, dict) and isinstance(other, dict):
                    what += f" ({', '.join(k for k in mine if mine[k] != other.get(k))})"
                raise ValueError(
                    f"{first.folder} and {run.folder} differ in {what}: their trials cannot be paired;"
                    " sweep both methods with the same version and options"
                )
    found: list[tuple[str, Verdicts]] = []
    ids = None
    for run in runs:
        if run.unfinished:
            raise ValueError(f"{run.folder}: {run.unfinished[0]!r} is not complete; run its sweep again to go on")
        for method in run.methods:
            taken = method in (name for name, _ in found)
            found.append((f"{run.folder.name}/{method}" if taken else method, verdicts(run, method)))
            its = run.trials(method, ["trial_id"])["trial_id"].to_numpy()
            if ids is not None and not np.array_equal(ids, its):
                raise ValueError(f"{run.folder}: {method!r} has other trial ids than {found[0][0]!r}")
            ids = its
    names = tuple(name for name, _ in found)
    if len(names) < 2:
        raise ValueError(f"one method ({', '.join(names) or 'none'}) is nothing to compare; give a second run")
    if len(set(names)) != len(names):
        raise ValueError(f"two runs of one name hold {next(n for n in names if names.count(n) > 1)!r}; rename a folder")
    success = np.stack([v.outcome == Outcome.SUCCESS for _, v in found])
    places = {name: i for i, name in enumerate(found[0][1].objects)}
    for name, v in found[1:]:
        codes = np.array([places.get(o, -1) for o in v.objects])
        if not np.array_equal(codes[v.object], found[0][1].object):
            raise ValueError(f"{name} and {found[0][0]} have other objects in the same trials")
    return Paired(names, success, found[0][1].split, found[0][1].object)


def compare(paired: Paired, *, draws: int = DRAWS, seed: int = 0) -> tuple[Comparison, ...]:
    """One comparison for each split, and one for all trials where there are two splits."""
    groups = [(SPLITS[k], paired.split == k) for k in range(len(SPLITS)) if (paired.split == k).any()]
    if len(groups) > 1:
        groups.append(("all", np.ones(len(paired.split), bool)))
    return tuple(_compare(name, paired, rows, draws, seed) for name, rows in groups)


def _compare(group: str, paired: Paired, rows: np.ndarray, draws: int, seed: int) -> Comparison:
    success, names = paired.success[:, rows], paired.names
    sampled = _resampled_rates(success, paired.split[rows], paired.object[rows], draws, seed)
    pairs = list(combinations(range(len(names)), 2))
    only = [[int((success[i] & ~success[j]).sum()), int((success[j] & ~success[i]).sum())] for i, j in pairs]
    p = [mcnemar(*counts) for counts in only]
    lines = []
    for (i, j), (only_i, only_j), raw, adjusted in zip(pairs, only, p, holm(p)):
        difference = 100 * (only_i - only_j) / success.shape[1]
        ends = None if sampled is None else np.quantile(100 * (sampled[:, i] - sampled[:, j]), [0.025, 0.975])
        low, high = (None, None) if ends is None else (float(ends[0]), float(ends[1]))
        word = "better" if difference > 0 else "worse"
        if adjusted >= ALPHA:
            word = "tied"
        elif low is None or high is None or low <= 0 <= high:
            word += " here"
        pair = Pair(names[i], names[j], difference, low, high, only_i, only_j, raw, float(adjusted), word)
        lines.append(pair)
    rates = tuple(float(100 * s.mean()) for s in success)
    rank = None if sampled is None else rank_probabilities(sampled)
    return Comparison(group, success.shape[1], names, rates, tuple(lines), rank)


def _resampled_rates(
    success: np.ndarray, split: np.ndarray, objects: np.ndarray, draws: int, seed: int
) -> np.ndarray | None:
    """(draws, M) success rates when the objects of each split are drawn again with replacement; None for one object."""
    n_objects = int(objects.max()) + 1
    hits, totals = np.zeros((draws, len(success))), np.zeros(draws)
    random = np.random.default_rng(seed)
    for k in np.unique(split):
        inside = split == k
        n = np.bincount(objects[inside], minlength=n_objects)
        kept = n > 0
        if kept.sum() < 2:
            return None
        x = np.stack([np.bincount(objects[inside], weights=s[inside], minlength=n_objects)[kept] for s in success])
        # The bootstrap's clusters are objects, not trials: trials on one object succeed together, and a reader asks about new
        # objects. Drawing n objects with replacement is one multinomial; rates then are sums of hits over sums of trials.
        weight = random.multinomial(kept.sum(), np.full(kept.sum(), 1 / kept.sum()), size=draws)
        hits += weight @ x.T
        totals += weight @ n[kept]
    return hits / totals[:, None]


def rank_probabilities(rates: np.ndarray) -> np.ndarray:
    """(M, M) probability that method i has rank j + 1 over draws (D, M) of rates; ties share their ranks evenly."""
    m = rates.shape[1]
    probability = np.zeros((m, m))
    # (D, M): how many methods are better in a draw, and how many are as good, itself included
    above = (rates[:, None, :] > rates[:, :, None]).sum(2)
    equal = (rates[:, None, :] == rates[:, :, None]).sum(2)
    for i in range(m):
        for size in np.unique(equal[:, i]):
            start = np.bincount(above[equal[:, i] == size, i], minlength=m)
            for first, count in enumerate(start):
                probability[i, first : first + size] += count / size
    return probability / len(rates)
