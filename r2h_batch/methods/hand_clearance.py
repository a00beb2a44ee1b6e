"""Which gripper poses keep clear of a hand: candidates against a hand on the object, rolls against a hand in the world."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float32, Int32
from torch import Tensor

from r2h_batch.grasp import gripper_tables
from r2h_batch.hand import HandModel
from r2h_batch.launch import launch_trials

__all__ = ["PosedHand", "gripper_clearance", "posed_hand"]


@dataclass(frozen=True)
class PosedHand:
    """The kernels' struct of B posed hands and the tensors that own its memory."""

    struct: Any
    owners: tuple[Any, ...]
    device: str

    def __len__(self) -> int:
        return len(self.owners[0])


def posed_hand(
    model: HandModel, vertices: Float32[Tensor, "b v 3"], device: str, *, threads: int | None = None
) -> PosedHand:
    """Hands with these vertices (the model's order, any one frame a row) as convex pieces."""
    from r2h_batch.kernels import hand_clearance as kernels

    ids = model.piece_vertices.to(vertices.device).long()
    points = vertices[:, ids].float().to(device).contiguous()
    ball = torch.empty((len(points), len(model.piece_names), 4), dtype=torch.float32, device=device)
    start = model.piece_offsets.to(torch.int32).to(device).contiguous()
    struct = kernels.PosedHands()
    struct.n_pieces, struct.n_points = len(model.piece_names), len(ids)
    struct.piece_start = wp.from_torch(start)
    struct.points = wp.from_torch(points.reshape(-1, 3), dtype=wp.vec3)
    struct.ball = wp.from_torch(ball.reshape(-1, 4), dtype=wp.vec4)
    launch_trials(kernels.enclose_pieces, len(points), [struct, struct.ball], device=device, threads=threads, chunk=64)
    return PosedHand(struct, (points, ball, start), device)


def gripper_clearance(
    hand: PosedHand,
    T_hand_ee: Float32[Tensor, "m 4 4"],
    opening_m: Float32[Tensor, " m"],
    row: Int32[Tensor, " b"],
    count: Int32[Tensor, " b"],
    width: int,
    *,
    cap_m: float,
    threads: int | None = None,
) -> Float32[Tensor, "b k"]:
    """Distance (m) of gripper k < `width` of every hand: at most `cap_m`, 0 where they meet or k >= count.

    Gripper k of hand i stands at row[i] + k of `T_hand_ee` (ee in the frame of the hand's vertices) and `opening_m`.
    """
    from r2h_batch.kernels import hand_clearance as kernels

    n = len(hand)
    out = torch.zeros((n, width), dtype=torch.float32, device=hand.device)
    if n == 0 or width == 0:
        return out
    inputs = [
        gripper_tables(hand.device), hand.struct, float(cap_m), wp.from_torch(row.to(torch.int32).contiguous()),
        wp.from_torch(count.to(torch.int32).contiguous()), wp.from_torch(T_hand_ee.contiguous(), dtype=wp.mat44),
        wp.from_torch(opening_m.contiguous()), wp.from_torch(out),
    ]  # fmt: skip
    launch_trials(kernels.gripper_to_hand, n, inputs, device=hand.device, threads=threads, chunk=8, width=width)
    return out
