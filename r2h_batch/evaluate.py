"""The Evaluator: a batch of handovers in, verdicts with margins and reasons out. The stages in order, nothing else."""

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from jaxtyping import Float32
from torch import Tensor

from r2h_batch import metrics, se3, torch_op
from r2h_batch.capture import Captured
from r2h_batch.config import BORDERLINE_M, EvalConfig
from r2h_batch.execute import Executed, execute, executed_time_at, time_at, time_path
from r2h_batch.gradients import differentiable
from r2h_batch.grasp import Grasp, attach, close_gripper
from r2h_batch.hand import HandSet
from r2h_batch.ik import IkResult, one_branch, solve_ik
from r2h_batch.inputs import Stages, check_indices, checked_inputs
from r2h_batch.launch import one_torch_thread
from r2h_batch.metrics import Criterion
from r2h_batch.objects import ObjectModel
from r2h_batch.plan import plan_paths
from r2h_batch.pose import judge_goals, safe_at
from r2h_batch.scene import Placed, Scene
from r2h_batch.types import CollidingPair, Outcome, PlanReason, Scores, Trials

POSE_CHUNK_CUDA = 1 << 16
"""Rows of one launch of the pose stage on CUDA, about 4 KB of working memory each."""

SORTED_ROWS = 256
"""From here on the pose stage takes the rows of a CPU batch object by object: a tenth faster, for the caches' sake."""


class Evaluator:
    """Judges predicted handovers on one device. Build it once: it holds the scene's tables and compiled kernels."""

    def __init__(
        self,
        config: EvalConfig | None = None,
        *,
        device: str | torch.device = "cpu",
        objects: Sequence[ObjectModel] | None = None,
        hand_set: HandSet | None = None,
        threads: int | None = None,
    ) -> None:
        self.config = config or EvalConfig()
        self.scene = Scene(device, config=self.config, objects=objects, hand_set=hand_set)
        self.threads = threads
        self.handle = torch_op.register(self)

    @cached_property
    def kinematic(self) -> "Evaluator":
        """The same evaluator with the motion taken as planned (`sim="none"`): for methods that score while they search."""
        twin = copy.copy(self)
        twin.config = replace(self.config, execute=replace(self.config.execute, sim="none"))
        twin.handle = torch_op.register(twin)
        return twin

    def score(
        self,
        T_obj_ee: Float32[Tensor, "*b 4 4"],
        T_world_ee: Float32[Tensor, "*b 4 4"],
        trials: Trials,
        stages: Stages = "all",
        *,
        keep_motion: bool = False,
    ) -> Scores:
        """Verdicts of B handovers: outcome, five criteria with margins (m), reasons, times, joint path.

        `T_obj_ee`: grasp, ee in the object's frame. `T_world_ee`: handover, ee in the world. Metres; rotations off by at
        most 1e-3 are re-orthonormalised, rows that are no pose come back as INVALID_INPUT and leave the others untouched.
        Rows do not depend on their batch: same bits for any batch size, order, chunk and thread count on one device.
        `keep_motion`: also return the executed joint angles (24 kB for 8 s of motion).
        Raises ValueError, TypeError before any work when shape, dtype or device do not fit.

        `stages="pose"` judges what needs no path, with the same kernels: Stability, Reach, Affordance (same bits), Plan and
        Safe at the goal posture. A pose that fails here fails there. `passed[:, PLAN]`: home and some branch are free;
        `plan_reason` differs from the full one only where that is NO_PATH_IN_BUDGET or NOT_SETTLED. `q_goal`,
        `margin[:, PLAN]`: posture and clearance of `r2h_batch.pose.Goal`, always finite. `margin[:, SAFE]`: the hand's exact
        mesh at `q_goal`, evaluated for every pose. No path: `path_len` 0, `path` of width 0, times NaN.

        With stages="pose", margins lead back to poses that require a gradient (docs/gradients.md).

        K candidates for each of N trials: poses (N, K, 4, 4), rows of the result in that order (`Scores.by_trial`).
        """
        T_obj_ee, T_world_ee, trials = checked_inputs(self.scene, T_obj_ee, T_world_ee, trials, stages)
        if torch.compiler.is_compiling():
            return torch_op.call(self.handle, T_obj_ee, T_world_ee, trials, stages)
        check_indices(self.scene, trials)
        return self._score(T_obj_ee, T_world_ee, trials, stages, keep_motion)

    def capture(self, b: int, *, stages: Stages = "pose") -> Captured:
        """A call of this evaluator for b rows, ready to be repeated: fixed memory in and out, on CUDA one graph."""
        return Captured(self, b, stages)

    def _score(
        self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, stages: Stages, keep_motion: bool = False
    ) -> Scores:
        n, chunk = len(trials), self.config.chunk
        if stages == "pose":  # without paths a row needs a quarter of the memory
            chunk = max(chunk, POSE_CHUNK_CUDA) if T_obj_ee.is_cuda else 4 * chunk
        else:  # a path's margins have no gradient here
            T_obj_ee, T_world_ee = T_obj_ee.detach(), T_world_ee.detach()
        judge = self._score_pose if stages == "pose" else partial(self._score_chunk, keep_motion=keep_motion)
        order = None
        if stages == "pose" and n >= SORTED_ROWS and not T_obj_ee.is_cuda:
            order = torch.argsort(trials.object_index, stable=True)
            T_obj_ee, T_world_ee, trials = T_obj_ee[order], T_world_ee[order], trials[order]
        with one_torch_thread(self.scene.device):
            parts = [
                judge(T_obj_ee[i : i + chunk], T_world_ee[i : i + chunk], trials[i : i + chunk])
                for i in range(0, max(n, 1), chunk)
            ]
        scores = parts[0] if len(parts) == 1 else Scores.concatenate(parts)
        return scores if order is None else scores[torch.argsort(order)]

    def _score_chunk(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, keep_motion: bool) -> Scores:
        scene, config, threads = self.scene, self.config, self.threads
        held = self._hold(T_obj_ee, T_world_ee, trials)
        active, placed = held.active, held.placed

        plan_start = time.perf_counter()
        ik, branches = self._branches(held)
        key = _random_key(trials.trial_id)
        planned = plan_paths(
            scene, placed, ik.q, branches, active, key, config.plan, execute=config.execute, threads=threads
        )
        t_plan_s = (time.perf_counter() - plan_start) / max(len(trials), 1)
        motion = time_path(planned.path, planned.length, config.execute)
        executed = execute(scene, placed, planned.path, planned.length, motion, config.execute, threads=threads)

        safe, touch = metrics.safe(scene, placed, executed, active, config.thresholds, threads=threads)
        (steady, reach, affordance), slip = self._without_posture(held)
        criteria = [steady, metrics.plan(planned, executed, active), reach, affordance, safe]
        judged = executed.valid[:, None]
        evaluated = torch.stack([c.evaluated for c in criteria], 1) & judged
        passed = torch.stack([c.passed for c in criteria], 1) & judged
        margin = torch.where(judged, torch.stack([c.margin for c in criteria], 1), torch.nan)
        outcome = _first_failure(passed, evaluated, active)
        outcome[active & ~executed.valid] = int(Outcome.INVALID_SIM)
        restless = (planned.length > 0) & executed.valid & ~executed.settled
        found = planned.length > 0
        nan = torch.full_like(motion.t_exec_s, torch.nan)
        goal = planned.path[torch.arange(len(trials), device=active.device), (planned.length - 1).clamp(min=0).long()]
        witnessed = touch.body >= 0
        if executed.sample_s is None:
            witness_time_s = time_at(
                planned.path, planned.length, motion, touch.segment, touch.fraction, config.execute
            )
        else:
            witness_time_s = executed_time_at(executed, touch.segment, touch.fraction)
        kept, kept_len, failed_state = _kept_motion(executed, keep_motion)
        return Scores(
            trial_id=trials.trial_id,
            outcome=outcome,
            success=outcome == int(Outcome.SUCCESS),
            passed=passed,
            evaluated=evaluated,
            margin=margin,
            borderline=(evaluated & (margin.abs() < BORDERLINE_M)).any(1),
            plan_reason=torch.where(restless, int(PlanReason.NOT_SETTLED), planned.reason).to(torch.int8),
            plan_pair=torch.where(active, planned.pair, int(CollidingPair.NONE)).to(torch.int8),
            witness_part=torch.stack([torch.where(found, planned.body, -1), touch.body], 1),
            witness_time_s=torch.where(witnessed, witness_time_s, nan),
            witness_point=torch.where(witnessed[:, None], touch.point, torch.nan),
            t_plan_s=torch.where(active, t_plan_s, torch.nan).float(),
            t_exec_s=executed.t_exec_s,
            q_goal=torch.where(found[:, None], goal, torch.nan),
            width_m=torch.where(active, held.grasp.width_m, nan),
            opening_m=torch.where(active, held.grasp.opening_m, nan),
            grasp_shift_m=torch.where(active, held.grasp.shift_m, nan),
            slip_m=slip,
            path=planned.path,
            path_time_s=motion.time_s,
            path_len=planned.length,
            motion=kept,
            motion_len=kept_len,
            failed_state=failed_state,
        )

    def _score_pose(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> Scores:
        """As `_score_chunk`, as far as it goes without a path."""
        held = self._hold(T_obj_ee, T_world_ee, trials)
        active = held.active
        ik, branches = self._branches(held)
        goal = judge_goals(self.scene, held.placed, held.T_world_ee, ik, branches, active, threads=self.threads)
        safe, body, point = safe_at(
            self.scene, held.placed, goal.q, active, self.config.thresholds, threads=self.threads
        )
        (steady, reach, affordance), slip = self._without_posture(held)
        plan = Criterion(torch.where(active, goal.clearance_m, torch.nan), goal.free, active)
        criteria = [steady, plan, reach, affordance, safe]
        evaluated = torch.stack([c.evaluated for c in criteria], 1)
        passed = torch.stack([c.passed for c in criteria], 1)
        margin = torch.stack([c.margin for c in criteria], 1)
        outcome = _first_failure(passed, evaluated, active)
        b, nan = len(trials), torch.full_like(goal.clearance_m, torch.nan)
        none = torch.empty((b, 0, 6), dtype=torch.float32, device=active.device)
        scores = Scores(
            trial_id=trials.trial_id,
            outcome=outcome,
            success=outcome == int(Outcome.SUCCESS),
            passed=passed,
            evaluated=evaluated,
            margin=margin,
            borderline=(evaluated & (margin.abs() < BORDERLINE_M)).any(1),
            plan_reason=goal.reason.to(torch.int8),
            plan_pair=goal.pair.to(torch.int8),
            witness_part=torch.stack([goal.body, body], 1),
            witness_time_s=nan,
            witness_point=point,
            t_plan_s=nan,
            t_exec_s=nan,
            q_goal=goal.q,
            width_m=torch.where(active, held.grasp.width_m, nan),
            opening_m=torch.where(active, held.grasp.opening_m, nan),
            grasp_shift_m=torch.where(active, held.grasp.shift_m, nan),
            slip_m=slip,
            path=none,
            path_time_s=none[:, :, 0],
            path_len=torch.zeros_like(goal.reason),
            motion=none,
            motion_len=torch.zeros_like(goal.reason),
            failed_state=none[:, :, 0].double(),
        )
        if torch.is_grad_enabled() and (T_obj_ee.requires_grad or T_world_ee.requires_grad):
            return differentiable(self, scores, T_obj_ee, T_world_ee, held, goal)
        return scores

    def _hold(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> "_Held":
        """Which rows are poses; the object in the closed gripper, everything at its place."""
        scene, T_world_hand, objects = self.scene, trials.T_world_hand, trials.object_index.contiguous()
        active = se3.is_pose(T_obj_ee) & se3.is_pose(T_world_ee) & se3.is_pose(T_world_hand)
        hands = trials.hand_index
        if objects.is_cuda:  # on a CPU they were looked at before any work
            for index, count in ((objects, len(scene.objects)), (hands, len(scene.hands.set))):
                active = active & (index >= 0) & (index < count)
            objects, hands = torch.where(active, objects, 0), torch.where(active, hands, 0)
        T_obj_ee, T_world_ee, T_world_hand = (_usable(T, active) for T in (T_obj_ee, T_world_ee, T_world_hand))
        grasp = close_gripper(
            scene.grasp_tables,
            T_obj_ee,
            objects,
            w_max=self.config.thresholds.w_max_m,
            mode=self.config.width,
            threads=self.threads,
        )
        attached = attach(T_obj_ee, grasp.shift_m)
        placed = scene.place(objects, hands, attached, T_world_hand, grasp.opening_m, threads=self.threads)
        return _Held(active, T_obj_ee, T_world_ee, T_world_hand, hands, objects, grasp, attached, placed)

    def _branches(self, held: "_Held") -> tuple[IkResult, Tensor]:
        """All IK branches, and which of them may be used."""
        ik = solve_ik(held.T_world_ee, active=held.active, threads=self.threads)
        if self.config.plan.goals == "set":
            return ik, ik.valid
        return ik, one_branch(ik, held.T_world_ee, threads=self.threads)

    def _without_posture(self, held: "_Held") -> tuple[tuple[Criterion, Criterion, Criterion], Tensor]:
        """Stability, Reach, Affordance: they need no joint angles; and how far the object slipped (NaN: not shaken)."""
        scene, config, threads, active = self.scene, self.config, self.threads, held.active
        T_world_obj = se3.matmul(held.T_world_ee, se3.inverse(held.attached))
        _, _, ball_center = scene.palm(held.hands, held.T_world_hand)
        steady, slip = metrics.stability(held.grasp, active), torch.full_like(held.grasp.width_m, torch.nan)
        if config.stability == "physics":
            steady, slip = metrics.stability_in_physics(
                scene, held.grasp, held.attached, held.objects, active, threads=threads
            )
        reach = metrics.reach(scene, T_world_obj, ball_center, held.objects, active, config.thresholds, threads=threads)
        affordance = metrics.affordance(
            scene, held.T_obj_ee, held.objects, held.grasp, active, config.thresholds, threads=threads
        )
        return (steady, reach, affordance), slip


@dataclass(frozen=True)
class _Held:
    """B trials with the object in the gripper: clean poses, the grasp, and where all bodies sit."""

    active: Tensor
    T_obj_ee: Tensor
    T_world_ee: Tensor
    T_world_hand: Tensor
    hands: Tensor
    objects: Tensor
    grasp: Grasp
    attached: Tensor
    placed: Placed


def _usable(T: Tensor, active: Tensor) -> Tensor:
    """Orthonormal poses, the identity where a row is not active."""
    eye = torch.eye(4, dtype=T.dtype, device=T.device)
    return torch.where(
        active[:, None, None], se3.orthonormalise(torch.where(active[:, None, None], T.detach(), eye)), eye
    ).contiguous()


def _kept_motion(executed: Executed, keep: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Recorded samples and their number, of all that moved or only of those whose simulation failed; and their state then."""
    length = executed.recorded if keep else torch.where(executed.valid, 0, executed.recorded)
    state = executed.failed_state
    if state is None or executed.valid.all():
        state = torch.empty((len(length), 0), dtype=torch.float64, device=length.device)
    return executed.path[:, : int(length.max()) if len(length) else 0].clone(), length, state


def _random_key(trial_id: Tensor) -> Tensor:
    """31 well-mixed bits of each trial id (the finaliser of splitmix64's predecessor, on 32 bits)."""
    x = (trial_id ^ (trial_id >> 32)) & 0xFFFFFFFF
    for shift, factor in ((16, 0x45D9F3B), (16, 0x45D9F3B), (16, 1)):
        x = ((x ^ (x >> shift)) * factor) & 0xFFFFFFFF
    return (x & 0x7FFFFFFF).to(torch.int32)


def _first_failure(passed: Tensor, evaluated: Tensor, active: Tensor) -> Tensor:
    """The outcome: the first criterion, in the paper's order, that was evaluated and failed."""
    outcome = torch.full(passed.shape[:1], int(Outcome.SUCCESS), dtype=torch.int8, device=passed.device)
    for i in reversed(range(passed.shape[1])):
        outcome = outcome.masked_fill(evaluated[:, i] & ~passed[:, i], i + 1)
    return outcome.masked_fill(~active, int(Outcome.INVALID_INPUT))
