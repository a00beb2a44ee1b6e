"""How many problems does the planner solve, how fast, and are its paths free? Against OMPL's RRTConnect on MuJoCo C.

python bench/plan.py [--problems N] [--device cpu|cuda:0] [--json FILE]

Problems: rows of the frozen mix (bench/mix.npz, see throughput.py) whose start and at least one IK branch are free in
MuJoCo C; both planners get the same start and goals. Ours is timed over the batch with everything from placing the
bodies on (goal checks, search, shortcuts, smallest clearance; IK apart); OMPL inside solve() only, without simplification,
its model made beforehand. OMPL's states are checked by MuJoCo C through a Python callback.
Its edges are sampled every 1/64 rad. A problem counts as solved by OMPL if its path passes the
re-check at 1/320 rad. Our paths are certified between samples too, are shortened, and carry their smallest clearance.

ratio_to_ompl: process times, one core each, the median of OMPL over our mean per problem: other work on the machine counts
little. ratio_to_ompl_wall: wall times, ours on all cores.
"""

import argparse
import statistics
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from _mix import load_mix
from _report import Report
from _twins import Batch, Checker, Problems, checker_of, dense, motion_samples, ompl_solve, recheck, solve
from numpy.typing import NDArray
from run import DEVICE, Bench

from r2h_batch import load_benchmark
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.ik import solve_ik
from r2h_batch.judge.motion.time_law import time_path
from r2h_batch.scene.scene import Scene

MEASURES = (
    "bench/plan.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
)
REPEATS = 3


def free_rows(scene: Scene, problems: Problems, wanted: int) -> tuple[list[int], list[Checker], list[np.ndarray]]:
    """Rows, judges and goals of the first problems whose start and at least one goal are free in MuJoCo C."""
    rows: list[int] = []
    checkers: list[Checker] = []
    goals: list[np.ndarray] = []
    for row in range(len(problems.batch)):
        if len(rows) == wanted:
            break
        checker = checker_of(scene, problems, row)
        free = [q for q in problems.ik.q[row][problems.ik.valid[row]].double().cpu().numpy() if checker.valid(q)]
        if free and checker.valid(scene.robot.home_q):
            rows.append(row)
            checkers.append(checker)
            goals.append(np.array(free))
    return rows, checkers, goals


def planned(scene: Scene, batch: Batch, threads: int | None, clock) -> tuple[Problems, float]:
    """The batch solved, and the best time of several runs without the IK's (measured apart, subtracted)."""
    best = float("inf")
    for _ in range(REPEATS):
        start = clock()
        problems = solve(scene, batch, threads=threads)
        middle = clock()
        with on_threads(threads):
            solve_ik(batch.T_world_ee)
        best = min(best, (middle - start) - (clock() - middle))
    return problems, best


@dataclass(frozen=True)
class OwnTimes:
    """Our plans of n problems, and the seconds they took: process time and wall time."""

    problems: Problems
    n: int
    seconds: float
    wall: float
    found: NDArray[np.bool_]


def own_times(report: Report, scene: Scene, batch: Batch) -> OwnTimes:
    """Plans the batch on one core and on all."""
    n = len(batch)
    problems, seconds = planned(scene, batch, 1, time.process_time)
    _, wall = planned(scene, batch, None, time.perf_counter)
    found = (problems.plan.length > 0).cpu().numpy()
    report.add("plan.solved", int(found.sum()))
    return OwnTimes(problems, n, seconds, wall, found)


def recheck_paths(report: Report, scene: Scene, own: OwnTimes, checkers: list[Checker]) -> None:
    """Our paths at the postures that are executed, by the oracle."""
    problems, found = own.problems, own.found
    config = scene.config.execute
    motion = time_path(problems.plan.path, problems.plan.length, config)
    penetrating = 0
    for row in np.flatnonzero(found):
        k = int(problems.plan.length[row])
        path, times = (x[row, :k].double().cpu().numpy() for x in (problems.plan.path, motion.time_s))
        penetrating += recheck(checkers[row], motion_samples(path, times, config)).penetrating > 0
    report.add("plan.penetrating_paths", penetrating)


def compare_with_ompl(
    report: Report,
    scene: Scene,
    own: OwnTimes,
    made: tuple[list[Checker], list[np.ndarray]],
    options: Any,
) -> None:
    """The same problems by OMPL with the oracle's checks. `made`: checker and goals of each problem."""
    checkers, goals = made
    n, seconds, wall = own.n, own.seconds, own.wall
    cpu, walls, solved = [], [], 0
    for row in range(n):
        before = time.process_time()
        answer = ompl_solve(
            checkers[row], goals[row], scene.robot.lower, scene.robot.upper,
            budget_s=options.budget_s, resolution_rad=options.resolution_rad,
        )  # fmt: skip
        cpu.append(time.process_time() - before)
        walls.append(answer.seconds)
        solved += answer.path is not None and not recheck(checkers[row], dense(answer.path)).penetrating
    report.add("plan.ompl_solved", solved)
    report.add("plan.ratio_to_ompl", statistics.median(cpu) / (seconds / n))
    report.add("plan.ratio_to_ompl_wall", statistics.median(walls) / (wall / n))


def run(options: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    scene = Evaluator(load_benchmark(), device=options.device).scene
    (T_obj_ee, T_world_ee, trials), _ = load_mix(options.device)
    whole = Batch(trials, T_obj_ee, T_world_ee)
    rows, checkers, goals = free_rows(scene, solve(scene, whole), options.problems)
    batch = whole.rows(torch.tensor(rows))
    report.add("plan.problems", len(batch))
    own = own_times(report, scene, batch)
    recheck_paths(report, scene, own, checkers)
    compare_with_ompl(report, scene, own, (checkers, goals), options)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        **DEVICE,
        "--problems": {"default": 300},
        "--budget-s": {"default": 10.0, "help": "OMPL's time for one problem"},
        "--resolution-rad": {"type": float, "default": 1 / 64, "help": "OMPL's edge resolution"},
    },
    peer="OMPL's RRT-Connect on MuJoCo C's contacts",
)

if __name__ == "__main__":
    BENCH.main()
