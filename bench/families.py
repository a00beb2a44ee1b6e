"""Object families: Table I of r2h-v2, the turn test, first failures in other configurations, and the contact network against
exact maps: docs/results/table1.md.

`python bench/families.py --rows FOLDER` sweeps into the folder, or goes on there, and measures; motions as planned
(`--execute.sim none`). `--counted` counts Table I and its pairs again, from the rows that ship with the package.
"""

import argparse
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from _report import ROOT, Report, made_by, markdown_table, swept
from run import Bench

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run

SHIPPED = ROOT / "r2h_batch" / "report" / "compare" / "rows" / "r2h-v2-as-planned"
"""Rows of Table I."""
STORED = ROOT / "bench" / "results" / "families.json"
MEASURES = (
    *("bench/families.py", "kernels", "r2h_batch/judge", "r2h_batch/scene", "r2h_batch/methods"),
    *(
        "r2h_batch/trials",
        "r2h_batch/evaluate.py",
        "r2h_batch/launching.py",
        "r2h_batch/stages.py",
        "r2h_batch/work.py",
    ),
)
METHODS = ("fc", "handover-va", "contact", "intent")
BOUNDS = ("random", "oracle")
SHORT = {"FC-Handover": "FC", "Handover-VA": "VA", "Contact-Handover": "Contact", "Intent-Handover": "Intent"}
"""`Learned` is short already."""
TRIALS, SOME, FEW = 500, 240, 120
"""Trials of each split: of Table I, of a turn test, of another configuration."""
V2 = ("--benchmark", "r2h-v2", "--execute.sim", "none")
OTHERS = {
    "preset paper": ("--preset", "paper"),
    "preset release": ("--preset", "release"),
    "the hand alone": ("--receiver", "hand"),
    "candidates as generated": ("--candidates", "as-generated"),
}
ANY_TURN = "20,40,60"
"""Degrees about x, y and z: a turn that maps neither a box nor a voxel grid onto itself."""


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """Everything on the page."""
    place, trials = options.rows, options.trials
    if options.counted:
        whole: dict[str, Any] = json.loads(STORED.read_text())
        return {**whole, **of_rows(SHIPPED), **origin(SHIPPED)}
    few = ("--trials", min(trials, FEW))
    v2 = swept(place / "v2", "--method", *METHODS, *BOUNDS, "--trials", trials, *V2)
    orders = {"r2h-v2": failures(v2)}
    for name, flags in OTHERS.items():
        folder = swept(place / f"v2-{name.replace(' ', '-')}", "--method", *METHODS, *few, *V2, *flags)
        orders[f"r2h-v2, {name}"] = failures(folder)
    return {
        "trials": trials,
        **of_rows(v2),
        "turned": {"r2h-v2": turned(v2, min(trials, SOME))},
        "exact": exact_maps(place, v2, trials),
        "orders": orders,
        **origin(v2),
        **made_by(MEASURES),
    }


def of_rows(v2: Path) -> dict[str, Any]:
    """Table I, pairs and rates of the oracle of the rows of Table I, in the order of this bench's methods."""
    from r2h_batch.runs.store import load_run

    found = table(v2)
    place = {name: k for k, name in enumerate(SHORT.values())} | {name: len(SHORT) for name in BOUNDS}
    found["rows"] = sorted(found["rows"], key=lambda r: (r["split"] == "Avg", r["split"], place[short(r["method"])]))
    return {
        "table": found,
        "compared": compared(load_run(v2)),
        "oracle": by_category(v2, "oracle"),
    }


def origin(v2: Path) -> dict[str, Any]:
    """Where the rows come from, and which contact network answered."""
    from r2h_batch.runs.store import load_run

    header = load_run(v2, verify=False).header
    network = json.loads((ROOT / "assets" / "families" / "voxnet_axes.json").read_text())["sha256"]
    return {"rows_commit": header["git_commit"], "rows_code": header["digests"]["code"], "network": network}


def table(folder: Path) -> dict[str, Any]:
    """Table I's rows and where they come from."""
    from r2h_batch.runs.store import load_run

    return table_of_run(load_run(folder))


def table_of_run(run: "Run") -> dict[str, Any]:
    """The same of an open run."""
    from r2h_batch.report.table import render, table_of

    data = json.loads(render(table_of(run), "json"))
    return {k: data[k] for k in ("origin", "rows")}


def compared(run: "Run", methods: Sequence[str] = METHODS) -> list[dict[str, Any]]:
    """Pairs, ranks and worst ranks of methods of a run."""
    from r2h_batch.report.statistics.paired import compare, pair_up

    found = compare(pair_up([run.only(methods)]))
    return [{**asdict(c), "rank": None if c.rank is None else c.rank.tolist()} for c in found]


def turned(folder: Path, trials: int) -> list[dict[str, Any]]:
    """The turn test of the methods: sweeps with turned objects beside the run, made or gone on with."""
    from r2h_batch.base.registry import TURNS
    from r2h_batch.report.turn import about, folder_of
    from r2h_batch.report.turn import turned as tests_of
    from r2h_batch.runs.store import load_run

    for turn in (*TURNS, ANY_TURN):
        swept(folder_of(folder, turn), "--method", *METHODS, "--trials", trials, *V2, "--turn", turn)
    return about(tests_of(load_run(folder, verify=False).only(METHODS)))


def by_category(folder: Path, method: str) -> dict[str, float]:
    """SR of a method in each category, percent."""
    from r2h_batch.report.statistics.tally import tally
    from r2h_batch.runs.store import load_run

    run = load_run(folder)
    counted = tally(run, run.named(method))
    sums: dict[str, list[int]] = {}
    for cell in counted.by("object"):
        own = sums.setdefault(counted.category.get(cell["object"], cell["object"]), [0, 0])
        own[0] += cell["successes"]
        own[1] += cell["n"]
    return {name: 100 * x / n for name, (x, n) in sorted(sums.items())}


def failures(folder: Path) -> dict[str, dict[str, dict[str, float]]]:
    """First failures (mean of the splits) of each method."""
    from r2h_batch.report.statistics.aggregate import summarise
    from r2h_batch.report.statistics.rates import FAILURES
    from r2h_batch.report.statistics.tally import tally
    from r2h_batch.runs.store import load_run

    run = load_run(folder).only(METHODS)
    rows = summarise([tally(run, name) for name in run.methods])
    mean = {SHORT[r.method.partition(" (")[0]]: r.rates for r in rows if r.split == "Avg"}
    of = {
        rate: {name: 0.0 if (r := own[rate]) is None else r.percent for name, own in mean.items()} for rate in FAILURES
    }
    return {"failures": of}


def exact_maps(place: Path, v2: Path, trials: int) -> dict[str, Any]:
    """SR of Contact-Handover on unseen instances with the network and with exact maps, in the same trials."""
    from r2h_batch import load_benchmark
    from r2h_batch.assets.receiving.contact_maps import contact_map
    from r2h_batch.data.people import people_hand
    from r2h_batch.runs.store import load_run

    file = place / "exact_maps.npz"
    if not file.exists():
        objects = load_benchmark("r2h-v2").objects
        names = np.array([o.name for o in objects])
        maps = np.stack([contact_map(o, people_hand()) for o in objects])
        np.savez_compressed(file, object=names, probability=maps, source=np.array("exact maps"))
    exact = swept(place / "exact", "--method", "contact", "--trials", trials, *V2, "--predicted-contacts", file)
    found: dict[str, Any] = {}
    for name, folder in (("network", v2), ("exact", exact)):
        method = load_run(folder).named("contact")
        found[name] = {r["split"]: {"sr": r["sr"]} for r in table(folder)["rows"] if r["method"] == method}
    return found


def short(method: str) -> str:
    """A method's short name; `random` and `oracle` as they are."""
    return SHORT.get(method.partition(" (")[0], method.partition(" (")[0])


def ends_of(row: Mapping[str, Any], name: str) -> str:
    """`LOW-HIGH` of an interval of Table I's JSON."""
    return f"{row[f'{name}_low']:.1f}-{row[f'{name}_high']:.1f}"


def ends(low: float | None, high: float | None) -> str:
    """`LOW to HIGH`, with signs."""
    return "-" if low is None or high is None else f"{low:+.1f} to {high:+.1f}"


def table_lines(data: Mapping[str, Any]) -> str:
    """Table I of r2h-v2 with its new columns."""
    compared_ = {c["group"]: c for c in data["compared"]}
    moved = {(t["method"], t["group"]): t for t in data["turned"]["r2h-v2"]}
    head = [
        "split, method",
        "SR",
        "more trials",
        "all objects",
        "all categories",
        f"{data['table']['rows'][0]['few']} new categories",
        "#1",
        "worst rank",
        "largest move by a turn",
    ]
    lines = []
    for r in data["table"]["rows"]:
        c = compared_.get("all" if r["split"] == "Avg" else r["split"], {"ranked": ()})
        first = worst = "bound"
        if r["method"] in c["ranked"]:
            k = list(c["ranked"]).index(r["method"])
            first = f"{100 * c['rank'][k][0]:.0f} %"
            w = c["worst"][k]
            worst = f"{w['rank']}" + (f" (without {w['without'].replace('_', ' ')})" if w["without"] else "")
        test = moved.get((r["method"], "all" if r["split"] == "Avg" else r["split"]))
        most = max(test["moves"], key=lambda m: abs(m["points"])) if test else None
        lines.append([
            f"{r['split']} {short(r['method'])}", f"{r['sr']:.1f}", ends_of(r, "sr"), ends_of(r, "sr_new_objects"),
            ends_of(r, "sr_new_categories"), ends_of(r, "sr_few"), first, worst,
            f"{most['points']:+.1f} ({ends(most['low'], most['high'])})" if most else "-",
        ])  # fmt: skip
    return markdown_table(head, lines)


LEARNED = ("Contact", "Learned")
"""Methods that learned from other instances of the judged categories."""


def table_one(data: Mapping[str, Any]) -> str:
    """README's Table I of r2h-v2: SR, its interval for the mean of all categories, and which methods are tied.

    Args:
        data: `table`, `compared` and `turned`, as families.json has them; `unseen`: the cells of the row of
            Contact-Handover on categories that its predictor never saw.
    """
    rows = {(r["split"], short(r["method"])): r for r in data["table"]["rows"]}
    titles = dict.fromkeys(r["method"].partition(" (")[0] for r in data["table"]["rows"])
    moved = {short(t["method"]) for t in data["turned"]["r2h-v2"] if t["marked"]}
    (whole,) = [c for c in data["compared"] if c["group"] == "all"]

    def cell(split: str, name: str) -> str:
        r = rows[split, name]
        return f"{r['sr']:.1f} ({ends_of(r, 'sr_new_categories')})"

    lines = [
        [
            t + (" ^" if short(t) in moved else "") + (" *" if short(t) in LEARNED else ""),
            rows["S0", short(t)]["reads"],
            cell("S0", short(t)),
            cell("S1", short(t)),
            beside(short(t), whole["pairs"]),
        ]
        for t in titles
    ]
    unseen = ["Contact-Handover, category not seen", rows["S0", "Contact"]["reads"], *data["unseen"]]
    lines.insert(1 + [short(t) for t in titles].index("Contact"), unseen)
    return markdown_table(["", "reads", "SR S0", "SR S1", "compared with the others"], lines)


def beside(name: str, pairs: Sequence[Mapping[str, Any]]) -> str:
    """A method's comparisons with the others, as `better than A; tied with B`; empty for a bound."""
    back = {"better": "worse", "worse": "better"}
    said: dict[str, list[str]] = {}
    for pair in pairs:
        a, b = short(pair["a"]), short(pair["b"])
        if name not in (a, b):
            continue
        word, _, here = pair["verdict"].partition(" ")
        word = word if name == a else back.get(word, word)
        said.setdefault(" ".join(filter(None, (word, here))), []).append(b if name == a else a)
    order = ("better", "better here", "tied", "worse here", "worse")
    words = {w: f"{w} {'with' if w == 'tied' else 'than'} {', '.join(said[w])}" for w in order if w in said}
    return "; ".join(words.values())


def failure_lines(data: Mapping[str, Any]) -> str:
    """First failures of the four methods in each configuration of r2h-v2, least to most."""
    lines = [
        [name, *(span(own.values()) for own in order_["failures"].values())] for name, order_ in data["orders"].items()
    ]
    heads = [f"F_{rate.removeprefix('f_')}" for rate in next(iter(data["orders"].values()))["failures"]]
    return markdown_table(["configuration", *heads], lines)


def span(values: Collection[float]) -> str:
    """`LOW to HIGH`, or the one number that all are."""
    low, high = f"{min(values):.1f}", f"{max(values):.1f}"
    return low if low == high else f"{low} to {high}"


def shown(data: Mapping[str, Any]) -> dict[str, Any]:
    """What pages show: tables, and what is said of them."""
    rows, exact = data["table"]["rows"], data["exact"]
    return {
        **{f"{split}_trials": n for split, n in {r["split"]: r["n"] for r in rows}.items()},
        "table_one": table_lines(data),
        "oracle_least": min(data["oracle"].values()),
        "pairs": markdown_table(["", "difference", "95 % interval", "p", "verdict"], pair_lines(data)),
        "first_failures": failure_lines(data),
        "share_of_exact": 100 * exact["network"]["S1"]["sr"] / exact["exact"]["S1"]["sr"],
    }


def pair_lines(data: Mapping[str, Any]) -> list[list[str]]:
    """Each pair of methods with its difference and verdict over all trials."""
    (whole,) = [c for c in data["compared"] if c["group"] == "all"]
    return [
        [
            *(f"{short(p['a'])} - {short(p['b'])}", f"{p['difference']:+.1f}", ends(p["low"], p["high"])),
            *(f"{p['p_new_holm']:.2g}", p["verdict"]),
        ]
        for p in whole["pairs"]
    ]


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--rows": {"default": Path("runs/families"), "type": Path, "help": "folder of the sweeps"},
        "--trials": {"default": TRIALS, "help": "of each split of Table I"},
        "--counted": {
            "action": "store_true",
            "help": "count Table I and its pairs again from the shipped rows, without a sweep",
        },
    },
    peer="exact contact maps",
    stored="families",
)

if __name__ == "__main__":
    BENCH.main()
