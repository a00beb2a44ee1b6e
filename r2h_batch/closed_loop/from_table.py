"""`TableHandoverEnv`: handovers in closed loop that begin with the object on the table (docs/pick.md, "In closed loop").

The policy moves arm and gripper: it closes around the object, lifts it and hands it over. Contacts on the way are certified
by the kernels that judge Pick and Plan. The end is judged by the benchmark's criteria.
"""

from dataclasses import replace
from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.closed_loop.arm import ee_and_jacobian
from r2h_batch.closed_loop.env import End, HandoverEnv, LoopConfig, Why
from r2h_batch.judge.grasp import CUT_CAP_M, attach, open_clearance
from r2h_batch.judge.grasp_physics import CLOSING_M_S
from r2h_batch.judge.least import TOLERANCE_M, least_along
from r2h_batch.judge.pick import closing_room
from r2h_batch.judge.plan import path_clearances
from r2h_batch.judge.received import given
from r2h_batch.observe.known import known_moments
from r2h_batch.scene.resting import among, with_resting, without
from r2h_batch.scene.scene import BodyPoses
from r2h_batch.types import GivenScores, Scores, Trials
from r2h_batch.verdicts import CRITERIA, Outcome, PickReason

TABLE_HORIZON_S = 30.0
"""Longest episode, s [choice]: the scripted way to the grasp and up takes 8 to 14 s."""
LIFTED_M = 1e-3
"""An object whose lowest point is as far above the table as this has left it [choice]."""
PARTS = 4
"""Parts in which a step's clearance of gripper and object is measured first."""


class Phase(IntEnum):
    """How far an episode has come."""

    RESTS = 0
    """the object lies on the table, the gripper is open"""
    CLOSES = 1
    """the fingers close, the arm stands"""
    LIFTS = 2
    """the gripper holds the object, which has not left the table"""
    CARRIES = 3


class TableHandoverEnv(HandoverEnv):
    """B handovers that begin at the moment of Pick: the object on the table, the arm at home, the gripper open.

    Observations are those of `HandoverEnv`, and `T_world_obj` (where the object is), `gripper` (the gap between the pads, m),
    `phase` (a number of `Phase`) and `T_obj_ee` (the grasp that the method asked for). An action has one number more, the
    last: below 0 the gripper closes. It closes once, at `CLOSING_M_S`, as soon as the arm has come to rest.

    `info` has besides `outcome`, the first criterion that fails in the benchmark's order (success where none does, "" while the
    episode runs), and `pick_reason`, a word of `PickReason`.
    """

    from_table: ClassVar[bool] = True

    def __init__(self, scores: Scores, *args: Any, **more: Any) -> None:
        """Args:
            scores: of a benchmark that asks for Pick, with their inputs.
            args: other arguments of `HandoverEnv`.
            more: the same, by name; action may not be "pose".

        Raises:
            ValueError: the benchmark does not ask for Pick, or as of `HandoverEnv`.
        """
        if scores.inputs is not None:
            benchmark = scores.inputs.evaluator.benchmark
            if "pick" not in benchmark.asks:
                raise ValueError(
                    f"{benchmark.name} does not ask for Pick, and its objects rest nowhere; take HandoverEnv, or r2h-v3-draft"
                )
        if more.get("config") is None:
            more["config"] = LoopConfig(horizon_s=TABLE_HORIZON_S)
        super().__init__(scores, *args, **more)

    def _more_shapes(self) -> dict[str, tuple[int, ...]]:
        return {"T_world_obj": (4, 4), "gripper": (), "phase": (), "T_obj_ee": (4, 4)}

    # --- what each row holds -------------------------------------------------------------------------------------

    def _hold(self, rows: Tensor) -> None:
        """Lays the objects of these rows on the table. Rows whose episode goes on keep what they have in the gripper."""
        kept = ("_attached", "_opening", "_blocked")
        before = {name: getattr(self, name) for name in kept} if hasattr(self, "phase") else None
        super()._hold(rows)
        inputs, b = self.scores.inputs, self.num_envs
        assert inputs is not None
        self._held = self.scores.outcome.to(self._device) != int(Outcome.INVALID_INPUT)
        self._T_obj_ee = torch.where(
            self._held[:, None, None], inputs.T_obj_ee.to(self._device), self._attached.new_tensor(np.eye(4))
        )  # fmt: skip
        self._blocked = torch.zeros_like(self._held)
        if before is None:
            self.phase = torch.zeros(b, dtype=torch.int8, device=self._device)
            self._asked = torch.zeros_like(self._held)
            self._shut = torch.zeros_like(self._opening)
            self._pick = torch.full_like(self.phase, int(PickReason.NOT_EVALUATED))
        else:
            for name, value in before.items():
                getattr(self, name).copy_(value)
        self._lay()

    def _lay(self) -> None:
        """The objects where they rest, and what robots meet there."""
        scene, trials = self.scene, self.trials
        self._T_rest = torch.eye(4, dtype=torch.float32, device=self._device).repeat(
            self.num_envs, 1, 1
        )
        rows = torch.nonzero(self._held).flatten()
        self._T_rest[rows] = known_moments(scene).of(trials[rows])
        bare = self._bare(self._every)
        alone = replace(bare, world=scene.world_without_hand)
        self._robot_alone = without(scene, alone, attached=True)
        self._above_table = without(scene, alone, table=True)
        resting = without(scene, bare, attached=True, table=True, others=True)
        self._arm_and_resting = without(
            scene, with_resting(scene, resting, self._T_rest), gripper=True
        )
        hulls = [scene.objects[int(i)].hull_vertices for i in trials.object_index]
        most = max(len(x) for x in hulls)
        padded = np.stack([x[np.minimum(np.arange(most), len(x) - 1)] for x in hulls])
        self._hull = torch.from_numpy(padded.astype(np.float64)).to(self._device)
        step = torch.full_like(self._attached[:1, 0, :1], self.speed * self.step_s)
        turns = (step.double() / self.weight).float()
        self._most_m = float(self._distance.robot_travel(turns))
        place = scene.config.workplace
        self._top_m = place.table_center[2] + place.table_half[2]

    def _start(self, mask: Tensor) -> None:
        rows = torch.nonzero(mask).flatten()
        self.phase = self.phase.clone()
        self.phase[rows], self._asked[rows], self._blocked[rows] = int(Phase.RESTS), False, False
        self._opening[rows] = self.scene.robot.open_gap_m
        self._attached[rows] = self._T_obj_ee[rows]
        self._shut[rows] = self.scene.robot.open_gap_m
        self._pick[rows] = int(PickReason.NOT_EVALUATED)
        super()._start(mask)

    def _grasped(self, rows: Tensor) -> Tensor:
        return self._T_obj_ee_made[rows]

    @property
    def T_world_obj(self) -> Float32[Tensor, "b 4 4"]:
        """Where the objects are."""
        held = se3.matmul(self.T_world_ee, se3.inverse(self._attached.double())).float()
        return torch.where((self.phase >= int(Phase.LIFTS))[:, None, None], held, self._T_rest)

    # --- one step ------------------------------------------------------------------------------------------------

    def begin(self) -> dict[str, Tensor]:
        self._T_obj_ee_made = self._T_obj_ee.clone()
        return super().begin()

    def _step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor]:
        running = self.ends == int(End.RUNNING)
        rests = self.phase == int(Phase.RESTS)
        self._asked = self._asked | (running & rests & self._closes)
        stands = self._asked & (self.phase <= int(Phase.CLOSES))
        still = self.q if self.action == "posture" else torch.zeros_like(actions)
        return super()._step(torch.where(stands[:, None], still.to(actions.dtype), actions))

    def _openings(self, rows: Tensor) -> tuple[Tensor, Tensor] | None:
        if not bool((self.phase == int(Phase.CLOSES)).any()):
            return None
        now = self._opening[rows]
        closes = self.phase[rows] == int(Phase.CLOSES)
        after = torch.maximum(now - CLOSING_M_S * self.step_s, self._shut[rows])
        return now, torch.where(closes, after, now)

    def _on_the_way(self, rows: Tensor, before: Tensor) -> None:
        """Ends what meets the table, itself or the object in this step, and moves the fingers."""
        rows = rows[self.ends[rows] == int(End.RUNNING)]
        moved = rows[(before[rows] != self.q[rows]).any(1)]
        way = torch.stack([before[moved], self.q[moved]], 1)
        met = moved[~self._meets_nothing(moved, way)]
        for phase, why in (
            (Phase.RESTS, PickReason.APPROACH_COLLIDES),
            (Phase.LIFTS, PickReason.LIFT_COLLIDES),
        ):
            self._pick[met[self.phase[met] == int(phase)]] = int(why)
        self._finish(met, End.COLLISION, Why.IN_THE_WAY)
        rows = rows[self.ends[rows] == int(End.RUNNING)]
        closing = rows[self.phase[rows] == int(Phase.CLOSES)]
        if len(closing):
            gap = self._opening[closing] - CLOSING_M_S * self.step_s
            self._opening[closing] = torch.maximum(gap, self._shut[closing])
            shut = closing[self._opening[closing] == self._shut[closing]]
            self.phase[shut] = int(Phase.LIFTS)
        lifting = rows[self.phase[rows] == int(Phase.LIFTS)]
        if len(lifting):
            up = self._low_m(lifting, self.q[lifting]) >= LIFTED_M
            self.phase[lifting[up]] = int(Phase.CARRIES)
            self._pick[lifting[up]] = int(PickReason.OK)
        rests = rows[self.phase[rows] == int(Phase.RESTS)]
        self._close(rests[self._asked[rests] & (self.qd[rests] == 0).all(1)])

    def _close(self, rows: Tensor) -> None:
        """Begins to close the grippers of rows whose arm has come to rest; ends those that hold nothing by that."""
        if not len(rows):
            return
        T_world_ee = self.T_world_ee[rows]
        grasp = se3.matmul(se3.inverse(self._T_rest[rows].double()), T_world_ee)
        grasp = se3.orthonormalise(grasp).float().contiguous()
        self._T_obj_ee_made[rows] = grasp
        posed = self._posed(grasp, T_world_ee.float(), self.trials[rows])
        stability, affordance = (CRITERIA.index(name) for name in ("stability", "affordance"))
        held = posed.passed[:, stability]
        found = posed.opening_m.isfinite() & posed.grasp_shift_m.isfinite()
        self._shut[rows] = torch.where(found, posed.opening_m, 0.0)
        self._attached[rows] = attach(grasp, torch.where(found, posed.grasp_shift_m, 0.0))
        self._blocked[rows] = posed.evaluated[:, affordance] & ~posed.passed[:, affordance]
        self._pick[rows[~held]] = int(PickReason.NOT_HELD)
        self._finish(rows[~held], End.DROP, Why.NOT_HELD)
        rows, grasp = rows[held], grasp[held]
        objects = self.trials.object_index[rows]
        room = closing_room(self.scene, grasp, self._T_rest[rows], objects, self.q[rows])
        met = rows[room <= 0]
        self._pick[met] = int(PickReason.CLOSING_COLLIDES)
        self._finish(met, End.COLLISION, Why.IN_THE_WAY)
        self.phase[rows[room > 0]] = int(Phase.CLOSES)

    # --- what is met ---------------------------------------------------------------------------------------------

    def _met_on_all_the_way(self, rows: Tensor) -> Tensor:
        return rows[:0]  # `_on_the_way` looks at each step

    def _meets_nothing(self, rows: Tensor, motion: Float32[Tensor, "r s j"]) -> Tensor:
        """Whether motions are certified free of what their phase may not meet."""
        free = torch.ones(len(rows), dtype=torch.bool, device=self._device)
        phase = self.phase[rows]
        for which, look in (
            (phase <= int(Phase.CLOSES), self._comes_free),
            (phase == int(Phase.LIFTS), self._lifts_free),
            (phase == int(Phase.CARRIES), super()._meets_nothing),
        ):
            if bool(which.any()):
                free[which] = look(rows[which], motion[which])
        return free

    def _comes_free(self, rows: Tensor, motion: Tensor) -> Bool[Tensor, " r"]:
        """The empty robot: of table and itself; the arm of the resting object's convex bodies, the open gripper of its solid."""
        bare = self._bare(rows)
        beside = among(self.scene, bare, self._arm_and_resting, rows)
        free = self._clear(replace(bare, world=self._robot_alone.world), motion)
        free &= self._clear(beside, motion)
        for k in range(motion.shape[1] - 1):
            some = torch.nonzero(free).flatten()
            room = self._solid_room(rows[some], motion[some, k], motion[some, k + 1])
            free[some[room < 0]] = False
        return free

    def _lifts_free(self, rows: Tensor, motion: Tensor) -> Bool[Tensor, " r"]:
        """The closed robot: of table and itself; the held object of the robot. The object goes no deeper into the table than
        the pads give."""
        bare = self._bare(rows)
        free = self._clear(replace(bare, world=self._robot_alone.world), motion)
        free &= self._clear(replace(bare, world=self._above_table.world), motion)
        most = self.scene.config.thresholds.pad_squeeze_m + TOLERANCE_M
        for k in range(motion.shape[1] - 1):
            low = self._lowest_m(rows, motion[:, k], motion[:, k + 1], bare)
            free &= low >= -most
        return free

    def _bare(self, rows: Tensor) -> BodyPoses:
        """Bodies of these rows with the gripper as it is."""
        trials = self.trials
        return self.scene.body_poses(
            trials.object_index[rows], trials.hand_index[rows], self._attached[rows],
            trials.T_world_hand[rows], self._opening[rows],
        )  # fmt: skip

    def _clear(self, bodies: BodyPoses, motion: Tensor) -> Bool[Tensor, " r"]:
        length = torch.full((len(motion),), motion.shape[1], dtype=torch.int32, device=self._device)
        found, _, _ = path_clearances(
            self.scene, bodies, motion.contiguous(), length, cap_m=CUT_CAP_M, depths=False
        )
        return found > 0

    def _solid_room(self, rows: Tensor, q0: Tensor, q1: Tensor) -> Float32[Tensor, " r"]:
        """Smallest clearance of the open gripper from the resting object's solid on the way from one posture to another, m."""
        T_obj_world = se3.inverse(self._T_rest[rows].double())
        objects = self.trials.object_index[rows].to(torch.int32)
        far = self._distance.robot_travel(q1 - q0)
        cap = CUT_CAP_M + 0.5 * self._most_m / PARTS

        def measure(i: Tensor, s: Tensor) -> Tensor:
            T, _ = ee_and_jacobian(self.scene.robot, q0[i] + s[:, None] * (q1[i] - q0[i]))
            grasp = se3.matmul(T_obj_world[i], T).float().contiguous()
            tables = self.scene.grasp_tables
            return open_clearance(tables, grasp, objects[i].contiguous(), cap_m=cap, known=True)[0]

        def travel(i: Tensor, low: Tensor, middle: Tensor, high: Tensor) -> Tensor:
            return far[i] * torch.maximum(middle - low, high - middle)

        every = torch.arange(len(rows), dtype=torch.int64, device=self._device)
        return least_along(measure, travel, every, len(rows), parts=PARTS, cap_m=CUT_CAP_M)[0]

    def _lowest_m(self, rows: Tensor, q0: Tensor, q1: Tensor, bare: BodyPoses) -> Tensor:
        """As `_low_m`, the smallest on the way from one posture to another."""
        turned = (q1 - q0).abs()
        radius = bare.object_motion_radius
        far = radius[:, 0] * turned[:, 0]
        for k in range(1, turned.shape[1]):
            far = far + radius[:, k] * turned[:, k]

        def measure(i: Tensor, s: Tensor) -> Tensor:
            return self._low_m(rows[i], q0[i] + s[:, None] * (q1[i] - q0[i]))

        def travel(i: Tensor, low: Tensor, middle: Tensor, high: Tensor) -> Tensor:
            return far[i] * torch.maximum(middle - low, high - middle)

        every = torch.arange(len(rows), dtype=torch.int64, device=self._device)
        return least_along(measure, travel, every, len(rows), parts=1, cap_m=LIFTED_M)[0]

    def _low_m(self, rows: Tensor, q: Tensor) -> Float32[Tensor, " r"]:
        """How far the lowest point of the held object is above the table's top, m."""
        T, _ = ee_and_jacobian(self.scene.robot, q)
        T_world_obj = se3.matmul(T, se3.inverse(self._attached[rows].double()))
        high = T_world_obj[:, None, 2, 3].clone()
        for k in range(3):
            high = high + T_world_obj[:, None, 2, k] * self._hull[rows, :, k]
        return (high.amin(1) - self._top_m).float()

    # --- the end -------------------------------------------------------------------------------------------------

    def _posed(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> Scores:
        """The objects of these poses rested where they did, wherever the receivers are now."""
        known = known_moments(self.scene)
        rest = {int(i): T for i, T in zip(self.trials.trial_id, self._T_rest, strict=True)}
        known.tell(trials, torch.stack([rest[int(i)] for i in trials.trial_id]))
        try:
            return super()._posed(T_obj_ee, T_world_ee, trials)
        finally:
            known.forget(trials)

    def _receive(self, rows: Tensor, gone_m: Tensor) -> None:
        super()._receive(rows[self.phase[rows] == int(Phase.CARRIES)], gone_m)

    def _finish(self, rows: Tensor, end: End, why: Why) -> None:
        if why == Why.HELD_OUT:
            rows = self._given_to(rows)
        super()._finish(rows, end, why)

    def _offer(self, rows: Tensor) -> None:
        super()._offer(self._given_to(rows))

    def _given_to(self, rows: Tensor) -> Tensor:
        """Rows whose object, as it is held out, passes what the benchmark asks about the giving; ends the others."""
        asks = self.evaluator.benchmark.asks
        if not len(rows) or "received" not in asks:
            return rows
        posed = self._posed(
            self._grasped(rows), self.T_world_ee[rows].float(), self._trials_now(rows)
        )
        assert isinstance(posed, GivenScores) and posed.inputs is not None
        # the way was judged step by step, and Reach and Affordance with it
        so_far = replace(
            posed,
            q_goal=self.q[rows],
            success=torch.ones_like(posed.success),
            outcome=torch.full_like(posed.outcome, int(Outcome.SUCCESS)),
        )
        found, names = given(so_far.with_inputs(posed.inputs)), posed.criteria
        received = found.passed[:, names.index("received")]
        super()._finish(rows[~received], End.NOT_RECEIVED, Why.NO_GRASP)
        return rows[received]

    def _observe(self) -> dict[str, Tensor]:
        return super()._observe() | {
            "T_world_obj": self.T_world_obj,
            "gripper": self._opening.clone(),
            "phase": self.phase.float(),
            "T_obj_ee": self._T_obj_ee.clone(),
        }

    def _info(self, before: Tensor | None) -> dict[str, Any]:
        info = super()._info(before)
        margin = self.scores.margin.cpu().numpy()
        info["margins"] = {name: margin[:, i] for i, name in enumerate(self.scores.criteria)}
        ends, phases = self.ends.cpu().numpy(), self.phase.cpu().numpy()
        whys = self._why.cpu().numpy()
        words = [_outcome(*row) for row in zip(ends, whys, phases, strict=True)]
        picks = [PickReason(int(x)).name.lower() for x in self._pick.cpu()]
        return info | {"outcome": np.array(words), "pick_reason": np.array(picks)}


def _outcome(end: int, why: int, phase: int) -> str:
    """The first criterion that an episode fails, in the benchmark's order."""
    lifted = phase == int(Phase.CARRIES)
    of_end = {
        End.RUNNING: "",
        End.SUCCESS: "success",
        End.CONTACT: "safe",
        End.COLLISION: "plan" if lifted else "pick",
        End.DROP: "stability",
        End.NOT_RECEIVED: "affordance" if why == Why.FINGERS_ON_REGION else "received",
        End.TIMEOUT: "reach" if lifted else "pick",
    }
    return of_end[End(end)]
