"""How far closing fingers come from one opening to another, and how low they are on the way."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.judge.grasp import gripper_poses
from r2h_batch.kernels.grasp.lowest import lowest_points
from r2h_batch.scene.kept import KeptWith
from r2h_batch.scene.scene import Scene

CELLS = 1024
"""Openings between which the fingers' way is tabled: 0.1 mm of a gripper that opens 10 cm."""
BENDS = 64
"""Openings at which their way is looked at for bends: rounding would hide those of much less than 1 mm."""
PARTS = 16
"""Parts of a way whose lowest points are known [choice]: a finger leaves a straight line by less than 0.05 mm in one."""

ROUNDING_M = 5e-6
"""Heights in float32 are exact to this."""


class FingersWay(NamedTuple):
    """How far the fingers have come, from shut to an opening: at most, of all points of the gripper together.

    Attributes:
        step_m: between the openings of the table.
        way_m: (CELLS + 1,) at these openings, from 0.
    """

    step_m: float
    way_m: Float32[Tensor, " c"]

    def at(self, opening_m: Float32[Tensor, " b"]) -> Float32[Tensor, " b"]:
        """At these openings, m, by straight lines between those of the table."""
        cell = opening_m / self.step_m
        low = cell.floor().clamp(0, len(self.way_m) - 2)
        first, last = self.way_m[low.long()], self.way_m[low.long() + 1]
        return first + (cell - low) * (last - first)


@KeptWith
def fingers_way(scene: Scene) -> FingersWay:
    """The way of a scene's fingers: from one opening to the next no point goes farther than its middle does and its radius
    times the turn."""
    step = scene.robot.open_gap_m / CELLS
    opening = step * torch.arange(CELLS + 1, dtype=torch.float32, device=scene.device)
    R, p = (x.double() for x in gripper_poses(scene.robot, opening))
    radii = gripper_radii(scene)
    turn = R.diff(dim=0).square().flatten(2).sum(2).sqrt() / 2**0.5  # 2 sin(angle / 2)
    moved = p.diff(dim=0).square().sum(2).sqrt() + radii * turn
    way = torch.cumsum(torch.cat([moved.new_zeros(1), moved.amax(1)]), 0)
    return FingersWay(step, way.float())


@KeptWith
def fingers_bend(scene: Scene) -> float:
    """No point of closing fingers has a larger second derivative by the opening (1/m)."""
    robot = scene.robot
    opening = torch.linspace(
        robot.closed_gap_m, robot.open_gap_m, BENDS + 1, dtype=torch.float32, device=scene.device
    )
    R, p = (x.double() for x in gripper_poses(robot, opening))
    moves, turns = (x.diff(n=2, dim=0).square().sum(2).sqrt() for x in (p, R.flatten(2)))
    step = (robot.open_gap_m - robot.closed_gap_m) / BENDS
    return float((moves + gripper_radii(scene) * turns).max()) / step**2


@KeptWith
def gripper_radii(scene: Scene) -> Float64[Tensor, " g"]:
    """No point of a gripper primitive is farther from its middle, m."""
    first = len(scene.tables.arm_order)
    axis, radius = (getattr(scene.world, k).numpy()[first:] for k in ("cap_axis", "cap_radius"))
    far = np.sqrt((axis * axis).sum(1)) + radius
    return torch.from_numpy(far.astype(np.float64)).to(scene.device)


class Heights(NamedTuple):
    """How far closing grippers are above the table's top: at least, on each of PARTS parts of their way (m), (B, PARTS)."""

    least_m: Float32[Tensor, "b p"]

    def within(self, row: Tensor, low: Tensor, high: Tensor) -> Float32[Tensor, " n"]:
        """On the intervals [low, high] of the ways of rows: shares of the way."""
        edges = torch.arange(PARTS + 1, dtype=torch.float32, device=low.device) / PARTS
        meets = (edges[1:] > low[:, None]) & (edges[:-1] < high[:, None])
        return torch.where(meets, self.least_m[row], torch.inf).amin(1)


def heights(
    scene: Scene,
    q: Float32[Tensor, "b j"],
    open_m: Float32[Tensor, " b"],
    shut_m: Float32[Tensor, " b"],
) -> Heights:
    """Heights of B grippers above the table's top while their fingers close.

    The way of a point over a part's openings leaves the straight line between the ends by at most an eighth of the bend
    times the squared openings, so the lower end less that is a lower bound.

    Args:
        scene: robot and table.
        q: (B, J) postures at which the grippers close, rad.
        open_m: (B,) the gap between the pads at the beginning.
        shut_m: (B,) and at the end.
    """
    place = scene.config.workplace
    top_m = place.table_center[2] + place.table_half[2]
    share = torch.arange(PARTS + 1, dtype=torch.float32, device=open_m.device) / PARTS
    opening = open_m[:, None] + share * (shut_m - open_m)[:, None]
    sizes = {"lowest": PARTS + 1}
    kernel = scene.sized(lowest_points)
    made = over_trials(kernel, len(opening), scene.device, sizes=sizes, chunk=64)(
        tool=scene.tool,
        gripper=scene.grasp_tables.gripper,
        q=q.contiguous(),
        opening=opening.contiguous(),
    )
    low = made["lowest"] - top_m
    off = fingers_bend(scene) * ((shut_m - open_m) / PARTS).square() / 8 + ROUNDING_M
    return Heights(torch.minimum(low[:, :-1], low[:, 1:]) - off[:, None])
