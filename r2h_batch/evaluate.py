"""The Evaluator: a batch of handovers in, verdicts with margins and reasons out. The stages in order, nothing else."""

import copy
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import torch
from jaxtyping import Float32
from torch import Tensor

from r2h_batch import metrics, se3
from r2h_batch.config import BORDERLINE_M, EvalConfig
from r2h_batch.execute import Executed, execute, executed_time_at, time_at, time_path
from r2h_batch.grasp import attach, close_gripper
from r2h_batch.hand import HandSet
from r2h_batch.ik import one_branch, solve_ik
from r2h_batch.launch import one_torch_thread
from r2h_batch.objects import ObjectModel
from r2h_batch.plan import plan_paths
from r2h_batch.scene import Scene
from r2h_batch.types import CollidingPair, Outcome, PlanReason, Scores, Trials


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

    @cached_property
    def kinematic(self) -> "Evaluator":
        """The same evaluator with the motion taken as planned (`sim="none"`): for methods that score while they search."""
        twin = copy.copy(self)
        twin.config = replace(self.config, execute=replace(self.config.execute, sim="none"))
        return twin

    def score(
        self,
        T_obj_ee: Float32[Tensor, "b 4 4"],
        T_world_ee: Float32[Tensor, "b 4 4"],
        trials: Trials,
        *,
        keep_motion: bool = False,
    ) -> Scores:
        """Verdicts of B handovers: outcome, five criteria with margins (m), reasons, times, joint path.

        `T_obj_ee`: grasp, ee in the object's frame. `T_world_ee`: handover, ee in the world. Metres; rotations off by at
        most 1e-3 are re-orthonormalised, rows that are no pose come back as INVALID_INPUT and leave the others untouched.
        Rows do not depend on their batch: same bits for any batch size, order, chunk and thread count on one device.
        `keep_motion`: also return the executed joint angles (24 kB for 8 s of motion).
        Raises ValueError, TypeError before any work when shape, dtype or device do not fit.
        """
        self._check(T_obj_ee, T_world_ee, trials)
        n, chunk = len(trials), self.config.chunk
        with one_torch_thread(self.scene.device):
            parts = [
                self._score_chunk(
                    T_obj_ee[i : i + chunk], T_world_ee[i : i + chunk], trials[i : i + chunk], keep_motion
                )
                for i in range(0, max(n, 1), chunk)
            ]
        return parts[0] if len(parts) == 1 else Scores.concatenate(parts)

    def _score_chunk(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, keep_motion: bool) -> Scores:
        scene, config, threads = self.scene, self.config, self.threads
        T_world_hand, objects = trials.T_world_hand, trials.object_index.contiguous()
        active = se3.is_pose(T_obj_ee) & se3.is_pose(T_world_ee) & se3.is_pose(T_world_hand)
        T_obj_ee, T_world_ee, T_world_hand = (_usable(T, active) for T in (T_obj_ee, T_world_ee, T_world_hand))

        grasp = close_gripper(
            scene.grasp_tables, T_obj_ee, objects, w_max=config.thresholds.w_max_m, mode=config.width, threads=threads
        )
        attached = attach(T_obj_ee, grasp.shift_m)
        placed = scene.place(objects, trials.hand_index, attached, T_world_hand, grasp.opening_m, threads=threads)

        plan_start = time.perf_counter()
        ik = solve_ik(T_world_ee, active=active, threads=threads)
        branches = ik.valid if config.plan.goals == "set" else one_branch(ik, T_world_ee, threads=threads)
        key = _random_key(trials.trial_id)
        planned = plan_paths(
            scene, placed, ik.q, branches, active, key, config.plan, execute=config.execute, threads=threads
        )
        t_plan_s = (time.perf_counter() - plan_start) / max(len(trials), 1)
        motion = time_path(planned.path, planned.length, config.execute)
        executed = execute(scene, placed, planned.path, planned.length, motion, config.execute, threads=threads)

        T_world_obj = se3.matmul(T_world_ee, se3.inverse(attached))
        _, _, ball_center = scene.palm(trials.hand_index, T_world_hand)
        safe, touch = metrics.safe(scene, placed, executed, active, config.thresholds, threads=threads)
        steady, slip = metrics.stability(grasp, active), torch.full_like(grasp.width_m, torch.nan)
        if config.stability == "physics":
            steady, slip = metrics.stability_in_physics(scene, grasp, attached, objects, active, threads=threads)
        criteria = [
            steady,
            metrics.plan(planned, executed, active),
            metrics.reach(scene, T_world_obj, ball_center, objects, active, config.thresholds, threads=threads),
            metrics.affordance(scene, T_obj_ee, objects, grasp, active, config.thresholds, threads=threads),
            safe,
        ]
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
        kept, kept_len = _kept_motion(executed, keep_motion)
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
            width_m=torch.where(active, grasp.width_m, nan),
            opening_m=torch.where(active, grasp.opening_m, nan),
            grasp_shift_m=torch.where(active, grasp.shift_m, nan),
            slip_m=slip,
            path=planned.path,
            path_time_s=motion.time_s,
            path_len=planned.length,
            motion=kept,
            motion_len=kept_len,
        )

    def _check(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> None:
        device = torch.device(self.scene.device)
        if not isinstance(trials, Trials):
            raise TypeError(f"trials is a {type(trials).__name__}; it must be r2h_batch.Trials")
        n = len(trials)
        for name, value in (
            ("T_obj_ee", T_obj_ee),
            ("T_world_ee", T_world_ee),
            ("trials.T_world_hand", trials.T_world_hand),
        ):
            if not isinstance(value, Tensor):
                raise TypeError(f"{name} is a {type(value).__name__}; it must be a torch tensor (B, 4, 4)")
            if value.dtype != torch.float32:
                raise TypeError(f"{name} is {value.dtype}; it must be torch.float32: call .float()")
            if value.shape != (n, 4, 4):
                raise ValueError(f"{name} has shape {tuple(value.shape)}; with {n} trials it must be ({n}, 4, 4)")
            if value.device.type != device.type:
                raise ValueError(f"{name} is on {value.device}, the evaluator on {device}: move one of them")
        for name, index, count in (
            ("object_index", trials.object_index, len(self.scene.objects)),
            ("hand_index", trials.hand_index, len(self.scene.hands.set)),
        ):
            if index.shape != (n,) or index.dtype != torch.int32 or index.device.type != device.type:
                raise ValueError(
                    f"trials.{name} is {index.dtype} {tuple(index.shape)} on {index.device}; it must be int32 ({n},) on {device}"
                )
            if n and not (int(index.min()) >= 0 and int(index.max()) < count):
                raise ValueError(
                    f"trials.{name} runs from {int(index.min())} to {int(index.max())}; the scene has 0 to {count - 1}"
                )


def _usable(T: Tensor, active: Tensor) -> Tensor:
    """Orthonormal poses, the identity where a row is not active."""
    eye = torch.eye(4, dtype=T.dtype, device=T.device)
    return torch.where(
        active[:, None, None], se3.orthonormalise(torch.where(active[:, None, None], T.detach(), eye)), eye
    ).contiguous()


def _kept_motion(executed: Executed, keep: bool) -> tuple[Tensor, Tensor]:
    """Recorded samples and their number: of all that moved, or only of those whose simulation failed."""
    length = executed.recorded if keep else torch.where(executed.valid, 0, executed.recorded)
    return executed.path[:, : int(length.max()) if len(length) else 0].clone(), length


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
        outcome[evaluated[:, i] & ~passed[:, i]] = i + 1
    outcome[~active] = int(Outcome.INVALID_INPUT)
    return outcome
