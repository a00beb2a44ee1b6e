"""Which proposals this gripper can hold, tried on its real shapes, and how good they are.

Score in [0, 1] = 0.4 alignment + 0.35 contact + 0.25 balance:
  alignment  mean cosine between closing axis and touched surface, 0 at the friction cone's edge, 1
  when square
  contact    share of the pad with surface within 1.5 mm, of the lesser pad; half a pad or more
  counts 1
  balance    1 at the centre of mass, 0 at the object's farthest point from it
"""

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from r2h_batch.bodies.objects import ObjectModel
from r2h_batch.bodies.robot import Robot
from r2h_batch.config import Thresholds
from r2h_batch.judge.grasp import (
    attach,
    close_pads,
    closed_clearance,
    open_is_clear,
    region_distance,
)
from r2h_batch.kernels.methods import antipodal
from r2h_batch.launch import launch_trials
from r2h_batch.methods.grasps.antipodal import FRICTION, pad_height
from r2h_batch.methods.grasps.candidate_set import Candidates, widest_m
from r2h_batch.scene.grasp_tables import GraspTables

CLEARANCE_M = 0.001
CENTERED_M = 0.0005
REACH_M = 0.0015
LEAST_CONTACT = 0.05
HOPELESS = 0.15
"""Below the friction cone's edge (cosine) after the first closing: the others move the pads along
the closing axis only."""
BEHIND_PADS_M = -0.001  # the closed gripper's shapes overshoot the real one by about this much

F32 = NDArray[np.float32]


def graded(
    model: ObjectModel, tables: GraspTables, mesh: wp.Mesh, proposals: F32, robot: Robot
) -> tuple[Candidates, NDArray[np.int64]]:
    """The proposals that keep every promise of `sample_grasps`, with their scores, and which of the
    proposals they are."""
    T = torch.from_numpy(proposals)
    row = torch.nonzero(_clear(tables, T))[:, 0]
    T = T[row].contiguous()
    edge, widest = 1 / np.hypot(1, FRICTION), widest_m(robot)
    pads = _Pads(tables, len(proposals))
    for turn in range(3):  # the pads centre the object; what then lies between them may differ
        width, opening, shift, empty = pads.close(T, row)
        held = ~empty & (width <= widest)
        T, row = attach(T[held], shift[held]).contiguous(), row[held]
        if turn == 0:  # for most there is no hope: they hold by an edge, or at a slant
            share, cosine, _ = pad_contact(
                model, mesh, T.numpy(), width[held].numpy(), opening[held].numpy(), robot
            )
            hopeful = torch.from_numpy((share > 0) & (cosine >= edge - HOPELESS))
            T, row = T[hopeful].contiguous(), row[hopeful]
    clear = _clear(tables, T)
    T, row = T[clear].contiguous(), row[clear]
    width, opening, shift, empty = pads.close(T, row)
    held = ~empty & (width <= widest) & (shift.abs() <= CENTERED_M)
    behind, _ = closed_clearance(tables, T, zeros(T), opening, cap_m=CLEARANCE_M)
    held &= behind >= BEHIND_PADS_M
    T, width, opening, shift, row = (x[held].contiguous() for x in (T, width, opening, shift, row))
    squeezed = (width - Thresholds().pad_squeeze_m).clamp(min=0)
    region = region_distance(tables, attach(T, shift), zeros(T), squeezed)[0].numpy()
    contact, alignment, part = pad_contact(
        model, mesh, T.numpy(), width.numpy(), opening.numpy(), robot
    )
    score, square = scored(model, T.numpy(), opening.numpy(), contact, alignment, robot)
    every = Candidates(T.numpy(), width.numpy(), score, part.astype(np.uint8), region)
    good = square & (contact >= LEAST_CONTACT)
    return every.rows(good), row.numpy()[good]


class _Pads:
    """`close_pads` of proposals by their number: those that stand as they did when it was asked
    before are not asked again."""

    def __init__(self, tables: GraspTables, count: int) -> None:
        self.tables = tables
        self.T = torch.full((count, 4, 4), torch.nan, dtype=torch.float32, device="cpu")
        self.found = [torch.empty(count, dtype=torch.float32, device="cpu") for _ in range(3)]
        self.empty = torch.empty(count, dtype=torch.bool, device="cpu")

    def close(self, T: torch.Tensor, row: torch.Tensor) -> list[torch.Tensor]:
        """Width, opening, shift, emptiness of proposals `row`, which stand at `T` now."""
        moved = (self.T[row] != T).flatten(1).any(1)
        poses, number = T[moved].contiguous(), row[moved]
        every = [*self.found, self.empty]
        for known, new in zip(every, close_pads(self.tables, poses, zeros(poses)), strict=True):
            known[number] = new
        self.T[number] = poses
        return [known[row] for known in every]


def scored(
    model: ObjectModel,
    T: F32,
    opening: F32,
    contact: NDArray[np.float64],
    alignment: NDArray[np.float64],
    robot: Robot,
) -> tuple[F32, NDArray[np.bool_]]:
    """Scores (the head of this file), and whether the touched surface is within the friction
    cone."""
    edge = 1 / np.hypot(1, FRICTION)
    pads = T[:, :3, 3] + pad_height(robot, opening)[:, None] * T[:, :3, 2]
    farthest = np.linalg.norm(model.vertices - model.com, axis=1).max()
    balance = 1 - np.clip(np.linalg.norm(pads - model.com, axis=1) / farthest, 0, 1)
    score = (
        0.4 * (alignment - edge) / (1 - edge) + 0.35 * np.minimum(contact / 0.5, 1) + 0.25 * balance
    )
    return score.astype(np.float32), alignment >= edge


def pad_contact(
    model: ObjectModel, mesh: wp.Mesh, T: F32, width: F32, opening: F32, robot: Robot
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """What `antipodal.pad_contact` says: share of the lesser pad, mean cosine, part."""
    link = robot.linkage
    share, cosine, part = (
        np.zeros(len(T), np.float32),
        np.zeros(len(T), np.float32),
        np.zeros(len(T), np.int32),
    )
    pad_z = pad_height(robot, opening).astype(np.float32)
    launch_trials(
        antipodal.pad_contact,
        len(T),
        inputs={
            "mesh": mesh.id,
            "face_part": wp.array(model.face_part, dtype=wp.uint8, device="cpu"),
            "half_x": link.pad_half_size[0],
            "half_z": link.pad_half_size[2],
            "reach": REACH_M,
            "T_obj_ee": T,
            "pad_z": pad_z,
            "width": width,
        },
        outputs={"contact": share, "alignment": cosine, "part": part},
        device="cpu",
    )
    return share.astype(np.float64), cosine.astype(np.float64), part


def _clear(tables: GraspTables, T: torch.Tensor) -> torch.Tensor:
    """Whether the open gripper keeps its clearance to the object."""
    return open_is_clear(tables, T, zeros(T), clearance_m=CLEARANCE_M)


def device_mesh(model: ObjectModel) -> wp.Mesh:
    return wp.Mesh(
        wp.array(model.vertices, dtype=wp.vec3, device="cpu"),
        wp.array(model.faces.reshape(-1), dtype=wp.int32, device="cpu"),
    )


def zeros(T: torch.Tensor) -> torch.Tensor:
    return torch.zeros(len(T), dtype=torch.int32, device="cpu")
