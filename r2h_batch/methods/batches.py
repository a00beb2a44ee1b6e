"""A method's answers for any number of trials, computed in parts on the scene's device."""

import time
from collections.abc import Callable

import torch
from torch import Tensor

from r2h_batch.base.launch.threads import one_torch_thread
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Predictions, Trials

PART = 512
"""Trials in memory together: each takes 20 kB for its posed hand, and as much for its
orientations."""


def answers(
    trials: Trials,
    scene: Scene,
    method: str,
    choose: Callable[[Trials, slice], tuple[Tensor, Tensor]],
    *,
    part: int = PART,
) -> Predictions:
    """Answer all trials.

    Args:
        trials: N trials on any device.
        scene: whose device computes.
        method: its name.
        choose: (n trials, their rows) -> T_obj_ee, T_world_ee, (n, 4, 4) each.
        part: most trials of one call of `choose`.

    Returns:
        Predictions on the trials' device; t_method_s is the wall time divided by N.
    """
    start = time.perf_counter()
    home, there = trials.trial_id.device, trials.to(scene.device)
    grasps = [torch.empty((0, 4, 4), dtype=torch.float32, device=scene.device)]
    poses = [torch.empty((0, 4, 4), dtype=torch.float32, device=scene.device)]
    with one_torch_thread(scene.device):
        for first in range(0, len(trials), part):
            rows = slice(first, first + part)
            T_obj_ee, T_world_ee = choose(there[rows], rows)
            grasps.append(T_obj_ee)
            poses.append(T_world_ee)
    T_obj_ee, T_world_ee = (torch.cat(parts).float().to(home) for parts in (grasps, poses))
    seconds = (time.perf_counter() - start) / max(len(trials), 1)
    t_method_s = torch.full((len(trials),), seconds, dtype=torch.float32, device=home)
    return Predictions(trials.trial_id, T_obj_ee, T_world_ee, t_method_s, method)


def part_of(rows: Tensor | None, part: slice) -> Tensor | None:
    """The rows of a part of all trials, of something that methods may be told.

    Args:
        rows: (N, ...) of all trials; None: it is not told.
        part: the rows of the part, as `choose` of `answers` gets them.
    """
    return None if rows is None else rows[part]
