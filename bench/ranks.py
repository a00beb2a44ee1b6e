"""Which methods change places when SR is not what counts: docs/results/questions.md, from the JSON of other pages.

Robustness, reception and moving receivers each have a bench of their own.
"""

import json
from itertools import combinations
from typing import Any

from _report import ROOT, lines_of, markdown_table

STORED = ROOT / "bench" / "results"
LEVELS = {2: "5 mm, 1 deg", 3: "10 mm, 2 deg"}
CASES = ("moves, planned", "moves, stop", "moves, servo", "moves, replan")


def read(name: str) -> Any:
    """A bench's JSON."""
    return json.loads((STORED / f"{name}.json").read_text())


def columns() -> dict[str, dict[str, float]]:
    """Column -> method -> percent; SR first. Reception counts where it is of the same benchmark."""
    robust, moving = read("robustness"), read("closed_loop")
    curves = {c["method"].partition(" (")[0]: [x["percent"] for x in c["sr"]] for c in robust["curves"]}
    found = {"SR": {m: x[0] for m, x in curves.items()}}
    found |= {level: {m: x[k] for m, x in curves.items()} for k, level in LEVELS.items()}
    received = read("reception")
    head, _, *rows = lines_of(received["tables"], "Received, by step")
    for name in ("of all", "and success") if received.get("benchmark") == robust["benchmark"] else ():
        found[f"received {name}".replace("of all", "").strip()] = {
            r[0]: float(r[head.index(name)]) for r in rows if r[0] in curves
        }
    methods = {m.partition(" (")[0]: x["cases"] for m, x in moving["methods"].items()}
    found |= {
        case: {m: 100 * x[case]["won"].count("1") / len(x[case]["won"]) for m, x in methods.items()} for case in CASES
    }
    return found


def tested(case: str, a: str, b: str) -> str:
    """A pair's difference as the page of a column gives it: marks, or p."""
    if case in LEVELS.values():
        head, _, *rows = lines_of(read("robustness")["tables"], "Pairs: A-B")
        (cell,) = [r[head.index(case)] for r in rows if {r[0], r[1]} == {a, b}]
        return "*" * cell.count("*")
    if case not in CASES:
        return ""
    return f" (p {corrected(case)[frozenset((a, b))]:.2g})"


def corrected(case: str) -> dict[frozenset[str], float]:
    """Pair of methods -> McNemar's exact p of a case with hands that move, corrected over all pairs."""
    from r2h_batch.report.statistics.paired import holm, mcnemar

    won = {m.partition(" (")[0]: x["cases"][case]["won"] for m, x in read("closed_loop")["methods"].items()}
    counts = {}
    for a, b in combinations(won, 2):
        pairs = list(zip(won[a], won[b], strict=True))
        counts[frozenset((a, b))] = pairs.count(("1", "0")), pairs.count(("0", "1"))
    p = holm([mcnemar(*own) for own in counts.values()])
    return dict(zip(counts, p.tolist(), strict=True))


def shown(_: object) -> dict[str, str]:
    """Tables and commits of the page."""
    found = columns()
    methods = list(found["SR"])
    places = {c: {m: 1 + sum(x[o] > x[m] for o in methods) for m in methods} for c, x in found.items()}
    rows = [[m, *(places[c][m] for c in found)] for m in methods]
    said = []
    for c, x in list(found.items())[1:]:
        for a, b in combinations(methods, 2):
            before, after = found["SR"][a] - found["SR"][b], x[a] - x[b]
            if before * after < 0:
                said.append([c, f"{a} - {b}", f"{before:+.1f}", f"{after:+.1f}{tested(c, a, b)}"])
    sources = {name: read(name) for name in ("robustness", "reception", "closed_loop")}
    return {
        "commits": ", ".join(dict.fromkeys(s["commit"][:12] for s in sources.values())),
        "table": markdown_table(["Method", *found], rows),
        "pairs": markdown_table(["column", "pair", "by SR", "by the column"], said),
    }
