"""One trial of one method as it was judged, whole: what is drawn, filmed, exported."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.config import Workplace
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.view.postures import Postures

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StoredTrial:
    """One trial of one method as it was judged: what a run folder says, and the trial itself made
    from its protocol. Poses `T_a_b` are 4x4 in metres."""

    header: dict[str, Any]  # as in run.json: configuration, protocol, motion
    method: str
    row: dict[str, Any]  # of trials and details
    T_obj_ee: Array  # as predicted
    T_obj_ee_attached: Array  # after closing moved the object between the pads
    T_world_ee: Array
    T_world_hand: Array
    q: Array  # (W, joints) rad, waypoints; home alone where no path was found
    time_s: Array  # (W,)
    executed_q: Array | None  # (S, joints) rad every `motion.sample_s` s; None: not simulated
    object_model: Any
    hand_set: Any = None  # None: the built-in one
    robot: Robot = field(default_factory=load_robot)
    workplace: Workplace = field(default_factory=Workplace)
    receiver: Array | None = None  # (5, 4) as in Trials.receiver, where the protocol has a person
    asked: Postures | None = None  # what planning met at the target, where there is no path
    planned_q: Array | None = None  # (P, joints) rad where q was executed; None: q is the plan
    believed: bool = False  # the bodies are those that planning believed in
    room_m: float = 0.0  # planning grew the person by this
    note: str = ""  # where what was computed again is not what is stored
    resting: Array | None = None  # T_world_obj of an object that nobody holds yet; None: it is held
    before: "tuple[StoredTrial, ...]" = ()  # legs before the motion: how the object was picked
    goes_on: bool = False  # it is such a leg

    @property
    def target_q(self) -> Array:
        """The posture (joints,) at the target, or the one that comes nearest to it."""
        return self.q[-1] if self.asked is None else self.asked.q

    @property
    def head_clearance_m(self) -> float:
        """What robot and object keep from the head, m."""
        return float(self.header.get("head_clearance_m", 0.0))

    @property
    def given(self) -> bool:
        """Whether the motion came from a file: joints move at a constant rate between samples."""
        return self.moves and self.row["t_plan_s"] is None

    @property
    def start(self) -> Array:
        """Where the trial's motion begins, rad: at home, or where the arm has lifted the object from the table."""
        carried = self.moves and "passed_pick" in self.row
        return self.q[0] if carried else np.array(self.workplace.home_q)

    @property
    def unreachable(self) -> bool:
        """Whether no posture reaches the target."""
        asked = self.row["pick_reason" if self.row["outcome"] == "pick" else "plan_reason"]
        return asked in ("ik_unreachable", "ik_not_found", "out_of_reach")

    @property
    def moves(self) -> bool:
        """Whether there is a path."""
        return len(self.q) > 1
