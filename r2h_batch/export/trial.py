"""One stored trial as a folder that plain MuJoCo opens: `r2h-batch scene --run DIR --trial ID --out
DIR2`.

scene.xml, meshes/   robot, gripper at its opening, object, hand, table; the ghost at the target,
palm, ball, region, fingers
                     as they hold and as they come; key frames `home`, `target` and, where there is
                     a path, `goal`
play.py              plays the trajectory with nothing but mujoco and numpy
trajectory.csv       time_s and the six joints (rad): the planned motion (the servos' reference) at
100 Hz and all waypoints executed.csv         the same of the motion that the simulator made of it,
every sample; only where one was run trial.json           poses, verdict, margins, witness, reasons,
digests
"""

import json
from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.bodies.hand import HandSet, load_hand_set
from r2h_batch.bodies.robot import load_robot
from r2h_batch.config import Thresholds
from r2h_batch.export.mjcf import TrialBodies, trial_spec, write_scene
from r2h_batch.export.stored import StoredTrial
from r2h_batch.scene.tables import Hands
from r2h_batch.verdicts import CRITERIA

Array = NDArray[np.float64]

RATE_HZ = 100.0


def spec_of(stored: StoredTrial) -> mujoco.MjSpec:
    """The trial's model with its key frames: `home`, `target` (the posture asked for), and `goal`
    where a path leads there."""
    configuration = stored.header["configuration"]
    bodies = TrialBodies(
        stored.object_model, configuration["plan"]["object_collision"], stored.row["hand_index"],
        stored.T_obj_ee_attached, stored.T_world_hand, float(stored.row["opening_m"]), stored.T_world_ee,
        float(stored.row["grasp_shift_m"] or 0.0), stored.row["width_m"],
        Thresholds(**configuration["thresholds"]), stored.workplace, stored.receiver,
        configuration.get("receiver") == "body",
    )  # fmt: skip
    goal = [("goal", stored.q[-1])] if stored.moves else []
    keyframes = [("home", np.array(stored.workplace.home_q)), *goal, ("target", stored.target_q)]
    return trial_spec(load_robot(), _posed(stored.hand_set or load_hand_set()), bodies, keyframes)


@lru_cache(maxsize=2)
def _posed(hand_set: HandSet) -> Hands:
    """All hands of a set, posed once."""
    return Hands.posed(hand_set.model, hand_set)


def export_trial(stored: StoredTrial, out: str | Path) -> Path:
    """Writes scene.xml, play.py, trajectory.csv, executed.csv and trial.json; returns the folder.
    Such files are replaced."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    write_scene(folder, spec_of(stored))
    (folder / "play.py").write_text(
        files("r2h_batch.export").joinpath("play.py").read_text(), encoding="utf-8"
    )
    robot = load_robot()
    _write_csv(folder / "trajectory.csv", robot.joints, *trajectory(stored))
    executed = folder / "executed.csv"
    if stored.executed_q is None:
        executed.unlink(missing_ok=True)  # of an earlier export
    else:
        sample_s = stored.header["motion"]["sample_s"]
        _write_csv(
            executed, robot.joints, sample_s * np.arange(len(stored.executed_q)), stored.executed_q
        )
    (folder / "trial.json").write_text(
        json.dumps(describe(stored), indent=1, allow_nan=False) + "\n"
    )
    return folder


def _write_csv(path: Path, joints: Sequence[str], time_s: Array, q: Array) -> None:
    rows = (",".join(f"{x:.9g}" for x in (t, *row)) for t, row in zip(time_s, q, strict=True))
    path.write_text("\n".join([",".join(("time_s", *joints)), *rows]) + "\n")


def trajectory(stored: StoredTrial, rate_hz: float = RATE_HZ) -> tuple[Array, Array]:
    """Times (N,) and postures (N, 6) of the planned motion: `rate_hz` samples and every waypoint,
    in order."""
    execute = stored.header["configuration"]["execute"]
    speed, gain = (
        execute["scale"] * execute[k] for k in ("max_velocity_rad_s", "max_acceleration_rad_s2")
    )
    times, postures, start = [0.0], [stored.q[0]], 0.0
    for a, b in zip(stored.q[:-1], stored.q[1:], strict=True):
        far = float(np.abs(b - a).max())
        duration = far / speed + speed / gain if far >= speed**2 / gain else 2 * (far / gain) ** 0.5
        first = int(np.floor(start * rate_hz)) + 1
        inner = np.arange(first, int(np.ceil((start + duration) * rate_hz))) / rate_hz - start
        inner = inner[(inner > 1e-6) & (inner < duration - 1e-6)]
        for t in inner:
            times.append(start + t)
            postures.append(a + (b - a) * (_travelled(t, far, duration, speed, gain) / far))
        start += duration
        times.append(start)
        postures.append(b)
    return np.array(times), np.array(postures)


def _travelled(t: float, far: float, duration: float, speed: float, gain: float) -> float:
    """How far (rad) the joint that sets the pace has come at time t of a trapezoid of speed."""
    if t > duration / 2:
        return far - _travelled(duration - t, far, duration, speed, gain)
    ramp = min(speed / gain, duration / 2)
    return 0.5 * gain * t * t if t <= ramp else 0.5 * gain * ramp * ramp + speed * (t - ramp)


def describe(stored: StoredTrial) -> dict[str, Any]:
    """The contents of trial.json. Poses are row-major 4x4, metres; T_a_b takes coordinates in b to
    a."""
    row, header = stored.row, stored.header
    T_world_obj = stored.T_world_ee @ np.linalg.inv(stored.T_obj_ee_attached)
    return {
        "trial_id": row["trial_id"],
        "protocol": header["protocol"],
        "method": stored.method,
        "object": row["object"],
        "split": row["split"],
        "side": row["side"],
        "hand_index": row["hand_index"],
        "outcome": row["outcome"],
        "passed": {c: row[f"passed_{c}"] for c in CRITERIA},
        "margin_m": {c: _finite(row[f"margin_{c}_m"]) for c in CRITERIA},
        "borderline": row["borderline"],
        "plan_reason": row["plan_reason"],
        "plan_pair": row["plan_pair"],
        "witness": {
            "plan_part": row["witness_plan_part"],
            "safe_part": row["witness_safe_part"],
            "safe_time_s": row["witness_time_s"],
            "safe_point_world_m": row["witness_point_m"],
        },
        "poses": {
            "T_obj_ee": stored.T_obj_ee.tolist(),
            "T_obj_ee_attached": stored.T_obj_ee_attached.tolist(),
            "T_world_ee": stored.T_world_ee.tolist(),
            "T_world_hand": stored.T_world_hand.tolist(),
            "T_world_obj_at_goal": T_world_obj.tolist(),
        },
        "width_m": row["width_m"],
        "opening_m": row["opening_m"],
        "grasp_shift_m": row["grasp_shift_m"],
        "t_plan_s": row["t_plan_s"],
        "t_exec_s": row["t_exec_s"],
        "q_goal": row["q_goal"],
        "q_target": stored.target_q.tolist(),
        "target_clearance_m": _finite(stored.asked_clearance_m),
        "note": stored.note,
        "waypoints": stored.q.tolist() if len(stored.q) > 1 else [],
        "waypoint_time_s": stored.time_s.tolist() if len(stored.q) > 1 else [],
        "configuration": header["configuration"],
        "digests": header["digests"],
        "versions": header["versions"],
        "git_commit": header.get("git_commit"),
    }


def _finite(value: float | None) -> float | str | None:
    """JSON has no infinities: Plan's margin without a path is the string "-inf"."""
    return value if value is None or np.isfinite(value) else repr(float(value))
