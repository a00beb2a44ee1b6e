"""Motions that the tests of execution share: planned paths, what engines make of them, and what servos are told."""

from functools import cache

import numpy as np
import torch
from problems import default_evaluator, make_batch, solve

from r2h_batch.base.launch import init_warp, launch_trials
from r2h_batch.config import ExecConfig
from r2h_batch.judge.motion.execute import Executed, execute
from r2h_batch.judge.motion.time_law import servo_law, time_path
from r2h_batch.kernels.motion.time_law import servo_commands
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.scene import BodyPoses

MUJOCO, PLANNED = ExecConfig(sim="mujoco", model="scene"), ExecConfig(sim="none")
ARM, MJWARP = ExecConfig(sim="mujoco", model="arm"), ExecConfig(sim="mjwarp", model="arm")
BRIEF, BRIEF_WARP = (
    ExecConfig(sim=s, model="scene", scale=1.0, settle_s=0.02, dwell_s=0.1) for s in ("mujoco", "mjwarp")
)
"""The whole scene at full speed, 1 s in all: MuJoCo-Warp on a CPU makes some 15,000 steps a second of it."""
N = 16


@cache
def problems(n: int = N):
    evaluator = default_evaluator()
    return solve(evaluator.scene, make_batch(evaluator.scene, n, seed=3, random_share=0.3))


def placed(rows: torch.Tensor | slice = slice(None), T_world_hand: torch.Tensor | None = None) -> BodyPoses:
    """The bodies of those problems; `T_world_hand`: with their hands there."""
    p = problems()
    t = p.batch.trials[rows]
    hand = t.T_world_hand if T_world_hand is None else T_world_hand
    attached, opening = p.T_obj_ee_attached[rows], p.opening_m[rows]
    return default_evaluator().scene.body_poses(t.object_index, t.hand_index, attached, hand, opening)


def into_the_table() -> tuple[torch.Tensor, torch.Tensor, int]:
    """The first paths, one of which now goes down to fingertips 13 cm below the table's top; which."""
    p = problems()
    found = torch.nonzero(p.plan.length > 0).flatten()[:4]
    path, length = p.plan.path.clone(), torch.zeros_like(p.plan.length)
    length[found] = p.plan.length[found]
    row = int(found[1])
    path[row, 1:] = path[row, 0] + torch.tensor([0, 0.8, 0.8, -1.0, 0, 0])
    length[row] = 2
    assert ee_pose(default_evaluator().scene.robot, path[row, 1].double().numpy())[2, 3] < -0.1
    return path, length, row


def run(config: ExecConfig, path=None, length=None, motion=None, n: int = N) -> Executed:
    p = problems(n)
    path = p.plan.path if path is None else path
    length = p.plan.length if length is None else length
    motion = time_path(path, length, config) if motion is None else motion
    return execute(default_evaluator().scene, p.body_poses, path, length, motion, config)


@cache
def reference_run(config: ExecConfig, first: int = N) -> Executed:
    """Of the first paths; MuJoCo-Warp on a CPU takes as long for two as for one twice."""
    plan = problems().plan
    length, found = torch.zeros_like(plan.length), torch.nonzero(plan.length > 0).flatten()[:first]
    length[found] = plan.length[found]
    return run(config, length=length)


def commands(path, length, motion, steps: int, *, lead: float, step_s: float) -> np.ndarray:
    init_warp()
    law = servo_law(PLANNED, np.ones(6), lead_s=lead, step_s=step_s)
    out = torch.zeros((len(path), steps, 6), dtype=torch.float64)
    index = torch.arange(len(path), dtype=torch.int32)
    launch_trials(
        servo_commands,
        len(path),
        inputs={
            "law": law,
            "trial": index,
            "path": path.contiguous(),
            "time": motion.time_s.contiguous(),
            "length": length.contiguous(),
        },
        outputs={"command": out},
        device="cpu",
        width=steps,
    )
    return out.numpy()
