"""Every number a verdict depends on, in SI units, each with where it comes from."""

import math
from dataclasses import dataclass, field
from typing import Literal

HOME_Q = (-0.3225, -1.7453, 1.4312, -1.2566, -1.5708, 1.2483)
"""Start of every trial, rad: gripper straight down, TCP at (0.421, 0, 0.449) m [choice]."""

OPEN_GAP_M = 0.085
"""Gap between the pads of the open gripper: the published stroke of the 2F-85."""

CLOSED_GAP_M = 0.0015112
"""Gap that the closed gripper's pads leave: the linkage at its stop (`bodies.robot.gap_from_drive(drive_upper)`)."""

BALL_OFFSET_M = 0.12
"""d_h: how far in front of the palm the centre of the ball lies that an object must meet to be within reach."""

TABLE_CENTER = (-0.025, 0.0, -0.025)
TABLE_HALF = (0.475, 0.6, 0.025)
"""Top at z = 0, x from -0.5 to 0.45 m, |y| <= 0.6 m [choice]; 5 cm thick."""

CLEARANCE_CAP_M = 0.05
"""Clearances are exact below this and a lower bound above it."""

FARTHEST_M = 1e6
"""Reach is exact up to here: an object farther away counts as this far."""

CLEARANCE_TOLERANCE_M = 1e-4
"""How exactly the smallest clearance along a path is located."""

BORDERLINE_M = 1e-4
"""Half width of the band around a threshold in which float32 geometry is not trusted."""


def _positive(owner: object, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        if not (isinstance(value, (int, float)) and math.isfinite(value) and value > 0):
            raise ValueError(f"{type(owner).__name__}.{name} is {value!r}; it must be a finite number above 0")


def _one_of(owner: object, name: str, allowed: tuple[str, ...]) -> None:
    if getattr(owner, name) not in allowed:
        raise ValueError(f"{type(owner).__name__}.{name} is {getattr(owner, name)!r}; allowed are {', '.join(allowed)}")


@dataclass(frozen=True)
class Thresholds:
    """Where a criterion turns from pass to fail (paper, Sec. Evaluation Metrics)."""

    w_max_m: float = OPEN_GAP_M
    w_min_m: float = CLOSED_GAP_M  # thinner material is not held: the closed pads do not reach it
    reach_radius_m: float = 0.10  # r_h
    reach_offset_m: float = BALL_OFFSET_M
    safe_margin_m: float = 0.0  # distance a hand must keep to count as untouched
    pad_squeeze_m: float = 0.001  # [choice] the rubber pads give this much in total: fingers that hold a region meet it

    def __post_init__(self) -> None:
        _positive(self, "w_max_m", "reach_radius_m", "reach_offset_m")
        if self.safe_margin_m < 0 or self.pad_squeeze_m < 0 or not 0 <= self.w_min_m < self.w_max_m:
            raise ValueError(
                "Thresholds.safe_margin_m, pad_squeeze_m and w_min_m must be 0 or more metres, w_min_m below w_max_m"
            )
        if not self.safe_margin_m < CLEARANCE_CAP_M:  # nobody would keep a distance that is not measured
            raise ValueError(
                f"Thresholds.safe_margin_m is {self.safe_margin_m:g}; the hand's distance is measured up to"
                f" {CLEARANCE_CAP_M:g} m, so it must be below that"
            )


@dataclass(frozen=True)
class IkConfig:
    """Who finds the joint angles of a handover pose. Which branches exist is proven by the closed form in both."""

    solver: Literal["fused", "pytorch-kinematics"] = (
        "fused"  # a Warp kernel; or that package's batched Jacobian, 300 x slower
    )

    def __post_init__(self) -> None:
        _one_of(self, "solver", ("fused", "pytorch-kinematics"))


@dataclass(frozen=True)
class Workplace:
    """Where the arm starts, and the table that it stands at: world frame, metres and radians."""

    home_q: tuple[float, ...] = HOME_Q
    table_center: tuple[float, ...] = TABLE_CENTER
    table_half: tuple[float, ...] = TABLE_HALF

    def __post_init__(self) -> None:
        for name, count, low, high in (
            ("home_q", 6, -2 * math.pi, 2 * math.pi), ("table_center", 3, -10.0, 10.0), ("table_half", 3, 1e-3, 10.0),
        ):  # fmt: skip
            value = tuple(float(x) for x in getattr(self, name))
            if len(value) != count or not all(low <= x <= high for x in value):  # NaN is in no range
                raise ValueError(
                    f"Workplace.{name} is {value}; it must be {count} numbers from {low:.4g} to {high:.4g}"
                )
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class PlanConfig:
    """How a path from home to the handover pose is looked for."""

    goals: Literal["set", "one"] = "set"  # all collision-free branches, or the paper's single one
    hand: Literal["true", "estimated"] = "true"  # which hand paths keep clear of; all else is judged on the true one
    edge_check: Literal["exact", "moveit"] = "exact"  # conservative advancement, or samples at MoveIt's resolution
    object_collision: Literal["hull", "pieces"] = "hull"
    hand_clearance_m: float = 0.003  # kept along the path wherever the goal keeps it [choice]
    range_rad: float = 1.5  # longest RRT extension
    rounds: tuple[int, ...] = (50, 500, 3000, 5000)  # iterations of each budget round
    shortcuts: int = 8  # waypoints pulled, segments joined: tries after the quickest subset of the waypoints is found
    seed: int = 0

    def __post_init__(self) -> None:
        _one_of(self, "goals", ("set", "one"))
        _one_of(self, "hand", ("true", "estimated"))
        _one_of(self, "edge_check", ("exact", "moveit"))
        _one_of(self, "object_collision", ("hull", "pieces"))
        _positive(self, "range_rad")
        if self.hand_clearance_m < 0:
            raise ValueError(f"PlanConfig.hand_clearance_m is {self.hand_clearance_m}; it must be 0 or more metres")
        if not self.rounds or any(n < 1 for n in self.rounds) or self.shortcuts < 0:
            raise ValueError(
                f"PlanConfig.rounds is {self.rounds}, shortcuts {self.shortcuts}; rounds must be 1 or more"
            )


@dataclass(frozen=True)
class EstimateConfig:
    """The hand that a planner with `PlanConfig.hand = "estimated"` sees: `predictors.predict_target` with the same numbers."""

    errors: Literal["normal", "frames", "tails"] = "normal"  # `PredictorNoise.target_errors`
    factor: float = 1.0  # on all of them; 0: the truth
    seed: int = 0  # of the methods: they and the planner see the same hand

    def __post_init__(self) -> None:
        _one_of(self, "errors", ("normal", "frames", "tails"))
        if not (isinstance(self.factor, (int, float)) and math.isfinite(self.factor) and self.factor >= 0):
            raise ValueError(
                f"EstimateConfig.factor is {self.factor!r}; it must be 0 (the truth) or more, 1 is the default"
            )


@dataclass(frozen=True)
class ExecConfig:
    """The time law (a trapezoid per segment, all joints together, at a fraction of the joint limits), and who moves the arm."""

    scale: float = 0.1  # MoveIt 2's default velocity and acceleration scaling
    max_velocity_rad_s: float = math.pi
    max_acceleration_rad_s2: float = 5.0
    sim: Literal["auto", "none", "mujoco", "mjwarp"] = "auto"  # auto: mujoco on a CPU, mjwarp on CUDA; none: kinematic
    # What is simulated: the whole scene; the arm with a rigid gripper and no contacts; auto: the arm, and again the whole
    # scene where a contact is not ruled out (docs/choices.md).
    model: Literal["auto", "scene", "arm"] = "auto"
    step_s: float = 0.002  # of simulator and servos: the real controller's 500 Hz
    record_steps: int = 4  # steps between two samples of the executed motion
    payload: Literal["known", "unknown"] = "known"  # whether the controller compensates the object's weight
    settle_position_m: float = 0.001  # at rest: the ee stays this near to the goal,
    settle_rotation_rad: float = math.radians(0.5)  # and turned by no more than this
    settle_s: float = 12.0  # at rest later than this after its reference has ended: Plan failure, not_settled
    dwell_s: float = 0.5  # it is watched this long after its reference has ended, and must stay for half of that

    def __post_init__(self) -> None:
        _one_of(self, "sim", ("auto", "none", "mujoco", "mjwarp"))
        _one_of(self, "model", ("auto", "scene", "arm"))
        _one_of(self, "payload", ("known", "unknown"))
        _positive(self, "scale", "max_velocity_rad_s", "max_acceleration_rad_s2", "step_s", "record_steps")
        _positive(self, "settle_position_m", "settle_rotation_rad", "settle_s", "dwell_s")
        if int(self.record_steps) != self.record_steps:
            raise ValueError(f"ExecConfig.record_steps is {self.record_steps}; it must be a whole number of steps")

    def engine(self, device: str) -> Literal["none", "mujoco", "mjwarp"]:
        """The engine that `sim` means on a device."""
        if self.sim != "auto":
            return self.sim
        return "mujoco" if device == "cpu" else "mjwarp"


@dataclass(frozen=True)
class EvalConfig:
    """All of it. `preset("paper")` differs from the default where the paper's pipeline is known to differ."""

    thresholds: Thresholds = field(default_factory=Thresholds)
    ik: IkConfig = field(default_factory=IkConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    execute: ExecConfig = field(default_factory=ExecConfig)
    workplace: Workplace = field(default_factory=Workplace)
    receiver: Literal["hand", "body"] = (
        "hand"  # what planning and Safe see of the person: the hand, or arm and torso too
    )
    estimate: EstimateConfig = field(default_factory=EstimateConfig)
    candidates: Literal["filtered", "as-generated"] = (
        "filtered"  # grasps that methods choose from; nothing is judged by it
    )
    width: Literal["pads", "whole"] = "pads"  # material between the pads, or the whole object's extent
    stability: Literal["geometric", "physics"] = "geometric"  # physics: the friction grasp must also outlast a shake
    chunk: int = 2048  # trials held in memory at once
    name: str = "default"

    def __post_init__(self) -> None:
        _one_of(self, "receiver", ("hand", "body"))
        _one_of(self, "candidates", ("filtered", "as-generated"))
        _one_of(self, "width", ("pads", "whole"))
        _one_of(self, "stability", ("geometric", "physics"))
        if self.chunk < 1:
            raise ValueError(f"EvalConfig.chunk is {self.chunk}; it must be 1 or more trials")

    @staticmethod
    def preset(name: str) -> "EvalConfig":
        """`default` (to be right) or `paper` (to compare with the paper's figures)."""
        if name == "default":
            return EvalConfig()
        if name == "paper":
            plan = PlanConfig(goals="one", hand="estimated", edge_check="moveit", hand_clearance_m=0.0)
            return EvalConfig(
                plan=plan, estimate=EstimateConfig(errors="tails"), candidates="as-generated", name="paper"
            )
        raise ValueError(f"unknown preset {name!r}; allowed are default, paper")
