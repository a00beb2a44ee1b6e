"""How fast and how right is a yes-or-no collision check? Own kernel and MuJoCo C on the same configurations.

python bench/collision.py [--trials N] [--per-trial M] [--json FILE]

Trials of r2h-v0 with their object in the gripper (tests/support/problems.py: half random, half sensible predictions). Half of the
configurations of a trial are uniform in the box that the planner samples (home +- pi), half lie within 0.2 rad of
straight lines from home to the IK solutions of the handover pose. Every engine does forward kinematics and checks the same
pairs: robot against hand pieces, table and itself, object hull against hand, table and arm.

Times are process time of one thread, the best of several runs, taken in turns; other work on the machine counts little.
MuJoCo C runs mj_kinematics and mj_collision; what the Python loop around them costs is measured on an empty model and taken
off. A disagreement counts when MuJoCo C's distance of that configuration is more than 0.1 mm from zero.
"""

import argparse
import time
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp
from _is_free import is_free
from _report import Report
from _twins import let_collide, make_batch, oracle, solve, staged
from run import Bench

from r2h_batch import load_benchmark
from r2h_batch.base.launch import launch_trials
from r2h_batch.config import HOME_Q, EvalConfig
from r2h_batch.scene.scene import Scene

MEASURES = (
    "bench/collision.py",
    "bench/_is_free.py",
    "kernels/geometry",
    "kernels/plan",
    "kernels/robot",
    "r2h_batch/base/launch",
)
BAND_M = 1e-4
REPEATS = 5


def configurations(scene: Scene, n: int, per_trial: int, seed: int = 0):
    """Planning problems and postures (n, per_trial, 6), float32 values in float64."""
    rng = np.random.default_rng(seed)
    problems = solve(scene, make_batch(scene, n, seed=seed), threads=1)
    home = np.array(HOME_Q)
    q = home + rng.uniform(-np.pi, np.pi, (n, per_trial, 6))
    valid, branches = problems.ik.valid.numpy(), problems.ik.q.numpy()
    for k in range(n):
        ends = branches[k][valid[k]]
        if len(ends):
            m = per_trial - per_trial // 2
            along = rng.uniform(0, 1.05, (m, 1))
            q[k, :m] = home + along * (ends[rng.integers(0, len(ends), m)] - home) + rng.uniform(-0.2, 0.2, (m, 6))
    return problems, q.astype(np.float32).astype(np.float64)


def contacts_of(twin: oracle.MujocoScene) -> mujoco.MjModel:
    """The twin's model with contacts between exactly the checked pairs, with MuJoCo's own defaults."""
    let_collide(twin, oracle.CLASSES)
    twin.model.opt.ccd_iterations, twin.model.opt.ccd_tolerance = 35, 1e-6
    return twin.model


def run_c(models, datas, q, free) -> None:
    for k, (m, d) in enumerate(zip(models, datas, strict=True)):
        qpos, rows = d.qpos, q[k]
        for i in range(len(rows)):
            qpos[:] = rows[i]
            mujoco.mj_kinematics(m, d)
            mujoco.mj_collision(m, d)
            free[k, i] = d.ncon == 0


def python_overhead(count: int) -> float:
    """Process time of the same loop over an almost empty model."""
    empty = mujoco.MjModel.from_xml_string("<mujoco/>")
    d, qpos = mujoco.MjData(empty), np.zeros(6)
    free, rows = np.zeros((1, count), bool), np.zeros((count, 6))
    times = []
    for _ in range(3):
        start = time.process_time()
        for i in range(count):
            qpos[:] = rows[i]
            mujoco.mj_kinematics(empty, d)
            mujoco.mj_collision(empty, d)
            free[0, i] = d.ncon == 0
        times.append(time.process_time() - start)
    return min(times)


def fastest(*runs) -> list[float]:
    """Shortest process time of each run, taken in turns."""
    times: list[list[float]] = [[] for _ in runs]
    for _ in range(REPEATS):
        for i, f in enumerate(runs):
            start = time.process_time()
            f()
            times[i].append(time.process_time() - start)
    return [min(t) for t in times]


class Engines:
    """Every engine on the same configurations and pairs, each run once: compiled, and with its answers at hand."""

    def __init__(self, scene: Scene, problems, twins, q: np.ndarray) -> None:
        self.models = [contacts_of(t) for t in twins]
        self.datas = [t.data for t in twins]
        self.q, self.scene, self.bodies = q, scene, problems.body_poses.bodies
        self.flat: Any = wp.array(q.reshape(-1, 6).astype(np.float32), dtype=float, device="cpu")
        self.own = wp.zeros(len(self.flat), dtype=wp.bool, device="cpu")
        self.c_free = np.zeros(q.shape[:2], bool)
        self.run_own()
        self.run_mujoco()

    def run_own(self) -> None:
        launch_trials(
            is_free,
            len(self.flat),
            inputs={"per_trial": self.q.shape[1], "world": self.scene.world, "bodies": self.bodies, "q": self.flat},
            outputs={"free": self.own},
            device="cpu",
            threads=1,
            chunk=1024,
        )

    def run_mujoco(self) -> None:
        run_c(self.models, self.datas, self.q, self.c_free)

    def times(self) -> list[float]:
        """Shortest process time (s) of the own kernel and of MuJoCo C."""
        return fastest(self.run_own, self.run_mujoco)


def report_disagreements(report: Report, engines: Engines, truth: np.ndarray) -> None:
    """`truth`: the twins' smallest distance (m) of each configuration; within BAND_M of zero nobody is wrong."""
    flags = engines.own.numpy().reshape(truth.shape)
    clear = np.abs(truth) >= BAND_M
    report.add("collision.disagreements_outside_band", int(((flags != (truth > 0)) & clear).sum()))


def run(args: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    torch.set_num_threads(1)
    scene = Scene(load_benchmark(), config=EvalConfig(), device="cpu")
    problems, q = configurations(scene, args.trials, args.per_trial)
    count = q.shape[0] * q.shape[1]
    report.add("collision.configs", count)
    twins = [oracle.mujoco_scene(scene, staged(problems, k)) for k in range(args.trials)]
    least = [[t.least(x, cap=2e-3) for x in rows] for t, rows in zip(twins, q, strict=True)]
    truth = np.array([[x[0] for x in rows] for rows in least])
    engines = Engines(scene, problems, twins, q)
    own, mujoco_c = engines.times()
    report.add("collision.ratio_to_mujoco_c", (mujoco_c - python_overhead(count)) / own)
    report_disagreements(report, engines, truth)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {"--trials": {"default": 32}, "--per-trial": {"default": 320}},
    peer="MuJoCo C",
)

if __name__ == "__main__":
    BENCH.main()
