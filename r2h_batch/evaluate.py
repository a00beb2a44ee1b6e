"""The Evaluator: a batch of handovers in, verdicts with margins and reasons out.

It checks what it is given and hands it on. `stages` is the judge, `launching` brings rows there, `judge.inputs` has the
checks of tensors, `judge.conventions` the hints about mistaken conventions.
"""

import copy
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Self

import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from r2h_batch import launching
from r2h_batch.base.io.progress import busy
from r2h_batch.base.launch import cpu_threads
from r2h_batch.base.launch.repeated import RepeatedCalls
from r2h_batch.base.launch.threads import on_threads, one_torch_thread
from r2h_batch.base.registry import PRESET_NAMES
from r2h_batch.base.table import of_lines
from r2h_batch.base.validate import instance_of, one_of, optional, suggest_names
from r2h_batch.config import EvalConfig, ExecutionError, ObjectErrors
from r2h_batch.judge.calls import torch_op
from r2h_batch.judge.calls.capture import Captured, check_capture
from r2h_batch.judge.calls.gradients import asks_gradients, differentiable
from r2h_batch.judge.compile import compile_stages
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.ik import build_tables
from r2h_batch.judge.inputs import (
    KnownInputs,
    Stages,
    check_asks,
    check_benchmark,
    check_indices,
    check_receiver,
    check_stages,
    checked_inputs,
    warn_of_doubts,
    warn_of_no_gradient,
    warn_of_payload,
)
from r2h_batch.scene.scene import Scene
from r2h_batch.stages import BELIEVED, BELIEVED_PICKS, LAST, PICKS, PLANNED, POSE, TRACE
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.load import load_benchmark
from r2h_batch.types import ScoreInputs, Scores, Trials
from r2h_batch.work import Work

if TYPE_CHECKING:
    from r2h_batch.judge.pick import Picked
    from r2h_batch.observe.sees import Sees


class Evaluator:
    """Judges predicted handovers on one device. Build it once: it holds the scene's tables and
    compiled kernels.

    Args:
        benchmark: what is judged (`load_benchmark`); None: the default benchmark.
        config: how it is judged, planning and motion: a configuration, or a preset's name (`r2h-batch ls presets`);
            None: the default preset. Its thresholds and workplace must be defaults or equal the benchmark's.
        device: `cpu`, `cuda` or `cuda:N`.
        threads: CPU threads of a call; None: all cores.
        plans_in: the cameras by whose images arms are planned (docs/r2h_v3.md, "What planning believes"); None: planning
            knows the truth. For benchmarks that ask for Pick.

    Raises:
        TypeError, ValueError: one of these is something else.
    """

    called = moved = (
        False  # True after the first call of poses, of motions was checked for common mistakes
    )
    look_again = False  # True from a first call with successes until a later one, in which all rows fail, was checked

    @suggest_names
    def __init__(
        self,
        benchmark: Benchmark | None = None,
        config: EvalConfig | str | None = None,
        *,
        device: str | torch.device = "cpu",
        threads: int | None = None,
        plans_in: "Sees | None" = None,
    ) -> None:
        how = "load_benchmark(NAME or FILE)"
        if isinstance(benchmark, EvalConfig):
            how += ", and Evaluator(config=EvalConfig(...)) for a configuration"
        optional(instance_of(Benchmark, how))("benchmark", benchmark)
        if isinstance(config, str):
            config = EvalConfig.preset(one_of(*PRESET_NAMES)("config", config))
        optional(instance_of(EvalConfig, "EvalConfig(...) or the name of a preset"))(
            "config", config
        )
        cpu_threads(threads)
        self.scene = Scene(benchmark or load_benchmark(), device, config=config)
        warn_of_payload(self.scene)
        self.config = self.scene.config
        check_asks(self.benchmark, self.config)
        if plans_in is not None and "pick" not in self.benchmark.asks:
            raise ValueError(
                f"plans_in is given, and benchmark {self.benchmark.name!r} begins with the object in the gripper; leave it out"
            )
        self.threads, self.plans_in = threads, plans_in
        if self.scene.device != "cpu":
            build_tables(self.scene.robot, self.config.workplace.home_q, self.scene.device)
        self._begin()

    def _begin(self) -> None:
        """The state of this object alone: its number for torch.compile, and what calls keep."""
        self.handle = torch_op.register(self)
        self._small_calls = RepeatedCalls(launching.SIZES_KEPT)
        self._known_inputs = KnownInputs()

    @property
    def benchmark(self) -> Benchmark:
        """The benchmark that is judged."""
        return self.scene.benchmark

    def __getstate__(self) -> dict[str, Any]:
        """The state of a copy or pickle: all but the handle and what calls keep. Copies share the scene's tables, which
        nobody changes; another process builds its own (`Scene.__reduce__`), rows are bitwise
        equal."""
        own = ("handle", "kinematic", "_small_calls", "_known_inputs")
        return {k: v for k, v in self.__dict__.items() if k not in own}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    @contextmanager
    def working(self) -> Iterator[None]:
        """A context in which kernels use `threads` CPU threads and torch uses one."""
        with one_torch_thread(self.scene.device), on_threads(self.threads):
            yield

    @cached_property
    def kinematic(self) -> Self:
        """The same evaluator with the motion taken as planned (`sim="none"`) and without errors of execution or of the
        object's pose: for methods that score while they search. They believe what they see."""
        twin = copy.copy(self)
        execute = replace(self.config.execute, sim="none")
        twin.config = replace(
            self.config,
            execute=execute,
            execution_error=ExecutionError(),
            object_errors=ObjectErrors(),
        )
        twin.called, twin.look_again = True, False  # the poses of a search are no mistakes
        return twin

    @suggest_names
    def score(
        self,
        T_obj_ee: Float32[Tensor, "*g 4 4"],
        T_world_ee: Float32[Tensor, "*b 4 4"],
        trials: Trials,
        stages: Stages = "all",
        *,
        keep_motion: bool = False,
    ) -> Scores:
        """Verdicts of B handovers: outcome, five criteria with margins (m), reasons, times, joint
        path.

        A row has the same bits for any batch size, order, chunk and thread count on one device. The
        first call on a CPU warns of poses that look transposed, exchanged or in millimetres; if it had successes, so does the
        first later call without any.

        Args:
            T_obj_ee: grasps, (B, 4, 4): the ee in the object's frame, m. (N, K, 4, 4) for K candidates
                of each of N trials; (N, 4, 4) or (N, 1, 4, 4) where each trial has one grasp for K
                poses. Tensors on the evaluator's device, NumPy arrays or nested lists of float32 or
                float64; judged in float32.
            T_world_ee: handover poses: the ee in the world frame, m, (B, 4, 4) or (N, K, 4, 4).
                Rotations off by at most 1e-3 are orthonormalised.
            trials: B (or N) trials.
            stages: `all`: the benchmark. `pose`: what needs no path, with the same kernels
                (Stability, Reach, Affordance; Plan and Safe at the goal posture). A pose that fails
                there fails the benchmark too (docs/training_loop.md). Its margins have gradients
                where poses require them (docs/training_loop.md).
            keep_motion: also return the executed joint angles (24 kB for 8 s of motion).

        Returns:
            Scores of B (or N K) rows, trial by trial (`Scores.by_trial`). A row whose matrix is not a
            rigid transform is INVALID_INPUT; other rows are not affected. `pose`: `path` has width 0, times are NaN,
            `q_goal` and Plan's margin are those of `judge.goal.Goal`.

        Raises:
            TypeError, ValueError: shape, dtype or device do not fit; before any work.
        """
        T_obj_ee, T_world_ee, trials = self._known_inputs.checked(
            self.scene, T_obj_ee, T_world_ee, trials, stages
        )
        check_receiver(self.config, trials)
        gradients = asks_gradients(T_obj_ee, T_world_ee)
        if gradients and stages == "all":
            warn_of_no_gradient()
        if torch.compiler.is_compiling():
            if keep_motion:  # its width is known once all have moved
                return torch.compiler.disable(self.score)(
                    T_obj_ee, T_world_ee, trials, stages, keep_motion=keep_motion
                )
            return torch_op.call(self.handle, T_obj_ee, T_world_ee, trials, stages)
        check_benchmark(self.benchmark, trials)
        first = not self.called and not T_obj_ee.is_cuda  # looking at values would wait for a GPU
        if first:
            self.called = True
            warn_of_doubts(T_obj_ee, T_world_ee, trials)
        with busy("judging") if first else nullcontext(), self.working():
            check_indices(self.scene, trials)
            compile_stages(self.scene, paths=stages == "all")
            scores = self._score(
                T_obj_ee.detach(), T_world_ee.detach(), trials, stages, keep_motion
            )
            if gradients and stages == "pose":
                judge = partial(self.score, stages="pose")
                scores = differentiable(judge, scores, (T_obj_ee, T_world_ee), trials)
            look = first
            if first:
                self.look_again = bool(scores.success.any())
            elif self.look_again and not T_obj_ee.is_cuda and not scores.success.any():
                look, self.look_again = True, False
            if look and (words := self.hint(scores, T_obj_ee, T_world_ee, trials)):
                warnings.warn(words, stacklevel=3)
            # Copies: an optimizer's step in place must not change the stored inputs, from which
            # pictures of these scores are drawn.
            scores = scores.with_inputs(
                ScoreInputs(T_obj_ee.detach().clone(), T_world_ee.detach().clone(), trials, self)
            )
            return scores if stages == "pose" else self._last(scores)

    @suggest_names
    def score_motion(
        self,
        T_obj_ee: Float32[Tensor, "b 4 4"],
        q: Float[Tensor, "b w j"],
        time_s: Float[Tensor, "b w"] | Float[Tensor, " w"],
        trials: Trials,
        *,
        length: Int[Tensor, " b"] | None = None,
        planned_q: Float[Tensor, "b p j"] | None = None,
        planned_length: Int[Tensor, " b"] | None = None,
    ) -> Scores:
        """Verdicts of B motions that you planned: the same five criteria and the same columns.

        Plan: the motion collides with nothing (certified between the samples) and keeps the robot's
        limits of angles and speeds; `plan_reason` is OK, MOTION_IN_COLLISION, BEYOND_JOINT_LIMITS
        or BEYOND_SPEED_LIMITS. It may start anywhere. Safe: along the motion as given, no
        simulator. The handover pose is where the motion ends. `t_exec_s` is the motion's duration, `t_plan_s` NaN.

        Args:
            T_obj_ee: the grasp, ee in the object's frame, m.
            q: angles of the robot's joints in W samples, rad; joints move at a constant rate between two samples.
            time_s: time of each sample, s; of all motions at once if it is (W,).
            trials: B trials.
            length: how many samples of each motion count, 2 to W; None: all W.
            planned_q: the planned path, if q is its execution by a robot or a simulator. Plan then judges
                both; if the robot touches the hand, Safe judges q and Plan judges planned_q alone.
                The other criteria judge q. None: q is the plan.
            planned_length: as `length`, of the plan.

        Returns:
            Scores of B rows. INVALID_INPUT: an angle is not finite, times go back, are not finite or
            end after 1e9 s, a joint moves between two samples of equal time, or the plan's first sample is more
            than 0.1 rad away from the motion's. A motion
            beyond the limits of angles is judged as one without a path.

        Raises:
            TypeError, ValueError: shape, dtype or device do not fit; before any work.
        """
        from r2h_batch.judge.trace import checked_plan, checked_trace, final_pose

        # torch.compile cannot trace this function. As a decorator, `disable` would cost every import a second.
        if torch.compiler.is_compiling():
            return torch.compiler.disable(self.score_motion)(
                T_obj_ee,
                q,
                time_s,
                trials,
                length=length,
                planned_q=planned_q,
                planned_length=planned_length,
            )
        instance_of(Trials, "benchmark.trials(...), or r2h_batch.Trials")("trials", trials)
        check_benchmark(self.benchmark, trials)
        for section in ("execution_error", "object_errors"):
            if getattr(self.config, section).any:
                raise ValueError(
                    f"{section} changes poses, and motions are judged as they are; score motions"
                    " with an Evaluator without it"
                )
        trace = checked_trace(q, time_s, length, len(trials), self.scene)
        plan = trace
        if planned_q is not None:
            plan = checked_plan(planned_q, planned_length, trace, self.scene)
            trace = replace(trace, usable=trace.usable & plan.usable)
        T_world_ee = final_pose(self.scene, trace)
        T_obj_ee, T_world_ee, trials = checked_inputs(
            self.scene, T_obj_ee, T_world_ee, trials, "all"
        )
        T_obj_ee = T_obj_ee.detach()
        check_receiver(self.config, trials)

        work = self._work(T_obj_ee, T_world_ee, trials, trace=trace, beside=plan)
        with self.working():
            check_indices(self.scene, trials)
            scores = launching.judged(
                work, TRACE, self._small_calls, at_once=self.rows_at_once(), sort=False
            )
        if not self.moved and not T_obj_ee.is_cuda and planned_q is None:
            self.moved = True
            if words := self.motion_hint(scores, T_obj_ee, trials, q, time_s, length):
                warnings.warn(words, stacklevel=3)
        scores = scores.with_inputs(ScoreInputs(T_obj_ee.clone(), T_world_ee, trials, self))
        with self.working():
            return self._last(scores)

    def picks(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> "Picked":
        """How the arm picks, or fails to, as a part of the verdict on B handovers.

        Args:
            T_obj_ee: (B, 4, 4) grasps, as of `score`.
            T_world_ee: (B, 4, 4) handover poses, as of `score`.
            trials: B trials of a benchmark that asks for Pick.

        Raises:
            TypeError, ValueError: shape, dtype or device do not fit; before any work.
        """
        T_obj_ee, T_world_ee, trials = checked_inputs(
            self.scene, T_obj_ee, T_world_ee, trials, "all"
        )
        with self.working():
            work = self._work(T_obj_ee, T_world_ee, trials)
            found = work.through(PICKS if self.plans_in is None else BELIEVED_PICKS).picked
        assert found is not None  # the benchmark asks for it
        return found

    def in_scene(self, scene: Scene) -> "Evaluator":
        """The same evaluator in another scene, where planning knows the truth.

        Args:
            scene: its benchmark has the same limits and criteria.
        """
        twin = copy.copy(self)
        twin.scene, twin.plans_in = scene, None
        return twin

    def rows_at_once(self, stages: Stages = "all") -> int:
        """How many rows are judged together: `EvalConfig.chunk`, on CUDA more where there is memory
        for it.

        A call with more rows is judged in chunks; a smaller call does not use the whole GPU.

        Args:
            stages: as of `score`.
        """
        check_stages(stages)
        return launching.rows_at_once(self.config, self.scene.device, paths=stages == "all")

    def _work(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, **more: Any) -> Work:
        """What stages begin with."""
        return Work(self.scene, self.config, trials, T_obj_ee, T_world_ee, self.plans_in, **more)

    def _score(
        self,
        T_obj_ee: Tensor,
        T_world_ee: Tensor,
        trials: Trials,
        stages: Stages,
        keep_motion: bool = False,
    ) -> Scores:
        """Verdicts of poses that were checked, as the robot with its errors reaches them; `LAST` is not yet asked."""
        poses = executed_poses(self.config, self.scene.objects, T_obj_ee, T_world_ee, trials)
        work = self._work(*poses, trials, keep_motion=keep_motion)
        planned = PLANNED if self.plans_in is None else BELIEVED
        return launching.judged(
            work, POSE if stages == "pose" else planned, self._small_calls, at_once=self.rows_at_once(stages), sort=True
        )  # fmt: skip

    def _last(self, scores: Scores) -> Scores:
        """The same verdicts after the stages that ask about what has passed all others."""
        asked = scores.inputs
        assert asked is not None
        work = self._work(asked.T_obj_ee, asked.T_world_ee, asked.trials, scores=scores)
        return work.through(LAST).scores

    def _score_checked(
        self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, *, stages: Stages
    ) -> Scores:
        """`score` of tensors whose shapes are known to fit."""
        with self.working():
            check_indices(self.scene, trials)
            check_receiver(self.config, trials)
            scores = self._score(T_obj_ee, T_world_ee, trials, stages)
            if stages == "pose":
                return scores
            return self._last(scores.with_inputs(ScoreInputs(T_obj_ee, T_world_ee, trials, self)))

    def capture(self, b: int, *, stages: Stages = "pose") -> Captured:
        """A call of this evaluator for b rows, ready to be repeated: fixed memory in and out, on
        CUDA one graph.

        Args:
            b: rows of each call.
            stages: `pose`, or `all` on a CPU.

        Raises:
            ValueError: CUDA cannot capture this configuration; the message says what to change.
        """
        device = torch.device(self.scene.device)
        check_capture(self.benchmark, self.config, device, stages)
        score = partial(self._score_checked, stages=stages)
        return Captured(score, device, b, bodies=self.benchmark.has_bodies)

    def hint(
        self, scores: Scores, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials
    ) -> str | None:
        """One line where many rows fail and far more succeed in another convention (`judge.conventions`); else None.

        Args:
            scores: verdicts of the B rows.
            T_obj_ee: (B, 4, 4) the grasps, m.
            T_world_ee: (B, 4, 4) the handover poses, m.
            trials: B trials.
        """
        from r2h_batch.judge.conventions import pose_hint

        def judge(T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> Scores:
            with self.working():
                return self._score(T_obj_ee, T_world_ee, trials, "pose")

        resting = None
        if "pick" in self.benchmark.asks:
            from r2h_batch.observe.known import known_moments

            resting = known_moments(self.scene).of
        poses = T_obj_ee.detach(), T_world_ee.detach()
        return pose_hint(scores, *poses, trials, self.scene, judge, resting)

    def motion_hint(
        self,
        scores: Scores,
        T_obj_ee: Float32[Tensor, "b 4 4"],
        trials: Trials,
        q: Float[Tensor, "b w j"],
        time_s: Float[Tensor, "b w"] | Float[Tensor, " w"],
        length: Int[Tensor, " b"] | None = None,
    ) -> str | None:
        """As `hint`, of motions.

        Args:
            scores: verdicts of the B motions.
            T_obj_ee: (B, 4, 4) the grasps, m.
            trials: B trials.
            q: (B, W, J) samples of the motions, rad, as of `score_motion`.
            time_s: (B, W) or (W,) their times, s.
            length: (B,) how many samples count; None: all.
        """
        from r2h_batch.judge.conventions import motion_hint

        def judge(rows: Tensor, q: Tensor, time_s: Tensor) -> Scores:
            few = None if length is None else torch.as_tensor(length)[rows]
            twin = copy.copy(self)
            twin.moved = True
            return twin.score_motion(T_obj_ee[rows], q, time_s, trials[rows], length=few)

        given = torch.as_tensor(q), torch.as_tensor(time_s)
        return motion_hint(scores, *given, judge, self.scene.robot)

    def __repr__(self) -> str:
        engine = self.config.execute.engine(torch.device(self.scene.device).type)
        return f"Evaluator({self.scene.about}; preset {self.config.name}, sim {engine})"

    def _repr_html_(self) -> str:
        limits = vars(self.config.thresholds).items()
        lines = [(name, f"{value:g}") for name, value in limits]
        return of_lines(("limit", "value"), lines, title=repr(self)).html()
