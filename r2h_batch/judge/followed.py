"""Plans that were made in a world that somebody believed in, judged in the true one."""

from dataclasses import fields, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from r2h_batch.judge.attach import AttachedBatch
from r2h_batch.judge.pick import Picked
from r2h_batch.judge.plan import Plan, path_clearances
from r2h_batch.judge.straight_way import STEPS
from r2h_batch.kernels.plan.codes import WAYPOINTS
from r2h_batch.scene.resting import without
from r2h_batch.scene.scene import Scene
from r2h_batch.types import CollidingPair, PlanReason
from r2h_batch.verdicts import PickReason

Rows = TypeVar("Rows", Picked, Plan)


def nothing_to_pick(scene: Scene, T_world_ee: Float32[Tensor, "b 4 4"]) -> Picked:
    """B picks in a world in which no object was seen: nothing is between the pads, and the arm does not move.

    Args:
        scene: the robot, and the least width that is held.
        T_world_ee: (B, 4, 4) the grasps, m.
    """
    b, joints, device = len(T_world_ee), len(scene.robot.joints), T_world_ee.device

    def full(shape: tuple[int, ...], value: float, dtype: torch.dtype) -> Tensor:
        return torch.full(shape, value, dtype=dtype, device=device)

    way = full((b, STEPS[-1] + 1, joints), torch.nan, torch.float32)
    return Picked(
        picked=full((b,), False, torch.bool),
        reason=full((b,), int(PickReason.NOTHING_BETWEEN_PADS), torch.int32),
        margin_m=full((b,), -scene.config.thresholds.w_min_m, torch.float32),
        pair=full((b,), int(CollidingPair.NONE), torch.int32),
        body=full((b,), -1, torch.int32),
        off_m=full((b,), torch.nan, torch.float32),
        T_world_ee=T_world_ee,
        path=full((b, int(WAYPOINTS), joints), 0.0, torch.float32),
        length=full((b,), 0, torch.int32),
        way_in=way,
        way_up=way.clone(),
    )


def no_plan(b: int, joints: int, device: torch.device) -> Plan:
    """B plans that nobody made."""
    return Plan(
        reason=torch.full((b,), int(PlanReason.NOT_EVALUATED), dtype=torch.int32, device=device),
        pair=torch.full((b,), int(CollidingPair.NONE), dtype=torch.int32, device=device),
        body=torch.full((b,), -1, dtype=torch.int32, device=device),
        clearance_m=torch.full((b,), -torch.inf, dtype=torch.float32, device=device),
        straight=torch.zeros(b, dtype=torch.bool, device=device),
        path=torch.zeros((b, int(WAYPOINTS), joints), dtype=torch.float32, device=device),
        length=torch.zeros(b, dtype=torch.int32, device=device),
    )


def put(into: Rows, rows: Int64[Tensor, " m"], found: Rows) -> None:
    """Writes M rows into others.

    Args:
        into: B rows.
        rows: which of them.
        found: M rows.
    """
    for f in fields(found):
        getattr(into, f.name)[rows] = getattr(found, f.name)


def follow_plans(
    scene: Scene, held: AttachedBatch, planned: Plan, begins: Bool[Tensor, " b"]
) -> Plan:
    """Plans as they turn out in the true world: the robot meets the table or itself, the held object the table, the robot or the
    person. Where the robot meets the person is Safe's business.

    Args:
        scene: the true one.
        held: the true objects in the gripper, and the true person.
        planned: B plans of another world.
        begins: rows that get as far as this; no other has a plan.
    """
    own = no_plan(len(begins), planned.path.shape[2], begins.device)
    rows = torch.nonzero(begins).flatten()
    put(own, rows, Plan(*(getattr(planned, f.name)[rows] for f in fields(Plan))))
    poses = held.planner_poses
    worlds = (
        without(scene, poses, person=True),
        without(scene, poses, arm=True, gripper=True, table=True),  # the held object and the person
    )
    alone, carried = (path_clearances(scene, w, own.path, own.length) for w in worlds)
    less = carried[0] < alone[0]
    least, pair, body = (torch.where(less, y, x) for x, y in zip(alone, carried, strict=True))
    moves = own.length > 0
    met = moves & (least <= 0)
    return replace(
        own,
        reason=torch.where(met, int(PlanReason.MOTION_IN_COLLISION), own.reason),
        pair=torch.where(moves, pair, own.pair),
        body=torch.where(moves, body, own.body),
        clearance_m=torch.where(moves, least, own.clearance_m),
    )
