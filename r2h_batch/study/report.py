"""Simulation against people: sim-to-real deltas, ratings and their tests. `python -m
r2h_batch.study --help`

Without arguments: the paper's own study, from the figures that it prints. What they do not allow is
said, not guessed.
"""

import csv
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from r2h_batch.study.stats import (
    SCALE,
    Correlation,
    StudyError,
    Summary,
    random_pairings,
    rating_tests,
    spearman,
)
from r2h_batch.study.table_file import LINE, Number, Text, read_table

DIMENSIONS = ("comfort", "safety", "naturalness")
REAL_COLUMNS: dict[str, Number | Text] = {
    "method": Text(),
    "real_sr": Number(0, 100, percent=True),
    "real_t_tot_s": Number(0, 1e5),
}
RATING_COLUMNS: dict[str, Number | Text] = {
    "participant": Text(),
    "method": Text(),
    "dimension": Text(),
    "rating": Number(1, 5, whole=True),
}
SIM_TRIALS, REAL_TRIALS = 1000, 150
"""Trials of a method behind the paper's rates: 500 in each split; 30 participants with 5 trials
each."""

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


def paper_table(name: str) -> Path:
    """The file of a table that the paper prints."""
    return Path(str(resources.files("r2h_batch.study").joinpath(f"paper/{name}.csv")))


def sim_to_real(
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
        lines.append(
            [
                method,
                f"{s:.1f}",
                f"{sr:.1f}",
                f"{sr - s:+.1f}",
                f"{ts:.2f}",
                f"{t:.2f}",
                f"{t - ts:+.2f}",
            ]
        )
    return lines


def correlation_line(name: str, c: Correlation) -> list[str]:
    """A line of the table of rank correlations: rho, its two intervals, p."""

    def ends(pair: tuple[float, float] | None) -> str:
        return "n/a" if pair is None else f"{pair[0]:+.2f} to {pair[1]:+.2f}"

    return [name, f"{c.rho:+.2f}", ends(c.measured), ends(c.others), f"{c.p:.2f}"]


def paper_report() -> str:
    """The paper's study through this code: what its figures give, and where its text says something
    else."""
    from r2h_batch.report.text import aligned

    with paper_table("table1").open(encoding="utf-8") as file:
        table = {
            r["method"]: r
            for r in csv.DictReader(x for x in file if not x.startswith("#"))
            if r["split"] == "Avg"
        }
    sim = {m: (float(r["sr"]), float(r["t_tot_s"])) for m, r in table.items()}
    change = Number(-1e3, 1e3)
    kinds: dict[str, Number | Text] = {
        **REAL_COLUMNS,
        "delta_sr_pp": change,
        "delta_t_tot_s": change,
    }
    real_rows = read_table(paper_table("table2_sim2real"), kinds)
    real = {r["method"]: (r["real_sr"], r["real_t_tot_s"]) for r in real_rows}
    lines = sim_to_real(sim, real)
    wrong = [
        f"- {r['method']}: the paper prints {r['delta_sr_pp']:+.1f} and {r['delta_t_tot_s']:+.2f}"
        for r, line in zip(real_rows, lines)
        if abs(float(line[3]) - r["delta_sr_pp"]) > 0.051
        or abs(float(line[6]) - r["delta_t_tot_s"]) > 0.0051
    ]
    counts = read_counts(paper_table("ratings"))
    methods = list(sim)
    means = {
        d: [float(counts[m, d] @ SCALE / counts[m, d].sum()) for m in methods] for d in DIMENSIONS
    }
    rates = {k: [float(table[m][k]) for m in methods] for k in ("sr", "f_safe", "f_afford")}
    real_sr = [real[m][0] for m in methods]
    rows = [
        correlation_line(
            "sim SR, real SR", spearman(rates["sr"], real_sr, counts=(SIM_TRIALS, REAL_TRIALS))
        )
    ]
    for d in DIMENSIONS:
        rows.append(correlation_line(f"sim SR, {d}", spearman(rates["sr"], means[d])))
    rows.append(correlation_line("sim F_safe, safety", spearman(rates["f_safe"], means["safety"])))
    rows.append(
        correlation_line(
            "sim F_afford, naturalness", spearman(rates["f_afford"], means["naturalness"])
        )
    )
    summaries = {key: Summary.of_counts(c) for key, c in counts.items()}
    parts = [
        "Sim to real (paper, Tables I and II): SR in percent, T_tot in seconds.",
        aligned(["Method", "sim SR", "real SR", "delta", "sim T", "real T", "delta"], lines, 1),
        "\n".join(["Where the paper prints another difference:", *wrong])
        if wrong
        else "All differences are as the paper prints them.",
        "Rank correlations over four methods (Spearman).",
        aligned(["Pair", "rho", "measured again", "other methods", "p"], rows, 1),
        "- measured again: 95 % if the same four methods were run again (binomial, 1000 simulated and 150 real trials);\n"
        "  n/a for ratings, whose counts per person are not published. other methods: four say next to nothing.\n"
        "- p: exact over all orders; with four methods it is never below 0.08.",
        "Ratings (30 participants, from the published counts).",
        _summary_table(summaries),
        "Statements of the text against the counts.",
        _quoted(summaries),
        "Friedman's test needs each participant's ratings; only counts are published, so chi2 cannot be recomputed.",
        _pairings(counts, methods),
        "- Wilcoxon's pairwise tests cannot be recomputed either, for the same reason.",
    ]
    return "\n\n".join(parts) + "\n"


def read_counts(path: Path) -> dict[tuple[str, str], np.ndarray]:
    """(method, dimension) -> how often each of 1..5 was given, from columns method, dimension,
    n1..n5."""
    kinds: dict[str, Number | Text] = {"method": Text(), "dimension": Text()}
    kinds |= {f"n{k}": Number(0, 1e6, whole=True) for k in SCALE}
    return {
        (r["method"], r["dimension"]): np.array([r[f"n{k}"] for k in SCALE])
        for r in read_table(path, kinds)
    }


def read_ratings(path: Path) -> dict[str, tuple[np.ndarray, list[str], int]]:
    """Dimension -> (participants, methods) ratings of complete participants, method names,
    participants left out.

    Columns participant, method, dimension, rating (1 to 5), one row per rating.
    """
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
        whole = [p for p in people.values() if len(p) == len(methods)]
        if len(whole) < 2:
            raise StudyError(f"{path}: {_stray(rows, dimension, methods, len(whole))}")
        table = np.array([[p[m] for m in methods] for p in whole]).reshape(-1, len(methods))
        result[dimension] = (table, methods, len(people) - len(whole))
    return result


def _stray(
    rows: Sequence[Mapping[str, Any]], dimension: str, methods: Sequence[str], whole: int
) -> str:
    """Why so few people rated every method: the line of the name that is rarest, most likely a
    slip."""
    mine = [r for r in rows if r["dimension"] == dimension]
    counts = {m: sum(r["method"] == m for r in mine) for m in methods}
    rare = min(counts, key=lambda m: counts[m])
    line = next(
        r[LINE]
        for r in rows
        if r["method"] == rare and (r["dimension"] == dimension or not counts[rare])
    )
    if len(mine) <= len(methods):
        line, rare = mine[0][LINE], dimension
        return f"line {line}: {rare!r} has {len(mine)} ratings only; mend the dimension's name, or leave them out"
    return (
        f"{dimension}: {whole} participants rated all of {', '.join(methods)}; two are needed. {rare} has {counts[rare]} "
        f"ratings, the first in line {line}: mend the name, or leave them out"
    )


def _summary_table(summaries: Mapping[tuple[str, str], Summary]) -> str:
    from r2h_batch.report.text import aligned

    def number(value: float) -> str:
        return f"{value:.2f}".rstrip("0").rstrip(".")

    keys = ("mean", "median", "q1", "q3", "min", "max")
    lines = [
        [m, d, str(s.n), *(number(getattr(s, k)) for k in keys)] for (m, d), s in summaries.items()
    ]
    return aligned(["Method", "Dimension", "n", *keys], lines, 2)


def _quoted(summaries: Mapping[tuple[str, str], Summary]) -> str:
    said = [
        (m, d, k, v, getattr(summaries[m, d], k))
        for (m, d), q in QUOTED.items()
        for k, v in q.items()
    ]
    wrong = [x for x in said if abs(x[3] - x[4]) > 0.051]
    lines = [f"- {len(said) - len(wrong)} of {len(said)} agree (to the digit printed)."]
    lines += [
        f"- {m}, {d}: the text says {k} {v:g}, the counts give {got:.3g}"
        for m, d, k, v, got in wrong
    ]
    return "\n".join(lines)


def _pairings(counts: Mapping[tuple[str, str], np.ndarray], methods: Sequence[str]) -> str:
    from r2h_batch.report.text import aligned

    lines = []
    for d in DIMENSIONS:
        median, low, high = random_pairings(np.stack([counts[m, d] for m in methods]))
        lines.append([d, f"{median:.1f}", f"{low:.1f} to {high:.1f}", f"{QUOTED_CHI2[d]:.1f}"])
    return aligned(["Dimension", "chi2, ratings dealt at random", "95 %", "paper"], lines, 1)


def rating_report(path: Path) -> str:
    """Summaries and tests of a ratings file with a row for every participant, method and
    dimension."""
    from r2h_batch.report.text import aligned

    parts = []
    for dimension, (table, methods, left_out) in read_ratings(path).items():
        test = rating_tests(table, methods)
        parts += [
            f"{dimension}: {test.participants} complete participants, {left_out} left out",
            _summary_table(
                {(m, dimension): Summary.of(table[:, i]) for i, m in enumerate(methods)}
            ),
            f"Friedman: chi2({len(methods) - 1}) = {test.chi2:.2f}, p = {test.p:.2g}"
            if len(methods) > 2
            else "Friedman's test needs three methods; with two, Wilcoxon's stands alone.",
            aligned(
                ["A", "B", "Wilcoxon p", "Bonferroni p"],
                [[a, b, f"{p:.2g}", f"{adjusted:.2g}"] for a, b, p, adjusted in test.pairs],
                2,
            ),
        ]
    return "\n\n".join(parts) + "\n"


def box_plot(summaries: Mapping[tuple[str, str], Summary]) -> str:
    """The paper's Fig. 7 as SVG: boxes from Q1 to Q3, medians, means as diamonds, whiskers at the
    extremes."""
    from r2h_batch.report.figures import box_plots, needs_matplotlib

    needs_matplotlib()
    methods = list(dict.fromkeys(m for m, _ in summaries))
    dimensions = list(dict.fromkeys(d for _, d in summaries))
    return box_plots(
        {m: {d: summaries[m, d] for d in dimensions if (m, d) in summaries} for m in methods}
    )
