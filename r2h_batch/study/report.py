"""Texts of the user study: simulation against the real robot, ratings and their tests."""

import csv
import io
from collections.abc import Mapping, Sequence
from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np

from r2h_batch.report.text import NA, aligned
from r2h_batch.study.stats import (
    SCALE,
    StudyError,
    Summary,
    random_pairings,
    rating_tests,
    spearman,
)
from r2h_batch.study.table_file import LINE, Number, Text, read_table

DIMENSIONS = ("comfort", "safety", "naturalness")
SECONDS, CHANGE = Number(0, 1e5), Number(-1e3, 1e3)
REAL_COLUMNS: dict[str, Number | Text] = {
    "method": Text(),
    "real_sr": Number(0, 100, percent=True),
    "real_t_tot_s": SECONDS,
}
RATING_COLUMNS: dict[str, Number | Text] = {
    **dict.fromkeys(("participant", "method", "dimension"), Text()),
    "rating": Number(1, 5, whole=True),
}
COUNT_COLUMNS: dict[str, Number | Text] = {
    **dict.fromkeys(("method", "dimension"), Text()),
    **{f"n{k}": Number(0, 1e6, whole=True) for k in SCALE},
}
SIM_TRIALS, REAL_TRIALS = 1000, 150
"""Trials of a method behind the paper's rates: 500 of each split; 30 participants with 5 each."""

QUOTED = {
    ("FC-Handover", "comfort"): {"mean": 3.2},
    ("FC-Handover", "safety"): {"mean": 2.9},
    ("FC-Handover", "naturalness"): {"median": 3.5, "mean": 3.4},
    ("Handover-VA", "comfort"): {"mean": 2.8},
    ("Handover-VA", "safety"): {"mean": 2.8},
    ("Handover-VA", "naturalness"): {"median": 2.0, "q1": 1.0, "mean": 2.5},
    ("Contact-Handover", "comfort"): {"median": 2.5, "mean": 2.5},
    ("Contact-Handover", "safety"): {"median": 2.0, "q3": 3.0, "mean": 2.4, "max": 4.0},
    ("Contact-Handover", "naturalness"): {"mean": 2.9},
    ("Intent-Handover", "comfort"): {"mean": 3.8},
    ("Intent-Handover", "safety"): {"mean": 3.7},
    ("Intent-Handover", "naturalness"): {"median": 4.0, "q1": 3.5, "mean": 4.1},
}
"""What the paper's text says about its ratings (Sec. User Study)."""
QUOTED_CHI2 = {"comfort": 28.4, "safety": 24.1, "naturalness": 31.7}

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5a5a5a", "#000000")

Ratings = tuple[np.ndarray, list[str], int]
"""(participants, methods) ratings of complete participants, the methods, participants left out."""
Summaries = Mapping[tuple[str, str], Summary]
"""(method, dimension) -> its summary."""


def paper_table(name: str) -> Path:
    """The file of a table that the paper prints."""
    return Path(__file__).parent / "paper" / f"{name}.csv"


def _differences(
    sim: Mapping[str, tuple[float, float]], real: Mapping[str, tuple[float, float]]
) -> list[list[str]]:
    """Lines of method, simulated and real SR and T_tot, and their differences."""
    lines = []
    for method, (sr, t) in real.items():
        if method not in sim:
            raise StudyError(
                f"method {method!r} has no simulated result; simulated are {', '.join(sim)}"
            )
        s, ts = sim[method]
        rates = [f"{s:.1f}", f"{sr:.1f}", f"{sr - s:+.1f}"]
        lines.append([method, *rates, f"{ts:.2f}", f"{t:.2f}", f"{t - ts:+.2f}"])
    return lines


def _difference_table(lines: Sequence[Sequence[str]]) -> str:
    return aligned(["Method", "sim SR", "real SR", "delta", "sim T", "real T", "delta"], lines, 1)


def _correlations(
    pairs: Mapping[str, tuple[Sequence[float], Sequence[float]]], trials: tuple[int, int]
) -> str:
    """The table of rank correlations. The first pair is of two success rates, from so many trials."""

    def ends(pair: tuple[float, float] | None) -> str:
        return NA if pair is None else f"{pair[0]:+.2f} to {pair[1]:+.2f}"

    lines: list[list[str]] = []
    for name, (x, y) in pairs.items():
        c = spearman(x, y, counts=None if lines else trials)
        lines.append([name, f"{c.rho:+.2f}", ends(c.measured), ends(c.others), f"{c.p:.2f}"])
    return aligned(["Pair", "rho", "measured again", "other methods", "p"], lines, 1)


def real_report(run: Path, file: Path, trials: int) -> str:
    """A robot's measured rates and times against those of a run."""
    from r2h_batch.report.table import table_of
    from r2h_batch.runs.store import load_run

    stored = load_run(run)
    # the last row of a method stays: Avg, or its only split
    rows = {row.method: row for row in table_of(stored).rows}
    measured = read_table(file, REAL_COLUMNS)
    real: dict[str, tuple[float, float]] = {}
    for line in measured:
        name = stored.named(line["method"])
        if name in real:
            raise StudyError(f"{file}: line {line[LINE]}: {name} is there twice; once is enough")
        real[name] = (line["real_sr"], line["real_t_tot_s"])
    sim = {}
    for name, row in rows.items():
        rate, total = row.rates["sr"], row.times["t_tot_s"].value
        sim[name] = (rate.percent if rate else 0.0, float("nan") if total is None else total)
    parts = [_difference_table(_differences(sim, real))]
    if len(real) > 2:
        rates = [sim[m][0] for m in real], [sr for sr, _ in real.values()]
        parts.append(_correlations({"sim SR, real SR": rates}, (rows[next(iter(real))].n, trials)))
    return "\n\n".join(parts) + "\n"


def paper_report() -> str:
    """The paper's study through this code: what its figures give, and where its text differs."""
    with paper_table("table1").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    table = {r["method"]: r for r in rows if r["split"] == "Avg"}
    methods = list(table)
    real_rows = read_table(
        paper_table("table2_sim2real"),
        {**REAL_COLUMNS, "delta_sr_pp": CHANGE, "delta_t_tot_s": CHANGE},
    )
    real = {r["method"]: (r["real_sr"], r["real_t_tot_s"]) for r in real_rows}
    lines = _differences({m: (float(r["sr"]), float(r["t_tot_s"])) for m, r in table.items()}, real)
    wrong = [
        f"- {r['method']}: the paper prints {r['delta_sr_pp']:+.1f} and {r['delta_t_tot_s']:+.2f}"
        for r, line in zip(real_rows, lines)
        if abs(float(line[3]) - r["delta_sr_pp"]) > 0.051
        or abs(float(line[6]) - r["delta_t_tot_s"]) > 0.0051
    ]
    agreement = "All differences are as the paper prints them."
    if wrong:
        agreement = "\n".join(["Where the paper prints another difference:", *wrong])
    counts = read_counts(paper_table("ratings"))
    rated = {key: Summary.of_counts(c) for key, c in counts.items()}
    means = {d: [rated[m, d].mean for m in methods] for d in DIMENSIONS}
    rates = {k: [float(table[m][k]) for m in methods] for k in ("sr", "f_safe", "f_afford")}
    pairs = {
        "sim SR, real SR": (rates["sr"], [real[m][0] for m in methods]),
        **{f"sim SR, {d}": (rates["sr"], means[d]) for d in DIMENSIONS},
        "sim F_safe, safety": (rates["f_safe"], means["safety"]),
        "sim F_afford, naturalness": (rates["f_afford"], means["naturalness"]),
    }
    parts = [
        "Sim to real (paper, Tables I and II): SR in percent, T_tot in seconds.",
        _difference_table(lines),
        agreement,
        "Rank correlations over four methods (Spearman).",
        _correlations(pairs, (SIM_TRIALS, REAL_TRIALS)),
        "- measured again: 95 % if the same four methods were run again (binomial, 1000 simulated and 150 real trials);\n"
        "  n/a for ratings, whose counts per person are not published. other methods: four say next to nothing.\n"
        "- p: exact over all orders; with four methods it is never below 0.08.",
        "Ratings (30 participants, from the published counts).",
        _summary_table(rated),
        "Statements of the text against the counts.",
        _quoted(rated),
        "Friedman's test needs each participant's ratings; only counts are published, so chi2 cannot be recomputed.",
        _pairings(counts, methods),
        "- Wilcoxon's pairwise tests cannot be recomputed either, for the same reason.",
    ]
    return "\n\n".join(parts) + "\n"


def read_counts(path: Path) -> dict[tuple[str, str], np.ndarray]:
    """(method, dimension) -> (5,) how often each of 1..5 was given, from columns method,
    dimension, n1..n5."""
    rows = read_table(path, COUNT_COLUMNS)
    return {(r["method"], r["dimension"]): np.array([r[f"n{k}"] for k in SCALE]) for r in rows}


def read_ratings(path: Path) -> dict[str, Ratings]:
    """Dimension -> its ratings, from columns participant, method, dimension, rating (1 to 5)."""
    rows = read_table(path, RATING_COLUMNS)
    methods = list(dict.fromkeys(r["method"] for r in rows))
    if len(methods) < 2:
        raise StudyError(f"{path}: all ratings are of {methods[0]}; two or more methods are needed")
    found: dict[str, dict[str, dict[str, int]]] = {}
    for r in rows:
        person = found.setdefault(r["dimension"], {}).setdefault(r["participant"], {})
        if r["method"] in person:
            raise StudyError(
                f"{path}: line {r[LINE]}: participant {r['participant']} rates {r['method']} twice for {r['dimension']}"
            )
        person[r["method"]] = r["rating"]
    result = {}
    for dimension, people in found.items():
        complete = [[p[m] for m in methods] for p in people.values() if len(p) == len(methods)]
        if len(complete) < 2:
            raise StudyError(f"{path}: {_slip(rows, dimension, methods, len(complete))}")
        result[dimension] = (np.array(complete), methods, len(people) - len(complete))
    return result


def _slip(
    rows: Sequence[Mapping[str, Any]], dimension: str, methods: Sequence[str], complete: int
) -> str:
    """Why so few people rated every method: the rarest name, most likely a slip, and its line."""
    own = [r for r in rows if r["dimension"] == dimension]
    if len(own) <= len(methods):
        return f"line {own[0][LINE]}: {dimension!r} has {len(own)} ratings only; mend the dimension's name, or leave them out"
    counts = {m: sum(r["method"] == m for r in own) for m in methods}
    rare = min(counts, key=lambda m: counts[m])
    line = next(r[LINE] for r in (own if counts[rare] else rows) if r["method"] == rare)
    return (
        f"{dimension}: {complete} participants rated all of {', '.join(methods)}; two are needed. {rare} has {counts[rare]} "
        f"ratings, the first in line {line}: mend the name, or leave them out"
    )


def _summary_table(rated: Summaries) -> str:
    keys = ("mean", "median", "q1", "q3", "min", "max")
    lines = []
    for (method, dimension), s in rated.items():
        numbers = [f"{getattr(s, k):.2f}".rstrip("0").rstrip(".") for k in keys]
        lines.append([method, dimension, str(s.n), *numbers])
    return aligned(["Method", "Dimension", "n", *keys], lines, 2)


def _quoted(rated: Summaries) -> str:
    n, lines = 0, []
    for (method, dimension), quoted in QUOTED.items():
        for key, value in quoted.items():
            counted = getattr(rated[method, dimension], key)
            n += 1
            if abs(value - counted) > 0.051:
                lines.append(
                    f"- {method}, {dimension}: the text says {key} {value:g}, the counts give {counted:.3g}"
                )
    return "\n".join([f"- {n - len(lines)} of {n} agree (to the digit printed).", *lines])


def _pairings(counts: Mapping[tuple[str, str], np.ndarray], methods: Sequence[str]) -> str:
    lines = []
    for d in DIMENSIONS:
        median, low, high = random_pairings(np.stack([counts[m, d] for m in methods]))
        lines.append([d, f"{median:.1f}", f"{low:.1f} to {high:.1f}", f"{QUOTED_CHI2[d]:.1f}"])
    return aligned(["Dimension", "chi2, ratings dealt at random", "95 %", "paper"], lines, 1)


def rating_report(ratings: Mapping[str, Ratings]) -> str:
    """Summaries and tests of every dimension."""
    parts = []
    for dimension, (table, methods, left_out) in ratings.items():
        test = rating_tests(table, methods)
        friedman = "Friedman's test needs three methods; with two, Wilcoxon's stands alone."
        if len(methods) > 2:
            friedman = f"Friedman: chi2({len(methods) - 1}) = {test.chi2:.2f}, p = {test.p:.2g}"
        pairs = [[a, b, f"{p:.2g}", f"{adjusted:.2g}"] for a, b, p, adjusted in test.pairs]
        parts += [
            f"{dimension}: {test.participants} complete participants, {left_out} left out",
            _summary_table(summaries(dimension, ratings[dimension])),
            friedman,
            aligned(["A", "B", "Wilcoxon p", "Bonferroni p"], pairs, 2),
        ]
    return "\n\n".join(parts) + "\n"


def summaries(dimension: str, ratings: Ratings) -> Summaries:
    """Of each method's ratings in a dimension."""
    table, methods, _ = ratings
    return {(m, dimension): Summary.of(table[:, i]) for i, m in enumerate(methods)}


def box_plot(rated: Summaries) -> str:
    """The paper's Fig. 7 as SVG: a group for each method, a colour for each dimension.

    Boxes go from Q1 to Q3, lines are medians, diamonds are means, whiskers are the extremes.
    """
    from r2h_batch.report.figures import needs_matplotlib, style

    needs_matplotlib()
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    methods = list(dict.fromkeys(m for m, _ in rated))
    color = dict(zip(dict.fromkeys(d for _, d in rated), cycle(COLORS)))
    step = len(color) + 1
    text = io.StringIO()
    with style(page=False):
        figure = Figure(figsize=(1.2 + 0.45 * len(methods) * step, 3.4), layout="constrained")
        axes = figure.add_subplot()
        axes.axhline(3, color="#444444", linestyle=(0, (2, 3)), linewidth=0.8)
        for (g, method), (k, d) in product(enumerate(methods), enumerate(color)):
            if (method, d) not in rated:
                continue
            box, line = rated[method, d], {"color": color[d]}
            ends = {"q1": box.q1, "q3": box.q3, "whislo": box.min, "whishi": box.max}
            mean = {"marker": "D", "markerfacecolor": "white", "markeredgecolor": color[d]}
            drawn = axes.bxp(
                [{"med": box.median, "mean": box.mean, **ends, "fliers": []}],
                positions=[g * step + k],
                widths=0.6,
                showmeans=True,
                patch_artist=True,
                boxprops={"facecolor": color[d] + "33", "edgecolor": color[d]},
                medianprops={**line, "linewidth": 2},
                meanprops={**mean, "markersize": 5},
                whiskerprops=line,
                capprops=line,
            )
            drawn["boxes"][0].set_gid(f"box-{g}-{k}")
        axes.set_xticks([g * step + (step - 2) / 2 for g in range(len(methods))], methods)
        axes.set_ylim(0.8, 5.2)
        axes.set_yticks(range(1, 6))
        patches = [Patch(color=color[d], label=d) for d in color]
        columns = max(len(color), 1)
        figure.legend(handles=patches, loc="outside lower center", ncols=columns, frameon=False)
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()
