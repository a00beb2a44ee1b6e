"""What the stages of a verdict pass on, and what a stage is. `stages` has the stages."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Bool, Float32, Float64, Int32
from torch import Tensor

from r2h_batch.config import EvalConfig
from r2h_batch.judge.attach import AttachedBatch, usable_rows
from r2h_batch.judge.distance import NearestApproach
from r2h_batch.judge.goal import Goal
from r2h_batch.judge.presented import Presented
from r2h_batch.judge.reach import Reached
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Scores, Trials

if TYPE_CHECKING:
    from r2h_batch.judge.motion.execute import Executed
    from r2h_batch.judge.motion.time_law import Motion
    from r2h_batch.judge.pick import Picked
    from r2h_batch.judge.plan import Plan
    from r2h_batch.judge.trace import Trace
    from r2h_batch.observe.sees import Sees


@dataclass(slots=True)
class Work:
    """B handovers, and what the stages so far know of them.

    Nobody reads what no stage before has written, so such a field has no None in its type.
    """

    scene: Scene
    config: EvalConfig
    trials: Trials
    T_obj_ee: Tensor
    T_world_ee: Tensor
    plans_in: "Sees | None" = None
    keep_motion: bool = False
    trace: "Trace" = None  # type: ignore[assignment]  # the motion that the caller gives,
    beside: "Trace" = None  # type: ignore[assignment]  # and its plan: the same one, or another
    T_world_obj: Tensor | None = None  # where objects rest; None: as the trials' moments say
    # what stages write, in their order
    held: AttachedBatch = None  # type: ignore[assignment]
    picked: "Picked | None" = None  # None: the benchmark does not ask for Pick
    planned: "Plan" = None  # type: ignore[assignment]
    missed_m: Tensor = None  # type: ignore[assignment]  # how far rows without a path are from one
    t_plan_s: float = float("nan")
    goal: Goal = None  # type: ignore[assignment]
    motion: "Motion" = None  # type: ignore[assignment]
    executed: "Executed" = None  # type: ignore[assignment]
    nearest: NearestApproach = None  # type: ignore[assignment]
    person: tuple[Tensor, Tensor] | None = None  # None: hands alone
    # for the criteria: `metrics.Evidence` says what these are
    goal_reached: Bool[Tensor, " b"] | None = None
    moves: Bool[Tensor, " b"] = None  # type: ignore[assignment]
    clearance_m: Float32[Tensor, " b"] = None  # type: ignore[assignment]
    reason: Int32[Tensor, " b"] = None  # type: ignore[assignment]
    slip_m: Float64[Tensor, " b"] | None = None
    reached: Reached = None  # type: ignore[assignment]
    presented: Presented = None  # type: ignore[assignment]
    valid: Bool[Tensor, " b"] | None = None
    fields: dict[str, Tensor] = field(default_factory=dict)  # of `Scores`
    scores: Scores = None  # type: ignore[assignment]  # of all rows, for stages of LAST

    def __getitem__(self, rows: slice | Tensor) -> "Work":
        """The same work on some rows, before any stage."""
        trace, beside = self.trace, self.beside
        if trace is not None:
            trace = trace[rows]
            beside = trace if beside is self.trace else beside[rows]
        poses = self.T_obj_ee[rows], self.T_world_ee[rows]
        return self.of(*poses, self.trials[rows], trace=trace, beside=beside)

    def of(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, **more: Any) -> "Work":
        """The work on other handovers, before any stage.

        Args:
            T_obj_ee: (B, 4, 4) grasps, m.
            T_world_ee: (B, 4, 4) handover poses, m.
            trials: B trials.
            more: other fields that are not as here.
        """
        own: dict[str, Any] = {
            "T_obj_ee": T_obj_ee,
            "T_world_ee": T_world_ee,
            "trials": trials,
            "fields": {},
        }
        return replace(self, **own, **more)

    def own(self, stages: "tuple[Stage, ...]") -> "list[Stage]":
        """Those of these stages that this work has."""
        return [stage for stage in stages if stage.when is None or stage.when(self)]

    def through(self, stages: "tuple[Stage, ...]") -> "Work":
        """The same work after those of these stages that it has."""
        for stage in self.own(stages):
            stage.run(self)
        return self

    @property
    def resting(self) -> Float32[Tensor, "b 4 4"]:
        """Where the objects rest, m; the identity where a hand is no pose and has no moment."""
        if self.T_world_obj is None:
            from r2h_batch.observe.known import known_moments

            known, poses = known_moments(self.scene), (self.T_obj_ee, self.T_world_ee)
            usable = usable_rows(self.scene, *poses, self.trials)
            active = torch.nonzero(usable["active"])[:, 0]
            if len(active) == len(self.trials):
                self.T_world_obj = known.of(self.trials)
                return self.T_world_obj
            eye = torch.eye(4, dtype=torch.float32, device=active.device)
            self.T_world_obj = eye.repeat(len(self.trials), 1, 1)
            self.T_world_obj[active] = known.of(self.trials[active])
        return self.T_world_obj


class Stage(NamedTuple):
    """A stage, and what else there is to know of it."""

    run: Callable[[Work], None]
    when: Callable[[Work], bool] | None = None
    """whether a work has this stage, by what it is before any stage; None: every one"""
    records: bool = True  # it may be a part of a recorded call (`base.launch.repeated`)
    rests: bool = False  # it reads `Work.resting`, which a recorded call is given
