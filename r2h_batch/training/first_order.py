"""How margins change with the two poses, to first order, once the points that decide them are known.

A margin is a distance between two points that the evaluator found. To first order it changes as
these points are carried along, without having to be found again (Danskin). A few dozen
multiplications a row: kernels, so that a call of one row is not spent on tensor operations.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
import warp as wp
from jaxtyping import Float32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.judge.attach import ROWS_CHUNK, AttachedBatch
from r2h_batch.judge.goal import Goal
from r2h_batch.judge.ik import ROTATION_LEVER_M
from r2h_batch.kernels.witness import change as kernels
from r2h_batch.scene.robot import ee_pose, ur_lengths
from r2h_batch.scene.scene import Scene
from r2h_batch.training.witnesses import Witnesses
from r2h_batch.types import CRITERIA, CollidingPair, PlanReason

WITNESSED = ("stability", "plan", "reach", "affordance", "safe")
"""Criteria whose changes are known from witnesses."""
MISSED = {
    "unreachable": int(PlanReason.IK_UNREACHABLE),
    "not_found": int(PlanReason.IK_NOT_FOUND),
    "start": int(PlanReason.START_IN_COLLISION),
}


@dataclass(frozen=True)
class Changes:
    """Derivatives by the entries of the poses of B trials, m per entry."""

    margin: Float32[Tensor, "b c 2 4 4"]
    """by T_obj_ee and T_world_ee, of all criteria of the benchmark; zero for those that were not evaluated and those
    without witnesses"""
    shift: Float32[Tensor, "b 4 4"]
    """of how far closing shifts the object, by T_obj_ee"""

    def copy(self) -> "Changes":
        """The same in memory of its own."""
        return Changes(self.margin.clone(), self.shift.clone())


def changes_at(
    scene: Scene, found: dict[str, Tensor], held: AttachedBatch, goal: Goal, w: Witnesses
) -> Changes:
    """How the margins of B poses change around them.

    Args:
        scene: robot and objects.
        found: fields of `Scores` of B poses.
        held: B trials.
        goal: their goals.
        w: the points that decide their margins.
    """
    b, device, grasp = len(held.active), scene.device, held.grasp
    poses = {
        "active": held.active,
        "evaluated": found["evaluated"],
        "T_obj_ee": held.T_obj_ee,
        "T_world_ee": held.T_world_ee,
        "attached": held.attached,
        "shift": grasp.shift_m,
    }
    made = over_trials(
        kernels.object_changes, b, device, sizes={"change": (len(CRITERIA), 2)}, chunk=ROWS_CHUNK
    )(
        open_gap=scene.robot.open_gap_m,
        **{name: CRITERIA.index(name) for name in ("stability", "reach", "affordance")},
        **poses,
        width=grasp.width_m,
        stability_by=w.decided["stability_by"],
        **w.closing,
        **{f"cut_{k}": w.cut[k] for k in ("part", "point", "normal")},
        **{f"region_{k}": w.region[k] for k in ("part", "point", "normal", "finger")},
        material=w.material["nearest"],
        material_distance=w.material["distance"],
        ball=held.ball,
        palm=w.palm["nearest"],
        palm_distance=w.palm["distance"],
        free=w.free["nearest"],
        free_found=w.free["found"],
    )
    change: Tensor = made["change"]
    links, T_home = _tables(scene)
    over_trials(kernels.body_changes, b, device, outputs={"change": change}, chunk=ROWS_CHUNK)(
        gripper=scene.grasp_tables.gripper,
        links=links,
        n_arm=scene.world.n_arm,
        n_robot=scene.world.n_robot,
        T_home=T_home,
        **{name: CRITERIA.index(name) for name in ("plan", "safe")},
        **MISSED,
        self_pair=int(CollidingPair.SELF),
        object_pair=int(CollidingPair.OBJECT_ROBOT),
        **poses,
        opening=grasp.opening_m,
        reason=goal.reason,
        opening_change=made["opening"],
        shift_change=made["shift"],
        missed=missed_change(scene, held.T_world_ee, w.safe_arm["ee"]),
        pair=goal.nearest_pair,
        body=goal.body,
        other=goal.other,
        push=goal.push,
        point=goal.point,
        **{name: w.arm[name] for name in ("axis", "origin", "inverse")},
        safe_body=w.decided["safe_body"],
        found=w.hand["found"],
        hand_point=w.hand["point"],
        hand_normal=w.hand["normal"],
        **{f"safe_{name}": w.safe_arm[name] for name in ("axis", "origin", "inverse")},
    )
    return Changes(change, made["shift"])


def missed_change(
    scene: Scene, T_world_ee: Float32[Tensor, "b 4 4"], T_reached: Float32[Tensor, "b 4 4"]
) -> Float32[Tensor, "b 4 4"]:
    """Changes of what the arm misses the poses by that it does not reach; without a closed form, of
    what the posture that came nearest does.

    Args:
        scene: the robot.
        T_world_ee: (B, 4, 4) the poses, m.
        T_reached: (B, 4, 4) the ee in the posture that came nearest, m.
    """
    b, device = len(T_world_ee), scene.device
    if scene.robot.family == "ur":
        run = over_trials(kernels.missed_by_ur, b, device, chunk=ROWS_CHUNK)
        lengths = _ur_lengths(scene)
        missed: Tensor = run(T_world_ee=T_world_ee, **lengths)["missed"]
    else:
        run = over_trials(kernels.missed_by_posture, b, device, chunk=ROWS_CHUNK)
        missed = run(rotation_lever=ROTATION_LEVER_M, T_world_ee=T_world_ee, T_reached=T_reached)[
            "missed"
        ]
    return missed


@lru_cache(maxsize=4)
def _ur_lengths(scene: Scene) -> dict[str, float]:
    ur = ur_lengths(scene.robot)
    return {name: getattr(ur, name) for name in ("d1", "a2", "a3", "d4", "d5", "tool")}


@lru_cache(maxsize=4)
def _tables(scene: Scene) -> tuple[Tensor, Any]:
    """Links of the robot's bodies, and home's ee pose."""
    T_home = ee_pose(scene.robot, scene.config.workplace.home_q)
    return torch.from_numpy(scene.body_links).to(scene.device, torch.int32), wp.mat44(T_home)
