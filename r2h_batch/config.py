"""The configuration of an evaluation: every number that a verdict depends on, in SI units.

The classes are frozen dataclasses. Their fields are held to their annotations when they are made
(`validate.validate_fields`), and when pydantic reads them from a file.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Literal, Self

from pydantic import ConfigDict, Field

from r2h_batch.base.registry import PRESET_NAMES, EngineName, EngineWord
from r2h_batch.base.validate import check_keywords, one_of, validate_fields
from r2h_batch.verdicts import UNITS

HOME_Q = (-0.3225, -1.7453, 1.4312, -1.2566, -1.5708, 1.2483)
"""The arm's posture at the start of every trial, rad. The gripper points straight down, the TCP is
at (0.421, 0, 0.449) m [choice]."""

OPEN_GAP_M = 0.085
"""Gap between the pads of the open gripper: the published stroke of the 2F-85."""

CLOSED_GAP_M = 0.0015112
"""Gap between the pads of the closed gripper, whose linkage is at its stop
(`scene.robot.gap_from_drive(drive_upper)`)."""

BALL_OFFSET_M = 0.12
"""d_h: distance from the palm to the centre of the ball that an object must meet to be in reach."""

TABLE_CENTER = (-0.025, 0.0, -0.025)
TABLE_HALF = (0.475, 0.6, 0.025)
"""The table's top is at z = 0, x from -0.5 to 0.45 m, |y| <= 0.6 m; it is 5 cm thick [choice]."""

MOST_HEAD_CLEARANCE_M = 0.5
"""Bound of `Benchmark.head_clearance_m`."""

PRESENTED_M = {"S0": 0.075, "S1": 0.035}
"""Presented: gripper and sharp parts may be nearer to the palm than the wanted part by this. [choice] of three raters
(vision models): the smallest value that agrees with most of their pictures (bench/rating.py)."""

UPRIGHT_DEG = 60.0
"""A vessel is upright where its opening is within this angle of the world's up [choice]."""

CLEARANCE_CAP_M = 0.05
"""Clearances are exact below this value and lower bounds above it."""

FARTHEST_M = 1e6
"""Reach is exact up to here: an object farther away counts as this far."""

CLEARANCE_TOLERANCE_M = 1e-4
"""Tolerance of the smallest clearance along a path."""

BORDERLINE_M = UNITS["m"].borderline
"""Half width of the band around a threshold in which float32 geometry does not decide."""

PAD_SQUEEZE_CAP_M = 0.01
"""Largest deformation of both rubber pads together."""

HALF_DEGREE = math.radians(0.5)

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Length = Annotated[float, Field(ge=0, allow_inf_nan=False, description="metres")]
Degrees = Annotated[float, Field(ge=0, le=180, description="degrees")]
Share = Annotated[float, Field(ge=0, le=1, description="a share")]
Speed = Annotated[float, Field(gt=0, le=1, description="a share of the joint limits")]
Seed = Annotated[int, Field(ge=-(1 << 63), lt=1 << 63, description="a seed of 64 bits")]
GoalClearance = Annotated[float, Field(ge=0, le=0.006, description="metres")]
Opening = Annotated[
    float, Field(gt=0, le=OPEN_GAP_M, description="metres; the open gripper's pads have this gap")
]
Squeeze = Annotated[
    float, Field(ge=0, le=PAD_SQUEEZE_CAP_M, description="metres; pads give no more")
]
KeptClear = Annotated[
    float, Field(ge=0, lt=CLEARANCE_CAP_M, description="metres; larger distances are not measured")
]
Angle = Annotated[float, Field(ge=-2 * math.pi, le=2 * math.pi)]
Coordinate = Annotated[float, Field(ge=-10, le=10)]
HalfLength = Annotated[float, Field(ge=1e-3, le=10)]
Rounds = Annotated[
    tuple[Annotated[int, Field(ge=1, le=100_000)], ...], Field(min_length=1, max_length=100)
]


class _Checked:
    """Fields are held to their annotations; a file may hold no other fields."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    def __new__(cls, *_: object, **given: object) -> Self:
        """A misspelt field is answered with the nearest name."""
        check_keywords(cls.__name__, given, [f.name for f in fields(cls)])  # type: ignore[arg-type]
        return super().__new__(cls)

    def __post_init__(self) -> None:
        validate_fields(self)


@dataclass(frozen=True)
class Thresholds(_Checked):
    """Where a criterion turns from pass to fail (paper, Sec. Evaluation Metrics).

    Attributes:
        w_max_m: widest material that the pads take, m.
        w_min_m: thinnest material that the closed pads reach, m.
        reach_radius_m: radius r_h of the ball that the object must meet, m.
        reach_offset_m: distance of the ball's centre from the palm along its normal, m.
        safe_margin_m: distance that a hand must keep to count as untouched, m.
        pad_squeeze_m: how much the rubber pads give in total, m [choice]: so fingers that hold a
            region meet it.
    """

    w_max_m: Opening = OPEN_GAP_M
    w_min_m: Length = CLOSED_GAP_M
    reach_radius_m: Positive = 0.10
    reach_offset_m: Positive = BALL_OFFSET_M
    safe_margin_m: KeptClear = 0.0
    pad_squeeze_m: Squeeze = 0.001

    def __post_init__(self) -> None:
        validate_fields(self)
        if not self.w_min_m < self.w_max_m:
            found = f"Thresholds.w_min_m is {self.w_min_m:g}"
            raise ValueError(f"{found}; it must be below w_max_m, {self.w_max_m:g}")


@dataclass(frozen=True)
class IkConfig(_Checked):
    """The solver of a pose's joint angles. The closed form proves which branches exist in both.

    Attributes:
        solver: of joint angles: the closed form, or the batched Jacobian of pytorch-kinematics, 300 times slower.
    """

    solver: Literal["fused", "pytorch-kinematics"] = "fused"


@dataclass(frozen=True)
class Workplace(_Checked):
    """The arm's posture at the start and the table.

    Attributes:
        home_q: joint angles at the start, rad, as many as the robot has joints.
        table_center: centre of the table's box in the world, m.
        table_half: its half sides, m.
    """

    home_q: Annotated[tuple[Angle, ...], Field(min_length=6, max_length=12)] = HOME_Q
    table_center: Annotated[tuple[Coordinate, ...], Field(min_length=3, max_length=3)] = (
        TABLE_CENTER
    )
    table_half: Annotated[tuple[HalfLength, ...], Field(min_length=3, max_length=3)] = TABLE_HALF

    def scaled(self, factor: float) -> "Workplace":
        """The same with a table `factor` times as long and wide, as high as before.

        Args:
            factor: above 0.
        """
        (x, y, z), (a, b, c) = self.table_center, self.table_half
        return replace(
            self,
            table_center=(factor * x, factor * y, z),
            table_half=(factor * a, factor * b, c),
        )


@dataclass(frozen=True)
class PlanConfig(_Checked):
    """The search for a path from home to the handover pose.

    Attributes:
        goals: of a path: all collision-free branches, or the paper's single one.
        hand: which hand paths keep clear of; everything else is judged on the true one.
        edge_check: of a path's edges: conservative advancement, or samples at MoveIt's resolution.
        object_collision: what paths avoid of the held object: its convex hull, or its convex pieces.
        hand_clearance_m: distance to the hand kept along the path where the goal keeps it, m [choice]; goals are measured
            up to 6.5 mm only.
        range_rad: longest extension of RRT, rad.
        rounds: iterations of each round of the search. Where several find nothing, searches at less clearance follow
            (`judge.search.LAST_SHARES`).
        shortcuts: waypoints pulled and segments joined after the quickest subset of the waypoints is
            found.
        seed: of the random postures of the search.
    """

    goals: Literal["set", "one"] = "set"
    hand: Literal["true", "estimated"] = "true"
    edge_check: Literal["exact", "moveit"] = "exact"
    object_collision: Literal["hull", "pieces"] = "hull"
    hand_clearance_m: GoalClearance = 0.003
    range_rad: Positive = 1.5
    rounds: Rounds = (50, 500, 3000, 5000)
    shortcuts: Annotated[int, Field(ge=0, le=10_000)] = 8
    seed: Seed = 0


@dataclass(frozen=True)
class EstimateConfig(_Checked):
    """The hand that a planner with `PlanConfig.hand = "estimated"` sees. `predict_target` of
    `predictors` gives the same hand for the same numbers.

    Attributes:
        errors: of the target hand, `PredictorNoise.target_errors`. normal: no outliers; frames: errors of published
            estimators in single frames; tails: both.
        factor: scales all errors; 0: the truth.
        seed: of the methods: they and the planner see the same hand.
    """

    errors: Literal["normal", "frames", "tails"] = "normal"
    factor: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    seed: Seed = 0


@dataclass(frozen=True)
class ExecutionError(_Checked):
    """Standard deviations, per axis, of what a real robot adds to the poses that a method asks for
    (`judge.execution_error`). 0: the robot does what it is asked.

    Attributes:
        camera_m: error of the handover pose about the hand's origin: the camera's calibration to the base, m.
        camera_deg: the same, degrees.
        camera_drawn: the camera's error: anew in every trial, or once: a calibration that stays wrong.
        object_m: error of the gripper in the object's frame, drawn in every trial, m.
        object_deg: the same, degrees.
        seed: of the random numbers.
    """

    camera_m: Length = 0.0
    camera_deg: Degrees = 0.0
    camera_drawn: Literal["trial", "run"] = "trial"
    object_m: Length = 0.0
    object_deg: Degrees = 0.0
    seed: Seed = 0

    @property
    def any(self) -> bool:
        """Whether anything is off."""
        return any((self.camera_m, self.camera_deg, self.object_m, self.object_deg))


@dataclass(frozen=True)
class ObjectErrors(_Checked):
    """How far the object's frame that methods see is from the true one (`judge.object_errors`), drawn in every trial; the
    same for all methods. 0: they see the truth.

    Attributes:
        translation_m: standard deviation per axis of where methods see the middle of the object's box, m.
        rotation_deg: standard deviation per axis of how they see the object turned about it, degrees.
        gross: share of the trials in which the object is also seen wrongly turned, 0 to 1.
        gross_turn: that turn. half: 180 degrees about one of the three axes of the object's box; symmetry: any angle about
            the axis about which turns change its surface least.
        seed: of the random numbers.
    """

    translation_m: Length = 0.0
    rotation_deg: Degrees = 0.0
    gross: Share = 0.0
    gross_turn: Literal["half", "symmetry"] = "half"
    seed: Seed = 0

    @property
    def any(self) -> bool:
        """Whether anything is off."""
        return any((self.translation_m, self.rotation_deg, self.gross))


OBJECT_ERRORS = {
    "none": (0.0, 0.0),
    "lab": (0.002, 1.0),
    "field": (0.005, 4.0),
    "rgb": (0.010, 8.0),
}
"""Level -> `translation_m` and `rotation_deg` of `ObjectErrors` [choice]. lab: a calibrated cell and a known model; field: a
depth camera; rgb: a colour camera alone. Publications of pose estimators give areas under recall curves (AR, ADD), which are
no lengths."""


@dataclass(frozen=True)
class ExecConfig(_Checked):
    """The time law and the simulator.

    The time law is a trapezoid per segment, all joints together, at a fraction of the joint limits.

    Attributes:
        scale: fraction of the joint limits that motions use; MoveIt 2's default is 0.1.
        max_velocity_rad_s: velocity limit of the slowest joint, rad/s; others move up to their own. The default, pi,
            means the robot's own limit.
        max_acceleration_rad_s2: acceleration limit of every joint, rad/s^2; robots have no own one.
        sim: engine that moves the arm. auto: mujoco on a CPU, mjwarp on CUDA; none: the planned motion.
        model: what is simulated. scene: everything, with contacts; arm: the arm with a rigid gripper and
            no contacts; auto: the arm, and again the whole scene where a contact is not ruled out (docs/choices.md).
        step_s: step of simulator and servos, s: the real controller's 500 Hz.
        record_steps: steps between two samples of the executed motion.
        payload: whether the controller compensates the object's weight.
        settle_position_m: at rest the ee stays this near to the goal, m.
        settle_rotation_rad: at rest the ee is turned by no more than this, rad.
        settle_s: at rest later than this after its reference has ended, s: `not_settled`.
        dwell_s: the arm is watched this long after its reference has ended, s, and must rest for
            half of it.
    """

    scale: Speed = 0.1
    max_velocity_rad_s: Positive = math.pi
    max_acceleration_rad_s2: Positive = 5.0
    sim: EngineWord = "auto"
    model: Literal["auto", "scene", "arm"] = "auto"
    step_s: Positive = 0.002
    record_steps: Annotated[int, Field(ge=1, le=10_000)] = 4
    payload: Literal["known", "unknown"] = "known"
    settle_position_m: Positive = 0.001
    settle_rotation_rad: Positive = HALF_DEGREE
    settle_s: Positive = 12.0
    dwell_s: Positive = 0.5

    def engine(self, device: str) -> EngineName:
        """The engine that `sim` means on a device.

        Args:
            device: cpu or cuda:N.
        """
        if self.sim != "auto":
            return self.sim
        return "mujoco" if device == "cpu" else "mjwarp"


@dataclass(frozen=True)
class EvalConfig(_Checked):
    """The whole configuration. `preset("paper")` differs from the default where the paper's
    pipeline is known to differ, `preset("release")` where the authors' public release does.

    Attributes:
        thresholds: where a criterion turns from pass to fail.
        ik: the solver of joint angles.
        plan: the search for a path.
        execute: time law and simulator.
        workplace: home and table.
        receiver: what planning and Safe see of the person: the hand, or arm, torso and head too.
        estimate: the hand that a planner may see.
        execution_error: what a real robot adds to the poses.
        object_errors: how far the object's frame that methods see is from the true one.
        candidates: grasps that methods choose from; no verdict depends on it. filtered: those that
            the gripper can hold; as-generated: all that the sampler proposes; narrow: of the
            filtered ones those across which the whole object fits into the open gripper.
        width: Stability measures the material between the pads, or the whole object's extent.
        reach: Reach measures the object, or its convex hull.
        stability: physics: the friction grasp must also outlast a shake.
        averages: how a split's rates are averaged in tables: each trial, or each object, counts the
            same.
        chunk: trials held in memory at once.
        name: of the preset.
    """

    thresholds: Thresholds = field(default_factory=Thresholds)
    ik: IkConfig = field(default_factory=IkConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    execute: ExecConfig = field(default_factory=ExecConfig)
    workplace: Workplace = field(default_factory=Workplace)
    receiver: Literal["hand", "body"] = "hand"
    estimate: EstimateConfig = field(default_factory=EstimateConfig)
    execution_error: ExecutionError = field(default_factory=ExecutionError)
    object_errors: ObjectErrors = field(default_factory=ObjectErrors)
    candidates: Literal["filtered", "as-generated", "narrow"] = "filtered"
    width: Literal["pads", "whole"] = "pads"
    reach: Literal["solid", "hull"] = "solid"
    stability: Literal["geometric", "physics"] = "geometric"
    averages: Literal["trials", "objects"] = "trials"
    chunk: Annotated[int, Field(ge=1, le=1 << 20)] = 2048
    name: str = "default"

    def for_robot(self, home_q: tuple[float, ...], max_velocity_rad_s: float) -> "EvalConfig":
        """The same with a robot's home and speed in place of the UR5e's, which are the defaults.

        Args:
            home_q: its home posture, rad.
            max_velocity_rad_s: speed limit of its slowest joint.
        """
        place, law = self.workplace, self.execute
        if place.home_q == HOME_Q:
            place = replace(place, home_q=home_q)
        if law.max_velocity_rad_s == ExecConfig.max_velocity_rad_s:
            law = replace(law, max_velocity_rad_s=max_velocity_rad_s)
        return replace(self, workplace=place, execute=law)

    @staticmethod
    def preset(name: str) -> "EvalConfig":
        """A named configuration.

        Args:
            name: `default`, `paper` to compare with the paper's figures, or `release` for the
                definitions of the authors' public release (docs/release.md).
        """
        return MADE_BY[one_of(*PRESET_NAMES)("name", name)]()


def _paper() -> EvalConfig:
    plan = PlanConfig(goals="one", hand="estimated", edge_check="moveit", hand_clearance_m=0.0)
    return EvalConfig(
        plan=plan,
        estimate=EstimateConfig(errors="tails"),
        candidates="as-generated",
        name="paper",
    )


def _release() -> EvalConfig:
    return EvalConfig(
        plan=PlanConfig(hand_clearance_m=0.0, range_rad=0.25, rounds=(200,), shortcuts=0),
        execute=ExecConfig(
            scale=1.0, max_velocity_rad_s=0.6, max_acceleration_rad_s2=1e3, sim="none"
        ),
        candidates="narrow",
        width="whole",
        reach="hull",
        averages="objects",
        name="release",
    )


MADE_BY: dict[str, Callable[[], EvalConfig]] = {
    "default": EvalConfig,
    "paper": _paper,
    "release": _release,
}
"""Name of a preset -> the function that makes it."""

if tuple(MADE_BY) != PRESET_NAMES:
    raise ValueError(
        f"registry.PRESETS names {', '.join(PRESET_NAMES)}; MADE_BY must name the same"
    )
