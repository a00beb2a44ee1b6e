"""Handover problems for tests and benchmarks: r2h-v0 trials with predictions of known character, and planning inputs.

`sensible` predictions are what a careful method makes: a stable candidate, the object's centre at the ball's centre, the
gripper coming from the robot's side. They are not chosen by looking at verdicts, so some fail.
"""

from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from r2h_batch import load_benchmark
from r2h_batch.base import se3
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.config import EvalConfig, ExecConfig, PlanConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.grasp import attach, close_gripper
from r2h_batch.judge.ik import IkResult, one_branch, solve_ik
from r2h_batch.judge.plan import Plan, plan_paths, random_key
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.types import Scores, Trials


@dataclass(frozen=True)
class Batch:
    """Trials with predictions."""

    trials: Trials
    T_obj_ee: torch.Tensor
    T_world_ee: torch.Tensor

    def __len__(self) -> int:
        return len(self.trials)

    def rows(self, rows: slice | torch.Tensor) -> "Batch":
        """The selected trials."""
        return Batch(self.trials[rows], self.T_obj_ee[rows], self.T_world_ee[rows])


@dataclass(frozen=True)
class Problems:
    """Planning inputs as the Evaluator makes them, and what the planner found."""

    batch: Batch
    body_poses: BodyPoses
    T_obj_ee_attached: torch.Tensor
    opening_m: torch.Tensor
    ik: IkResult
    plan: Plan


def make_batch(scene: Scene, n: int, *, seed: int = 0, random_share: float = 0.5) -> Batch:
    """Trials 0 to n - 1 (S0 and S1 by turns); predictions `random` (as the benchmark's bound) or sensible, by a coin."""
    benchmark = replace(load_benchmark("r2h-v0"), objects=scene.objects, hand_set=scene.hands.set)
    trials = benchmark.trials_with_ids(torch.arange(n)).named(scene.objects)  # for any robot and limits
    rng = np.random.default_rng(seed)
    random = rng.random(n) < random_share
    T_obj_ee = np.zeros((n, 4, 4), np.float32)
    candidates = candidates_of(scene.objects)
    for i, o in enumerate(trials.object_index.tolist()):
        T_obj_ee[i] = candidates[o].T_obj_ee[rng.integers(len(candidates[o]))]
    _, normal, ball = (x.numpy().astype(np.float64) for x in scene.palm(trials.hand_index, trials.T_world_hand))
    R = Rotation.random(n, random_state=rng.integers(1 << 30)).as_matrix()
    away = ball * [1, 1, 0] / np.linalg.norm(ball[:, :2], axis=1, keepdims=True)
    z = away - normal + 0.5 * rng.normal(size=(n, 3))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    y = np.cross(z, R[:, :, 0])
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    R = np.where(random[:, None, None], R, np.stack([np.cross(y, z), y, z], -1))
    p = np.where(
        random[:, None],
        ball + 0.20 * _in_unit_ball(rng, n),
        ball - np.einsum("nij,nj->ni", R, np.linalg.inv(T_obj_ee.astype(np.float64))[:, :3, 3]),
    )
    T_world_ee = np.tile(np.eye(4), (n, 1, 1))
    T_world_ee[:, :3, :3], T_world_ee[:, :3, 3] = R, p
    return Batch(trials, torch.from_numpy(T_obj_ee), torch.from_numpy(T_world_ee.astype(np.float32)))


def solve(scene: Scene, batch: Batch, config: PlanConfig | None = None, *, threads: int | None = None) -> Problems:
    """Grasp, placing, IK and planning of a batch, in the Evaluator's order and with its random keys."""
    t = batch.trials
    T_obj_ee, T_world_ee, T_world_hand = (
        se3.orthonormalise(T) for T in (batch.T_obj_ee, batch.T_world_ee, t.T_world_hand)
    )
    with on_threads(threads):
        grasp = close_gripper(scene.grasp_tables, T_obj_ee, t.object_index)
        attached = attach(T_obj_ee, grasp.shift_m)
        body_poses = scene.body_poses(t.object_index, t.hand_index, attached, T_world_hand, grasp.opening_m)
        active = torch.ones(len(t), dtype=torch.bool)
        ik = solve_ik(T_world_ee, active=active, robot=scene.robot)
        config = config or scene.config.plan
        branches = ik.valid if config.goals == "set" else one_branch(ik, T_world_ee)
        planned = plan_paths(scene, body_poses, ik.q, branches, active, random_key(t.trial_id), config)
    return Problems(batch, body_poses, attached, grasp.opening_m, ik, planned)


@cache
def default_evaluator(name: str = "r2h-v0") -> Evaluator:
    """One Evaluator for all tests of a process."""
    return Evaluator(load_benchmark(name))


@cache
def kinematic_evaluator(name: str) -> Evaluator:
    """One Evaluator that takes motions as planned for all tests of a process. It is not changed: what changes it asks a copy."""
    return Evaluator(load_benchmark(name), EvalConfig(execute=ExecConfig(sim="none")))


def assert_same(a: Scores, b: Scores) -> None:
    """Bitwise equal, NaN equal to NaN; only t_plan_s is a measured time."""
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        assert x.shape == y.shape and x.dtype == y.dtype and x.device == y.device, f.name
        if f.name != "t_plan_s":
            assert x.detach().contiguous().numpy().tobytes() == y.detach().contiguous().numpy().tobytes(), f.name


def _in_unit_ball(rng: np.random.Generator, n: int) -> np.ndarray:
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True) * rng.random((n, 1)) ** (1 / 3)
