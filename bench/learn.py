"""A method that learned (`r2h-batch train rank`): docs/results/questions.md.

`python bench/learn.py --runs FOLDER [--scans FOLDER]` trains three seeds and four folds of left-out categories into the folder,
or goes on there, and judges what they choose on r2h-v2, motion as planned. SCANS: a folder of meshes of yours. Beside these
what a labelled pair costs and what an instance does.
"""

import argparse
import json
import os
import shutil
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from _report import ROOT, Report, made_by, markdown_table
from run import Bench

if TYPE_CHECKING:
    from r2h_batch import Evaluator, Trials
    from r2h_batch.types import Predictions

STORED = ROOT / "bench" / "results" / "learn.json"
MEASURES = (
    *("bench/learn.py", "kernels", "r2h_batch/judge", "r2h_batch/scene", "r2h_batch/methods"),
    *(
        "r2h_batch/training",
        "r2h_batch/trials",
        "r2h_batch/evaluate.py",
        "r2h_batch/launching.py",
        "r2h_batch/stages.py",
        "r2h_batch/work.py",
    ),
)
FOLDS = (
    ("cup", "headphones", "bottle", "power_drill"),
    ("bowl", "hammer", "screwdriver", "scissors"),
    ("eyeglasses", "wineglass", "knife", "binoculars"),
    ("game_controller", "pliers", "toothbrush", "trigger_sprayer"),
)
"""Each category is left out of training once."""
SEEDS = (0, 1, 2)
REGION = 0.4
"""Share of a scan's longest side that the receiver takes; from the low end and the high one by turns."""
COSTLY = "families:* x 2 seed 71"
"""Instances whose cost is measured."""


def trained(place: Path, seed: int, leave_out: Sequence[str] = ()) -> Path:
    """Weights."""
    from r2h_batch import load_benchmark
    from r2h_batch.training.rank import Recipe, train_ranker

    name = "-".join([f"seed{seed}", *leave_out])
    return train_ranker(load_benchmark("r2h-v2"), Recipe(seed=seed, leave_out=tuple(leave_out)), place / name)


def rates(evaluator: "Evaluator", trials: "Trials", found: "Predictions") -> dict[str, Any]:
    """SR of each split, first failures, and SR of each category, percent."""
    from r2h_batch.types import Outcome

    outcome = evaluator.score(found.T_obj_ee, found.T_world_ee, trials).outcome
    won, functional = outcome == int(Outcome.SUCCESS), trials.trial_id % 2 == 1
    told: dict[str, Any] = {}
    for split, rows in (("s0", ~functional), ("s1", functional)):
        if rows.any():
            failed = {o.name.lower(): int((outcome[rows] == int(o)).sum()) for o in Outcome if 1 <= int(o) <= 5}
            told[split] = {"sr": 100 * float(won[rows].double().mean()), "of": int(rows.sum()), **failed}
    of: dict[str, list[bool]] = defaultdict(list)
    for index, good in zip(trials.object_index.tolist(), won.tolist(), strict=True):
        model = evaluator.scene.objects[index]
        of[model.who.category or model.name].append(good)
    return told | {"categories": {k: 100 * float(np.mean(v)) for k, v in of.items()}}


def scans(folder: Path) -> "Evaluator":
    """Meshes of a folder: each whole (S0), and with the receiver at one end of its longest side (S1)."""
    from r2h_batch import Evaluator, load_benchmark
    from r2h_batch.config import EvalConfig, ExecConfig
    from r2h_batch.methods.candidates import without_candidates
    from r2h_batch.scene.objects import build_object

    objects = []
    for i, file in enumerate(sorted(folder.glob("*.obj"))):
        whole = build_object(file, file.stem, pieces=False)
        axis = "xyz"[int(np.ptp(whole.vertices, axis=0).argmax())]
        region = f"{axis}<{REGION}" if i % 2 == 0 else f"{axis}>{1 - REGION}"
        functional = build_object(file, f"{file.stem}_end", split="S1", receiver=region, pieces=False)
        objects += [whole, functional]
    config = EvalConfig(execute=ExecConfig(sim="none"))
    benchmark = load_benchmark("r2h-v2").with_objects(objects)
    none = without_candidates(Evaluator(benchmark, config, threads=1).scene)
    kept = [o for k, o in enumerate(objects) if k not in none]
    return Evaluator(benchmark.with_objects(kept), config, threads=1)


def labels_a_second() -> dict[str, float]:
    """Labels a CPU second in the whole loop of the default stream, and with 64 pairs a trial."""
    from r2h_batch import load_benchmark
    from r2h_batch.training import stream

    told = {}
    for name, pairs in (("loop", 16), ("loop, 64 pairs a trial", 64)):
        items = iter(stream(load_benchmark("r2h-v2"), "* x 5 seed 5", pairs=pairs, trials=4096 // pairs))
        next(items)
        start, many = time.process_time(), 0
        for _ in range(6):
            many += next(items)["success"].numel()
        told[name] = many / (time.process_time() - start)
    return told


def instance_cost(place: Path) -> dict[str, float]:
    """CPU seconds of an instance with its grasp candidates: drawn anew, and read from disk."""
    from r2h_batch import load_benchmark
    from r2h_batch.methods.candidates import candidates_of
    from r2h_batch.trials.family_objects import drawn_instance, planned_objects

    robot = load_benchmark("r2h-v2").robot
    before = os.environ.get("R2H_BATCH_CACHE")
    found = {}
    try:
        os.environ["R2H_BATCH_CACHE"] = str(place / "cache of instances")
        shutil.rmtree(place / "cache of instances", ignore_errors=True)
        candidates_of(
            (planned_objects("families:cup x 1 seed 70")[0].drawn(),), "filtered", robot
        )  # kernels are compiled
        for name in ("drawn anew", "from disk"):
            drawn_instance.cache_clear()
            planned = planned_objects(COSTLY)
            start = time.process_time()
            for one in planned:
                candidates_of((one.drawn(),), "filtered", robot)
            found[name] = (time.process_time() - start) / len(planned)
    finally:
        os.environ.pop("R2H_BATCH_CACHE")
        if before is not None:
            os.environ["R2H_BATCH_CACHE"] = before
    return found


class Study:
    """The parts of the page; each gives keys of the JSON."""

    def __init__(self, options: argparse.Namespace) -> None:
        """The benchmark, its trials and its judge.

        Args:
            options: of the command line.
        """
        from r2h_batch import Evaluator, load_benchmark
        from r2h_batch.config import EvalConfig, ExecConfig

        self.options, self.benchmark = options, load_benchmark("r2h-v2")
        self.evaluator = Evaluator(self.benchmark, EvalConfig(execute=ExecConfig(sim="none")), threads=1)
        self.some = self.benchmark.trials(options.trials)

    def judged(self, path: Path, trials: "Trials", judge: "Evaluator", **more: Any) -> dict[str, Any]:
        """Rates of weights on trials."""
        from r2h_batch.methods import learned

        told = rates(judge, trials, learned.predict(trials, judge.scene, weights=str(path), **more))
        rounded = {k: round(told[k]["sr"], 1) for k in ("s0", "s1") if k in told}
        print(path.parent.name, more, rounded, flush=True)
        return told

    def seeds(self) -> dict[str, Any]:
        """Each seed on the benchmark."""
        some = SEEDS[: self.options.seeds]
        found = {str(seed): self.judged(trained(self.options.runs, seed), self.some, self.evaluator) for seed in some}
        return {"trials": self.options.trials, "seeds": found}

    def blind(self) -> dict[str, Any]:
        """The first seed where it does not know the region."""
        path = trained(self.options.runs, 0)
        return {"blind": self.judged(path, self.some, self.evaluator, region="hidden")}

    def folds(self) -> dict[str, Any]:
        """Networks that never saw some categories, on these alone."""

        names = [o.who.category for o in self.benchmark.objects]
        found: dict[str, Any] = {"folds": {}}
        for fold, out in enumerate(FOLDS[: self.options.folds]):
            path = trained(self.options.runs, 0, out)
            own = torch.tensor([names[i] in out for i in self.some.object_index.tolist()])
            found["folds"][str(fold)] = self.judged(path, self.some[own], self.evaluator) | {"left_out": out}
        return found

    def scans(self) -> dict[str, Any]:
        """The first seed on meshes of a folder, beside Intent-Handover and the random method; nothing without a folder."""
        from r2h_batch.methods import intent, random

        if self.options.scans is None:
            return {}
        judge = scans(self.options.scans)
        path = trained(self.options.runs, 0)
        some = judge.scene.benchmark.trials(self.options.scan_trials)
        return {
            "scans": self.judged(path, some, judge) | {"objects": len(judge.scene.objects)},
            "scans, random": rates(judge, some, random.predict(some, judge.scene)),
            "scans, Intent": rates(judge, some, intent.predict(some, judge.scene)),
        }

    def labels(self) -> dict[str, Any]:
        """Labels a second."""
        return {"labels": labels_a_second()}

    def drawing(self) -> dict[str, Any]:
        """Costs of instances."""
        return {"drawing": {"instance": instance_cost(self.options.runs.absolute())}}


PARTS = ("seeds", "blind", "folds", "scans", "labels", "drawing")


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """Everything on the page, or some parts of it: the others stay as the JSON has them. The JSON says each part's commit."""
    torch.set_num_threads(1)
    bench, made = Study(options), made_by(MEASURES)
    found: dict[str, Any] = {} if {*PARTS} == {*options.parts} else json.loads(STORED.read_text())
    commits = found.get("commits", {name: found.get("commit") for name in PARTS})
    for name in options.parts:
        told = getattr(bench, name)()
        found |= told
        commits |= {name: made["commit"]} if told else {}
        print(name, "measured", flush=True)
    return found | made_by(MEASURES) | {"commits": commits}


def shown(data: Mapping[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    from r2h_batch.scene.objects import S0_NAMES

    left_out = {c: v["categories"][c] for v in data["folds"].values() for c in v["left_out"]}
    functional = [v for c, v in left_out.items() if c not in S0_NAMES]
    return {
        "table": rates_table(data),
        "categories_left_out": len(functional),
        "left_out": float(np.mean(functional)),
    }


def rates_table(data: Mapping[str, Any]) -> str:
    """SR and first failures of all weights."""
    lines = [[f"seed {k}", *cells(v)] for k, v in data["seeds"].items()]
    lines.append(["blind", *cells(data["blind"])])
    lines += [[f"left out: {', '.join(v['left_out'])}", *cells(v)] for v in data["folds"].values()]
    lines += [[f"own meshes{words}", *cells(data[f"scans{of}"])] for of, words in OWN_MESHES.items()]
    return markdown_table(["", "S0", "S1"], lines)


OWN_MESHES = {
    ", Intent": ", Intent-Handover",
    "": "",
    ", random": ", random method",
}


def cells(row: Mapping[str, Any]) -> list[str]:
    """SR and first failures of S0 and S1."""
    told = []
    for split in ("s0", "s1"):
        own = row.get(split)
        failed = "" if own is None else "/".join(str(own[k]) for k in ("plan", "reach", "affordance", "safe"))
        told.append("-" if own is None else f"{own['sr']:.1f} ({failed} of {own['of']})")
    return told


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--runs": {"default": Path("runs/learn"), "type": Path, "help": "folder of trainings"},
        "--scans": {"type": Path, "help": "a folder of meshes (.obj) of yours"},
        "--trials": {"default": 500, "help": "of each split"},
        "--scan-trials": {"default": 120, "help": "of each split, on scans"},
        "--parts": {"default": PARTS, "choices": PARTS, "help": "measure these, and keep the others"},
        "--seeds": {"default": len(SEEDS), "help": "how many seeds"},
        "--folds": {"default": len(FOLDS), "help": "how many folds"},
    },
    peer="Intent-Handover and the random method",
    stored="learn",
)

if __name__ == "__main__":
    BENCH.main()
