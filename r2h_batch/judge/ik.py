"""Joint angles that bring the ee frame to a pose: all branches of a UR arm, up to 8 postures of other
arms, residuals, and whether it is proven that none exists."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Float32, Int, UInt8
from torch import Tensor

from r2h_batch.base.launch import init_warp, over_trials
from r2h_batch.judge import ik_any
from r2h_batch.kernels.ik import step as ik_step
from r2h_batch.kernels.plan.codes import BRANCHES
from r2h_batch.kernels.robot.fk import UrParameters, vec6d
from r2h_batch.scene.robot import Robot, ur_lengths
from r2h_batch.scene.robot_file import DEFAULT_ROBOT, load_robot

ROTATION_LEVER_M = 0.1
"""How many metres a radian counts in the residual of an unreachable target [choice]: about the
fingers' length."""
POSITION_TOLERANCE_M = 1e-5
ROTATION_TOLERANCE_RAD = 1e-5
CHUNK = 128
"""Targets a thread takes at a time: at about 3 us each the launch costs next to nothing, and no
core waits long at the end."""


@dataclass(frozen=True)
class IkResult:
    """Up to 8 branches for each of B targets.

    Slot 4 s + 2 e + w holds the branch with s = 1 where the wrist centre lies behind the shoulder
    (seen along the arm's plane), e = 1 where sin q3 < 0, w = 1 where sin q5 < 0. Each joint stands
    at the turn nearest to home within limits.
    """

    q: Float[Tensor, "b 8 6"]
    """Joint angles, rad; NaN where not valid."""
    valid: Bool[Tensor, "b 8"]
    """The slot holds a solution: the float32 angles in `q` are within the joint limits, and both errors below tolerance."""
    position_error_m: Float[Tensor, "b 8"]
    """Distance between the targets' and the reached ee origin, float64 inside; inf where there is
    no branch."""
    rotation_error_rad: Float[Tensor, "b 8"]
    """Angle between the targets' and the reached ee axes; inf where there is no branch."""
    status: UInt8[Tensor, "b 4"]
    """Solver status of the branch pair 2 s + w: a STATUS_* code of kernels/ik/step.py."""

    @property
    def unproven(self) -> Bool[Tensor, "b"]:
        """True if the numerical search may have missed solutions: the arm has no closed form, and the
        target is not provably out of reach."""
        from r2h_batch.kernels.ik.any_arm import STATUS_NOT_FOUND  # 0.1 s to import, for paths only

        return (self.status >= int(STATUS_NOT_FOUND)).any(1)

    @property
    def reachable(self) -> Bool[Tensor, "b"]:
        """At least one branch was found."""
        return self.valid.any(1)

    @property
    def unreachable_proven(self) -> Bool[Tensor, "b"]:
        """The closed form has no solution, for no pose within about 1 um and 1 urad either. False
        for inactive rows."""
        return (self.status == int(ik_step.STATUS_UNREACHABLE)).all(1)

    @property
    def singular(self) -> Bool[Tensor, "b"]:
        """Some pair has sin q5 = 0 (< 1e-6): its slots hold points of a line of solutions (q6 =
        home if on it)."""
        return (self.status == int(ik_step.STATUS_SINGULAR)).any(1)


@dataclass(frozen=True)
class SearchedIk(IkResult):
    """IK of an arm without a closed form: also how long the search took, and how near it came where it
    found nothing."""

    steps: Int[Tensor, "b 2"]
    """Steps of damped least squares, and how many seeds were tried."""
    nearest: Float[Tensor, "b j"]
    """The posture that came nearest, rad; NaN where one was found."""
    miss_m: Float[Tensor, "b"]
    """By how much it misses, m (a radian counts ROTATION_LEVER_M); inf where one was found."""


def solve_ik(
    T_world_ee: Float[Tensor, "b 4 4"],
    *,
    active: Bool[Tensor, "b"] | None = None,
    robot: Robot | None = None,
    home: Sequence[float] | None = None,
) -> IkResult:
    """All branches for every target, on the device of `T_world_ee`; a row depends on nothing but
    its own target.

    Rows with `active` False, NaN or no rigid transform have no valid branch and are not proven
    unreachable. `robot`: default the UR5e, `home` its own unless given. One that is not of a UR's
    structure is solved by judge/ik_any.py.
    """
    robot = load_robot(DEFAULT_ROBOT) if robot is None else robot
    home = robot.home_q if home is None else tuple(home)
    device = T_world_ee.device
    if active is None:
        active = torch.ones(T_world_ee.shape[:1], dtype=torch.bool, device=device)
    init_warp()
    if robot.family != "ur":
        return SearchedIk(
            *ik_any.solve(
                robot,
                T_world_ee,
                active,
                tolerance=(POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD),
                rotation_lever_m=ROTATION_LEVER_M,
            )
        )
    place = str(device) if device.type == "cpu" else str(wp.device_from_torch(device))
    made = over_trials(
        ik_step.solve_ik_kernel, len(T_world_ee), place, sizes=ik_any.sizes(6), chunk=CHUNK, width=4
    )(
        ur=ur_parameters(robot, home),
        position_tolerance_m=POSITION_TOLERANCE_M,
        rotation_tolerance_rad=ROTATION_TOLERANCE_RAD,
        T_world_ee=T_world_ee.contiguous(),
        active=active.contiguous(),
    )
    return IkResult(*made.values())  # the kernel writes the fields in their order


JACOBIAN_STEPS = 100
"""Steps of the numerical solver per start; it needs 5 to 30."""


def one_branch(
    ik: IkResult,
    T_world_ee: Float[Tensor, "b 4 4"],
    *,
    robot: Robot | None = None,
    home: Sequence[float] | None = None,
) -> Bool[Tensor, "b 8"]:
    """`ik.valid` with one branch left for each target: the one that a numerical Jacobian solver
    started at home reaches.

    As MoveIt's default solver: damped least squares on the whole arm, joints clamped to their
    limits; where it sticks it starts again, here from the committed seeds in order. If that fails
    too, the first valid branch stands in. `robot` and `home` as in `solve_ik`.
    """
    robot = load_robot(DEFAULT_ROBOT) if robot is None else robot
    home = robot.home_q if home is None else tuple(home)
    n, device = len(T_world_ee), T_world_ee.device
    if robot.family != "ur":  # the first posture found is that of the nearest seed
        return ik.valid & (ik.valid.cumsum(1) == 1)
    from r2h_batch.kernels.ik.jacobian import first_branch  # the default has no need of it

    place = str(device) if device.type == "cpu" else str(wp.device_from_torch(device))
    made = over_trials(first_branch, n, place, chunk=64)(
        iterations=JACOBIAN_STEPS,
        **_jacobian_tables(robot, home, place),
        T_world_ee=T_world_ee.contiguous(),
        q=ik.q,
        valid=ik.valid,
    )
    # argmax of 0 and 1 is the first 1: the first valid branch (slot 0 where there is none; `&
    # ik.valid` drops it)
    slot = made["slot"].long()
    slot = torch.where(slot >= 0, slot, ik.valid.to(torch.int8).argmax(1))
    return ik.valid & (torch.arange(BRANCHES, dtype=torch.int64, device=device) == slot[:, None])


@lru_cache(maxsize=64)
def _jacobian_tables(robot: Robot, home: tuple[float, ...], device: str) -> dict[str, wp.array]:
    """Joint frames (the last: the ee in wrist_3), limits and starts for `first_branch`, on a
    device."""
    T = np.stack([*robot.T_parent_joint, robot.T_wrist3_flange @ robot.T_flange_ee])
    starts = np.concatenate([np.array(home)[None], ik_seeds()])
    limits = {"lower": robot.lower, "upper": robot.upper, "starts": starts}
    return {
        "joint_R": wp.array(T[:, :3, :3], dtype=wp.mat33d, device=device),
        "joint_p": wp.array(T[:, :3, 3], dtype=wp.vec3d, device=device),
        **{k: wp.array(x, dtype=wp.float64, device=device) for k, x in limits.items()},
    }


def build_tables(robot: Robot, home: tuple[float, ...], device: str) -> None:
    """Makes the solvers' tables; they are on a CUDA device before this returns, as `Scene`'s own
    are."""
    home_posture(device, home)
    if robot.family == "ur":
        _jacobian_tables(robot, home, device)
    else:
        ik_any.tables(robot, device)
    wp.synchronize_device(device)


@lru_cache(maxsize=64)
def home_posture(device: str, home: tuple[float, ...]) -> Float[Tensor, "1 6"]:
    """Home's joint angles on a device."""
    return torch.from_numpy(np.array([home], np.float32)).to(device)


def nearest_turns(
    q: Float32[Tensor, "b 8 j"], start: Float32[Tensor, "b j"], robot: Robot
) -> Float32[Tensor, "b 8 j"]:
    """The same branches, each joint moved by whole turns to the angle nearest to `start` that the limits allow.

    Args:
        q: (B, 8, J) branches, rad.
        start: (B, J) where a path begins, rad.
        robot: the arm.
    """
    lower, upper = (
        torch.from_numpy(np.array(x, np.float64)).to(q.device) for x in (robot.lower, robot.upper)
    )
    turn = 2 * np.pi
    moved = q.double()
    moved = moved - turn * ((moved - start.double()[:, None]) / turn + 0.5).floor()
    moved = torch.where(moved > upper, moved - turn, moved)
    moved = torch.where(moved < lower, moved + turn, moved)
    nearest = moved.float()
    within = (nearest.double() >= lower) & (nearest.double() <= upper)
    return torch.where(within, nearest, q)


@cache
def ik_seeds() -> np.ndarray:
    """The committed seeds (S, 6) in rad, in the order they are tried; joint 1 is relative to the
    wrist centre's azimuth."""
    with (files("r2h_batch.assets") / "robot" / "ik_seeds.npy").open("rb") as file:
        seeds: np.ndarray = np.load(file)
    seeds.setflags(write=False)
    return seeds


@lru_cache(maxsize=64)
def ur_parameters(robot: Robot, home: tuple[float, ...]) -> UrParameters:
    """The link lengths, limits and home that the kernels need; refuses a robot without a UR's
    structure."""
    ur = UrParameters()
    for name, length in ur_lengths(robot)._asdict().items():
        setattr(ur, name, length)
    ur.home, ur.lower, ur.upper = vec6d(*home), vec6d(*robot.lower), vec6d(*robot.upper)
    return ur


def reference_chain(robot: Robot, **to: Any) -> Any:
    """pytorch-kinematics' chain base -> ee, the reference for FK, Jacobian and its own IK: from airo-models'
    URDF of the arm where it has one, else from the robot's joint frames.

    Keyword arguments go to `chain.to` (dtype, device).
    """
    import airo_models
    import pytorch_kinematics

    if not robot.visuals:
        urdf, last = _urdf_of(robot)
        chain = pytorch_kinematics.build_serial_chain_from_urdf(urdf, last, "l0")
        return chain.to(**to) if to else chain
    text = Path(airo_models.get_urdf_path(robot.visuals)).read_text()
    x, y, z = robot.T_flange_ee[:3, 3]
    ee = (
        '<link name="ee"/><joint name="tool0-ee" type="fixed"><parent link="tool0"/><child link="ee"/>'
        f'<origin rpy="0 0 0" xyz="{x} {y} {z}"/></joint></robot>'
    )
    # lxml refuses the undeclared prefix
    text = re.sub(r'\sdrake:\w+="[^"]*"', "", text).replace("</robot>", ee)
    chain = pytorch_kinematics.build_serial_chain_from_urdf(text.encode(), "ee", "base_link")
    return chain.to(**to) if to else chain


def _urdf_of(robot: Robot) -> tuple[str, str]:
    """The chain of an arm as a URDF, and the name of its last link, the ee."""
    from scipy.spatial.transform import Rotation

    def joint(k: int, kind: str, T: np.ndarray) -> str:
        turn, place = Rotation.from_matrix(T[:3, :3]).as_euler("xyz"), T[:3, 3]
        rpy, xyz = (" ".join(map(repr, x.tolist())) for x in (turn, place))
        return (
            f'<link name="l{k + 1}"/><joint name="j{k}" type="{kind}"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<origin rpy="{rpy}" xyz="{xyz}"/><axis xyz="0 0 1"/><limit lower="-7" upper="7" effort="1" velocity="1"/></joint>'
        )

    n = len(robot.joints)
    joints = [joint(k, "revolute", robot.T_parent_joint[k]) for k in range(n)]
    joints.append(joint(n, "fixed", robot.T_wrist3_ee))
    return f'<robot name="arm"><link name="l0"/>{"".join(joints)}</robot>', f"l{n + 1}"
