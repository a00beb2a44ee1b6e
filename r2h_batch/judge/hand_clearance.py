"""Distance of closed grippers from posed hands: where a hand stands, and where it holds the object."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float32, Int32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.kernels.methods import hand_clearance as kernels
from r2h_batch.scene.grasp_tables import gripper_tables
from r2h_batch.scene.hand import HandModel
from r2h_batch.scene.robot import Robot


@dataclass(frozen=True)
class PosedHand:
    """B posed hands: the kernels' struct, and the tensors that own its memory."""

    struct: Any
    owners: tuple[Any, ...]
    device: str

    def __len__(self) -> int:
        return len(self.owners[0])

    @property
    def points(self) -> Float32[Tensor, "b p 3"]:
        """Points of the convex pieces, each row in a frame of its own, m."""
        points: Tensor = self.owners[0]
        return points


def posed_hand(
    model: HandModel,
    vertices: Float32[Tensor, "b v 3"],
    device: str,
) -> PosedHand:
    """Hands as convex pieces.

    Args:
        model: whose order the vertices have.
        vertices: (b, V, 3) in metres, each row in a frame of its own.
        device: of the result.
    """
    return hand_of_points(model, hand_points(model, vertices, device))


def hand_points(
    model: HandModel, vertices: Float32[Tensor, "b v 3"], device: str
) -> Float32[Tensor, "b p 3"]:
    """The points of each hand's convex pieces, piece by piece, m; arguments as of `posed_hand`."""
    ids = model.piece_vertices.to(vertices.device).long()
    return vertices[:, ids].float().to(device).contiguous()


def hand_of_points(model: HandModel, points: Float32[Tensor, "b p 3"]) -> PosedHand:
    """The hands whose `hand_points` these are."""
    device, ids = str(points.device), model.piece_vertices
    ball = torch.empty((len(points), len(model.piece_names), 4), dtype=torch.float32, device=device)
    start = model.piece_offsets.to(torch.int32).to(device).contiguous()
    struct = kernels.PosedHands()
    struct.n_pieces, struct.n_points = len(model.piece_names), len(ids)
    struct.piece_start = wp.from_torch(start)
    struct.points = wp.from_torch(points.reshape(-1, 3), dtype=wp.vec3)
    struct.ball = wp.from_torch(ball.reshape(-1, 4), dtype=wp.vec4)
    over_trials(
        kernels.enclose_pieces, len(points), device, outputs={"ball": struct.ball}, chunk=64
    )(hands=struct)
    return PosedHand(struct, (points, ball, start), device)


def gripper_clearance(
    robot: Robot,
    hand: PosedHand,
    T_hand_ee: Float32[Tensor, "m 4 4"],
    opening_m: Float32[Tensor, " m"],
    row: Int32[Tensor, " b"],
    count: Int32[Tensor, " b"],
    width: int,
    *,
    cap_m: float,
) -> Float32[Tensor, "b k"]:
    """Distance of several grippers from each hand.

    Args:
        robot: with the gripper.
        hand: b hands.
        T_hand_ee: (m, 4, 4) gripper poses in the frame of a hand's vertices.
        opening_m: (m,) their openings.
        row: (b,) where the grippers of a hand begin in these two.
        count: (b,) how many a hand has.
        width: columns of the result.
        cap_m: distances are computed up to this.

    Returns:
        (b, width) metres, at most `cap_m`; 0 where they meet, and from `count` on.
    """
    n, sizes = len(hand), {"clearance": width}
    if n == 0 or width == 0:
        return torch.zeros((n, width), dtype=torch.float32, device=hand.device)
    made = over_trials(kernels.gripper_to_hand, n, hand.device, sizes=sizes, chunk=8, width=width)(
        gripper=gripper_tables(robot, hand.device),
        hands=hand.struct,
        cap=cap_m,
        row=row.to(torch.int32).contiguous(),
        count=count.to(torch.int32).contiguous(),
        T=T_hand_ee.contiguous(),
        opening=opening_m.contiguous(),
    )
    clearance: Tensor = made["clearance"]
    return clearance
