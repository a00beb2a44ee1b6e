"""Twin of kernels/witness/change.py: margins' changes as differentiable functions of the poses, by torch's autograd in float64.

A margin is a distance between two points that the evaluator found. To first order it changes as these points are carried
along (Danskin): each function here is that change, zero at the poses of the witness (`_0`). `Changes` puts them together from
the same witnesses.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.config import EvalConfig
from r2h_batch.judge.ik import ROTATION_LEVER_M
from r2h_batch.kernels.witness.change import CUT, NO_MATERIAL, TOO_THIN, TOO_WIDE
from r2h_batch.kernels.witness.closing import EMPTY, MATERIAL, STEP_HIGH, STEP_LOW
from r2h_batch.scene.robot import UrLengths, ee_pose, gap_from_drive, gripper_primitives_at, ur_lengths
from r2h_batch.scene.scene import Scene
from r2h_batch.training.witnesses import Witnesses
from r2h_batch.types import CRITERIA, CollidingPair, PlanReason


@dataclass(frozen=True)
class Closing:
    """Between which points the pads stand, at the grasp `T_obj_ee`: 4 points are low, high as met,
    low, high as judged.

    `slope_*`: how far y follows a wall of the pads' prism that cuts the surface there; `lift`: how
    the pads rise per metre of opening. `state`: what the opening depends on, a code of
    kernels/witness/closing.py.
    """

    T_obj_ee: Float[Tensor, "b 4 4"]
    point_obj: Float[Tensor, "b 4 3"]
    slope_x: Float[Tensor, "b 4"]
    slope_z: Float[Tensor, "b 4"]
    lift: Float[Tensor, " b"]
    state: Int32[Tensor, " b"]
    centred: Bool[Tensor, " b"]
    """the pads hold the object: closing has moved it to their middle"""


@dataclass(frozen=True)
class Closed:
    """First-order changes of width, opening and shift (m), zero at the poses of the witness."""

    width: Float[Tensor, " b"]
    opening: Float[Tensor, " b"]
    shift: Float[Tensor, " b"]


@dataclass(frozen=True)
class Contact:
    """A point of the object and the gripper primitive nearest to it, at an opening. Normal: ee
    frame, towards the object."""

    point_obj: Float[Tensor, "b 3"]
    normal_ee: Float[Tensor, "b 3"]
    finger: Float[Tensor, "b 3"]
    """velocity of the primitive's point, per metre of opening"""
    found: Bool[Tensor, " b"]


STEEPEST = 0.05
"""Least 1 - dw/dg: the opening moves by at most 20 times what the material does."""


def closed(T_obj_ee: Float[Tensor, "b 4 4"], c: Closing) -> Closed:
    """How width, opening and shift change with the grasp: the opening is the fixed point of width
    and pad height."""
    # Shapes: four witness points a row, (B, 4, 3): low and high of what the pads meet, low and high
    # of what is judged. d: how each moves in the ee frame as the grasp changes, the object being
    # fixed in its own.
    x0 = se3.apply(se3.inverse(c.T_obj_ee)[:, None], c.point_obj)
    d = se3.apply(se3.inverse(T_obj_ee)[:, None], c.point_obj) - x0
    # A point that slides along the surface stays on the prism's boundary: it gives back slope *
    # (its move across)
    y = d[..., 1] - c.slope_x * d[..., 0] - c.slope_z * d[..., 2]
    # The prism rises with the opening g, so w = w(T, g): dg = dw/dT dT + dw/dg dg, thus dg = dw|_g
    # / (1 - dw/dg)
    rise = c.slope_z * c.lift[:, None]
    zero = torch.zeros_like(c.lift)
    follows, step = c.state == MATERIAL, (c.state == STEP_LOW) | (c.state == STEP_HIGH)
    material = (y[:, 1] - y[:, 0]) / (1 - (rise[:, 1] - rise[:, 0])).clamp(min=STEEPEST)
    # On a step the pads' ends stand at the step's height z: g follows from z through the linkage,
    # dg = dz / lift
    on_step = torch.where(c.state == STEP_LOW, d[:, 0, 2], d[:, 1, 2]) / torch.where(
        step, c.lift, torch.ones_like(zero)
    )
    opening = torch.where(follows, material, torch.where(step, on_step, zero))
    y = y + rise * torch.where(follows, opening, zero)[:, None]
    return Closed(
        width=torch.where(c.state == EMPTY, zero, y[:, 3] - y[:, 2]),
        opening=torch.where(c.centred, opening, zero),
        shift=torch.where(c.centred, 0.5 * (y[:, 0] + y[:, 1]), zero),
    )


def attached(T_obj_ee: Float[Tensor, "b 4 4"], shift_m: Float[Tensor, " b"], change: Closed) -> Float[Tensor, "b 4 4"]:
    """`grasp.attach` with the shift's change: where the object is held after closing."""
    p = T_obj_ee[:, :3, 3] + T_obj_ee[:, :3, 1] * (shift_m + change.shift)[:, None]
    return se3.from_rotation(T_obj_ee[:, :3, :3], p)


def separation(
    T_obj_ee: Float[Tensor, "b 4 4"],
    T_obj_ee_0: Float[Tensor, "b 4 4"],
    opening: Float[Tensor, " b"],
    c: Contact,
) -> Float[Tensor, " b"]:
    """Change of the distance between an object's point and a gripper primitive; `T_obj_ee` is the
    attachment."""
    x0 = se3.apply(se3.inverse(T_obj_ee_0), c.point_obj)
    moved = se3.apply(se3.inverse(T_obj_ee), c.point_obj) - x0 - c.finger * opening[:, None]
    return torch.where(c.found, se3.dot(c.normal_ee, moved), torch.zeros_like(opening))


@dataclass(frozen=True)
class Poses0:
    """Poses of the first-order changes, and those (`_0`) at which the witnesses
    were found."""

    T_world_ee: Float[Tensor, "b 4 4"]
    T_world_ee_0: Float[Tensor, "b 4 4"]
    T_obj_ee: Float[Tensor, "b 4 4"]  # the attachment
    T_obj_ee_0: Float[Tensor, "b 4 4"]
    opening: Float[Tensor, " b"]  # change of the opening, m


@dataclass(frozen=True)
class Arm:
    """Joint axes and points on them (world frame), and the joint rates per motion of the ee frame
    (damped inverse; more than six joints: pseudo-inverse)."""

    axis: Float[Tensor, "b j 3"]
    origin: Float[Tensor, "b j 3"]
    inverse: Float[Tensor, "b j 6"]
    T_world_ee: Float[Tensor, "b 4 4"]


def receded(point_obj: Float[Tensor, "b 3"], away: Float[Tensor, "b 3"], poses: Poses0) -> Float[Tensor, " b"]:
    """How far a point of the held object goes along `away` (world frame)."""
    at = se3.apply(se3.matmul(poses.T_world_ee_0, se3.inverse(poses.T_obj_ee_0)), point_obj)
    now = se3.apply(se3.matmul(poses.T_world_ee, se3.inverse(poses.T_obj_ee)), point_obj)
    return se3.dot(away, now - at)


FIXED = -1
"""A carrier of a point: nothing that moves. The others, for an arm of J joints: 0 to J a link (J
with the ee), J + 1 the gripper, J + 2 the held object."""


def carried(
    point: Float[Tensor, "b 3"],
    carrier: Int64[Tensor, " b"],
    finger: Float[Tensor, "b 3"],
    poses: Poses0,
    arm: Arm,
) -> Float[Tensor, "b 3"]:
    """How a point (world frame) moves with what carries it. `finger`: its velocity per metre of
    opening, ee frame."""
    # All carriers are worked out for all rows and the right one is picked: rows differ, and a
    # gather would split the batch
    x_ee = se3.apply(se3.inverse(poses.T_world_ee_0), point)
    with_ee = se3.apply(poses.T_world_ee, x_ee) - point
    fingers = se3.rotate(poses.T_world_ee_0[:, :3, :3], finger * poses.opening[:, None])
    x_obj = se3.apply(poses.T_obj_ee_0, x_ee)
    with_object = se3.apply(se3.matmul(poses.T_world_ee, se3.inverse(poses.T_obj_ee)), x_obj) - point

    twist = ee_motion(poses)
    with_link = torch.zeros_like(point)
    ee = arm.axis.shape[1]
    for j in range(ee - 1):
        rate = torch.zeros_like(point[:, 0])
        for k in range(6):
            rate = rate + arm.inverse[:, j, k] * twist[:, k]
        lever = torch.linalg.cross(arm.axis[:, j], point - arm.origin[:, j])
        with_link = with_link + torch.where((carrier > j)[:, None], rate[:, None] * lever, 0.0)

    out = torch.where((carrier == ee)[:, None], with_ee, with_link)
    out = torch.where((carrier == ee + 1)[:, None], with_ee + fingers, out)
    out = torch.where((carrier == ee + 2)[:, None], with_object, out)
    return torch.where((carrier == FIXED)[:, None], 0.0, out)


def ee_motion(poses: Poses0) -> Float[Tensor, "b 6"]:
    """Motion of the ee frame: of its origin (m), and its turn (rad), world frame, to first
    order."""
    R, R0 = poses.T_world_ee[:, :3, :3], poses.T_world_ee_0[:, :3, :3]
    # R = exp([w]) R0 moves each axis by w x a_k; sum_k a_k x (w x a_k) = 2 w gives the turn back,
    # exact to first order
    turn = sum(torch.linalg.cross(R0[:, :, k], R[:, :, k]) for k in range(3))
    return torch.cat([poses.T_world_ee[:, :3, 3] - poses.T_world_ee_0[:, :3, 3], 0.5 * turn], 1)


def missed(T_world_ee: Float[Tensor, "b 4 4"], ur: UrLengths) -> Float[Tensor, " b"]:
    """By how much the arm misses a target with the hand turned as asked (m): the closed form of
    kernels/ik/nearest.py.

    The wrist centre may be too near to the axis of joint 1, and beyond or within what both links
    reach.
    """
    R = T_world_ee[:, :3, :3]
    wrist = T_world_ee[:, :3, 3] - ur.tool * R[:, :, 2]
    x, y, height = wrist[:, 0], wrist[:, 1], wrist[:, 2] - ur.d1
    # Joint 1 can put the wrist centre only onto a cylinder of radius d4 about its axis or beyond:
    # `off` is missing within it
    square = x * x + y * y
    r = _root(square)
    off = (ur.d4 - r).clamp(min=0.0)
    rho = _root(square - ur.d4**2)
    least = torch.full_like(x, torch.inf)
    for shoulder in (1.0, -1.0):
        c, s = x * shoulder * rho + y * ur.d4, y * shoulder * rho - x * ur.d4
        scale = _root(c * c + s * s)
        c, s = c / scale, s / scale
        # The tool's z axis in the arm's plane (joint 1 turned): its part square to that plane is
        # cos q5
        z_x, z_z = c * R[:, 0, 2] + s * R[:, 1, 2], R[:, 2, 2]
        sin_q5 = _root(z_x * z_x + z_z * z_z)
        for flip in (1.0, -1.0):
            a = shoulder * rho - flip * ur.d5 * z_z / sin_q5
            b = height + flip * ur.d5 * z_x / sin_q5
            d = _root(a * a + b * b)
            beyond = torch.maximum(d - ur.a2 - ur.a3, abs(ur.a2 - ur.a3) - d).clamp(min=0.0)
            least = torch.minimum(least, _root(beyond * beyond + off * off))
    return least


def missed_by(
    T_world_ee: Float[Tensor, "b 4 4"],
    T_reached: Float[Tensor, "b 4 4"],
    rotation_lever_m: float,
) -> Float[Tensor, " b"]:
    """By how much a posture misses a target.

    Args:
        T_world_ee: (B, 4, 4) targets, m.
        T_reached: (B, 4, 4) ee at the posture, m.
        rotation_lever_m: what a radian counts for.

    Returns:
        (B,) m.
    """
    away = T_world_ee[:, :3, 3] - T_reached[:, :3, 3]
    R, R0 = T_world_ee[:, :3, :3], T_reached[:, :3, :3]
    # sum_k a_k x R a_k = 2 sin(angle) axis, and the trace is 1 + 2 cos(angle)
    turn = sum(torch.linalg.cross(R0[:, :, k], R[:, :, k]) for k in range(3))
    cosine = sum((se3.dot(R0[:, :, k], R[:, :, k]) for k in range(3)), torch.full_like(away[:, 0], -1.0))
    angle = torch.atan2(_root(se3.dot(turn, turn)), cosine)
    return _root(se3.dot(away, away)) + rotation_lever_m * angle


def _root(square: Tensor) -> Tensor:
    """Square roots; below 1e-18 the value 1e-9 and gradient 0."""
    return square.clamp(min=1e-18).sqrt()


def _unit(way: Tensor, counts: Tensor) -> Tensor:
    length = se3.dot(way, way).sqrt()[:, None]
    return torch.where(counts[:, None] & (length > 0), way / length.clamp(min=1e-9), 0.0)


class Changes:
    """The first-order change of all margins (B, C) as a function of the poses; float64."""

    def __init__(self, scene: Scene, config: EvalConfig, found: Any, held: Any, goal: Any, w: Witnesses) -> None:
        double = {k: v.double() for k, v in vars(held).items() if isinstance(v, Tensor) and v.is_floating_point()}
        self.held, self.goal, self.w, self.scene = replace(held, **double), goal, w, scene
        self.evaluated, self.active = found["evaluated"], held.active[:, None, None]
        self.home = torch.from_numpy(ee_pose(scene.robot, scene.config.workplace.home_q)).double()
        self.unreachable = (goal.reason == int(PlanReason.IK_UNREACHABLE)) | (
            goal.reason == int(PlanReason.IK_NOT_FOUND)
        )
        self.start = goal.reason == int(PlanReason.START_IN_COLLISION)

    def __call__(self, T_obj_ee: Float[Tensor, "b 4 4"], T_world_ee: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b c"]:
        """The changes, m."""
        held, w, goal, by = self.held, self.w, self.goal, self.w.decided["stability_by"]
        grasp = held.grasp
        T_obj_ee = torch.where(self.active, T_obj_ee, held.T_obj_ee)
        T_world_ee = torch.where(self.active, T_world_ee, held.T_world_ee)
        c = {k: v.double() if v.is_floating_point() else v for k, v in w.closing.items()}
        centred = (c["state"] > 0) & (grasp.width_m <= self.scene.robot.open_gap_m)
        pads = Closing(held.T_obj_ee, c["point"], c["slope_x"], c["slope_z"], c["lift"], c["state"], centred)
        change = closed(T_obj_ee, pads)
        at = attached(T_obj_ee, grasp.shift_m.double(), change)
        poses = Poses0(T_world_ee, held.T_world_ee, at, held.attached, change.opening)

        cut, region = (
            Contact(x["point"].double(), x["normal"].double(), x["finger"].double(), x["part"] >= 0)
            for x in (w.cut, w.region)
        )
        stability = separation(T_obj_ee, held.T_obj_ee, torch.zeros_like(change.opening), cut)
        sign = (by == TOO_THIN).double() - (by == TOO_WIDE).double()
        stability = torch.where(by == CUT, stability, sign * change.width)
        missing, towards = self._way(T_obj_ee, w.material["nearest"], w.material["distance"] > 0)
        stability = torch.where(by == NO_MATERIAL, -se3.dot(towards, missing), stability)

        palm = w.palm["nearest"].double()
        T_world_obj = se3.matmul(held.T_world_ee, se3.inverse(held.attached))
        away = se3.rotate(T_world_obj[:, :3, :3], _unit(palm - held.ball, w.palm["distance"] > 0))
        reach = -receded(palm, away, poses)

        aside, towards = self._way(T_obj_ee, w.free["nearest"], w.free["found"])
        affordance = separation(at, held.attached, change.opening, region) - se3.dot(towards, aside)

        normal = torch.where(w.hand["found"][:, None], w.hand["normal"].double(), 0.0)
        body = w.decided["safe_body"]
        moved = self._carried(w.hand["point"], body, body, poses, w.safe_arm)
        safe = -se3.dot(normal, moved)
        at_start = self.start[:, None, None]
        at_home = replace(
            poses,
            T_world_ee=torch.where(at_start, self.home, T_world_ee),
            T_world_ee_0=torch.where(at_start, self.home, held.T_world_ee),
        )
        pairs = int(CollidingPair.SELF), int(CollidingPair.OBJECT_ROBOT)
        with_robot = (goal.nearest_pair == pairs[0]) | (goal.nearest_pair == pairs[1])
        other, none = torch.where(with_robot, goal.other, -1), torch.full_like(goal.body, -1)
        apart = self._carried(goal.point, goal.body, goal.body, at_home, w.arm)
        apart = apart - self._carried(goal.point, other, none, at_home, w.arm)
        plan = torch.where(self.unreachable, -self._missed(T_world_ee), se3.dot(goal.push.double(), apart))
        numbers = {"stability": stability, "plan": plan, "reach": reach, "affordance": affordance, "safe": safe}
        out = torch.stack([numbers[name] for name in CRITERIA], 1)
        return torch.where(self.evaluated, out, torch.zeros_like(out))

    def _way(self, T_obj_ee: Tensor, point: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        """How a point of the object moves in the ee frame, and the unit vector to it."""
        x0 = se3.apply(se3.inverse(self.held.T_obj_ee), point.double())
        return se3.apply(se3.inverse(T_obj_ee), point.double()) - x0, _unit(x0, counts)

    def _carried(self, point: Tensor, body: Tensor, finger_of: Tensor, poses: Poses0, at: dict[str, Tensor]) -> Tensor:
        scene, joints = self.scene, len(self.scene.robot.joints)
        n = scene.world.n_robot
        link = torch.from_numpy(scene.body_links)[body.clamp(min=0, max=n - 1).long()].long()
        carrier = torch.where(body < 0, FIXED, torch.where(body >= n, joints + 2, link))
        x = se3.apply(se3.inverse(poses.T_world_ee_0), point.double())
        finger = self._finger(torch.where(finger_of < n, finger_of - scene.world.n_arm, -1), x)
        arm = Arm(*(at[k].double() for k in ("axis", "origin", "inverse", "ee")))
        return carried(point.double(), carrier, finger, poses, arm)

    def _finger(self, part: Tensor, x: Tensor) -> Tensor:
        """How points (ee frame) of gripper primitives move per metre of opening: differences of their poses."""
        robot, gap, h = self.scene.robot, self.held.grasp.opening_m.double().numpy(), 1e-6
        low, high = (float(gap_from_drive(robot, d)) for d in (robot.linkage.drive_upper, robot.linkage.drive_lower))
        free = torch.from_numpy((gap > low + 1e-6) & (gap < high - 1e-6)) & (part >= 0)
        ahead, behind, now = (torch.from_numpy(gripper_primitives_at(robot, gap + s * h)) for s in (1, -1, 0))
        rows, k = torch.arange(len(x)), part.clamp(min=0).long()
        local = se3.apply(se3.inverse(now[rows, k]), x)
        moved = se3.apply(ahead[rows, k], local) - se3.apply(behind[rows, k], local)
        return torch.where(free[:, None], moved / (2 * h), 0.0)

    def _missed(self, T_world_ee: Tensor) -> Tensor:
        if self.scene.robot.family == "ur":
            return missed(T_world_ee, ur_lengths(self.scene.robot))
        return missed_by(T_world_ee, self.w.safe_arm["ee"].double(), ROTATION_LEVER_M)
