"""Changes of Pick's margin in the pose stage with the grasp, to first order: reach, or the open gripper beside table, person."""

from functools import lru_cache
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, Int64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.judge.goal import judge_goals
from r2h_batch.judge.grasp import CUT_CAP_M, gripper_poses
from r2h_batch.judge.ik import solve_ik
from r2h_batch.scene.person import with_person
from r2h_batch.scene.resting import without
from r2h_batch.scene.robot import Robot, ShapeKind, corners_of
from r2h_batch.scene.scene import Scene
from r2h_batch.training import first_order, witnesses
from r2h_batch.types import CollidingPair, Trials

NEAR_M, NEAR_SHARE = 3e-4, 0.02
"""A depth in the table is one of these if it is off by no more: depths of the evaluator are lower bounds, mostly to 1 %."""


def pick_change(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    T_world_obj: Float32[Tensor, "b 4 4"],
    trials: Trials,
    active: Bool[Tensor, " b"],
    margin_m: Float32[Tensor, " b"],
    pick: Int32[Tensor, "b 3"],
) -> Float32[Tensor, "b 4 4"]:
    """Derivatives of B margins by the entries of T_obj_ee, m per entry.

    The gripper moves rigidly with the ee frame, so its smallest clearance changes by how its nearest point moves along the
    direction that parts the two bodies. In the table it is the deepest body, which leaves by the nearest side of the table or of
    itself. Zero where the margin is at its cap, and where nothing here parts the two.

    Args:
        scene: robot, objects, hands and table.
        T_obj_ee: (B, 4, 4) grasps, m.
        T_world_obj: (B, 4, 4) where the objects rest, m.
        trials: B trials.
        active: (B,) rows that are judged.
        margin_m: (B,) the margins.
        pick: (B, 3) their reasons, pairs and robot bodies (`PickedScores.pick`).
    """
    T_world_ee = se3.matmul(T_world_obj, T_obj_ee)
    opening = torch.full_like(margin_m, scene.robot.open_gap_m)
    poses = scene.body_poses(
        trials.object_index, trials.hand_index, T_obj_ee, trials.T_world_hand, opening
    )
    if trials.receiver is not None:
        poses = with_person(scene, poses, trials.receiver, hand=True)
    gripper = without(scene, poses, attached=True, arm=True)
    home = scene.config.workplace.home_q
    ik = solve_ik(T_world_ee, active=active, robot=scene.robot, home=home)
    goal = judge_goals(scene, gripper, T_world_ee, ik, ik.valid, active)
    reach = ik.valid.any(1)
    # clearance: push . (R x + p) at the point x of the ee's frame
    x, push = se3.apply(se3.inverse(T_world_ee.double()), goal.point.double()).float(), goal.push
    _, pair, body = pick.long().unbind(1)
    sunk = (pair == int(CollidingPair.TABLE)) & (margin_m < 0)
    out, at = _out_of_table(scene, T_world_ee, opening, body, -margin_m)
    push, x = torch.where(sunk[:, None], out, push), torch.where(sunk[:, None], at, x)
    change = torch.zeros_like(T_world_ee)
    change[:, :3, :3] = push[:, :, None] * x[:, None]
    change[:, :3, 3] = push
    T_reached = witnesses.arm_at(scene, torch.where(reach[:, None], 0.0, goal.q))["ee"]
    missed = first_order.missed_change(scene, T_world_ee, T_reached)
    change = torch.where(reach[:, None, None], change, -missed)
    counts = active & (margin_m < CUT_CAP_M)
    change = torch.where(counts[:, None, None], change, 0.0)
    return se3.matmul(T_world_obj.mT, change)


def _out_of_table(
    scene: Scene, T_world_ee: Tensor, opening_m: Tensor, body: Int64[Tensor, " b"], depth_m: Tensor
) -> tuple[Float32[Tensor, "b 3"], Float32[Tensor, "b 3"]]:
    """Directions (world) that part each row's gripper body and the table, and the points (ee frame) that move along them: out of
    the table's nearest side by the body's point that is farthest in, or, of a box, out of its own nearest side by the table's
    corner that is. No direction where edges of both are nearer than all sides.
    """
    robot, place, device = scene.robot, scene.config.workplace, opening_m.device
    R, p = gripper_poses(robot, opening_m)
    cores, radius = _cores(robot, scene.device)
    own = (body - len(scene.tables.arm_order)).clamp(0, len(cores) - 1)
    rows = torch.arange(len(own), dtype=torch.int64, device=device)
    points = se3.matmul(cores[own], R[rows, own].mT) + p[rows, own][:, None]
    corners = (
        np.array(place.table_center) + np.array(list(product((-1, 1), repeat=3))) * place.table_half
    )
    table = torch.from_numpy(corners.astype(np.float32)).to(device)
    # the ways out (world): of the table's sides x, y, z, -x, -y, -z, and of a box's
    sides = torch.eye(3, dtype=torch.float32, device=device).expand(len(own), 3, 3)
    boxes = se3.matmul(T_world_ee[:, :3, :3], R[rows, own]).mT
    out = torch.cat([sides, -sides, boxes, -boxes], 1)  # (B, 12, 3)
    inner, farthest = se3.matmul(out, se3.apply(T_world_ee[:, None], points).mT).min(2)
    outer, corner = se3.matmul(out, table.T.expand(len(own), 3, 8)).max(2)
    depth = outer - inner + radius[own, None]
    no_box = torch.from_numpy(np.array(robot.gripper.kind) != ShapeKind.BOX).to(device)[own]
    depth[:, 6:] = torch.where(no_box[:, None], torch.inf, depth[:, 6:])
    least, side = depth.min(1)
    near = (least - depth_m).abs() <= NEAR_M + NEAR_SHARE * depth_m
    push = torch.where(near[:, None], out[rows, side], 0.0)
    of_table = se3.apply(se3.inverse(T_world_ee), table[corner[rows, side]])
    of_body = points[rows, farthest[rows, side]]
    return push, torch.where((side < 6)[:, None], of_body, of_table)


@lru_cache(maxsize=4)
def _cores(robot: Robot, device: str) -> tuple[Float32[Tensor, "g k 3"], Float32[Tensor, " g"]]:
    """Points whose hull is the core of each gripper body, in its frame, m (a cylinder's are on its rims), and the radius about
    that core."""
    shapes, found = robot.gripper, []
    turns = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
    for kind, size, corners in zip(shapes.kind, shapes.size, corners_of(shapes), strict=True):
        if kind == ShapeKind.HULL:
            points = np.asarray(corners, np.float64)
        elif kind == ShapeKind.BOX:
            points = np.array(list(product(*((-a, a) for a in size))))
        elif kind == ShapeKind.CYLINDER:
            rim = size[0] * np.stack([np.cos(turns), np.sin(turns), 0 * turns], 1)
            points = np.concatenate([rim + [0, 0, z] for z in (-size[1], size[1])])
        else:
            half = size[1] if kind == ShapeKind.CAPSULE else 0.0
            points = np.array([[0, 0, -half], [0, 0, half]])
        found.append(points)
    most = max(map(len, found))
    filled = np.stack([np.concatenate([x, np.repeat(x[-1:], most - len(x), 0)]) for x in found])
    round_ = np.where(np.array(shapes.kind) <= ShapeKind.CAPSULE, np.array(shapes.size)[:, 0], 0.0)
    core, radius = (torch.from_numpy(x.astype(np.float32)).to(device) for x in (filled, round_))
    return core, radius
