"""Pick: can the arm take the object from where it rests? From home to 10 cm before the grasp, straight in with the open
gripper, close, and 10 cm straight up. Geometric and certified, as Plan is; a criterion where a benchmark asks for it."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.base.io.progress import busy, progress
from r2h_batch.base.launch import over_trials
from r2h_batch.base.launch.threads import one_torch_thread
from r2h_batch.config import FARTHEST_M
from r2h_batch.judge.attach import ROWS_CHUNK, usable_rows
from r2h_batch.judge.fingers_way import fingers_way, heights
from r2h_batch.judge.goal import measured
from r2h_batch.judge.grasp import (
    CUT_CAP_M,
    Grasp,
    attach,
    close_gripper,
    way_in_clearance,
)
from r2h_batch.judge.ik import IkResult, home_posture, solve_ik
from r2h_batch.judge.inputs import check_benchmark, check_indices, check_receiver, checked_inputs
from r2h_batch.judge.least import SHARE, TOLERANCE_M, least_along
from r2h_batch.judge.plan import Plan, path_clearances, plan_paths, random_key
from r2h_batch.judge.straight_way import STEPS, WAY_M, Ways, resampled, straight_ways
from r2h_batch.kernels.judge import pick as kernels
from r2h_batch.kernels.plan.codes import BRANCHES, WAYPOINTS
from r2h_batch.scene.person import with_person
from r2h_batch.scene.resting import among, with_resting, without
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.types import CollidingPair, PlanReason, Trials
from r2h_batch.verdicts import PickReason

FAR_FROM_M = 0.002
"""A path that the planner measured this much farther from everything than the cap is not measured again: it is exact
to a tenth."""
ROWS = 512
"""Rows that are judged at a time."""


@dataclass(frozen=True)
class Picked:
    """Whether B objects can be picked from where they rest.

    Attributes:
        picked: no stage fails.
        reason: PickReason: the first stage that fails, in the order of the enum.
        margin_m: what that stage fails by, below 0; else the smallest clearance and margin of all stages, at most 1 cm.
            -inf: no path was found, which no length says.
        pair: CollidingPair that the margin is about; NONE where no two bodies decide (reach, what lies between the pads).
        body: robot body of that pair (`Scene.part_names`); -1: none.
        off_m: how far the gripper leaves the straight ways between their waypoints at most; NaN without a way.
        T_world_ee: the grasp where the object rests, m.
        path: from home to 10 cm before the grasp, rad; meaningless beyond `length`.
        length: waypoints of it; 0: none.
        way_in: from there to the grasp, rad; NaN without one.
        way_up: from 10 cm above down to the grasp, rad; NaN without one.
    """

    picked: Bool[Tensor, " b"]
    reason: Int32[Tensor, " b"]
    margin_m: Float32[Tensor, " b"]
    pair: Int32[Tensor, " b"]
    body: Int32[Tensor, " b"]
    off_m: Float32[Tensor, " b"]
    T_world_ee: Float32[Tensor, "b 4 4"]
    path: Float32[Tensor, "b w j"]
    length: Int32[Tensor, " b"]
    way_in: Float32[Tensor, "b k j"]
    way_up: Float32[Tensor, "b k j"]

    def __getitem__(self, rows: Any) -> "Picked":
        return Picked(*(getattr(self, f.name)[rows] for f in fields(Picked)))

    @property
    def column(self) -> Int32[Tensor, "b 3"]:
        """Reason, pair and body side by side, as `Scores.pick` has them."""
        run = over_trials(
            kernels.pick_columns, len(self.reason), str(self.reason.device), sizes={"pick": 3}, chunk=ROWS_CHUNK
        )  # fmt: skip
        column: Tensor = run(reason=self.reason, nearest=self.pair, part=self.body)["pick"]
        return column

    @property
    def lifted(self) -> Float32[Tensor, "b j"]:
        """The posture at the end of the lift, rad, of the branch that passed; NaN without one. Carrying begins there."""
        return self.way_up[:, 0]


def picked(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    T_world_obj: Float32[Tensor, "b 4 4"],
    trials: Trials,
) -> Picked:
    """Whether the arm can pick each trial's object where it rests, why not, and by how much (docs/r2h_v3.md).

    A row does not depend on the others. The trial's handover pose plays no part: the person waits where the trial says.

    Args:
        scene: robot, objects, hands and table (`Evaluator.scene`).
        T_obj_ee: (B, 4, 4) grasps, the ee in the object's frame, m.
        T_world_obj: (B, 4, 4) where the objects rest on the table (`observe.moments`), m.
        trials: B trials.

    Raises:
        TypeError, ValueError: shape, dtype or device do not fit; before any work.
    """
    check_benchmark(scene.benchmark, trials)
    T_obj_ee, T_world_obj, trials = checked_inputs(
        scene, T_obj_ee, T_world_obj, trials, "pose", second="T_world_obj"
    )
    check_receiver(scene.config, trials)
    check_indices(scene, trials)
    one_thread = one_torch_thread(torch.device(scene.device))
    with one_thread, busy("picks"), progress("picked", len(trials), "trials") as told:
        return judge_picks(scene, T_obj_ee, T_world_obj, trials, told=told)


def judge_picks(
    scene: Scene, T_obj_ee: Tensor, T_world_obj: Tensor, trials: Trials, *,
    ways: bool = True, told: Callable[[int], None] = lambda rows: None,
) -> Picked:  # fmt: skip
    """`picked` of checked inputs.

    Args:
        scene: as of `picked`.
        T_obj_ee: (B, 4, 4) grasps, m.
        T_world_obj: (B, 4, 4) where the objects rest, m.
        trials: B trials.
        ways: also judge the ways to the grasp and up from it; else Pick is what it asks at the grasp: the first two stages.
        told: is called with the number of rows of each batch that is done.
    """
    parts = []
    for i in range(0, max(len(trials), 1), ROWS):
        grasp, rest = (x[i : i + ROWS].detach() for x in (T_obj_ee, T_world_obj))
        own = trials if len(grasp) == len(trials) else trials[i : i + ROWS]
        parts.append(_Batch.of(scene, grasp, rest, own).judged(ways))
        told(len(grasp))
    if len(parts) == 1:
        return parts[0]
    return Picked(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Picked)))


def follow_picks(
    scene: Scene, T_obj_ee: Tensor, T_world_obj: Tensor, trials: Trials, planned: Picked
) -> Picked:
    """Picks that were planned in a world that somebody believed in, judged in this one as the arm makes them.

    A row that was not picked there stays as it is: the arm does not move.

    Args:
        scene: the true one.
        T_obj_ee: (B, 4, 4) the grasps in the true objects' frames, m.
        T_world_obj: (B, 4, 4) where the true objects rest, m.
        trials: the true B trials.
        planned: what was planned.
    """
    parts = []
    for i in range(0, max(len(trials), 1), ROWS):
        own = slice(i, i + ROWS)
        batch = _Batch.of(scene, T_obj_ee[own], T_world_obj[own], trials[own])
        parts.append(batch.followed(planned[own]))
    return Picked(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Picked)))


class _Nearest(NamedTuple):
    """Smallest clearances, and which bodies have them: CollidingPair, robot body."""

    clearance_m: Tensor
    pair: Tensor
    body: Tensor

    def nearer(self, other: "_Nearest") -> "_Nearest":
        """Row by row the one with the smaller clearance."""
        less = other.clearance_m < self.clearance_m
        return _Nearest(*(torch.where(less, y, x) for x, y in zip(self, other, strict=True)))

    def at(self, slot: Tensor) -> "_Nearest":
        """Those at (B,) `slot` among (B, 8) branches."""
        return _Nearest(*(x.gather(1, slot[:, None])[:, 0] for x in self))

    def put(self, where: tuple[Tensor, ...], other: "_Nearest") -> None:
        """Writes `other` there."""
        for x, y in zip(self, other, strict=True):
            x[where] = y

    def of(self, pair: CollidingPair) -> "_Nearest":
        """The same, named `pair`."""
        return self._replace(pair=torch.full_like(self.pair, int(pair)))


def _margin(clearance_m: Tensor) -> _Nearest:
    """A margin that is about no two bodies."""
    none = torch.zeros(clearance_m.shape, dtype=torch.int32, device=clearance_m.device)
    return _Nearest(clearance_m, none, none - 1)


@dataclass(frozen=True, eq=False)
class _Tried:
    """Branches of some rows as far as they are known, and the path that leads to one of them."""

    whole: Tensor  # (B, 8) the branch follows both ways
    followed: Tensor  # (B,) most waypoints that a branch follows at the closest spacing
    way_in: Tensor  # (B, 8, W, J)
    way_up: Tensor
    off_m: Tensor  # (B, 8)
    approach: _Nearest  # (B, 8), -inf: not walked
    lift: _Nearest
    reason: Tensor  # (B,) PlanReason of the path from home
    path: Tensor  # (B, W, J)
    length: Tensor  # (B,)
    way: _Nearest  # (B,) along the path, or where it fails
    slot: Tensor  # (B,) the branch that passes all, -1: none so far

    @staticmethod
    def none(b: int, joints: int, device: torch.device) -> "_Tried":
        """Nothing is known."""
        branches, postures = (b, int(BRANCHES)), STEPS[-1] + 1

        def full(shape: tuple[int, ...], value: float) -> Tensor:
            return torch.full(shape, value, dtype=torch.float32, device=device)

        def whole(shape: tuple[int, ...], value: int) -> Tensor:
            return torch.full(shape, value, dtype=torch.int32, device=device)

        return _Tried(
            whole=torch.zeros(branches, dtype=torch.bool, device=device),
            followed=whole((b,), 0),
            way_in=full((*branches, postures, joints), torch.nan),
            way_up=full((*branches, postures, joints), torch.nan),
            off_m=full(branches, torch.nan),
            approach=_margin(full(branches, -torch.inf)),
            lift=_margin(full(branches, -torch.inf)),
            reason=whole((b,), int(PlanReason.NOT_EVALUATED)),
            path=full((b, int(WAYPOINTS), joints), 0.0),
            length=whole((b,), 0),
            way=_margin(full((b,), -torch.inf)),
            slot=whole((b,), -1),
        )

    def found(self) -> _Nearest:
        """(B,) The nearest along both ways of the branch that passes and along the path to it."""
        slot = self.slot.clamp(min=0).long()
        nearest = self.approach.at(slot).nearer(self.lift.at(slot)).nearer(self.way)
        cap = _margin(torch.full_like(nearest.clearance_m, CUT_CAP_M))
        passes = self.slot >= 0
        return _Nearest(*(torch.where(passes, x, y) for x, y in zip(nearest, cap, strict=True)))


@dataclass(frozen=True, eq=False)
class _Batch:
    """Some rows, and what every stage reads of them."""

    scene: Scene
    trials: Trials
    active: Tensor
    objects: Tensor
    hands: Tensor
    T_obj_ee: Tensor
    T_world_obj: Tensor
    T_world_ee: Tensor
    T_world_hand: Tensor
    open_m: Tensor  # the gap of the open gripper

    @staticmethod
    def of(scene: Scene, T_obj_ee: Tensor, T_world_obj: Tensor, trials: Trials) -> "_Batch":
        """Rows whose poses are poses are active."""
        usable = usable_rows(scene, T_obj_ee, T_world_obj, trials)
        T_obj_ee, T_world_obj = usable["T_obj_ee"], usable["T_world_ee"]
        placed = over_trials(kernels.place_grasps, len(trials), scene.device, chunk=ROWS_CHUNK)(
            open_gap=scene.robot.open_gap_m, T_world_obj=T_world_obj, T_obj_ee=T_obj_ee
        )
        return _Batch(
            scene, trials, usable["active"], usable["object"], usable["hand"], T_obj_ee, T_world_obj,
            placed["T_world_ee"], usable["T_world_hand"], placed["opening"],
        )  # fmt: skip

    def some(self, rows: Tensor) -> "_Batch":
        """These rows alone."""
        every = {f.name: getattr(self, f.name)[rows] for f in fields(_Batch)[1:]}
        return replace(self, **every)

    def judged(self, ways: bool) -> Picked:
        """All stages, or the first two; a row goes on to the next one if no earlier stage fails."""
        ik, found = self._at_grasp()
        if not ways:
            return found
        free = torch.nonzero(found.picked).flatten()
        rest = self.some(free)._from_here(ik.q[free], ik.valid[free])
        b = len(self.objects)

        def put(name: str, value: float) -> Tensor:
            x: Tensor = getattr(rest, name)
            out = torch.full((b, *x.shape[1:]), value, dtype=x.dtype, device=x.device)
            out[free] = x
            return out

        judged = {f: getattr(found, f) for f in ("picked", "reason", "margin_m", "pair", "body")}
        for name, x in judged.items():
            x[free] = getattr(rest, name)
        walked = {name: put(name, torch.nan) for name in ("off_m", "way_in", "way_up")}
        walked |= {name: put(name, 0) for name in ("path", "length")}
        return Picked(**judged, T_world_ee=self.T_world_ee, **walked)

    def _at_grasp(self) -> tuple[IkResult, Picked]:
        """All branches at the grasps, and the first two stages: is one within reach, and is the open gripper free there, wherever
        the arm is? Nothing but kernels over the rows: a small call is recorded with it (`base.launch.repeated`)."""
        scene, b = self.scene, len(self.objects)
        ik = solve_ik(
            self.T_world_ee,
            active=self.active,
            robot=scene.robot,
            home=scene.config.workplace.home_q,
        )
        joints = ik.q.shape[2]
        postures = {"valid": ik.valid.contiguous(), "q": ik.q.flatten(0, 1)}
        sizes = {"posture": (1, joints)}
        at = over_trials(kernels.first_branches, b, scene.device, sizes=sizes, chunk=ROWS_CHUNK)(
            active=self.active, **postures
        )
        reason, pair, slot = (at[k] for k in ("reason", "pair", "slot"))
        missed = measured(
            scene, self._placed, self.T_world_ee, ik, postures, at["missed"], reason=reason, pair=pair, slot=slot
        )  # fmt: skip
        touching = path_clearances(
            scene, self._gripper, at["posture"], at["length"], cap_m=CUT_CAP_M
        )
        made = over_trials(kernels.judge_grasps, b, scene.device, chunk=ROWS_CHUNK)(
            cap=CUT_CAP_M,
            farthest=FARTHEST_M,
            ok=int(PickReason.OK),
            not_evaluated=int(PickReason.NOT_EVALUATED),
            out_of_reach=int(PickReason.OUT_OF_REACH),
            collides=int(PickReason.GRASP_COLLIDES),
            active=self.active,
            length=at["length"],
            missed=missed.clearance_m,
            **dict(zip(("clearance", "nearest", "part"), touching, strict=True)),
        )
        found = Picked(
            made["picked"], made["reason"], made["margin"], made["pair"], made["body"],
            T_world_ee=self.T_world_ee, **_no_ways(b, joints, self.active.device),
        )  # fmt: skip
        return ik, found

    def followed(self, planned: Picked) -> Picked:
        """`follow_picks` of these rows."""
        rows = torch.nonzero(self.active & planned.picked).flatten()
        if not len(rows):
            return planned
        made = self.some(rows)._made(planned[rows])
        out = planned[
            torch.arange(len(planned.picked), dtype=torch.int64, device=rows.device)
        ]  # copies
        for f in fields(Picked):
            getattr(out, f.name)[rows] = getattr(made, f.name)
        return out

    def _made(self, planned: Picked) -> Picked:
        """These rows, which were picked where they were planned, stage by stage."""
        every = self._every
        at_grasp = planned.way_in[:, -1].contiguous()
        stages = _Stages(self)
        touching = self._gripper_at(every, at_grasp)
        stages.fail(touching.clearance_m <= 0, PickReason.GRASP_COLLIDES, touching)
        approach = self._approach(every, planned.way_in, depths=True)
        stages.fail(approach.clearance_m <= 0, PickReason.APPROACH_COLLIDES, approach)
        entered = self._entered(stages.left, touching.nearer(approach).clearance_m)
        stages.fail(entered.clearance_m < 0, PickReason.APPROACH_COLLIDES, entered)
        grasp = self._grasp
        held = _margin(grasp.margin_m)
        stages.fail(grasp.empty, PickReason.NOTHING_BETWEEN_PADS, held)
        stages.fail(grasp.margin_m < 0, PickReason.NOT_HELD, held)
        closing = self._closing(grasp, at_grasp, stages.left)
        stages.fail(closing.clearance_m <= 0, PickReason.CLOSING_COLLIDES, closing)
        lift = self._lift(grasp, every, planned.way_up, depths=True)
        stages.fail(lift.clearance_m <= 0, PickReason.LIFT_COLLIDES, lift)
        way = self._clear_of(every, planned.path, planned.length)
        stages.fail(way.clearance_m <= 0, PickReason.PATH_COLLIDES, way)
        stages.pass_by(touching, approach, entered, held, closing, lift, way)
        return replace(
            planned, picked=stages.left, reason=stages.reason.to(torch.int32), margin_m=stages.found.clearance_m,
            pair=stages.found.pair, body=stages.found.body,
        )  # fmt: skip

    def _from_here(self, q: Tensor, valid: Tensor) -> Picked:
        """The stages after the first two, of rows that pass those; q, valid: (B, 8) branches at the grasp."""
        grasp = self._grasp
        tried = self._tried(grasp, q, valid)
        stages = _Stages(self)
        fail = stages.fail

        some = tried.whole.any(1)
        short = 2 * (STEPS[-1] + 1) - tried.followed
        fail(~some, PickReason.NO_STRAIGHT_WAY, _margin(-WAY_M / STEPS[-1] * short.float()))

        # straight in
        walked = tried.approach.clearance_m > 0
        blocked, least_bad = self._blocked_approach(tried, stages.left & ~walked.any(1))
        fail(~walked.any(1), PickReason.APPROACH_COLLIDES, blocked)
        held = _margin(grasp.margin_m)
        # a finger beside the object mostly decides both: this stage can name it
        known_m = torch.minimum(grasp.margin_m + TOLERANCE_M, tried.found().clearance_m)
        entered = self._entered(stages.left, known_m)
        fail(entered.clearance_m < 0, PickReason.APPROACH_COLLIDES, entered)

        # close
        fail(grasp.empty, PickReason.NOTHING_BETWEEN_PADS, held)
        fail(grasp.margin_m < 0, PickReason.NOT_HELD, held)
        closing = self._closing(grasp, q[self._every, valid.to(torch.int8).argmax(1)], stages.left)
        fail(closing.clearance_m <= 0, PickReason.CLOSING_COLLIDES, closing)

        # straight up
        up = walked & (tried.lift.clearance_m > 0)
        widest = tried.approach.clearance_m.argmax(1)
        fails = stages.left & ~up.any(1)
        fail(fails, PickReason.LIFT_COLLIDES, self._blocked_lift(grasp, tried, widest, fails))

        # home to 10 cm before the grasp
        for word, why in (
            (PlanReason.START_IN_COLLISION, PickReason.START_IN_COLLISION),
            (PlanReason.IK_IN_COLLISION, PickReason.BEFORE_COLLIDES),
            (PlanReason.NO_PATH_IN_BUDGET, PickReason.NO_PATH_IN_BUDGET),
        ):
            fail(tried.reason == int(word), why, tried.way)
        # of a row that fails, the branch that its margin is about
        first = torch.where(walked.any(1), widest, least_bad)
        slot = torch.where(up.any(1), up.to(torch.int8).argmax(1), first)
        slot = torch.where(tried.slot >= 0, tried.slot.long(), slot)
        stages.pass_by(
            entered, held, closing, tried.approach.at(slot), tried.lift.at(slot), tried.way
        )
        found, left = stages.found, stages.left
        ways = [_of_slot(x, slot, some) for x in (tried.way_in, tried.way_up)]
        return Picked(
            picked=left,
            reason=stages.reason.to(torch.int32),
            margin_m=found.clearance_m,
            pair=found.pair,
            body=found.body,
            off_m=tried.off_m.gather(1, slot[:, None])[:, 0],
            T_world_ee=self.T_world_ee,
            path=tried.path,
            length=torch.where(left, tried.length, 0),
            way_in=ways[0],
            way_up=ways[1],
        )

    def _tried(self, grasp: Grasp, q: Tensor, valid: Tensor) -> _Tried:
        """Branches, until one of each row passes the ways and a path from home leads to it.

        The order: widest spacing of waypoints first; of those, the branch that begins nearest to home, then all others.
        """
        scene, b = self.scene, len(self.objects)
        tried = _Tried.none(b, q.shape[2], q.device)
        home = home_posture(str(q.device), scene.config.workplace.home_q)
        for steps in STEPS:
            rows = torch.nonzero(tried.slot < 0).flatten()
            if not len(rows):
                break
            ways = straight_ways(scene, self.T_world_ee[rows], q[rows], valid[rows], steps)
            fresh = ways.whole & ~tried.whole[rows]
            row, slot = torch.nonzero(fresh, as_tuple=True)
            tried.way_in[rows[row], slot] = resampled(ways.way_in[row, slot])
            tried.way_up[rows[row], slot] = resampled(ways.way_up[row, slot])
            tried.off_m[rows[row], slot] = ways.off_m[row, slot]
            tried.whole[rows] |= fresh
            tried.followed[rows] = ways.followed.amax(1)
            distance = torch.zeros(fresh.shape, dtype=torch.float64, device=q.device)
            for j in range(q.shape[2]):  # summed in a fixed order: the same bits at any batch size
                distance = distance + (ways.way_in[:, :, 0, j] - home[:, None, j]).double().square()
            nearest = torch.where(fresh, distance, torch.inf).argmin(1, keepdim=True)
            first = fresh & torch.zeros_like(fresh).scatter(1, nearest, True)
            for branches in (first, fresh & ~first) if steps == STEPS[0] else (fresh,):
                self._try(grasp, tried, rows, ways, branches & (tried.slot[rows] < 0)[:, None])
        return tried

    def _try(self, grasp: Grasp, tried: _Tried, rows: Tensor, ways: Ways, branches: Tensor) -> None:
        """Walks these branches (R, 8) of `rows`, and looks for a path to those that are free. Writes into `tried`."""
        row, slot = torch.nonzero(branches, as_tuple=True)
        if not len(row):
            return
        approach = self._approach(rows[row], ways.way_in[row, slot], depths=False)
        tried.approach.put((rows[row], slot), approach)
        free = approach.clearance_m > 0
        row, slot = row[free], slot[free]
        lift = self._lift(grasp, rows[row], ways.way_up[row, slot], depths=False)
        tried.lift.put((rows[row], slot), lift)
        up = torch.zeros_like(branches)
        up[row, slot] = lift.clearance_m > 0
        own = torch.nonzero(up.any(1)).flatten()
        if not len(own):
            return
        at, before = rows[own], ways.way_in[own, :, 0].contiguous()
        plan, way = self._way(at, before, up[own])
        reached = plan.length > 0
        end = plan.path.gather(
            1, (plan.length.long() - 1).clamp(min=0)[:, None, None].expand(-1, 1, before.shape[2])
        )
        same = (end == before).all(2) & up[own]
        # a row whose first path fails keeps that reason unless another branch has a path
        news = reached | (tried.reason[at] == int(PlanReason.NOT_EVALUATED))
        tried.reason[at[news]] = plan.reason[news]
        tried.way.put((at[news],), _Nearest(*(x[news] for x in way)))
        tried.path[at[reached]] = plan.path[reached]
        tried.length[at[reached]] = plan.length[reached]
        tried.slot[at[reached]] = same[reached].to(torch.int8).argmax(1).to(torch.int32)

    def _bare(self, rows: Tensor, opening_m: Tensor) -> BodyPoses:
        """Bodies of these rows with the gripper at an opening and the object attached, in the scene's tables."""
        return self.scene.body_poses(
            self.objects[rows],
            self.hands[rows],
            self.T_obj_ee[rows],
            self.T_world_hand[rows],
            opening_m,
        )

    @cached_property
    def _grasp(self) -> Grasp:
        """The gripper closed on the objects."""
        scene, limits = self.scene, self.scene.config.thresholds
        return close_gripper(
            scene.grasp_tables, self.T_obj_ee.contiguous(), self.objects, w_max=limits.w_max_m, w_min=limits.w_min_m,
            mode=scene.config.width,
        )  # fmt: skip

    @cached_property
    def _every(self) -> Tensor:
        """All rows."""
        return torch.arange(len(self.objects), dtype=torch.int64, device=self.active.device)

    @cached_property
    def _placed(self) -> BodyPoses:
        """All rows with the open gripper, in the scene's tables."""
        return self.scene.body_poses(
            self.objects, self.hands, self.T_obj_ee, self.T_world_hand, self.open_m
        )

    @cached_property
    def _people(self) -> BodyPoses:
        """All rows, the person waiting beside table, robot and attached object."""
        if self.trials.receiver is None:
            return self._placed
        return with_person(self.scene, self._placed, self.trials.receiver, hand=True)

    @cached_property
    def _empty(self) -> BodyPoses:
        """The same with an empty gripper."""
        return without(self.scene, self._people, attached=True)

    @cached_property
    def _gripper(self) -> BodyPoses:
        """The empty gripper alone, with table and person."""
        alone, receiver = self.scene.world_of_gripper, self.trials.receiver
        if receiver is None:
            return replace(self._placed, world=alone)
        return with_person(self.scene, self._placed, receiver, hand=True, base=alone)

    @cached_property
    def _gripper_beside_person(self) -> BodyPoses:
        """The same without the table."""
        return without(self.scene, self._gripper, table=True)

    @cached_property
    def _lifted(self) -> BodyPoses:
        """The attached object among all but the table: it leaves that straight up."""
        return without(self.scene, self._people, table=True)

    @cached_property
    def _resting(self) -> BodyPoses:
        """The robot and the resting object alone."""
        alone = without(self.scene, self._placed, attached=True, table=True, others=True)
        return with_resting(self.scene, alone, self.T_world_obj)

    @cached_property
    def _resting_beside_arm(self) -> BodyPoses:
        """The arm without its gripper, and the resting object."""
        return without(self.scene, self._resting, gripper=True)

    @cached_property
    def _all(self) -> BodyPoses:
        """The empty robot, table, person and resting object."""
        return with_resting(self.scene, self._empty, self.T_world_obj)

    def _bodies(self, world: BodyPoses, rows: Tensor, opening_m: Tensor) -> BodyPoses:
        """Bodies of these rows with the gripper at an opening, among those of `world`."""
        return among(self.scene, self._bare(rows, opening_m), world, rows)

    def _open(self, rows: Tensor) -> Tensor:
        """The gap of the open gripper, for each of these rows."""
        return self.open_m[rows]

    def _gripper_at(self, rows: Tensor, q: Tensor) -> _Nearest:
        """Clearances (R,) of the open gripper alone at posture q, from table and person."""
        alone = self._bodies(self._gripper, rows, self._open(rows))
        return self._along(alone, q[:, None], depths=True)

    def _approach(self, rows: Tensor, path: Tensor, *, depths: bool) -> _Nearest:
        """Smallest clearances (R,) along ways in (R, W, J): of the robot from table, person and itself, of the arm from the
        resting object."""

        def met(world: BodyPoses, some: Tensor) -> _Nearest:
            own = rows[some]
            return self._along(self._bodies(world, own, self._open(own)), path[some], depths=depths)

        every = torch.arange(len(rows), dtype=torch.int64, device=rows.device)
        first = met(self._empty, every)
        # what met one of these already is asked for depths alone
        some = every if depths else torch.nonzero(first.clearance_m > 0).flatten()
        second = _margin(torch.full_like(first.clearance_m, CUT_CAP_M))
        second.put((some,), met(self._resting_beside_arm, some))
        return first.nearer(second.of(CollidingPair.OBJECT_ROBOT))

    def _along(
        self, bodies: BodyPoses, path: Tensor, *, depths: bool, cap_m: float = CUT_CAP_M
    ) -> _Nearest:
        """Smallest clearances (R,) along paths (R, W, J)."""
        length = torch.full((len(path),), path.shape[1], dtype=torch.int32, device=path.device)
        return _Nearest(
            *path_clearances(
                self.scene, bodies, path.contiguous(), length, cap_m=cap_m, depths=depths
            )
        )

    def _blocked_approach(self, tried: _Tried, fails: Tensor) -> tuple[_Nearest, Tensor]:
        """Nearest or deepest bodies of rows that `fails` marks, on the way in of the branch whose grasp posture has most room."""
        out = _margin(torch.full_like(self.T_world_ee[:, 0, 0], -torch.inf))
        slot = tried.whole.to(torch.int8).argmax(1)
        row, branch = torch.nonzero(fails[:, None] & tried.whole, as_tuple=True)
        if not len(row):
            return out, slot
        at_grasp = torch.full_like(tried.approach.clearance_m, -torch.inf)
        at_grasp[row, branch] = self._approach(
            row, tried.way_in[row, branch, -1:], depths=True
        ).clearance_m
        slot = torch.where(fails, at_grasp.argmax(1), slot)
        rows = torch.nonzero(fails).flatten()
        met = self._approach(rows, tried.way_in[rows, slot[rows]], depths=True)
        known = tried.approach.at(slot)
        out.put((rows,), _deeper(met, _Nearest(*(x[rows] for x in known))))
        return out, slot

    def _blocked_lift(self, grasp: Grasp, tried: _Tried, slot: Tensor, fails: Tensor) -> _Nearest:
        """Nearest or deepest bodies of rows that `fails` marks, on the way up of the branch at `slot`."""
        out = _margin(torch.full_like(self.T_world_ee[:, 0, 0], -torch.inf))
        rows = torch.nonzero(fails).flatten()
        if len(rows):
            met = self._lift(grasp, rows, tried.way_up[rows, slot[rows]], depths=True)
            out.put((rows,), _deeper(met, _Nearest(*(x[rows] for x in tried.lift.at(slot)))))
        return out

    def _entered(self, left: Tensor, known_m: Tensor) -> _Nearest:
        """Smallest clearances (B,) of the open gripper from the object's solid on the straight way in, where they are below what
        is `known_m` (B,) to be as near."""
        out = _margin(torch.full_like(known_m, CUT_CAP_M)).of(CollidingPair.OBJECT_ROBOT)
        rows = torch.nonzero(left).flatten()
        clearance, witness = way_in_clearance(
            self.scene.grasp_tables, self.T_obj_ee[rows], self.objects[rows], known_m[rows].clamp(0, CUT_CAP_M),
            way_m=WAY_M, tolerance_m=TOLERANCE_M, share=SHARE,
        )  # fmt: skip
        nearer = witness >= 0
        rows = rows[nearer]
        out.clearance_m[rows] = clearance[nearer]
        out.body[rows] = witness[nearer] + len(self.scene.tables.arm_order)
        return out

    def _closing(self, grasp: Grasp, q: Tensor, left: Tensor) -> _Nearest:
        """Smallest clearances (B,) of the gripper from table and person while its fingers close at q; where closing pushes the
        object into the table deeper than the pads give, what is missing."""
        scene = self.scene
        rows = torch.nonzero(left).flatten()
        gap, shut = scene.robot.open_gap_m, grasp.opening_m

        def opening(row: Tensor, s: Tensor) -> Tensor:
            return gap + s * (shut[row] - gap)

        def at(world: BodyPoses, row: Tensor, s: Tensor, cap_m: float) -> _Nearest:
            poses = self._bodies(world, row, opening(row, s))
            return self._along(poses, q[row][:, None], depths=True, cap_m=cap_m)

        way = fingers_way(scene)

        def travel(row: Tensor, low: Tensor, middle: Tensor, high: Tensor) -> Tensor:
            first, half, last = (way.at(opening(row, s)) for s in (low, middle, high))
            return torch.maximum((half - first).abs(), (last - half).abs())

        # the person is far from most grippers at a table: one look at fingers half shut says by how much at least
        start, half, end = (torch.full_like(shut, s) for s in (0.0, 0.5, 1.0))
        far = travel(rows, start[rows], half[rows], end[rows])
        people = torch.full_like(shut, torch.inf)
        cap_m = CUT_CAP_M + float(way.way_m[-1])
        people[rows] = at(self._gripper_beside_person, rows, half[rows], cap_m).clearance_m - far
        # the table is below them: how low they come is known
        above = heights(scene, q[rows], self._open(rows), shut[rows])
        number = torch.zeros_like(self._every)
        number[rows] = torch.arange(len(rows), dtype=torch.int64, device=rows.device)

        def floor(row: Tensor, low: Tensor, high: Tensor) -> Tensor:
            return torch.minimum(people[row], above.within(number[row], low, high))

        best, where = least_along(
            lambda row, s: at(self._gripper, row, s, CUT_CAP_M).clearance_m, travel, rows, len(q), parts=1, cap_m=CUT_CAP_M,
            floor=floor,
        )  # fmt: skip
        nearest = _margin(best)
        witness = at(self._gripper, rows, where[rows], CUT_CAP_M)
        nearest.pair[rows], nearest.body[rows] = witness.pair, witness.body
        # the pads bring the object between them: it moves along the closing axis
        down = grasp.shift_m * self.T_world_ee[:, 2, 1]
        room = scene.config.thresholds.pad_squeeze_m - down
        pushed = _margin(torch.where(room < 0, room, torch.inf)).of(CollidingPair.OBJECT_TABLE)
        return nearest.nearer(pushed)

    def _lift(self, grasp: Grasp, rows: Tensor, path: Tensor, *, depths: bool) -> _Nearest:
        """Smallest clearances (R,) on ways up (R, W, J): of the robot from all, of the held object from person and robot."""
        shut = grasp.opening_m[rows]
        closed = replace(self, T_obj_ee=attach(self.T_obj_ee, grasp.shift_m))._bare(rows, shut)
        worlds = (among(self.scene, closed, w, rows) for w in (self._empty, self._lifted))
        first, second = (self._along(w, path, depths=depths) for w in worlds)
        return first.nearer(second)

    def _way(self, rows: Tensor, before: Tensor, branches: Tensor) -> tuple[Plan, _Nearest]:
        """A path from home to one of the `branches` (R, 8) before the grasp, and what it or its failure is about."""
        scene, config = self.scene, self.scene.config
        every, open_m = torch.ones_like(rows, dtype=torch.bool), self._open(rows)
        key = random_key(self.trials.trial_id[rows])
        plan = plan_paths(
            scene, self._bodies(self._all, rows, open_m), before, branches, every, key, config.plan, execute=config.execute,
            cap_m=CUT_CAP_M + FAR_FROM_M,
        )  # fmt: skip
        # what the path keeps from the object, and from all else; without a path a posture says it
        fails = plan.reason == int(PlanReason.IK_IN_COLLISION)
        home = home_posture(str(every.device), config.workplace.home_q)
        first = _of_slot(before[:, :, None], branches.to(torch.int8).argmax(1), every)
        at_posture = fails | (plan.reason == int(PlanReason.START_IN_COLLISION))
        path = plan.path.clone()
        path[:, 0] = torch.where(
            (fails & at_posture)[:, None],
            first[:, 0],
            torch.where(at_posture[:, None], home, path[:, 0]),
        )
        length = torch.where(at_posture, 1, plan.length).to(torch.int32)
        way = _margin(torch.full_like(plan.clearance_m, CUT_CAP_M))
        near = torch.nonzero(at_posture | (plan.clearance_m < CUT_CAP_M + FAR_FROM_M)).flatten()
        if len(near):
            way.put((near,), self._clear_of(rows[near], path[near], length[near]))
        return plan, way

    def _clear_of(self, rows: Tensor, path: Tensor, length: Tensor) -> _Nearest:
        """Smallest clearances (R,) of the empty robot along paths from home: from the resting object, and from all else."""
        found = []
        for world in (self._empty, self._resting):
            poses = self._bodies(world, rows, self._open(rows))
            found.append(
                _Nearest(*path_clearances(self.scene, poses, path, length, cap_m=CUT_CAP_M))
            )
        return found[0].nearer(found[1].of(CollidingPair.OBJECT_ROBOT))


@lru_cache(maxsize=16)
def _no_ways(b: int, joints: int, device: torch.device) -> dict[str, Tensor]:
    """What `Picked` has of rows whose ways were not asked for."""
    off_m = torch.full((b,), torch.nan, dtype=torch.float32, device=device)
    path = torch.empty((b, 0, joints), dtype=torch.float32, device=device)
    length = torch.zeros((b,), dtype=torch.int32, device=device)
    return {"off_m": off_m, "path": path, "length": length, "way_in": path, "way_up": path}


class _Stages:
    """The first stage of each row that fails, and what its margin is about; rows that are `left` have passed all so far."""

    def __init__(self, batch: _Batch) -> None:
        self.found = _margin(torch.full_like(batch.T_world_ee[:, 0, 0], CUT_CAP_M))
        self.reason = torch.zeros_like(batch.objects)
        self.left = torch.ones_like(batch.active)

    def fail(self, rows: Tensor, why: PickReason, by: _Nearest) -> None:
        """Rows fail here that have not failed before."""
        rows = rows & self.left
        self.reason = torch.where(rows, int(why), self.reason)
        self._put(rows, by)
        self.left = self.left & ~rows

    def pass_by(self, *stages: _Nearest) -> None:
        """The smallest of these is the margin of rows that have passed them all."""
        for by in stages:
            self._put(self.left, self.found.nearer(by))

    def _put(self, rows: Tensor, by: _Nearest) -> None:
        self.found = _Nearest(
            *(torch.where(rows, y, x) for x, y in zip(self.found, by, strict=True))
        )


def _deeper(met: _Nearest, known: _Nearest) -> _Nearest:
    """`met`, whose depths are measured; `known` where that finds less: postures differ from waypoint to waypoint."""
    return _Nearest(
        *(
            torch.where(met.clearance_m > known.clearance_m, y, x)
            for x, y in zip(met, known, strict=True)
        )
    )


def _of_slot(path: Tensor, slot: Tensor, some: Tensor) -> Tensor:
    """The paths at (B,) `slot` among (B, 8, W, J); NaN where there is none."""
    own = path[torch.arange(len(slot), dtype=torch.int64, device=slot.device), slot]
    return torch.where(some[:, None, None], own, torch.nan)
