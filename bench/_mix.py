"""The frozen mix: 1,024 trials of r2h-v0, S0 and S1 by turns, half with the poses of `oracle`, half with those of `random`."""

from pathlib import Path

import numpy as np
import torch
from _twins import Batch

from r2h_batch.scene.scene import Scene
from r2h_batch.trials.protocol import trials_digest, trials_with_ids

MIX = Path(__file__).with_name("mix.npz")


def load_mix(scene: Scene, n: int | None = None) -> Batch:
    """Its first n trials with their poses, on the CPU; more than it has: the mix again."""
    with np.load(MIX, allow_pickle=False) as mix:
        ids, *poses = (torch.from_numpy(mix[k]) for k in ("trial_id", "T_obj_ee", "T_world_ee"))
    trials = trials_with_ids(ids, objects=scene.objects, hand_set=scene.hands.set, protocol="r2h-v0")
    return repeated(Batch(trials, *poses), len(ids) if n is None else n)


def by_oracle() -> torch.Tensor:
    """(1024,) whose poses are the oracle's."""
    with np.load(MIX, allow_pickle=False) as mix:
        return torch.from_numpy(mix["by_oracle"])


def is_current(scene: Scene) -> bool:
    """Whether today's trials are those that the mix was made for."""
    with np.load(MIX, allow_pickle=False) as mix:
        return trials_digest(load_mix(scene).trials) == str(mix["digest"])


def repeated(batch: Batch, n: int) -> Batch:
    """The batch again and again until it has n rows."""
    return batch.rows(torch.arange(n, device=batch.T_obj_ee.device) % len(batch))


def on(batch: Batch, device: str) -> Batch:
    return Batch(batch.trials.to(device), batch.T_obj_ee.to(device), batch.T_world_ee.to(device))
