"""Motion along a planned path: what an engine makes of its time law.

The arm alone moves as it does in the whole scene as long as nothing that could push touches.
Contacts push between links, between gripper or links and the table, and between object and arm,
never at the hand (`scene/model.py`). While no such pair touches, the scene's equations of motion
are the arm's own but for the fingers, which give way within FINGER_GIVE_M. So it is enough that
along the simulated motion (samples and the lines between them) every such pair keeps more than both
its bodies may be off those lines: at the first step at which a contact could push, the arm would
still be where it is alone, and there nothing touches (`nothing_pushes`).
"""

import math
from dataclasses import dataclass, fields, replace
from importlib import import_module
from typing import Literal

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Float64, Int32
from torch import Tensor
from torch.nn.functional import pad

from r2h_batch.base.launch import over_trials
from r2h_batch.config import CLEARANCE_TOLERANCE_M, ExecConfig
from r2h_batch.judge.motion.simulation import Job, Samples
from r2h_batch.judge.motion.time_law import Motion, limits, servo_law
from r2h_batch.kernels.motion.time_law import path_deviation
from r2h_batch.kernels.plan.lines import path_clearance
from r2h_batch.kernels.robot.tool import settle_sample
from r2h_batch.scene.model import TrialScenes
from r2h_batch.scene.robot import drive_from_gap, gap_from_drive
from r2h_batch.scene.scene import BodyPoses, Scene

FINGER_GIVE_M = 1.2e-5
"""A bound on how far the fingers of the whole scene give way in a motion without contacts, and how
far its arm is off the arm alone: nearly twice the most that was seen (`bench/execute.py --ask models`:
execute.models.finger_sway_max_um)."""

NEAR_M = 1e-3
"""Clearance beyond this is not measured: no simulated motion is ever this far off its samples'
lines."""

FAR_OBJECT_M = 5.0
"""An object that sticks out of the robot by more is not simulated: nothing holds it there, and at such
a lever its inertia swings until `settle_s` is over, in the whole scene (14 times the time of a row)."""

LOCATED_M = 1e-5
"""How exactly the clearance is located."""


def nothing_pushes(
    scene: Scene,
    body_poses: BodyPoses,
    motion: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    off_m: Float32[Tensor, " b"],
) -> Bool[Tensor, " b"]:
    """Whether no pair whose contacts push can have touched in B recorded motions (rows of length 0:
    False).

    `off_m`: how far any point of robot or object was off the joint lines between the samples, at
    most. Certified: the lines are walked as planned paths are, over all pairs but the hand's
    (object and table, which do not push, are counted).
    """
    kernel = scene.sized(path_clearance)
    found = over_trials(kernel, len(length), scene.device, chunk=1, uneven=True)(
        cap=NEAR_M,
        tolerance=LOCATED_M,
        without=-math.inf,
        world=scene.world_without_hand,
        bodies=body_poses.bodies,
        path=motion.contiguous(),
        length=length.contiguous(),
    )
    return found["clearance"] - LOCATED_M > 2.0 * off_m


@dataclass(frozen=True)
class Executed:
    """The motion that happened, as joint lines between samples `sample_s` apart (kinematic: the
    planned path itself).

    `t_exec_s`: when the arm came to rest at its goal, NaN where it did not or there is no path.
    `valid`: False where the simulator failed: such a row has no length, but `path` still holds its
    `recorded` samples. `slack_m`: how far any point of the robot may have been off the lines
    between two samples, fingers that gave way included; `slack_with_object_m`: any point of robot
    and object. `deviation_m`: a bound on how far any point of robot or object ever was from where
    the planned path has it at that time; below the path's clearance it certifies that the motion
    touched nothing of what planning checks. `failed_state`: qpos and qvel as the simulator had them
    before it failed. `window_slack_m`: `slack_m` of each WINDOW segments, where the fingers are not
    where the trial's opening but `window_opening_m` has them; None for motions as planned.
    """

    path: Float32[Tensor, "b w 6"]
    length: Int32[Tensor, " b"]
    t_exec_s: Float32[Tensor, " b"]
    settled: Bool[Tensor, " b"]
    valid: Bool[Tensor, " b"]
    slack_m: Float32[Tensor, " b"]
    slack_with_object_m: Float32[Tensor, " b"]
    deviation_m: Float32[Tensor, " b"]
    recorded: Int32[Tensor, " b"]
    sample_s: float | None
    failed_state: Float64[Tensor, "b s"] | None = None
    window_slack_m: Float32[Tensor, "b k"] | None = None
    window_opening_m: Float32[Tensor, "b k"] | None = None


def execute(
    scene: Scene,
    body_poses: BodyPoses,
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    motion: Motion,
    config: ExecConfig,
    *,
    clearance_m: Float32[Tensor, " b"] | None = None,
) -> Executed:
    """Moves the arm along B paths in the engine of `config`; rows without a path are left out.

    Each trial runs until its reference has ended and `dwell_s` more; what has not come to rest by
    then runs again, for `settle_s` longer. How long the reference takes decides nothing. Rows do
    not depend on each other. A row whose object is FAR_OBJECT_M off does not run and is not at rest.

    `clearance_m`: certified smallest distance of all pairs along each planned path
    (`Plan.clearance_m`). With `model="auto"` the arm alone moves first, with `model="scene"` in
    MuJoCo C the whole scene without contacts; where no body can have come as near to another as to
    touch it, the contacts of the whole scene cannot have pushed and the motion stands: known from
    the clearance, if it is given and large enough, else from a walk along the motion
    (`nothing_pushes`). The other rows are moved in the whole scene with its contacts.
    """
    engine = config.engine(scene.device)
    if engine == "none":
        true = torch.ones_like(length, dtype=torch.bool)
        zero = torch.zeros_like(motion.t_exec_s)
        end, none = motion.t_exec_s, torch.zeros_like(length)
        return Executed(path, length, end, length > 0, true, zero, zero, zero, none, None)

    def move(
        model: Literal["scene", "arm"], rows: Bool[Tensor, " b"], contacts: bool = True
    ) -> Executed:
        how = replace(config, model=model)
        run = _Runner(scene, body_poses, path, length, motion, how, engine, contacts)
        return _until_at_rest(run, rows)

    sticks_out = body_poses.object_motion_radius - scene.motion_radii.amax(0).to(path.device)
    found = (length > 0) & (sticks_out.amax(1) <= FAR_OBJECT_M)
    if config.model == "auto":
        alone = _with_fingers(move("arm", found), found)
    elif config.model == "scene" and engine == "mujoco":
        alone = move("scene", found, contacts=False)
    else:
        return move(config.model, found)
    free = torch.zeros_like(found)
    if clearance_m is not None:
        # Two bodies may each be off by the deviation, towards each other; the clearance is located
        # to a tolerance.
        free = alone.valid & (2.0 * alone.deviation_m < clearance_m - CLEARANCE_TOLERANCE_M)
    unsure = found & alone.valid & ~free
    if bool(unsure.any()):
        recorded = torch.where(unsure, alone.length, 0)
        free = free | nothing_pushes(
            scene, body_poses, alone.path, recorded, alone.slack_with_object_m
        )
    if bool((free | ~found).all()):
        return alone
    return _merged(alone, move("scene", found & ~free), torch.nonzero(found & ~free).flatten())


def _until_at_rest(run: "_Runner", rows: Bool[Tensor, " b"]) -> Executed:
    """The motion of `rows`: to the end of the reference, and `settle_s` more where the arm is not
    at rest by then."""
    config = run.config
    found = torch.nonzero(rows).flatten().cpu().numpy()
    done = run(found, run.reference_s[found] + config.dwell_s)
    late = found[(~done.settled & done.valid).cpu().numpy()[found]]
    if not len(late):
        return done
    longer = run(late, run.reference_s[late] + config.settle_s + config.dwell_s)
    return _merged(done, longer, torch.from_numpy(late).to(rows.device))


def _with_fingers(alone: Executed, found: Bool[Tensor, " b"]) -> Executed:
    """The arm's own motion with what the fingers of the whole scene would have given way at
    most."""
    give = FINGER_GIVE_M * found.to(alone.slack_m.dtype)
    more = {
        name: getattr(alone, name) + give
        for name in ("slack_m", "slack_with_object_m", "deviation_m")
    }
    assert alone.window_slack_m is not None
    return replace(alone, **more, window_slack_m=alone.window_slack_m + give[:, None])


def _merged(first: Executed, again: Executed, rows: Tensor) -> Executed:
    """`first` with the rows that ran again."""
    width = max(first.path.shape[1], again.path.shape[1])
    states = [x.failed_state for x in (first, again) if x.failed_state is not None]
    state_width = max((x.shape[1] for x in states), default=0)
    parts = {}
    for name in (f.name for f in fields(Executed) if f.name != "sample_s"):
        a, b = getattr(first, name), getattr(again, name)
        if name == "path":
            a, b = (pad(x, (0, 0, 0, width - x.shape[1])) for x in (a, b))
        elif name.startswith("window_"):
            windows = max(a.shape[1], b.shape[1])
            a, b = (pad(x, (0, windows - x.shape[1])) for x in (a, b))
        elif name == "failed_state":  # the scene has more joints than the arm alone
            a, b = (pad(x, (0, state_width - x.shape[1]), value=torch.nan) for x in (a, b))
        a = a.clone()
        a[rows] = b[rows]
        parts[name] = a
    return Executed(**parts, sample_s=first.sample_s)


class _Runner:
    """One batch of paths, ready to be simulated for any rows and any durations."""

    def __init__(
        self, scene: Scene, body_poses: BodyPoses, path: Tensor, length: Tensor, motion: Motion, config: ExecConfig,
        engine: str, contacts: bool
    ) -> None:  # fmt: skip
        self.scene, self.config, self.contacts = scene, config, contacts
        self.path, self.length = path.contiguous(), length
        self.reference_s = motion.t_exec_s.double().cpu().numpy()
        module = import_module(f"r2h_batch.judge.motion.sim_{engine}")
        self.simulate = module.simulate
        self.law = servo_law(
            config,
            scene.robot.joint_weight,
            lead_s=1.0 / scene.robot.dynamics.servo_rate,
            step_s=config.step_s,
        )
        device = "cpu" if module.ON_CPU else scene.device
        self.device = device
        self.body_poses, tables = body_poses, (self.path, motion.time_s, length)
        self.planned = [wp.from_torch(t.contiguous()) for t in tables]
        path_in, time_in, length_in = (wp.from_torch(t.to(device).contiguous()) for t in tables)
        self.tables = (path_in, time_in, length_in)
        T_wrist_gripper = scene.robot.T_wrist3_flange @ scene.robot.T_flange_gripper
        T_wrist_obj = np.tile(np.eye(4), (len(length), 1, 1))
        T_wrist_obj[:, :3, :3] = body_poses.R_wrist_obj.cpu()
        T_wrist_obj[:, :3, 3] = body_poses.p_wrist_obj.cpu()
        self.trials = TrialScenes(
            scene.objects, np.linalg.inv(T_wrist_gripper) @ T_wrist_obj, body_poses.object_index.long().cpu().numpy(),
            body_poses.hand_index.long().cpu().numpy(), body_poses.T_world_hand.double().cpu().numpy(),
            body_poses.opening_m.double().cpu().numpy(),
        )  # fmt: skip

    def __call__(self, rows: np.ndarray, duration_s: np.ndarray) -> Executed:
        sample_s = self.config.step_s * self.config.record_steps
        samples = np.ceil(duration_s / sample_s - 1e-6).astype(np.int64)
        order = np.argsort(-samples, kind="stable")
        rows, samples = rows[order], samples[order]
        job = Job(
            self.scene.model(self.trials.hand_index[rows], self.config), self.law, self.tables, rows, self.trials.rows(rows),
            self.path[torch.from_numpy(rows), 0].double().cpu().numpy(),
            samples, self.config.record_steps, self.device, self.scene.motion_radii.cpu().numpy(),
            self.contacts,
        )  # fmt: skip
        return self._judged(job, self.simulate(job), sample_s)

    def _judged(self, job: Job, answer: Samples, sample_s: float) -> Executed:
        """When each motion came to rest, and how far it may have been off its samples."""
        b, device, config = len(self.length), self.path.device, self.config
        rows = torch.from_numpy(job.rows).to(device)
        path = torch.zeros(
            (b, max(answer.q.shape[1], 2), answer.q.shape[2]), dtype=torch.float32, device=device
        )
        path[rows, : answer.q.shape[1]] = torch.from_numpy(answer.q).to(device)
        valid = torch.ones(b, dtype=torch.bool, device=device)
        valid[rows] = torch.from_numpy(answer.valid & np.isfinite(answer.q).all((1, 2))).to(device)
        length = torch.zeros(b, dtype=torch.int32, device=device)
        length[rows] = torch.from_numpy(job.samples + 1).to(device, torch.int32)
        recorded, length = length, torch.where(valid, length, 0)
        first = self._at_rest(path, length)
        at = first.float() * sample_s
        still = length - 1 - first >= round(0.5 * config.dwell_s / sample_s)
        # relative to the reference: its length is the planner's, and a longer path is no worse at
        # coming to rest
        reference_s = torch.from_numpy(self.reference_s).to(device)
        settled = (length > 0) & still & (at <= reference_s + config.settle_s)
        lever = self.scene.motion_radii.to(device)
        acceleration = torch.zeros((b, 1, path.shape[2]), dtype=torch.float64, device=device)
        acceleration[rows, 0] = torch.from_numpy(np.nan_to_num(answer.acceleration)).to(device)
        slack = (acceleration * lever).sum(-1).amax(-1) * sample_s**2 / 8
        slack[rows] += torch.from_numpy(np.nan_to_num(answer.sway_m)).to(device)
        window_slack, window_opening = self._windows(job, answer, sample_s)
        t_exec = torch.where(settled, at.float(), torch.nan)
        state = torch.full(
            (b, answer.failed_state.shape[1]), torch.nan, dtype=torch.float64, device=device
        )
        state[rows] = torch.from_numpy(answer.failed_state).to(device)
        swing = (acceleration[:, 0] * self.body_poses.object_motion_radius.to(device)).sum(-1)
        both = torch.maximum(slack, swing * sample_s**2 / 8)
        deviation = torch.where(length > 0, self._deviation(path, length, sample_s) + both, 0.0)
        return Executed(
            path,
            length,
            t_exec,
            settled,
            valid,
            slack.float(),
            both.float(),
            deviation.float(),
            recorded,
            sample_s,
            state,
            window_slack,
            window_opening,
        )

    def _windows(self, job: Job, answer: Samples, sample_s: float) -> tuple[Tensor, Tensor]:
        """Slack and opening of each window, (B, K) both.

        A step of h seconds moves a joint by h times its new speed: q is a line between steps, and
        its second difference is h^2 a. After i of the m steps between two samples it is off their
        line by at most max|a| h^2 i (m - i) / 2 <= max|a| (m h)^2 / 8, and a point of the robot by
        the sum over the joints of that times its motion radius. The fingers are off besides, from
        the middle of the angles that their joints took in the window.
        """
        slack, opening = answer.bend * sample_s**2 / 8, self.trials.opening_m[job.rows, None]
        if job.scene.full:
            linkage = self.scene.robot.linkage
            middle = 0.5 * (answer.fingers[..., 0] + answer.fingers[..., 1])
            middle = np.clip(middle, linkage.drive_lower, linkage.drive_upper)
            opening = gap_from_drive(self.scene.robot, middle).astype(np.float32)
            slack = slack + job.scene.levers.sway(
                drive_from_gap(self.scene.robot, opening), answer.fingers
            )
        shape = (2, len(self.length), slack.shape[1])
        out = torch.zeros(shape, dtype=torch.float32, device="cpu")
        out[0, job.rows] = torch.from_numpy(slack).float()
        out[1, job.rows] = torch.from_numpy(np.broadcast_to(opening, slack.shape).copy()).float()
        window_slack, window_opening = out.to(self.path.device).unbind(0)
        return window_slack, window_opening

    def _at_rest(self, path: Tensor, length: Tensor) -> Int32[Tensor, " b"]:
        """The sample from which each motion stays at its goal."""
        b, device, config = len(length), path.device, self.config
        rows, last = (
            torch.arange(b, dtype=torch.int64, device=device),
            (self.length - 1).clamp(min=0),
        )
        goal = self.path[rows, last.long()][:, None].contiguous()
        kernel = self.scene.sized(settle_sample)
        made = over_trials(kernel, b, self.scene.device, chunk=64)(
            tool=self.scene.tool,
            position_m=config.settle_position_m,
            rotation_rad=config.settle_rotation_rad,
            goal=goal,
            path=path,
            length=length,
        )
        return made["sample"]

    def _deviation(self, motion: Tensor, length: Tensor, sample_s: float) -> Tensor:
        """Deviation of the lines between samples from the planned path: at the samples, and by the
        path's curvature between two in time."""
        law = servo_law(self.config, self.scene.robot.joint_weight, lead_s=0.0, step_s=sample_s)
        lever = self.scene.motion_radii.float().to(motion.device).contiguous()
        held = self.body_poses.object_motion_radius
        planned, time, planned_length = self.planned
        kernel = self.scene.sized(path_deviation)
        made = over_trials(kernel, len(length), self.scene.device, chunk=16)(
            law=law,
            motion_radius=lever,
            object_motion_radius=held,
            path=planned,
            time=time,
            length=planned_length,
            motion=motion,
            motion_length=length,
        )
        # between two samples dt apart a joint curves off its chord by at most a dt^2 / 8 over its
        # weight, and a point by that times its lever
        weight = torch.tensor(
            self.scene.robot.joint_weight, dtype=torch.float64, device=motion.device
        )
        longest = torch.maximum(
            (lever.double() / weight).sum(1).amax(), (held.double() / weight).sum(1)
        )
        return made["deviation"].double() + limits(self.config)[1] * sample_s**2 / 8 * longest


def executed_time_at(
    executed: Executed, segment: Int32[Tensor, " b"], fraction: Float32[Tensor, " b"]
) -> Float32[Tensor, " b"]:
    """When a simulated motion passes `fraction` of the stretch after sample `segment`, s."""
    assert executed.sample_s is not None
    return ((segment + fraction.double()) * executed.sample_s).float()
