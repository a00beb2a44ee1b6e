"""Straight ways of the gripper into a grasp and up from it: their waypoints, and the IK branches that follow them."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.judge.ik import solve_ik
from r2h_batch.kernels.plan.codes import BRANCHES
from r2h_batch.kernels.plan.line import follow_lines
from r2h_batch.scene.kept import KeptWith
from r2h_batch.scene.scene import Scene

WAY_M = 0.1
"""Length of the straight way in, and of the way up [choice]."""
STEPS = (10, 20, 40)
"""Waypoints of a way after its first, 10, 5 and 2.5 mm apart [choice]: between them the joints go straight. A branch takes
the widest spacing at which it follows."""
MOST_TURN_RAD = 0.5
"""A joint that turns farther from one waypoint to the next does not follow the line [choice]."""
MOST_OFF_M = 1e-4
"""A gripper that leaves the line farther between two waypoints does not follow it [choice]: what float32 makes unreliable."""


class Ways(NamedTuple):
    """Ways in and up of B x 8 branches, of which `followed` waypoints are of use."""

    way_in: Float32[Tensor, "b 8 k j"]  # to the grasp, rad
    way_up: Float32[Tensor, "b 8 k j"]  # down to the grasp
    followed: Int32[Tensor, "b 8"]  # of both together, the grasp twice
    off_m: Float32[Tensor, "b 8"]  # how far the gripper leaves the straight ways at most

    @property
    def whole(self) -> Bool[Tensor, "b 8"]:
        """Branches that follow both to their ends."""
        return self.followed == 2 * self.way_in.shape[2]


def straight_ways(
    scene: Scene,
    T_world_ee: Float32[Tensor, "b 4 4"],
    q: Float32[Tensor, "b 8 j"],
    valid: Bool[Tensor, "b 8"],
    steps: int,
) -> Ways:
    """The ways of each branch: along the gripper's axis from WAY_M before the grasp, and WAY_M up along the vertical.

    Args:
        scene: the robot.
        T_world_ee: (B, 4, 4) grasps, m.
        q: (B, 8, J) branches at the grasp, rad.
        valid: (B, 8) which of them are branches.
        steps: waypoints of a way after its first.
    """
    b, joints = len(T_world_ee), q.shape[2]
    m = (
        WAY_M / steps * torch.arange(1, steps + 1, dtype=torch.float32, device=q.device)
    )  # from the grasp
    lever, both = gripper_lever_m(scene), []
    for up in (False, True):
        T = T_world_ee[:, None].repeat(1, steps + 1, 1, 1)
        if up:
            T[:, 1:, 2, 3] += m
        else:
            T[:, 1:, :3, 3] -= m[:, None] * T_world_ee[:, None, :3, 2]
        ik = solve_ik(T[:, 1:].flatten(0, 1), robot=scene.robot, home=scene.config.workplace.home_q)
        size: dict[str, int | tuple[int, ...]]
        size = {"path": (int(BRANCHES), steps + 1, joints)}
        size |= {"followed": int(BRANCHES), "off": int(BRANCHES)}
        both.append(
            over_trials(scene.sized(follow_lines), b, scene.device, sizes=size, chunk=16)(
                most_turn=MOST_TURN_RAD,
                most_off=MOST_OFF_M,
                lever=lever,
                world=scene.world,
                tool=scene.tool,
                q=torch.cat([q[:, None], ik.q.view(b, steps, BRANCHES, joints)], 1),
                valid=torch.cat([valid[:, None], ik.valid.view(b, steps, BRANCHES)], 1),
                T_world_ee=T,
            )
        )
    way_in, way_up = both
    return Ways(
        way_in["path"],
        way_up["path"],
        way_in["followed"] + way_up["followed"],
        torch.maximum(way_in["off"], way_up["off"]),
    )


def resampled(path: Float32[Tensor, "*b k j"]) -> Float32[Tensor, "*b w j"]:
    """The same way with as many waypoints as the closest spacing has: more postures of the same straight lines."""
    n = STEPS[-1] // (path.shape[-2] - 1)
    t = torch.arange(n, dtype=torch.float32, device=path.device)[:, None] / n
    first, delta = path[..., :-1, None, :], path.diff(dim=-2)[..., None, :]
    return torch.cat([(first + t * delta).flatten(-3, -2), path[..., -1:, :]], -2)


@KeptWith
def gripper_lever_m(scene: Scene) -> float:
    """No point of the gripper is farther from the ee (m)."""
    T_ee_wrist = np.linalg.inv(scene.T_wrist_ee)
    world, k = scene.world, len(scene.robot.joints) + 1
    ends = np.stack([world.link_c0.numpy()[k], world.link_c1.numpy()[k]])
    at = ends @ T_ee_wrist[:3, :3].T + T_ee_wrist[:3, 3]
    return float(np.sqrt((at * at).sum(1)).max() + world.link_radius.numpy()[k])
