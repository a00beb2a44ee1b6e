"""The goal posture of a handover pose, judged without a path: the branch the planner would go to,
its clearance, Safe there."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M, FARTHEST_M
from r2h_batch.judge.ik import ROTATION_LEVER_M, IkResult, SearchedIk, home_posture, ur_parameters
from r2h_batch.kernels.ik import nearest as ik_nearest
from r2h_batch.kernels.ik.step import STATUS_SINGULAR
from r2h_batch.kernels.judge import goal as goal_kernels
from r2h_batch.launch import over_trials
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.types import PlanReason

MEASURED = (
    PlanReason.START_IN_COLLISION,
    PlanReason.IK_UNREACHABLE,
    PlanReason.IK_IN_COLLISION,
)
"""Reasons of failures whose threshold is a length."""


@dataclass(frozen=True)
class Goal:
    """Where B handover poses would end, and how clear that is.

    `reason`, `pair`: as in `Plan`, as far as they are known without a path. `q` is the free branch
    that the planner tries first; else the valid branch with the largest clearance; else, for an
    unreachable target, the posture that comes nearest to it with the hand turned as asked; NaN for
    inactive rows. `clearance_m` is above 0 exactly where `reason` is OK: the smallest over all
    pairs, exact below 5 cm and a lower bound above; where bodies meet, minus a lower bound of the
    overlap (kernels/plan/posture.py); minus the residual where unreachable; that of home where the
    start collides. `push`: when the two bodies move rigidly, the clearance changes by push .
    (motion of `body` - motion of `other`) at `point` (world frame; zero where there is no pair
    below the cap).
    """

    reason: Int32[Tensor, " b"]
    pair: Int32[Tensor, " b"]
    slot: Int32[Tensor, " b"]  # of the branch (IkResult), -1: none
    q: Float32[Tensor, "b 6"]
    clearance_m: Float32[Tensor, " b"]
    nearest: Int32[Tensor, " b"]  # CollidingPair of the nearest pair, whatever `pair` says
    body: Int32[Tensor, " b"]  # Scene.part_names; -1: none
    other: Int32[Tensor, " b"]  # hand piece or robot body it is nearest to; -1: none, or the table
    push: Float32[Tensor, "b 3"]
    point: Float32[Tensor, "b 3"]

    @property
    def free(self) -> Bool[Tensor, " b"]:
        """Some branch is free, and home is."""
        return self.reason == int(PlanReason.OK)


def judge_goals(
    scene: Scene,
    body_poses: BodyPoses,
    T_world_ee: Float32[Tensor, "b 4 4"],
    ik: IkResult,
    branches: Bool[Tensor, "b 8"],
    active: Bool[Tensor, " b"],
) -> Goal:
    """The goals of B handover poses whose IK is solved; `branches` are those that may be used
    (`goals="one"`: one)."""
    b, device = len(active), active.device
    active = active.contiguous()
    goal = _unjudged(b, ik.q.shape[2], device)
    postures = {"valid": branches.contiguous(), "q": ik.q.flatten(0, 1)}

    over_trials(
        scene.sized(goal_kernels.choose_goal),
        b,
        scene.device,
        outputs={"reason": goal.reason, "pair": goal.pair, "slot": goal.slot},
    )(
        world=body_poses.tables(scene),
        bodies=body_poses.bodies,
        home=home_posture(str(device), scene.config.workplace.home_q),
        singular=int(STATUS_SINGULAR),
        unproven=int(PlanReason.NO_PATH_IN_BUDGET),
        active=active,
        status=ik.status,
        **postures,
    )
    _measure(goal, scene, body_poses, T_world_ee, ik, postures, active)
    if scene.robot.family != "ur":  # of a UR the kernel knows what is proven
        goal.reason.copy_(weaken_singular_reason(goal.reason, ik))
    return goal


def failed_clearance(
    scene: Scene,
    body_poses: BodyPoses,
    T_world_ee: Float32[Tensor, "b 4 4"],
    ik: IkResult,
    branches: Bool[Tensor, "b 8"],
    reason: Int32[Tensor, " b"],
) -> Float32[Tensor, " b"]:
    """How far B trials without a path are from a start and a goal that are free, as a margin below
    0 (m): `Goal.clearance_m` of the same `reason` (PlanReason), bit for bit.

    -inf where no length says it: no path within the budget. Rows with a path: -inf too.
    """
    measured = torch.zeros_like(reason, dtype=torch.bool)
    for why in MEASURED:
        measured |= reason == int(why)
    goal = _unjudged(len(reason), ik.q.shape[2], reason.device)
    goal.reason.copy_(torch.where(measured, reason, int(PlanReason.NOT_EVALUATED)))
    goal.slot.fill_(-1)
    postures = {"valid": branches.contiguous(), "q": ik.q.flatten(0, 1)}
    _measure(goal, scene, body_poses, T_world_ee, ik, postures, measured)
    return torch.where(measured, goal.clearance_m.clamp(min=-FARTHEST_M), -torch.inf)


def weaken_singular_reason(reason: Int32[Tensor, " b"], ik: IkResult) -> Int32[Tensor, " b"]:
    """`reason` (PlanReason) with NO_PATH_IN_BUDGET for IK_IN_COLLISION where branches are not all
    solutions.

    At sin q5 = 0 they are points of a line of solutions (`IkResult.singular`): that these collide
    proves nothing of the others. Nor does it where there is no closed form, nor that nothing was
    found.
    """
    met = reason == int(PlanReason.IK_IN_COLLISION)
    missed = reason == int(PlanReason.IK_UNREACHABLE)
    for rows, weaker in (
        (ik.singular & met, PlanReason.NO_PATH_IN_BUDGET),
        (ik.unproven & met, PlanReason.NO_FREE_POSTURE_FOUND),
        (ik.unproven & missed, PlanReason.IK_NOT_FOUND),
    ):
        reason = torch.where(rows, int(weaker), reason)
    return reason


def _unjudged(b: int, joints: int, device: torch.device) -> Goal:
    """Room for B goals, all of which the kernels write: they may find there what a call before
    left."""
    reason, pair, slot, nearest, body, other = torch.empty(
        (6, b), dtype=torch.int32, device=device
    ).unbind(0)
    q = torch.empty((b, joints), dtype=torch.float32, device=device)
    clearance = torch.empty(b, dtype=torch.float32, device=device)
    push, point = torch.empty((2, b, 3), dtype=torch.float32, device=device).unbind(0)
    return Goal(reason, pair, slot, q, clearance, nearest, body, other, push, point)


def _measure(
    goal: Goal,
    scene: Scene,
    body_poses: BodyPoses,
    T_world_ee: Float32[Tensor, "b 4 4"],
    ik: IkResult,
    postures: dict[str, Tensor],
    active: Bool[Tensor, " b"],
) -> None:
    """Writes the clearance of each `active` goal, whose `reason` and `slot` are known, and what it
    is attained by; where no branch is free also the posture itself.

    Each launch goes on from what the one before wrote into `goal`.
    """
    b, device = len(active), active.device
    # a posture for targets that no branch reaches ...
    if not isinstance(ik, SearchedIk):
        residual = torch.empty(b, dtype=torch.float32, device=device)
        over_trials(
            ik_nearest.nearest_posture,
            b,
            scene.device,
            outputs={"q": goal.q, "residual": residual},
            chunk=256,
        )(
            ur=ur_parameters(scene.robot, scene.config.workplace.home_q),
            rotation_lever_m=ROTATION_LEVER_M,
            active=active,
            branches=postures["valid"],
            T_world_ee=T_world_ee.contiguous(),
        )
    else:
        residual = ik.miss_m
        goal.q.copy_(torch.where(active[:, None], ik.nearest, torch.nan))
    # ... and how near its bodies are to others
    over_trials(
        scene.sized(goal_kernels.goal_clearance),
        b,
        scene.device,
        outputs={
            "pair": goal.pair,
            "slot": goal.slot,
            "q_goal": goal.q,
            "clearance": goal.clearance_m,
            "nearest": goal.nearest,
            "body": goal.body,
            "other": goal.other,
            "push": goal.push,
            "point": goal.point,
        },
    )(
        cap=CLEARANCE_CAP_M,
        world=body_poses.tables(scene),
        hull_ball=scene.hull_balls,
        bodies=body_poses.bodies,
        home=home_posture(str(device), scene.config.workplace.home_q),
        reason=goal.reason,
        **postures,
        residual=residual,
    )
