"""How often the intervals over categories cover, and how often equal methods are called different: docs/results/coverage.md.

`python bench/coverage.py --rows FOLDER` counts the rows of a run of r2h-v2 (bench/families.py makes one: runs/families/v2),
simulates, and writes bench/results/coverage.json and the page. Without --rows it takes the counts of the JSON again. A truth
is drawn from Beta populations of categories, or from the counted categories, with replacement.
"""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table, page_from

STORED, PAGE = ROOT / "bench" / "results" / "coverage.json", ROOT / "docs" / "results" / "coverage.md"
MEASURES = ("bench/coverage.py", "r2h_batch/report/statistics")
METHODS = ("fc", "handover-va", "contact", "intent")
CATEGORIES = (6, 10, 16)
TRIALS = 50
"""Trials of a category."""
DRAWS, TABLES = 2000, 2000
"""Samples of categories of each population; tables under the null."""
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


def counted(folder: Path) -> dict[str, Any]:
    """Trials, successes and discordant trials of each category: all that this page needs of a run's rows."""
    from r2h_batch.report.statistics.paired import pair_up
    from r2h_batch.runs.store import load_run

    run = load_run(folder)
    run = run.only([run.named(word) for word in METHODS])
    pair_up([run])  # the same trials, each complete
    tables = [run.trials(name, ["trial_id", "split", "object", "outcome"]).sort_by("trial_id") for name in run.methods]
    solved = np.array([np.array(t["outcome"].to_pylist()) == "success" for t in tables])
    names = tables[0]["object"].to_pylist()
    category = np.array([run.categories[name] for name in names])
    split = np.array(tables[0]["split"].to_pylist())
    found = []
    for name in dict.fromkeys(category.tolist()):
        own = solved[:, category == name]
        only = own.astype(int) @ (~own).T.astype(int)
        found.append({
            "category": name, "split": str(split[category == name][0]), "n": own.shape[1],
            "hits": own.sum(1).tolist(), "only": only.tolist(),
        })  # fmt: skip
    return {
        "methods": [n.partition(" (")[0] for n in run.methods],
        "digest": run.header["digests"]["code"],
        "rows": found,
    }


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
    from r2h_batch.report.statistics.aggregate import clustered_rate

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
    from scipy.special import stdtrit

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


def differences(rows: Sequence[Mapping[str, Any]], pair: tuple[int, int], categories: int, draws: int) -> float:
    """Percent of a pair's intervals that hold the mean difference of the counted categories, drawn with replacement."""
    from r2h_batch.report.statistics.paired import Paired, compare

    random = np.random.default_rng(1)
    (i, j), n = pair, np.array([r["n"] for r in rows])
    shares = np.array([(r["only"][i][j], r["only"][j][i], r["n"] - r["only"][i][j] - r["only"][j][i]) for r in rows])
    shares = shares / n[:, None]
    truth, hits = 100 * float((shares[:, 0] - shares[:, 1]).mean()), 0
    for _ in range(draws):
        first, second, _ = random.multinomial(TRIALS, shares[random.integers(len(rows), size=categories)]).T
        zero = np.zeros(categories, np.int64)
        trials = np.stack([np.full(categories, TRIALS), zero])
        solved = np.stack([np.stack([first, second]), np.zeros((2, categories), np.int64)])
        only = np.zeros((2, 2, 2), np.int64)
        only[0, 0, 1], only[0, 1, 0] = first.sum(), second.sum()
        (found,) = compare(Paired(("a", "b"), trials, solved, only), draws=1)[0].pairs
        assert found.low is not None and found.high is not None  # there are two categories or more
        hits += found.low - 1e-9 <= truth <= found.high + 1e-9
    return 100 * hits / draws


def relabelled(rows: Sequence[Mapping[str, Any]], random: np.random.Generator, methods: int) -> Any:
    """A table under the null: in each category the methods' names are permuted."""
    from r2h_batch.report.statistics.paired import Paired
    from r2h_batch.verdicts import SPLITS

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
    from r2h_batch.report.statistics.paired import ALPHA, compare

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


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Everything on the page."""
    own = json.loads(STORED.read_text())["counted"] if options.rows is None else counted(options.rows)
    rows, methods = own["rows"], own["methods"]
    found: dict[str, Any] = {
        "draws": DRAWS,
        "tables": TABLES,
        "trials": TRIALS,
        "counted": own,
        "rates": {},
        "pairs": {},
    }
    for name, (draw, truth) in populations(rows, methods).items():
        found["rates"][name] = {
            str(c): coverage(draw, truth, c, DRAWS)
            | {"plain t": plain_t(draw, truth, c, DRAWS)}
            | {f"of {k} new": coverage(draw, truth, c, DRAWS, few=k) for k in (4, 8)}
            for c in CATEGORIES
        }
        print(name, {c: round(v["covers"], 1) for c, v in found["rates"][name].items()}, flush=True)
    for i, j in combinations(range(len(methods)), 2):
        found["pairs"][f"{methods[i]} - {methods[j]}"] = {
            str(c): differences(rows, (i, j), c, DRAWS // 4) for c in CATEGORIES
        }
    random = np.random.default_rng(0)
    found["null"] = called([relabelled(rows, random, len(methods)) for _ in range(TABLES)])
    return found | made_by(MEASURES)


def markdown(data: Mapping[str, Any]) -> str:
    """docs/results/coverage.md."""

    def cell(own: Mapping[str, Any]) -> str:
        return f"{own['covers']:.1f} ({own['below']:.1f}, {own['above']:.1f})"

    columns = [str(c) for c in CATEGORIES]
    head = ["categories' rates", *(f"C = {c}" for c in columns), *(f"plain t, {c}" for c in columns)]
    lines = [
        [name, *(cell(own[c]) for c in columns), *(f"{own[c]['plain t']:.1f}" for c in columns)]
        for name, own in data["rates"].items()
    ]
    some = [
        [name, *(cell(own[c][f"of {k} new"]) for k in (4, 8) for c in columns)] for name, own in data["rates"].items()
    ]
    pairs = [[name, *(f"{own[c]:.1f}" for c in columns)] for name, own in data["pairs"].items()]
    words = {"any": "in one of the three at least"}
    null = [
        [words.get(group, group), f"{own['not corrected']:.1f}", f"{own['corrected']:.1f}"]
        for group, own in data["null"].items()
    ]
    inside = [own[c]["covers"] for own in data["rates"].values() for c in columns]
    plain = [own[c]["plain t"] for own in data["rates"].values() for c in columns]
    right = [sum(93 <= v <= 97 for v in values) for values in (inside, plain)]
    low = [sum(v < 93 for v in values) for values in (inside, plain)]
    parts = [
        "# Do the intervals cover?",
        "See how often the 95 % intervals over categories hold the truth, and how often equal methods are called different."
        f" `python bench/coverage.py` simulated this ({data['draws']:,} samples of C categories, {data['trials']} trials of each;"
        " `bench/results/coverage.json`). [Statistical terms](../statistics.md).",
        "## The mean of all categories",
        "Percent of the intervals that hold the mean; in brackets those that lie below it and above it. A method's line draws C"
        " categories with replacement from its own of r2h-v2. Plain t: the t interval of the rates, for comparison.",
        markdown_table(head, lines),
        f"Of {len(inside)} cells, {right[0]} lie within 93 to 97 % and {low[0]} below ({right[1]} and {low[1]} of the plain t"
        f" interval). The least is {min(inside):.1f} % ({min(plain):.1f} %). Where one category in five fails and six are"
        " measured, a quarter of the samples has none of these. No interval can know of them.",
        "## The mean of a few new categories",
        "The prediction interval for the rate that 4 or 8 new categories show, as many trials each.",
        markdown_table(["categories' rates", *(f"{k} new, C = {c}" for k in (4, 8) for c in columns)], some),
        "## Differences of two methods",
        f"Categories of r2h-v2 drawn with replacement ({data['draws'] // 4} samples).",
        markdown_table(["pair", *(f"C = {c}" for c in columns)], pairs),
        "## Equal methods",
        f"In each category of r2h-v2 the names of the four methods were permuted ({data['tables']:,} tables), so none is better."
        " Percent of the tables in which some pair is called better for new categories, without Holm's correction of the test for"
        " new categories and with it.",
        markdown_table(["trials", "not corrected", "corrected"], null),
    ]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--rows", type=Path, help="a run of r2h-v2 with the four methods; default: the counts of the JSON"
    )
    page_from(parser, STORED, PAGE, measure, markdown)
