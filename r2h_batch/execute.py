"""Motion along a planned path: the time law, and the motion that an engine makes of it."""

from dataclasses import dataclass
from importlib import import_module

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Float64, Int32
from torch import Tensor

from r2h_batch.config import ExecConfig
from r2h_batch.dynamics import SERVO_RATE, Payload, arm_model
from r2h_batch.launch import launch_trials
from r2h_batch.scene import Placed, Scene
from r2h_batch.simulation import Job, Samples


@dataclass(frozen=True)
class Motion:
    """When each waypoint is reached (s, rows beyond the path repeat the end), and T_exec (NaN without a path)."""

    time_s: Float32[Tensor, "b w"]
    t_exec_s: Float32[Tensor, " b"]


@dataclass(frozen=True)
class Executed:
    """The motion that happened, as joint lines between samples `sample_s` apart (kinematic: the planned path itself).

    `t_exec_s`: when the arm came to rest at its goal, NaN where it did not or there is no path. `valid`: False where the
    simulator failed (nothing else of such a row means anything). `slack_m`: how far any point of the robot may have been
    off the lines between two samples.
    """

    path: Float32[Tensor, "b w 6"]
    length: Int32[Tensor, " b"]
    t_exec_s: Float32[Tensor, " b"]
    settled: Bool[Tensor, " b"]
    valid: Bool[Tensor, " b"]
    slack_m: Float32[Tensor, " b"]
    sample_s: float | None


def execute(
    scene: Scene,
    placed: Placed,
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    motion: Motion,
    config: ExecConfig,
    *,
    threads: int | None = None,
) -> Executed:
    """Moves the arm along B paths in the engine of `config`; rows without a path are left out.

    Each trial runs until its reference has ended and `dwell_s` more; what has not come to rest by then runs again, to the
    limit. Rows do not depend on each other.
    """
    engine = config.engine(scene.device)
    if engine == "none":
        true = torch.ones_like(length, dtype=torch.bool)
        return Executed(path, length, motion.t_exec_s, length > 0, true, torch.zeros_like(motion.t_exec_s), None)
    run = _Runner(scene, placed, path, length, motion, config, engine, threads)
    limit = config.settle_limit_s + config.dwell_s
    found = torch.nonzero(length > 0).flatten().cpu().numpy()
    reference_s = motion.t_exec_s.double().cpu().numpy()[found]
    done = run(found, np.minimum(reference_s + config.dwell_s, limit))
    restless = (~done.settled & done.valid).cpu().numpy()[found] & (reference_s + config.dwell_s < limit)
    late = found[restless]
    if not len(late):
        return done
    return _merged(done, run(late, np.full(len(late), limit)), torch.from_numpy(late).to(path.device))


def _merged(first: Executed, again: Executed, rows: Tensor) -> Executed:
    """`first` with the rows that ran again."""
    width = max(first.path.shape[1], again.path.shape[1])
    parts = {}
    for name in ("path", "length", "t_exec_s", "settled", "valid", "slack_m"):
        a, b = getattr(first, name), getattr(again, name)
        if name == "path":
            a, b = (torch.nn.functional.pad(x, (0, 0, 0, width - x.shape[1])) for x in (a, b))
        a = a.clone()
        a[rows] = b[rows]
        parts[name] = a
    return Executed(**parts, sample_s=first.sample_s)


class _Runner:
    """One batch of paths, ready to be simulated for any rows and any durations."""

    def __init__(
        self, scene: Scene, placed: Placed, path: Tensor, length: Tensor, motion: Motion, config: ExecConfig,
        engine: str, threads: int | None,
    ) -> None:  # fmt: skip
        from r2h_batch.kernels.reference import Law

        self.scene, self.config, self.threads = scene, config, threads
        self.path, self.length = path.contiguous(), length
        self.simulate = import_module(f"r2h_batch.sim_{engine}").simulate
        self.model = arm_model(scene.robot, step_s=config.step_s, payload_known=config.payload == "known")
        self.law = Law()
        self.law.speed, self.law.acceleration = _limits(config)
        self.law.lead, self.law.step = 1.0 / SERVO_RATE, config.step_s
        device = "cpu" if engine == "mujoco" else scene.device
        self.device = device
        path_in, time_in, length_in = (
            wp.from_torch(t.to(device).contiguous()) for t in (self.path, motion.time_s, length)
        )
        self.tables = (path_in, time_in, length_in)
        T_wrist_gripper = scene.robot.T_wrist3_flange @ scene.robot.T_flange_gripper
        T_wrist_obj = np.tile(np.eye(4), (len(length), 1, 1))
        T_wrist_obj[:, :3, :3], T_wrist_obj[:, :3, 3] = placed.R_wrist_obj.cpu(), placed.p_wrist_obj.cpu()
        self.T_gripper_obj = np.linalg.inv(T_wrist_gripper) @ T_wrist_obj
        self.objects = placed.object_index.cpu().numpy()

    def __call__(self, rows: np.ndarray, duration_s: np.ndarray) -> Executed:
        sample_s = self.config.step_s * self.config.record_steps
        samples = np.ceil(duration_s / sample_s - 1e-6).astype(np.int64)
        order = np.argsort(-samples, kind="stable")
        rows, samples = rows[order], samples[order]
        job = Job(
            self.model, self.law, self.tables, rows,
            [Payload.of(self.scene.objects[self.objects[i]], self.T_gripper_obj[i]) for i in rows],
            self.path[torch.from_numpy(rows), 0].double().cpu().numpy(),
            samples, self.config.record_steps, self.device,
        )  # fmt: skip
        return self._judged(job, self.simulate(job, threads=self.threads), sample_s)

    def _judged(self, job: Job, answer: Samples, sample_s: float) -> Executed:
        """When each motion came to rest, and how far it may have been off its samples."""
        from r2h_batch.kernels.reference import settle_sample

        b, device, config = len(self.length), self.path.device, self.config
        rows = torch.from_numpy(job.rows).to(device)
        path = torch.zeros((b, max(answer.q.shape[1], 2), 6), dtype=torch.float32, device=device)
        path[rows, : answer.q.shape[1]] = torch.from_numpy(answer.q).to(device)
        valid = torch.ones(b, dtype=torch.bool, device=device)
        valid[rows] = torch.from_numpy(answer.valid & np.isfinite(answer.q).all((1, 2))).to(device)
        length = torch.zeros(b, dtype=torch.int32, device=device)
        length[rows] = torch.from_numpy(job.samples + 1).to(device, torch.int32)
        length = torch.where(valid, length, 0)
        goal = self.path[torch.arange(b, device=device), (self.length - 1).clamp(min=0).long()][:, None].contiguous()
        first = torch.zeros(b, dtype=torch.int32, device=device)
        arrays = [wp.from_torch(t) for t in (goal, path, length, first)]
        inputs = [self.scene.tool, config.settle_position_m, config.settle_rotation_rad, *arrays]
        launch_trials(settle_sample, b, inputs, device=self.scene.device, threads=self.threads, chunk=64)
        at = first * sample_s
        still = length - 1 - first >= round(0.5 * config.dwell_s / sample_s)
        settled = (length > 0) & still & (at <= config.settle_limit_s)
        lever = self.scene.levers.to(device)
        acceleration = torch.zeros((b, 1, 6), dtype=torch.float64, device=device)
        acceleration[rows, 0] = torch.from_numpy(np.nan_to_num(answer.acceleration)).to(device)
        slack = (acceleration * lever).sum(-1).amax(-1) * sample_s**2 / 8
        t_exec = torch.where(settled, at.float(), torch.nan)
        return Executed(path, length, t_exec, settled, valid, slack.float(), sample_s)


def time_path(path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"], config: ExecConfig) -> Motion:
    """A trapezoid of speed per segment, all joints together, stopping at every waypoint.

    The joint with the farthest to go sets the pace at `scale` times the limits; the path itself is not left. For two
    waypoints this is the time of the paper's T_exec: 8.4-9.0 s at MoveIt 2's default scale of 0.1.
    """
    duration = _duration(_segment_lengths(path, length), config)
    time = torch.zeros(path.shape[:2], dtype=torch.float64, device=path.device)
    for k in range(path.shape[1] - 1):
        time[:, k + 1] = time[:, k] + duration[:, k]
    t_exec = torch.where(length > 0, time[:, -1], torch.nan)
    return Motion(time.float(), t_exec.float())


def executed_time_at(
    executed: Executed, segment: Int32[Tensor, " b"], fraction: Float32[Tensor, " b"]
) -> Float32[Tensor, " b"]:
    """When a simulated motion passes `fraction` of the stretch after sample `segment`, s."""
    assert executed.sample_s is not None
    return ((segment + fraction.double()) * executed.sample_s).float()


def time_at(
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    motion: Motion,
    segment: Int32[Tensor, " b"],
    fraction: Float32[Tensor, " b"],
    config: ExecConfig,
) -> Float32[Tensor, " b"]:
    """When each path passes `fraction` (0 to 1) of its `segment`, s; NaN without a path."""
    rows = torch.arange(len(path), device=path.device)
    at = segment.long().clamp(0, path.shape[1] - 2)
    whole = _segment_lengths(path, length)[rows, at]
    total = _duration(whole, config)
    v, a = _limits(config)
    s = fraction.double() * whole
    near = torch.minimum(s, whole - s).clamp(min=0)  # the trapezoid is symmetric: count from the nearer end
    ramp = torch.minimum(torch.full_like(whole, v * v / (2 * a)), whole / 2)
    t = torch.where(near <= ramp, (2 * near / a).sqrt(), (2 * ramp / a).sqrt() + (near - ramp) / v)
    t = torch.where(s <= whole / 2, t, total - t)
    passed = torch.minimum((motion.time_s[rows, at] + t).float(), motion.time_s[rows, at + 1])  # never after its own end
    return torch.where(length > 0, passed, torch.nan)


def _limits(config: ExecConfig) -> tuple[float, float]:
    return config.scale * config.max_velocity_rad_s, config.scale * config.max_acceleration_rad_s2


def _segment_lengths(path: Tensor, length: Tensor) -> Float64[Tensor, "b w"]:
    """Largest joint motion of each segment (rad); 0 beyond the path's end."""
    d = (path[:, 1:].double() - path[:, :-1].double()).abs().amax(-1)
    slot = torch.arange(path.shape[1] - 1, device=path.device)
    return torch.where(slot < length[:, None] - 1, d, 0.0)


def _duration(d: Tensor, config: ExecConfig) -> Tensor:
    v, a = _limits(config)
    return torch.where(d >= v * v / a, d / v + v / a, 2 * (d / a).sqrt())
