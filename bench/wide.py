"""Wide tables of pages, from the JSON of several benches: `{wide.NAME}` of a page (bench/figures.py).

Sentences stand in the pages. A page that shows such a table names its JSON as `bench/results/NAME.json`.
"""

import json
from collections.abc import Mapping
from typing import Any

from _report import ROOT, markdown_table

AGAIN = {
    "v1": "r2h-v1",
    "body": "r2h-v1, `--receiver body`",
    "paper": "r2h-v0, preset paper",
    "unseen": "r2h-v1 with meshes of `bench/meshes.py`, S0",
    "families": "r2h-v2",
    "panda": "r2h-v1, Panda",
    "ur10e": "r2h-v1, UR10e",
    "release": "r2h-release, preset release",
    "error": "r2h-v1, `execution_error=5mm,1deg`",
}
PEOPLE = {"reception": "reception", "closed": "closed loop, `moves` with `servo`"}
GATED = {"fc": "FC-Handover", "handover_va": "Handover-VA", "contact": "Contact-Handover", "intent": "Intent-Handover"}
OWN_GATE = {"fc": "hand", "handover_va": "ik", "contact": "none", "intent": "none"}
NETWORKS = {
    "all_categories": ["`contact`", "192 objects of all 16 categories, none of them judged"],
    "other_categories": ["`contact,contacts=other-categories`", "the other 12 categories and 57 kinds of other things"],
}


def values(name: str) -> Mapping[str, Any]:
    """Figures of a bench by what stands behind its name."""
    own = json.loads((ROOT / "bench" / "results" / f"{name}.json").read_text())["values"]
    return {k.removeprefix(f"{name}."): v for k, v in own.items()}


def shown(_: object) -> dict[str, str]:
    """All tables."""
    again, gates, nets = values("judge_again"), values("gates"), values("networks")
    figures = ("rows", "margins", "wrong", "largest_difference_mm", "bounds_that_do_not", "facts.rows", "facts.wrong")
    cells = {s: [again[f"{s}.{f}"] for f in figures] for s in AGAIN}
    judged = [[title, *(f"{x:.3f}" if isinstance(x, float) else x for x in cells[s])] for s, title in AGAIN.items()]
    people = [
        [title, again[f"{s}.rows"], again[f"{s}.facts.rows"], again[f"{s}.facts.wrong"]] for s, title in PEOPLE.items()
    ]

    def gated(method: str, gate: str) -> str:
        rates = " / ".join(f"{gates[f'{method}.{gate}.{split}']:.1f}" for split in ("s0", "s1"))
        return f"{rates} (own)" if OWN_GATE[method] == gate else rates

    def rate(name: str, split: str) -> str:
        sr, low, high = (nets[f"{name}.{split}.{k}"] for k in ("sr", "sr_new_categories_low", "sr_new_categories_high"))
        return f"{sr:.1f} ({low:.1f}-{high:.1f})"

    of_networks = [
        [
            *said,
            f"{nets[f'{name}.region_auc']:.2f}",
            rate(name, "s0"),
            rate(name, "s1"),
            f"{nets[f'{name}.s1.f_afford']:.1f}",
        ]
        for name, said in NETWORKS.items()
    ]
    head = (
        "rows",
        "margins",
        "wrong verdicts",
        "largest error of a distance, mm",
        "bounds that are too large",
        "facts",
        "wrong facts",
    )
    kinds = ("none", "ik", "hand")
    return {
        "judged": markdown_table(["set", *head], judged),
        "people": markdown_table(["set", "rows", "facts", "wrong facts"], people),
        "gates": markdown_table(
            ["SR S0 / S1", *(f"`gate={k}`" for k in kinds)],
            [[t, *(gated(m, k) for k in kinds)] for m, t in GATED.items()],
        ),
        "networks": markdown_table(["", "trained on", "region AUC", "SR S0", "SR S1", "F_afford S1"], of_networks),
    }
