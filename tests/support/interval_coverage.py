"""How often intervals over categories hold the truth, and how often equal methods are called different: simulated.

A truth is drawn from Beta populations of categories, or from counted categories of r2h-v2 (category_counts.json), with
replacement.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from r2h_batch.report.statistics.aggregate import clustered_rate
from r2h_batch.report.statistics.paired import ALPHA, Paired, compare
from r2h_batch.verdicts import SPLITS

COUNTED: dict[str, Any] = json.loads((Path(__file__).parent / "category_counts.json").read_text())
"""Trials, successes and discordant trials of the four methods in each category of r2h-v2."""
CATEGORIES = (6, 10, 16)
TRIALS = 50
"""Trials of a category."""
BETAS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "Beta(6, 4)": ((1.0, 6, 4),),
    "Beta(8, 2)": ((1.0, 8, 2),),
    "Beta(18, 2)": ((1.0, 18, 2),),
    "Beta(2, 2)": ((1.0, 2, 2),),
    "Beta(0.5, 0.5), two humps": ((1.0, 0.5, 0.5),),
    "Beta(0.8, 0.2), two humps": ((1.0, 0.8, 0.2),),
    "0.7 Beta(18, 2) + 0.3 Beta(4, 6)": ((0.7, 18, 2), (0.3, 4, 6)),
    "0.5 Beta(18, 2) + 0.5 Beta(2, 18)": ((0.5, 18, 2), (0.5, 2, 18)),
    "0.8 Beta(18, 2) + 0.2 Beta(2, 8)": ((0.8, 18, 2), (0.2, 2, 8)),
}
"""Populations of a category's rate: weight, a and b of each part."""

Draw = Callable[[np.random.Generator, int], np.ndarray]
"""Rates (C,) of so many new categories."""


def beta(parts: Sequence[tuple[float, float, float]]) -> tuple[Draw, float]:
    """A population, and its mean."""
    weights, a, b = map(np.array, zip(*parts, strict=True))

    def draw(random: np.random.Generator, count: int) -> np.ndarray:
        part = random.choice(len(weights), size=count, p=weights)
        return random.beta(a[part], b[part])

    return draw, float(weights @ (a / (a + b)))


def resampled(rates: np.ndarray) -> tuple[Draw, float]:
    """Counted categories as a population, and its mean."""
    return lambda random, count: random.choice(rates, size=count), float(rates.mean())


def coverage(
    draw: Draw, truth: float, categories: int, draws: int, few: int | None = None, seed: int = 0
) -> dict[str, float]:
    """Percent of intervals that hold the truth, that lie below and above it, and their mean width in points.

    Args:
        draw: the population.
        truth: its mean.
        categories: how many are measured.
        draws: samples.
        few: the truth is instead the rate that so many new categories show, with as many trials each.
        seed: of the samples.
    """
    random = np.random.default_rng(seed)
    total = np.full(categories, TRIALS)
    below = above = 0
    width = 0.0
    for _ in range(draws):
        rate = clustered_rate(random.binomial(TRIALS, draw(random, categories)), total, few)
        assert rate  # there are two categories or more
        own = 100 * (truth if few is None else random.binomial(TRIALS, draw(random, few)).mean() / TRIALS)
        below += rate.high < own - 1e-9
        above += rate.low > own + 1e-9
        width += rate.high - rate.low
    shares = {"below": 100 * below / draws, "above": 100 * above / draws, "width": width / draws}
    return {"covers": 100 - shares["below"] - shares["above"], **shares}


def plain_t(draw: Draw, truth: float, categories: int, draws: int, seed: int = 0) -> float:
    """Percent that the t interval of the categories' rates covers, on the same samples."""
    random = np.random.default_rng(seed)
    rates = np.stack([random.binomial(TRIALS, draw(random, categories)) for _ in range(draws)]) / TRIALS
    half = stdtrit(categories - 1, 0.975) * rates.std(1, ddof=1) / categories**0.5
    return 100 * float((np.abs(rates.mean(1) - truth) <= half).mean())


def populations(rows: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> dict[str, tuple[Draw, float]]:
    """Name -> a population of categories: Betas, then the rows of each method in all categories and in each split's."""
    found = {name: beta(parts) for name, parts in BETAS.items()}
    for split in ("", "S0", "S1"):
        own = [r for r in rows if split in ("", r["split"])]
        for k, method in enumerate(methods):
            rates = np.array([r["hits"][k] / r["n"] for r in own])
            found[f"{method}, {split or 'all'} ({len(own)})"] = resampled(rates)
    return found


def relabelled(rows: Sequence[Mapping[str, Any]], random: np.random.Generator, methods: int) -> Paired:
    """A table under the null: in each category the methods' names are permuted."""
    trials = np.zeros((len(SPLITS), len(rows)), np.int64)
    hits = np.zeros((len(SPLITS), methods, len(rows)), np.int64)
    only = np.zeros((len(SPLITS), methods, methods), np.int64)
    for k, row in enumerate(rows):
        split, place = SPLITS.index(row["split"]), random.permutation(methods)
        trials[split, k] = row["n"]
        hits[split, :, k] = np.array(row["hits"])[place]
        only[split] += np.array(row["only"])[np.ix_(place, place)]
    return Paired(tuple(map(str, range(methods))), trials, hits, only)


def called(tables: Sequence[Any]) -> dict[str, dict[str, float]]:
    """Group, or `any` of them -> percent of tables in which some pair is called better for new categories: as `compare` does,
    and by the same tests without Holm's correction over the pairs."""
    found: dict[str, list[tuple[bool, bool]]] = {}
    for paired in tables:
        own = {}
        for c in compare(paired, draws=1):
            with_holm = any(p.verdict in ("better", "worse") for p in c.pairs)
            without = any(p.p_holm < ALPHA and p.p_new is not None and p.p_new < ALPHA for p in c.pairs)
            own[c.group] = with_holm, without
        own["any"] = any(v[0] for v in own.values()), any(v[1] for v in own.values())
        for group, value in own.items():
            found.setdefault(group, []).append(value)
    return {
        group: dict(zip(("corrected", "not corrected"), (100 * np.mean(values, 0)).tolist(), strict=True))
        for group, values in found.items()
    }
