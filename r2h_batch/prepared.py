"""An `Evaluator` besides its stages: the scene and settings that it is built from, copies and pickles, threads,
chunks that bound the memory, captured calls, hints about mistaken conventions. `evaluate.py` has the stages.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Self

import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from r2h_batch.base.launch import cpu_threads
from r2h_batch.base.launch.memory import in_chunks, rows_at_once
from r2h_batch.base.launch.repeated import RepeatedCalls
from r2h_batch.base.launch.threads import on_threads, one_torch_thread
from r2h_batch.base.registry import PRESET_NAMES
from r2h_batch.base.table import of_lines
from r2h_batch.base.validate import instance_of, one_of, optional, suggest_names
from r2h_batch.config import EvalConfig, ExecutionError, ObjectErrors
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.ik import build_tables
from r2h_batch.judge.inputs import (
    KnownInputs,
    Stages,
    check_asks,
    check_indices,
    check_receiver,
    check_stages,
    warn_of_payload,
)
from r2h_batch.protocols.benchmark import Benchmark
from r2h_batch.protocols.load import load_benchmark
from r2h_batch.scene.scene import Scene
from r2h_batch.training import torch_op
from r2h_batch.training.capture import Captured, check_capture
from r2h_batch.types import Scores, Trials

if TYPE_CHECKING:
    from r2h_batch.observe.sees import Sees

POSE_CHUNK_CUDA = 1 << 16
"""Rows of one launch of the pose stage on CUDA, about 4 KB of working memory each."""

ROW_BYTES, MOVED_ROW_BYTES = 32 << 10, 192 << 10
"""Working memory of a row with a path, and of one whose motion is recorded, without the trees of the
planner's search."""

SORTED_ROWS = 256
"""CPU batches of this size or more are sorted by object, then by hand. Neighbouring rows then share
cached data and branches. This is five to ten per cent faster, and another five where candidates share
trials."""

SIZES_KEPT = 8
"""Each thread keeps recordings of small pose calls (`base.launch.repeated`) of at most so many batch sizes."""


class Prepared(ABC):
    """A scene, settings and memory, ready to judge. `Evaluator` adds the stages."""

    called = moved = (
        False  # True after the first call of poses, of motions was checked for common mistakes
    )

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
        self._small_calls = RepeatedCalls(SIZES_KEPT)
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
        twin.called = True  # the poses of a search are no mistakes
        return twin

    def rows_at_once(self, stages: Stages = "all") -> int:
        """How many rows are judged together: `EvalConfig.chunk`, on CUDA more where there is memory
        for it.

        A call with more rows is judged in chunks; a smaller call does not use the whole GPU.
        """
        check_stages(stages)
        chunk, device = self.config.chunk, self.scene.device
        if stages == "pose":  # without paths a row needs a quarter of the memory
            return max(chunk, POSE_CHUNK_CUDA) if device != "cpu" else 4 * chunk
        moves = self.config.execute.engine(torch.device(device).type) != "none"
        return rows_at_once(device, chunk, MOVED_ROW_BYTES if moves else ROW_BYTES)

    def _score(
        self,
        T_obj_ee: Tensor,
        T_world_ee: Tensor,
        trials: Trials,
        stages: Stages,
        keep_motion: bool = False,
    ) -> Scores:
        """The batch in chunks that bound the memory; results do not depend on the chunk boundaries."""
        n = len(trials)
        T_obj_ee, T_world_ee = executed_poses(
            self.config, self.scene.objects, T_obj_ee, T_world_ee, trials
        )
        score_chunk = (
            self._score_pose
            if stages == "pose"
            else partial(self._score_planned, keep_motion=keep_motion)
        )
        order = None
        if n >= SORTED_ROWS and not T_obj_ee.is_cuda:
            pairs = trials.object_index.long() * len(self.scene.hands.set) + trials.hand_index
            order = torch.argsort(pairs, stable=True)
            T_obj_ee, T_world_ee, trials = T_obj_ee[order], T_world_ee[order], trials[order]

        def chunk(first: int, last: int) -> Scores:
            if last - first == n:
                return score_chunk(T_obj_ee, T_world_ee, trials)
            return score_chunk(T_obj_ee[first:last], T_world_ee[first:last], trials[first:last])

        chunks = in_chunks(n, self.rows_at_once(stages), chunk)
        scores = chunks[0] if len(chunks) == 1 else Scores.concatenate(chunks)
        return scores if order is None else scores[torch.argsort(order)]

    def _score_checked(
        self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, *, stages: Stages
    ) -> Scores:
        """`score` of tensors whose shapes are known to fit."""
        with self.working():
            check_indices(self.scene, trials)
            check_receiver(self.config, trials)
            return self._score(T_obj_ee, T_world_ee, trials, stages)

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
        check_capture(self.config, device, stages)
        return Captured(partial(self._score_checked, stages=stages), device, b)

    def hint(
        self, scores: Scores, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials
    ) -> str | None:
        """One line where all rows fail and some succeed in another convention (`judge.conventions`); else None.

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
        """As `hint`, of motions; the arguments are those of `score_motion`."""
        from r2h_batch.judge.conventions import motion_hint

        def judge(rows: Tensor, q: Tensor, time_s: Tensor) -> Scores:
            few = None if length is None else torch.as_tensor(length)[rows]
            twin = copy.copy(self)
            twin.moved = True
            return twin.score_motion(T_obj_ee[rows], q, time_s, trials[rows], length=few)

        return motion_hint(scores, torch.as_tensor(q), torch.as_tensor(time_s), judge)

    def __repr__(self) -> str:
        engine = self.config.execute.engine(torch.device(self.scene.device).type)
        return f"Evaluator({self.scene.about}; preset {self.config.name}, sim {engine})"

    def _repr_html_(self) -> str:
        limits = vars(self.config.thresholds).items()
        lines = [(name, f"{value:g}") for name, value in limits]
        return of_lines(("limit", "value"), lines, title=repr(self)).html()

    @abstractmethod
    def score(
        self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, stages: Stages = "all"
    ) -> Scores:
        """Verdicts of B handovers."""

    @abstractmethod
    def score_motion(
        self,
        T_obj_ee: Float32[Tensor, "b 4 4"],
        q: Float[Tensor, "b w j"],
        time_s: Float[Tensor, "b w"] | Float[Tensor, " w"],
        trials: Trials,
        *,
        length: Int[Tensor, " b"] | None = None,
    ) -> Scores:
        """Verdicts of B motions."""

    @abstractmethod
    def _score_pose(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> Scores:
        """The stages that need no path, of one chunk."""

    @abstractmethod
    def _score_planned(
        self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, keep_motion: bool
    ) -> Scores:
        """Every stage, of one chunk."""
