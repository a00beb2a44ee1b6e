"""A method that learned (`r2h-batch train rank`): docs/results/questions.md.

`python bench/learn.py --runs FOLDER [--scans FOLDER]` trains three seeds and four folds of left-out categories into the folder,
or goes on there, and judges what they choose on r2h-v2, motion as planned. SCANS: a folder of meshes of yours. Part `recipes`
trains without two of the folds and judges on new instances of these, to choose a recipe by.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from _report import ROOT, Report, made_by, markdown_table, memory_over
from _rows import over_categories, paired_over_categories
from run import Bench

if TYPE_CHECKING:
    from r2h_batch import Evaluator, Trials
    from r2h_batch.scene.objects import ObjectModel
    from r2h_batch.trials.benchmark import Benchmark
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
STEPS = 30
NEAR = 192
"""Pairs of the second round."""
STREAMED = 10**7
"""Pairs over which memory is measured."""
REGIONS, TRIALS_OF_REGIONS = "* x 2 seed 77", 1000
"""Instances that no network learned from, each with four regions at random; their trials."""
RECIPES: dict[str, dict[str, Any]] = {
    "12 items, 2 rounds": {"items": 12, "steps": 800, "rounds": 2, "mined_steps": 250},
    "24 items, 3 rounds": {"items": 24, "steps": 1200, "rounds": 3, "mined_steps": 300},
}
"""Recipes that were compared before one of them became the default of `train rank`."""
CHOSEN_BY, CHOICE = (1, 3), "{} x 4 seed 78"
"""Folds without which they are trained; instances of these on which they are compared."""
OWN_TRIALS, REGION_TRIALS = 400, 500
"""Trials with these instances as they are, and with regions at random."""
OTHER_ID = 1 << 50
"""The first id of trials that no benchmark and no training of this bench has."""
COSTLY = "families:* x 2 seed 71"
"""Instances whose cost is measured."""
SHORT = (
    *("--families", "* x 2 seed 72", "--regions", "1", "--items", "6", "--steps", "400"),
    *("--rounds", "1", "--mined-items", "2", "--mined-steps", "100"),
)
"""A training of the notebook's size."""
TRAININGS = {
    "one process": ("--workers", "0"),
    "two processes": ("--workers", "1"),
    "two processes, --renew 3": ("--workers", "1", "--renew", "3"),
}
SAME_WEIGHTS = ("one process", "two processes")
GRASPS_OF = ("drawn for the instance", "drawn for the region")
"""Grasp candidates that the ranker chooses from."""
KINDS = ("a part", "all but a part", "one side of a plane")
ROWS = ROOT / "r2h_batch" / "report" / "compare" / "rows" / "r2h-v2"
BESIDE = ("learned", "intent")
"""Shipped rows whose objects receivers try to take; the first is compared with the second."""
HANDED = ("received", "received and success")
SPREAD = ("S0", "S1", "S0+S1")
"""Splits that a row of the table is of."""


def trained(place: Path, seed: int, leave_out: Sequence[str], **other: Any) -> tuple[Path, dict[str, float]]:
    """Weights, and CPU seconds of the parts of their training; `other` than the default recipe."""
    from r2h_batch import load_benchmark
    from r2h_batch.training.rank import CHECKPOINT, Recipe, train_ranker

    default = Recipe()
    changed = [f"{k}{v}" for k, v in other.items() if v != getattr(default, k)]
    name = "-".join([f"seed{seed}", *changed, *leave_out])
    path = train_ranker(load_benchmark("r2h-v2"), Recipe(seed=seed, leave_out=tuple(leave_out), **other), place / name)
    spent: dict[str, float] = torch.load(place / name / CHECKPOINT, weights_only=True)["spent"]
    return path, spent


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


def kind_of_region(model: "ObjectModel") -> str:
    """Which of `KINDS` a region is."""
    own, rest = ({*model.face_part[face].tolist()} for face in (model.receiver_face, ~model.receiver_face))
    if own & rest:
        return KINDS[2]
    return KINDS[0] if len(own) == 1 else KINDS[1]


@cache
def is_free_of_region(model: "ObjectModel") -> bool:
    """Whether any grasp that 8 rounds of proposals find keeps off the receiver's region."""
    from r2h_batch.methods.grasps import REGION_CLEARANCE_M, NoGraspError, sample_grasps

    try:  # of so few, those off the region are taken first
        found = sample_grasps(model, count=10, enough=sys.maxsize)
    except NoGraspError:
        return False
    return bool((found.region_m > REGION_CLEARANCE_M).any())


def region_limits(own: "Benchmark", path: Path) -> dict[str, dict[str, float]]:
    """Limits of a ranker on a benchmark's objects, percent of trials by kind of region, pose stage.

    Keys: `of` trials; `learned`: the pair that it likes best; `a pair`: one of its 384 pairs; `oracle`: a proposal of the
    oracle; `held`: some candidate passes Stability and Affordance, wherever it is brought; `denser`: or one of some 100,000
    grasps does that are sampled for the region.
    """
    from r2h_batch.base import rng
    from r2h_batch.methods import oracle
    from r2h_batch.methods.candidates import candidates_in, without_candidates
    from r2h_batch.methods.learned import FIRST, PER_CANDIDATE, TOP
    from r2h_batch.methods.ranker.features import SEE
    from r2h_batch.methods.ranker.network import read_weights
    from r2h_batch.methods.ranker.observe import observe
    from r2h_batch.methods.ranker.search import liked, scored_by

    none = without_candidates(Evaluator(own, threads=1).scene)
    own = own.with_objects([o for k, o in enumerate(own.objects) if k not in none])
    judge = Evaluator(own, threads=1)
    trials = own.trials_with_ids(OTHER_ID + 1 + 2 * torch.arange(TRIALS_OF_REGIONS))  # odd ones: S1
    kinds = np.array([kind_of_region(o) for o in judge.scene.objects])[trials.object_index.numpy()]
    score, key = scored_by(read_weights(path)), rng.key_of("learned 0")
    grasps = [torch.from_numpy(c.T_obj_ee) for c in candidates_in(judge.scene)]
    learned, pair, held = (np.zeros(len(trials), bool) for _ in range(3))
    for n in range(len(trials)):
        trial = trials[n : n + 1]
        told, middle = observe(trial, judge.scene, SEE, seed=0, region=True)
        seen = {k: v[:, : int(told["exists"].sum())] if k in PER_CANDIDATE else v for k, v in told.items()}
        pick, T, good = liked(seen, middle, trial.trial_id, score, key, first=FIRST, second=0, top=TOP)
        found = judge.score(seen["candidates"][:, pick[0]], T, trial, stages="pose")
        won = found.success.numpy()
        learned[n], pair[n] = won[int(good.argmax())], won.any()
        own_grasps = grasps[int(trial.object_index)]
        margin = judge.score(
            own_grasps[None], T[:, :1].expand(-1, len(own_grasps), -1, -1), trial, stages="pose"
        ).margin
        columns = [found.criteria.index(name) for name in ("stability", "affordance")]
        held[n] = bool((margin[:, columns] >= 0).all(1).any())
    best = oracle.predict(trials, judge.scene, evaluator=judge)
    by_oracle = judge.score(best.T_obj_ee, best.T_world_ee, trials, stages="pose").success.numpy()
    index = trials.object_index.numpy()
    without = [o for k, o in enumerate(own.objects) if not held[index == k].any()]
    free = {o.name for o in without if is_free_of_region(o)}
    denser = held | np.array([own.objects[k].name in free for k in index])
    rows = {"learned": learned, "a pair": pair, "oracle": by_oracle, "held": held, "denser": denser}
    return {
        kind: {"of": int(own_rows.sum()), **{name: 100 * float(won[own_rows].mean()) for name, won in rows.items()}}
        for kind in KINDS
        if (own_rows := kinds == kind).any()
    }


def labels_a_second() -> dict[str, float]:
    """Labels a CPU second: in the whole loop of the default stream, with 64 pairs a trial, and of `score` alone."""
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
    drawn = stream(load_benchmark("r2h-v2"), "* x 5 seed 5")
    item = drawn.item(3)
    trials = drawn.benchmark.trials_with_ids(item["trial_id"])
    start = time.process_time()
    for _ in range(6):
        drawn.evaluator.kinematic.score(item["T_obj_ee"], item["T_world_ee"], trials, stages="pose")
    return told | {"score alone": 6 * item["success"].numel() / (time.process_time() - start)}


def step_profile(place: Path) -> dict[str, float]:
    """Shares of a training step's CPU time, percent, of torch's operators above 3 %."""
    from torch.profiler import profile

    from r2h_batch import load_benchmark
    from r2h_batch.methods.ranker import features
    from r2h_batch.training.pairs import stream
    from r2h_batch.training.rank import PAIRS, POSES, Lessons, Recipe, Training

    pairs = stream(load_benchmark("r2h-v2"), "cup,hammer x 2 seed 5", pairs=PAIRS, poses=POSES, see=features.SEE)
    training = Training(Recipe(), pairs, place / "none", print, lambda numbers, step: None)
    training.lessons = [Lessons.of([pairs.item(0)], POSES)]
    training.learn()
    with profile() as found:
        for _ in range(STEPS):
            training.learn()
    own = {e.key: float(e.self_cpu_time_total) for e in found.key_averages()}
    every = sum(own.values())
    shares = {k: 100 * v / every for k, v in sorted(own.items(), key=lambda x: -x[1])}
    return {"ms a step": every / 1000 / STEPS} | {k: v for k, v in shares.items() if v > 3}


def handed_over(folder: Path, trials: int) -> dict[str, Any]:
    """Whether the stored rows' first trials of each split are received, also with success; of both methods, and paired on the
    trial."""
    from r2h_batch.judge.reception import reception
    from r2h_batch.report.compare.stored import load_rows
    from r2h_batch.sweep.results.judge import Judge
    from r2h_batch.sweep.results.questions import judged, parts

    run = load_rows(folder).only(BESIDE)
    judge = Judge(run)
    scene, asked = judge.evaluator.scene, judge.trials(np.arange(2 * trials))
    ends: dict[str, dict[str, np.ndarray]] = {}
    for name in sorted(run.methods, key=lambda n: [n.lower().startswith(word) for word in BESIDE], reverse=True):
        own = {k: np.zeros(2 * trials, bool) for k in ("success", "received")}
        for part in parts(run, name):
            (trial_id, scores), won = judged(judge, part), part.success
            first = np.flatnonzero(trial_id < 2 * trials)
            some = scores[torch.from_numpy(first)]
            own["success"][trial_id[first]] = [won[i] for i in trial_id[first].tolist()]
            own["received"][trial_id[first]] = reception(some).received.numpy()
        ends[name.partition(" (")[0]] = own | {"received and success": own["received"] & own["success"]}
        print(name, {k: int(v.sum()) for k, v in own.items()}, flush=True)
    splits = np.array(asked.splits)
    kinds = np.array([scene.objects[i].category for i in asked.object_index.tolist()])
    rates = {
        name: {s: {k: over_categories(own[k], splits, kinds, s) for k in HANDED} for s in SPREAD}
        for name, own in ends.items()
    }
    ours, theirs = ends.values()
    paired = {s: {k: paired_over_categories(ours[k], theirs[k], splits, kinds, s) for k in HANDED} for s in SPREAD}
    return {"of": trials, "rates": rates, "paired": paired}


def generator(place: Path) -> dict[str, Any]:
    """The result of examples/train_generator.py as it is printed."""
    sys.path.insert(0, str(ROOT / "examples"))
    from train_generator import main

    return main(["--out", str(place / "generator")])


def policy() -> dict[str, Any]:
    """The result of examples/learn_ppo.py as it is printed."""
    sys.path.insert(0, str(ROOT / "examples"))
    from learn_ppo import main

    return main([])


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
            objects = [one.drawn() for one in planned]
            mesh = time.process_time()
            for one in objects:
                candidates_of((one,), "filtered", robot)
            end = time.process_time()
            found[name] = (end - start) / len(planned)
            found[f"{name}, candidates"] = (end - mesh) / len(planned)
    finally:
        os.environ.pop("R2H_BATCH_CACHE")
        if before is not None:
            os.environ["R2H_BATCH_CACHE"] = before
    return found


def from_nothing(place: Path) -> dict[str, Any]:
    """Wall and CPU seconds of trainings that begin with an empty cache, by who draws the instances."""
    found: dict[str, Any] = {}
    for name, words in TRAININGS.items():
        out, cache = place / "from nothing" / name, place / "from nothing" / f"{name}, cache"
        for folder in (out, cache):
            shutil.rmtree(folder, ignore_errors=True)
        before, start = os.times(), time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "r2h_batch", "train", "rank", "--out", str(out), *SHORT, *words],
            check=True, env={**os.environ, "R2H_BATCH_CACHE": str(cache)}, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        after = os.times()
        cpu = after.children_user + after.children_system - before.children_user - before.children_system
        found[name] = {"wall s": time.perf_counter() - start, "cpu s": cpu}
        print(name, found[name], flush=True)
    weights = [(place / "from nothing" / name / "rank.safetensors").read_bytes() for name in SAME_WEIGHTS]
    return found | {"same": weights[0] == weights[1]}


def memory() -> dict[str, Any]:
    """Resident MiB while a stream gives `STREAMED` pairs, after each tenth."""
    from r2h_batch import load_benchmark
    from r2h_batch.training import stream

    items = iter(stream(load_benchmark("r2h-v2"), "* x 5 seed 5"))
    return memory_over(STREAMED, lambda done: next(items)["success"].numel())


def same_for_workers() -> bool:
    """Whether 0, 1 and 2 workers give the same items, bit for bit."""
    from torch.utils.data import DataLoader

    from r2h_batch import load_benchmark
    from r2h_batch.training import stream

    pairs = stream(load_benchmark("r2h-v2"), "cup,hammer x 2 seed 5", items=6, trials=32)
    runs = [[*DataLoader(pairs, batch_size=None, num_workers=w)] for w in (0, 1, 2)]
    same = [
        torch.equal(a[k].nan_to_num(), b[k].nan_to_num())
        for run in runs[1:]
        for a, b in zip(runs[0], run, strict=True)
        for k in a
    ]
    return len(same) > 100 and all(same)


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

    def judged(self, path: Path | None, trials: "Trials", judge: "Evaluator", **more: Any) -> dict[str, Any]:
        """Rates of weights (None: those that ship) on trials, and CPU milliseconds of an answer."""
        from r2h_batch.methods import learned

        start = time.process_time()
        answers = learned.predict(trials, judge.scene, weights=str(path or ""), **more)
        spent = 1000 * (time.process_time() - start) / len(trials)
        told = rates(judge, trials, answers) | {"ms": spent}
        rounded = {k: round(told[k]["sr"], 1) for k in ("s0", "s1") if k in told}
        print(path and path.parent.name, more, rounded, flush=True)
        return told

    def seeds(self) -> dict[str, Any]:
        """Each seed on the benchmark."""
        found: dict[str, Any] = {"trials": self.options.trials, "seeds": {}, "spent": {}}
        for seed in SEEDS[: self.options.seeds]:
            path, found["spent"][f"seed {seed}"] = trained(self.options.runs, seed, ())
            found["seeds"][str(seed)] = self.judged(path, self.some, self.evaluator)
            found["bytes"] = path.stat().st_size
        return found

    def variants(self) -> dict[str, Any]:
        """The first seed with a second round, and blind."""
        path, _ = trained(self.options.runs, 0, ())
        return {
            "second round": self.judged(path, self.some, self.evaluator, second=NEAR),
            "blind": self.judged(path, self.some, self.evaluator, region="hidden"),
        }

    def folds(self) -> dict[str, Any]:
        """Networks that never saw some categories, on these alone."""

        names = [o.who.category for o in self.benchmark.objects]
        found: dict[str, Any] = {"folds": {}, "spent of folds": {}}
        for fold, out in enumerate(FOLDS[: self.options.folds]):
            path, found["spent of folds"][f"fold {fold}"] = trained(self.options.runs, 0, out)
            own = torch.tensor([names[i] in out for i in self.some.object_index.tolist()])
            found["folds"][str(fold)] = self.judged(path, self.some[own], self.evaluator) | {"left_out": out}
        return found

    def scans(self) -> dict[str, Any]:
        """The first seed on meshes of a folder, beside Intent-Handover and the random method; nothing without a folder."""
        from r2h_batch.methods import intent, random

        if self.options.scans is None:
            return {}
        judge = scans(self.options.scans)
        path, _ = trained(self.options.runs, 0, ())
        some = judge.scene.benchmark.trials(self.options.scan_trials)
        return {
            "scans": self.judged(path, some, judge) | {"objects": len(judge.scene.objects)},
            "scans, second round": self.judged(path, some, judge, second=NEAR),
            "scans, random": rates(judge, some, random.predict(some, judge.scene)),
            "scans, Intent": rates(judge, some, intent.predict(some, judge.scene)),
        }

    def regions(self) -> dict[str, Any]:
        """The first seed on regions at random of instances that it did not see, by their kind: with the instance's candidates,
        and with candidates drawn for the region, as an object of the user's has them."""
        from dataclasses import replace

        from r2h_batch.methods.learned import weights_file
        from r2h_batch.training.instances import training_objects
        from r2h_batch.training.regions import with_regions

        plain = training_objects(self.benchmark, REGIONS)
        ways: dict[str, Any] = {}
        objects = with_regions(plain, 4)[len(plain) :]
        for name, some in zip(GRASPS_OF, (objects, [replace(o, turn=None) for o in objects]), strict=True):
            with weights_file("") as path:
                ways[name] = region_limits(self.benchmark.with_objects(some), path)
            print(name, ways[name], flush=True)
        return {"regions": {"objects": len(plain), "trials": TRIALS_OF_REGIONS, "ways": ways}}

    def regions_of(self, plain: "tuple[ObjectModel, ...]", count: int, path: Path) -> dict[str, Any]:
        """Success of the pose stage, percent, on instances with four regions at random each: all, and by kind of region."""
        from r2h_batch.methods import learned
        from r2h_batch.training.regions import with_regions

        own = self.benchmark.with_objects(with_regions(plain, 4)[len(plain) :])
        judge = Evaluator(own, threads=1)
        trials = own.trials_with_ids(OTHER_ID + 1 + 2 * torch.arange(count))  # odd ones: S1
        kinds = np.array([kind_of_region(o) for o in judge.scene.objects])[trials.object_index.numpy()]
        answers = learned.predict(trials, judge.scene, weights=str(path))
        won = judge.score(answers.T_obj_ee, answers.T_world_ee, trials, stages="pose").success.numpy()
        return {
            "all": 100 * float(won.mean()), "trials": count,
            "kinds": {k: {"sr": 100 * float(won[kinds == k].mean()), "of": int((kinds == k).sum())} for k in KINDS},
        }  # fmt: skip

    def recipes(self) -> dict[str, Any]:
        """Each recipe without some categories, on new instances of these: what a recipe was chosen by."""
        from r2h_batch.methods import learned
        from r2h_batch.training.instances import training_objects

        found: dict[str, Any] = {name: {} for name in RECIPES}
        for fold in CHOSEN_BY:
            plain = training_objects(self.benchmark, CHOICE.format(",".join(FOLDS[fold])))
            own = self.benchmark.with_objects(plain)
            judge = Evaluator(own, threads=1)
            trials = own.trials_with_ids(OTHER_ID + torch.arange(OWN_TRIALS))
            functional = np.array(trials.splits) == "S1"
            for name, recipe in RECIPES.items():
                path, _ = trained(self.options.runs, 0, FOLDS[fold], **recipe)
                answers = learned.predict(trials, judge.scene, weights=str(path))
                won = judge.score(answers.T_obj_ee, answers.T_world_ee, trials, stages="pose").success.numpy()
                own_regions = {
                    s: 100 * float(won[rows].mean()) for s, rows in (("s0", ~functional), ("s1", functional))
                }
                at_random = self.regions_of(plain, REGION_TRIALS, path)
                found[name][str(fold)] = {**own_regions, "at random": at_random["all"]}
                print(name, fold, found[name][str(fold)], flush=True)
        return {"recipes": found}

    def costs(self) -> dict[str, Any]:
        """Labels a second, a step's profile, workers."""
        return {
            "labels": labels_a_second(),
            "step": step_profile(self.options.runs),
            "workers": same_for_workers(),
        }

    def received(self) -> dict[str, Any]:
        """Whether receivers can take, and do take, what it hands over."""
        return {"received": handed_over(ROWS, self.options.received)}

    def drawing(self) -> dict[str, Any]:
        """Costs of instances, and trainings from nothing."""
        place = self.options.runs.absolute()
        return {
            "drawing": {"instance": instance_cost(place), "trainings": from_nothing(place), "load": os.getloadavg()[0]}
        }

    def policy(self) -> dict[str, Any]:
        """The policy that the example learns by PPO, beside the servo that it begins as."""
        return {"policy": policy()}

    def generator(self) -> dict[str, Any]:
        """The generator of the examples."""
        return {"generator": generator(self.options.runs)}

    def memory(self) -> dict[str, Any]:
        """Memory of a long stream."""
        return {"memory": memory()}


PARTS = (
    *("seeds", "variants", "folds", "scans", "regions", "recipes", "costs"),
    *("received", "generator", "policy", "memory", "drawing"),
)


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
        "--received": {"default": 500, "help": "of each split, whose objects receivers try to take"},
        "--parts": {"default": PARTS, "choices": PARTS, "help": "measure these, and keep the others"},
        "--seeds": {"default": len(SEEDS), "help": "how many seeds"},
        "--folds": {"default": len(FOLDS), "help": "how many folds"},
    },
    peer="Intent-Handover and the random method; the servo; random pairs",
    stored="learn",
)

if __name__ == "__main__":
    BENCH.main()
