"""Object families: Table I of r2h-v2, the turn test, the order of the methods, how many instances they need, the contact
network against exact maps, and what 96 objects cost: docs/results/table1.md.

`python bench/families.py --rows FOLDER` sweeps into the folder, or goes on there, and measures; motions as planned
(`--execute.sim none`). `--counted` counts Table I, its pairs and the spreads again, from the rows
that ship with the package.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from _report import ROOT, Report, made_by, markdown_table, resident_mib, swept
from run import Bench
from scipy.special import stdtrit

if TYPE_CHECKING:
    from r2h_batch.config import EvalConfig
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
V1, V2 = ("--benchmark", "r2h-v1", "--execute.sim", "none"), ("--benchmark", "r2h-v2", "--execute.sim", "none")
OTHERS = {
    "preset paper": ("--preset", "paper"),
    "preset release": ("--preset", "release"),
    "the hand alone": ("--receiver", "hand"),
    "candidates as generated": ("--candidates", "as-generated"),
}
REGIONS = {
    "bottle": (("base",), ("body", "base")),
    "power drill": (("grip", "trigger"), ("grip",)),
    "binoculars": (("right_barrel", "right_eyecup"), ("barrel", "right_barrel", "eyecup", "right_eyecup")),
}
"""Category -> the parts that the receiver takes: as r2h-v2 declares them, and another definition."""
OF_REGIONS = 120
"""Trials of a category with each definition of its region."""
ANY_TURN = "20,40,60"
"""Degrees about x, y and z: a turn that maps neither a box nor a voxel grid onto itself."""
ROUNDS, ROWS = 7, 128
MOST_CATEGORIES = 1000


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """Everything on the page; each part is kept in the folder of the rows as soon as it is known."""
    place, trials = options.rows, options.trials
    if options.counted:
        whole: dict[str, Any] = json.loads(STORED.read_text())
        rows = {k: v for k, v in origin(SHIPPED).items() if k.startswith("rows_")}
        return {**whole, **of_rows(SHIPPED), **rows}
    if options.kept:
        kept: dict[str, Any] = json.loads((place / "found.json").read_text())
        if not is_frozen(kept):
            sys.exit(f"{place / 'found.json'} was measured on another r2h-v2; give a new --rows FOLDER, without --kept")
        return kept | {"contacts_cpu_s": contact_seconds(), "sizes": sizes()} | origin(place / "v2")
    few = ("--trials", min(trials, FEW))
    v2 = swept(place / "v2", "--method", *METHODS, *BOUNDS, "--trials", trials, *V2)
    found: dict[str, Any] = {"trials": trials, "turned": {}, "orders": {}}

    def keep(**parts: Any) -> None:
        found.update(parts)
        (place / "found.json").write_text(json.dumps(found, indent=1) + "\n")
        print(", ".join(parts), "measured", flush=True)

    keep(**of_rows(v2))
    keep(turned={"r2h-v2": turned(v2, min(trials, SOME), V2)})
    v1 = swept(place / "v1", "--method", *METHODS, "--trials", min(trials, SOME), *V1)
    keep(turned=found["turned"] | {"r2h-v1": turned(v1, min(trials, SOME), V1)})
    keep(exact=exact_maps(place, v2, trials))
    keep(orders={"r2h-v2": order(v2)})
    for name, flags in OTHERS.items():
        folder = swept(place / f"v2-{name.replace(' ', '-')}", "--method", *METHODS, *few, *V2, *flags)
        keep(orders=found["orders"] | {f"r2h-v2, {name}": order(folder)})
    keep(cost=cost())
    keep(regions=regions())
    return found | {"contacts_cpu_s": contact_seconds(), "sizes": sizes()} | origin(v2)


def of_rows(v2: Path) -> dict[str, Any]:
    """Table I, pairs, rates of the oracle and spreads of the rows of Table I, in the order of this bench's methods."""
    from r2h_batch.runs.store import load_run

    found = table(v2)
    place = {name: k for k, name in enumerate(SHORT.values())} | {name: len(SHORT) for name in BOUNDS}
    found["rows"] = sorted(found["rows"], key=lambda r: (r["split"] == "Avg", r["split"], place[short(r["method"])]))
    return {
        "table": found,
        "compared": compared(load_run(v2)),
        "oracle": by_category(v2, "oracle"),
        "spreads": spreads(v2),
    }


def origin(v2: Path) -> dict[str, Any]:
    """Where the rows and the page come from."""
    from r2h_batch.runs.store import load_run

    header = load_run(v2, verify=False).header
    rows = {"rows_commit": header["git_commit"], "rows_code": header["digests"]["code"]}
    return {**rows, "network": network_report()["sha256"], **made_by(MEASURES)}


def is_frozen(data: Mapping[str, Any]) -> bool:
    """Whether the rows are of r2h-v2 as it is frozen; before, it had the receivers of r2h-v1. A sweep itself refuses to go on
    with rows of another digest."""
    from r2h_batch import load_benchmark

    return str(data["table"]["origin"]["benchmark"]).endswith(load_benchmark("r2h-v2").digest)


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


def turned(folder: Path, trials: int, protocol: Sequence[str]) -> list[dict[str, Any]]:
    """The turn test of the methods: sweeps with turned objects beside the run, made or gone on with."""
    from r2h_batch.base.registry import TURNS
    from r2h_batch.report.turn import about, folder_of
    from r2h_batch.report.turn import turned as tests_of
    from r2h_batch.runs.store import load_run

    for turn in (*TURNS, ANY_TURN):
        swept(folder_of(folder, turn), "--method", *METHODS, "--trials", trials, *protocol, "--turn", turn)
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


def spreads(folder: Path) -> dict[str, Any]:
    """Standard deviations between categories (s_c), between instances of one (s_i), and of an instance's rate by its trials
    (s_t), in points: of each method's SR and of each pair's difference. Splits have Table I's weights."""
    from r2h_batch.report.statistics.paired import pair_up
    from r2h_batch.runs.store import load_run

    paired = pair_up([load_run(folder).only(METHODS)])
    place, trials, hits = paired.clusters[1], paired.trials, paired.hits
    weights = trials.sum(1) / trials.sum()
    names = [SHORT[name.partition(" (")[0]] for name in paired.names]
    found: dict[str, Any] = {"methods": {}, "pairs": {}}

    def over_splits(solved: np.ndarray, noise: np.ndarray) -> dict[str, float]:
        """Both splits' parts, of a mean over C categories of which each split has its share."""
        parts, counts = [], []
        for k in range(len(trials)):
            asked = trials[k] > 0
            n = trials[k][asked]
            parts.append(parts_of(solved[k][asked] / n, float(noise[k]), n, place[asked]))
            counts.append(len(np.unique(place[asked])))
        more = [w**2 * sum(counts) / c for w, c in zip(weights, counts, strict=True)]
        return {key: 100 * sum(m * own[key] for m, own in zip(more, parts, strict=True)) ** 0.5 for key in parts[0]}

    means = hits.sum(2) / trials.sum(1)[:, None]  # (2, M)
    for i, name in enumerate(names):
        found["methods"][name] = over_splits(hits[:, i], means[:, i] * (1 - means[:, i]))
    for i, a in enumerate(names):
        for j, b in list(enumerate(names))[i + 1 :]:
            more = means[:, i] - means[:, j]
            differ = (paired.only[:, i, j] + paired.only[:, j, i]) / trials.sum(1)
            own = over_splits(hits[:, i] - hits[:, j], differ - more**2)
            difference = 100 * float(weights @ more)
            found["pairs"][f"{a} - {b}"] = {"difference": difference, **own, "needs": needed(difference, own)}
    return found


def parts_of(value: np.ndarray, noise: float, n: np.ndarray, place: np.ndarray) -> dict[str, float]:
    """Variances of a split: between categories (s_c), between instances of one (s_i), and of an instance's value by its
    trials (s_t); those of the trials are taken off the others.

    Args:
        value: (K,) mean over the trials of each instance.
        noise: variance of a single trial's value.
        n: (K,) trials of each instance.
        place: (K,) number of each instance's category.
    """
    kinds = np.unique(place)
    groups = [value[place == c] for c in kinds]
    sizes = np.array([len(g) for g in groups])
    trial = noise * float(np.mean(1 / n))
    inner = float(np.mean([g.var(ddof=1) for g in groups]))
    outer = float(np.var([g.mean() for g in groups], ddof=1))
    return {"s_c": max(outer - inner * float(np.mean(1 / sizes)), 0.0), "s_i": max(inner - trial, 0.0), "s_t": trial}


def half_width(own: Mapping[str, float], categories: int, instances: int) -> float:
    """Half of the 95 % interval of a mean over so many categories of two splits, and instances of each."""
    variance = own["s_c"] ** 2 + (own["s_i"] ** 2 + own["s_t"] ** 2) / instances
    return float(stdtrit(categories - 2, 0.975)) * (variance / categories) ** 0.5


def needed(difference: float, own: Mapping[str, float]) -> dict[str, int | None]:
    """Instances of a category -> the fewest categories whose interval leaves out 0; None beyond a thousand."""
    found: dict[str, int | None] = {}
    for m in (1, 6, 20):
        enough = (c for c in range(4, MOST_CATEGORIES + 1) if half_width(own, c, m) < abs(difference))
        found[str(m)] = next(enough, None)
    return found


def order(folder: Path) -> dict[str, Any]:
    """SR and first failures (mean of the splits) of each method, and what of the six pairs is decided over all trials."""
    from r2h_batch.report.statistics.aggregate import summarise
    from r2h_batch.report.statistics.paired import compare, pair_up
    from r2h_batch.report.statistics.rates import FAILURES
    from r2h_batch.report.statistics.tally import tally
    from r2h_batch.runs.store import load_run

    run = load_run(folder).only(METHODS)
    rows = summarise([tally(run, name) for name in run.methods])
    mean = {SHORT[r.method.partition(" (")[0]]: r.rates for r in rows if r.split == "Avg"}
    rates = {name: rate.percent for name, own in mean.items() if (rate := own["sr"])}
    failures = {
        rate: {name: 0.0 if (r := own[rate]) is None else r.percent for name, own in mean.items()} for rate in FAILURES
    }
    (whole,) = [c for c in compare(pair_up([run]), draws=1) if c.group == "all"]
    decided = [
        {"better": winner, "worse": loser, "new": not p.verdict.endswith("here")}
        for p in whole.pairs
        if p.verdict != "tied"
        for a, b in [[SHORT[name.partition(" (")[0]] for name in (p.a, p.b)]]
        for winner, loser in [(a, b) if p.verdict.startswith("better") else (b, a)]
    ]
    return {"sr": rates, "failures": failures, "decided": decided, "n": whole.n}


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
        run = load_run(folder)
        rows = table(folder)["rows"]
        method = run.named("contact")
        found[name] = {
            r["split"]: {k: r[k] for k in ("sr", "sr_low", "sr_high", "f_afford")}
            for r in rows
            if r["method"] == method
        }
    return found


def as_planned() -> "EvalConfig":
    """The configuration of `--execute.sim none`."""
    from r2h_batch.config import EvalConfig, ExecConfig

    return EvalConfig(execute=ExecConfig(sim="none"))


def regions() -> list[dict[str, Any]]:
    """SR of the four methods on a category's instances with each definition of the receiver's region, in the same trials.

    Receiving hands, contact maps and what methods see of the region follow the definition.
    """
    from r2h_batch import load_benchmark
    from r2h_batch.evaluate import Evaluator
    from r2h_batch.methods import contact, fc, handover_va, intent

    methods = {"FC": fc, "VA": handover_va, "Contact": contact, "Intent": intent}
    whole = load_benchmark("r2h-v2")
    found = []
    for category, definitions in REGIONS.items():
        own = [o for o in whole.objects if o.name.rpartition("_")[0] == category.replace(" ", "_")]
        for parts in definitions:
            region = [np.isin(o.face_part, [o.part_names.index(p) for p in parts]) for o in own]
            objects = tuple(
                replace(o, receiver_face=r, instruction=f"hand over the {category} to human")
                for o, r in zip(own, region, strict=True)
            )
            benchmark = replace(whole, objects=objects)
            evaluator = Evaluator(benchmark, as_planned(), threads=1)
            trials = benchmark.trials(OF_REGIONS, splits=["S1"])
            rates = {}
            for name, method in methods.items():
                answer = method.predict(trials, evaluator.scene, seed=0)
                scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials)
                rates[name] = 100 * float((scores.outcome == 0).double().mean())
            share = float(np.mean([o.mesh.area_faces[r].sum() / o.mesh.area for o, r in zip(own, region, strict=True)]))
            line = {
                "category": category,
                "parts": parts,
                "n": OF_REGIONS,
                "instances": len(own),
                "area": share,
                "sr": rates,
            }
            found.append(line)
            print(line, flush=True)
    return found


def cost() -> dict[str, Any]:
    """Process seconds of a scene of 96 objects, a trial's time against r2h-v1's by turns, and memory."""
    from r2h_batch import load_benchmark
    from r2h_batch.evaluate import Evaluator
    from r2h_batch.methods import intent

    begin = resident_mib()
    found: dict[str, Any] = {}
    score: dict[str, Callable[[], object]] = {}
    for protocol in ("r2h-v1", "r2h-v2"):
        benchmark = load_benchmark(protocol)
        seconds = time.process_time()
        evaluator = Evaluator(benchmark, as_planned(), threads=1)
        evaluator.scene.world, evaluator.scene.grasp_tables, evaluator.scene.object_mesh_ids  # noqa: B018
        trials = benchmark.trials(ROWS // 2, splits=["S0", "S1"])
        answer = intent.predict(trials, evaluator.scene, seed=0)
        evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials)
        found[protocol] = {"ready_cpu_s": time.process_time() - seconds, "resident_mib": resident_mib() - begin}

        def again(e=evaluator, a=answer, t=trials) -> object:
            return e.score(a.T_obj_ee, a.T_world_ee, t)

        score[protocol] = again
    times: dict[str, list[float]] = {p: [] for p in score}
    for _ in range(ROUNDS):
        for protocol, call in score.items():
            seconds = time.process_time()
            call()
            times[protocol].append(time.process_time() - seconds)
    ratios = [b / a for a, b in zip(times["r2h-v1"], times["r2h-v2"], strict=True)]
    found["trial_ms"] = {p: 1e3 * statistics.median(t) / ROWS for p, t in times.items()}
    found["trial_ratio"] = {"median": statistics.median(ratios), "low": min(ratios), "high": max(ratios)}
    found["first_use"] = first_use()
    return found


def sizes() -> dict[str, float]:
    """Megabytes of the families' files and of all that a wheel packs."""
    files = (ROOT / "assets" / "families").glob("*")
    stored = sum(p.stat().st_size for p in files if p.suffix in (".npz", ".safetensors", ".json"))
    return {"families_mb": stored / 1e6, "wheel_mb": packed_mb(("r2h_batch", "kernels", "assets"))}


def first_use() -> dict[str, float]:
    """Seconds of a sweep of the four methods, ten trials of each split, with an empty cache: process time and wall."""
    command = [sys.executable, "-m", "r2h_batch", "sweep", "--method", *METHODS, "--trials", "10", "--quiet", *V2]
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.time()
    with tempfile.TemporaryDirectory() as place:
        environment = {**os.environ, "R2H_BATCH_CACHE": f"{place}/cache"}
        subprocess.run([*command, "--out", f"{place}/run"], check=True, env=environment, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"cpu_s": cpu, "wall_s": time.time() - begin}


def contact_seconds() -> float:
    """Process seconds of the contact network for an object of a family, the mean of four."""
    import torch

    from r2h_batch.methods.predictors.grid import contact_grids
    from r2h_batch.methods.predictors.principal_axes import load_axes_network
    from r2h_batch.scene.objects import load_objects

    torch.set_num_threads(1)
    network, objects = load_axes_network(), load_objects(["cup_01", "hammer_01", "bottle_01", "bowl_01"])
    begin = time.process_time()
    with torch.no_grad():
        for o in objects:
            network(contact_grids([o]))
    return (time.process_time() - begin) / len(objects)


def packed_mb(folders: Sequence[str]) -> float:
    """Size of the tracked files of these folders in one archive, packed as a wheel packs them."""
    listed = subprocess.run(["git", "ls-files", *folders], cwd=ROOT, check=True, capture_output=True, text=True)
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in listed.stdout.splitlines():
            archive.write(ROOT / name, name)
    return buffer.tell() / 1e6


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


def network_report() -> dict[str, Any]:
    """The report of the contact network's training."""
    return json.loads((ROOT / "assets" / "families" / "voxnet_axes.json").read_text())


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
        "--kept": {"action": "store_true", "help": "write what earlier calls measured, without measuring more"},
        "--counted": {
            "action": "store_true",
            "help": "count Table I, its pairs and the spreads again from the shipped rows, without a sweep",
        },
    },
    peer="exact contact maps, r2h-v1",
    stored="families",
)

if __name__ == "__main__":
    BENCH.main()
