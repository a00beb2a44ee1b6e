"""The goal posture of a handover pose, judged without a path: the branch the planner would go to,
its clearance, Safe there."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.config import CLEARANCE_CAP_M, FARTHEST_M
from r2h_batch.judge.ik import ROTATION_LEVER_M, IkResult, SearchedIk, home_posture, ur_parameters
from r2h_batch.kernels.ik import nearest as ik_nearest
from r2h_batch.kernels.ik.step import STATUS_SINGULAR
from r2h_batch.kernels.judge import goal as goal_kernels
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
    nearest_pair: Int32[Tensor, " b"]  # CollidingPair of the nearest bodies, whatever `pair` says
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
    *,
    from_home: bool = True,
) -> Goal:
    """The goals of B handover poses whose IK is solved.

    Args:
        scene: robot, objects and hands.
        body_poses: of B trials, as the planner sees them.
        T_world_ee: (B, 4, 4) float32 handover poses, m.
        ik: all branches.
        branches: (B, 8) those that may be used (`goals="one"`: one).
        active: (B,) rows to judge.
        from_home: whether the way of the object begins at home, which then has to be free. What the arm picks from the table
            it lifts elsewhere, and at home it holds nothing.
    """
    active, device = active.contiguous(), active.device
    postures = {"valid": branches.contiguous(), "q": ik.q.flatten(0, 1)}
    chosen = over_trials(scene.sized(goal_kernels.choose_goal), len(active), scene.device)(
        world=body_poses.tables(scene),
        bodies=body_poses.bodies,
        home=home_posture(str(device), scene.config.workplace.home_q),
        from_home=int(from_home),
        singular=int(STATUS_SINGULAR),
        unproven=int(PlanReason.NO_PATH_IN_BUDGET),
        active=active,
        status=ik.status,
        **postures,
    )
    goal = measured(scene, body_poses, T_world_ee, ik, postures, active, **chosen)
    if scene.robot.family == "ur":  # the kernel knows what is proven
        return goal
    return replace(goal, reason=weaken_singular_reason(goal.reason, ik))


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
    rows = torch.zeros_like(reason, dtype=torch.bool)
    for why in MEASURED:
        rows |= reason == int(why)
    reason = torch.where(rows, reason, int(PlanReason.NOT_EVALUATED))
    found = {
        "reason": reason,
        "pair": torch.zeros_like(reason),
        "slot": torch.full_like(reason, -1),
    }
    postures = {"valid": branches.contiguous(), "q": ik.q.flatten(0, 1)}
    goal = measured(scene, body_poses, T_world_ee, ik, postures, rows, **found)
    return torch.where(rows, goal.clearance_m.clamp(min=-FARTHEST_M), -torch.inf)


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


def measured(
    scene: Scene,
    body_poses: BodyPoses,
    T_world_ee: Float32[Tensor, "b 4 4"],
    ik: IkResult,
    postures: dict[str, Tensor],
    active: Bool[Tensor, " b"],
    *,
    reason: Int32[Tensor, " b"],
    pair: Int32[Tensor, " b"],
    slot: Int32[Tensor, " b"],
) -> Goal:
    """Goals of known reason and slot: the clearance and what it is attained by; where no branch is
    free also the posture itself. Writes into `pair` and `slot`.

    Args:
        scene: robot, objects and hands.
        body_poses: of B trials.
        T_world_ee: (B, 4, 4) float32 poses of the ee, m.
        ik: all branches.
        postures: `valid` (B, 8), the branches that may be used, and `q` (B * 8, J), rad.
        active: (B,) rows to measure.
        reason: (B,) `PlanReason`.
        pair: (B,) `CollidingPair` that is known already.
        slot: (B,) of the free branch; -1: none.
    """
    b, home = len(active), scene.config.workplace.home_q
    # a posture for targets that no branch reaches ...
    if isinstance(ik, SearchedIk):
        q, residual = torch.where(active[:, None], ik.nearest, torch.nan), ik.miss_m
    else:
        near = over_trials(ik_nearest.nearest_posture, b, scene.device, sizes={"q": 6}, chunk=256)(
            ur=ur_parameters(scene.robot, home),
            rotation_lever_m=ROTATION_LEVER_M,
            active=active,
            branches=postures["valid"],
            T_world_ee=T_world_ee.contiguous(),
        )
        q, residual = near["q"], near["residual"]
    # ... and how near its bodies are to others
    kernel = scene.sized(goal_kernels.goal_clearance)
    given = {"pair": pair, "slot": slot, "q_goal": q}
    made = over_trials(kernel, b, scene.device, outputs=given)(
        cap=CLEARANCE_CAP_M,
        world=body_poses.tables(scene),
        hull_ball=scene.hull_balls,
        bodies=body_poses.bodies,
        home=home_posture(str(active.device), home),
        reason=reason,
        **postures,
        residual=residual,
    )
    found = (made[k] for k in ("clearance", "nearest", "body", "other", "push", "point"))
    return Goal(reason, pair, slot, q, *found)
