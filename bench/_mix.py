"""The frozen mix: 1,024 trials of the default benchmark, S0 and S1 by turns, half with the poses of `oracle`, half with those
of `random`."""

from pathlib import Path

import numpy as np
import torch

from r2h_batch import load_benchmark
from r2h_batch.types import Trials

MIX = Path(__file__).with_name("mix.npz")
Poses = tuple[torch.Tensor, torch.Tensor, Trials]
"""T_obj_ee, T_world_ee and the trials that they answer."""


def load_mix(device: str = "cpu", n: int | None = None) -> tuple[Poses, torch.Tensor]:
    """Its first n rows (more than it has: the mix again), and which poses are the oracle's."""
    with np.load(MIX, allow_pickle=False) as mix:
        ids, by_oracle = (torch.from_numpy(mix[k]) for k in ("trial_id", "by_oracle"))
        T_obj_ee, T_world_ee = (torch.from_numpy(mix[k]) for k in ("T_obj_ee", "T_world_ee"))
    trials = load_benchmark().trials_with_ids(ids)
    whole = repeated((T_obj_ee, T_world_ee, trials), len(ids) if n is None else n)
    return on(whole, device), by_oracle[torch.arange(len(whole[2])) % len(ids)]


def repeated(poses: Poses, n: int) -> Poses:
    """The rows again and again until there are n."""
    rows = torch.arange(n, device=poses[0].device) % len(poses[2])
    return poses[0][rows], poses[1][rows], poses[2][rows]


def on(poses: Poses, device: str) -> Poses:
    T_obj_ee, T_world_ee, trials = poses
    return T_obj_ee.to(device), T_world_ee.to(device), trials.to(device)
