"""The types that walk through the stages: trials in, predictions beside them, scores out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, NamedTuple, Self, SupportsIndex

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int8, Int32, Int64
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from r2h_batch.base import summary
from r2h_batch.base.soft import in_metres, soft_success
from r2h_batch.base.table import of_lines
from r2h_batch.base.validate import describe_value, instance_of, integer, one_of, sequence_of
from r2h_batch.base.validate_tensors import row_index
from r2h_batch.verdicts import (
    CRITERIA,
    PERSON,
    SIDES,
    SPLITS,
    CollidingPair,
    CriterionEntry,
    MarginKind,
    Nearer,
    Outcome,
    PlanReason,
    criteria_of,
)

__all__ = [
    "CRITERIA",
    "PERSON",
    "SIDES",
    "SPLITS",
    "CollidingPair",
    "MarginKind",
    "Nearer",
    "Outcome",
    "PlanReason",
    "Predictions",
    "ScoreInputs",
    "Scores",
    "Trials",
]


def in_one_copy(tensors: Sequence[Tensor]) -> list[Tensor]:
    """The tensors on the CPU: packed as bytes where they are, copied once, and views of that copy
    here; no gradients."""
    # views need aligned offsets
    by_size = sorted(range(len(tensors)), key=lambda i: -tensors[i].element_size())
    flat = [tensors[i].detach().contiguous().view(-1).view(torch.uint8) for i in by_size]
    parts = torch.cat(flat).cpu().split([len(f) for f in flat])
    copied = [
        p.view(tensors[i].dtype).view(tensors[i].shape) for i, p in zip(by_size, parts, strict=True)
    ]
    return [copied[by_size.index(i)] for i in range(len(tensors))]


@dataclass(frozen=True)
class _Rows:
    """Rows of several tensors with one leading size: ``len``, selection and ``to``."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(
        self, rows: SupportsIndex | slice | Sequence[int] | NDArray[Any] | Tensor
    ) -> Self:
        """The selected rows, always as rows: number 3 is one row, as 3:4; else a slice, indices or
        a mask.

        TypeError for anything else, IndexError for rows that there are not.
        """
        found = row_index(rows, len(self))
        return self._changed(lambda value: value[found])

    def to(self, device: str | torch.device) -> Self:
        """The same rows on another device; from a GPU to the CPU in one copy, for which the host
        waits once."""
        try:
            if not isinstance(device, (str, torch.device)):  # builds for CUDA take any whole number
                raise TypeError
            device = torch.device(device)
        except (RuntimeError, TypeError):
            raise ValueError(
                f"device is {describe_value(device)}; it must be cpu, cuda or cuda:N"
            ) from None
        every: list[Tensor] = []

        def collect(value: Tensor) -> Tensor:
            every.append(value)
            return value

        # in the order in which they are put back; what stands beside the rows goes along
        self._changed(collect)
        devices = {value.device.type for value in every}
        if device.type == "cpu" and devices - {"cpu"}:
            copied = iter(in_one_copy(every))
            return self._changed(lambda value: next(copied))
        return self._changed(lambda value: value.to(device))

    def clone(self) -> Self:
        """The same rows in memory of their own, without history: the caller may write
        there."""
        return self._changed(lambda value: value.detach().clone())

    # What belongs to the rows but is no tensor (names, inputs). Not a field: judging never reads
    # it.
    _context = None

    def _changed(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same with each tensor changed, and the rows of the context with them."""
        new = replace(self, **{name: change(value) for name, value in self._tensors().items()})
        return new._with(self._context, change)

    def _with(self, context: Any, change: Callable[[Tensor], Tensor]) -> Self:
        if context is None:
            return self
        return self._with_context(
            context._changed(change) if isinstance(context, _Rows) else context
        )

    def _with_context(self, context: Any) -> Self:
        object.__setattr__(self, "_context", context)
        return self

    def _tensors(self) -> dict[str, Tensor]:
        values = ((f.name, getattr(self, f.name)) for f in fields(self))
        return {name: value for name, value in values if isinstance(value, Tensor)}


def _alone(value: Any) -> Any:
    """A tensor in memory that holds nothing else; anything else as it is."""
    if isinstance(value, Tensor) and value.nbytes < value.untyped_storage().nbytes():
        return value.clone()
    return value


class _Origin(NamedTuple):
    """Names of objects, and the benchmark, that trials index."""

    objects: tuple[str, ...]
    benchmark: str


@dataclass(frozen=True)
class Trials(_Rows):
    """N trials: which object is handed to which hand, and where that hand stands.

    Attributes:
        trial_id: number of each trial in its benchmark; 2 i in S0, 2 i + 1 in S1.
        object_index: row of `Scene.objects`.
        hand_index: row of the hand set, `Scene.hands`.
        T_world_hand: pose of the hand in the world, m.
        receiver: the receiver's arm and torso where the benchmark gives hands some (the head: `r2h_batch.scene.person.heads_of`):
            rows (x, y, z, w) in the world, m. Shoulder with the upper arm's radius w; elbow with the forearm's; wrist; middle
            of the torso box; its half sizes along its facing, sideways and up. In the last two rows
            w is x and y of the unit vector that the torso faces. Verdicts depend on it with
            `EvalConfig.receiver = "body"` alone.
        person: who the receiver is, where a benchmark has people: columns `PERSON` (years, 0 or 1, m, m, 0 or 1,
            people that were drawn before in vain). Verdicts do not depend on it.
    """

    trial_id: Int64[Tensor, " n"]
    object_index: Int32[Tensor, " n"]
    hand_index: Int32[Tensor, " n"]
    T_world_hand: Float32[Tensor, "n 4 4"]
    receiver: Float32[Tensor, "n 5 4"] | None = None
    person: Float32[Tensor, "n 6"] | None = None

    def named(self, objects: Sequence[Any], *, benchmark: str = "") -> Self:
        """The same trials, which know what their objects are called.

        Args:
            objects: objects or names, as indexed by `object_index`.
            benchmark: whose trials they are (`Benchmark.label`), where they are those of one.

        Raises:
            TypeError: no sequence.
        """
        if isinstance(objects, (str, bytes)) or not isinstance(objects, Sequence):
            raise TypeError(
                f"objects is {describe_value(objects)}; it must be a sequence of objects or names"
            )
        names = tuple(str(getattr(o, "name", o)) for o in objects)
        return replace(self)._with_context(_Origin(names, benchmark))

    @property
    def object_names(self) -> list[str]:
        """(N,) names of the objects; ValueError for trials that were not told (`Benchmark.trials`
        tells them)."""
        if self._context is None:
            raise ValueError(
                "these trials do not know their objects' names; say trials.named(scene.objects)"
            )
        return [self._context.objects[i] for i in self.object_index.tolist()]

    @property
    def benchmark(self) -> str:
        """`NAME@DIGEST` of the benchmark whose objects and hands they index; empty for trials that were
        not told."""
        return "" if self._context is None else str(self._context.benchmark)

    @property
    def splits(self) -> list[str]:
        """(N,) S0 or S1: trial i of S0 has the id 2 i, of S1 the id 2 i + 1."""
        return [SPLITS[i % 2] for i in self.trial_id.tolist()]

    def __repr__(self) -> str:
        counts = ", ".join(f"{n:,} of {s}" for s in SPLITS if (n := self.splits.count(s)))
        kinds = [
            summary.counted(len(x.unique()), w)
            for x, w in ((self.object_index, "object"), (self.hand_index, "hand"))
        ]
        return f"Trials({len(self):,} on {self.trial_id.device}: {counts or 'none'}; {', '.join(kinds)})"

    def _repr_html_(self) -> str:
        names = (
            self.object_names
            if self._context is not None
            else [f"object {i}" for i in self.object_index.tolist()]
        )
        ids, hands = self.trial_id.tolist(), self.hand_index.tolist()
        rows = [(str(t), s, o, str(h)) for t, s, o, h in zip(ids, self.splits, names, hands)]
        more = [("...", "", "", "")] if len(rows) > SHOWN_ROWS else []
        head = ("trial", "split", "object", "hand")
        return of_lines(head, rows[:SHOWN_ROWS] + more, title=repr(self)).html()


SHOWN_ROWS = 10
"""Rows of a table in a notebook."""


@dataclass(frozen=True)
class ScoreInputs(_Rows):
    """The inputs of a call of `Evaluator.score`: B trials, their poses, the evaluator.
    `r2h_batch.show` draws from them."""

    T_obj_ee: Float32[Tensor, "b 4 4"]
    T_world_ee: Float32[Tensor, "b 4 4"]
    trials: Trials
    evaluator: Any

    def _changed(self, change: Callable[[Tensor], Tensor]) -> Self:
        return replace(
            self,
            T_obj_ee=change(self.T_obj_ee),
            T_world_ee=change(self.T_world_ee),
            trials=self.trials._changed(change),
        )


@dataclass(frozen=True)
class Predictions(_Rows):
    """A method's answer for N trials.

    Attributes:
        trial_id: number of each trial.
        T_obj_ee: grasp pose, the gripper in the object's frame, m.
        T_world_ee: handover pose, the gripper in the world, m.
        t_method_s: the method's own time for each trial, s; NaN: not measured.
        method: name in tables.
    """

    trial_id: Int64[Tensor, " n"]
    T_obj_ee: Float32[Tensor, "n 4 4"]
    T_world_ee: Float32[Tensor, "n 4 4"]
    t_method_s: Float32[Tensor, " n"] | None = None
    method: str = "unnamed"


@dataclass(frozen=True)
class Scores(_Rows):
    """Verdicts of B trials. Columns of (B, C) follow `criteria`.

    Attributes:
        trial_id: number of each trial.
        outcome: `Outcome`: success, or the first failure.
        success: whether all criteria pass.
        passed: whether each criterion passes.
        evaluated: whether each criterion was evaluated.
        margin: in the criterion's unit (m), positive when the criterion passes; NaN where it was not evaluated.
        margin_kind: `MarginKind`. DISTANCE: a length, to 0.1 mm. BOUND: bodies overlap, and the
            margin is minus a lower bound of their penetration depth, the shortest translation that
            parts them. CAP: the clearance is this or more (5 cm; Stability 1 cm), or there is
            nothing to measure (-inf; nothing between the pads).
        borderline: an evaluated margin is nearer to 0 than 0.1 mm (0.05 deg), where float32 does not decide it.
        plan_reason: `PlanReason`: OK, or why there is no path.
        plan_pair: `CollidingPair`: what collides at start or goal; with a path its nearest pair.
        witness_part: robot part (`Scene.part_names`) of Plan's and of Safe's smallest clearance.
        witness_time_s: time of Safe's smallest clearance, s.
        witness_point: point of Safe's smallest clearance in the world, m.
        t_plan_s: planning, amortised over the batch, s.
        t_exec_s: time until the arm stays at its goal, s.
        q_goal: joint angles at the goal, rad.
        width_m: extent along y of the material between the pads, m.
        opening_m: gap between the closed pads, m.
        grasp_shift_m: how far closing moves the object along y, m.
        slip_m: slip of the object in the shake, m; NaN unless `stability = "physics"` shook it.
        presented_margin_m: margin of Presented, m, also where the benchmark does not ask for it; NaN in rows that were not
            judged.
        presented_by: `Nearer`: what that margin is about; -1 in these rows.
        tilt_deg: angle between a vessel's opening and the world's up; NaN of other objects.
        path: waypoints, rad; the first `path_len` count.
        path_time_s: times of the waypoints, s.
        path_len: number of waypoints; 0: no path.
        motion: executed joint angles, rad, every `ExecConfig.step_s * record_steps`: of trials whose
            simulation failed, up to the failure; with `score(keep_motion=True)` of all that moved.
        motion_len: number of rows of `motion` that count.
        failed_state: qpos and qvel of the simulator when it failed; width 0 where none did, NaN in
            the other rows.
        body_m: distance of the robot to the receiver's arm, torso and head, m, exact below 5 cm; negative:
            a bound of their overlap; NaN without these or a motion. Verdicts depend on it with
            `EvalConfig.receiver = "body"` alone.
    """

    trial_id: Int64[Tensor, " b"]
    outcome: Int8[Tensor, " b"]
    success: Bool[Tensor, " b"]
    passed: Bool[Tensor, "b c"]
    evaluated: Bool[Tensor, "b c"]
    margin: Float32[Tensor, "b c"]
    margin_kind: Int8[Tensor, "b c"]
    borderline: Bool[Tensor, " b"]
    plan_reason: Int8[Tensor, " b"]
    plan_pair: Int8[Tensor, " b"]
    witness_part: Int32[Tensor, "b 2"]
    witness_time_s: Float32[Tensor, " b"]
    witness_point: Float32[Tensor, "b 3"]
    t_plan_s: Float32[Tensor, " b"]
    t_exec_s: Float32[Tensor, " b"]
    q_goal: Float32[Tensor, "b 6"]
    width_m: Float32[Tensor, " b"]
    opening_m: Float32[Tensor, " b"]
    grasp_shift_m: Float32[Tensor, " b"]
    slip_m: Float32[Tensor, " b"]
    presented_margin_m: Float32[Tensor, " b"]
    presented_by: Int8[Tensor, " b"]
    tilt_deg: Float32[Tensor, " b"]
    path: Float32[Tensor, "b w 6"]
    path_time_s: Float32[Tensor, "b w"]
    path_len: Int32[Tensor, " b"]
    motion: Float32[Tensor, "b s 6"]
    motion_len: Int32[Tensor, " b"]
    failed_state: Float64[Tensor, "b s"]
    body_m: Float32[Tensor, " b"]

    own_asks: ClassVar[tuple[str, ...]] = ()
    """Criteria that a benchmark asks for, and that have fields of their own here."""

    @property
    def entries(self) -> tuple[CriterionEntry, ...]:
        """The criteria of the columns: those of `CRITERIA`, and what the benchmark asks for beside them."""
        asks = self.own_asks
        if self.passed.shape[-1] > len(CRITERIA) + len(asks):  # it has no fields that others lack
            asks = (*asks, "presented")
        return criteria_of(asks)

    @property
    def criteria(self) -> tuple[str, ...]:
        """Names of the columns: `CRITERIA`, and what the benchmark asks for beside them."""
        return tuple(entry.name for entry in self.entries)

    @property
    def presented(self) -> Bool[Tensor, "*b"]:
        """Rows whose wanted part comes to the hand first (`presented_margin_m`), whether or not the benchmark asks for it."""
        return self.presented_margin_m >= 0

    def failed(self, criterion: str) -> Bool[Tensor, " b"]:
        """Rows (B,) whose first failure is a criterion.

        Args:
            criterion: one of `criteria`, such as `plan`.

        Raises:
            ValueError: no criterion has this name.
        """
        one_of(*self.criteria)("criterion", criterion)
        return self.outcome == int(Outcome[criterion.upper()])

    def by_trial(self, k: int) -> Self:
        """The same rows as views (N, k, ...).

        Args:
            k: candidates of each trial, as they were scored.

        Raises:
            ValueError: k does not divide the number of rows.
        """
        k = k if torch.compiler.is_compiling() else integer(1)("k", k)
        if len(self) % k:
            raise ValueError(
                f"k is {k}; {len(self)} rows can only be split by a divisor of their number"
            )
        return replace(
            self,
            **{name: x.unflatten(0, (len(self) // k, k)) for name, x in self._tensors().items()},
        )

    def soft(self, *, temperature_m: float, log: bool = False) -> Float32[Tensor, " b"]:
        """Smooth success (B,) in (0, 1), above 0.5 exactly where `success` (r2h_batch.base.soft).

        Differentiable where `margin` is: scored with stages="pose" from poses that require a
        gradient.

        Args:
            temperature_m: margins of this size, m, move it noticeably.
            log: return its logarithm, which stays linear far from success.
        """
        return soft_success(
            in_metres(self.margin),
            self.evaluated,
            self.success,
            temperature_m=temperature_m,
            log=log,
        )

    @property
    def inputs(self) -> ScoreInputs | None:
        """The inputs of the call that returned these scores.

        None for captured and compiled calls, and for rows of two calls.
        """
        return self._context

    def with_inputs(self, inputs: ScoreInputs) -> Self:
        """The same scores, with the inputs of their call.

        Args:
            inputs: poses, trials and the evaluator that judged them.
        """
        instance_of(ScoreInputs)("inputs", inputs)
        same = object.__new__(type(self))
        same.__dict__.update(self.__dict__)
        return same._with_context(inputs)

    def __getstate__(self) -> dict[str, Any]:
        """State of copies and pickles: the numbers, not the evaluator, nor the memory beside a
        field (fields of a call lie side by side)."""
        return {k: _alone(v) for k, v in self.__dict__.items() if k != "_context"}

    def __repr__(self) -> str:
        return summary.scores_line(
            self.outcome.shape, str(self.outcome.device), self._array("outcome")
        )

    def _repr_html_(self) -> str:
        head = ("criterion", "evaluated", "pass", "median margin, mm", "5 % margin, mm")
        return of_lines(head, self._table(), title=repr(self)).html()

    def summary(self) -> str:
        """A few lines: outcomes, and each criterion with its pass rate and margins."""
        lines = [repr(self), f"{'':12}{'evaluated':>10}{'pass':>9}{'median mm':>11}{'5 % mm':>9}"]
        lines += [
            f"{name:12}{n:>10}{rate:>9}{middle:>11}{low:>9}"
            for name, n, rate, middle, low in self._table()
        ]
        return "\n".join(lines)

    def scalars(self) -> dict[str, float]:
        """Plain numbers for any logger: rates of outcomes and criteria, mean margins (m, without
        those that are caps) and times (s); none is NaN."""
        passed, evaluated, margin, kind, outcome = (
            self._array(k) for k in ("passed", "evaluated", "margin", "margin_kind", "outcome")
        )
        times = {name: self._array(name) for name in ("t_plan_s", "t_exec_s")}
        return summary.scalars_of(self.entries, passed, evaluated, margin, kind, outcome, times)

    def to_pandas(self) -> Any:
        """A pandas DataFrame, a row for each of B (or N x K) rows: the columns of a run folder's
        trials (extra `pandas`), with split, object and side where `inputs` are known."""
        flat = (
            self
            if self.outcome.ndim == 1
            else replace(self, **{k: x.flatten(0, 1) for k, x in self._tensors().items()})
        )
        columns = summary.score_columns(self.entries, flat._array)
        return summary.frame_of({**(flat._names() or {}), **columns})

    def _names(self) -> dict[str, Any] | None:
        """Columns split, object and side of each row; None where the trials are not known."""
        if self.inputs is None or len(self.inputs.trials) != len(self.outcome):
            return None
        trials, hands = self.inputs.trials, self.inputs.evaluator.scene.hands.set
        objects = [o.name for o in self.inputs.evaluator.scene.objects]
        side = hands.side.cpu()[trials.hand_index.cpu().long()]
        return {
            "split": trials.splits,
            "object": [objects[i] for i in trials.object_index.tolist()],
            "side": [SIDES[i] for i in side.tolist()],
        }

    def _table(self) -> list[tuple[str, str, str, str, str]]:
        arrays = (self._array(name) for name in ("passed", "evaluated", "margin"))
        return summary.scores_table(self.entries, *arrays)

    def _array(self, name: str) -> NDArray[Any]:
        return np.asarray(getattr(self, name).detach().cpu())

    @staticmethod
    def concatenate(parts: list["Scores"]) -> "Scores":
        """One `Scores` with the rows of all parts, in order.

        Args:
            parts: one or more, of one device.
        """
        sequence_of(Scores, "what Evaluator.score returns")("parts", parts)
        longest = max(p.motion.shape[1] for p in parts)
        states = max(p.failed_state.shape[1] for p in parts)
        parts = [
            replace(
                p,
                motion=pad(p.motion, (0, 0, 0, longest - p.motion.shape[1])),
                failed_state=pad(
                    p.failed_state, (0, states - p.failed_state.shape[1]), value=torch.nan
                ),
            )
            for p in parts
        ]
        kind = type(parts[0])
        return kind(
            **{f.name: torch.cat([getattr(p, f.name) for p in parts]) for f in fields(kind)}
        )


@dataclass(frozen=True, repr=False)
class PickedScores(Scores):
    """Verdicts of a benchmark that asks for Pick.

    Attributes:
        pick: `PickReason`, the `CollidingPair` that Pick's margin is about, and the robot part of it (-1: none).
    """

    pick: Int32[Tensor, "b 3"]

    own_asks: ClassVar[tuple[str, ...]] = ("pick",)


@dataclass(frozen=True, repr=False)
class GivenScores(PickedScores):
    """Verdicts of a benchmark that asks for Received too.

    Attributes:
        receives: `ReceiveReason`, how many receiving grasps pass every step, and the `Room` that the margin is of; -1: not
            judged, or (the room) not received.
    """

    receives: Int32[Tensor, "b 3"]

    own_asks: ClassVar[tuple[str, ...]] = ("pick", "received")
