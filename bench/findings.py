"""The paper's eight findings against this benchmark's tables: docs/results/table1.md.

A finding is a list of conditions on Table I. It appears if all of them hold, in part if some do.
"""

import csv
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product

from _report import ROOT, markdown_table

TABLES = {
    "table1-v1": "r2h-v1",
    "table1-v1-paper-preset": "r2h-v1, preset paper",
    "table1-v1-release-preset": "r2h-v1, preset release",
    "table1-release": "r2h-release, preset release",
    "table1-v0": "r2h-v0",
}
"""File -> what it is called here; r2h-v1 first, for its receivers have bodies."""

PAPER_PRESET = "r2h-v1, preset paper"
SHORT = {"FC-Handover": "FC", "Handover-VA": "VA", "Contact-Handover": "Contact", "Intent-Handover": "Intent"}
RESULTS = ROOT / "docs" / "results"
PAPER = ROOT / "r2h_batch" / "sweep" / "study" / "paper" / "table1.csv"
Cells = Callable[[str, str, str], float]
"""(split, short name, column) -> number of a table"""


@dataclass(frozen=True)
class Finding:
    """Claims of the paper; conditions, each with its words."""

    text: str
    holds: tuple[tuple[str, Callable[[Cells], bool]], ...]


def extreme(split: str, column: str, who: str, sign: int) -> Callable[[Cells], bool]:
    """Whether `who` alone has the highest (sign 1) or lowest (-1) value of the four."""
    return lambda cell: all(
        sign * (cell(split, who, column) - cell(split, other, column)) > 0 for other in SHORT.values() if other != who
    )


def rises(who: str, column: str) -> Callable[[Cells], bool]:
    """Whether a rate is higher in S1 than in S0."""
    return lambda cell: cell("S1", who, column) > cell("S0", who, column)


def drop(cell: Cells, who: str) -> float:
    """By how much SR falls from S0 to S1."""
    return cell("S0", who, "sr") - cell("S1", who, "sr")


def _of_contact() -> list[Finding]:
    """Where the paper speaks of Contact-Handover first."""
    four = tuple(SHORT.values())
    return [
        Finding(
            "Contact-Handover has the highest SR in S0 and the lowest F_safe",
            (
                ("highest SR in S0", extreme("S0", "sr", "Contact", 1)),
                ("lowest F_safe", extreme("Avg", "f_safe", "Contact", -1)),
            ),
        ),
        Finding(
            "In S1 all kinematic failures of Contact-Handover get worse",
            tuple((f"{c} rises", rises("Contact", c)) for c in ("f_plan", "f_reach", "f_safe", "f_stab")),
        ),
        Finding(
            "Functional awareness lowers F_afford in S1: Intent-Handover first, Contact-Handover second",
            (
                ("Intent lowest", extreme("S1", "f_afford", "Intent", -1)),
                ("Contact second", lambda cell: sorted(four, key=lambda m: cell("S1", m, "f_afford"))[1] == "Contact"),
            ),
        ),
    ]


def _of_intent() -> list[Finding]:
    """Where it speaks of Intent-Handover."""
    return [
        Finding(
            "Intent-Handover has the highest SR on average and in S1, and the lowest F_plan",
            (
                ("highest mean SR", extreme("Avg", "sr", "Intent", 1)),
                ("highest SR in S1", extreme("S1", "sr", "Intent", 1)),
                ("lowest F_plan", extreme("Avg", "f_plan", "Intent", -1)),
            ),
        ),
        Finding(
            "Intent-Handover takes longest to plan, and fails Safe in S0",
            (
                ("longest own time", extreme("Avg", "t_method_s", "Intent", 1)),
                (
                    "more F_safe in S0 than Contact",
                    lambda cell: cell("S0", "Intent", "f_safe") > cell("S0", "Contact", "f_safe"),
                ),
            ),
        ),
    ]


def _of_fc_and_va() -> list[Finding]:
    """Where it speaks of FC-Handover and Handover-VA."""
    four = tuple(SHORT.values())
    return [
        Finding("FC-Handover has the lowest F_reach", (("lowest F_reach", extreme("Avg", "f_reach", "FC", -1)),)),
        Finding(
            "FC-Handover has the highest F_afford in S1, and its F_plan rises there",
            (("highest F_afford", extreme("S1", "f_afford", "FC", 1)), ("F_plan rises", rises("FC", "f_plan"))),
        ),
        Finding(
            "Handover-VA: lowest SR, shortest planning, lowest F_stab, highest F_plan and F_safe, largest drop from S0 to S1",
            (
                ("lowest SR", extreme("Avg", "sr", "VA", -1)),
                ("shortest own time", extreme("Avg", "t_method_s", "VA", -1)),
                ("lowest F_stab", extreme("Avg", "f_stab", "VA", -1)),
                ("highest F_plan", extreme("Avg", "f_plan", "VA", 1)),
                ("highest F_safe", extreme("Avg", "f_safe", "VA", 1)),
                ("drops most", lambda cell: all(drop(cell, "VA") > drop(cell, m) for m in four if m != "VA")),
            ),
        ),
    ]


def findings() -> list[Finding]:
    """The eight, in the order of the paper's Results."""
    return [*_of_contact(), *_of_intent(), *_of_fc_and_va()]


def cells_of(data: Mapping) -> Cells:
    """The cells of a table's JSON; what is not evaluated counts 0."""
    rows = {(r["split"], SHORT.get(r["method"].partition(" (")[0], r["method"])): r for r in data["rows"]}
    return lambda split, who, column: float(rows[split, who][column] or 0.0)


def paper_cells() -> Cells:
    """The paper's own Table I (its planning time stands for a method's own)."""
    lines = [line for line in PAPER.read_text().splitlines() if not line.startswith("#")]
    rows = {(r["split"], SHORT[r["method"]]): r for r in csv.DictReader(lines)}
    names = {"t_method_s": "t_plan_s"}

    def cell(split: str, who: str, column: str) -> float:
        value = rows[split, who][names.get(column, column)]
        return float(value) if value not in ("", "n/a", "N/A") else 0.0

    return cell


def verdict(finding: Finding, cell: Cells) -> tuple[str, str]:
    """`appears`, `in part` or `no`, and the conditions that do not hold."""
    missing = [words for words, holds in finding.holds if not holds(cell)]
    word = "appears" if not missing else "no" if len(missing) == len(finding.holds) else "in part"
    return word, ", ".join(missing)


def appearing(tables: Mapping[str, Cells]) -> str:
    """A Markdown table: each finding, and in each table `yes`, or the conditions that fail."""
    rows = []
    for number, finding in enumerate(findings(), 1):
        verdicts = [verdict(finding, cell) for cell in tables.values()]
        words = [{"appears": "yes", "no": "no"}.get(word, f"not: {missing}") for word, missing in verdicts]
        rows.append([number, finding.text, *words])
    return markdown_table(["", "finding", *tables], rows, left=True)


def success_table(tables: Mapping[str, Cells]) -> str:
    """A Markdown table: SR of each method and split, the paper's and ours, and the mean distance from the paper's."""
    paper, places = paper_cells(), [*product(SHORT.values(), ("S0", "S1"))]
    every = [paper, *tables.values()]
    rows = [[who, split, *(f"{cell(split, who, 'sr'):.1f}" for cell in every)] for who, split in places]
    for split in ("S0", "S1"):
        rows.append(["oracle", split, "", *(f"{cell(split, 'oracle', 'sr'):.1f}" for cell in tables.values())])
    away = (sum(abs(c(s, m, "sr") - paper(s, m, "sr")) for m, s in places) / len(places) for c in every)
    rows.append(["distance", "", *(f"{x:.1f}" for x in away)])
    return markdown_table(["SR", "split", "paper", *tables], rows)


def shown(_: object) -> dict[str, object]:
    """Tables and words of the page, from the tables' JSON."""
    data = {title: json.loads((RESULTS / f"{file}.json").read_text()) for file, title in TABLES.items()}
    here = {name: cells_of(d) for name, d in data.items()}
    first = next(iter(data.values()))
    rates = {n: [c(s, m, "f_safe") for m in SHORT.values() for s in ("S0", "S1")] for n, c in here.items()}
    return {
        "trials": first["origin"]["trials"],
        "commit": first["provenance"]["commit"],
        "success": success_table(here),
        "least_safe": min(rates[PAPER_PRESET]),
        "most_safe": max(rates[PAPER_PRESET]),
        "other": max(max(own) for name, own in rates.items() if name != PAPER_PRESET),
        "appearing": appearing(here),
    }
