"""A planned motion as an arm's controller reads it: CSV, ROS 2 `trajectory_msgs/JointTrajectory` as JSON, URScript.

Formats from their public definitions: ROS 2 `trajectory_msgs/msg/JointTrajectory.msg` and the URScript manual of e-Series
(`servoj`, `set_tcp`, `set_payload`, `popup`). Neither needs ROS or a robot here.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import UsageError
from r2h_batch.scene.robot import Robot, forward_kinematics
from r2h_batch.view.lab.frames import turn_vector
from r2h_batch.view.mjcf import posture_at, trajectory
from r2h_batch.view.stored_trial import StoredTrial

Array = NDArray[np.float64]

AT_START_RAD = 0.01
"""The arm may stand this far from a path's first posture, each joint [choice]."""
LOOKAHEAD_S, GAIN = 0.1, 300
"""URScript's own defaults for `servoj`."""
FINE_S = 0.002
"""Step in which the fastest moment of a path is looked for."""


@dataclass(frozen=True)
class Path:
    """A motion in even steps.

    Attributes:
        joints: their names.
        time_s: (N,) s from the start.
        q: (N, J) rad.
        velocity: (N, J) rad/s.
        slower: how many times longer it takes than the run's motion.
    """

    joints: tuple[str, ...]
    time_s: Array
    q: Array
    velocity: Array
    slower: float

    @property
    def back(self) -> "Path":
        """The same postures in the other order."""
        return Path(
            self.joints,
            self.time_s[-1] - self.time_s[::-1],
            self.q[::-1],
            -self.velocity[::-1],
            self.slower,
        )


def path_of(stored: StoredTrial, *, step_s: float, tcp_speed: float) -> Path:
    """The planned motion, as slow as the TCP's highest speed must be.

    Args:
        stored: a trial with a path.
        step_s: between two postures, s.
        tcp_speed: highest speed of the TCP, m/s; a motion that stays below keeps its own speed.

    Raises:
        UsageError: the trial has no path, or its path was found in closed loop.
    """
    if not stored.moves:
        row = stored.row
        raise UsageError(
            f"trial {row['trial_id']} of {stored.method!r} has no path ({row['outcome']}); choose trials with one"
        )
    if stored.planned_q is not None:
        raise UsageError(
            f"trial {stored.row['trial_id']} was moved in closed loop, after a hand that a laboratory does not have;"
            " export a sweep without --receiver-motion"
        )
    end = float(stored.time_s[-1]) if stored.given else float(trajectory(stored)[0][-1])
    slower = max(_fastest(stored, end) / tcp_speed, 1.0)
    time_s = np.append(np.arange(0.0, slower * end - step_s / 2, step_s), slower * end)
    own = time_s / slower
    q, ahead = postures(stored, own), step_s / slower / 2
    # joints speed up evenly between two corners of the speed, where a central difference is exact
    before, after = np.clip(own - ahead, 0.0, end), np.clip(own + ahead, 0.0, end)
    velocity = (postures(stored, after) - postures(stored, before)) / (slower * 2 * ahead)
    velocity[[0, -1]] = 0.0
    return Path(stored.robot.joints, time_s, q, velocity, slower)


def postures(stored: StoredTrial, time_s: Array) -> Array:
    """Postures (N, J) rad of the motion that the run planned or was given, at times (N,) s of its own."""
    if not stored.given:
        return posture_at(stored, time_s)
    return np.stack([np.interp(time_s, stored.time_s, joint) for joint in stored.q.T], 1)


def _fastest(stored: StoredTrial, end: float) -> float:
    """The highest speed of the TCP, m/s."""
    time_s = np.linspace(0.0, end, max(int(end / FINE_S), 2) + 1)
    p = tcp_of(stored.robot, postures(stored, time_s))[:, :3, 3]
    return float(np.linalg.norm(np.diff(p, axis=0), axis=1).max() / (time_s[1] - time_s[0]))


def tcp_of(robot: Robot, q: Array) -> Array:
    """`T_world_ee` (N, 4, 4) of postures (N, J)."""
    wrist = len(robot.joints)
    return np.stack([forward_kinematics(robot, row)[wrist] @ robot.T_wrist3_ee for row in q])


def csv_of(path: Path) -> str:
    """Columns time_s, then q_JOINT (rad) and v_JOINT (rad/s) of each joint."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time_s", *(f"{k}_{name}" for k in "qv" for name in path.joints)])
    for t, q, v in zip(path.time_s, path.q, path.velocity, strict=True):
        writer.writerow([f"{x:.6f}" for x in (t, *q, *v)])
    return text.getvalue()


def ros2_of(path: Path) -> dict[str, Any]:
    """The fields of `trajectory_msgs/JointTrajectory`; `header.frame_id` is `base_link`."""
    points = []
    for t, q, v in zip(path.time_s, path.q, path.velocity, strict=True):
        ns = round(float(t) * 1e9)
        points.append(
            {
                "positions": q.round(9).tolist(),
                "velocities": v.round(9).tolist(),
                "accelerations": [],
                "effort": [],
                "time_from_start": {"sec": ns // 10**9, "nanosec": ns % 10**9},
            }
        )
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "base_link"},
        "joint_names": list(path.joints),
        "points": points,
    }


def urscript_of(
    path: Path, name: str, robot: Robot, *, load_kg: float, load_m: Sequence[float]
) -> str:
    """A URScript program that follows the path with `servoj`; before it moves, it refuses another first posture.

    Args:
        path: of a UR.
        name: of the program: letters, digits and _.
        robot: for the TCP.
        load_kg: mass at the flange, gripper and what it holds.
        load_m: (3,) its centre in the flange's frame, m.
    """
    T, step_s = robot.T_flange_ee, float(path.time_s[1] - path.time_s[0])
    tcp = _numbers([*T[:3, 3], *turn_vector(T[:3, :3])])
    wrong = (
        f"The arm does not stand at the first posture of {name}. Move it there, then start again."
    )
    lines = [
        f"def {name}():",
        f"  set_tcp(p[{tcp}])",
        f"  set_payload({load_kg:.3f}, [{_numbers(load_m)}])",
        f"  local first = [{_numbers(path.q[0])}]",
        "  local here = get_actual_joint_positions()",
        "  local i = 0",
        f"  while i < {len(path.joints)}:",
        f"    if norm(here[i] - first[i]) > {AT_START_RAD}:",
        f'      popup("{wrong}", title="r2h_batch", error=True, blocking=True)',
        "      halt",
        "    end",
        "    i = i + 1",
        "  end",
    ]
    steps = np.diff(path.time_s)
    for q, dt in zip(path.q[1:], steps, strict=True):
        # the last step may be shorter than the controller's: it then waits for a whole one
        hold = max(float(dt), step_s)
        lines.append(
            f"  servoj([{_numbers(q)}], t={hold:.4f}, lookahead_time={LOOKAHEAD_S}, gain={GAIN})"
        )
    return "\n".join([*lines, "  stopj(2.0)", "end", f"{name}()", ""])


def _numbers(values: Sequence[float] | Array) -> str:
    return ", ".join(f"{x + 0.0:.6f}" for x in np.round(np.asarray(values, np.float64), 6))
