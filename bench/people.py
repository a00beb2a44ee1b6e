"""Receivers of every size: docs/results/questions.md.

Dimensions of the built-in people beside ANSUR II, success of the built-in methods by group, and what decides Handover-VA's
plans on a larger hand. Six CPU minutes.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
from _report import Report, made_by, markdown_table, swept
from _source import ROOT
from numpy.typing import NDArray
from PIL import Image
from run import Bench
from scipy.spatial.transform import Rotation

from r2h_batch import load_benchmark
from r2h_batch.assets.hand.build_handset import JOINT_RANGE_DEG, draw_angles, mirrored, pose_from_angles
from r2h_batch.config import HOME_Q
from r2h_batch.data.people import GROUPS, WHEELCHAIR, built_in_people, hand_lengths, people_hand, people_hand_set
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.reception import reception
from r2h_batch.methods import contact, fc, handover_va, intent, oracle, random
from r2h_batch.runs.store import Run, load_run
from r2h_batch.scene.arrays import asset, read_arrays
from r2h_batch.scene.hand import load_hand, load_hand_set
from r2h_batch.scene.objects import load_objects
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.edit import edited
from r2h_batch.types import PERSON
from r2h_batch.view.drawing import Drawing, View
from r2h_batch.view.pictures import painter
from r2h_batch.view.stored import judged_again

STORED, PICTURE = ROOT / "bench" / "results" / "people.json", ROOT / "docs" / "results" / "people.png"
MEASURES = (
    "assets/people",
    "r2h_batch/data/people.py",
    "r2h_batch/trials/draw/people.py",
    "r2h_batch/trials/draw/receivers.py",
    "r2h_batch/trials/draw/wheelchair.py",
    "r2h_batch/trials/holding",
    "r2h_batch/judge/plan.py",
    "r2h_batch/judge/reception.py",
    "r2h_batch/methods",
)
V1 = "r2h-v1"
RECEIVERS = (*GROUPS, WHEELCHAIR)
PARTS = (V1, *RECEIVERS, "hands", "reception", "cost", "picture")
KINEMATIC = ("--execute.sim", "none")
METHODS = ("fc", "handover-va", "contact", "intent", "oracle", "random")
FOUR = {fc.TITLE: fc, handover_va.TITLE: handover_va, contact.TITLE: contact, intent.TITLE: intent}
RECEIVED = ("cup", "bowl", "hammer", "bottle")
"""Objects whose reception is asked: the people's held-out grasps are sampled at first use, a CPU minute an object."""

CDC = {"boys": (1149, 1329, 1518), "girls": (1145, 1325, 1529)}
"""Stature of children of 6 to 12 years, mm: stature for age of the CDC growth charts (2000, statage.csv), its LMS distributions
of these 72 months mixed evenly; 5th, 50th, 95th percentile."""

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


THUMB, POSTURES = ", thumb as Anny rests it", ", other postures"
OTHER_POSTURES = ("open_flat", "cupped", "grip_cylinder", "pinch", "relaxed")


def drawn_again(axes: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """200 postures a side of `OTHER_POSTURES`, from the built-in set's ranges and other random numbers, as turns about a hand's
    axes."""
    pose, kinds = [], [OTHER_POSTURES[i % len(OTHER_POSTURES)] for i in range(200)] * 2
    for i, kind in enumerate(kinds):
        rng = np.random.default_rng([41, i])
        angles = draw_angles(rng, kind)
        while ((angles < JOINT_RANGE_DEG[..., 0]) | (angles > JOINT_RANGE_DEG[..., 1])).any():
            angles = draw_angles(rng, kind)
        right = pose_from_angles(angles, axes)
        pose.append(mirrored(right) if i >= 200 else right)
    side = np.repeat(np.arange(2, dtype=np.int8), 200)
    return {"pose": np.asarray(pose, np.float32), "side": side, "posture": np.array(kinds)}


def stand_ins(folder: Path) -> dict[str, list[str]]:
    """Flags of the built-in hand with other postures, and of its built-in postures as long as a tall man's hand."""
    hand, hands = load_hand(), load_hand_set()
    axes, none = hand.joint_axes.double().numpy(), np.zeros((400, 10), np.float32)
    np.savez(folder / "drawn_again.npz", shape=none, allow_pickle=False, **drawn_again(axes))
    stored = dict(read_arrays(asset("hand", "hand.npz")))
    length = float(hand_lengths(hand, none[:1])[0])
    for name in ("vertices", "shape_basis", "joints_rest", "joint_shape_basis"):
        stored[name] = (stored[name] * (0.210 / length)).astype(stored[name].dtype)
    np.savez(folder / "long.npz", allow_pickle=False, **stored)
    np.savez(
        folder / "as_built_in.npz",
        pose=hands.pose.numpy(),
        shape=hands.shape.numpy(),
        side=hands.side.numpy(),
        posture=np.array(hands.posture),
    )
    return {
        f"stand-in hand{POSTURES}": ["--hands", str(folder / "drawn_again.npz")],
        "stand-in hand, stretched to 210 mm": [
            *("--hand-model", str(folder / "long.npz")),
            *("--hands", str(folder / "as_built_in.npz")),
        ],
    }


def hand_files(folder: Path) -> dict[str, list[str]]:
    """Flags of hands for the same bodies of r2h-v1: name -> words of a sweep."""
    model = ROOT / "assets" / "people" / "hand.npz"
    every = built_in_people("all")
    adults = people_hand_set(built_in_people("adults"))
    people = every.by_hand
    length = every.lengths["hand_length"]
    found: dict[str, list[str]] = {"stand-in hand": [], **stand_ins(folder)}
    poses = {"": adults.pose.numpy()}
    poses[THUMB] = thumbs_at_rest(poses[""], adults.side.numpy())
    for mm, how in ((150, ""), (186, ""), (210, ""), (210, THUMB)):
        near = people[np.argsort(np.abs(1000 * length[people] - mm), kind="stable")[:20]]
        shape = np.tile(every.hand_shape[near].mean(0), (len(adults), 1))
        file = folder / f"hands_{mm}{len(how)}.npz"
        np.savez(file, pose=poses[how], shape=shape, side=adults.side, posture=np.array(adults.posture))
        found[f"people's hand, {mm} mm{how}"] = ["--hand-model", str(model), "--hands", str(file)]
    again = drawn_again(people_hand().joint_axes.double().numpy())
    again["pose"] = thumbs_at_rest(again["pose"], again["side"])
    np.savez(folder / "all_three.npz", shape=shape, allow_pickle=False, **again)
    all_three = f"people's hand, {mm} mm{how}{POSTURES}"
    return found | {all_three: ["--hand-model", str(model), "--hands", str(folder / "all_three.npz")]}


def draw(path: Path) -> None:
    """24 receivers of `people: all` from the side of their arm, by stature, with the robot at home."""
    benchmark = edited(BenchmarkChoice(people="all"))
    trials = benchmark.trials(120)
    assert trials.person is not None
    evaluator = Evaluator(benchmark).kinematic
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


def cost(rounds: int = 7, trials: int = 64) -> dict[str, Any]:
    """Core milliseconds of a trial by turns, and adults' over r2h-v1's of each turn: drawing, and judging the oracle's answers
    without motions (all are successes in both, so that outcomes do not differ)."""
    made = {V1: load_benchmark("r2h-v1"), "adults": edited(BenchmarkChoice(people="adults"))}
    judged: dict[str, Callable[[], object]] = {}
    for name, benchmark in made.items():
        evaluator = Evaluator(benchmark, threads=1).kinematic
        drawn = benchmark.trials(trials)
        answer = oracle.predict(drawn, evaluator.scene, seed=0, evaluator=evaluator)
        judged[name] = partial(evaluator.score, answer.T_obj_ee, answer.T_world_ee, drawn)
    drawing = {name: partial(b.trials, trials) for name, b in made.items()}
    found: dict[str, Any] = {}
    for what, calls in (("drawing", drawing), ("judging", judged)):
        times: dict[str, list[float]] = {name: [] for name in calls}
        for turn in range(rounds + 1):
            for name, call in calls.items():
                begin = time.process_time()
                call()
                if turn:  # the first turn loads tables and kernels
                    times[name].append(time.process_time() - begin)
        ratios = [b / a for a, b in zip(times[V1], times["adults"], strict=True)]
        found[what] = {name: 1000 * float(np.median(s)) / (2 * trials) for name, s in times.items()}
        found[what] |= {"ratio": float(np.median(ratios)), "low": min(ratios), "high": max(ratios)}
    return found


def of_group(group: str, options: argparse.Namespace) -> dict[str, Any]:
    """Counts of the methods on a group's trials, or on those of r2h-v1."""
    words = [] if group == V1 else ["--people", group]
    with TemporaryDirectory() as folder:
        run = swept(
            Path(folder) / "run",
            "--benchmark",
            "r2h-v1",
            "--method",
            *options.methods,
            *words,
            "--trials",
            options.trials,
            *KINEMATIC,
        )
        return counts(load_run(run))


def of_reception(options: argparse.Namespace) -> dict[str, Any]:
    """Hand -> method -> trials of `RECEIVED`, those that are received, and those that are a success too."""
    found: dict[str, Any] = {}
    for name, benchmark in ((V1, load_benchmark("r2h-v1")), ("adults", edited(BenchmarkChoice(people="adults")))):
        few = replace(benchmark, objects=load_objects(RECEIVED))
        evaluator = Evaluator(few, threads=1).kinematic
        drawn = few.trials(options.trials)
        found[name] = {}
        for method, module in FOUR.items():
            answer = module.predict(drawn, evaluator.scene, seed=0)
            scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, drawn)
            received = reception(scores).received
            both = received & scores.success.to(received.device)
            found[name][method] = [len(drawn), int(received.sum()), int(both.sum())]
            print(name, method, found[name][method], flush=True)
    return found


def of_hands(options: argparse.Namespace) -> dict[str, Any]:
    """Counts of Handover-VA on the bodies of r2h-v1 with other hands."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        line = ("--benchmark", "r2h-v1", "--method", "handover-va", "--trials", options.trials, *KINEMATIC)
        runs = {
            hand: swept(folder / f"run{k}", *line, *words) for k, (hand, words) in enumerate(hand_files(folder).items())
        }
        return {hand: counts(load_run(run)) for hand, run in runs.items()}


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """The figures of the page, or of the parts that `--only` names, beside the stored ones."""
    data: dict[str, Any] = {"groups": {}}
    if options.only:
        data = json.loads(STORED.read_text()) if STORED.exists() else data
    for part in options.only or PARTS:
        if part in (V1, *RECEIVERS):
            data["groups"][part] = of_group(part, options)
        elif part == "hands":
            data["hands"] = of_hands(options)
        elif part == "reception":
            data["reception"] = of_reception(options)
        elif part == "cost":
            data["cost"] = cost()
        else:
            draw(PICTURE)
    people = json.loads((ROOT / "assets" / "people" / "report.json").read_text())
    return {**data, "trials": options.trials, "people": people, **made_by(MEASURES)}


def shown(data: dict[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    groups = {g: data["groups"][g] for g in (V1, *RECEIVERS)}
    names = list(next(iter(groups.values())))
    success = [
        [group, *(f"{_sr(found[m]):.1f}" for m in names), found[names[0]]["redrawn_trials"]]
        for group, found in groups.items()
    ]
    return {
        "success": markdown_table(["Receivers", *names, "Redrawn"], success),
    }


def _sr(found: dict[str, Any]) -> float:
    return 100 * float(found["outcomes"].get("success", 0)) / int(found["n"])


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--trials": {"default": 100, "help": "of each split"},
        "--only": {"nargs": "+", "choices": PARTS, "default": (), "help": "measure these parts, keep the others"},
        "--methods": {"default": METHODS},
    },
    peer="ANSUR II, CDC growth charts, the built-in hand",
    stored="people",
)

if __name__ == "__main__":
    BENCH.main()
