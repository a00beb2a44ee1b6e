"""Pick: can the arm take the object from where it rests? From home to 10 cm before the grasp, straight in with the open
gripper, close, and 10 cm straight up. Geometric and certified, as Plan is; no part of the verdict (docs/pick.md)."""

from dataclasses import dataclass, fields
from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.io.progress import progress
from r2h_batch.base.launch import over_trials
from r2h_batch.base.launch.threads import one_torch_thread
from r2h_batch.judge.goal import failed_clearance
from r2h_batch.judge.grasp import (
    CUT_CAP_M,
    Grasp,
    attach,
    close_gripper,
    gripper_poses,
    open_clearance,
)
from r2h_batch.judge.ik import home_posture, solve_ik
from r2h_batch.judge.inputs import check_benchmark, check_indices, check_receiver, checked_inputs
from r2h_batch.judge.least import least_along
from r2h_batch.judge.plan import Plan, path_clearances, plan_paths, random_key
from r2h_batch.kernels.judge.rows import usable_rows
from r2h_batch.kernels.plan.codes import BRANCHES
from r2h_batch.kernels.plan.line import follow_lines
from r2h_batch.scene.person import with_person
from r2h_batch.scene.resting import with_resting, without
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.types import CollidingPair, PlanReason, Trials

WAY_M = 0.1
"""Length of the straight way in, and of the way up [whole.md; choice]."""
STEPS = 40
"""Waypoints of a straight way after its first, 2.5 mm apart [choice]: between them the joints go straight."""
MOST_TURN_RAD = 0.5
"""A joint that turns farther from one waypoint to the next does not follow the line [choice]."""
MOST_OFF_M = 1e-4
"""A gripper that leaves the line farther between two waypoints does not follow it [choice]: what float32 makes unreliable."""
OBJECT_PARTS, CLOSING_PARTS = 16, 8
ROWS = 128
"""Rows that are judged at a time."""


class PickReason(IntEnum):
    """Why an object cannot be picked: the first of these that holds."""

    OK = 0
    OUT_OF_REACH = 1
    NO_STRAIGHT_WAY = 2
    APPROACH_COLLIDES = 3
    NOTHING_BETWEEN_PADS = 4
    NOT_HELD = 5
    CLOSING_COLLIDES = 6
    LIFT_COLLIDES = 7
    START_IN_COLLISION = 8
    BEFORE_COLLIDES = 9
    NO_PATH_IN_BUDGET = 10
    NOT_EVALUATED = 11


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


def picked(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    T_world_obj: Float32[Tensor, "b 4 4"],
    trials: Trials,
) -> Picked:
    """Whether the arm can pick each trial's object where it rests, why not, and by how much (docs/pick.md).

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
    check_receiver(scene.config, trials, (T_obj_ee, T_world_obj))
    check_indices(scene, trials)
    with one_torch_thread(torch.device(scene.device)):
        parts = []
        with progress("picked", len(trials), "trials") as told:
            for i in range(0, max(len(trials), 1), ROWS):
                grasp, rest = (x[i : i + ROWS].detach() for x in (T_obj_ee, T_world_obj))
                parts.append(_Batch.of(scene, grasp, rest, trials[i : i + ROWS]).judged())
                told(len(grasp))
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

    def of(self, pair: CollidingPair) -> "_Nearest":
        """The same, named `pair`."""
        return self._replace(pair=torch.full_like(self.pair, int(pair)))


def _margin(clearance_m: Tensor) -> _Nearest:
    """A margin that is about no two bodies."""
    none = torch.zeros(clearance_m.shape, dtype=torch.int32, device=clearance_m.device)
    return _Nearest(clearance_m, none, none - 1)


class _Lines(NamedTuple):
    """Ways in and ways up of B x 8 branches, the grasp last, and how many waypoints of each are followed."""

    path: Tensor
    followed: Tensor
    off_m: Tensor


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
    grasp: Grasp

    @staticmethod
    def of(scene: Scene, T_obj_ee: Tensor, T_world_obj: Tensor, trials: Trials) -> "_Batch":
        """Rows whose poses are poses are active."""
        usable = over_trials(usable_rows, len(trials), scene.device, chunk=4096)(
            objects=len(scene.objects),
            hands=len(scene.hands.set),
            T_obj_ee=T_obj_ee.contiguous(),
            T_world_ee=T_world_obj.contiguous(),
            T_world_hand=trials.T_world_hand.detach().contiguous(),
            object=trials.object_index.contiguous(),
            hand=trials.hand_index.contiguous(),
        )
        T_obj_ee, limits = usable["T_obj_ee"], scene.config.thresholds
        grasp = close_gripper(
            scene.grasp_tables,
            T_obj_ee,
            usable["object"],
            w_max=limits.w_max_m,
            w_min=limits.w_min_m,
            mode=scene.config.width,
            known=True,
        )
        T_world_ee = se3.matmul(usable["T_world_ee"], T_obj_ee)
        return _Batch(
            scene, trials, usable["active"], usable["object"], usable["hand"], T_obj_ee,
            usable["T_world_ee"], T_world_ee, usable["T_world_hand"], grasp,
        )  # fmt: skip

    def judged(self) -> Picked:
        """All stages; a row goes on to the next one if no earlier stage fails."""
        found = _margin(torch.full_like(self.T_world_ee[:, 0, 0], CUT_CAP_M))
        reason = torch.zeros_like(self.objects)
        left = self.active

        def fail(rows: Tensor, why: PickReason, by: _Nearest) -> None:
            nonlocal found, reason, left
            rows = rows & left
            reason = torch.where(rows, int(why), reason)
            found = _Nearest(*(torch.where(rows, y, x) for x, y in zip(found, by, strict=True)))
            left = left & ~rows

        def passed(by: _Nearest) -> None:
            nonlocal found
            nearer = found.nearer(by)
            found = _Nearest(*(torch.where(left, y, x) for x, y in zip(found, nearer, strict=True)))

        # reach
        there, missed_m, lines_in, lines_up = self._ways()
        fail(~there, PickReason.OUT_OF_REACH, _margin(missed_m))
        n = STEPS + 1
        whole = (lines_in.followed == n) & (lines_up.followed == n)
        short = (2 * n - lines_in.followed - lines_up.followed).amin(1)
        fail(~whole.any(1), PickReason.NO_STRAIGHT_WAY, _margin(-WAY_M / STEPS * short.float()))

        # straight in
        approach = self._approach(lines_in, whole & left[:, None])
        free = approach.clearance_m > 0
        fail(
            ~free.any(1), PickReason.APPROACH_COLLIDES, approach.at(approach.clearance_m.argmax(1))
        )
        entered = self._entered(left)
        fail(entered.clearance_m < 0, PickReason.APPROACH_COLLIDES, entered)

        # close
        held = _margin(self.grasp.margin_m)
        fail(self.grasp.empty, PickReason.NOTHING_BETWEEN_PADS, held)
        fail(self.grasp.margin_m < 0, PickReason.NOT_HELD, held)
        closing = self._closing(lines_in.path[:, :, -1], approach.clearance_m.argmax(1), left)
        fail(closing.clearance_m <= 0, PickReason.CLOSING_COLLIDES, closing)

        # straight up
        free = free & left[:, None]
        lifted = self._lift(lines_up, free)
        up = free & (lifted.clearance_m > 0)
        best = torch.where(free, lifted.clearance_m, -torch.inf).argmax(1)
        fail(~up.any(1), PickReason.LIFT_COLLIDES, lifted.at(best))

        # home to 10 cm before the grasp
        before = lines_in.path[:, :, 0].contiguous()
        slot = torch.minimum(approach.clearance_m, lifted.clearance_m).argmax(1)
        plan, way = self._way(before, up & left[:, None], left)
        for word, why in (
            (PlanReason.START_IN_COLLISION, PickReason.START_IN_COLLISION),
            (PlanReason.IK_IN_COLLISION, PickReason.BEFORE_COLLIDES),
            (PlanReason.NO_PATH_IN_BUDGET, PickReason.NO_PATH_IN_BUDGET),
        ):
            fail(plan.reason == int(word), why, way)
        end = plan.path.gather(
            1, (plan.length.long() - 1).clamp(min=0)[:, None, None].expand(-1, 1, before.shape[2])
        )
        same = (end == before).all(2) & up
        slot = torch.where(left & same.any(1), same.to(torch.int8).argmax(1), slot)
        for by in (entered, held, closing, approach.at(slot), lifted.at(slot), way):
            passed(by)

        reason = torch.where(self.active, reason, int(PickReason.NOT_EVALUATED)).to(torch.int32)
        found = _Nearest(*(
            torch.where(self.active, x, y) for x, y in zip(found, _margin(torch.full_like(found[0], torch.nan)), strict=True)
        ))  # fmt: skip
        some = whole.any(1)
        # of a row that fails, the branch that its margin is about
        walked = approach.clearance_m.isfinite()
        first = torch.where(
            walked.any(1), approach.clearance_m.argmax(1), whole.to(torch.int8).argmax(1)
        )
        slot = torch.where(up.any(1), slot, torch.where(free.any(1), best, first))
        ways = [_of_slot(x.path, slot, some) for x in (lines_in, lines_up)]
        off = torch.maximum(lines_in.off_m, lines_up.off_m).gather(1, slot[:, None])[:, 0]
        return Picked(
            picked=left,
            reason=reason,
            margin_m=found.clearance_m,
            pair=found.pair,
            body=found.body,
            off_m=torch.where(some, off, torch.nan),
            T_world_ee=self.T_world_ee,
            path=plan.path,
            length=torch.where(left, plan.length, 0),
            way_in=ways[0],
            way_up=ways[1],
        )

    def _bodies(
        self,
        rows: Tensor,
        opening_m: Tensor,
        T_obj_ee: Tensor | None = None,
        *,
        person: bool = True,
    ) -> BodyPoses:
        """Bodies of these rows with the gripper at an opening, the person waiting; `T_obj_ee`: with the object attached so."""
        T = self.T_obj_ee if T_obj_ee is None else T_obj_ee
        poses = self.scene.body_poses(
            self.objects[rows], self.hands[rows], T[rows], self.T_world_hand[rows], opening_m
        )
        if person and self.trials.receiver is not None:
            receiver = self.trials.receiver[rows]
            poses = with_person(self.scene, poses, receiver, hand=True)
        return poses if T_obj_ee is not None else without(self.scene, poses, attached=True)

    @property
    def _branches(self) -> Tensor:
        """The row of each of B x 8 branches."""
        rows = torch.arange(len(self.trials), dtype=torch.int64, device=self.active.device)
        return rows.repeat_interleave(int(BRANCHES))

    def _open(self, rows: Tensor) -> Tensor:
        """The gap of the open gripper, for each of these rows."""
        return torch.full_like(self.grasp.opening_m[rows], self.scene.robot.open_gap_m)

    def _ways(self) -> tuple[Tensor, Tensor, _Lines, _Lines]:
        """Whether every waypoint has a branch, and by how much one misses it (below 0, m); the ways in and up."""
        scene, b = self.scene, len(self.trials)
        joints, home = len(scene.robot.joints), scene.config.workplace.home_q
        m = (
            WAY_M
            / STEPS
            * torch.arange(1, STEPS + 1, dtype=torch.float32, device=self.active.device)
        )
        T = self.T_world_ee[:, None].repeat(1, 2 * STEPS + 1, 1, 1)
        T[:, 1 : STEPS + 1, :3, 3] -= m[:, None] * self.T_world_ee[:, None, :3, 2]
        T[:, STEPS + 1 :, 2, 3] += m
        ik = solve_ik(
            T.flatten(0, 1), active=self.active.repeat_interleave(T.shape[1]), robot=scene.robot, home=home
        )  # fmt: skip
        q, valid = ik.q.view(b, -1, BRANCHES, joints), ik.valid.view(b, -1, BRANCHES)
        any_branch = valid.any(2)
        # the grasp first, then the ends, then what lies between
        ranked = [0, STEPS, 2 * STEPS, *range(1, STEPS), *range(STEPS + 1, 2 * STEPS)]
        order = torch.tensor(ranked, dtype=torch.int64, device=T.device)
        missed = order[(~any_branch[:, order]).to(torch.int8).argmax(1)]
        there = any_branch.all(1)
        at = torch.arange(b, dtype=torch.int64, device=T.device) * T.shape[1] + missed
        one = type(ik)(*(getattr(ik, f.name)[at] for f in fields(ik)))
        reason = torch.full_like(self.objects, int(PlanReason.IK_UNREACHABLE))
        reason = torch.where(there | ~self.active, int(PlanReason.NOT_EVALUATED), reason)
        rows = torch.arange(b, dtype=torch.int64, device=T.device)
        missed_m = failed_clearance(
            scene, self._bodies(rows, self._open(rows), person=False), T.flatten(0, 1)[at].contiguous(), one,
            one.valid, reason.to(torch.int32),
        )  # fmt: skip
        lever = gripper_lever_m(scene)
        lines = []
        for first in (1, STEPS + 1):
            own = [0, *range(first, first + STEPS)]
            size: dict[str, int | tuple[int, ...]]
            size = {"path": (int(BRANCHES), STEPS + 1, joints)}
            size |= {"followed": int(BRANCHES), "off": int(BRANCHES)}
            made = over_trials(scene.sized(follow_lines), b, scene.device, sizes=size, chunk=16)(
                most_turn=MOST_TURN_RAD,
                most_off=MOST_OFF_M,
                lever=lever,
                world=scene.world,
                tool=scene.tool,
                q=q[:, own].contiguous(),
                valid=valid[:, own].contiguous(),
                T_world_ee=T[:, own].contiguous(),
            )
            lines.append(_Lines(made["path"], made["followed"], made["off"]))
        return there, missed_m, lines[0], lines[1]

    def _approach(self, lines: _Lines, branches: Tensor) -> _Nearest:
        """Smallest clearances (B, 8) on the ways in: of the robot from table, person and itself, of the arm from the resting
        object. -inf where a way is not walked: where the grasp posture collides and another branch's does not, or less."""
        rows = self._branches
        open_m = self._open(rows)
        worlds = (self._bodies(rows, open_m), self._arm_and_object(rows, open_m, gripper=False))
        at_grasp = self._walked(worlds, lines.path[:, :, -1:], branches).clearance_m
        free = branches & (at_grasp > 0)
        least_bad = torch.zeros_like(free).scatter(1, at_grasp.argmax(1, keepdim=True), True)
        walked = torch.where(free.any(1, keepdim=True), free, least_bad & branches)
        return self._walked(worlds, lines.path, walked)

    def _arm_and_object(self, rows: Tensor, open_m: Tensor, *, gripper: bool) -> BodyPoses:
        """The robot, with its gripper or without, and the resting object alone."""
        poses = self._bodies(rows, open_m, person=False)
        alone = without(self.scene, poses, table=True, gripper=not gripper, others=True)
        return with_resting(self.scene, alone, self.T_world_obj[rows])

    def _walked(
        self, worlds: tuple[BodyPoses, BodyPoses], path: Tensor, branches: Tensor
    ) -> _Nearest:
        """Smallest clearances (B, 8) along paths (B, 8, W, J) in both worlds, whose second is robot and object alone."""
        length = torch.where(branches.flatten(), path.shape[2], 0).to(torch.int32)
        ways = path.flatten(0, 1).contiguous()
        first, second = (_Nearest(*path_clearances(self.scene, w, ways, length)) for w in worlds)
        nearest = first.nearer(second.of(CollidingPair.OBJECT_ROBOT))
        return _Nearest(*(x.view(-1, int(BRANCHES)) for x in nearest))

    def _entered(self, left: Tensor) -> _Nearest:
        """Smallest clearances (B,) of the open gripper from the object's solid on the straight way in."""
        scene, back = self.scene, self.T_obj_ee[:, :3, 2]

        def at(row: Tensor, s: Tensor, cap_m: float) -> tuple[Tensor, Tensor]:
            T = self.T_obj_ee[row]
            T[:, :3, 3] -= (WAY_M * (1 - s))[:, None] * back[row]
            return open_clearance(
                scene.grasp_tables, T.contiguous(), self.objects[row], cap_m=cap_m, known=True
            )

        def travel(row: Tensor, low: Tensor, middle: Tensor, high: Tensor) -> Tensor:
            return WAY_M * torch.maximum(middle - low, high - middle)

        cap = CUT_CAP_M + 0.5 * WAY_M / OBJECT_PARTS
        rows = torch.nonzero(left).flatten()
        best, where = least_along(
            lambda row, s: at(row, s, cap)[0], travel, rows, len(left), parts=OBJECT_PARTS, cap_m=CUT_CAP_M
        )  # fmt: skip
        body = torch.full_like(self.objects, -1)
        witness = at(rows, where[rows], cap)[1]
        body[rows] = torch.where(witness < 0, -1, witness + len(scene.tables.arm_order))
        return _margin(best)._replace(body=body).of(CollidingPair.OBJECT_ROBOT)

    def _closing(self, grasp_q: Tensor, slot: Tensor, left: Tensor) -> _Nearest:
        """Smallest clearances (B,) of the robot while the fingers close, from table and person; where closing pushes the object
        into the table deeper than the pads give, what is missing."""
        scene = self.scene
        n = len(slot)
        q = _of_slot(grasp_q[:, :, None], slot, left).nan_to_num()
        rows = torch.nonzero(left).flatten()
        gap, shut = scene.robot.open_gap_m, self.grasp.opening_m

        def opening(row: Tensor, s: Tensor) -> Tensor:
            return gap + s * (shut[row] - gap)

        def at(row: Tensor, s: Tensor) -> _Nearest:
            one = torch.ones(len(row), dtype=torch.int32, device=row.device)
            poses = self._bodies(row, opening(row, s))
            return _Nearest(*path_clearances(scene, poses, q[row].contiguous(), one))

        radius = gripper_radii(scene)

        def travel(row: Tensor, low: Tensor, middle: Tensor, high: Tensor) -> Tensor:
            (R0, p0), (R1, p1), (R2, p2) = (
                gripper_poses(scene.robot, opening(row, s)) for s in (low, middle, high)
            )
            far = torch.zeros_like(low)
            for R, p in ((R0, p0), (R2, p2)):
                turn = (R - R1).double().square().flatten(2)
                size = turn.sum(2).sqrt() / 2**0.5  # 2 sin(angle / 2)
                moved = se3.dot((p - p1).double(), (p - p1).double()).sqrt() + radius * size
                far = torch.maximum(far, moved.amax(1).float())
            return far

        best, where = least_along(
            lambda row, s: at(row, s).clearance_m, travel, rows, n, parts=CLOSING_PARTS, cap_m=CUT_CAP_M
        )  # fmt: skip
        nearest = _margin(best)
        witness = at(rows, where[rows])
        nearest.pair[rows], nearest.body[rows] = witness.pair, witness.body
        # the pads bring the object between them: it moves along the closing axis
        down = self.grasp.shift_m * self.T_world_ee[:, 2, 1]
        room = scene.config.thresholds.pad_squeeze_m - down
        pushed = _margin(torch.where(room < 0, room, torch.inf)).of(CollidingPair.OBJECT_TABLE)
        return nearest.nearer(pushed)

    def _lift(self, lines: _Lines, branches: Tensor) -> _Nearest:
        """Smallest clearances (B, 8) on the ways up: of the robot from all, of the held object from person and robot."""
        rows = self._branches
        shut = self.grasp.opening_m[rows]
        closed = attach(self.T_obj_ee, self.grasp.shift_m)
        bare = self._bodies(rows, shut)
        # it leaves the table straight up, so that pair is left out
        loaded = without(self.scene, self._bodies(rows, shut, closed), table=True)
        length = torch.where(branches.flatten(), lines.path.shape[2], 0).to(torch.int32)
        ways = lines.path.flatten(0, 1).contiguous()
        first, second = (
            _Nearest(*path_clearances(self.scene, w, ways, length)) for w in (bare, loaded)
        )
        nearest = first.nearer(second)
        return _Nearest(*(x.view(-1, int(BRANCHES)) for x in nearest))

    def _way(self, before: Tensor, branches: Tensor, left: Tensor) -> tuple[Plan, _Nearest]:
        """A path from home to one of the `branches` before the grasp, and what it or its failure is about."""
        scene, config = self.scene, self.scene.config
        rows = torch.arange(len(left), dtype=torch.int64, device=left.device)
        open_m = self._open(rows)
        empty = self._bodies(rows, open_m)
        among = with_resting(scene, empty, self.T_world_obj)
        plan = plan_paths(
            scene, among, before, branches, left, random_key(self.trials.trial_id), config.plan, execute=config.execute
        )  # fmt: skip
        # what the path keeps from the object, and from all else; without a path a posture says it
        fails = plan.reason == int(PlanReason.IK_IN_COLLISION)
        home = home_posture(str(left.device), config.workplace.home_q)
        first = _of_slot(before[:, :, None], branches.to(torch.int8).argmax(1), left).nan_to_num()
        posture = torch.where(fails[:, None, None], first, home[:, None]).contiguous()
        one = (fails | (plan.reason == int(PlanReason.START_IN_COLLISION))).to(torch.int32)
        alone = self._arm_and_object(rows, open_m, gripper=True)
        found = []
        for poses in (empty, alone):
            path = _Nearest(*path_clearances(scene, poses, plan.path, plan.length))
            at = _Nearest(*path_clearances(scene, poses, posture, one))
            found.append(
                _Nearest(*(torch.where(one > 0, y, x) for x, y in zip(path, at, strict=True)))
            )
        nearest = found[0].nearer(found[1].of(CollidingPair.OBJECT_ROBOT))
        unknown = (one == 0) & (plan.length == 0)
        none = _margin(torch.full_like(nearest.clearance_m, -torch.inf))
        return plan, _Nearest(
            *(torch.where(unknown, y, x) for x, y in zip(nearest, none, strict=True))
        )


def _of_slot(path: Tensor, slot: Tensor, some: Tensor) -> Tensor:
    """The paths at (B,) `slot` among (B, 8, W, J); NaN where there is none."""
    own = path[torch.arange(len(slot), dtype=torch.int64, device=slot.device), slot]
    return torch.where(some[:, None, None], own, torch.nan)


@lru_cache(maxsize=4)
def gripper_lever_m(scene: Scene) -> float:
    """No point of the gripper is farther from the ee (m)."""
    T_ee_wrist = np.linalg.inv(scene.T_wrist_ee)
    world, k = scene.world, len(scene.robot.joints) + 1
    ends = np.stack([world.link_c0.numpy()[k], world.link_c1.numpy()[k]])
    at = ends @ T_ee_wrist[:3, :3].T + T_ee_wrist[:3, 3]
    return float(np.sqrt((at * at).sum(1)).max() + world.link_radius.numpy()[k])


@lru_cache(maxsize=4)
def gripper_radii(scene: Scene) -> Tensor:
    """No point of a gripper primitive is farther from its middle (m), (G,) float64."""
    first = len(scene.tables.arm_order)
    axis, radius = (getattr(scene.world, k).numpy()[first:] for k in ("cap_axis", "cap_radius"))
    far = np.sqrt((axis * axis).sum(1)) + radius
    return torch.from_numpy(far.astype(np.float64)).to(scene.device)
