"""The same methods on the built-in robots, and their inverse kinematics: docs/results/questions.md.

`python bench/robots.py --sections ik trials collision plan table --out FOLDER` measures these and leaves the others as they are
in the JSON; each says on which commit it was measured.

table: sweeps all methods on the default benchmark with each robot, motion as planned, persons placed for the robot (the same
FOLDER goes on).
ik: postures drawn uniformly within the joint ranges, so every target can be reached; process time of one thread;
pytorch-kinematics' PseudoInverseIK, by restarts, on the first of them.
trials: whole trials, half the oracle's answers and half random's, motion as planned; process time of one thread, robots by turns.
collision: postures near hands and anywhere (tests/kernels/test_collision.py), against distances of MuJoCo C on the robot's own
bodies; one within 0.1 mm of contact is borderline.
plan: the same answers; RRT-Connect of OMPL on MuJoCo C's contacts has the same start, goals and checked pairs. Paths of both are
checked again every 1/320 rad.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _report import ROOT, Report, made_by, markdown_table, swept
from _rows import keep, rate_of
from _twins import Batch, dense, ompl_solve, oracle, recheck, solve
from ik import pseudo_inverse
from plan import free_rows
from run import Bench

from r2h_batch import load_benchmark
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.ik import reference_chain, solve_ik
from r2h_batch.judge.planner import Planner
from r2h_batch.methods import oracle as oracle_method
from r2h_batch.methods import random as random_method
from r2h_batch.scene.robot import Robot, ee_pose
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.scene.scene import Scene

MEASURES = (
    "bench/robots.py",
    "assets/robot",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/methods",
)
ROBOTS = ("ur5e_2f85", "ur3e_2f85", "ur10e_2f85", "panda_hand")
METHODS = ("fc", "handover-va", "contact", "intent", "random", "oracle")
STORED = ROOT / "bench" / "results" / "robots.json"
RESTARTS = 20
SECTIONS = ("ik", "trials", "collision", "plan", "table")
REPEATS = 3
BAND_M = 1e-4
"""Within it float32 may decide either way."""
BUDGET_S = 5.0
KINEMATIC = EvalConfig(execute=ExecConfig(sim="none"))


def inverse_kinematics(robot: Robot, count: int, some: int) -> dict[str, float]:
    """Times, misses and errors on targets that the robot can reach."""
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (count, len(robot.joints)))
    targets = torch.from_numpy(ee_pose(robot, q).astype(np.float32))
    with on_threads(1):
        solve_ik(targets[:256], robot=robot)
        start = time.process_time()
        found = solve_ik(targets, robot=robot)
        seconds = time.process_time() - start
    few = targets[:some].contiguous()
    ours = reference_chain(robot).forward_kinematics(torch.from_numpy(q[:some]).float()).get_matrix()
    assert float((ours - few).abs().max()) < 1e-4, f"{robot.name}: the reference chain is another arm"
    start = time.process_time()
    reference = pseudo_inverse(robot, few, RESTARTS)
    reference_s = time.process_time() - start
    return {
        "us": 1e6 * seconds / count,
        "missed": int((~found.reachable).sum()),
        "postures": float(found.valid.sum(1).double().mean()),
        "position_error_um": 1e6 * float(found.position_error_m[found.valid].max()),
        "reference_us": 1e6 * reference_s / some,
        "reference_missed": int((~reference).sum()),
        "missed_of_these": int((~found.reachable[:some]).sum()),
    }


def table(robot: str, trials: int, folder: Path) -> dict[str, dict[str, Any]]:
    """Method -> the record of its mean row."""
    from r2h_batch.report.table import record, table_of
    from r2h_batch.runs.store import load_run

    swept(
        folder,
        "--robot",
        robot,
        "--method",
        *METHODS,
        "--trials",
        trials,
        "--execute.sim",
        "none",
        "--quiet",
    )
    keep(folder, ROOT / "bench" / "options" / "robots" / robot)
    rows = table_of(load_run(folder)).rows
    return {row.method.partition(" (")[0]: record(row) for row in rows if row.split == "Avg"}


class Answered:
    """A robot's evaluator, and trials that it can judge: half with the oracle's answers, half with random's."""

    def __init__(self, robot: Robot, count: int) -> None:
        benchmark = load_benchmark().on(robot)
        self.evaluator = Evaluator(benchmark, KINEMATIC)
        trials = benchmark.trials(count // 2)
        scene = self.evaluator.scene
        best = oracle_method.predict(trials, scene, seed=0, evaluator=self.evaluator)
        any_ = random_method.predict(trials, scene, seed=0)
        by_oracle = (torch.arange(len(trials)) % 4 < 2)[:, None, None]  # splits are by turns
        T_obj_ee = torch.where(by_oracle, best.T_obj_ee, any_.T_obj_ee)
        T_world_ee = torch.where(by_oracle, best.T_world_ee, any_.T_world_ee)
        self.batch = Batch(trials, T_obj_ee, T_world_ee)

    def score(self) -> float:
        """Process seconds of one call on one thread."""
        start = time.process_time()
        with on_threads(1):
            self.evaluator.score(self.batch.T_obj_ee, self.batch.T_world_ee, self.batch.trials)
        return time.process_time() - start


def whole_trials(answered: dict[str, Answered]) -> dict[str, dict[str, float]]:
    """Microseconds a trial, robots by turns."""
    times: dict[str, list[float]] = {name: [] for name in answered}
    for turn in range(REPEATS + 1):
        for name, own in answered.items():
            seconds = own.score()
            if turn:  # the first call reads kernels
                times[name].append(1e6 * seconds / len(own.batch))
    return {name: {"us": statistics.median(t), "trials": len(answered[name].batch)} for name, t in times.items()}


def collisions(robot: Robot, count: int, per_trial: int = 250) -> dict[str, int]:
    """Own verdicts on postures, half near a hand and half anywhere, against MuJoCo C's distances."""
    rng, scene = np.random.default_rng(11), Scene(load_benchmark().on(robot))
    found = {"postures": 0, "borderline": 0, "disagreements": 0, "colliding": 0}
    for _ in range(count // (40 * per_trial)):
        stages, base = oracle.random_stages(scene, rng, 40)
        n = len(robot.joints)
        q = base[:, None] + rng.normal(size=(40, per_trial, n)) * rng.choice([0.03, 0.15, 0.5], (40, per_trial, 1))
        q[:, ::2] = rng.uniform(
            np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi), (40, per_trial // 2, n)
        )
        flat = torch.from_numpy(q.reshape(-1, n)).float()
        every = torch.ones(len(flat), dtype=torch.bool)
        clear = Planner(scene, oracle.place(scene, stages)).check(flat, every, per_trial)[0].view(40, per_trial)
        exact = flat.double().numpy().reshape(q.shape)
        for k, staged in enumerate(stages):
            twin = oracle.mujoco_scene(scene, staged)
            least = np.array([twin.least(x, cap=2e-3)[0] for x in exact[k]])
            sure = np.abs(least) >= BAND_M
            found["postures"] += per_trial
            found["borderline"] += int((~sure).sum())
            found["colliding"] += int((least < 0).sum())
            found["disagreements"] += int((sure & (clear[k].numpy() != (least > 0))).sum())
    return found


def paths(answered: Answered, wanted: int) -> dict[str, int]:
    """Ours and OMPL's on the first problems whose start and at least one goal are free in MuJoCo C."""
    scene = answered.evaluator.scene
    robot, problems = scene.robot, solve(scene, answered.batch, threads=1)
    found = dict.fromkeys(("solved", "penetrating", "ompl_solved", "ompl_penetrating"), 0)
    chosen = free_rows(scene, problems, wanted)
    for row, checker, goals in zip(*chosen, strict=True):
        if n := int(problems.plan.length[row]):
            found["solved"] += 1
            own = problems.plan.path[row, :n].double().numpy()
            found["penetrating"] += recheck(checker, dense(own)).penetrating > 0
        theirs = ompl_solve(checker, goals, robot.lower, robot.upper, budget_s=BUDGET_S, home=robot.home_q).path
        if theirs is not None:
            wrong = recheck(checker, dense(theirs)).penetrating > 0
            found["ompl_penetrating" if wrong else "ompl_solved"] += 1
    return {"problems": len(chosen[0]), **found}


@on_threads(1)
def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """The stored data with the sections asked for measured again, of all robots."""
    torch.set_num_threads(1)
    data = json.loads(STORED.read_text())
    data.setdefault("measured", {"table": {"commit": data.get("commit")}})
    asked, robots = options.sections, {name: load_robot(name) for name in ROBOTS}
    record = data.setdefault("robots", {})
    for name in robots:
        record.setdefault(name, {})
    answered = {name: Answered(r, options.rows) for name, r in robots.items()} if {"trials", "plan"} & {*asked} else {}
    if "trials" in asked:
        for name, times in whole_trials(answered).items():
            record[name]["trials"] = times
    for name, robot in robots.items():
        own = record[name]
        if "ik" in asked:
            own["ik"] = inverse_kinematics(robot, options.targets, options.reference_targets)
        if "plan" in asked:
            own["plan"] = paths(answered[name], options.problems)
        if "collision" in asked:
            own["collision"] = collisions(robot, options.postures)
        if "table" in asked:
            own["table"] = table(name, options.trials, options.out / name)
        print(name, json.dumps({k: own[k] for k in asked if k != "table"}), flush=True)
    if "ik" in asked:
        data |= {"targets": options.targets, "some": options.reference_targets}
    if "table" in asked:
        data |= {"trials": options.trials, "benchmark": load_benchmark().name}
    made = made_by(MEASURES)
    data["measured"].update({key: {"commit": made["commit"]} for key in asked})
    return data | (made if {*asked} == {*SECTIONS} else {})


def shown(data: dict[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    robots = data["robots"]
    methods = list(next(iter(robots.values()))["table"])

    rates = [[m, *(rate_of(r["table"][m]) for r in robots.values())] for m in methods]
    return {
        "commits": ", ".join(sorted({str(made["commit"])[:12] for made in data["measured"].values()})),
        "rates": markdown_table(["Method", *robots], rates),
    }


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--out": {"default": Path("runs/robots"), "type": Path},
        "--sections": {"default": SECTIONS, "choices": SECTIONS},
        "--trials": {"default": 100, "help": "of each split, in the table"},
        "--rows": {"default": 400, "help": "whole trials, and those from which problems are taken"},
        "--problems": {"default": 60, "help": "of planning"},
        "--postures": {"default": 10_000},
        "--targets": {"default": 100_000},
        "--reference-targets": {"default": 500},
    },
    peer="MuJoCo C, OMPL, pytorch-kinematics",
    stored="robots",
)

if __name__ == "__main__":
    BENCH.main()
