"""The object in the closed gripper: which rows are poses at all, what closing does, and where every body then sits."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch import se3
from r2h_batch.config import EvalConfig
from r2h_batch.judge.grasp import Grasp, attach, close_gripper
from r2h_batch.scene.scene import Placed, Scene
from r2h_batch.types import Trials

__all__ = ["Holding", "hold"]


@dataclass(frozen=True)
class Holding:
    """B trials with the object in the gripper: clean poses, the grasp, and where all bodies sit.

    Rows that are not `active` have the identity for every pose; the stages pass over them.
    """

    active: Bool[Tensor, " b"]
    T_obj_ee: Float32[Tensor, "b 4 4"]  # the grasp as asked for
    T_world_ee: Float32[Tensor, "b 4 4"]
    T_world_hand: Float32[Tensor, "b 4 4"]
    hands: Int32[Tensor, " b"]
    objects: Int32[Tensor, " b"]
    grasp: Grasp
    attached: Float32[Tensor, "b 4 4"]  # T_obj_ee once the pads have met the object
    placed: Placed


def hold(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    T_world_ee: Float32[Tensor, "b 4 4"],
    trials: Trials,
    config: EvalConfig,
    *,
    threads: int | None = None,
) -> Holding:
    """B trials with the gripper closed on the object; rows with a pose that is none, or an unknown body, are not active."""
    T_world_hand, objects, hands = trials.T_world_hand, trials.object_index.contiguous(), trials.hand_index
    poses = torch.stack(
        [T_obj_ee.detach(), T_world_ee.detach(), T_world_hand.detach()]
    )  # as one: a small batch is all overhead
    active = se3.is_pose(poses).all(0)
    if objects.is_cuda:  # on a CPU they were looked at before any work
        for index, count in ((objects, len(scene.objects)), (hands, len(scene.hands.set))):
            active = active & (index >= 0) & (index < count)
        objects, hands = torch.where(active, objects, 0), torch.where(active, hands, 0)
    T_obj_ee, T_world_ee, T_world_hand = _usable(poses, active).unbind(0)
    limits = config.thresholds
    grasp = close_gripper(
        scene.grasp_tables, T_obj_ee, objects,
        w_max=limits.w_max_m, w_min=limits.w_min_m, mode=config.width, threads=threads,
    )  # fmt: skip
    attached = attach(T_obj_ee, grasp.shift_m)
    placed = scene.place(objects, hands, attached, T_world_hand, grasp.opening_m, threads=threads)
    return Holding(active, T_obj_ee, T_world_ee, T_world_hand, hands, objects, grasp, attached, placed)


def _usable(T: Float32[Tensor, "k b 4 4"], active: Bool[Tensor, " b"]) -> Float32[Tensor, "k b 4 4"]:
    """Orthonormal poses, the identity where a row is not active."""
    eye, kept = torch.eye(4, dtype=T.dtype, device=T.device), active[:, None, None]
    # twice: a row that is no pose may hold anything, and must not reach the orthonormalisation
    return torch.where(kept, se3.orthonormalise(torch.where(kept, T, eye)), eye).contiguous()
