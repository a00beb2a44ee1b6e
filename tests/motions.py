"""Motions that the tests of execution share: planned paths, what engines make of them, and what servos are told."""

from functools import cache

import numpy as np
import torch
import warp as wp
from problems import default_evaluator, make_batch, solve

from r2h_batch.config import ExecConfig
from r2h_batch.execute import Executed, execute, time_path
from r2h_batch.kernels.reference import Law, servo_commands
from r2h_batch.launch import init_warp

MUJOCO, PLANNED = ExecConfig(sim="mujoco"), ExecConfig(sim="none")
ARM, MJWARP = ExecConfig(sim="mujoco", model="arm"), ExecConfig(sim="mjwarp", model="arm")
BRIEF, BRIEF_WARP = (ExecConfig(sim=s, settle_limit_s=0.2) for s in ("mujoco", "mjwarp"))
"""The whole scene, watched for 0.7 s only: MuJoCo-Warp on a CPU makes some 15,000 steps a second of it."""
N = 16


@cache
def problems(n: int = N):
    evaluator = default_evaluator()
    return solve(evaluator.scene, make_batch(evaluator.scene, n, seed=3, random_share=0.3))


def run(config: ExecConfig, path=None, length=None, motion=None, n: int = N) -> Executed:
    p = problems(n)
    path = p.plan.path if path is None else path
    length = p.plan.length if length is None else length
    motion = time_path(path, length, config) if motion is None else motion
    return execute(default_evaluator().scene, p.placed, path, length, motion, config)


@cache
def reference_run(config: ExecConfig) -> Executed:
    return run(config)


def commands(path, length, motion, steps: int, *, lead: float, step_s: float) -> np.ndarray:
    init_warp()
    law = Law()
    law.speed, law.acceleration = 0.1 * np.pi, 0.5
    law.lead, law.step = lead, step_s
    out = torch.zeros((len(path), steps, 6), dtype=torch.float64)
    index = torch.arange(len(path), dtype=torch.int32)
    arrays = [wp.from_torch(t.contiguous()) for t in (index, path, motion.time_s, length, out)]
    wp.launch(servo_commands, dim=(len(path), steps), inputs=[0, law, *arrays], device="cpu")
    return out.numpy()
