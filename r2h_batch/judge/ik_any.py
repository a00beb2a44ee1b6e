"""Joint angles of an arm without a closed form: damped least squares from seeds, up to eight
postures that differ (kernels/ik/any_arm.py). What it does not find may still exist."""

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Bool, Float32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.base.launch.instances import of_joints
from r2h_batch.kernels.plan.codes import BRANCHES
from r2h_batch.scene.robot import Robot, ee_pose, forward_kinematics

SEEDS = 1024
"""Postures from which the nearest are taken; more find little more, and the search among them costs more."""
FROM_HOME_M2 = 0.003
"""Weight of a squared radian from home in the choice of the nearest: with it postures lie as near
to home as those of a search that takes no account of it and tries three times as many."""
TRIED = 64
"""Number of seeds nearest to a target that are tried; where all fail, as many others are tried."""
ITERATIONS = 20
"""Steps from a seed; four times as many from those of the others that come near."""
APART_RAD = 0.25
"""Postures that differ less in every joint count as one."""


def solve(
    robot: Robot,
    T_world_ee: Float32[Tensor, "b 4 4"],
    active: Bool[Tensor, " b"],
    *,
    tolerance: tuple[float, float],
    rotation_lever_m: float,
) -> Iterable[Tensor]:
    """The postures of each target.

    Args:
        robot: any chain of turning joints.
        T_world_ee: targets, m.
        active: rows to solve.
        tolerance: m and rad, of what is returned.
        rotation_lever_m: what a radian of the residual counts for.

    Returns:
        The fields of `judge.ik.SearchedIk`.
    """
    from r2h_batch.kernels.ik import any_arm  # 0.1 s to import, and a UR needs none

    joints, device = len(robot.joints), T_world_ee.device
    place = str(device) if device.type == "cpu" else str(wp.device_from_torch(device))
    chain, seeds = tables(robot, place)
    made: dict[str, Tensor] = over_trials(
        of_joints(any_arm.solve_any, joints), len(active), place, sizes=sizes(joints), chunk=16
    )(
        chain=chain,
        seeds=seeds,
        most=TRIED,
        iterations=ITERATIONS,
        apart=APART_RAD,
        position_tolerance_m=tolerance[0],
        rotation_tolerance_rad=tolerance[1],
        rotation_lever_m=rotation_lever_m,
        T_world_ee=T_world_ee.contiguous(),
        active=active.contiguous(),
    )
    return made.values()


def sizes(joints: int) -> dict[str, Any]:
    """Further dimensions of what the solvers' kernels write."""
    branches = dict.fromkeys(("valid", "position_error", "rotation_error"), int(BRANCHES))
    return {"q": (int(BRANCHES), joints), **branches, "status": 4, "steps": 2, "nearest": joints}


@lru_cache(maxsize=16)
def tables(robot: Robot, device: str) -> tuple[Any, Any]:
    """The kernels' `Chain` and `Seeds` of a robot, on a device.

    Seeds are Halton's sequence within the joint limits (Halton 1960). A turn beyond +-180 degrees
    repeats postures: they stay within it.
    """
    joints = len(robot.joints)
    T = np.stack([*robot.T_parent_joint, robot.T_wrist3_ee])
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    # these take half a second to import, and a UR needs none
    from scipy.spatial.transform import Rotation
    from scipy.stats import qmc

    from r2h_batch.kernels.ik import any_arm

    q = lower + (upper - lower) * qmc.Halton(joints, scramble=False).random(SEEDS + 1)[1:]
    ee = ee_pose(robot, q)
    chain = of_joints(any_arm.Chain, joints)()
    chain.R = wp.array(T[:, :3, :3], dtype=wp.mat33d, device=device)
    chain.p = wp.array(T[:, :3, 3], dtype=wp.vec3d, device=device)
    chain.frames = wp.array(T[:, :3].ravel(), dtype=float, device=device)
    vecq = type(chain.home)
    # float32 rounds to the nearest number: these are within the limits
    chain.lower = vecq(np.nextafter(robot.lower, np.inf, dtype=np.float32))
    chain.upper = vecq(np.nextafter(robot.upper, -np.inf, dtype=np.float32))
    chain.home = vecq(robot.home_q)
    chain.center = wp.vec3d(*forward_kinematics(robot, np.zeros(joints))[1, :3, 3])
    # from the first joint's origin no further than the stretched chain
    chain.reach = float(np.linalg.norm(T[1:, :3, 3], axis=1).sum())
    seeds = of_joints(any_arm.Seeds, joints)()
    seeds.q = wp.array(q, dtype=float, device=device)
    seeds.p = wp.array(ee[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device)
    turns = Rotation.from_matrix(ee[:, :3, :3]).as_quat().astype(np.float32)
    seeds.turn = wp.array(turns, dtype=wp.quat, device=device)
    away = FROM_HOME_M2 * ((q - np.array(robot.home_q)) ** 2).sum(1)
    seeds.away = wp.array(away, dtype=float, device=device)
    return chain, seeds
