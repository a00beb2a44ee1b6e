"""What `Evaluator.score` accepts: one row per candidate, from (B, 4, 4) or (N, K, 4, 4); everything else is refused by name."""

from dataclasses import replace
from typing import Literal, get_args

import torch
from torch import Tensor

from r2h_batch.scene import Scene
from r2h_batch.types import Trials

Stages = Literal["pose", "all"]
"""How far `Evaluator.score` goes: what needs no path, or everything."""


def checked_inputs(
    scene: Scene, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, stages: Stages
) -> tuple[Tensor, Tensor, Trials]:
    """Poses (B, 4, 4) and B trials; (N, K) candidates become N K rows, each trial K times in turn.

    Raises ValueError, TypeError from shapes, dtypes and devices alone.
    """
    device = torch.device(scene.device)
    if stages not in get_args(Stages):
        raise ValueError(f"stages is {stages!r}; allowed are {', '.join(get_args(Stages))}")
    if not isinstance(trials, Trials):
        raise TypeError(f"trials is a {type(trials).__name__}; it must be r2h_batch.Trials")
    n = len(trials)
    many = isinstance(T_obj_ee, Tensor) and T_obj_ee.ndim == 4
    k = T_obj_ee.shape[1] if many else 1
    shape, words = ((n, k, 4, 4), f"({n}, K, 4, 4)") if many else ((n, 4, 4), f"({n}, 4, 4) or ({n}, K, 4, 4)")
    for name, value, expected in (
        ("T_obj_ee", T_obj_ee, shape),
        ("T_world_ee", T_world_ee, shape),
        ("trials.T_world_hand", trials.T_world_hand, (n, 4, 4)),
    ):
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} is a {type(value).__name__}; it must be a torch tensor (B, 4, 4) or (N, K, 4, 4)")
        if value.dtype != torch.float32:
            raise TypeError(f"{name} is {value.dtype}; it must be torch.float32: call .float()")
        if value.shape != expected:
            allowed = words if name == "T_obj_ee" else str(tuple(expected))
            raise ValueError(f"{name} has shape {tuple(value.shape)}; with {n} trials it must be {allowed}")
        if value.device.type != device.type:
            raise ValueError(f"{name} is on {value.device}, the evaluator on {device}: move one of them")
    for name, index in (("object_index", trials.object_index), ("hand_index", trials.hand_index)):
        if index.shape != (n,) or index.dtype != torch.int32 or index.device.type != device.type:
            raise ValueError(
                f"trials.{name} is {index.dtype} {tuple(index.shape)} on {index.device}; it must be int32 ({n},) on {device}"
            )
    if many:
        T_obj_ee, T_world_ee = T_obj_ee.reshape(n * k, 4, 4), T_world_ee.reshape(n * k, 4, 4)
        trials = repeated(trials, k)
    return T_obj_ee, T_world_ee, trials


def check_indices(scene: Scene, trials: Trials) -> None:
    """Raises ValueError for an object or hand outside the scene; on CUDA looking at them would wait for the device.

    There rows with such an index become INVALID_INPUT.
    """
    if torch.device(scene.device).type != "cpu" or not len(trials):
        return
    for name, index, count in (
        ("object_index", trials.object_index, len(scene.objects)),
        ("hand_index", trials.hand_index, len(scene.hands.set)),
    ):
        low, high = int(index.min()), int(index.max())
        if low < 0 or high >= count:
            raise ValueError(f"trials.{name} runs from {low} to {high}; the scene has 0 to {count - 1}")


def repeated(trials: Trials, k: int) -> Trials:
    """Each trial k times in turn: the rows of (N, k) candidates."""
    rows = {
        name: x[:, None].expand(-1, k, *x.shape[1:]).reshape(-1, *x.shape[1:]) for name, x in trials._tensors().items()
    }
    return replace(trials, **rows)
