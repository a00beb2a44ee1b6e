"""Pictures of a handover along the motion that happened, from the model that was simulated."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch import se3
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.grasp import attach
from r2h_batch.motion.execute import Executed, execute
from r2h_batch.motion.time_law import time_path
from r2h_batch.scene.dynamics import Payload
from r2h_batch.scene.model import COLLISION, SceneModel, TrialScene, build_scene_model
from r2h_batch.scene.offscreen import renderer
from r2h_batch.types import (
    CRITERIA,
    CollidingPair,
    Outcome,
    PlanReason,
    Predictions,
    Scores,
    Trials,
)

AZIMUTH_DEG, ELEVATION_DEG = 125.0, -18.0
PADDING_M = 0.09
"""Seen around the centres of the robot's primitives."""


@dataclass(frozen=True)
class Strip:
    """One handover: what came of it, and pictures at some times of its motion (one alone where
    there was none)."""

    method: str
    outcome: Outcome
    verdict: str
    time_s: NDArray[np.float64]
    images: NDArray[np.uint8]  # (times, height, width, 3)


def strips(
    evaluator: Evaluator,
    trial: Trials,
    predictions: Sequence[Predictions],
    *,
    frames: int = 5,
    size: tuple[int, int] = (480, 400),
) -> list[Strip]:
    """A strip for each method's answer to one trial, from one direction; a failed Safe shows the
    touch.

    `trial` and each of `predictions` have one row. `size` is width and height in pixels.
    """
    if evaluator.config.execute.sim == "none":
        raise ValueError(
            "strips show an executed motion; ExecConfig.sim is 'none', allowed are auto, mujoco, mjwarp"
        )
    if len(trial) != 1 or any(len(p) != 1 for p in predictions):
        raise ValueError(
            f"strips show one trial; {len(trial)} trials and {[len(p) for p in predictions]} predictions given"
        )
    told = [_replayed(evaluator, trial, p) for p in predictions]
    scene = evaluator.scene
    model = build_scene_model(
        scene.robot, [scene.objects[int(trial.object_index[0])]], scene.hands, [int(trial.hand_index[0])],
        step_s=evaluator.config.execute.step_s, skins=True, workplace=scene.config.workplace,
    )  # fmt: skip
    chosen = [_times(scores, executed, frames) for scores, executed, _ in told]
    with renderer(model.model, *size) as drawer:
        out = []
        for p, (scores, executed, bodies), at in zip(predictions, told, chosen, strict=True):
            postures = _postures(executed, at, scene.config.workplace.home_q)
            camera = _camera(model, bodies, postures, size)
            touch = (
                scores.witness_point[0].numpy() if int(scores.outcome[0]) == Outcome.SAFE else None
            )
            touch_s = float(scores.witness_time_s[0])
            images = [
                _picture(
                    drawer,
                    model,
                    bodies,
                    q,
                    camera,
                    touch if touch is not None and abs(t - touch_s) < 0.01 else None,
                )
                for t, q in zip(at, postures, strict=True)
            ]
            outcome = Outcome(int(scores.outcome[0]))
            out.append(
                Strip(p.method, outcome, verdict(scores, scene.part_names), at, np.stack(images))
            )
    return out


def verdict(scores: Scores, parts: Sequence[str], row: int = 0) -> str:
    """One line: success with its time, or which criterion failed first, and how."""
    outcome = Outcome(int(scores.outcome[row]))
    if outcome == Outcome.SUCCESS:
        return f"success, {float(scores.t_exec_s[row]):.1f} s"
    if outcome > len(CRITERIA):
        return outcome.name.lower().replace("_", " ")
    name = f"{CRITERIA[outcome - 1].capitalize()} fails"
    if outcome == Outcome.PLAN:
        pair = CollidingPair(int(scores.plan_pair[row]))
        with_what = (
            f" ({pair.name.lower().replace('_', ', ')})" if pair != CollidingPair.NONE else ""
        )
        return f"{name}: {PlanReason(int(scores.plan_reason[row])).name.lower().replace('_', ' ')}{with_what}"
    if outcome == Outcome.SAFE:
        body = int(scores.witness_part[row, 1])
        part = parts[body].replace("_", " ") if body >= 0 else "robot"
        return f"{name}: {part} meets the hand at {float(scores.witness_time_s[row]):.1f} s"
    return f"{name} by {-1e3 * float(scores.margin[row, outcome - 1]):.1f} mm"


def _replayed(
    evaluator: Evaluator, trial: Trials, p: Predictions
) -> tuple[Scores, Executed, TrialScene]:
    """Verdict, executed motion and bodies of one prediction: the same bits as in a batch."""
    scene, config, device = evaluator.scene, evaluator.config, evaluator.scene.device
    trial = trial.to(device)
    T_obj_ee, T_world_ee = p.T_obj_ee.to(device), p.T_world_ee.to(device)
    scores = evaluator.score(T_obj_ee, T_world_ee, trial)
    attached = attach(se3.orthonormalise(T_obj_ee), scores.grasp_shift_m)
    T_world_hand = se3.orthonormalise(trial.T_world_hand)
    placed = scene.place(
        trial.object_index, trial.hand_index, attached, T_world_hand, scores.opening_m
    )
    motion = time_path(scores.path, scores.path_len, config.execute)
    executed = execute(
        scene,
        placed,
        scores.path,
        scores.path_len,
        motion,
        config.execute,
        threads=evaluator.threads,
    )
    robot, model = scene.robot, scene.objects[int(trial.object_index[0])]
    T_gripper_ee = np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee
    T_gripper_obj = T_gripper_ee @ np.linalg.inv(attached[0].double().cpu().numpy())
    bodies = TrialScene(
        Payload.of(model, T_gripper_obj), 0, int(trial.hand_index[0]), T_world_hand[0].double().cpu().numpy(),
        float(scores.opening_m[0]),
    )  # fmt: skip
    on_cpu: dict[str, Any] = {
        k: v.cpu() for k, v in vars(executed).items() if isinstance(v, torch.Tensor)
    }
    return scores.to("cpu"), replace(executed, **on_cpu), bodies


def _times(scores: Scores, executed: Executed, frames: int) -> NDArray[np.float64]:
    """Even times from start to rest; where Safe fails the nearest is that of the touch."""
    n = int(executed.length[0])
    if n == 0:
        return np.zeros(1)
    assert executed.sample_s is not None
    end = float(executed.t_exec_s[0]) if bool(executed.settled[0]) else (n - 1) * executed.sample_s
    at = np.linspace(0.0, end, frames)
    if int(scores.outcome[0]) == Outcome.SAFE and np.isfinite(
        touch := float(scores.witness_time_s[0])
    ):
        at[np.abs(at - touch).argmin()] = touch
    return at


def _postures(
    executed: Executed, time_s: NDArray[np.float64], home: Sequence[float]
) -> NDArray[np.float64]:
    n = int(executed.length[0])
    if n == 0:
        return np.array([home])
    assert executed.sample_s is not None
    at = np.clip(np.round(time_s / executed.sample_s).astype(int), 0, n - 1)
    return executed.path[0, at].double().numpy()


def _camera(
    model: SceneModel, bodies: TrialScene, postures: NDArray[np.float64], size: tuple[int, int]
) -> mujoco.MjvCamera:  # fmt: skip
    """A camera that sees robot, object and hand in all postures, as near as possible."""
    own = copy.copy(model.model)
    data = mujoco.MjData(own)
    model.load(own, bodies, data)
    mujoco.mj_resetData(own, data)
    near = (own.geom_group == COLLISION) & (own.geom_type != mujoco.mjtGeom.mjGEOM_MESH)
    round_ = np.array([own.geom("hand/skin").id, own.geom("object/mesh_visual").id])
    points = [[0.0, 0.0, -0.05]]
    for q in postures:
        data.qpos[:] = model.start(bodies, q)
        mujoco.mj_kinematics(own, data)
        points += [
            p + s * PADDING_M * e for p in data.geom_xpos[near] for e in np.eye(3) for s in (-1, 1)
        ]
        points += [
            p + s * 0.7 * r * e
            for p, r in zip(data.geom_xpos[round_], own.geom_rbound[round_])
            for e in np.eye(3)
            for s in (-1, 1)
        ]
    a, e = np.radians([AZIMUTH_DEG, ELEVATION_DEG])
    axes = np.array(
        [
            [np.sin(a), -np.cos(a), 0.0],
            [0, 0, 0],
            [np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)],
        ]
    )
    axes[1] = np.cross(axes[0], axes[2])  # right, up, forward
    at = np.array(points) @ axes.T
    middle = (at.min(0) + at.max(0)) / 2
    right, up, forward = np.abs(at - middle)[:, 0], np.abs(at - middle)[:, 1], (at - middle)[:, 2]
    half = np.tan(np.radians(own.vis.global_.fovy) / 2)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = middle @ axes
    camera.azimuth, camera.elevation = AZIMUTH_DEG, ELEVATION_DEG
    camera.distance = float(
        max((right / (half * size[0] / size[1]) - forward).max(), (up / half - forward).max())
    )
    return camera


def _picture(
    drawer: mujoco.Renderer, model: SceneModel, bodies: TrialScene, q: NDArray[np.float64], camera: mujoco.MjvCamera,
    touch: NDArray[np.float32] | None,
) -> NDArray[np.uint8]:  # fmt: skip
    data = mujoco.MjData(model.model)
    model.load(model.model, bodies, data)
    mujoco.mj_resetData(model.model, data)
    data.qpos[:] = model.start(bodies, q)
    mujoco.mj_forward(model.model, data)
    drawer.update_scene(data, camera)
    if touch is not None:
        scene = drawer.scene
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 0.025), touch.astype(np.float64),
            np.eye(3).ravel(), np.array([0.85, 0.1, 0.1, 0.75], np.float32),
        )  # fmt: skip
        scene.ngeom += 1
    return np.array(drawer.render())
