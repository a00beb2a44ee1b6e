"""Every number a verdict depends on, in SI units, each with where it comes from."""

import math
from dataclasses import dataclass, field
from typing import Literal, SupportsIndex

from r2h_batch.checks import Rule, given, kind, many, number, one_of, text, whole

HOME_Q = (-0.3225, -1.7453, 1.4312, -1.2566, -1.5708, 1.2483)
"""Start of every trial, rad: gripper straight down, TCP at (0.421, 0, 0.449) m [choice]."""

OPEN_GAP_M = 0.085
"""Gap between the pads of the open gripper: the published stroke of the 2F-85."""

CLOSED_GAP_M = 0.0015112
"""Gap that the closed gripper's pads leave: the linkage at its stop
(`bodies.robot.gap_from_drive(drive_upper)`)."""

BALL_OFFSET_M = 0.12
"""d_h: how far in front of the palm the centre of the ball lies that an object must meet to be
within reach."""

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


PAD_SQUEEZE_CAP_M = 0.01
"""What two rubber pads can give in total, generously."""


def _hold(owner: object, **rules: Rule) -> None:
    """Hold fields to rules; numbers of NumPy become Python's, which a run folder can store."""
    for name, rule in rules.items():
        object.__setattr__(
            owner, name, rule(f"{type(owner).__name__}.{name}", getattr(owner, name))
        )


_ABOVE_0 = number(0, above=True)


@dataclass(frozen=True)
class Thresholds:
    """Where a criterion turns from pass to fail (paper, Sec. Evaluation Metrics)."""

    w_max_m: float = OPEN_GAP_M
    w_min_m: float = CLOSED_GAP_M  # thinner material is not held: the closed pads do not reach it
    reach_radius_m: float = 0.10  # r_h
    reach_offset_m: float = BALL_OFFSET_M
    safe_margin_m: float = 0.0  # distance a hand must keep to count as untouched
    # [choice] the rubber pads give this much in total: fingers that hold a region meet it
    pad_squeeze_m: float = 0.001

    def __post_init__(self) -> None:
        wide = number(
            0, OPEN_GAP_M, above=True, what=": the open gripper's pads are so far apart, in metres"
        )
        squeeze = number(0, PAD_SQUEEZE_CAP_M, what=" metres: rubber pads give no more")
        _hold(
            self,
            w_max_m=wide,
            reach_radius_m=_ABOVE_0,
            reach_offset_m=_ABOVE_0,
            pad_squeeze_m=squeeze,
        )
        _hold(self, safe_margin_m=number(0, what=" metres"), w_min_m=number(0, what=" metres"))
        if not self.w_min_m < self.w_max_m:
            raise ValueError(
                f"Thresholds.w_min_m is {self.w_min_m:g}; it must be below w_max_m, {self.w_max_m:g}"
            )
        if (
            not self.safe_margin_m < CLEARANCE_CAP_M
        ):  # nobody would keep a distance that is not measured
            raise ValueError(
                f"Thresholds.safe_margin_m is {self.safe_margin_m:g}; the hand's distance is measured up to"
                f" {CLEARANCE_CAP_M:g} m, so it must be below that"
            )


@dataclass(frozen=True)
class IkConfig:
    """Who finds the joint angles of a handover pose. Which branches exist is proven by the closed
    form in both."""

    solver: Literal["fused", "pytorch-kinematics"] = (
        "fused"  # a Warp kernel; or that package's batched Jacobian, 300 x slower
    )

    def __post_init__(self) -> None:
        _hold(self, solver=one_of("fused", "pytorch-kinematics"))


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
            words = f"it must be {count} numbers from {low:.4g} to {high:.4g}"
            said = getattr(self, name)
            try:
                value = tuple(float(x) for x in said)
            except (TypeError, ValueError, RuntimeError):
                raise TypeError(f"Workplace.{name} is {given(said)}; {words}") from None
            if len(value) != count or not all(
                low <= x <= high for x in value
            ):  # NaN is in no range
                raise ValueError(f"Workplace.{name} is {value}; {words}")
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class PlanConfig:
    """How a path from home to the handover pose is looked for."""

    goals: Literal["set", "one"] = "set"  # all collision-free branches, or the paper's single one
    hand: Literal["true", "estimated"] = (
        "true"  # which hand paths keep clear of; all else is judged on the true one
    )
    edge_check: Literal["exact", "moveit"] = (
        "exact"  # conservative advancement, or samples at MoveIt's resolution
    )
    object_collision: Literal["hull", "pieces"] = "hull"
    hand_clearance_m: float = 0.003  # kept along the path wherever the goal keeps it [choice]
    range_rad: float = 1.5  # longest RRT extension
    rounds: tuple[int, ...] = (50, 500, 3000, 5000)  # iterations of each budget round
    # waypoints pulled, segments joined: tries after the quickest subset of the waypoints is found
    shortcuts: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        _hold(self, goals=one_of("set", "one"), hand=one_of("true", "estimated"))
        _hold(self, edge_check=one_of("exact", "moveit"), object_collision=one_of("hull", "pieces"))
        _hold(
            self,
            range_rad=_ABOVE_0,
            hand_clearance_m=number(0, what=" metres"),
            shortcuts=whole(0),
            seed=whole(),
        )
        _hold(self, rounds=many(SupportsIndex, "iterations of each round"))
        _hold(
            self,
            rounds=lambda name, rounds: tuple(
                whole(1)(f"{name}[{i}]", n) for i, n in enumerate(rounds)
            ),
        )


@dataclass(frozen=True)
class EstimateConfig:
    """The hand that a planner with `PlanConfig.hand = "estimated"` sees:
    `predictors.predict_target` with the same numbers."""

    errors: Literal["normal", "frames", "tails"] = "normal"  # `PredictorNoise.target_errors`
    factor: float = 1.0  # on all of them; 0: the truth
    seed: int = 0  # of the methods: they and the planner see the same hand

    def __post_init__(self) -> None:
        _hold(self, errors=one_of("normal", "frames", "tails"), seed=whole())
        _hold(self, factor=number(0, what=": 0 is the truth, 1 the default"))


@dataclass(frozen=True)
class ExecConfig:
    """The time law (a trapezoid per segment, all joints together, at a fraction of the joint
    limits), and who moves the arm."""

    scale: float = 0.1  # MoveIt 2's default velocity and acceleration scaling
    max_velocity_rad_s: float = math.pi
    max_acceleration_rad_s2: float = 5.0
    sim: Literal["auto", "none", "mujoco", "mjwarp"] = (
        "auto"  # auto: mujoco on a CPU, mjwarp on CUDA; none: kinematic
    )
    # What is simulated: the whole scene; the arm with a rigid gripper and no contacts; auto: the
    # arm, and again the whole scene where a contact is not ruled out (docs/choices.md).
    model: Literal["auto", "scene", "arm"] = "auto"
    step_s: float = 0.002  # of simulator and servos: the real controller's 500 Hz
    record_steps: int = 4  # steps between two samples of the executed motion
    payload: Literal["known", "unknown"] = (
        "known"  # whether the controller compensates the object's weight
    )
    settle_position_m: float = 0.001  # at rest: the ee stays this near to the goal,
    settle_rotation_rad: float = math.radians(0.5)  # and turned by no more than this
    settle_s: float = (
        12.0  # at rest later than this after its reference has ended: Plan failure, not_settled
    )
    dwell_s: float = (
        0.5  # it is watched this long after its reference has ended, and must stay for half of that
    )

    def __post_init__(self) -> None:
        _hold(
            self,
            sim=one_of("auto", "none", "mujoco", "mjwarp"),
            model=one_of("auto", "scene", "arm"),
        )
        _hold(self, payload=one_of("known", "unknown"), record_steps=whole(1, what=" of steps"))
        lengths = ("settle_position_m", "settle_rotation_rad", "settle_s", "dwell_s")
        for name in ("scale", "max_velocity_rad_s", "max_acceleration_rad_s2", "step_s", *lengths):
            _hold(self, **{name: _ABOVE_0})

    def engine(self, device: str) -> Literal["none", "mujoco", "mjwarp"]:
        """The engine that `sim` means on a device."""
        if self.sim != "auto":
            return self.sim
        return "mujoco" if device == "cpu" else "mjwarp"


@dataclass(frozen=True)
class EvalConfig:
    """All of it. `preset("paper")` differs from the default where the paper's pipeline is known to
    differ."""

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
    width: Literal["pads", "whole"] = (
        "pads"  # material between the pads, or the whole object's extent
    )
    stability: Literal["geometric", "physics"] = (
        "geometric"  # physics: the friction grasp must also outlast a shake
    )
    chunk: int = 2048  # trials held in memory at once
    name: str = "default"

    def __post_init__(self) -> None:
        parts = {
            "thresholds": Thresholds,
            "ik": IkConfig,
            "plan": PlanConfig,
            "execute": ExecConfig,
        }
        for name, part in {**parts, "workplace": Workplace, "estimate": EstimateConfig}.items():
            _hold(self, **{name: kind(part)})
        _hold(self, receiver=one_of("hand", "body"), candidates=one_of("filtered", "as-generated"))
        _hold(self, width=one_of("pads", "whole"), stability=one_of("geometric", "physics"))
        _hold(self, chunk=whole(1, what=" of trials"), name=text)

    @staticmethod
    def preset(name: str) -> "EvalConfig":
        """`default` (to be right) or `paper` (to compare with the paper's figures)."""
        if one_of("default", "paper")("name", name) == "default":
            return EvalConfig()
        plan = PlanConfig(goals="one", hand="estimated", edge_check="moveit", hand_clearance_m=0.0)
        return EvalConfig(
            plan=plan,
            estimate=EstimateConfig(errors="tails"),
            candidates="as-generated",
            name="paper",
        )
