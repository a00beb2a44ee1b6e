"""r2h-v3: built-in methods from the table to the hand, by the stage that fails first: docs/r2h_v3.md.

`python bench/r2h_v3.py` sweeps `r2h-v3` with the motion as planned (`--execute.sim none`), judges some rows again with
other code, and takes the time of each part. `--trials 500 --seen-trials 500 --checked 30 --processes 2 --parts FOLDER --rows` is
for a night: it keeps what is done, started again it goes on with what is missing, and it writes the rows that the package ships.
"""

import argparse
import concurrent.futures
import hashlib
import json
import multiprocessing
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Literal

import families
import numpy as np
import torch
from _report import ROOT, Parts, Report, markdown_table, swept
from _rows import over_categories, paired_over_categories, poses_of, rows_of, thinned
from _source import digests
from run import Bench

MEASURES = (
    "bench/r2h_v3.py",
    "kernels/judge",
    "kernels/plan",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/judge/metrics.py",
    "r2h_batch/judge/pick.py",
    "r2h_batch/judge/received.py",
    "r2h_batch/judge/reception.py",
    "r2h_batch/judge/scores.py",
    "r2h_batch/judge/straight_way.py",
    "r2h_batch/methods/from_table.py",
    "r2h_batch/methods/oracle.py",
    "r2h_batch/observe/known.py",
    "r2h_batch/observe/moment.py",
    "r2h_batch/trials/r2h_v3.py",
    "r2h_batch/scene/resting.py",
)
SEES = "cell-v1,region=told"
SEEING = ("robust", "fc", "handover-va", "contact", "intent", "learned", "random")
BOUNDS = ("random", "oracle", "robust")
RULES = ("fc", "handover-va", "contact", "intent")
METHODS = ("random", "oracle", "fc", "handover-va", "contact", "intent", "learned")
TRACKS: dict[str, tuple[str, ...]] = {
    "truth": ("--method", *METHODS),
    "seen": ("--sees", SEES, "--method", *SEEING),
}
SHARD = 128
"""Trials that a process takes at a time, all methods of a track: those that see share what they look at."""
SHIPPED = {"truth": "r2h-v3-as-planned", "seen": "r2h-v3-sees-cell-v1"}
"""Track -> folder of its rows in the package (report/compare/rows)."""
SAME_M = 1e-4
"""Presented's margins that differ by less are the same."""
TIMED = 128
"""Rows of each method whose parts are timed."""


def measured(options: argparse.Namespace, _: Report) -> Mapping[str, Any]:
    """All figures of the page."""
    from r2h_batch.runs.store import load_run

    of = {"trials": options.trials, "seen_trials": options.seen_trials, "source": digests(MEASURES)}
    with tempfile.TemporaryDirectory() as folder:
        # rows of other code or of other trials lie in another folder
        name = hashlib.sha256(json.dumps(of).encode()).hexdigest()[:12]
        home = (options.parts or Path(folder)).absolute() / name
        home.mkdir(parents=True, exist_ok=True)
        context, parts = multiprocessing.get_context("spawn"), Parts(home, of)
        with ProcessPoolExecutor(options.processes, mp_context=context) as pool:
            waiting = []
            for track, trials in (("seen", options.seen_trials), ("truth", options.trials)):
                shards = -(-2 * trials // SHARD)
                waiting += [pool.submit(_swept, home, track, trials, k, shards) for k in range(shards)]
            for piece in waiting:
                piece.result()
        runs, each = {track: load_run(home / track) for track in TRACKS}, options.checked
        # a process for each method: what the ones before have in memory is gone
        with ProcessPoolExecutor(options.processes, mp_context=context, max_tasks_per_child=1) as pool:
            checked = [
                pool.submit(parts.get, f"checked {t} {each} {name}", partial(_checked, home / t, name, each))
                for t, run in runs.items()
                for name in run.methods
            ]
            concurrent.futures.wait(checked)
        if options.rows:
            trials = {"truth": options.trials, "seen": options.seen_trials}
            for track, name in SHIPPED.items():
                words = [*_line(track), "--trials", str(trials[track]), "--out", f"runs/{name}"]
                rows = ROOT / "r2h_batch/report/compare/rows" / name
                thinned(home / track, rows, ["python", "-m", "r2h_batch.sweep", *words])
        titles = dict(zip(SEEING, runs["seen"].methods, strict=True))
        return {
            "trials": options.trials,
            "methods": {name: _about(runs["truth"], name) for name in runs["truth"].methods},
            "checked": [c for part in checked for c in part.result()],
            "ms": parts.get("cost", partial(_cost, runs["truth"])),  # alone on the machine
            "seen_trials": options.seen_trials,
            "seen": {name: _about(runs["seen"], name) for name in runs["seen"].methods},
            "robust": titles["robust"],
            "rules": [titles[m] for m in RULES],
            "pairs": {t: _pairs(runs[t]) for t in TRACKS},
        }


def _line(track: str) -> list[str]:
    """The sweep of a track, without the number of its trials."""
    return ["--benchmark", "r2h-v3", *TRACKS[track], "--execute.sim", "none"]


def _swept(home: Path, track: str, trials: int, k: int, shards: int) -> None:
    """One shard of a track's trials, all methods."""
    begin = time.process_time()
    piece = ("--shard-trials", SHARD, "--shard", f"{k + 1}/{shards}")
    more = ("--trials", trials, "--save-paths", "--threads", 1, "--quiet", *piece)
    swept(home / track, *_line(track), *more)
    print(f"{track}, shard {k + 1} of {shards}: {time.process_time() - begin:.0f} CPU s", flush=True)


def _about(run: Any, name: str) -> dict[str, Any]:
    """The outcomes of a method, and why it fails."""
    rows = sorted(run.trials(name).to_pylist(), key=lambda r: r["trial_id"])
    return {
        "n": len(rows),
        "won": "".join(str(int(r["outcome"] == "success")) for r in rows),
        "outcomes": dict(Counter(r["outcome"] for r in rows)),
        "reasons": dict(Counter(r["pick_reason"] for r in rows if r["outcome"] == "pick")),
        "plans": dict(Counter(r["plan_reason"] for r in rows if r["outcome"] == "plan")),
        "nobody": dict(Counter(r["received_reason"] for r in rows if r["outcome"] == "received")),
    }


def _pairs(run: Any) -> list[dict[str, Any]]:
    """Whom the paired tests of all trials tell apart, with Holm's correction; bounds are left out."""
    from r2h_batch.report.statistics.paired import compare, pair_up

    methods = run.only([m for m in run.methods if not m.lower().startswith(BOUNDS)])
    (whole,) = [c for c in compare(pair_up([methods]), draws=1) if c.group == "all"]
    return [
        {"a": p.a, "b": p.b, "difference": p.difference, "p": p.p_holm, "p_new": p.p_new_holm, "verdict": p.verdict}
        for p in whole.pairs
    ]


def _checked(folder: Path, name: str, each: int) -> list[dict[str, Any]]:
    """So many rows of a method, and the verdict of other code on them."""
    from dataclasses import fields

    from _twins import Again, AgainBelieved, PickTwin, presented_again, reception_of

    from r2h_batch.judge.pick import Picked
    from r2h_batch.judge.reception import reception
    from r2h_batch.observe import moments
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.judge import Judge
    from r2h_batch.types import Predictions

    run = load_run(folder)
    judge = Judge(run)
    scene, believes = judge.evaluator.scene, judge.evaluator.plans_in is not None
    kind = AgainBelieved if believes else Again
    checked: list[dict[str, Any]] = []
    columns = rows_of(run, name)
    ids = list(columns)[:: max(len(columns) // each, 1)][:each]
    trials = judge.trials(ids)
    grasp, pose = poses_of([columns[i] for i in ids])
    rest = moments(scene, trials)
    found = judge.evaluator.picks(grasp, pose, trials)
    scores = judge.evaluator.score(grasp, pose, trials)
    people, answers = reception(scores), Predictions(trials.trial_id, grasp, pose)
    for k, i in enumerate(ids):
        row = columns[i]
        own = Picked(*(getattr(found, f.name)[k : k + 1] for f in fields(Picked)))
        says = ""
        if not believes or int(own.length[0]):  # without a pick in the believed world the arm does not move
            says = PickTwin(scene, trials[k : k + 1], grasp[k], rest[k], own).wrong()
        if row["passed_pick"] != bool(own.picked):
            says = f"{says} stored otherwise"
        twin = kind(
            scene, judge.evaluator.config, trials[k : k + 1], row | _until_safe(row), row["T_obj_ee"], row["T_world_ee"],
            T_world_rest=rest[k],
        )  # fmt: skip
        others = [f.name for f in twin.findings() if not f.holds]
        if (said := row["passed_presented"]) is not None:
            first = presented_again(scene, trials, answers, scores, k).margin
            away = abs(first - row["margin_presented_m"]) > SAME_M
            others += ["presented"] if away or (said != (first >= 0) and abs(first) > SAME_M) else []
        if row["passed_received"] is not None:
            others += [f.name for f in reception_of(twin, people, k) if not f.holds]
            if bool(people.received[k]) != row["passed_received"]:
                others.append("received is stored otherwise")
        checked.append(
            {
                "method": name,
                "trial": i,
                "picked": bool(own.picked),
                "carried": bool(row.get("q")),
                "presented": bool(row["passed_presented"]),
                "received": bool(row["passed_received"]),
                "wrong": "; ".join([*([says.strip()] if says.strip() else []), *others]),
            }
        )
    return checked


TIMES: dict[str, tuple[tuple[str, ...], Literal["pose", "all"]]] = {
    "none": ((), "all"),
    "present": (("pick", "presented"), "all"),
    "received": (("pick", "presented", "received"), "all"),
    "pose_none": ((), "pose"),
    "pose": (("pick", "presented"), "pose"),
}
"""Calls that are timed beside drawing a moment: the criteria that r2h-v3 asks for, and the stages."""
WARM, ROUNDS = 4, 3
"""Calls before the clock counts: the first compiles and caches, the next ones record small calls."""


def _cost(run: Any) -> dict[str, float]:
    """Process milliseconds of a row (median of some rounds), of `TIMES` and of drawing its moment."""
    from dataclasses import replace

    from r2h_batch.config import EvalConfig, ExecConfig
    from r2h_batch.evaluate import Evaluator
    from r2h_batch.observe import moments
    from r2h_batch.trials.registry import named_benchmark

    rows: list[dict[str, Any]] = []
    for name in run.methods:
        columns = rows_of(run, name)
        rows += [columns[i] for i in sorted(columns)[:TIMED]]
    grasp, pose = poses_of(rows)
    ids = torch.tensor([r["trial_id"] for r in rows])

    def timed(call: Callable[[], object]) -> float:
        spent = []
        for _ in range(WARM + ROUNDS):
            begin = time.process_time()
            call()
            spent.append(time.process_time() - begin)
        return 1e3 * statistics.median(spent[WARM:]) / len(rows)

    found: dict[str, float] = {}
    v3 = named_benchmark("r2h-v3")
    for name, (asks, stages) in TIMES.items():
        benchmark = replace(v3, asks=asks)
        evaluator = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")), threads=1)
        trials = benchmark.trials_with_ids(ids)
        found[name] = timed(partial(evaluator.score, grasp, pose, trials, stages))
        if "moment" not in found:
            found["moment"] = timed(partial(moments, evaluator.scene, trials))
    return found


def _until_safe(row: dict[str, Any]) -> dict[str, Any]:
    """The outcome of a row by the criteria that the twin knows: what fails behind Safe has passed all of them."""
    return {"outcome": "success"} if row["outcome"] in ("presented", "received") else {}


def shown(data: Mapping[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    from r2h_batch.report.statistics.aggregate import wilson_interval
    from r2h_batch.report.text import short_names
    from r2h_batch.verdicts import IN_ORDER

    methods = data["methods"]
    short = short_names(list(methods))
    nobody = list(dict.fromkeys(r for m in methods.values() for r in m["nobody"]))
    giving = [[short[k], *(m["nobody"].get(r, 0) for r in nobody)] for k, m in methods.items() if m["nobody"]]
    ms = data["ms"]
    cost = [
        ["a kinematic trial (`--execute.sim none`, five criteria)", f"{ms['none']:.2f}"],
        ["with Pick and Presented, and the carry in place of the path from home", f"{ms['present']:.2f}"],
        ["and the reception of what got so far", f"{ms['received']:.1f}"],
    ]
    order = [entry.name for entry in IN_ORDER]
    oracle = methods["oracle"]
    splits, kinds = _kinds(max(len(m["won"]) for m in (*methods.values(), *data["seen"].values())))

    def rate(m: Mapping[str, Any]) -> str:
        won = np.array([c == "1" for c in m["won"]])
        if m is oracle:
            return f"{100 * won.mean():.1f}"
        ends = [100 * float(x) for x in wilson_interval(np.array(won.sum()), len(won))]
        _, *wide = over_categories(won, splits[: len(won)], kinds[: len(won)], "S0+S1")
        return f"{100 * won.mean():.1f} ({ends[0]:.1f}-{ends[1]:.1f}) ({wide[0]:.1f}-{wide[1]:.1f})"

    def table(track: str, of: Mapping[str, Any]) -> str:
        """Methods by their rates, the bounds last: what each reads, its rate and intervals, first failures, and the others."""
        names, reads = short_names(list(of)), _reads(track)
        bounds = [k for k in of if k.lower().startswith(BOUNDS)]
        ranked = sorted((k for k in of if k not in bounds), key=lambda k: -of[k]["won"].count("1"))
        rows = [
            [
                *(names[k], reads[k], rate(of[k])),
                *(f"{100 * of[k]['outcomes'].get(c, 0) / of[k]['n']:.1f}" for c in order),
                families.beside(families.short(k), data["pairs"][track]),
            ]
            for k in (*ranked, *bounds)
        ]
        return markdown_table(["", "Reads", "SR", *(name.capitalize() for name in order), "compared with others"], rows)

    sighted = short_names(list(data["seen"]))
    cost += [
        ["the pose stage of the five criteria", f"{ms['pose_none']:.3f}"],
        ["with Pick and Presented", f"{ms['pose']:.3f}"],
    ]
    reasons = list(dict.fromkeys(r for m in methods.values() for r in sorted(m["reasons"], key=m["reasons"].get)[::-1]))
    causes = [
        [short[k], of, *(f"{100 * m['reasons'].get(r, 0) / of:.1f}" for r in reasons)]
        for k, m in methods.items()
        if (of := sum(m["reasons"].values()))
    ]
    words = list(dict.fromkeys(r for m in methods.values() for r in m["plans"]))
    plans = [[short[k], *(m["plans"].get(r, 0) for r in words)] for k, m in methods.items() if m["plans"]]
    checked = data["checked"]
    wrong = sum(bool(c["wrong"]) for c in checked)
    known, names = certified_trials()
    drawn = [name.rpartition("_")[0].replace("_", " ") for name in names]
    of, again = Counter(drawn), Counter(c for c, k in zip(drawn, known.redraws, strict=True) if k)
    redraws = [[c, of[c], again[c], f"{100 * again[c] / of[c]:.1f}"] for c in sorted(again)]
    return {
        "certified": len(drawn),
        "redrawn": sum(again.values()),
        "redrawn_share": 100 * sum(again.values()) / len(drawn),
        "never": int((~known.solved).sum()),
        "redraws": markdown_table(["", "trials", "drawn again", "percent"], redraws),
        "stages": table("truth", methods),
        **_bound_of(data, sighted, splits, kinds),
        "sights": table("seen", data["seen"]),
        "reasons": _believed(data, sighted),
        "plans": markdown_table(["", *(r.replace("_", " ") for r in words)], plans),
        "at_most": 100 * float(wilson_interval(np.array(wrong), len(checked))[1]),
        "causes": markdown_table(["", "trials", *(r.replace("_", " ") for r in reasons)], causes),
        "checked": len(checked),
        "wrong": wrong,
        "passing": sum(c["picked"] for c in checked),
        "carried": sum(c["carried"] for c in checked),
        "received": sum(c["received"] for c in checked),
        "giving": markdown_table(["", *(r.replace("_", " ") for r in nobody)], giving),
        "cost": markdown_table(["", "ms"], cost),
        "timed": TIMED * len(methods),
        "moment": ms["moment"],
    }


def _reads(track: str) -> dict[str, str]:
    """What each method of a track may read, by the rows that the package ships."""
    from r2h_batch.runs.store import load_run

    run = load_run(ROOT / "r2h_batch/report/compare/rows" / SHIPPED[track], verify=False)
    return {name: run.entry(name).reads for name in run.methods}


def _believed(data: Mapping[str, Any], short: Mapping[str, str]) -> str:
    """Of planning in what was seen: reasons by method."""
    both = ("reasons", "plans")
    words = [list(dict.fromkeys(r for m in data["seen"].values() for r in m[k])) for k in both]
    named = [f"{name}: {r.replace('_', ' ')}" for name, rs in zip(("Pick", "Plan"), words, strict=True) for r in rs]
    reasons = [
        [short[title], *(m[k].get(r, 0) for k, rs in zip(both, words, strict=True) for r in rs)]
        for title, m in data["seen"].items()
    ]
    return markdown_table(["", *named], reasons)


def _kinds(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Split and category of the first `n` trials of r2h-v3."""
    from r2h_batch import load_benchmark

    names = load_benchmark("r2h-v3").trials_with_ids(torch.arange(n)).object_names
    return np.array(["S0", "S1"])[np.arange(n) % 2], np.array([name.rpartition("_")[0] for name in names])


def _bound_of(
    data: Mapping[str, Any], short: Mapping[str, str], splits: np.ndarray, kinds: np.ndarray
) -> dict[str, Any]:
    """The robust search less the best published rule on the same trials."""
    from r2h_batch.report.statistics.intervals import paired_score_interval

    seen = data["seen"]
    best = max(data["rules"], key=lambda k: seen[k]["won"].count("1"))
    robust = data["robust"]
    pairs = Counter(zip(seen[best]["won"], seen[robust]["won"], strict=True))
    more, less, n = pairs["0", "1"], pairs["1", "0"], len(seen[best]["won"])
    low, high = (100 * x for x in paired_score_interval(more, less, n))
    rows = [np.array([c == "1" for c in seen[k]["won"]]) for k in (robust, best)]
    wide = paired_over_categories(rows[0], rows[1], splits[:n], kinds[:n], "S0+S1")
    return {
        **{"best": short[best], "points": 100 * (more - less) / n, "low": low, "high": high},
        **{"wide_low": wide["low"], "wide_high": wide["high"]},
    }


def certified_trials() -> tuple[Any, list[str]]:
    """The shipped certificates, and the object that each of their trials had as it was drawn first."""
    from dataclasses import replace

    from r2h_batch import load_benchmark
    from r2h_batch.trials.certified import load_certified

    known = load_certified("r2h-v3")
    first = replace(load_benchmark("r2h-v3"), certified=None)
    return known, first.trials_with_ids(torch.from_numpy(known.trial_id)).object_names


BENCH = Bench(
    __doc__,
    measured,
    MEASURES,
    {
        "--trials": {"default": 100, "help": "of each split, told the truth"},
        "--seen-trials": {"default": 20, "help": "of each split of the seeing track"},
        "--checked": {"default": 8, "help": "rows of each method that other code judges again"},
        "--rows": {"action": "store_true", "help": "write the rows that the package ships"},
        "--processes": {"default": 2},
        "--parts": {"type": Path, "help": "folder where rows and finished parts are kept: a stopped bench goes on"},
    },
    peer="own twins in float64",
    stored="r2h_v3",
)

if __name__ == "__main__":
    BENCH.main()
