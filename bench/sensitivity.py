"""Effect of each choice on the default benchmark: the four methods with one choice changed at a time, docs/results/sensitivity.

`python bench/sensitivity.py --out FOLDER` measures it and writes JSON and page (the same FOLDER goes on); `make tables` does too.
Motion as planned (`--execute.sim none`); each variant is one sweep. The paired test (`r2h-batch compare`) says which methods are
apart in each, and the ranks how often their order is that of the base.
"""

import argparse
import json
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _report import ROOT, Report, markdown_table, swept
from run import Bench

METHODS = ("fc", "handover-va", "contact", "intent")
TITLES = {"fc": "FC-Handover", "handover-va": "Handover-VA", "contact": "Contact-Handover", "intent": "Intent-Handover"}
COLUMNS = ("sr", "f_plan", "f_reach", "f_safe", "f_stab", "f_afford")
STORED = ROOT / "docs" / "results" / "sensitivity.json"
TRIALS = 200
"""Trials of each split."""


@dataclass(frozen=True)
class Variant:
    """One choice changed: its name, what is said instead of the base's flags, and options of single methods."""

    name: str
    flags: tuple[str, ...] = ()
    options: tuple[tuple[str, str], ...] = ()
    """method -> options; the other methods are the base's"""

    @property
    def methods(self) -> list[str]:
        """Methods that are swept: all, or those whose options change."""
        if not self.options:
            return list(METHODS)
        return [f"{m},{said}" for m, said in self.options]


def variants() -> list[Variant]:
    """The base first; then the protocol, what methods and planner know, how it
    is judged, and each method's own choices."""
    own = [
        ("handover-va", "loops=one"),
        ("handover-va", "at=gripper"),
        ("handover-va", "at=object"),
        ("contact", "gate=ik"),
        ("contact", "contacts=all"),
        ("contact", "at=gripper"),
        ("intent", "orientation=axis"),
        ("intent", "at=gripper"),
        ("intent", "inward_deg=-15"),
        *(("intent", f"select={mode}") for mode in ("FS", "A1", "A2", "A3")),
        ("intent", "at=ergonomic"),
        ("fc", "gate=none"),
        ("fc", "height_m=0.12"),
        ("fc", "at=gripper"),
        ("fc", "at=gripper,height_m=0.12"),
    ]
    return [
        Variant("base"),
        Variant("protocol r2h-v1", ("--benchmark", "r2h-v1")),
        Variant("adults alone", ("--people", "adults")),
        Variant("plan-hand estimated", ("--plan.hand", "estimated")),
        Variant("candidates as generated", ("--candidates", "as-generated")),
        Variant("errors of frames", ("--estimate.errors", "frames")),
        Variant("errors with tails", ("--estimate.errors", "tails")),
        Variant("no error", ("--predictor-noise", "0")),
        Variant("error x 2", ("--predictor-noise", "2")),
        Variant("arm and torso do not count", ("--receiver", "hand")),
        Variant("edges sampled", ("--plan.edge-check", "moveit")),
        Variant("width of the whole object", ("--width", "whole")),
        Variant("reach of the hull", ("--reach", "hull")),
        Variant("preset paper", ("--preset", "paper")),
        Variant("preset release", ("--preset", "release")),
        Variant("protocol r2h-release", ("--benchmark", "r2h-release")),
        *(Variant(f"{m},{said}", (), ((m, said),)) for m, said in own),
    ]


def rates_of(folder: Path) -> dict[str, dict[str, dict[str, float | None]]]:
    """Method (the sweep's word) -> split -> column -> percent."""
    from r2h_batch.report.table import render, table_of
    from r2h_batch.runs.store import load_run

    words = {title: word for word, title in TITLES.items()}
    found: dict[str, dict[str, dict[str, float | None]]] = {}
    for row in json.loads(render(table_of(load_run(folder)), "json"))["rows"]:
        word = words[row["method"].partition(" (")[0]]
        found.setdefault(word, {})[row["split"]] = {c: row[c] for c in COLUMNS}
    return found


def pairs_of(folders: Sequence[Path]) -> dict[str, str]:
    """`a > b` or `a = b` for the pairs of methods over all trials: apart (on these objects at least) or tied."""
    from r2h_batch.report.statistics.paired import compare, pair_up
    from r2h_batch.runs.store import load_run

    (whole,) = [c for c in compare(pair_up([load_run(f) for f in folders]), draws=1) if c.group == "all"]
    found = {}
    for p in whole.pairs:
        a, b = (name.partition(" (")[0] for name in (p.a, p.b))
        found[f"{a} / {b}"] = "tied" if p.verdict == "tied" else a if p.verdict.startswith("better") else b
    return found


def order_of(rates: dict[str, dict[str, dict[str, float | None]]]) -> list[str]:
    """The methods by their mean SR of both splits, best first."""
    return sorted(METHODS, key=lambda m: -float(rates[m]["Avg"]["sr"] or 0))


def kept_pairs(order: Sequence[str], base: Sequence[str]) -> int:
    """How many of the six pairs of methods stand in the base's order."""
    place = {m: order.index(m) for m in base}
    return sum(place[a] < place[b] for i, a in enumerate(base) for b in base[i + 1 :])


def tables_of(data: dict) -> dict[str, Any]:
    """SR of each variant, and its change against the base; how many keep the base's order."""
    variants_, base = data["variants"], data["variants"][0]
    lines: list[list[object]] = []
    own_lines: list[list[object]] = []
    for v in variants_:
        cells = []
        for m in v["own"]:
            rate = v["rates"][m]["Avg"]["sr"]
            moved = "" if v is base else f" ({rate - base['rates'][m]['Avg']['sr']:+.1f})"
            cells.append(f"{rate:.1f}{moved}")
        (lines if len(cells) == len(METHODS) else own_lines).append(
            [v["name"].replace("protocol ", "benchmark "), *cells, v["kept"]]
        )
    stable = sum(v["kept"] == 6 for v in variants_[1:])
    best = sum(v["order"][0] == base["order"][0] for v in variants_[1:])
    return {
        "table": markdown_table(["changed", *(TITLES[m] for m in METHODS), "pairs"], lines),
        "options": markdown_table(["changed", "SR", "pairs"], own_lines),
        **{"stable": stable, "best": best, "variants": len(variants_) - 1},
    }


def shown(_: Any) -> dict[str, Any]:
    """What pages show of docs/results/sensitivity.json."""
    data = json.loads(STORED.read_text())
    return tables_of(data) | {k: data[k] for k in ("trials", "commit")} | {"benchmark": data["benchmark"]["name"]}


def measure(place: Path, trials: int) -> dict:
    """Sweeps every variant into a folder of `place`; what the JSON holds."""
    from r2h_batch.runs.store import load_run

    found: list[dict] = []
    base_rates: dict = {}
    header: dict = {}
    for variant in variants():
        line = [
            "--method",
            *variant.methods,
            "--trials",
            str(trials),
            "--execute.sim",
            "none",
            *variant.flags,
        ]
        folder = swept(place / re.sub("[ ,=]", "-", variant.name), *line)
        mine = rates_of(folder)
        base_rates, header = base_rates or mine, header or load_run(folder).header
        rates = {**base_rates, **mine}
        order = order_of(rates)
        found.append({
            "name": variant.name,
            "command": shlex.join(["r2h-batch", "sweep", *line]),
            "own": list(mine),
            "rates": rates,
            "order": order,
            "kept": kept_pairs(order, order_of(base_rates)),
            "pairs": pairs_of([folder]) if len(mine) == len(METHODS) else {},
        })  # fmt: skip
    origin = {"commit": header["git_commit"], "code": header["digests"]["code"], "device": header["device"]["name"]}
    origin |= {"benchmark": {"name": header["protocol"], "digest": header["digests"]["benchmark"]}}
    return {"trials": trials, **origin, "variants": found}


def run(options: argparse.Namespace, _: Report) -> None:
    """The choices of the default benchmark; their JSON stands beside the page."""
    import figures

    STORED.write_text(json.dumps(measure(options.out, options.trials), indent=1) + "\n")
    figures.write()


BENCH = Bench(
    __doc__,
    run,
    flags={
        "--out": {"default": Path("runs/sensitivity"), "type": Path},
        "--trials": {"default": TRIALS, "help": "of each split"},
    },
)

if __name__ == "__main__":
    BENCH.main()
