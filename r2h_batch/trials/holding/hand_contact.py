"""Contact of a posed hand with an object, and how deep it cuts in, measured on the exact meshes of
both."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from r2h_batch.base.launch import over_trials
from r2h_batch.kernels.receiver.point_mesh import (
    may_be_in_hand,
    point_mesh_distance,
    wall_thickness,
)
from r2h_batch.scene.hand import HandModel, load_hand

REGIONS = ("index", "middle", "pinky", "ring", "thumb", "palm")
"""Where a hand touches: five digits (joints 1-3, 4-6, 7-9, 10-12, 13-15) and the palm."""
THUMB, PALM = 4, 5
CUTOFF_M = 0.02
BOX_M, DIRECTIONS = 1e-5, 40
PALMAR_COSINE = 0.35
"""Palmar skin: its rest normal leans at least this much (70 degrees) towards the side that the
joint flexes to."""

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Contact:
    """B hands on one object, metres; columns follow `REGIONS`."""

    gap: F32
    """(B, 6) least distance of the region's palmar skin to the surface, negative inside; 2 cm:
    nothing is that near"""
    normal: F32
    """(B, 6, 3) the object's outward normal at the nearest point"""
    point: F32
    """(B, 6, 3) the skin point that is nearest"""
    face: NDArray[np.int32]
    """(B, 6) the object's face there, -1 without one"""
    depth: F32
    """(B,) how deep the deepest skin point is in the object"""
    back_depth: F32
    """(B,) the same for skin that is not palmar: back, sides and wrist"""
    touch: F32
    """(B,) share of the palmar skin within 5 mm of the surface"""


class ObjectSurface:
    """An object's mesh, ready for distance queries on a CPU (frame obj)."""

    def __init__(self, vertices: F32, faces: NDArray[np.int32]) -> None:
        self.vertices = np.ascontiguousarray(vertices, np.float32)
        self.faces = np.ascontiguousarray(faces, np.int32)
        self.mesh = wp.Mesh(
            wp.array(self.vertices, dtype=wp.vec3, device="cpu"),
            wp.array(self.faces.reshape(-1), dtype=wp.int32, device="cpu"),
            support_winding_number=True,
        )

    def distance(
        self, points: NDArray[Any], cutoff: float, *, quick: bool = False
    ) -> tuple[F32, F32, NDArray[np.int32]]:
        """Signed distance (n,), outward normal (n, 3) and nearest face (n,) of points (n, 3); see
        `point_mesh_distance`.

        `quick`: the sign by the nearest face's normal, not by the winding number.
        """
        flat = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        made = over_trials(point_mesh_distance, len(flat), "cpu", chunk=2048)(
            mesh=self.mesh.id, cutoff=cutoff, by_normal=int(quick), point=flat
        )
        return made["distance"].numpy(), made["normal"].numpy(), made["face"].numpy()

    def thickness(self, most: float) -> F32:
        """(F,) how thick (m) the solid is behind each face, or a face that shares a corner with it;
        `most` where it is more."""
        made = over_trials(wall_thickness, len(self.faces), "cpu", chunk=2048)(
            mesh=self.mesh.id, most=most
        )
        corner = np.full(len(self.vertices), most, np.float32)
        np.minimum.at(corner, self.faces, made["thickness"].numpy()[:, None])
        return np.asarray(corner[self.faces].min(axis=1))


@lru_cache(maxsize=2)
def palmar_region(model: HandModel | None = None) -> NDArray[np.int64]:
    """(V,) index into `REGIONS` of the palmar skin, -1 for back, sides and wrist."""
    model = load_hand() if model is None else model
    v, faces = model.vertices.double().numpy(), model.faces.numpy()
    normal = np.zeros_like(v)
    corner = v[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    # The cross product is twice the face's area: vertex normals weighted by area
    for k in range(3):
        np.add.at(normal, faces[:, k], cross)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # A vertex belongs to the joint that carries most of it; that joint's second axis points to the
    # back of the hand
    joint = model.weights.argmax(1).numpy()
    dorsal = model.joint_axes.double().numpy()[joint, :, 1]
    region = np.where(joint > 0, (joint - 1) // 3, PALM)
    palmar = -(normal * dorsal).sum(1) >= PALMAR_COSINE
    wrist = (joint == 0) & (v[:, 0] > -0.015)
    return np.where(palmar & ~wrist, region, -1)


def measure_contact(
    surface: ObjectSurface,
    vertices: F32,
    *,
    hand: HandModel | None = None,
    about: F32 | None = None,
    measured: NDArray[np.bool_] | None = None,
) -> Contact:
    """Contacts of B hands with skins `vertices` (B, V, 3) in the object's frame; `hand`: whose
    skins (default: ours).

    `about` (B, V): what the skins' distances are about. Then only the points that are nearest by it
    are asked, quickly: contacts to look at, not to vouch for. `measured` (B, V): skin that is not is
    known to be 2 cm and more away.
    """
    n, count = vertices.shape[:2]
    region = palmar_region(hand or load_hand())
    rows = np.arange(n)[:, None]
    if about is None:
        distance, face = (
            np.full((n, count), CUTOFF_M, np.float32),
            np.full((n, count), -1, np.int32),
        )
        normal = np.zeros((n, count, 3), np.float32)
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        around = np.zeros((n, count), bool)
        if measured is None:
            measured = ~around
        else:
            around = ((vertices < low) | (vertices > high)).any(axis=2)
        # outside of the object's box the sign needs no winding number
        for points, outside in ((measured & ~around, False), (measured & around, True)):
            d, normal[points], face[points] = surface.distance(
                vertices[points], CUTOFF_M, quick=outside
            )
            distance[points] = np.abs(d) if outside else d
    else:
        distance = np.minimum(about, CUTOFF_M)
    nearest = np.stack(
        [
            np.flatnonzero(region == r)[distance[:, region == r].argmin(1)]
            for r in range(len(REGIONS))
        ],
        axis=1,
    )
    if about is None:
        gap, normal, face = distance[rows, nearest], normal[rows, nearest], face[rows, nearest]
    else:
        gap, normal, face = surface.distance(vertices[rows, nearest], CUTOFF_M, quick=True)
        gap, normal, face = gap.reshape(n, -1), normal.reshape(n, -1, 3), face.reshape(n, -1)
    inside = np.maximum(-distance, 0.0)
    return Contact(
        gap=gap,
        normal=normal,
        point=vertices[rows, nearest],
        face=face,
        depth=inside.max(1),
        back_depth=inside[:, region < 0].max(1),
        touch=(distance[:, region >= 0] < 0.005).mean(1).astype(np.float32),
    )


def hand_depth(
    points: F32,
    vertices: F32,
    side: int | torch.Tensor,
    *,
    hand: HandModel | None = None,
    least: float = 0.0,
) -> NDArray[np.float32]:
    """(B,) how deep the deepest of the object's surface points (n, 3) is in each hand: what thin
    parts do to a hand.

    `least`: what is less deep than this (m) may be said to be 0, which is quicker to find out.
    """
    model = hand or load_hand()
    faces = model.faces_by_side.numpy()[int(side)]
    pieces = [p.numpy() for p in model.pieces]
    depth = np.zeros(len(vertices), np.float32)
    for i, skin in enumerate(vertices):
        near = points[_may_be_inside(points, skin, pieces, least)]
        if len(near):
            distance, _, _ = ObjectSurface(skin, faces).distance(near, 0.05)
            depth[i] = max(0.0, -float(distance.min()))
    return depth


def _may_be_inside(
    points: F32, skin: F32, pieces: list[NDArray[np.int64]], least: float
) -> NDArray[np.bool_]:
    """(n,) whether points may be in the hand and `least` deep: these convex pieces hold the skin,
    so no other is inside."""
    direction = _directions()
    along = skin[np.concatenate(pieces)].astype(np.float64) @ direction.T
    first = np.cumsum([0, *map(len, pieces)])[:-1]
    made = over_trials(may_be_in_hand, len(points), "cpu", chunk=4096)(
        direction=direction.astype(np.float32),
        low=(np.minimum.reduceat(along, first) - BOX_M).astype(np.float32),
        high=(np.maximum.reduceat(along, first) + BOX_M).astype(np.float32),
        box_low=wp.vec3(*(skin.min(0) - BOX_M).tolist()),
        box_high=wp.vec3(*(skin.max(0) + BOX_M).tolist()),
        skin=np.ascontiguousarray(skin),
        off_skin=max(0.0, least - BOX_M),
        point=np.ascontiguousarray(points),
    )
    inside: NDArray[np.bool_] = made["inside"].numpy()
    return inside


@lru_cache(maxsize=1)
def _directions() -> NDArray[np.float64]:
    """(D, 3) unit vectors, well spread over half of the sphere: the axes, which rule out most,
    before the others."""
    step = np.arange(DIRECTIONS) + 0.5
    z, turn = 1 - step / DIRECTIONS, np.pi * (1 + 5**0.5) * step
    ring = np.sqrt(1 - z**2)
    return np.concatenate(
        [np.eye(3), np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)]
    )
