"""The criteria of the paper (Sec. Evaluation Metrics): one function per equation, each a signed
margin.

A criterion is an entry of `verdicts.EVERY`, which says what it is called, the margin's unit, which objects it concerns, and
where its function is: here, or in another package. `judge` calls the functions in the order of the entries.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING

import torch
import warp as wp
from jaxtyping import Bool, Float32, Float64, Int8, Int32, Int64
from torch import Tensor

from r2h_batch.base.validate import one_of
from r2h_batch.config import CLEARANCE_CAP_M, EvalConfig
from r2h_batch.judge import at_handover
from r2h_batch.judge.attach import AttachedBatch
from r2h_batch.judge.distance import NearestApproach
from r2h_batch.judge.foreign import ask
from r2h_batch.judge.grasp import CUT_CAP_M, region_distance
from r2h_batch.judge.presented import Presented
from r2h_batch.judge.reach import Reached
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.person import eyes_of, heads_of
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials
from r2h_batch.verdicts import (
    CriterionEntry,
    MarginKind,
    PickReason,
    PlanReason,
    criteria_of,
)

if TYPE_CHECKING:
    from r2h_batch.judge.pick import Picked


@dataclass(frozen=True)
class Criterion:
    """One criterion of B handovers, as `judge.scores.verdict` reads it. Where it was not evaluated
    everything else means nothing.

    It passes at a margin above 0, and at 0 where the registry says that touching passes. A number
    that is NaN fails: NaN is neither above 0 nor equal to it; with a criterion that the registry has
    in some splits only, it says that the row is not evaluated.
    """

    number: Float32[Tensor, " b"]  # in the registry's unit, m or deg; so are limit and cap
    evaluated: Bool[Tensor, " b"]
    limit: float = 0.0  # the margin is the number less this,
    below: bool = False  # or, where the number has to stay below it, this less the number
    cap: float = 0.0  # the number is a clearance that counts up to here; 0: it is a length
    passed: Bool[Tensor, " b"] | None = None  # None: the margin says it
    # MarginKind, or a code that `kind_of` gives one to; NONE, or None: number and cap say it
    kind: Int8[Tensor, " b"] | Int32[Tensor, " b"] | None = None
    kind_of: tuple[int, ...] = ()

    @property
    def margin(self) -> Float32[Tensor, " b"]:
        """(B,) in the criterion's unit."""
        return self.limit - self.number if self.below else self.number - self.limit


@lru_cache(maxsize=256)
def constants(device: torch.device, dtype: torch.dtype, *values: float) -> Tensor:
    """These numbers (n,), filled in on the device: a GPU would wait for a copy from the host. Each
    is made once: a small call is all overhead."""
    out = torch.empty(len(values), dtype=dtype, device=device)
    for i, value in enumerate(values):
        out[i].fill_(value)
    return out


@dataclass(frozen=True)
class Evidence:
    """Results of the stages for B handovers: all that a criterion may use."""

    scene: Scene
    config: EvalConfig
    held: AttachedBatch  # poses, the grasp, where bodies are
    # the arm came to rest at the end of a path; None: free postures are those of clearance above 0
    goal_reached: Bool[Tensor, " b"] | None
    moves: Bool[Tensor, " b"]  # active, and with a motion; in stages="pose": active
    clearance_m: Float32[Tensor, " b"]  # of the path; without one, or without motion, of a posture
    reason: Int32[Tensor, " b"]  # PlanReason
    nearest: NearestApproach  # of the robot to the receiver
    slip_m: Float64[Tensor, " b"] | None  # in the shake, NaN where it failed; None: not shaken
    reached: Reached  # where what Reach measures of the object is nearest to the ball's middle
    presented: Presented  # what comes to the hand first
    trials: Trials
    picked: "Picked | None" = None  # None: the benchmark does not ask for Pick

    @property
    def trial_id(self) -> Int64[Tensor, " b"]:
        """(B,) numbers of the trials."""
        return self.trials.trial_id

    @property
    def T_world_obj(self) -> Float32[Tensor, "b 4 4"]:
        """(B, 4, 4) where the objects are once the pads have closed, m; the identity in rows that are not judged."""
        return at_handover.T_world_obj(self.held)

    @property
    def palm(self) -> at_handover.Palm:
        """The receivers' palms in the world: point p_h, normal n_h and middle of the ball c_h, (B, 3) each."""
        return at_handover.Palm(*self.scene.palm(self.trials.hand_index, self.trials.T_world_hand))

    @property
    def receiver(self) -> Float32[Tensor, "b 5 4"]:
        """(B, 5, 4) arm and torso, as `Trials.receiver` has them.

        Raises:
            ValueError: these receivers have no body.
        """
        if self.trials.receiver is None:
            raise ValueError(
                f"receivers of {self.scene.benchmark.name} have no body; take a benchmark of people, such as r2h-v2"
            )
        return self.trials.receiver

    @property
    def head(self) -> Float32[Tensor, "b 2 4"]:
        """(B, 2, 4) the receivers' heads, capsules: lower and upper end, each with the radius; world, m."""
        return heads_of(self.receiver)

    @property
    def eyes(self) -> Float64[Tensor, "b 2 3"]:
        """(B, 2, 3) left and right eye, world, m."""
        return eyes_of(self.receiver)

    @property
    def up(self) -> Float32[Tensor, "b 3"]:
        """(B, 3) unit vectors towards vessels' openings in the world; NaN where the object is no open vessel."""
        local = wp.to_torch(self.scene.openings)[self.held.objects.long()]
        local = torch.where((local == 0).all(1, keepdim=True), torch.nan, local)
        return (self.T_world_obj[:, :3, :3] @ local[:, :, None])[:, :, 0]

    def points(
        self, role: at_handover.Role
    ) -> tuple[Float32[Tensor, "b p 3"], Bool[Tensor, "b p"]]:
        """Points on the objects' surfaces in the world, m, and which of them are of a part.

        Args:
            role: `object`, `wanted` (S1: the receiver's region, S0: the object) or `sharp`.

        Returns:
            (B, P, 3) and (B, P).
        """
        return at_handover.points(self.scene, self.held, role)

    def distance(self, point: Float32[Tensor, "b 3"], to: str) -> Float32[Tensor, " b"]:
        """How far points are from something, m.

        Args:
            point: (B, 3) in the world, m: one for each row.
            to: `gripper`, `object`, `wanted`, `sharp` or `head`.

        Returns:
            (B,) 0 inside of gripper or object, negative inside of the head, inf where there is no such part.

        Raises:
            TypeError, ValueError: `point` or `to` is something else.
        """
        one_of(*at_handover.MEASURED, "head")("to", to)
        point = at_handover.checked_points(point, len(self.held.active))
        if to == "head":
            return at_handover.head_distance(self.head, point)
        return at_handover.distance(self.scene, self.held, point, to)


def judge(evidence: Evidence) -> list[Criterion]:
    """The benchmark's criteria, in the order of their columns; evaluated where they concern the object."""
    return [_criterion(entry, evidence) for entry in criteria_of(evidence.scene.benchmark.asks)]


def _criterion(entry: CriterionEntry, e: Evidence) -> Criterion:
    if entry.function:
        found = ask(entry, lambda: _function(entry), e, e.held.active, Criterion)
    else:
        found = _function(entry)(e)
    if entry.applies is None:
        return found
    concerned = _concerned(entry, e.scene.objects, found.evaluated.device)
    return replace(found, evaluated=found.evaluated & concerned[e.held.objects.long()])


@lru_cache(maxsize=64)
def _function(entry: CriterionEntry) -> Callable[[Evidence], Criterion]:
    module, name = entry.equation
    found: Callable[[Evidence], Criterion] = getattr(import_module(module), name)
    return found


@lru_cache(maxsize=64)
def _concerned(
    entry: CriterionEntry, objects: tuple[ObjectModel, ...], device: torch.device
) -> Bool[Tensor, " o"]:
    """Which objects a criterion concerns; asked once, for a GPU would wait for a copy from the host."""
    return torch.tensor([entry.concerns(o) for o in objects], dtype=torch.bool, device=device)


def stability(e: Evidence) -> Criterion:
    """Stability(g) <=> w_O(g) <= w_max, and something is held that the open gripper does not cut
    into.

    Margin: the smallest of w_max - w, w - w_min and the clearance of the open gripper from the
    object, which counts 1 cm at most. With `stability="physics"` also 2 cm - slip: the friction
    grasp has to hold the object through its weight and a shake along three axes.
    """
    number, kind = e.held.grasp.margin_m, e.held.margin_kind
    if e.slip_m is not None:
        from r2h_batch.judge.grasp_physics import DROPPED_M  # with MuJoCo, which has run then

        left = torch.where(e.slip_m.isnan(), -torch.inf, DROPPED_M - e.slip_m).float()
        # only grasps that pass geometrically were shaken
        slips = (number >= 0) & (left < number)
        lost = torch.where(left.isinf(), int(MarginKind.CAP), int(MarginKind.DISTANCE))
        kind = torch.where(slips, lost.to(torch.int8), kind)
        number = torch.where(slips, left, number)
    return Criterion(number, e.held.active, cap=CUT_CAP_M, kind=kind)


def plan(e: Evidence) -> Criterion:
    """Plan(g, h) <=> h in S_plan(g). Margin: the smallest clearance along the path.

    Without a path: minus what the start, or the best branch, lacks to be free, or the target to be
    reached (`judge.goal.Goal.clearance_m`). -inf where a search found nothing, or where the arm did
    not come to rest at its goal: no length says by how much. A path that was found passes, also
    where its clearance was only sampled. Where the object has to be picked first and is not, nothing is planned.
    """
    judged = e.held.active
    if e.picked is not None and e.goal_reached is not None:  # a posture is judged all the same
        judged = judged & (e.reason != int(PlanReason.NOT_EVALUATED))
    return Criterion(
        e.clearance_m,
        judged,
        cap=CLEARANCE_CAP_M,
        passed=e.goal_reached,
        kind=e.reason,
        kind_of=KIND_OF_REASON,
    )


_NO_CLEARANCE = {
    PlanReason.IK_UNREACHABLE: MarginKind.DISTANCE,  # by how far
    PlanReason.IK_NOT_FOUND: MarginKind.CAP,  # by no more than the best try
}
KIND_OF_REASON = tuple(int(_NO_CLEARANCE.get(r, MarginKind.NONE)) for r in PlanReason)
"""MarginKind of Plan's margin, by `PlanReason`; NONE: it is a clearance."""


def reach(e: Evidence) -> Criterion:
    """Reach(g, h) <=> V_O(g, h) meets the ball B_h. Margin: r_h - dist(c_h, solid of the object,
    or its convex hull with `reach="hull"`).

    The surface's tables stand in the object's frame: the ball is moved there, not the object.
    """
    radius = e.config.thresholds.reach_radius_m
    return Criterion(e.reached.distance_m, e.held.active, limit=radius, below=True)


def affordance(e: Evidence) -> Criterion:
    """Affordance(g) <=> V_grip(g) does not meet G_O^H(g). Margin: the distance of the fingers from
    the receiver's region. S1 only.

    The region moves with the object, which closing has shifted (`attached`). The fingers are
    `squeezed`: those that hold the region itself overlap it by more than rounding.
    """
    held = e.held
    distance, _ = region_distance(
        e.scene.grasp_tables,
        held.attached,
        held.objects,
        held.squeezed_m,
        cap_m=CLEARANCE_CAP_M,
    )
    return Criterion(distance, held.active, cap=CLEARANCE_CAP_M)


def safe(e: Evidence) -> Criterion:
    """Safe(g, h) <=> M_hand does not meet M_robot(g, h) over the motion. Margin: the smallest
    distance over time, less `safe_margin_m`.

    With `receiver="body"` arm, torso and head of the receiver count as the hand does.
    """
    far = None
    if not e.nearest.exact:  # the slack of a motion is taken off a cap too
        far = (e.nearest.body < 0).to(torch.int8) * int(MarginKind.CAP)
    return Criterion(
        e.nearest.distance_m,
        e.moves,
        limit=e.config.thresholds.safe_margin_m,
        cap=CLEARANCE_CAP_M,
        kind=far,
    )


def pick(e: Evidence) -> Criterion:
    """Pick(g) <=> the arm takes the object from where it rests with this grasp: `judge.pick`. Margin: of the first stage that
    fails, else the smallest of all stages, 1 cm at most.
    """
    assert e.picked is not None  # the evaluator asks for it where the benchmark does
    return Criterion(
        e.picked.margin_m,
        e.held.active,
        cap=CUT_CAP_M,
        passed=e.picked.picked,
        kind=e.picked.reason,
        kind_of=KIND_OF_PICK,
    )


def presented(e: Evidence) -> Criterion:
    """Presented(g, h) <=> the wanted part meets the ball B_h, and neither the gripper nor a sharp part is nearer to the palm
    than it by more than t: `judge.presented`. Margin: min(r_h - dist(c_h, wanted), t + min(dist(p_h, gripper), dist(p_h,
    sharp)) - dist(p_h, wanted)).
    """
    return Criterion(e.presented.margin_m, e.held.active)


def received(e: Evidence) -> Criterion:
    """Received(g, h) <=> some receiving grasp of this person passes every step (`judge.reception`). Margin: no length says it, so
    it is the room between hand and gripper that reception keeps (a cap), or -inf.

    Judged once all before it have passed (`received.given`): by nothing here.
    """
    return Criterion(*_not_judged(len(e.held.active), e.held.active.device))


@lru_cache(maxsize=16)
def _not_judged(b: int, device: torch.device) -> tuple[Float32[Tensor, " b"], Bool[Tensor, " b"]]:
    """Number and `evaluated` of rows that are judged by nothing here. Nobody writes to them."""
    number = torch.full((b,), torch.nan, dtype=torch.float32, device=device)
    return number, torch.zeros(b, dtype=torch.bool, device=device)


_NO_PICK = {
    PickReason.OUT_OF_REACH: MarginKind.DISTANCE,  # by how far
    PickReason.NO_STRAIGHT_WAY: MarginKind.DISTANCE,  # how much of the ways no branch follows
    PickReason.NOTHING_BETWEEN_PADS: MarginKind.CAP,
    PickReason.NOT_HELD: MarginKind.DISTANCE,  # too thick or too thin by
}
KIND_OF_PICK = tuple(int(_NO_PICK.get(r, MarginKind.NONE)) for r in PickReason)
"""MarginKind of Pick's margin, by `PickReason`; NONE: it is a clearance."""
