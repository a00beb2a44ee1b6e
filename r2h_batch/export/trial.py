"""One stored trial as a folder that plain MuJoCo opens: `python -m r2h_batch.scene --run DIR --trial ID --out DIR2`.

scene.xml, meshes/   robot, gripper at its opening, object, hand, table; key frames `home` and `goal`
trajectory.csv       time_s and the six joints (rad): the planned motion (the servos' reference) at 100 Hz and all waypoints
executed.csv         the same of the motion that the simulator made of it, every sample; only where one was run
trial.json           poses, verdict, margins, witness, reasons, digests
"""

import json
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow.compute as pc
import torch
from numpy.typing import NDArray

from r2h_batch import se3
from r2h_batch.benchmark import Benchmark
from r2h_batch.benchmark.given import Given
from r2h_batch.benchmark.of_run import benchmark_of_run
from r2h_batch.bodies.hand import load_hand_set
from r2h_batch.bodies.robot import load_robot
from r2h_batch.config import Workplace
from r2h_batch.export.mjcf import TrialBodies, write_scene
from r2h_batch.files import FileError
from r2h_batch.results.reading import load_run
from r2h_batch.scene.tables import Hands
from r2h_batch.trials.protocol import make_trials, trials_digest, trials_of
from r2h_batch.verdicts import CRITERIA

Array = NDArray[np.float64]

RATE_HZ = 100.0
CHECKED_TRIALS = 20_000
"""Runs of at most this many trials have their whole trial list compared with its digest."""


class ExportError(ValueError):
    """A trial that cannot be exported: the message says what is there and what to do."""


@dataclass(frozen=True)
class StoredTrial:
    """What a run folder says about one trial of one method, and the trial itself made again from its protocol."""

    header: dict[str, Any]
    method: str
    row: dict[str, Any]
    T_obj_ee: Array  # as predicted
    T_obj_ee_attached: Array  # after closing moved the object between the pads
    T_world_ee: Array
    T_world_hand: Array
    q: Array  # (W, 6) waypoints; home alone where no path was found
    time_s: Array  # (W,)
    executed_q: Array | None  # (S, 6) every `motion.sample_s` of run.json; None: not simulated
    object_model: Any
    hand_set: Any = None  # None: the built-in one
    workplace: Workplace = field(default_factory=Workplace)


def load_trial(
    run: str | Path,
    trial_id: int,
    *,
    method: str | None = None,
    object_mesh: Sequence[str] = (),
    given: Given | None = None,
) -> StoredTrial:
    """The trial as it was scored; `given` (or `object_mesh` alone): what the sweep's flags said of the benchmark.

    Raises `ExportError`, `results.RunError`.
    """
    stored = load_run(run)
    header = stored.header
    method = _method(stored, method)
    if "paths" not in header["stored"]:
        raise ExportError(f"{run}: stored without paths; sweep again with --save-paths and another --out")
    configuration = header["configuration"]
    if not {"objects", "motion"} <= header.keys() or not {"plan", "execute"} <= configuration.keys():
        raise ExportError(f"{run}: run.json lacks objects or configuration; it was not made by a sweep")
    rows = stored.trials(method)
    row = _row(rows, trial_id, f"{run}: method {method!r}")
    for details in _rows(stored.details(method), trial_id):
        row |= details
    if row.get("opening_m") is None:
        raise ExportError(f"trial {trial_id} of {method!r} was not judged ({row['outcome']}): there is nothing to show")
    poses = _row(stored.poses(method), trial_id, f"{run}: poses of {method!r}")
    path = _rows(stored.paths(method), trial_id)
    benchmark, T_world_hand = _trial_again(header, row, given or Given(object_mesh=tuple(object_mesh)), str(run))
    T_obj_ee, T_world_ee = (_orthonormal(np.array(poses[k]).reshape(4, 4)) for k in ("T_obj_ee", "T_world_ee"))
    attached = T_obj_ee.copy()
    attached[:3, 3] += T_obj_ee[:3, 1] * np.float32(row["grasp_shift_m"])
    q = np.array(path[0]["q"], np.float64) if path else np.array([benchmark.workplace.home_q])
    time_s = np.array(path[0]["time_s"], np.float64) if path else np.zeros(1)
    executed_q = np.array(path[0]["executed_q"], np.float64) if path and path[0]["executed_q"] else None
    model = next(o for o in benchmark.objects if o.name == row["object"])
    return StoredTrial(
        header, method, row, T_obj_ee, attached, T_world_ee, T_world_hand, q, time_s, executed_q, model,
        benchmark.hand_set, benchmark.workplace,
    )  # fmt: skip


def _method(stored: Any, method: str | None) -> str:
    names = stored.methods
    if method is None and len(names) == 1:
        return str(names[0])
    if method is None:
        raise ExportError(
            f"{stored.folder}: holds several methods, choose one with --method: {', '.join(names) or 'none'}"
        )
    try:
        name = str(stored.named(method))
    except ValueError as error:
        raise ExportError(str(error)) from None
    if name not in names:
        raise ExportError(f"{stored.folder}: {name!r} is not complete; run its sweep again to go on")
    return name


def _rows(table: Any, trial_id: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = table.filter(pc.equal(table["trial_id"], trial_id)).to_pylist()
    return rows


def _row(table: Any, trial_id: int, where: str) -> dict[str, Any]:
    rows = _rows(table, trial_id)
    if not rows:
        ids = table["trial_id"].to_pylist()
        some = ", ".join(map(str, ids[:10])) + (f", ... up to {max(ids)}" if len(ids) > 10 else "")
        raise ExportError(f"{where} has no trial {trial_id}; it has {len(ids)}: {some or 'none'}")
    return rows[0]


def _trial_again(header: dict[str, Any], row: dict[str, Any], given: Given, run: str) -> tuple[Benchmark, Array]:
    """The benchmark of the run and this trial's T_world_hand, made from the protocol and checked against the digests."""
    try:
        benchmark = benchmark_of_run(header, given, run)
    except FileError as error:
        raise ExportError(str(error)) from None
    counts = header["trials"]
    if sum(counts.values()) <= CHECKED_TRIALS and (benchmark.listed is not None or len(set(counts.values())) == 1):
        trials = make_trials(list(counts), max(counts.values()), benchmark=benchmark)
        if trials_digest(trials, objects=benchmark.objects) != header["digests"]["trials"]:
            raise ExportError(
                f"{run}: was made with other trials: export with r2h_batch {header['versions'].get('r2h_batch')}"
                f" at commit {header.get('git_commit')}"
            )
    trial = trials_of(benchmark, torch.tensor([row["trial_id"]], dtype=torch.int64, device="cpu"))
    name = benchmark.objects[int(trial.object_index[0])].name
    if name != row["object"] or int(trial.hand_index[0]) != row["hand_index"]:
        raise ExportError(f"{run}: trial {row['trial_id']} is not the one of {header['protocol']!r}")
    return benchmark, _orthonormal(trial.T_world_hand[0].numpy())


def _orthonormal(T: NDArray[Any]) -> Array:
    """As the evaluator reads a pose: float32, z kept, x and y made orthonormal."""
    return se3.orthonormalise(torch.from_numpy(np.array(T, np.float32))[None])[0].double().numpy()


def export_trial(stored: StoredTrial, out: str | Path) -> Path:
    """Writes scene.xml, trajectory.csv, executed.csv and trial.json; returns the folder. Such files are replaced."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    plan = stored.header["configuration"]["plan"]
    bodies = TrialBodies(
        stored.object_model, plan["object_collision"], stored.row["hand_index"], stored.T_obj_ee_attached,
        stored.T_world_hand, float(stored.row["opening_m"]), stored.workplace,
    )  # fmt: skip
    robot = load_robot()
    keyframes = [("home", np.array(stored.workplace.home_q)), *([("goal", stored.q[-1])] if len(stored.q) > 1 else [])]
    hand_set = stored.hand_set or load_hand_set()
    write_scene(folder, robot, Hands.posed(hand_set.model, hand_set), bodies, keyframes)
    _write_csv(folder / "trajectory.csv", robot.joints, *trajectory(stored))
    executed = folder / "executed.csv"
    if stored.executed_q is None:
        executed.unlink(missing_ok=True)  # of an earlier export
    else:
        sample_s = stored.header["motion"]["sample_s"]
        _write_csv(executed, robot.joints, sample_s * np.arange(len(stored.executed_q)), stored.executed_q)
    (folder / "trial.json").write_text(json.dumps(describe(stored), indent=1, allow_nan=False) + "\n")
    return folder


def _write_csv(path: Path, joints: Sequence[str], time_s: Array, q: Array) -> None:
    rows = (",".join(f"{x:.9g}" for x in (t, *row)) for t, row in zip(time_s, q, strict=True))
    path.write_text("\n".join([",".join(("time_s", *joints)), *rows]) + "\n")


def trajectory(stored: StoredTrial, rate_hz: float = RATE_HZ) -> tuple[Array, Array]:
    """Times (N,) and postures (N, 6) of the planned motion: `rate_hz` samples and every waypoint, in order."""
    execute = stored.header["configuration"]["execute"]
    speed, gain = (execute["scale"] * execute[k] for k in ("max_velocity_rad_s", "max_acceleration_rad_s2"))
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
    """The contents of trial.json. Poses are row-major 4x4, metres; T_a_b takes coordinates in b to a."""
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
        "nearest_pair": row["nearest_pair"],
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


def render_strip(
    folder: str | Path,
    png: str | Path,
    *,
    moments: Sequence[float] = (0.0, 0.6, 1.0),
    width: int = 600,
    height: int = 600,
) -> None:
    """A picture of the exported trial: the moments (fractions of its duration) side by side. Needs MUJOCO_GL=osmesa or egl."""
    folder = Path(folder)
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    motion = folder / "executed.csv" if (folder / "executed.csv").is_file() else folder / "trajectory.csv"
    table = np.loadtxt(motion, delimiter=",", skiprows=1, ndmin=2)
    data.qpos[:] = table[-1, 1:]
    mujoco.mj_forward(model, data)
    camera = _camera(data.body("hand").xipos - data.body("gripper").xipos, data.body("gripper").xipos)
    option = mujoco.MjvOption()
    option.geomgroup[:] = [1, 1, 1, 0, 0, 0]
    frames = []
    with mujoco.Renderer(model, height, width) as renderer:
        for f in moments:
            row = table[np.abs(table[:, 0] - f * table[-1, 0]).argmin()]
            data.qpos[:] = row[1:]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera, option)
            frames.append(renderer.render().copy())
    _write_png(Path(png), np.concatenate(frames, axis=1))


def _camera(gripper_to_hand: Array, gripper: Array) -> Any:
    """A free camera in front of the table that sees hand and gripper beside each other at the goal."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.36, 0.6 * gripper[1], 0.30]
    camera.distance, camera.elevation = 1.6, -14.0
    flat = gripper_to_hand[:2] / max(float(np.linalg.norm(gripper_to_hand[:2])), 1e-6)
    angles = np.radians(np.arange(90, 271, 5))  # looking towards -x, from the receiver's side
    side = np.abs(np.cos(angles) * flat[1] - np.sin(angles) * flat[0])
    camera.azimuth = float(np.degrees(angles[np.argmax(side - 0.35 * np.cos(angles - np.pi) ** 2)]))
    return camera


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    h, w, _ = image.shape
    raw = np.concatenate([np.ones((h, 1), np.uint8), _differences(image).reshape(h, -1)], axis=1).tobytes()
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", w, h, 8, 2, 0, 0, 0)), (b"IDAT", zlib.compress(raw, 9)), (b"IEND", b""))
    body = b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def _differences(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Each pixel less its left neighbour (PNG's filter 1): a rendered scene packs to half the size."""
    out = image.copy()
    out[:, 1:] -= image[:, :-1]
    return out
