"""From what the stages found to `Scores`: the criteria side by side, the first failure, the reasons
and witnesses."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.config import ExecConfig
from r2h_batch.judge.attach import ROWS_CHUNK, AttachedBatch
from r2h_batch.judge.distance import NearestApproach
from r2h_batch.judge.goal import Goal
from r2h_batch.judge.metrics import Criterion, constants
from r2h_batch.kernels.judge import verdict as kernels
from r2h_batch.types import (
    CollidingPair,
    GivenScores,
    Outcome,
    PickedScores,
    PlanReason,
    Scores,
)
from r2h_batch.verdicts import IN_ORDER, SPLITS, UNITS, CriterionEntry

if TYPE_CHECKING:  # paths: a pose's first verdict is there 0.2 s earlier without them
    from r2h_batch.judge.motion.execute import Executed
    from r2h_batch.judge.motion.time_law import Motion
    from r2h_batch.judge.plan import Plan


def verdict(
    entries: Sequence[CriterionEntry],
    criteria: Sequence[Criterion],
    held: AttachedBatch,
    slip_m: Float64[Tensor, " b"] | None,
    valid: Bool[Tensor, " b"] | None = None,
) -> dict[str, Tensor]:
    """The fields of `Scores` that need neither path nor posture; `criteria` in the order of `entries`, which are the
    benchmark's.

    The outcome is the first criterion (`IN_ORDER`) that was evaluated and failed. `valid`: False where the
    simulator failed; such a row is judged by nothing and is INVALID_SIM. A row that is not active
    is INVALID_INPUT.
    """
    active, grasp, b = held.active, held.grasp, len(held.active)
    device = str(active.device)
    sizes = dict.fromkeys(("passed", "evaluated", "margin", "margin_kind"), len(criteria))
    simulated = {"simulated": int(valid is not None), "valid": active if valid is None else valid}
    found: dict[str, Tensor] = over_trials(
        kernels.open_verdict, b, device, sizes=sizes, chunk=ROWS_CHUNK
    )(
        invalid_input=int(Outcome.INVALID_INPUT),
        invalid_sim=int(Outcome.INVALID_SIM),
        shaken=int(slip_m is not None),
        active=active,
        width=grasp.width_m,
        opening=grasp.opening_m,
        shift=grasp.shift_m,
        slip=grasp.width_m if slip_m is None else slip_m.float(),
        **simulated,
    )
    columns = {name: found[name] for name in ("outcome", "success", "borderline", *sizes)}
    # where nothing is given nothing is read
    fillers = {
        "kind": constants(active.device, torch.int8, 0),
        "code": constants(active.device, torch.int32, 0),
    }
    for entry in (e for e in IN_ORDER if e in entries):
        column = entries.index(entry)
        c = criteria[column]
        kind = {}
        if c.kind is not None:
            kind["code" if c.kind_of else "kind"] = c.kind.contiguous()
        over_trials(kernels.judge_criterion, b, device, outputs=columns, chunk=ROWS_CHUNK)(
            column=column,
            failure=int(Outcome[entry.name.upper()]),
            borderline=UNITS[entry.unit].borderline,
            touching=int(entry.touching_passes),
            partial=int(entry.splits != SPLITS),
            below=int(c.below),
            limit=c.limit,
            cap=c.cap,
            decided=int(c.passed is not None),
            kind_from=0 if c.kind is None else 2 if c.kind_of else 1,
            number=c.number.contiguous(),
            evaluated=c.evaluated.contiguous(),
            passed=active if c.passed is None else c.passed.contiguous(),
            kind_of_code=constants(active.device, torch.int8, *(c.kind_of or (0,))),
            **fillers | kind,
            **simulated,
        )
    return found


def motion_fields(
    active: Bool[Tensor, " b"],
    planned: "Plan",
    motion: "Motion",
    executed: "Executed",
    nearest: NearestApproach,
    config: ExecConfig | None,
    *,
    t_plan_s: float,
    keep_motion: bool,
    body_m: Float32[Tensor, " b"] | None,
) -> dict[str, Tensor]:
    """The fields of `Scores` of trials that were planned and moved, beside those of `verdict`. `config`: the time
    law of the path, None for motions with times of their own."""
    from r2h_batch.judge.motion.execute import executed_time_at
    from r2h_batch.judge.motion.time_law import time_at

    has_path, witnessed = planned.length > 0, nearest.body >= 0
    begun = planned.reason != int(PlanReason.NOT_EVALUATED)
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
    return {
        "plan_reason": torch.where(restless, int(PlanReason.NOT_SETTLED), planned.reason).to(
            torch.int8
        ),
        "plan_pair": torch.where(active, planned.pair, int(CollidingPair.NONE)).to(torch.int8),
        "witness_part": torch.stack([torch.where(has_path, planned.body, -1), nearest.body], 1),
        "witness_time_s": torch.where(witnessed, time_s, torch.nan),
        "witness_point": torch.where(witnessed[:, None], nearest.point, torch.nan),
        "t_plan_s": torch.where(begun, t_plan_s, torch.nan).float(),
        "t_exec_s": executed.t_exec_s,
        "q_goal": torch.where(has_path[:, None], goal, torch.nan),
        "path": planned.path,
        "path_time_s": motion.time_s,
        "path_len": planned.length,
        "motion": kept,
        "motion_len": kept_len,
        "failed_state": failed_state,
        "body_m": torch.full_like(executed.t_exec_s, torch.nan) if body_m is None else body_m,
    }


def pose_fields(goal: Goal, nearest: NearestApproach) -> dict[str, Tensor]:
    """The fields of `Scores` of poses that were judged without a path, beside those of
    `verdict`."""
    b, joints = goal.q.shape
    sizes = {"witness_part": 2, "q_goal": joints}
    found: dict[str, Tensor] = over_trials(
        kernels.pose_rows, b, str(goal.q.device), sizes=sizes, chunk=ROWS_CHUNK
    )(
        reason=goal.reason,
        pair=goal.pair,
        plan_body=goal.body,
        safe_body=nearest.body,
        point=nearest.point,
        q=goal.q,
    )
    return found


def scores_of(trial_id: Int64[Tensor, " b"], found: dict[str, Tensor]) -> Scores:
    """`Scores` of rows whose fields are all found. Poses that were judged without a path have no numbers in the others."""
    if "path" not in found:
        q = found["q_goal"]
        found = found | _no_path(*q.shape, q.device)
    return _kind(found)(trial_id=trial_id, **found)


def _kind(found: dict[str, Tensor]) -> type[Scores]:
    """The class of scores that have these fields."""
    if "receives" in found:
        return GivenScores
    return PickedScores if "pick" in found else Scores


def not_given(b: int, device: torch.device) -> dict[str, Tensor]:
    """The fields of `GivenScores` of B rows that nobody was asked to take."""
    made: dict[str, Tensor] = over_trials(
        kernels.nobody_takes, b, str(device), sizes={"receives": 3}, chunk=ROWS_CHUNK
    )()
    return made


def judged_later(
    scores: GivenScores,
    criterion: str,
    rows: Int64[Tensor, " n"],
    passed: Bool[Tensor, " n"],
    margin: Float32[Tensor, " n"],
    kind: Int64[Tensor, " n"],
) -> GivenScores:
    """The same verdicts with one more criterion, of rows that have passed all before it.

    Args:
        scores: B rows.
        criterion: its name.
        rows: (N,) which of them are judged by it.
        passed: (N,) whether it passes.
        margin: (N,) in its unit.
        kind: (N,) `MarginKind`.
    """
    column = scores.criteria.index(criterion)
    entry = scores.entries[column]

    def put(name: str, value: Any, at: Any = (rows, column)) -> Tensor:
        field: Tensor = getattr(scores, name).clone()
        field[at] = value if isinstance(value, bool) else value.to(field.dtype)
        return field

    near = scores.borderline[rows] | (margin.abs() < UNITS[entry.unit].borderline)
    failed = torch.where(passed, scores.outcome[rows], int(Outcome[criterion.upper()]))
    return replace(
        scores,
        passed=put("passed", passed),
        evaluated=put("evaluated", True),
        margin=put("margin", margin),
        margin_kind=put("margin_kind", kind),
        outcome=put("outcome", failed, rows),
        success=put("success", passed, rows),
        borderline=put("borderline", near, rows),
    )


@lru_cache(maxsize=16)
def _no_path(b: int, joints: int, device: torch.device) -> dict[str, Tensor]:
    """Fields of postures that hold no numbers."""
    path = torch.empty((b, 0, joints), dtype=torch.float32, device=device)
    state = torch.empty((b, 0), dtype=torch.float64, device=device)
    return {"path": path, "path_time_s": path[:, :, 0], "motion": path, "failed_state": state}


def _kept_motion(executed: "Executed", keep: bool) -> tuple[Tensor, Tensor, Tensor]:
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
