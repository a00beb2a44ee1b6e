"""The paper's eight findings against this benchmark's tables: docs/results/findings.md and README's table.

`make tables` writes both (bench/tables.py). A finding is a list of conditions on Table I. It appears if all of them hold, in
part if some do. A person wrote the causes below (CAUSES has the date); all figures come from the tables.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLES = {
    "table1-v1": "r2h-v1",
    "table1-v1-paper-preset": "r2h-v1, preset paper",
    "table1-v1-release-preset": "r2h-v1, preset release",
    "table1-release": "r2h-release, preset release",
    "table1-v0": "r2h-v0",
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
            "FC-Handover has the lowest F_reach", (("lowest F_reach", extreme("Avg", "f_reach", "FC", -1)),), CAUSES[5]
        ),
        Finding(
            "FC-Handover has the highest F_afford in S1, and its F_plan rises there: its orientation does not know the region",
            (("highest F_afford", extreme("S1", "f_afford", "FC", 1)), ("F_plan rises", rises("FC", "f_plan"))),
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
    " edges against the true hand. In preset paper it samples paths around the estimated hand, and motions then fail Safe."
    " In the default preset Intent-Handover is ahead in S0 (cause 4).",
    "Contact-Handover's pose search sees hand and object but not the object's function. F_afford rises: the network never saw"
    " the object whose contacts it predicts ([receivers](../receivers.md#contact-network)). Stability fails only with candidates"
    " as generated (`candidates as generated` in [sensitivity](sensitivity.md)).",
    "Intent-Handover's rule knows the region. Contact-Handover's network never saw the object. With filtered candidates that"
    " still gives the second place; with candidates as generated (preset paper) it does not.",
    "Intent-Handover turns hand, object and gripper as one: where the predicted hand and the gripper are apart, the target"
    " hand and the gripper are. With the TCP instead of the object's centre 15 cm above the palm (`intent,at=gripper` in"
    " [sensitivity](sensitivity.md)) a bowl or a cup has little room. The paper does not say what stands there; the authors'"
    " release does ([baselines](../baselines.md#the-texts-sentence-by-sentence)).",
    "The stand-ins' times say nothing about the originals: a look-up takes microseconds, a diffusion model seconds. Cause"
    " 1 explains F_safe: when planning sees only the estimated hand, methods near the hand sometimes fail Safe.",
    "Reach hardly ever fails: with published errors the object comes within a few centimetres of c_h, and the ball's"
    " radius is 10 cm. Twice the errors change little (`error x 2` in [sensitivity](sensitivity.md)). Handover-VA's loops retreat"
    " from the receiver where the arm does not reach.",
    "FC-Handover opposes the gripper to the fingers wherever they point, in both splits, and knows no region; what"
    " stops it stands in [why Plan fails](table1-v1.md#why-plan-fails). The"
    " paper names neither the distance to the palm nor what keeps it: with the object 3 cm nearer, at the ball's centre, F_plan"
    " about doubles (`fc,height_m=0.12` in [sensitivity](sensitivity.md)). In r2h-release fingers point away from the robot:"
    " FC- and Intent-Handover, which oppose the gripper to them, mostly fail Plan there.",
    "Handover-VA takes the first pose that the arm reaches and checks no collision: highest F_plan, lowest SR. FC-Handover"
    " opposes fingers that point sideways or up and then meets hand or table; with the object 3 cm nearer it ranks last"
    " (cause 7). Handover-VA runs ICP and computes grasps while the others look up hands. In the default preset only its grasps"
    " are unfiltered, so only it fails Stability. From S0 to S1 Affordance costs all but Intent-Handover"
    " ([by object](table1-v1.md#by-object)).",
]
"""Read on 2026-11-21 from 500 trials of each split. `make tables` does not check them: a person does."""


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


def distance_lines(tables: Mapping[str, Cells]) -> list[str]:
    """A Markdown table: mean distance of each rate from the paper's, over methods and splits."""
    columns = {"sr": "SR", "f_plan": "F_plan", "f_reach": "F_reach", "f_safe": "F_safe", "f_stab": "F_stab"}
    columns["f_afford"] = "F_afford (S1)"
    paper, lines = paper_cells(), ["| | " + " | ".join(columns.values()) + " |", "|---|" + "--:|" * len(columns)]
    for name, cell in tables.items():
        cells = []
        for column in columns:
            places = [(s, m) for s in (("S1",) if column == "f_afford" else ("S0", "S1")) for m in SHORT.values()]
            apart = [abs(cell(s, m, column) - paper(s, m, column)) for s, m in places]
            cells.append(f"{sum(apart) / len(apart):.1f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def success_lines(tables: Mapping[str, Cells]) -> list[str]:
    """A Markdown table: SR of each method and split, the paper's and ours."""
    cells = {"paper": paper_cells(), **tables}
    lines = ["| SR | split | " + " | ".join(cells) + " |", "|---|---|" + "--:|" * len(cells)]
    for who, split in product(SHORT.values(), ("S0", "S1")):
        rates = " | ".join(f"{cell(split, who, 'sr'):.1f}" for cell in cells.values())
        lines.append(f"| {who} | {split} | {rates} |")
    return lines


def some_of(ids: list[int]) -> str:
    """The ids, of many the number and the first five."""
    shown = ", ".join(map(str, ids[:5] if len(ids) > 10 else ids))
    return f"{len(ids)}: {shown}, ..." if len(ids) > 10 else shown


def oracle_lines(tables: Mapping[str, Mapping]) -> list[str]:
    """A Markdown table: the oracle's success, and the trials that it does not solve."""
    lines = ["| | SR S0 | SR S1 | trials that it leaves | of these no method solves |", "|---|--:|--:|---|---|"]
    for name, data in tables.items():
        cell = cells_of(data)
        ids = [some_of(data[key]) for key in ("oracle_unsolved", "solved_by_nobody")]
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


def page(tables: Mapping[str, Mapping]) -> str:
    """docs/results/findings.md, from name -> the table's JSON."""
    data = {title: tables[file] for file, title in TABLES.items()}
    here = {name: cells_of(d) for name, d in data.items()}
    first = next(iter(data.values()))
    parts = [
        "# Compare with the paper",
        "The paper's Table I beside ours, which of its findings appear here, and why others do not. Objects, hands and"
        " networks are stand-ins ([baselines](../baselines.md)): a finding that does not appear is no evidence against the"
        " paper. `make tables` makes this page from the"
        f" [tables](table1-v1.md) ({first['origin']['trials']} trials, commit {first['provenance']['commit'][:12]}) and the"
        " paper's figures as printed (`r2h_batch/study/paper/table1.csv`).",
        "## Success rates",
        "\n".join(success_lines(here)),
        "## Findings",
        "A finding is a list of conditions: `yes` means that all hold, `no` that none holds; `not:` names those that do not"
        " hold.",
        "\n".join(appearing(here)),
        "## Causes",
        "Causes are a person's reading of the tables, not tests.",
        "\n".join(f"{number}. {finding.cause}" for number, finding in enumerate(findings(), 1)),
        "## Distance from the paper's table",
        "Mean difference in points from the paper's rates, whatever its sign, over the four methods and both splits. No"
        " setting was chosen by it: objects, hands and networks differ. With preset release every handover of the bowl fails"
        " Stability: across it the whole object is wider than the gripper opens.",
        "\n".join(distance_lines(here)),
        "## Upper bound",
        "The oracle tries candidates until the evaluator accepts one. In preset paper the planner samples edges around the"
        " estimated hand.",
        "\n".join(oracle_lines(data)),
        "## Who is better",
        "Each cell gives the better method of a pair and the difference in points of SR, over both splits (`r2h-batch"
        ' compare`). "These objects" means that the test decides for the 16 objects, not for new ones'
        " ([statistics](../statistics.md#who-is-better)).",
        "\n".join(pair_lines(data)),
    ]
    return "\n\n".join(parts) + "\n"


def readme_lines(default: Mapping) -> list[str]:
    """The table of README.md: r2h-v1, default preset."""
    return [
        "| | SR S0 | SR S1 | F_plan S0 / S1 | F_reach | F_safe | F_stab S1 | F_afford S1 | Presented S1 |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
        *_readme_rows(default),
    ]


def _readme_rows(data: Mapping) -> list[str]:
    cell, lines = cells_of(data), []
    for title in dict.fromkeys(r["method"] for r in data["rows"]):
        who = SHORT.get(title.partition(" (")[0], title)
        both = [f"{cell('S0', who, c):.1f} / {cell('S1', who, c):.1f}" for c in ("f_plan", "f_reach", "f_safe")]
        ends = [f"{cell('S1', who, c):.1f}" for c in ("f_stab", "f_afford", "presented")]
        rates = [f"{cell(s, who, 'sr'):.1f}" for s in ("S0", "S1")]
        lines.append(f"| {title.partition(' (')[0]} | " + " | ".join([*rates, *both, *ends]) + " |")
    return lines


def with_table(text: str, lines: list[str]) -> str:
    """README.md with its table exchanged: the lines from `| | SR S0` to the next that is none."""
    before, head, rest = text.partition("| | SR S0 |")
    after = rest.split("\n")
    while after and (after[0].startswith("|") or after[0].endswith("|")):
        after.pop(0)
    return before + "\n".join([*lines, *after]) if head else text
