"""From what the stages found to `Scores`: the criteria side by side, the first failure, the reasons
and witnesses."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from r2h_batch.config import BORDERLINE_M, ExecConfig
from r2h_batch.judge.attach import AttachedBatch
from r2h_batch.judge.distance import NearestApproach
from r2h_batch.judge.goal import Goal
from r2h_batch.judge.metrics import Criterion, constants
from r2h_batch.judge.motion.execute import Executed, executed_time_at
from r2h_batch.judge.motion.time_law import Motion, time_at
from r2h_batch.judge.plan import Plan
from r2h_batch.judge.presented import Presented
from r2h_batch.types import CollidingPair, Outcome, PlanReason, Scores

NONE_FAILED = 100
"""More than the code of any criterion."""


def verdict(
    criteria: Sequence[Criterion],
    held: AttachedBatch,
    slip_m: Float64[Tensor, " b"] | None,
    region: Presented,
    valid: Bool[Tensor, " b"] | None = None,
) -> dict[str, Tensor]:
    """The fields of `Scores` that need neither path nor posture; `criteria` in the order of
    `CRITERIA`.

    The outcome is the first criterion that was evaluated and failed. `valid`: False where the
    simulator failed; such a row is judged by nothing and is INVALID_SIM. A row that is not active
    is INVALID_INPUT.
    """
    active, grasp, device = held.active, held.grasp, held.active.device
    nan = constants(device, torch.float32, torch.nan)
    success, invalid_sim, invalid_input = (
        constants(device, torch.int8, code)
        for code in (Outcome.SUCCESS, Outcome.INVALID_SIM, Outcome.INVALID_INPUT)
    )
    evaluated = torch.stack([c.evaluated for c in criteria], 1)  # (B, C), as the three below
    if valid is not None:
        evaluated = evaluated & valid[:, None]
    passed = torch.stack([c.passed for c in criteria], 1) & evaluated
    margin = torch.where(evaluated, torch.stack([c.margin for c in criteria], 1), nan)
    kind = torch.stack([c.kind for c in criteria], 1) * evaluated  # MarginKind.NONE is 0
    # the smallest code of a failed criterion; NONE_FAILED where none failed
    codes = constants(device, torch.int8, *range(1, len(criteria) + 1))
    none = constants(device, torch.int8, NONE_FAILED)
    first = torch.where(evaluated ^ passed, codes, none).amin(1)
    outcome = torch.where(first == none, success, first)
    if valid is not None:
        outcome = torch.where(valid, outcome, invalid_sim)
    outcome = torch.where(active, outcome, invalid_input)
    return {
        "outcome": outcome,
        "success": outcome == success,
        "passed": passed,
        "evaluated": evaluated,
        "margin": margin,
        "margin_kind": kind,
        # NaN is not below it
        "borderline": (margin.abs() < constants(device, torch.float32, BORDERLINE_M)).any(1),
        "width_m": torch.where(active, grasp.width_m, nan),
        "opening_m": torch.where(active, grasp.opening_m, nan),
        "grasp_shift_m": torch.where(active, grasp.shift_m, nan),
        "slip_m": torch.full_like(grasp.width_m, torch.nan) if slip_m is None else slip_m.float(),
        "presented": region.presented,
        "presented_angle_deg": region.angle_deg,
        "presented_distance_m": region.distance_m,
    }


def motion_scores(
    trial_id: Int64[Tensor, " b"],
    shared: dict[str, Tensor],
    active: Bool[Tensor, " b"],
    planned: Plan,
    motion: Motion,
    executed: Executed,
    nearest: NearestApproach,
    config: ExecConfig | None,
    *,
    t_plan_s: float,
    keep_motion: bool,
    body_m: Float32[Tensor, " b"],
) -> Scores:
    """`Scores` of trials that were planned and moved; `shared` from `verdict`. `config`: the time
    law of the path, None for motions with times of their own."""
    has_path, witnessed = planned.length > 0, nearest.body >= 0
    restless = has_path & executed.valid & ~executed.settled
    last = (planned.length - 1).clamp(min=0).long()
    goal = planned.path[torch.arange(len(active), dtype=torch.int64, device=active.device), last]
    if executed.sample_s is None:
        time_s = time_at(
            planned.path, planned.length, motion, nearest.segment, nearest.fraction, config
        )
    else:
        time_s = executed_time_at(executed, nearest.segment, nearest.fraction)
    kept, kept_len, failed_state = _kept_motion(executed, keep_motion)
    return Scores(
        trial_id=trial_id,
        **shared,
        plan_reason=torch.where(restless, int(PlanReason.NOT_SETTLED), planned.reason).to(
            torch.int8
        ),
        plan_pair=torch.where(active, planned.pair, int(CollidingPair.NONE)).to(torch.int8),
        witness_part=torch.stack([torch.where(has_path, planned.body, -1), nearest.body], 1),
        witness_time_s=torch.where(witnessed, time_s, torch.nan),
        witness_point=torch.where(witnessed[:, None], nearest.point, torch.nan),
        t_plan_s=torch.where(active, t_plan_s, torch.nan).float(),
        t_exec_s=executed.t_exec_s,
        q_goal=torch.where(has_path[:, None], goal, torch.nan),
        path=planned.path,
        path_time_s=motion.time_s,
        path_len=planned.length,
        motion=kept,
        motion_len=kept_len,
        failed_state=failed_state,
        body_m=body_m,
    )


def pose_scores(
    trial_id: Int64[Tensor, " b"],
    shared: dict[str, Tensor],
    goal: Goal,
    nearest: NearestApproach,
    *,
    body_m: Float32[Tensor, " b"],
) -> Scores:
    """`Scores` of poses that were judged without a path; `shared` from `verdict`."""
    nan, zero = torch.full_like(goal.clearance_m, torch.nan), torch.zeros_like(goal.reason)
    none = torch.empty((len(nan), 0, goal.q.shape[1]), dtype=torch.float32, device=nan.device)
    nothing = none[:, :, 0]
    return Scores(
        trial_id=trial_id,
        **shared,
        plan_reason=goal.reason.to(torch.int8),
        plan_pair=goal.pair.to(torch.int8),
        witness_part=torch.stack([goal.body, nearest.body], 1),
        witness_time_s=nan,
        witness_point=nearest.point,
        t_plan_s=nan,
        t_exec_s=nan,
        q_goal=goal.q,
        path=none,
        path_time_s=nothing,
        path_len=zero,
        motion=none,
        motion_len=zero.clone(),
        failed_state=nothing.double(),
        body_m=body_m,
    )


def _kept_motion(executed: Executed, keep: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Recorded samples and their number, of all that moved or only of those whose simulation
    failed; and their state then."""
    length = executed.recorded if keep else torch.where(executed.valid, 0, executed.recorded)
    state = executed.failed_state
    # nothing was recorded, and looking at lengths would wait for a GPU
    if executed.sample_s is None:
        empty = torch.empty((len(length), 0), dtype=torch.float64, device=length.device)
        return executed.path[:, :0].clone(), length, empty
    if state is None or executed.valid.all():
        state = torch.empty((len(length), 0), dtype=torch.float64, device=length.device)
    return executed.path[:, : int(length.max()) if len(length) else 0].clone(), length, state
