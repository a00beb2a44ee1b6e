"""The paper's eight findings against this benchmark's tables: docs/results/findings.md, from docs/results/*.json alone.

    python bench/findings.py                    # after bench/table1.py and bench/sensitivity.py

A finding is a list of conditions on Table I. It appears if all of them hold, in part if some do. A person wrote the causes below
(CAUSES has the date); all figures come from the tables.
"""

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from _report import ROOT

TABLES = {
    "table1-v1": "r2h-v1",
    "table1-v1-paper-preset": "r2h-v1, preset paper",
    "table1": "r2h-v0",
    "table1-paper-preset": "r2h-v0, preset paper",
}
"""File -> what it is called here; r2h-v1 first, for its receivers have bodies."""

SHORT = {"FC-Handover": "FC", "Handover-VA": "VA", "Contact-Handover": "Contact", "Intent-Handover": "Intent"}
PAPER = ROOT / "r2h_batch" / "study" / "paper" / "table1.csv"
Cells = Callable[[str, str, str], float]
"""(split, short name, column) -> number of a table"""


@dataclass(frozen=True)
class Finding:
    """What the paper says; conditions, each with its words; why they hold here or not."""

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
            "In S1 all kinematic failures of Contact-Handover get worse: its collision cost does not transfer to functional"
            " constraints",
            tuple((f"{c} rises", rises("Contact", c)) for c in ("f_plan", "f_reach", "f_safe", "f_stab")),
            CAUSES[1],
        ),
        Finding(
            "Functional awareness lowers F_afford in S1: Intent-Handover first, Contact-Handover second",
            (
                ("Intent lowest", extreme("S1", "f_afford", "Intent", -1)),
                (
                    "Contact second",
                    lambda cell: sorted(four, key=lambda m: cell("S1", m, "f_afford"))[1] == "Contact",
                ),
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
            "Intent-Handover takes longest to plan (2.4 x Contact-Handover), and fails Safe in S0: it avoids a generated hand",
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
            "FC-Handover has the lowest F_reach",
            (("lowest F_reach", extreme("Avg", "f_reach", "FC", -1)),),
            CAUSES[5],
        ),
        Finding(
            "FC-Handover has the highest F_afford in S1, and its F_plan rises there: its orientation does not know the region",
            (
                ("highest F_afford", extreme("S1", "f_afford", "FC", 1)),
                ("F_plan rises", rises("FC", "f_plan")),
            ),
            CAUSES[6],
        ),
        Finding(
            "Handover-VA has the lowest SR, the shortest planning and the lowest F_stab, the highest F_plan and F_safe, and drops"
            " most from S0 to S1",
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
    "Contact-Handover compares 256 poses of gripper and held object with the estimated hand. The other methods compare at"
    " most eight, without the object. In the default preset F_safe is 0 for every method, because the planner certifies"
    " edges against the true hand. In preset paper it samples paths around the estimated hand: motions then fail Safe, and"
    " those of Contact-Handover fail least.",
    "Contact-Handover's pose search sees hand and object but not the object's function. S1's long tools leave more room"
    " beside the palm than S0's bowls, so F_plan stays or falls. F_afford rises: the network cannot learn the contacts of"
    " binoculars, trigger sprayer and power drill from the other fifteen objects"
    " ([receivers](../receivers.md#contact-network)). Stability fails only with candidates as generated: for wineglass,"
    " binoculars and toothbrush the gripper cannot hold the grasp that blocks least contact.",
    "Intent-Handover's rule knows the region. Its remaining failures are fingers that reach past the point on the"
    " approach axis. Contact-Handover comes last, since its network never saw the object. A network trained on all objects"
    " halves its F_afford (`contact,contacts=all` in [sensitivity](sensitivity.md)).",
    "Intent-Handover turns hand, object and gripper as one, so it has one pose and searches nothing. In S0 the TCP 15 cm"
    " above the palm leaves no room for a bowl or a cup: in most Plan failures the object overlaps the hand. With the"
    " object's middle at that place (`intent,at=object` in [sensitivity](sensitivity.md)) it ranks first. The default"
    " follows the paper, which names the gripper ([choices](../choices.md#methods)). In S1 Intent-Handover leads.",
    "The stand-ins' times say nothing about the originals: a look-up takes microseconds, a diffusion model seconds. Cause"
    " 1 explains F_safe: when planning sees only the estimated hand, every method near the hand sometimes fails Safe.",
    "Reach hardly ever fails: with published errors the object comes within a few centimetres of c_h, and the ball's"
    " radius is 10 cm. The paper's 2 to 9 % need errors several times larger, or another rule for the object's place."
    " Handover-VA has most of the failures: its loops retreat from the receiver where the arm does not reach.",
    "Contact-Handover's F_afford is mostly higher (cause 3), Handover-VA's similar. FC-Handover's F_plan differs little"
    " between the splits: it opposes the gripper to the fingers wherever they point. In most of its failures the object"
    " overlaps the hand or the arm overlaps the table.",
    "FC-Handover has the lowest SR: it opposes fingers that point sideways or up and then meets hand or table."
    " Handover-VA's handle need not point where fingers do. Its own time is among the longest, since it runs ICP and"
    " computes grasps while the others look up hands. In the default preset only its grasps are unfiltered, so only it"
    " fails Stability. With candidates as generated it fails least, as in the paper. From S0 to S1 it loses to Affordance:"
    " it grasps knife, pliers and toothbrush from above, in the receiver's region.",
]
"""Written on 2026-11-20 from 500 trials of each split."""


def cells_of(data: Mapping) -> Cells:
    """The cells of a table's JSON; what is not evaluated counts 0."""
    rows = {(r["split"], SHORT.get(r["method"].partition(" (")[0], r["method"])): r for r in data["rows"]}
    return lambda split, who, column: float(rows[split, who][column] or 0.0)


def paper_cells() -> Cells:
    """The paper's own Table I (its planning time stands for a method's own)."""
    import csv

    lines = [line for line in PAPER.read_text().splitlines() if not line.startswith("#")]
    rows = {(r["split"], SHORT[r["method"]]): r for r in csv.DictReader(lines)}
    names = {"t_method_s": "t_plan_s"}

    def cell(split: str, who: str, column: str) -> float:
        value = rows[split, who][names.get(column, column)]
        return float(value) if value not in ("", "n/a", "N/A") else 0.0

    return cell


def said(finding: Finding, cell: Cells) -> tuple[str, str]:
    """`appears`, `in part` or `no`, and the conditions that do not hold."""
    missing = [words for words, holds in finding.holds if not holds(cell)]
    word = "appears" if not missing else "no" if len(missing) == len(finding.holds) else "in part"
    return word, ", ".join(missing)


def appearing(tables: Mapping[str, Cells]) -> list[str]:
    """A Markdown table: each finding, and in each table `yes`, or the conditions that fail."""
    lines = ["| | finding | " + " | ".join(tables) + " |", "|--:|---|" + "---|" * len(tables)]
    for number, finding in enumerate(findings(), 1):
        here = [said(finding, cell) for cell in tables.values()]
        words = [{"appears": "yes", "no": "no"}.get(word, f"not: {missing}") for word, missing in here]
        lines.append(f"| {number} | {finding.text} | " + " | ".join(words) + " |")
    return lines


def oracle_lines(tables: Mapping[str, Mapping]) -> list[str]:
    """A Markdown table: the oracle's success, and the trials that it does not solve."""
    lines = ["| | SR S0 | SR S1 | trials that it leaves | of these no method solves |", "|---|--:|--:|---|---|"]
    for name, data in tables.items():
        cell = cells_of(data)
        ids = [", ".join(map(str, data[key])) for key in ("oracle_unsolved", "solved_by_nobody")]
        lines.append(
            f"| {name} | {cell('S0', 'oracle', 'sr'):.1f} | {cell('S1', 'oracle', 'sr'):.1f} | {ids[0]} | {ids[1]} |"
        )
    return lines


def pair_lines(tables: Mapping[str, Mapping]) -> list[str]:
    """The six pairs of the four methods: apart or tied, in each table, over all trials."""
    lines = ["| pair | " + " | ".join(tables) + " |", "|---|" + "---|" * len(tables)]
    found: dict[tuple[str, str], list[str]] = {}
    for data in tables.values():
        for p in data["pairs"]:
            a, b = (SHORT.get(p[k].partition(" (")[0]) for k in "ab")
            if p["group"] != "all" or not (a and b):
                continue
            here = " (these objects)" if p["verdict"].endswith("here") else ""
            better = "tied" if p["verdict"] == "tied" else (a if p["verdict"].startswith("better") else b) + here
            found.setdefault((a, b), []).append(f"{better}, {p['difference']:+.1f}")
    return [*lines, *(f"| {a} - {b} | " + " | ".join(cells) + " |" for (a, b), cells in found.items())]


def page(results: Path) -> str:
    """docs/results/findings.md."""
    data = {title: json.loads((results / f"{file}.json").read_text()) for file, title in TABLES.items()}
    here = {name: cells_of(d) for name, d in data.items()}
    first = next(iter(data.values()))
    code = first["provenance"]["digests"]["code"][:16]
    parts = [
        "# The paper's findings, one by one",
        "This page says which findings of the paper appear in this benchmark, and why others do not. Objects, hands and"
        " networks are stand-ins ([baselines](../baselines.md)): a finding that does not appear is no evidence against the"
        " paper. We tuned nothing towards its table. `python bench/findings.py` makes this page from the"
        f" [tables](table1-v1.md) ({first['origin']['trials']} trials, code {code}). The paper's own figures are in"
        " `r2h_batch/study/paper/table1.csv`. A finding is a list of conditions: `yes` means that all hold, `no` that none"
        " holds; `not:` names those that do not hold.",
        "\n".join(appearing(here)),
        "## Causes",
        "\n".join(f"{number}. {finding.cause}" for number, finding in enumerate(findings(), 1)),
        "## Upper bound",
        "In the default preset the oracle solves every trial. In preset paper the planner samples edges around the estimated"
        " hand, and the oracle fails a few trials.",
        "\n".join(oracle_lines(data)),
        "## Who is better",
        "Each cell gives the better method of a pair and the difference in points of SR, over both splits (`r2h-batch"
        ' compare`). "These objects" means that the test decides for the 16 objects, not for new ones'
        " ([statistics](../statistics.md#who-is-better)).",
        "\n".join(pair_lines(data)),
    ]
    return "\n\n".join(parts) + "\n"


def readme_lines(data: Mapping) -> list[str]:
    """The table of README.md: r2h-v0, default preset."""
    cell = cells_of(data)
    lines = [
        "| | SR S0 | SR S1 | F_plan S0 / S1 | F_reach | F_safe | F_stab S1 | F_afford S1 | Presented S1 |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for title in dict.fromkeys(r["method"] for r in data["rows"]):
        who = SHORT.get(title.partition(" (")[0], title)
        both = [f"{cell('S0', who, c):.1f} / {cell('S1', who, c):.1f}" for c in ("f_plan", "f_reach", "f_safe")]
        ends = [f"{cell('S1', who, c):.1f}" for c in ("f_stab", "f_afford", "presented")]
        rates = [f"{cell(s, who, 'sr'):.1f}" for s in ("S0", "S1")]
        lines.append(f"| {title} | " + " | ".join([*rates, *both, *ends]) + " |")
    return lines


def with_table(text: str, lines: list[str]) -> str:
    """README.md with its table exchanged: the lines from `| | SR S0` to the next that is none."""
    before, head, rest = text.partition("| | SR S0 |")
    after = rest.split("\n")
    while after and (after[0].startswith("|") or after[0].endswith("|")):
        after.pop(0)
    return before + "\n".join([*lines, *after]) if head else text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=ROOT / "docs" / "results")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "findings.md")
    parser.add_argument("--readme", action="store_true", help="also exchange the table in README.md")
    given = parser.parse_args()
    given.out.write_text(page(given.results))
    print(given.out)
    if given.readme:
        file = ROOT / "README.md"
        file.write_text(
            with_table(file.read_text(), readme_lines(json.loads((given.results / "table1.json").read_text())))
        )
        print(file)


if __name__ == "__main__":
    main()
