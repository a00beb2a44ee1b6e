"""Receivers of every size: `python bench/people.py` writes bench/results/people.json and docs/results/people.md.

Dimensions of the built-in people beside ANSUR II, success of the built-in methods by group, and what decides Handover-VA's
plans on a larger hand. Six CPU minutes.
"""

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
from _report import made_by, markdown_table, page_from, swept
from _source import ROOT
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from r2h_batch.config import HOME_Q
from r2h_batch.data.people import GROUPS, built_in_people, people_hand_set
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import random
from r2h_batch.runs.store import Run, load_run
from r2h_batch.trials.benchmark.benchmark import built_in
from r2h_batch.trials.benchmark.build import BenchmarkOverrides
from r2h_batch.trials.protocol import make_trials
from r2h_batch.types import PERSON
from r2h_batch.view.drawing import Drawing, View
from r2h_batch.view.pictures import painter
from r2h_batch.view.stored import judged_again

STORED, PAGE = ROOT / "bench" / "results" / "people.json", ROOT / "docs" / "results" / "people.md"
MEASURES = (
    "assets/people",
    "r2h_batch/data/people.py",
    "r2h_batch/trials/people.py",
    "r2h_batch/trials/receivers.py",
    "r2h_batch/judge/plan.py",
    "r2h_batch/methods",
)
V1 = "r2h-v1"
PARTS = (V1, *GROUPS, "hands", "cost", "picture")
KINEMATIC = ("--sim", "none")
METHODS = ("fc", "handover-va", "contact", "intent", "oracle", "random")

# 5th, 50th, 95th percentile, mm: computed from the public data of the 2012 survey of U.S. Army personnel (ANSUR II; Gordon
# et al. 2014, NATICK/TR-15/007; 4,082 men, 1,986 women), as copied in the repository coleharlow12/ANSURDataAnalysis.
# Seated shoulder: elbow rest height + shoulder-elbow length.
ANSUR = {
    "men": {
        "stature": (1648, 1755, 1870),
        "acromial_height": (1339, 1439, 1546),
        "biacromial_breadth": (384, 415, 447),
        "acromion_radiale": (307, 335, 365),
        "radiale_stylion": (244, 267, 295),
        "iliac_height": (977, 1061, 1148),
        "popliteal_height": (390, 430, 471),
        "seated_shoulder": (558, 608, 662),
        "hand_length": (177, 193, 210),
    },
    "women": {
        "stature": (1525, 1626, 1740),
        "acromial_height": (1242, 1332, 1434),
        "biacromial_breadth": (335, 365, 396),
        "acromion_radiale": (283, 311, 340),
        "radiale_stylion": (218, 240, 268),
        "iliac_height": (918, 993, 1080),
        "popliteal_height": (350, 387, 428),
        "seated_shoulder": (520, 567, 615),
        "hand_length": (165, 180, 199),
    },
}


def counts(run: Run) -> dict[str, Any]:
    """Successes, first failures and what Plan's failures meet, by method and seat."""
    found: dict[str, Any] = {}
    columns = ("outcome", "plan_pair", "plan_reason", "seated", "redrawn")
    for method in run.methods:
        rows = pa.concat_tables(list(run.shards("trials", method, columns))).to_pylist()
        plan = [r for r in rows if r["outcome"] == "plan"]
        found[method.split(" ")[0]] = {
            "n": len(rows),
            "outcomes": dict(Counter(r["outcome"] for r in rows)),
            "plan_pairs": dict(Counter(r["plan_pair"] or "none" for r in plan)),
            "plan_reasons": dict(Counter(r["plan_reason"] for r in plan)),
            "seated": [
                sum(r["outcome"] == "success" for r in rows if r["seated"]),
                sum(bool(r["seated"]) for r in rows),
            ],
            "redrawn": int(sum(r["redrawn"] or 0 for r in rows)),
            "redrawn_trials": int(sum((r["redrawn"] or 0) > 0 for r in rows)),
        }
    return found


ANNY_THUMB, OUR_THUMB = np.array([-0.0647, -0.0525, 0.0482]), np.array([-0.0699, -0.0161, 0.0582])
"""From the thumb's root to its tip: as Anny rests it (the mean adult, in the hand's frame, m), and of the built-in hand."""


def thumbs_at_rest(pose: NDArray[np.float32], side: NDArray[np.int8]) -> NDArray[np.float32]:
    """The postures (H, 48) with the thumb's root turned back to where Anny rests it: palmwards."""
    a, b = (v / np.linalg.norm(v) for v in (OUR_THUMB, ANNY_THUMB))
    axis = np.cross(a, b)
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(a @ b))
    out = pose.astype(np.float64).reshape(-1, 16, 3).copy()
    mirror = np.where(side[:, None] == 1, [[1.0, -1.0, -1.0]], 1.0)
    out[:, 13] = (turn * Rotation.from_rotvec(out[:, 13] * mirror)).as_rotvec() * mirror
    return out.reshape(-1, 48).astype(np.float32)


def hand_files(folder: Path) -> dict[str, list[str]]:
    """Flags of hands for the same bodies of r2h-v1: name -> words of a sweep."""
    model = ROOT / "assets" / "people" / "hand.npz"
    every = built_in_people("all")
    adults = people_hand_set(built_in_people("adults"))
    people = every.by_hand
    length = every.lengths["hand_length"]
    found: dict[str, list[str]] = {"stand-in hand": []}
    poses = {"": adults.pose.numpy()}
    poses[", thumb as Anny rests it"] = thumbs_at_rest(poses[""], adults.side.numpy())
    for mm, how in ((150, ""), (186, ""), (210, ""), (210, ", thumb as Anny rests it")):
        near = people[np.argsort(np.abs(1000 * length[people] - mm), kind="stable")[:20]]
        shape = np.tile(every.hand_shape[near].mean(0), (len(adults), 1))
        file = folder / f"hands_{mm}{len(how)}.npz"
        np.savez(file, pose=poses[how], shape=shape, side=adults.side, posture=np.array(adults.posture))
        found[f"people's hand, {mm} mm{how}"] = ["--hand-model", str(model), "--hands", str(file)]
    return found


def draw(path: Path) -> None:
    """24 receivers of `people: all` from the side of their arm, by stature, with the robot at home."""
    benchmark = BenchmarkOverrides(people="all").read()
    trials = make_trials(trials=120, benchmark=benchmark)
    assert trials.person is not None
    evaluator = Evaluator.from_benchmark(benchmark).kinematic
    order = np.argsort(trials.person[:, PERSON.index("stature_m")].numpy(), kind="stable")
    images = []
    for row in order[np.linspace(0, len(order) - 1, 24).astype(int)].tolist():
        trial = trials[row : row + 1]
        drawing = Drawing(judged_again(evaluator, trial, random.predict(trial, evaluator.scene, seed=0), "random"))
        left = int(benchmark.hand_set.side[trial.hand_index.long()]) == 1
        view = View(np.array([0.4, 0, 0.1]), 112 if left else -112, -12, 2.4)
        with painter(drawing, (300, 300), view) as paint:
            images.append(paint(np.array(HOME_Q)))
    lines = [np.concatenate(images[k : k + 6], 1) for k in range(0, len(images), 6)]
    Image.fromarray(np.concatenate(lines, 0)).quantize(128).save(path, optimize=True)


def cost(rounds: int = 7, trials: int = 64) -> dict[str, float]:
    """Median core milliseconds a trial, by turns: judging the same answers of `random` without motions, and drawing."""
    found: dict[str, list[float]] = {}
    made = {"r2h-v1": built_in(), "adults": BenchmarkOverrides(people="adults").read()}
    evaluators = {name: Evaluator.from_benchmark(b).kinematic for name, b in made.items()}
    for turn in range(rounds + 1):
        for name, benchmark in made.items():
            begin = time.process_time()
            drawn = make_trials(trials=trials, benchmark=benchmark)
            middle = time.process_time()
            answers = random.predict(drawn, evaluators[name].scene, seed=0)
            start = time.process_time()
            evaluators[name].score(answers.T_obj_ee, answers.T_world_ee, drawn)
            end = time.process_time()
            if turn:  # the first turn loads tables and kernels
                found.setdefault(f"{name}, drawing", []).append(middle - begin)
                found.setdefault(f"{name}, judging", []).append(end - start)
    return {name: round(1000 * float(np.median(s)) / (2 * trials), 3) for name, s in found.items()}


def of_group(group: str, options: argparse.Namespace) -> dict[str, Any]:
    """Counts of the methods on a group's trials, or on those of r2h-v1."""
    words = [] if group == V1 else ["--people", group]
    with TemporaryDirectory() as folder:
        run = swept(Path(folder) / "run", "--method", *options.methods, *words, "--trials", options.trials, *KINEMATIC)
        return counts(load_run(run))


def of_hands(options: argparse.Namespace) -> dict[str, Any]:
    """Counts of Handover-VA on the bodies of r2h-v1 with other hands."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        line = ("--method", "handover-va", "--trials", options.trials, *KINEMATIC)
        runs = {
            hand: swept(folder / f"run{k}", *line, *words) for k, (hand, words) in enumerate(hand_files(folder).items())
        }
        return {hand: counts(load_run(run)) for hand, run in runs.items()}


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The figures of the page, or of the parts that `--only` names, beside the stored ones."""
    data: dict[str, Any] = {"groups": {}}
    if options.only:
        data = json.loads(STORED.read_text()) if STORED.exists() else data
    for part in options.only or PARTS:
        if part in (V1, *GROUPS):
            data["groups"][part] = of_group(part, options)
        elif part == "hands":
            data["hands"] = of_hands(options)
        elif part == "cost":
            data["cost_ms"] = cost()
        else:
            draw(PAGE.with_name("people.png"))
    people = json.loads((ROOT / "assets" / "people" / "report.json").read_text())
    return {**data, "trials": options.trials, "people": people, **made_by(MEASURES)}


LEFT_OUT = """FC-Handover, Contact-Handover and Intent-Handover see receiving grasps of this hand, and were not measured here.

"""
HEAD = """\
# Receivers of every size: results

Look up how people of every size are served ([what they are](../people.md)). `python bench/people.py` measured all figures
(bench/results/people.json, commit {commit}), {trials} trials a split, without simulated motions.

![24 receivers by stature, from the side of their arm](people.png)

## Success

SR in %, both splits together. `Redrawn`: trials in which no posture fitted the first person. r2h-v1 is the protocol without
people.

{success}

{left_out}Losses of the oracle, the upper bound: {losses}.

## Why Handover-VA fails more often on a larger hand

The same bodies (r2h-v1) and joint angles, on other hands. The shape hardly matters: a hand of people that is as long as the
stand-in (186 mm) fails as often. Size does: gripper and object meet larger hands more often. So does the thumb: where it rests
palmwards, as Anny has it, it stands in the way of object and gripper. This package turns it to the stand-in's rest.
Failures of Handover-VA's plans, by what collides at start or goal:

{hands}

## Cost

Core milliseconds a trial (`random`, no motion, shared machine), median of seven turns: {cost}.

## Dimensions

5th, 50th and 95th percentile, mm. ANSUR II: the public data of the 2012 survey of U.S. Army personnel (4,082 men, 1,986 women;
Gordon et al. 2014), who are younger and fitter than a population. Ours are measured on Anny's bodies: the hand from the joint
of the wrist (ANSUR II: from the stylion), the shoulder from its joint. Anny's upper arms are shorter and its men's hands
longer than ANSUR II's. Iliac height, popliteal height and seated shoulder were fitted to ANSUR II's medians: these
rows show the fit and validate nothing.

{dimensions}

Children: ours alone. No published table of these lengths could be looked up.

{children}

## What the shapes hold

Capsules and box hold the skin of a person but for a few percent. `outside`: how far the rest stands out. `overshoot`: from
the shape's surface to the nearest vertex of the body.

{shapes}
"""


def markdown(data: dict[str, Any]) -> str:
    """The page."""
    people, groups = data["people"], {g: data["groups"][g] for g in (V1, *GROUPS)}
    names = list(next(iter(groups.values())))
    success = [
        [group, *(f"{_sr(found[m]):.1f}" for m in names), found[names[0]]["redrawn_trials"]]
        for group, found in groups.items()
    ]
    losses = "; ".join(f"{group}: {_losses(found['oracle'])}" for group, found in groups.items())
    pairs = sorted({p for found in data["hands"].values() for m in found.values() for p in m["plan_pairs"]})
    hands = [
        [hand, f"{_sr(m):.1f}", m["outcomes"].get("plan", 0), *(m["plan_pairs"].get(p, 0) for p in pairs)]
        for hand, found in data["hands"].items()
        for m in found.values()
    ]
    dimensions = [
        [
            name.replace("_", " "),
            *(
                _three(x)
                for who in ("men", "women")
                for x in (people["groups"][f"adults, {who}"][name], ANSUR[who][name])
            ),
        ]
        for name in ANSUR["men"]
    ]
    children = [
        [name.replace("_", " "), *(_three(people["groups"][f"children, {who}"][name]) for who in ("boys", "girls"))]
        for name in ANSUR["men"]
    ]
    shapes = [
        [
            group,
            part.replace("_", " "),
            f"{100 * f['skin_held_share']:.1f}",
            f["skin_outside_max_mm"],
            f["overshoot_mean_mm"],
            f["overshoot_p95_mm"],
        ]
        for group, parts in people["shapes"].items()
        for part, f in parts.items()
    ]
    return HEAD.format(
        commit=str(data["commit"])[:12],
        trials=data["trials"],
        success=markdown_table(["Receivers", *names, "Redrawn"], success),
        losses=losses,
        left_out="" if len(names) == len(METHODS) else LEFT_OUT,
        cost=", ".join(f"{name} {ms}" for name, ms in data["cost_ms"].items()),
        hands=markdown_table(["Hand", "SR", "Plan fails", *(p.replace("_", " ") for p in pairs)], hands),
        dimensions=markdown_table(["", "men", "men, ANSUR II", "women", "women, ANSUR II"], dimensions),
        children=markdown_table(["", "boys", "girls"], children),
        shapes=markdown_table(
            ["Group", "Shape", "held, %", "outside, mm", "overshoot, mm", "overshoot 95 %, mm"], shapes
        ),
    )


def _sr(found: dict[str, Any]) -> float:
    return 100 * float(found["outcomes"].get("success", 0)) / int(found["n"])


def _three(values: Any) -> str:
    return " / ".join(map(str, values))


def _losses(found: dict[str, Any]) -> str:
    lost = {k: v for k, v in found["outcomes"].items() if k != "success"}
    if not lost:
        return "none"
    reasons = ", ".join(f"{v} {k}" for k, v in found["plan_reasons"].items())
    return ", ".join(f"{v} {k}" for k, v in lost.items()) + (f" ({reasons})" if reasons else "") + f" of {found['n']}"


def main() -> None:
    """Measures, or writes the page again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100, help="of each split")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=(), help="measure these parts, keep the others")
    parser.add_argument("--methods", nargs="+", default=METHODS)
    page_from(parser, STORED, PAGE, measure, markdown)


if __name__ == "__main__":
    main()
