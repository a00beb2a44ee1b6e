"""The paper's eight findings against this benchmark's tables: docs/results/findings.md.

`make tables` writes both (bench/tables.py). A finding is a list of conditions on Table I. It appears if all of them hold, in
part if some do. A person wrote the causes below (CAUSES has the date); all figures come from the tables.
"""

import csv
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
ROWS = ("v1-paper-preset", "v1-release-preset", "release-release-preset", "v0")
SHORT = {"FC-Handover": "FC", "Handover-VA": "VA", "Contact-Handover": "Contact", "Intent-Handover": "Intent"}
PAPER = ROOT / "r2h_batch" / "sweep" / "study" / "paper" / "table1.csv"
Cells = Callable[[str, str, str], float]
"""(split, short name, column) -> number of a table"""


@dataclass(frozen=True)
class Finding:
    """Claims of the paper; conditions, each with its words; why they hold here or not."""

    text: str
    holds: tuple[tuple[str, Callable[[Cells], bool]], ...]
    cause: str


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
            CAUSES[0],
        ),
        Finding(
            "In S1 all kinematic failures of Contact-Handover get worse",
            tuple((f"{c} rises", rises("Contact", c)) for c in ("f_plan", "f_reach", "f_safe", "f_stab")),
            CAUSES[1],
        ),
        Finding(
            "Functional awareness lowers F_afford in S1: Intent-Handover first, Contact-Handover second",
            (
                ("Intent lowest", extreme("S1", "f_afford", "Intent", -1)),
                ("Contact second", lambda cell: sorted(four, key=lambda m: cell("S1", m, "f_afford"))[1] == "Contact"),
            ),
            CAUSES[2],
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
            CAUSES[3],
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
            CAUSES[4],
        ),
    ]


def _of_fc_and_va() -> list[Finding]:
    """Where it speaks of FC-Handover and Handover-VA."""
    four = tuple(SHORT.values())
    return [
        Finding(
            "FC-Handover has the lowest F_reach", (("lowest F_reach", extreme("Avg", "f_reach", "FC", -1)),), CAUSES[5]
        ),
        Finding(
            "FC-Handover has the highest F_afford in S1, and its F_plan rises there",
            (("highest F_afford", extreme("S1", "f_afford", "FC", 1)), ("F_plan rises", rises("FC", "f_plan"))),
            CAUSES[6],
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
            CAUSES[7],
        ),
    ]


def findings() -> list[Finding]:
    """The eight, in the order of the paper's Results."""
    return [*_of_contact(), *_of_intent(), *_of_fc_and_va()]


CAUSES = [
    "Contact-Handover compares 256 poses of gripper and held object with the estimated hand. The other methods compare at most"
    " eight, without the object. In the default preset F_safe is 0: the planner certifies paths against the true hand.",
    "Contact-Handover's pose search ignores the function of the object, and its network never saw the object. In S1 its"
    " Stability fails only with candidates as generated (preset paper).",
    "Intent-Handover's rule knows the receiver's region. Contact-Handover's network estimates it. With candidates as generated"
    " the estimate is too coarse for second place.",
    "Intent-Handover turns hand, object and gripper as one. So the gripper is as far from the target hand as from the predicted"
    " hand on the object. The paper does not say whether object or gripper stands 15 cm above the palm.",
    "The times of stand-ins say nothing about the originals.",
    "Reach rarely fails: the object comes within a few centimetres of c_h, and the ball's radius is 10 cm.",
    "FC-Handover places the gripper opposite to the fingers, wherever they point, and knows no region"
    " ([why its plans fail](table1-v1.md#why-plan-fails)).",
    "Handover-VA takes the first pose that the arm reaches, and checks no collision. It runs ICP, where the other methods look"
    " up stored hands, so it is slower. Only its grasps are unfiltered in the default preset, so only it fails Stability.",
]
"""Read on 2026-11-21 from 500 trials of each split. `make tables` does not check them: a person does."""


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


def page(tables: Mapping[str, Mapping]) -> str:
    """docs/results/findings.md, from name -> the table's JSON."""
    data = {title: tables[file] for file, title in TABLES.items()}
    here = {name: cells_of(d) for name, d in data.items()}
    first = next(iter(data.values()))
    rates = {n: [c(s, m, "f_safe") for m in SHORT.values() for s in ("S0", "S1")] for n, c in here.items()}
    safe = {name: (min(own), max(own)) for name, own in rates.items()}
    other = max(most for name, (_, most) in safe.items() if name != PAPER_PRESET)
    parts = [
        "# Compare with the paper",
        "See which findings of the paper appear here, and why others do not. Objects, hands and networks are stand-ins"
        " ([baselines](../baselines.md)). So a finding that does not appear is no evidence against the paper. `make tables`"
        f" makes this page ({first['origin']['trials']} trials, commit {first['provenance']['commit'][:12]}).",
        "## Success rates",
        "A column stands for a protocol and its preset (default unless named). `r2h-batch report bench/rows/NAME` prints Table I"
        f" of a column, for NAME in {', '.join(f'`{n}`' for n in ROWS)}. The last row has the mean distance from the paper's SR,"
        " in points.",
        success_table(here),
        "- In preset paper the planner avoids the estimated hand and samples edges, so the oracle loses some trials.\n"
        f"- F_safe is {safe[PAPER_PRESET][0]:.1f} to {safe[PAPER_PRESET][1]:.1f} % in preset paper, and"
        f" {'at most ' if other else ''}{other:.1f} % in the other columns.\n"
        "- In preset release every handover of the bowl fails Stability: the bowl is wider than the gripper opens.\n"
        "- In r2h-release fingers point away from the robot. FC- and Intent-Handover place the gripper opposite to them, so Plan"
        " mostly fails.",
        "## Findings",
        "A finding is a list of conditions on the rates as they are, without a test. Two rates that are near may change places"
        " with other trials. `yes`: all hold. `no`: none holds. `not:` names those that do not hold."
        " Own time: T_method.",
        appearing(here),
        "## Causes",
        "A person read these causes from the tables. No test checks them.",
        "\n".join(f"{number}. {finding.cause}" for number, finding in enumerate(findings(), 1)),
    ]
    return "\n\n".join(parts) + "\n"
