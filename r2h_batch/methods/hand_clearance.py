"""Which gripper poses keep clear of a hand: candidates against a hand on the object, rolls against
a hand in the world."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float32, Int32
from torch import Tensor

from r2h_batch.bodies.hand import HandModel
from r2h_batch.kernels.methods import hand_clearance as kernels
from r2h_batch.launch import launch_trials
from r2h_batch.scene.grasp_tables import gripper_tables

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
    ids = model.piece_vertices.to(vertices.device).long()
    points = vertices[:, ids].float().to(device).contiguous()
    ball = torch.empty((len(points), len(model.piece_names), 4), dtype=torch.float32, device=device)
    start = model.piece_offsets.to(torch.int32).to(device).contiguous()
    struct = kernels.PosedHands()
    struct.n_pieces, struct.n_points = len(model.piece_names), len(ids)
    struct.piece_start = wp.from_torch(start)
    struct.points = wp.from_torch(points.reshape(-1, 3), dtype=wp.vec3)
    struct.ball = wp.from_torch(ball.reshape(-1, 4), dtype=wp.vec4)
    launch_trials(
        kernels.enclose_pieces,
        len(points),
        inputs={"hands": struct},
        outputs={"ball": struct.ball},
        device=device,
        threads=threads,
        chunk=64,
    )
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
    """Distance (m) of gripper k < `width` of every hand: at most `cap_m`, 0 where they meet or k >=
    count.

    Gripper k of hand i stands at row[i] + k of `T_hand_ee` (ee in the frame of the hand's vertices)
    and `opening_m`.
    """
    n = len(hand)
    out = torch.zeros((n, width), dtype=torch.float32, device=hand.device)
    if n == 0 or width == 0:
        return out
    launch_trials(
        kernels.gripper_to_hand,
        n,
        inputs={
            "gripper": gripper_tables(hand.device),
            "hands": hand.struct,
            "cap": cap_m,
            "row": row.to(torch.int32).contiguous(),
            "count": count.to(torch.int32).contiguous(),
            "T": T_hand_ee.contiguous(),
            "opening": opening_m.contiguous(),
        },
        outputs={"clearance": out},
        device=hand.device,
        threads=threads,
        chunk=8,
        width=width,
    )
    return out
