"""Which methods change places when SR is not what counts: docs/results/questions.md, from the JSON of other pages.

Robustness, reception and moving receivers each have a bench of their own.
"""

import json
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


def shown(_: object) -> dict[str, str]:
    """Tables and commits of the page."""
    found = columns()
    methods = list(found["SR"])
    places = {c: {m: 1 + sum(x[o] > x[m] for o in methods) for m in methods} for c, x in found.items()}
    rows = [[m, *(places[c][m] for c in found)] for m in methods]
    return {
        "table": markdown_table(["Method", *found], rows),
    }
