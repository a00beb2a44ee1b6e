"""How much weight a closed grasp carries before the object turns or slips in it, in closed form.

The pads press on the object with force F along the closing axis y. Friction holds a force of at most
2 mu F across y and a moment of at most 2 mu F r about y, and less of one where it holds some of the
other: an ellipse (Howe and Cutkosky 1996). r is the mean distance of a pad's points from its centre:
the whole pad is in contact and the pressure is the same everywhere, so that small or round contacts
hold less. `grasp_physics` closes the gripper in a simulator instead, which takes seconds.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from r2h_batch.base import se3
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.grasp import attach
from r2h_batch.judge.grasp_physics import FRICTION, G
from r2h_batch.scene.robot import Robot, drive_from_gap, pad_center_z
from r2h_batch.types import CRITERIA, Scores

Array = NDArray[np.float64]

GRIP_N = 27.0
"""Force of each pad that `grasp_physics.TORQUE_NM` gives: a light grasp of a hand that may squeeze
with 235 N."""


@dataclass(frozen=True)
class Payload:
    """Loads by weight on B closed grasps; NaN where Stability fails, for the pads then hold
    nothing."""

    lever_m: Float64[Array, " b"]
    """distance of the centre of mass from the axis through the pads' centres"""
    pivot_torque_nm: Float64[Array, " b"]
    """moment of the weight about that axis at the handover pose"""
    payload_factor: Float64[Array, " b"]
    """how many times its weight the grasp holds there; below 1 the object turns or slips"""
    any_posture_factor: Float64[Array, " b"]
    """the least of it over all directions of gravity: what holds in every posture on the way"""


def payload(scores: Scores, *, grip_n: float = GRIP_N, friction: float = FRICTION) -> Payload:
    """The weight that each judged grasp carries.

    Args:
        scores: what `Evaluator.score` returned.
        grip_n: normal force of each pad, N.
        friction: coefficient between pad and object.

    Raises:
        ValueError: the scores hold no inputs.
    """
    if (inputs := scores.inputs) is None:
        raise ValueError("these scores hold no inputs; score again")
    scene, config = inputs.evaluator.scene, inputs.evaluator.config
    poses = executed_poses(config, scene.objects, inputs.T_obj_ee, inputs.T_world_ee, inputs.trials)
    attached = attach(se3.orthonormalise(poses[0]), scores.grasp_shift_m).double().cpu().numpy()
    down = -poses[1][:, 2, :3].double().cpu().numpy()  # in ee
    objects = [scene.objects[i] for i in inputs.trials.object_index.tolist()]
    com = np.array([o.com for o in objects], np.float64).reshape(-1, 3)
    mass = np.array([o.mass for o in objects], np.float64)
    T_ee_obj = np.linalg.inv(attached)
    r = se3.rotate(T_ee_obj[:, :3, :3], com) + T_ee_obj[:, :3, 3]
    r = r - _pad_center(scene.robot, scores.opening_m.double().cpu().numpy())
    radius = _pad_radius(scene.robot)
    lever = np.hypot(r[:, 0], r[:, 2])
    weight = mass * G
    force = weight * np.hypot(down[:, 0], down[:, 2])
    moment = weight * abs(r[:, 2] * down[:, 0] - r[:, 0] * down[:, 2])
    most = 2 * friction * grip_n
    with np.errstate(divide="ignore"):
        factor = most / np.hypot(force, moment / radius)
    worst = most / (weight * np.hypot(1.0, lever / radius))
    held = scores.passed[:, CRITERIA.index("stability")].cpu().numpy()
    return Payload(*(np.where(held, x, np.nan) for x in (lever, moment, factor, worst)))


def _pad_center(robot: Robot, opening_m: Array) -> Array:
    """The point between the pads' centres (b, 3), in ee."""
    T = np.linalg.inv(robot.T_flange_ee) @ robot.T_flange_gripper
    z = pad_center_z(robot, drive_from_gap(robot, opening_m))
    return np.asarray(T[:3, 2] * z[:, None] + T[:3, 3])


def _pad_radius(robot: Robot) -> float:
    """Mean distance of a pad's points from its centre, m."""
    a, _, b = robot.linkage.pad_half_size
    d = np.hypot(a, b)
    sides = a * a / (2 * b) * np.log((b + d) / a) + b * b / (2 * a) * np.log((a + d) / b)
    return float((d + sides) / 3)
