"""A user's grasps as candidates: as they are, or seated on this gripper and tried."""

import warnings
from dataclasses import replace

import numpy as np
import torch

from r2h_batch.bodies.grasp_set import GraspSet
from r2h_batch.bodies.objects import ObjectModel
from r2h_batch.bodies.robot import Robot
from r2h_batch.judge.grasp import close_pads
from r2h_batch.launch import init_warp
from r2h_batch.methods.grasps.candidate_set import (
    OWN_GRIPPER,
    Candidates,
    NoGraspError,
    carrier,
    joined,
)
from r2h_batch.methods.grasps.grade import device_mesh, graded, zeros
from r2h_batch.scene.grasp_tables import grasp_tables

SEATS_M = (0.0, 0.004, -0.004, 0.008, -0.008, 0.012, -0.012, 0.016, -0.016, 0.02, -0.02)


def own_grasps(model: ObjectModel, grasps: GraspSet, robot: Robot) -> Candidates:
    """The user's grasps as they are, best score first, without any check. `width`: of what
    lies between the pads."""
    init_warp()
    order = np.argsort(-grasps.score, kind="stable")
    T = np.ascontiguousarray(grasps.T_obj_ee[order])
    width = close_pads(
        grasp_tables([model], robot),
        torch.from_numpy(T),
        zeros(torch.from_numpy(T)),
    )[0]
    part, nan = (
        np.maximum(grasps.part[order], 0).astype(np.uint8),
        np.full(len(T), np.nan, np.float32),
    )
    return Candidates(T, width.numpy(), grasps.score[order], part, nan)


def seat_grasps(model: ObjectModel, grasps: GraspSet, robot: Robot | None = None) -> Candidates:
    """The user's grasps that keep every promise of `sample_grasps`, best score of the user's first.

    Pads centre the object as in `sample_grasps`. Those of another gripper may be pushed up to 20 mm
    further or less far along the approach, the nearest place first: its fingers have another
    length. `score` is the user's, `part` what the pads touch. How many were seated elsewhere and
    how many dropped is one warning; none left raises.
    """
    init_warp()
    robot = carrier(robot)
    tables, mesh = grasp_tables([model], robot), device_mesh(model)
    own = OWN_GRIPPER if robot == carrier(None) else robot.name.replace("_", "-")
    depths = (0.0,) if grasps.gripper == own else SEATS_M
    seated: dict[int, tuple[Candidates, float]] = {}
    for depth in depths:
        left = np.array([i for i in range(len(grasps)) if i not in seated], np.int64)
        if not len(left):
            break
        T = grasps.T_obj_ee[left].copy()
        T[:, :3, 3] += np.float32(depth) * T[:, :3, 2]
        found, rows = graded(model, tables, mesh, T, robot)
        seated |= {int(left[r]): (found.rows([k]), depth) for k, r in enumerate(rows)}
    if not seated:
        raise NoGraspError(
            f"{model.name}: none of {len(grasps)} grasps can be held by the {own}; are they in the object's frame, in"
            " metres, and named for the right gripper?"
        )
    moved = sum(depth != 0 for _, depth in seated.values())
    if moved or len(seated) < len(grasps):
        dropped = len(grasps) - len(seated)
        warnings.warn(
            f"{model.name}: of {len(grasps)} grasps of the {grasps.gripper}, {moved} seated elsewhere, {dropped} dropped",
            stacklevel=2,
        )
    order = sorted(seated, key=lambda i: (-float(grasps.score[i]), i))
    return replace(joined([seated[i][0] for i in order]), score=grasps.score[order])
