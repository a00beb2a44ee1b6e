"""`HandoverEnv`: handovers in closed loop, kinematic, as a Gymnasium vector environment.

The object is in the gripper and the arm at home when an episode begins. Each step the policy sees the
hand as a camera does (noise, latency, drop-outs) and says how to go on. Torch throughout, on the scene's
device; a row does not depend on its batch. Definitions: docs/receivers.md, "Receivers that move".
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float32, Int8
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.validate import validate_fields
from r2h_batch.closed_loop.arm import ee_and_jacobian, joint_speeds, twist_between
from r2h_batch.closed_loop.moving import MovingHands, ReceiverMotion
from r2h_batch.closed_loop.relative import CAP_M, Passed, RelativeDistance
from r2h_batch.judge.distance import person_distance
from r2h_batch.judge.grasp import attach
from r2h_batch.judge.metrics import reach_distance
from r2h_batch.judge.motion.execute import nothing_pushes
from r2h_batch.judge.motion.time_law import limits
from r2h_batch.judge.reception import reception
from r2h_batch.scene.person import with_person
from r2h_batch.scene.scene import BodyPoses
from r2h_batch.trials.noise import PredictorNoise, perturbed, trial_ids
from r2h_batch.types import CRITERIA, Scores

Action = Literal["velocity", "twist", "pose", "posture"]
"""Kinds of a policy's actions: joint speeds (rad/s); speed and turn of the ee (m/s, rad/s, world
axes); the ee's target pose (T_world_ee); the posture at the step's end (rad). The arm goes as far
towards it as its limits let it."""

FRAME_SHARE = 0.2
"""Noise of each frame, as a share of the noise per trial to which it is added [choice]."""
EE_SPEED_M_S, EE_TURN_RAD_S, GAIN_S = 0.25, 1.0, 1.5
"""With which an asked pose is approached [choice]: gain per second up to this speed and turn."""
REST_M_S = 0.03
"""Slower than this, TCP and hand stand well enough for the object to be taken [choice]."""
HELD_OUT_S = 0.1
"""The object must be within reach, with robot and hand at rest, for this time (HandoverSim, Chao et
al. 2022)."""
STAYED_M = 0.01
"""While it is taken the object goes no farther."""
HUMAN_M_S, REACTION_S, STOP_S, INTRUSION_M = 1.6, 0.1, 0.3, 0.0
"""ISO/TS 15066, 5.5.4: speed of a person, the robot's reaction and stopping time [choice], C + Z_d + Z_r."""
HAND_N, HAND_KG, HAND_N_M = 280.0, 0.6, 75e3
"""ISO/TS 15066, annex A, from memory: transient force, mass and stiffness of a hand."""


MOST = 1e3
"""No number that is seen is larger."""


class End(IntEnum):
    """How an episode ends."""

    RUNNING = 0
    SUCCESS = 1
    CONTACT = 2
    """robot and receiver touched before the hand took the object"""
    COLLISION = 3
    """the robot or the object came to the table, or the robot to itself or to the object"""
    DROP = 4
    """the gripper does not hold the object (Stability)"""
    NOT_RECEIVED = 5
    """the object is held out within reach, but the hand cannot take it: fingers are on the receiver's region
    (Affordance), no grasp of the hand is free (motion takes), or the robot did not hold still (motion takes)"""
    TIMEOUT = 6


@dataclass(frozen=True)
class LoopConfig:
    """How a closed loop runs.

    Attributes:
        rate_hz: steps a second, 10 to 50.
        horizon_s: longest duration of an episode, s.
        latency_s: age of an observation, s; rounded to whole steps.
        noise: factor on the error model of the hand (`PredictorNoise`); 0: exact.
        dropout: share of frames without a hand; the policy then sees the last hand again.
        seed: of noise and drop-outs.
    """

    rate_hz: int = 20
    horizon_s: float = 15.0
    latency_s: float = 0.1
    noise: float = 1.0
    dropout: float = 0.05
    seed: int = 0

    def __post_init__(self) -> None:
        validate_fields(self)
        ranges = {
            "rate_hz": (10, 50),
            "horizon_s": (1, 600),
            "latency_s": (0, 5),
            "noise": (0, 100),
            "dropout": (0, 0.95),
        }
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(
                    f"LoopConfig.{name} is {getattr(self, name)}; allowed is {low} to {high}"
                )


@dataclass(frozen=True)
class Episodes:
    """Outcomes of B episodes. Times are in s from the beginning. NaN: the event did not happen.

    Attributes:
        end: `End`.
        robot_touched: of contacts, True if the robot caused the contact, False if the hand did.
        time_s: end of the episode; of a success the handover time.
        least_m: least distance of robot and hand at the steps, at most `CAP_M`; with `receiver="body"` of arm and
            torso too.
        slack_m: certified: between steps the distance to the hand is at most this much below `least_m`.
        near_speed_m_s: largest speed of the robot, a bound for its fastest point, within `CAP_M` of the hand.
        ssm_s: how long robot and hand were nearer than ISO/TS 15066's protective distance.
        ssm_depth_m: largest shortfall from that protective distance.
        pfl_share: `near_speed_m_s` divided by the speed that reaches ISO/TS 15066's transient force limit of a hand.
        robot_idle: share of the time in which the robot stands (Hoffman 2019).
        human_idle: share of the time in which the hand stands.
        concurrent: share in which both move.
        delay: share in which neither moves: one waits for the other (functional delay).
        hand_path_m: length of the wrist's path.
    """

    end: Int8[Tensor, " b"]
    robot_touched: Bool[Tensor, " b"]
    time_s: Float32[Tensor, " b"]
    least_m: Float32[Tensor, " b"]
    slack_m: Float32[Tensor, " b"]
    near_speed_m_s: Float32[Tensor, " b"]
    ssm_s: Float32[Tensor, " b"]
    ssm_depth_m: Float32[Tensor, " b"]
    pfl_share: Float32[Tensor, " b"]
    robot_idle: Float32[Tensor, " b"]
    human_idle: Float32[Tensor, " b"]
    concurrent: Float32[Tensor, " b"]
    delay: Float32[Tensor, " b"]
    hand_path_m: Float32[Tensor, " b"]


class HandoverEnv(VectorEnv):
    """B handovers whose receivers move.

    Observations (a dict of float32 tensors, B rows): `time` s; `q`, `qd` joint angles and speeds; `T_world_ee`;
    `T_world_hand` and `hand_joints` (16, 3) as the camera has them, `age` s of that frame; `gap` m, distance of the
    robot from that hand (`receiver="body"`: and its arm), `CAP_M` at most; `T_hand_ee`, the handover pose that the
    method asked for, in the frame of the hand that it was asked for. With `privileged`: `true_T_world_hand`,
    `true_gap`. Reward: 1 for a success, -1 for a contact, a collision or a drop, less a tenth of the horizon's share
    that a step takes.

    Rows that have ended stand still until `reset`; nothing resets by itself.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012

    def __init__(
        self,
        scores: Scores,
        motion: ReceiverMotion | str = "moves",
        *,
        config: LoopConfig | None = None,
        action: Action = "velocity",
        privileged: bool = False,
    ) -> None:
        """The handovers of a call of `Evaluator.score`.

        Args:
            scores: B rows with their inputs: trials, grasps, handover poses, planned paths.
            motion: of the receivers, or its name.
            config: how the loop runs.
            action: what the policy says.
            privileged: whether observations hold the truth too.

        Raises:
            ValueError: the scores hold no inputs, or their Evaluator has an execution error.
        """
        if (inputs := scores.inputs) is None:
            raise ValueError("these scores hold no inputs; score again")
        self.evaluator, self.trials = inputs.evaluator, inputs.trials
        if self.evaluator.config.execution_error.any:
            raise ValueError(
                "a closed loop has no execution_error; score with an Evaluator without it"
            )
        if action not in get_args(Action):
            raise ValueError(f"action is {action!r}; allowed are {', '.join(get_args(Action))}")
        self.scores, self.config, self.action = scores, config or LoopConfig(), action
        self.motion = ReceiverMotion.parse(motion) if isinstance(motion, str) else motion
        self.privileged, self.scene = privileged, self.evaluator.scene
        self._sees_person = self.evaluator.config.receiver == "body"
        self.num_envs, self.step_s = len(scores), 1.0 / self.config.rate_hz
        self._device = torch.device(self.scene.device)
        joints, law = len(self.scene.robot.joints), self.scene.config.execute
        self.speed, self.acceleration = limits(law)
        self.brake = law.max_acceleration_rad_s2
        robot = self.scene.robot
        # speed, acceleration and brake are the slowest joint's; another one's are 1 / weight times as high
        self.weight = torch.tensor(
            np.array(robot.joint_weight), dtype=torch.float64, device=self._device
        )
        self._lower, self._upper = (
            torch.tensor(np.array(x), dtype=torch.float32, device=self._device)
            for x in (robot.lower, robot.upper)
        )
        shapes = {"time": (), "q": (joints,), "qd": (joints,), "T_world_ee": (4, 4), "T_world_hand": (4, 4),
                  "hand_joints": (16, 3), "age": (), "gap": (), "T_hand_ee": (4, 4)}  # fmt: skip
        if privileged:
            shapes |= {"true_T_world_hand": (4, 4), "true_gap": ()}
        self.single_observation_space = Dict(
            {k: Box(-MOST, MOST, shape, np.float32) for k, shape in shapes.items()}
        )
        most = np.float32(self.speed / robot.joint_weight)
        self.single_action_space = {
            "velocity": Box(-most, most),
            "twist": Box(-1.0, 1.0, (6,), np.float32),
            "pose": Box(-10.0, 10.0, (4, 4), np.float32),
            "posture": Box(np.float32(robot.lower), np.float32(robot.upper)),
        }[action]
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._hold()

    def _hold(self) -> None:
        """Sets what all episodes share: the grasp and the pose that was asked."""
        inputs, scores = self.scores.inputs, self.scores
        assert inputs is not None
        shut = scores.opening_m.isfinite() & scores.grasp_shift_m.isfinite()
        self._held = shut & scores.passed[:, CRITERIA.index("stability")]
        eye = torch.eye(4, dtype=torch.float32, device=self._device)
        grasp, pose = (
            se3.orthonormalise(torch.where(shut[:, None, None], T.to(self._device), eye))
            for T in (inputs.T_obj_ee, inputs.T_world_ee)
        )
        self._attached = attach(grasp, torch.where(shut, scores.grasp_shift_m, 0.0)).contiguous()
        self._opening = torch.where(shut, scores.opening_m, 0.0).contiguous()
        hand = self.trials.T_world_hand.double()
        self._T_hand_ee = se3.matmul(se3.inverse(hand), pose.double()).float()
        self._distance = RelativeDistance(self.scene, self.trials, self._attached, self._opening)
        affordance = CRITERIA.index("affordance")
        self._blocked = scores.evaluated[:, affordance] & ~scores.passed[:, affordance]
        self._index = self.trials.hand_index.long().to(self._device)
        self._joints = self.scene.hands.joints.to(self._device)[self._index]
        self._pivot = self.scene.palms[0][self._index]

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The beginning of all episodes. `seed` (one number): of noise and receivers, in place of theirs."""
        if seed is not None:
            number = (
                seed if isinstance(seed, int) else int(next((s for s in seed if s is not None), 0))
            )
            self.config = replace(self.config, seed=number)
            self.motion = replace(self.motion, seed=number)
            self._np_random = np.random.default_rng(number)
        b, device = self.num_envs, self._device
        self.hands = MovingHands.of(self.scene, self.trials, self.motion)
        self.k, self.time_s = 0, 0.0
        home = torch.tensor(self.scene.config.workplace.home_q, dtype=torch.float32, device=device)
        self.q = home.expand(b, -1).clone()
        self.qd = torch.zeros_like(self.q)
        self.ends = torch.where(self._held, int(End.RUNNING), int(End.DROP)).to(torch.int8)
        zero = torch.zeros(b, dtype=torch.float32, device=device)
        self._sums = {k: zero.clone() for k in ("robot", "hand", "both", "ssm", "path", "held_out")}
        self._worst = {k: zero.clone() for k in ("near_speed", "depth", "slack")}
        self._ended_s = torch.where(self._held, torch.inf, 0.0).float()
        self._by_robot = torch.zeros(b, dtype=torch.bool, device=device)
        self._at_take = zero.new_zeros(b, 3)
        self.T_world_ee, _ = ee_and_jacobian(self.scene.robot, self.q)
        T = self.hands.pose(0.0)
        every = torch.arange(b, dtype=torch.int64, device=device)
        self.gap = self._apart(every, self.q, T)
        self._least = self.gap.clone()
        self._finish(every[self._held & (self.gap <= 0)], End.CONTACT)
        self.T_world_hand = T
        self._poses, self._postures = [T], [self.q]
        self._bias = self._error(0, 1.0)
        self._last_seen = torch.zeros(b, dtype=torch.int64, device=device)
        return self._observe(), {}

    def step(
        self, actions: Tensor | np.ndarray
    ) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]:
        """One step of every episode that runs; the others stand. Actions as `action` says, (B, ...)."""
        with self.evaluator.working():
            return self._step(actions)

    def _step(
        self, actions: Tensor | np.ndarray
    ) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]:
        actions = torch.as_tensor(actions, device=self._device)
        running = self.ends == int(End.RUNNING)
        rows = torch.nonzero(running).flatten()
        first, last = self.time_s, (self.k + 1) * self.step_s
        q, qd = self.moved(actions, rows)
        T = self.hands.pose(last)
        moved = self.hands.moving(first, last - first)
        passed = self._distance.over_step(
            rows, (self.q[rows], q), self.hands, (first, last), self.gap[rows]
        )
        if self._sees_person and len(rows):
            near = self._from_person(rows, torch.stack([self.q[rows], q], 1), T[rows])
            gap, least = (torch.minimum(x, near) for x in (passed.gap_m, passed.least_m))
            passed = Passed(gap, least, passed.touch | (near <= 0))
        self._count(rows, q, T, moved, passed)
        before, self.T_world_hand = self.T_world_hand, T
        old, place = self.q, self.T_world_ee[:, :3, 3]
        self.q, self.qd, self.gap = self.q.clone(), torch.zeros_like(self.qd), self.gap.clone()
        self.q[rows], self.qd[rows], self.gap[rows] = q, qd.float(), passed.gap_m
        self.k, self.time_s = self.k + 1, last
        self._poses.append(T)
        self._postures.append(self.q)
        self.T_world_ee, _ = ee_and_jacobian(self.scene.robot, self.q)
        gone = self.T_world_ee[:, :3, 3] - place

        touched = rows[passed.touch & ~self.hands.taking[rows]]
        if len(touched):
            # with the other left where it was, the one that ends nearer brought them together
            robot = self._apart(touched, self.q[touched], before[touched])
            self._by_robot[touched] = robot < self._apart(touched, old[touched], T[touched])
            self._finish(touched, End.CONTACT)
        self._receive(rows, se3.dot(gone, gone).sqrt())
        if last >= self.config.horizon_s - 1e-9:
            self._finish(torch.nonzero(self.ends == int(End.RUNNING)).flatten(), End.TIMEOUT)
        self.hands.react(last, self.gap)
        return self._observe(), *self._outcome(running), {}

    def _outcome(self, running: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reward, terminated, truncated."""
        late, success = self.ends == int(End.TIMEOUT), self.ends == int(End.SUCCESS)
        over = self.ends != int(End.RUNNING)
        bad = over & ~late & ~success & (self.ends != int(End.NOT_RECEIVED))
        reward = success.float() - bad.float() - 0.1 * self.step_s / self.config.horizon_s
        return torch.where(running, reward, 0.0), over & ~late, late

    # --- the robot -----------------------------------------------------------------------------------------------

    def moved(self, actions: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Postures (rad) of `rows` at the end of one step with actions (B rows), as near to the
        actions as limits of speed, acceleration and joints allow, and the joint speeds (rad/s). An
        asked posture that they allow is reached bit for bit."""
        dt, q, old, target = self.step_s, self.q[rows], self.qd[rows].double(), actions[rows]
        if self.action == "velocity":
            v = target.double()
        elif self.action == "posture":
            v = (target.double() - q.double()) / dt
        else:
            T, jacobian = ee_and_jacobian(self.scene.robot, q)
            twist = target.double()
            if self.action == "pose":
                twist = GAIN_S * twist_between(T, se3.orthonormalise(twist))
                way, turn = (se3.dot(x, x).sqrt() for x in (twist[:, :3], twist[:, 3:]))
                over = torch.maximum(way / EE_SPEED_M_S, turn / EE_TURN_RAD_S).clamp(min=1.0)
                twist = twist / over[:, None]
            v = joint_speeds(jacobian, twist)
        v = torch.nan_to_num(v, nan=0.0)
        v = v / (self._fastest(v) / (self.speed * (1 + 1e-3))).clamp(min=1.0)
        dv = v - old
        slower = (v.abs() <= old.abs()) & (v * old >= 0)
        most = torch.where(slower, self.brake, self.acceleration) * dt * (1 + 1e-3) + 1e-5
        share = (
            (most / (dv.abs() * self.weight).clamp(min=1e-12)).amin(1, keepdim=True).clamp(max=1.0)
        )
        v = old + share * dv
        to = (q.double() + v * dt).float()
        if self.action == "posture":
            exact = ((to - target).abs() <= 1e-6).all(1, keepdim=True)
            to = torch.where(exact, target.float(), to)
        to = torch.minimum(torch.maximum(to, self._lower), self._upper)
        return to, (to.double() - q.double()) / dt

    def keeps_off(self, actions: Tensor) -> Bool[Tensor, " b"]:
        """Whether the step of these actions, and the way to a stop after it, are free of table,
        robot and object: a robot knows these. The receiver is not looked at. An arm that stands
        where it is False meets nothing."""
        rows = torch.nonzero(self.ends == int(End.RUNNING)).flatten()
        q, v = self.moved(torch.as_tensor(actions, device=self._device), rows)
        stop = q + (v * self._fastest(v) / (2.0 * self.brake)).float()
        stop = torch.minimum(torch.maximum(stop, self._lower), self._upper)
        way = torch.stack([self.q[rows], q, stop], 1)
        free = torch.ones(self.num_envs, dtype=torch.bool, device=self._device)
        with self.evaluator.working():
            free[rows] = self._meets_nothing(rows, way)
        return free

    def _fastest(self, v: Tensor) -> Tensor:
        """The largest of joint speeds (r, j) by its weight: (r, 1)."""
        return (v.abs() * self.weight).amax(1, keepdim=True)

    def _meets_nothing(self, rows: Tensor, motion: Float32[Tensor, "r s j"]) -> Tensor:
        """Whether motions are certified free of table, robot and object."""
        length = torch.full((len(rows),), motion.shape[1], dtype=torch.int32, device=self._device)
        off = torch.zeros(len(rows), dtype=torch.float32, device=self._device)
        bodies = self.bodies(self.T_world_hand[rows], rows)
        return nothing_pushes(self.scene, bodies, motion, length, off)

    # --- what happens --------------------------------------------------------------------------------------------

    def _count(self, rows: Tensor, q: Tensor, T: Tensor, moved: Tensor, passed: Any) -> None:
        """Adds a step to the columns."""
        dt, s, w = self.step_s, self._sums, self._worst
        speed = self._distance.robot_travel(q - self.q[rows]) / dt
        hand, robot = moved[rows], (q != self.q[rows]).any(1)
        s["robot"][rows] += dt * robot
        s["hand"][rows] += dt * hand
        s["both"][rows] += dt * (robot & hand)
        s["path"][rows] += (T[rows, :3, 3] - self.T_world_hand[rows, :3, 3]).square().sum(1).sqrt()
        protective = (
            HUMAN_M_S * (REACTION_S + STOP_S)
            + speed * REACTION_S
            + 0.5 * speed * STOP_S
            + INTRUSION_M
        )
        near = passed.gap_m < CAP_M
        inside = robot & near & (passed.gap_m < protective)
        s["ssm"][rows] += dt * inside
        for name, value in (
            ("near_speed", torch.where(near, speed, 0.0)),
            ("depth", torch.where(inside, protective - passed.gap_m, 0.0)),
        ):
            w[name][rows] = torch.maximum(w[name][rows], value)
        self._least[rows] = torch.minimum(self._least[rows], passed.gap_m)
        low = torch.minimum(self._least[rows] - w["slack"][rows], passed.least_m)
        w["slack"][rows] = self._least[rows] - low

    def _receive(self, rows: Tensor, gone_m: Tensor) -> None:
        """Ends the episodes in which the object was held out, or was taken; `gone_m`: of the TCP in this step."""
        rows = rows[self.ends[rows] == int(End.RUNNING)]
        rest = gone_m[rows] <= REST_M_S * self.step_s
        taking = self.hands.taking[rows]
        self._taken(rows[taking], rest[taking])
        still = (
            self.hands.travel(self.time_s - self.step_s, self.time_s)[rows]
            <= REST_M_S * self.step_s
        )
        rows, both = rows[~taking], (rest & still)[~taking]
        ready = torch.zeros_like(both)
        near = rows[both]
        if len(near):
            ready[both] = self._within_reach(near) >= 0
        held = self._sums["held_out"]
        held[rows] = torch.where(ready, held[rows] + self.step_s, 0.0)
        out = rows[held[rows] >= HELD_OUT_S - 1e-6]
        self._finish(out[self._blocked[out]], End.NOT_RECEIVED)
        out = out[~self._blocked[out]]
        if self.motion.kind == "takes":
            self._offer(out)
        else:
            self._finish(out, End.SUCCESS)

    def _within_reach(self, rows: Tensor) -> Tensor:
        """Margin of Reach with hands and robot where they are, m."""
        T_world_obj = se3.matmul(self.T_world_ee[rows], se3.inverse(self._attached[rows].double()))
        T = self.T_world_hand[rows]
        center = self.scene.palm(self.trials.hand_index[rows], T)[2]
        ball = se3.apply(se3.inverse(T_world_obj), center.double()).float().contiguous()
        objects = self.trials.object_index[rows].to(torch.int32).contiguous()
        far = reach_distance(self.scene, objects, ball)
        return self.scene.config.thresholds.reach_radius_m - far

    def _offer(self, rows: Tensor) -> None:
        """Hands set out for the easiest grasp of the object as it is held out; where there is none the episode
        ends."""
        if not len(rows):
            return
        inputs = self.scores.inputs
        assert inputs is not None
        T, person = self.T_world_ee[rows], self.receiver
        trials = replace(
            self.trials[rows],
            T_world_hand=self.T_world_hand[rows],
            receiver=None if person is None else person[rows],
        )
        poses = inputs.T_obj_ee[rows], T.float()
        posed = self.evaluator.score(*poses, trials, stages="pose")
        found = posed.inputs
        assert found is not None
        reception_scores = reception(replace(posed, q_goal=self.q[rows]).with_inputs(found))
        self._finish(rows[~reception_scores.received], End.NOT_RECEIVED)
        some = rows[reception_scores.received]
        self.hands.take(self.time_s, some, reception_scores.T_world_hand[reception_scores.received])
        self._at_take[some] = T[reception_scores.received, :3, 3].float()

    def _taken(self, rows: Tensor, rest: Tensor) -> None:
        """Ends what is taken: a success where the robot has held still."""
        if not len(rows):
            return
        gone = (self.T_world_ee[rows, :3, 3].float() - self._at_take[rows]).square().sum(
            1
        ).sqrt() > STAYED_M
        self._finish(rows[gone], End.NOT_RECEIVED)
        there = ~gone & rest & (self.hands.taken_s[rows] <= self.time_s)
        self._finish(rows[there], End.SUCCESS)

    def _finish(self, rows: Tensor, end: End) -> None:
        """Ends episodes. One that came to nothing worse is looked at once more, all its way: does the robot meet
        itself, the table or the object?"""
        if not len(rows):
            return
        self.ends[rows], self._ended_s[rows] = int(end), self.time_s
        if end == End.CONTACT or self.k == 0:
            return
        free = self._meets_nothing(rows, torch.stack(self._postures, 1)[rows])
        self.ends[rows[~free]] = int(End.COLLISION)

    # --- what is seen --------------------------------------------------------------------------------------------

    @property
    def receiver(self) -> Float32[Tensor, "b 5 4"] | None:
        """The receivers' bodies now, arms with their hands (`Trials.receiver`)."""
        return self.hands.people(self.T_world_hand)

    def bodies(self, T_world_hand: Float32[Tensor, "r 4 4"], rows: Tensor) -> BodyPoses:
        """Bodies of some trials with their hands there, for the scene's functions."""
        trials = self.trials
        return self.scene.body_poses(
            trials.object_index[rows], trials.hand_index[rows], self._attached[rows], T_world_hand.contiguous(),
            self._opening[rows],
        )  # fmt: skip

    def obstacles(self, T_world_hand: Float32[Tensor, "r 4 4"], rows: Tensor) -> BodyPoses:
        """The same for a planner: with arm and torso where `receiver="body"`."""
        bodies = self.bodies(T_world_hand, rows)
        if not self._sees_person:
            return bodies
        receiver = self.hands.people(T_world_hand, rows)
        assert receiver is not None  # such an evaluator refuses trials without
        return with_person(self.scene, bodies, receiver, hand=True)

    def _apart(self, rows: Tensor, q: Tensor, T_world_hand: Tensor) -> Tensor:
        """Distances of robot and receiver, with the hands of these rows there, m."""
        hand = self._distance.at(rows, q, T_world_hand)
        if not self._sees_person or not len(rows):
            return hand
        return torch.minimum(hand, self._from_person(rows, q[:, None], T_world_hand))

    def _from_person(self, rows: Tensor, path: Tensor, T_world_hand: Tensor) -> Tensor:
        """Least distance of the robot on its way from arm and torso as they are with the hands there, m; inf: farther
        than 5 cm."""
        receiver = self.hands.people(T_world_hand, rows)
        assert receiver is not None
        length = torch.full((len(rows),), path.shape[1], dtype=torch.int32, device=self._device)
        bodies = self.bodies(T_world_hand, rows)
        found, part = person_distance(self.scene, bodies, receiver, path, length)
        return torch.where(part < 0, torch.inf, found)

    def _error(self, purpose: int, share: float) -> Tensor:
        """Errors of the seen hands in their own frames, (b, 4, 4)."""
        noise = PredictorNoise().scaled(self.config.noise * share)
        key = rng.key_of(f"seen in a closed loop {self.config.seed}")
        eye = torch.eye(4, dtype=torch.float32, device=self._device).expand(self.num_envs, 4, 4)
        return perturbed(
            eye, self._pivot, trial_ids(self.trials.trial_id), key, purpose=purpose,
            rotation_deg=noise.target_rotation_deg, translation_m=noise.target_translation_m,
        )  # fmt: skip

    def _observe(self) -> dict[str, Tensor]:
        """The policy's observations now."""
        k, c = self.k, self.config
        frame = max(0, k - round(c.latency_s * c.rate_hz))
        if frame > 0 or k == 0:  # a frame that is new
            key = rng.key_of(f"drop-outs {c.seed}")
            (u,) = rng.uniforms(key, trial_ids(self.trials.trial_id), 1, purpose=0, attempt=frame)
            lost = torch.from_numpy(u < c.dropout).to(self._device) & (frame > 0)
            error = se3.matmul(
                self._bias.double(), self._error(1 + frame % 60_000, FRAME_SHARE).double()
            )
            T_seen = se3.matmul(self._poses[frame].double(), error).float()
            if k == 0:
                self._seen = T_seen
            self._seen = torch.where(lost[:, None, None], self._seen, T_seen)
            self._last_seen = torch.where(lost, self._last_seen, frame)
        running = torch.nonzero(self.ends == int(End.RUNNING)).flatten()
        gap = torch.full_like(self.gap, CAP_M)
        gap[running] = self._apart(running, self.q[running], self._seen[running])
        b = self.num_envs
        found = {
            "time": torch.full((b,), self.time_s, dtype=torch.float32, device=self._device),
            "q": self.q.clone(),
            "qd": self.qd.clone(),
            "T_world_ee": self.T_world_ee.float(),
            "T_world_hand": self._seen.clone(),
            "hand_joints": se3.apply(self._seen[:, None], self._joints),
            "age": (self.k - self._last_seen).float() * self.step_s,
            "gap": gap,
            "T_hand_ee": self._T_hand_ee.clone(),
        }
        if self.privileged:
            found |= {"true_T_world_hand": self.T_world_hand.clone(), "true_gap": self.gap.clone()}
        return found

    # --- what came of it -----------------------------------------------------------------------------------------

    def episodes(self) -> Episodes:
        """Verdicts and columns as they are now."""
        s, w = self._sums, self._worst
        time_s = torch.where(self._ended_s.isinf(), self.time_s, self._ended_s)
        share = 1.0 / time_s.clamp(min=self.step_s)
        robot, hand, both = ((s[k] * share).clamp(max=1.0) for k in ("robot", "hand", "both"))
        arm_kg = float(np.sum(self.scene.robot.dynamics.mass))
        reduced = 1.0 / (1.0 / HAND_KG + 2.0 / arm_kg)
        allowed = HAND_N / float(np.sqrt(HAND_N_M * reduced))
        return Episodes(
            self.ends.clone(), self._by_robot.clone(), time_s, self._least.clone(), w["slack"].clone(),
            w["near_speed"].clone(), s["ssm"].clone(), w["depth"].clone(), w["near_speed"] / allowed,
            1.0 - robot, 1.0 - hand, both, (1.0 - robot - hand + both).clamp(min=0.0), s["path"].clone(),
        )  # fmt: skip

    def trace(self) -> tuple[Float32[Tensor, "b s j"], Float32[Tensor, "b s 4 4"]]:
        """Postures (rad) and T_world_hand at the beginning and after each step."""
        return torch.stack(self._postures, 1), torch.stack(self._poses, 1)


def single(env: HandoverEnv) -> "gymnasium.Env[Any, Any]":
    """A `HandoverEnv` of one handover as a plain Gymnasium environment with NumPy arrays, for libraries that
    know no vector environments."""
    if env.num_envs != 1:
        raise ValueError(f"this environment has {env.num_envs} handovers; a single one has 1")
    return _Single(env)


class _Single(gymnasium.Env[Any, Any]):
    def __init__(self, env: HandoverEnv) -> None:
        self.vector, self.metadata = env, {"render_modes": []}
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        return _numbers(self.vector.reset(seed=seed)[0]), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        observation, reward, ended, late, _ = self.vector.step(np.asarray(action)[None])
        return _numbers(observation), float(reward[0]), bool(ended[0]), bool(late[0]), {}


def _numbers(observation: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    return {k: np.array(x[0].cpu().numpy(), np.float32) for k, x in observation.items()}
