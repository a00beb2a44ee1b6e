"""Trials as methods see them, small and batch first: cloud, region, candidates, estimated hand."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float32
from pydantic import Field
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.validate import validate_fields
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.placing import center_of
from r2h_batch.methods.predictors import (
    Observations,
    PredictorNoise,
    predict_contacts,
    predict_parts,
    predict_target,
)
from r2h_batch.scene.objects import POINTS, ObjectModel
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials


@dataclass(frozen=True)
class Seen:
    """How much of a trial is seen.

    Attributes:
        cloud: points of the object, at most 2048, spread evenly over its surface. A smaller cloud begins a larger one.
        hand: points of the estimated hand's skin.
        contacts: whether each point has the probability that people touch it, as Contact-Handover sees it; new instances
            cost a network's answer each, which is kept on disk.
        noise: deviations of the error model; None: those that methods are tested with.
        spread: False: the cloud's first points, which lie on one piece of the surface. Weights of before learned from these.
    """

    cloud: Annotated[int, Field(ge=1, le=POINTS)] = 96
    hand: Annotated[int, Field(ge=1)] = 64
    contacts: bool = False
    noise: PredictorNoise | None = None
    spread: bool = True

    def __post_init__(self) -> None:
        validate_fields(self)


def observe(
    trials: Trials,
    scene: Scene,
    see: Seen,
    *,
    seed: int = 0,
    seen: Observations | None = None,
    region: bool = True,
) -> tuple[dict[str, Tensor], Float32[Tensor, "n 3"]]:
    """Trials as methods see them, and the middle of what the receiver is to take, frame obj.

    Args:
        trials: N trials.
        scene: objects, hands and robot.
        see: how much.
        seed: key of the errors' draws; a row depends on seed and trial id alone.
        seen: answers of your own networks, in place of the error model.
        region: whether the receiver's region is seen; else nothing is of it, and the middle is the object's.

    Returns:
        The tensors that `training.pairs.Pairs` names, from `cloud` to `exists`; and the middle (N, 3).
    """
    o = trials.object_index.long()
    hand = predict_target(trials, scene, seed=seed, noise=see.noise, seen=seen)
    points = (
        _spread(see.cloud)
        if see.spread
        else torch.arange(see.cloud, dtype=torch.int64, device="cpu")
    )
    parts = predict_parts(trials, scene, seed=seed, noise=see.noise, seen=seen, points=points)
    last = hand.bank.vertices.shape[1] - 1
    every = torch.linspace(0, last, see.hand, dtype=torch.float64, device="cpu").long()
    skin = hand.bank.vertices[:, every][hand.row]
    cloud, normals = (x[o] for x in _clouds(scene.objects, see.cloud, see.spread))
    usage = parts.usage.contiguous()
    if not region:
        usage = torch.zeros_like(usage)
    count = usage.sum(1, keepdim=True)
    mean = (cloud * usage[..., None]).sum(1) / count.clamp(min=1)
    table = candidate_table(scene)
    candidate, exists = table.rows(trials.object_index)
    found = {
        "cloud": cloud, "normals": normals, "part": parts.label.contiguous(), "region": usage,
        "hand": se3.apply(hand.T[:, None], skin), "T_world_hand": hand.T, "side": hand.side,
        "palm_point": hand.palm_point, "palm_normal": hand.palm_normal, "wrist_to_middle": hand.wrist_to_middle,
        "ball_center": hand.ball_center, "candidates": table.T_obj_ee[candidate],
        "opening_m": table.opening_m[candidate], "score": table.score[candidate], "exists": exists,
    }  # fmt: skip
    if see.contacts:
        contact = predict_contacts(trials, scene, seen=seen)
        found["contact"] = contact[:, points].contiguous()
    return found, torch.where(count > 0, mean, _middles(scene.objects)[o])


@lru_cache(maxsize=4)
def _clouds(objects: Sequence[ObjectModel], count: int, spread: bool) -> tuple[Tensor, Tensor]:
    """Points (O, P, 3) of each cloud and their normals."""
    some = _spread(count).numpy() if spread else slice(count)
    every = [np.stack([getattr(o, k)[some] for o in objects]) for k in ("points", "normals")]
    points, normals = (torch.from_numpy(x) for x in every)
    return points, normals


@lru_cache(maxsize=4)
def _spread(count: int) -> Tensor:
    """Numbers of `count` points of a cloud in bit-reversed order (van der Corput): a cloud is in the order of its faces, so that
    points far apart in it are far apart on the surface, and the first of these are a coarser sample of the same."""
    bits = POINTS.bit_length() - 1  # of a power of two
    order = [int(f"{k:0{bits}b}"[::-1], 2) for k in range(count)]
    return torch.tensor(order, dtype=torch.int64, device="cpu")


@lru_cache(maxsize=4)
def _middles(objects: Sequence[ObjectModel]) -> Tensor:
    """(O, 3) the point of each object that is brought to a palm, frame obj."""
    return torch.from_numpy(np.stack([center_of(o) for o in objects])).float()
