"""`HandoverEnv`: handovers in closed loop, kinematic, as a Gymnasium vector environment.

The object is in the gripper and the arm at home when an episode begins; where the benchmark asks for Pick, the arm is where
it has lifted the object from the table. Each step the policy sees the
hand as a camera does (noise, latency, drop-outs) and says how to go on. A row does not depend on its
batch. Definitions: docs/closed_loop.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Annotated, Any, Literal, TypeGuard, get_args

import gymnasium
import numpy as np
import torch
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float32, Float64, Int8
from pydantic import Field
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.io.progress import busy
from r2h_batch.base.validate import (
    boolean,
    describe_value,
    instance_of,
    integer,
    one_of,
    optional,
    suggest_names,
    validate_fields,
)
from r2h_batch.base.validate_tensors import as_numbers
from r2h_batch.closed_loop.arm import ee_and_jacobian, joint_speeds, twist_between
from r2h_batch.closed_loop.fingers import OwnHands
from r2h_batch.closed_loop.moving import MovingHands, ReceiverMotion, Taken, rows_of_seeds
from r2h_batch.closed_loop.registered import register
from r2h_batch.closed_loop.relative import CAP_M, Passed, RelativeDistance
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.distance import person_distance
from r2h_batch.judge.grasp import attach
from r2h_batch.judge.motion.execute import nothing_pushes
from r2h_batch.judge.motion.time_law import limits
from r2h_batch.judge.reach import reached
from r2h_batch.judge.reception import reception
from r2h_batch.scene.person import heads_of, with_person
from r2h_batch.scene.scene import BodyPoses
from r2h_batch.trials.holding.held_out import load_held_out
from r2h_batch.trials.noise import PredictorNoise, perturbed, trial_ids
from r2h_batch.types import CRITERIA, Scores, Trials

register()

Action = Literal["velocity", "twist", "pose", "posture"]
"""Kinds of a policy's actions: joint speeds (rad/s); speed and turn of the ee (m/s, rad/s, world
axes); the ee's target pose (T_world_ee); the posture at the step's end (rad). The arm goes as far
towards it as its limits let it."""

Output = Literal["numpy", "torch"]
"""Form of observations and rewards."""

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

MOST_SEED = (1 << 63) - 1

NEXT_EPISODE = 1 << 40
"""Added to a trial's number for the draws of each further round through the handovers."""


class End(IntEnum):
    """How an episode ends."""

    RUNNING = 0
    SUCCESS = 1
    CONTACT = 2
    """robot and receiver touched before the hand took the object"""
    COLLISION = 3
    """the robot or the object came to the table, or the robot to itself or to the object"""
    DROP = 4
    """the gripper does not hold the object (Stability), or where the benchmark asks for Pick, it was not lifted from the table"""
    NOT_RECEIVED = 5
    """the object is held out within reach, but the hand cannot take it: fingers are on the receiver's region
    (Affordance), gripper or a sharp part come to the hand first (Presented, where the benchmark asks for it), no grasp of the
    hand is free (motion takes), or the robot did not hold still (motion takes)"""
    TIMEOUT = 6


class Why(IntEnum):
    """The reasons of an end; `WORDS` says each in a sentence."""

    RUNNING = 0
    HELD_OUT = 1
    TAKEN = 2
    ROBOT_CAME = 3
    HAND_CAME = 4
    IN_THE_WAY = 5
    NOT_HELD = 6
    FINGERS_ON_REGION = 7
    NO_GRASP = 8
    NOT_STILL = 9
    LATE = 10
    NOT_PRESENTED = 11
    NOT_LIFTED = 12


WORDS = np.array(
    [
        "",
        "the object was within reach while robot and hand stood",
        "the hand took the object",
        "the robot came to the receiver",
        "the receiver came to the robot",
        "the robot met the table, itself or the object on its way",
        "the gripper does not hold the object",
        "the gripper's fingers are on the receiver's part of the object",
        "no grasp of the hand is free",
        "the object moved while the hand took it",
        "the horizon came first",
        "the wanted part was not what the hand came to first",
        "the plan does not lift the object from the table and carry it",
    ]
)
_NAMES = np.array([end.name.lower() for end in End])


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

    rate_hz: Annotated[int, Field(ge=10, le=50)] = 20
    horizon_s: Annotated[float, Field(ge=1, le=600)] = 15.0
    latency_s: Annotated[float, Field(ge=0, le=5)] = 0.1
    noise: Annotated[float, Field(ge=0, le=100)] = 1.0
    dropout: Annotated[float, Field(ge=0, le=0.95)] = 0.05
    seed: int = 0

    def __post_init__(self) -> None:
        validate_fields(self)


@dataclass(frozen=True)
class Episodes:
    """Outcomes of B episodes. Times are in s from the beginning. NaN: the event did not happen.

    Attributes:
        end: `End`.
        robot_touched: of contacts, True if the robot caused the contact, False if the hand did.
        time_s: end of the episode; of a success the handover time.
        least_m: least distance of robot and hand at the steps, at most `CAP_M`; with `receiver="body"` of arm,
            torso and head too. Until the hand sets out to take the object.
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
        overlap_m: largest overlap of hand and gripper at the steps while the hand takes the object; 0 where it takes
            nothing.
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
    overlap_m: Float32[Tensor, " b"]


def checked_motion(
    motion: ReceiverMotion | str,
    *,
    action: Action = "velocity",
    output: Output = "numpy",
    privileged: bool = False,
    autoreset: bool = False,
) -> ReceiverMotion:
    """The motion of the receivers, once it is known that the arguments of `HandoverEnv` are allowed.

    Args:
        motion: it, or its name.
        action: as of `HandoverEnv`, as are the next three.
        output: as there.
        privileged: as there.
        autoreset: as there.

    Raises:
        TypeError, ValueError: one of them is none that is allowed.
    """
    for name, switch in (("privileged", privileged), ("autoreset", autoreset)):
        boolean(name, switch)
    named = "the name of a motion, or ReceiverMotion(...)"
    instance_of((str, ReceiverMotion), named)("motion", motion)
    one_of(*get_args(Action))("action", action)
    one_of(*get_args(Output))("output", output)
    return ReceiverMotion.parse(motion) if isinstance(motion, str) else motion


class HandoverEnv(VectorEnv):
    """B handovers whose receivers move.

    Observations (a dict of float32 arrays, B rows): `time` s; `q`, `qd` joint angles and speeds; `T_world_ee`;
    `T_world_hand` and `hand_joints` (16, 3) as the camera has them, `age` s of that frame; `gap` m, distance of the
    robot from that hand (`receiver="body"`: and its arm), `CAP_M` at most; `T_hand_ee`, the handover pose that the
    method asked for, in the frame of the hand that it was asked for. With `privileged`: `true_T_world_hand`,
    `true_gap`. Reward: 1 for a success, -1 for a contact, a collision or a drop, less a tenth of the horizon's share
    that a step takes.

    `info` has for each row `end` (a name of `End` in small letters), `why` in words, `success`, `least_m` and
    `margins` (criterion -> m, or its other unit) of the plan that the episode began with. `_end` marks rows that end
    in this step.

    Without `autoreset`, rows that have ended stand still until `reset`, whose option `reset_mask` names rows (B,). With
    it, they begin their next episode in the step after their last one (`AutoresetMode.NEXT_STEP`).

    Which handover an episode plays depends on the row's seed, the row and the number of the row's episode, and on
    nothing that other rows or policies do: row i plays place (seed mod N + i + k B) mod N of the N `scores` in its k-th
    episode after a seed. Without `num_envs` row i stays with handover i. Noise and motion are drawn by the seed, the
    trial and how often the seed has been through all N, so a trial plays the same in every row.

    `infos["trial_id"]` names the handovers, and `reset(options={"trial_id": ...})` asks for some.

    The object is in the gripper on every benchmark. Where it asks for Pick, an episode begins where the plan has lifted the
    object from the table; a row whose plan does not lift and carry it ends at once (`drop`).
    """

    @suggest_names
    def __init__(
        self,
        scores: Scores,
        motion: ReceiverMotion | str = "moves",
        *,
        config: LoopConfig | None = None,
        action: Action = "velocity",
        privileged: bool = False,
        num_envs: int | None = None,
        output: Output = "numpy",
        autoreset: bool = False,
    ) -> None:
        """The handovers of a call of `Evaluator.score`.

        Args:
            scores: rows with their inputs: trials, grasps, handover poses, planned paths.
            motion: of the receivers, or its name.
            config: how the loop runs.
            action: what the policy says.
            privileged: whether observations hold the truth too.
            num_envs: B, handovers at once, at most the rows of `scores`; None: all.
            output: numpy arrays, or torch tensors on the scene's device.
            autoreset: whether rows that have ended begin their next episode.

        Raises:
            ValueError: the scores hold no inputs, or their Evaluator has errors of execution or of the object's pose.
        """
        if (inputs := scores.inputs) is None:
            raise ValueError("these scores hold no inputs; score again")
        self.motion = checked_motion(
            motion, action=action, output=output, privileged=privileged, autoreset=autoreset,
        )  # fmt: skip
        self.evaluator, n = inputs.evaluator, len(scores)
        for section in ("execution_error", "object_errors"):
            if getattr(self.evaluator.config, section).any:
                raise ValueError(
                    f"a closed loop has no {section}; score with an Evaluator without it"
                )
        optional(integer(1, n))("num_envs", num_envs)
        self._stays = num_envs is None
        self.pool, self.config, self.action = scores, config or LoopConfig(), action
        self.output, self.autoreset = output, autoreset
        mode = AutoresetMode.NEXT_STEP if autoreset else AutoresetMode.DISABLED
        self.autoreset_mode = mode  # TorchRL reads it here, Gymnasium in the metadata
        self.metadata = {**self.metadata, "autoreset_mode": mode}
        self.privileged, self.scene = privileged, self.evaluator.scene
        self._from_table = "pick" in self.scene.benchmark.asks
        self._holding = self.evaluator
        if self._from_table:  # how it is held out does not depend on how it was picked
            asks = tuple(a for a in self.scene.benchmark.asks if a == "presented")
            held = replace(self.scene.benchmark, asks=asks)
            self._holding = Evaluator(held, self.evaluator.config, device=self.scene.device)
        self._sees_person = self.evaluator.config.receiver == "body"
        self.num_envs, self.step_s = num_envs or n, 1.0 / self.config.rate_hz
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
        self._every = torch.arange(self.num_envs, dtype=torch.int64, device=self._device)
        self._seen_seeds = np.full(self.num_envs, self.config.seed, object)
        self._moved_seeds = np.full(self.num_envs, self.motion.seed, object)
        self._first_place = np.zeros(self.num_envs, np.int64)
        self._episode, self._round = (np.zeros(self.num_envs, np.int64) for _ in range(2))
        self._hold(self._every)
        self._begun = False

    def __reduce__(self) -> Any:
        """Refuses copies by pickle: judged scores leave their evaluator behind."""
        raise TypeError(
            "a HandoverEnv cannot be pickled or copied; make it where it runs, as gymnasium.make_vec does"
        )

    def _hold(self, rows: Tensor) -> None:
        """Puts these rows of the pool into the gripper: grasps, and poses that were asked."""
        self._row = rows
        self.scores = self.pool if len(rows) == len(self.pool) else self.pool[rows.cpu()]
        inputs, scores = self.scores.inputs, self.scores
        assert inputs is not None
        self.trials = inputs.trials
        shut = scores.opening_m.isfinite() & scores.grasp_shift_m.isfinite()
        person = self.trials.receiver
        self._heads = None if person is None else heads_of(person.to(self._device))
        self._held = shut & scores.passed[:, CRITERIA.index("stability")]
        home = torch.tensor(
            self.scene.config.workplace.home_q, dtype=torch.float32, device=self._device
        )
        self._begins_at = home.repeat(len(rows), 1)
        self._lifted = torch.ones_like(self._held)
        if self._from_table:
            self._lifted = scores.path_len > 0
            self._begins_at = torch.where(self._lifted[:, None], scores.path[:, 0], home)
        eye = torch.eye(4, dtype=torch.float32, device=self._device)
        grasp, pose = (
            se3.orthonormalise(torch.where(shut[:, None, None], T.to(self._device), eye))
            for T in (inputs.T_obj_ee, inputs.T_world_ee)
        )
        self._attached = attach(grasp, torch.where(shut, scores.grasp_shift_m, 0.0)).contiguous()
        self._opening = torch.where(shut, scores.opening_m, 0.0).contiguous()
        hand = self.trials.T_world_hand.double()
        self._T_hand_ee = se3.matmul(se3.inverse(hand), pose.double()).float()
        self._index = self.trials.hand_index.long().to(self._device)
        self._joints = self.scene.hands.joints.to(self._device)[self._index]
        self._pivot = self.scene.palms[0][self._index]
        takes = self.motion.kind == "takes"
        own = OwnHands(self.scene, self._skin(self._every)) if takes else None
        self._distance = RelativeDistance(
            self.scene, self.trials, self._attached, self._opening, own
        )
        affordance = CRITERIA.index("affordance")
        self._blocked = scores.evaluated[:, affordance] & ~scores.passed[:, affordance]

    def _skin(self, rows: Tensor) -> Float32[Tensor, "r v 3"]:
        """Vertices of the hands as they wait, in their own frames, m."""
        return self.scene.hands.vertices[self._index[rows].cpu()].to(self._device)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins episodes: all, or those of a mask.

        Args:
            seed: of noise and receivers, from now on: one number for all rows, or a number for
                each. A row with a number of its own plays as it does where all rows have that number. A seed begins the
                first episodes of all rows. None: the first call does, and a later one begins the next.
            options: `reset_mask`, (B,) bool: the rows that begin anew; without it all. `trial_id`: the trial that
                they play, or a list of B (what stands at rows that do not begin is not read). It plays as in its
                first episode with this seed; the row's next episode is the one that would have come anyway.

        Raises:
            TypeError, ValueError: the seed is no whole number from 0 and no list of B of them, or it comes with a
                `reset_mask` that leaves rows out; no handover is of such a trial.
            ClosedEnvironmentError: `close` was called.
        """
        self.check_open("reset")
        if options is not None and not isinstance(options, Mapping):
            raise TypeError(
                f"options are {describe_value(options)}; they must be a mapping or None"
            )
        options = options or {}
        if odd := [name for name in options if name not in ("reset_mask", "trial_id")]:
            raise ValueError(
                f"options of reset hold {describe_value(odd[0])}; allowed are 'reset_mask' and 'trial_id'"
            )
        mask = options.get("reset_mask")
        if mask is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
                found = f"{mask.dtype} {mask.shape}"
                raise ValueError(f"reset_mask is {found}; it must be bool ({self.num_envs},)")
        begins = np.ones(self.num_envs, np.bool_) if mask is None else mask
        asked = self._places_of(options.get("trial_id"), begins)
        if seed is not None:
            if not begins.all():
                raise ValueError(
                    "seed comes with a reset_mask that leaves rows out; a seed begins all rows, so leave one of the two out"
                )
            self._seed(seed)
        if seed is not None or not self._begun:
            with busy("the first episodes"):
                return self._given(self.begin(asked)), self._info(None)
        self._next(torch.from_numpy(begins).to(self._device), asked)
        return self._given(self._observe()), self._info(None)

    def _places_of(self, trial_id: object, begins: np.ndarray) -> np.ndarray | None:
        """Places in the pool of asked trials, (B,); -1 at rows that do not begin."""
        if trial_id is None:
            return None
        numbers = list(trial_id) if _is_list(trial_id) else [trial_id] * self.num_envs
        if len(numbers) != self.num_envs:
            raise ValueError(
                f"trial_id has {len(numbers)} entries; it must be one number, or {self.num_envs}, one for each row"
            )
        place = {int(t): i for i, t in reversed(list(enumerate(self.pool.trial_id.tolist())))}
        found = np.full(self.num_envs, -1, np.int64)
        for row in np.flatnonzero(begins):
            number = integer(0, MOST_SEED)("trial_id", numbers[row])
            if number not in place:
                some = ", ".join(str(t) for t in sorted(place)[:8])
                more = ", ..." if len(place) > 8 else ""
                raise ValueError(
                    f"trial_id is {number}; this environment has the {len(place)} trials {some}{more}"
                )
            found[row] = place[number]
        return found

    def _seed(self, seed: object) -> None:
        """Takes the seeds of `reset`."""
        numbers: list[int] = []
        if _is_list(seed):
            if len(seed) != self.num_envs:
                raise ValueError(
                    f"seed has {len(seed)} entries; it must be one number, or {self.num_envs}, one for each row"
                )
            rule = integer(0, MOST_SEED, what=" (a number for each row)")
            numbers = [rule(f"seed[{row}]", number) for row, number in enumerate(seed)]
        else:
            numbers = [
                integer(0, MOST_SEED, what=" (or a list of such)")("seed", seed)
            ] * self.num_envs
        self._seen_seeds = self._moved_seeds = np.array(numbers, object)
        if not self._stays:  # in Python's integers: a seed has up to 63 bits
            self._first_place = np.array([n % len(self.pool) for n in numbers], np.int64)
        self._np_random = np.random.default_rng(numbers[0])

    def begin(self, asked: np.ndarray | None = None) -> dict[str, Tensor]:
        """The first episodes of all rows; observations as tensors, whatever `output` is.

        Args:
            asked: (B,) places of `pool` that the rows play; None: the seed's own.
        """
        b, device = self.num_envs, self._device
        self._episode = np.zeros(b, np.int64)
        self._choose(np.arange(b), asked)
        self._poses: list[Tensor] = []
        self._postures: list[Tensor] = []
        self.k_of = torch.zeros(b, dtype=torch.int64, device=device)
        zero = torch.zeros(b, dtype=torch.float32, device=device)
        joints = len(self.scene.robot.joints)
        self.q, self.qd = (zero.new_zeros(b, joints) for _ in range(2))
        self.ends, self._why = (torch.zeros(b, dtype=torch.int8, device=device) for _ in range(2))
        sums = ("robot", "hand", "both", "ssm", "path", "held_out")
        self._sums = {k: zero.clone() for k in sums}
        self._worst = {k: zero.clone() for k in ("near_speed", "depth", "slack", "overlap")}
        self._ended_s, self._least, self.gap = (zero.clone() for _ in range(3))
        self._by_robot = torch.zeros(b, dtype=torch.bool, device=device)
        self._at_take = zero.new_zeros(b, 3)
        self._bias = torch.eye(4, dtype=torch.float32, device=device).repeat(b, 1, 1)
        self._seen, self.T_world_hand = self._bias.clone(), self._bias.clone()
        self._last_seen, self._first = self.k_of.clone(), self.k_of.clone()
        self.hands: MovingHands | None = None
        self._begun = True
        self._start(torch.ones(b, dtype=torch.bool, device=device))
        return self._observe()

    def _next(self, mask: Tensor, asked: np.ndarray | None = None) -> None:
        """Begins the next episodes of some rows, with the places of the pool that are asked or else their own."""
        rows = np.flatnonzero(mask.cpu().numpy())
        self._episode[rows] += 1
        self._choose(rows, asked)
        self._start(mask)

    def _choose(self, rows: np.ndarray, asked: np.ndarray | None) -> None:
        """Takes the handovers of these rows' episodes: by seed, row and number of the episode alone."""
        n, begun = len(self.pool), self._row.cpu().numpy().copy()
        turn = rows + self._episode[rows] * self.num_envs
        begun[rows] = (self._first_place[rows] + turn) % n if asked is None else asked[rows]
        self._round[rows] = turn // n if asked is None else 0
        if np.array_equal(begun, self._row.cpu().numpy()):
            return
        joints, own = self._joints, self._distance.own
        self._hold(torch.from_numpy(begun).to(self._device))
        others = np.setdiff1d(np.arange(self.num_envs), rows)
        go_on = torch.from_numpy(others).to(
            self._device
        )  # perhaps with fingers that take an object
        self._joints[go_on] = joints[go_on]
        if own is not None and self._distance.own is not None:
            self._distance.own.put(go_on, own.vertices[go_on])

    def _start(self, mask: Tensor) -> None:
        """Sets rows to the beginning of an episode."""
        rows = torch.nonzero(mask).flatten()
        self.q, self.qd = (x.clone() for x in (self.q, self.qd))
        self.q[rows], self.qd[rows] = self._begins_at[rows], 0.0
        self.k_of[rows] = 0
        held, lifted = self._held[rows], self._lifted[rows]
        begins = held & lifted
        self.ends[rows] = torch.where(begins, int(End.RUNNING), int(End.DROP)).to(torch.int8)
        why = torch.where(held, int(Why.NOT_LIFTED), int(Why.NOT_HELD))
        self._why[rows] = torch.where(begins, int(Why.RUNNING), why).to(torch.int8)
        for counted in (*self._sums.values(), *self._worst.values()):
            counted[rows] = 0.0
        self._ended_s[rows] = torch.where(begins, torch.inf, 0.0).float()
        self._by_robot[rows], self._at_take[rows] = False, 0.0
        if (own := self._distance.own) is not None:
            own.put(rows, self._skin(rows))
            self._joints[rows] = self.scene.hands.joints.to(self._device)[self._index[rows]]
        hands = MovingHands.of(self.scene, self._drawn, self.motion, self._moved_seeds)
        self.hands = hands if self.hands is None else hands.keeping(self.hands, ~mask)
        T = self.hands.pose(self.times)
        self.T_world_hand = torch.where(mask[:, None, None], T, self.T_world_hand)
        self.T_world_ee, _ = ee_and_jacobian(self.scene.robot, self.q)
        self.gap[rows] = self._apart(rows, self.q[rows], T[rows])
        self._least[rows] = self.gap[rows]
        self._bias = torch.where(mask[:, None, None], self._error(0, 1.0), self._bias)
        self._last_seen[rows] = 0
        if self._poses:
            self._poses[-1], self._postures[-1] = self.T_world_hand, self.q
        else:
            self._poses, self._postures = [self.T_world_hand], [self.q]
        self._first[rows] = len(self._poses) - 1
        self._finish(rows[begins & (self.gap[rows] <= 0)], End.CONTACT, Why.HAND_CAME)
        if cut := int(self._first.min()):  # nobody asks for what was before
            del self._poses[:cut], self._postures[:cut]
            self._first = self._first - cut

    @property
    def times(self) -> Float64[Tensor, " b"]:
        """Since each row's episode began, s."""
        return self.k_of.double() * self.step_s

    @property
    def time_s(self) -> float:
        """Since the oldest of the episodes began, s."""
        return float(self.times.max())

    @property
    def k(self) -> int:
        """Steps of the oldest of the episodes."""
        return int(self.k_of.max())

    @property
    def _drawn(self) -> Trials:
        """The trials under the numbers that random draws go by."""
        again = torch.from_numpy(self._round).to(self.trials.trial_id.device)
        return replace(self.trials, trial_id=self.trials.trial_id + NEXT_EPISODE * again)

    def step(self, actions: Any) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        """One step of every episode that runs; the others stand, or begin anew with `autoreset`.

        Args:
            actions: (B, ...) finite numbers, as `action` says: an array, a tensor or nested lists. float32 or float64.

        Raises:
            TypeError, ValueError: they are something else; the message names it.
            ResetNeeded: `reset` was never called.
            ClosedEnvironmentError: `close` was called.
        """
        before = self.ends.clone() if self._begun else None
        self.check_open("step")
        observation, *outcome = self.advance(self.checked_actions(actions))
        assert before is not None
        reward, over, late = map(self._given, outcome)
        return self._given(observation), reward, over, late, self._info(before)

    def check_open(self, call: str) -> None:
        """Nothing happens, unless `close` was called.

        Args:
            call: what is about to be done, for the message.

        Raises:
            ClosedEnvironmentError: `close` was called.
        """
        if self.closed:
            raise ClosedEnvironmentError(f"{call} was called after close; make a new environment")

    def checked_actions(self, actions: Any) -> Tensor:
        """A policy's answer as a tensor (B, ...) on the env's device.

        Args:
            actions: (B, ...) of `single_action_space`, finite numbers: an array, a tensor or nested lists.

        Raises:
            TypeError, ValueError: they are something else; the message names it.
        """
        shape = (self.num_envs, *(self.single_action_space.shape or ()))
        words = f"a tensor {shape} of finite torch.float32 or torch.float64"
        given = as_numbers("actions", actions, words, self._device)
        if tuple(given.shape) != shape:
            raise ValueError(f"actions are {tuple(given.shape)}; they must be {words}")
        if not bool(given.isfinite().all()):
            row = int(torch.nonzero(~given.isfinite())[0, 0])
            raise ValueError(f"actions of row {row} are not finite; they must be {words}")
        return given.detach().to(self._device)

    def advance(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor]:
        """As `step`, without `info` and with tensors, whatever `output` is.

        Args:
            actions: what `checked_actions` returned.
        """
        self.check_open("step")
        if not self._begun:
            raise ResetNeeded("HandoverEnv.step was called before reset; call reset first")
        with self.evaluator.working():
            return self._step(actions)

    def _step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor]:
        running = self.ends == int(End.RUNNING)
        rows = torch.nonzero(running).flatten()
        first, last = self.times, (self.k_of + 1).double() * self.step_s
        assert self.hands is not None
        q, qd = self.moved(actions, rows)
        T = self.hands.pose(last)
        moved = self.hands.travel(first, last) > 1e-6
        passed = self._distance.over_step(
            rows,
            (self.q[rows], q),
            self.hands,
            (first[rows], last[rows]),
            self.gap[rows],
        )
        if self._sees_person and len(rows):
            near = self._from_person(rows, torch.stack([self.q[rows], q], 1), T[rows])
            gap, least = (torch.minimum(x, near) for x in (passed.gap_m, passed.least_m))
            passed = Passed(gap, least, passed.touch | (near <= 0))
        self._count(rows, q, T, moved, passed)
        before, self.T_world_hand = self.T_world_hand, T
        old, place, gap = self.q, self.T_world_ee[:, :3, 3], self.gap
        self.q, self.qd, self.gap = self.q.clone(), torch.zeros_like(self.qd), self.gap.clone()
        self.q[rows], self.qd[rows], self.gap[rows] = q, qd.float(), passed.gap_m
        self.k_of = self.k_of + 1
        self._poses.append(T)
        self._postures.append(self.q)
        self.T_world_ee, _ = ee_and_jacobian(self.scene.robot, self.q)
        gone = self.T_world_ee[:, :3, 3] - place

        touched = rows[passed.touch]
        if len(touched):
            # with the other left where it was, the one that ends nearer brought them together
            robot = self._apart(touched, self.q[touched], before[touched])
            by_robot = robot < self._apart(touched, old[touched], T[touched])
            by_robot &= (
                robot < gap[touched]
            )  # a robot that stands, or backs off, brings nothing together
            # a hand that takes the object may come to the gripper, and to nothing else
            taking = self.hands.taking[touched]
            bad = ~taking | by_robot | ~self._at_gripper(touched)
            self._by_robot[touched] = by_robot & bad
            for who, why in ((by_robot, Why.ROBOT_CAME), (~by_robot, Why.HAND_CAME)):
                self._finish(touched[bad & who], End.CONTACT, why)
        self._receive(rows, se3.dot(gone, gone).sqrt())
        late = (self.ends == int(End.RUNNING)) & (self.times >= self.config.horizon_s - 1e-9)
        self._finish(torch.nonzero(late).flatten(), End.TIMEOUT, Why.LATE)
        self.hands.react(self.times, self.gap)
        outcome = self._outcome(running)
        if self.autoreset and bool((~running).any()):
            self._next(~running)
            reward, terminated, truncated = outcome
            outcome = reward, terminated & running, truncated & running
        return self._observe(), *outcome

    def _at_gripper(self, rows: Tensor) -> Tensor:
        """Whether the robot's body nearest to the hand is one of the gripper's."""
        near = self._distance.nearest(rows, self.q[rows], self.T_world_hand[rows])
        names, gripper = self.scene.part_names, len(self.scene.robot.gripper.names)
        return near.body >= len(names) - 1 - gripper  # the object is the last

    def _given(self, value: Any) -> Any:
        """Tensors as `output` says."""
        if self.output == "torch":
            return value
        if isinstance(value, dict):
            return {k: self._given(x) for k, x in value.items()}
        return value.cpu().numpy()

    def _info(self, before: Tensor | None) -> dict[str, Any]:
        """State of each row, as NumPy arrays; `before`: the ends before this step."""
        ends = self.ends.cpu().numpy()
        margin = self.scores.margin.cpu().numpy()
        info = {
            "end": _NAMES[ends],
            "why": WORDS[self._why.cpu().numpy()],
            "success": ends == int(End.SUCCESS),
            "trial_id": self.scores.trial_id.cpu().numpy(),
            "least_m": self._least.cpu().numpy(),
            "margins": {name: margin[:, i] for i, name in enumerate(self.scores.criteria)},
        }
        if before is not None:
            ended = (before.cpu().numpy() == int(End.RUNNING)) & (ends != int(End.RUNNING))
            info["_end"] = ended
            info["is_success"] = (
                info["success"] & ended
            )  # where LeRobot and Stable-Baselines3 read it
            info["_is_success"] = ended
        return info

    def _outcome(self, running: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reward, terminated, truncated."""
        late, success = self.ends == int(End.TIMEOUT), self.ends == int(End.SUCCESS)
        over = self.ends != int(End.RUNNING)
        bad = over & ~late & ~success & (self.ends != int(End.NOT_RECEIVED))
        reward = success.float() - bad.float() - 0.1 * self.step_s / self.config.horizon_s
        return torch.where(running, reward, 0.0), over & ~late, late

    # --- the robot -----------------------------------------------------------------------------------------------

    def moved(self, actions: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Postures (R, J; rad) of `rows` at the end of one step with their actions, as near to the
        actions as limits of speed, acceleration and joints allow, and the joint speeds (rad/s). An
        asked posture that they allow is reached bit for bit.

        Args:
            actions: (B, ...) of `single_action_space`.
            rows: (R,) int64.
        """
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
        where it is False meets nothing.

        Args:
            actions: (B, ...) of `single_action_space`.
        """
        rows = torch.nonzero(self.ends == int(End.RUNNING)).flatten()
        q, v = self.moved(actions.to(self._device), rows)
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
        assert self.hands is not None
        taking = self.hands.taking[rows]
        inside_m = torch.where(taking, -passed.gap_m, 0.0).clamp(min=0.0)
        w["overlap"][rows] = torch.maximum(w["overlap"][rows], inside_m)
        rows, gap, between = rows[~taking], passed.gap_m[~taking], passed.least_m[~taking]
        self._least[rows] = torch.minimum(self._least[rows], gap)
        low = torch.minimum(self._least[rows] - w["slack"][rows], between)
        w["slack"][rows] = self._least[rows] - low

    def _receive(self, rows: Tensor, gone_m: Tensor) -> None:
        """Ends the episodes in which the object was held out, or was taken; `gone_m`: of the TCP in this step."""
        assert self.hands is not None
        rows = rows[self.ends[rows] == int(End.RUNNING)]
        rest = gone_m[rows] <= REST_M_S * self.step_s
        taking = self.hands.taking[rows]
        self._taken(rows[taking], rest[taking])
        now = self.times
        still = self.hands.travel(now - self.step_s, now)[rows] <= REST_M_S * self.step_s
        rows, both = rows[~taking], (rest & still)[~taking]
        ready = torch.zeros_like(both)
        near = rows[both]
        if len(near):
            ready[both] = self._within_reach(near) >= 0
        held = self._sums["held_out"]
        held[rows] = torch.where(ready, held[rows] + self.step_s, 0.0)
        out = rows[held[rows] >= HELD_OUT_S - 1e-6]
        self._finish(out[self._blocked[out]], End.NOT_RECEIVED, Why.FINGERS_ON_REGION)
        out = out[~self._blocked[out]]
        if len(out) and "presented" in self.scene.benchmark.asks:
            presented = self._posed(out).presented
            self._finish(out[~presented], End.NOT_RECEIVED, Why.NOT_PRESENTED)
            out = out[presented]
        if self.motion.kind == "takes":
            self._offer(out)
        else:
            self._finish(out, End.SUCCESS, Why.HELD_OUT)

    def _within_reach(self, rows: Tensor) -> Tensor:
        """Margin of Reach with hands and robot where they are, m."""
        T_world_obj = se3.matmul(self.T_world_ee[rows], se3.inverse(self._attached[rows].double()))
        T = self.T_world_hand[rows]
        center = self.scene.palm(self.trials.hand_index[rows], T)[2]
        ball = se3.apply(se3.inverse(T_world_obj), center.double()).float().contiguous()
        objects = self.trials.object_index[rows].to(torch.int32).contiguous()
        far = reached(self.scene, objects, ball).distance_m
        return self.scene.config.thresholds.reach_radius_m - far

    def _offer(self, rows: Tensor) -> None:
        """Hands set out for the easiest grasp of the object as it is held out; where there is none the episode
        ends."""
        if not len(rows):
            return
        posed = self._posed(rows)
        found = posed.inputs
        assert found is not None
        trials = found.trials
        assert self._heads is not None  # hands that take have a person
        at_rest = replace(posed, q_goal=self.q[rows]).with_inputs(found)
        reception_scores = reception(at_rest, head=self._heads[rows])
        self._finish(rows[~reception_scores.received], End.NOT_RECEIVED, Why.NO_GRASP)
        received = reception_scores.received
        objects = trials.object_index.cpu()
        held_out = load_held_out(
            self.scene.objects, self.scene.hands.model, objects.unique().tolist()
        )
        of = objects[received.cpu()].long()
        which = held_out.first[of] + reception_scores.grasp[received].long().cpu()
        hands = held_out.grasps.posed
        vertices, joints = (x[which].to(self._device) for x in (hands.vertices, hands.joints))
        before, there = (
            T[received] for T in (reception_scores.T_world_before, reception_scores.T_world_hand)
        )
        self._take(rows[received], Taken(before, there, vertices, joints))

    def _posed(self, rows: Tensor) -> Scores:
        """The pose stage of robot and receivers where they are."""
        inputs = self.scores.inputs
        assert inputs is not None
        poses = inputs.T_obj_ee[rows], self.T_world_ee[rows].float()
        trials = self._trials_now(rows)
        if self._from_table:
            trials = trials.named(self.scene.objects)
        return self._holding.score(*poses, trials, stages="pose")

    def _trials_now(self, rows: Tensor) -> Trials:
        """Trials with the receivers where they are."""
        person = self.receiver
        return replace(
            self.trials[rows],
            T_world_hand=self.T_world_hand[rows],
            receiver=None if person is None else person[rows],
        )

    def _take(self, rows: Tensor, grasp: Taken) -> None:
        """Hands set out for these grasps, with the grasps' fingers from now on."""
        assert self.hands is not None and self._distance.own is not None
        self.hands.take(self.times, rows, grasp)
        self._distance.own.put(rows, grasp.vertices)
        self._joints[rows] = grasp.joints
        self._at_take[rows] = self.T_world_ee[rows, :3, 3].float()
        self.gap[rows] = self._apart(rows, self.q[rows], self.T_world_hand[rows])

    def _taken(self, rows: Tensor, rest: Tensor) -> None:
        """Ends what is taken: a success where the robot has held still."""
        if not len(rows):
            return
        gone = (self.T_world_ee[rows, :3, 3].float() - self._at_take[rows]).square().sum(
            1
        ).sqrt() > STAYED_M
        self._finish(rows[gone], End.NOT_RECEIVED, Why.NOT_STILL)
        assert self.hands is not None
        there = ~gone & rest & (self.hands.taken_s[rows] <= self.times[rows])
        self._finish(rows[there], End.SUCCESS, Why.TAKEN)

    def _finish(self, rows: Tensor, end: End, why: Why) -> None:
        """Ends episodes. One that came to nothing worse is looked at once more, all its way: does the robot meet
        itself, the table or the object?"""
        if not len(rows):
            return
        self.ends[rows], self._why[rows] = int(end), int(why)
        self._ended_s[rows] = self.times[rows].float()
        rows = rows[self.k_of[rows] > 0]
        if end == End.CONTACT or not len(rows):
            return
        met = rows[~self._meets_nothing(rows, self._since(self._postures, rows))]
        self.ends[met], self._why[met] = int(End.COLLISION), int(Why.IN_THE_WAY)

    def _since(self, each: list[Tensor], rows: Tensor) -> Tensor:
        """Entries (r, s, ...) of all steps since the oldest of these rows' episodes began; a younger one begins with its
        first entry repeated."""
        oldest = int(self._first[rows].min())
        found = torch.stack([x[rows] for x in each[oldest:]], 1)
        own = (self._first[rows] - oldest)[:, None]
        step = torch.arange(found.shape[1], dtype=torch.int64, device=rows.device)
        place = torch.arange(len(rows), dtype=torch.int64, device=rows.device)[:, None]
        return found[place, torch.maximum(step[None], own)]

    # --- what is seen --------------------------------------------------------------------------------------------

    @property
    def receiver(self) -> Float32[Tensor, "b 5 4"] | None:
        """The receivers' bodies now, arms with their hands (`Trials.receiver`)."""
        assert self.hands is not None
        return self.hands.people(self.T_world_hand)

    def bodies(self, T_world_hand: Float32[Tensor, "r 4 4"], rows: Tensor) -> BodyPoses:
        """Bodies of some trials with their hands there, for the scene's functions.

        Args:
            T_world_hand: (R, 4, 4) palms in the world, metres.
            rows: (R,) int64 trials of the env.
        """
        trials = self.trials
        return self.scene.body_poses(
            trials.object_index[rows], trials.hand_index[rows], self._attached[rows], T_world_hand.contiguous(),
            self._opening[rows],
        )  # fmt: skip

    def obstacles(self, T_world_hand: Float32[Tensor, "r 4 4"], rows: Tensor) -> BodyPoses:
        """The same for a planner: with arm, torso and head where `receiver="body"`.

        Args:
            T_world_hand: (R, 4, 4) palms in the world, metres.
            rows: (R,) int64 trials of the env.
        """
        bodies = self.bodies(T_world_hand, rows)
        if not self._sees_person:
            return bodies
        assert self.hands is not None
        receiver = self.hands.people(T_world_hand, rows)
        assert receiver is not None  # such an evaluator refuses trials without
        assert self._heads is not None
        return with_person(self.scene, bodies, receiver, hand=True, head=self._heads[rows])

    def _apart(self, rows: Tensor, q: Tensor, T_world_hand: Tensor) -> Tensor:
        """Distances of robot and receiver, with the hands of these rows there, m."""
        hand = self._distance.at(rows, q, T_world_hand)
        if not self._sees_person or not len(rows):
            return hand
        return torch.minimum(hand, self._from_person(rows, q[:, None], T_world_hand))

    def _from_person(self, rows: Tensor, path: Tensor, T_world_hand: Tensor) -> Tensor:
        """Least distance of the robot on its way from arm, torso and head as they are with the hands there, m; inf:
        farther than 5 cm."""
        assert self.hands is not None and self._heads is not None
        receiver = self.hands.people(T_world_hand, rows)
        assert receiver is not None
        length = torch.full((len(rows),), path.shape[1], dtype=torch.int32, device=self._device)
        bodies = self.bodies(T_world_hand, rows)
        head = self._heads[rows]
        found, part = person_distance(self.scene, bodies, receiver, path, length, head)
        return torch.where(part < 0, torch.inf, found)

    def _error(self, purpose: int, share: float) -> Tensor:
        """Errors of the seen hands in their own frames, (b, 4, 4)."""
        noise = PredictorNoise().scaled(self.config.noise * share)
        found = torch.eye(4, dtype=torch.float32, device=self._device).repeat(self.num_envs, 1, 1)
        ids = trial_ids(self._drawn.trial_id)
        for seed, own in rows_of_seeds(self._seen_seeds):
            rows = torch.from_numpy(own).to(self._device)
            found[rows] = perturbed(
                found[rows], self._pivot[rows], ids[own], rng.key_of(f"seen in a closed loop {seed}"), purpose=purpose,
                rotation_deg=noise.target_rotation_deg, translation_m=noise.target_translation_m,
            )  # fmt: skip
        return found

    def _observe(self) -> dict[str, Tensor]:
        """The policy's observations now."""
        c, late = self.config, round(self.config.latency_s * self.config.rate_hz)
        frame = (self.k_of - late).clamp(min=0)
        new = (frame > 0) | (self.k_of == 0)
        if bool(new.any()):
            kept = torch.stack(self._poses[-(late + 1) :])
            back = torch.minimum(self.k_of, torch.full_like(frame, late))
            T = kept[len(kept) - 1 - back, self._every].double()
            ids, lost = self._drawn.trial_id, torch.zeros_like(new)
            keys = [
                (rng.key_of(f"drop-outs {s}"), own) for s, own in rows_of_seeds(self._seen_seeds)
            ]
            for number in torch.unique(
                frame[new]
            ).tolist():  # one, where all episodes began together
                own = new & (frame == number)
                u = np.empty(self.num_envs)
                for key, of in keys:
                    (u[of],) = rng.uniforms(key, trial_ids(ids)[of], 1, purpose=0, attempt=number)
                gone = torch.from_numpy(u < c.dropout).to(self._device) & (number > 0)
                error = se3.matmul(
                    self._bias.double(), self._error(1 + number % 60_000, FRAME_SHARE).double()
                )
                T_seen = se3.matmul(T, error).float()
                self._seen = torch.where((own & ~gone)[:, None, None], T_seen, self._seen)
                lost = lost | (own & gone)
            self._last_seen = torch.where(new & ~lost, frame, self._last_seen)
        running = torch.nonzero(self.ends == int(End.RUNNING)).flatten()
        gap = torch.full_like(self.gap, CAP_M)
        gap[running] = self._apart(running, self.q[running], self._seen[running])
        found = {
            "time": self.times.float(),
            "q": self.q.clone(),
            "qd": self.qd.clone(),
            "T_world_ee": self.T_world_ee.float(),
            "T_world_hand": self._seen.clone(),
            "hand_joints": se3.apply(self._seen[:, None], self._joints),
            "age": (self.k_of - self._last_seen).float() * self.step_s,
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
        time_s = torch.where(self._ended_s.isinf(), self.times.float(), self._ended_s)
        share = 1.0 / time_s.clamp(min=self.step_s)
        robot, hand, both = ((s[k] * share).clamp(max=1.0) for k in ("robot", "hand", "both"))
        arm_kg = float(np.sum(self.scene.robot.dynamics.mass))
        reduced = 1.0 / (1.0 / HAND_KG + 2.0 / arm_kg)
        allowed = HAND_N / float(np.sqrt(HAND_N_M * reduced))
        return Episodes(
            self.ends.clone(), self._by_robot.clone(), time_s, self._least.clone(), w["slack"].clone(),
            w["near_speed"].clone(), s["ssm"].clone(), w["depth"].clone(), w["near_speed"] / allowed,
            1.0 - robot, 1.0 - hand, both, (1.0 - robot - hand + both).clamp(min=0.0), s["path"].clone(),
            w["overlap"].clone(),
        )  # fmt: skip

    def trace(self) -> tuple[Float32[Tensor, "b s j"], Float32[Tensor, "b s 4 4"]]:
        """Postures (rad) and T_world_hand at the beginning and after each step."""
        return self._since(self._postures, self._every), self._since(self._poses, self._every)


class SingleHandoverEnv(gymnasium.Env[Any, Any]):
    """A `HandoverEnv` of one handover at a time as a plain Gymnasium environment, for libraries that know no vector
    environments. Arrays are NumPy's; `info` has the one row's values, without margins that were not
    evaluated."""

    def __init__(self, env: HandoverEnv) -> None:
        """Args:
            env: with one handover at a time, NumPy arrays and without autoreset.

        Raises:
            ValueError: it has another number of handovers, tensors or an autoreset.
        """
        if env.num_envs != 1:
            raise ValueError(f"this environment has {env.num_envs} handovers; a single one has 1")
        if env.output != "numpy" or env.autoreset:
            raise ValueError('a single environment needs output="numpy" and autoreset=False')
        self.vector, self.render_mode, self.metadata = env, env.render_mode, env.metadata
        self._over = False
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        if seed is not None:  # said as for many: Gymnasium has no limits
            integer(0, MOST_SEED)("seed", seed)
        super().reset(seed=seed)
        observation, info = self.vector.reset(seed=seed, options=options)
        self._over = False
        return _seen(observation), _first(info)

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """As `HandoverEnv.step`, of the one row.

        Args:
            action: (A,) of `action_space`.

        Raises:
            ResetNeeded: `reset` was never called, or the episode has ended.
            ClosedEnvironmentError: `close` was called.
        """
        self.vector.check_open("step")
        if self._over:
            raise ResetNeeded("the episode has ended; call reset before the next step")
        observation, reward, ended, late, info = self.vector.step(np.asarray(action)[None])
        found = _seen(observation), float(reward[0]), bool(ended[0]), bool(late[0])
        self._over = found[2] or found[3]
        return *found, _first(info)

    def render(self) -> Any:
        frames = self.vector.render()
        return frames[0] if frames else None

    def close(self) -> None:
        self.vector.close()


def _is_list(value: object) -> TypeGuard[Sequence[object]]:
    return isinstance(value, (list, tuple, np.ndarray)) and np.ndim(value) == 1


def _seen(observation: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The one row of an observation, numbers as arrays without dimensions: a `Box` holds nothing else."""
    return {k: x[0, ...] for k, x in observation.items()}


def _first(values: Mapping[str, Any]) -> dict[str, Any]:
    """The first row of each array, also of those in a dict inside; NaN is left out."""
    rows = {k: _first(x) if isinstance(x, Mapping) else x[0] for k, x in values.items()}
    return {k: x for k, x in rows.items() if not (isinstance(x, np.floating) and np.isnan(x))}
