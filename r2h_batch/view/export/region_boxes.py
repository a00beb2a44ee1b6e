"""The receiver's region as thin boxes that lie along its faces, for judges that know boxes alone."""

from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from r2h_batch.scene.objects import ObjectModel

Array = NDArray[np.float64]

EDGE_M = 1e-3
"""Faces are cut until their edges are this long: a box holds whole ones."""
THICK_M, OVER_M = 5e-4, 1e-3
"""A box is this thick at most, and no point of it lies farther from the region."""


@lru_cache(maxsize=32)
def region_as_boxes(model: ObjectModel) -> Array:
    """(N, 5, 3) boxes (as `ObjectModel.receiver_boxes`) that hold the faces of an object's receiver region
    and nothing that is more than `OVER_M` away from them; the object's own boxes where it has some."""
    if model.receiver_boxes is not None:
        return model.receiver_boxes
    if not model.receiver_face.any():
        return np.zeros((0, 5, 3))
    vertices, faces = trimesh.remesh.subdivide_to_size(
        model.vertices.astype(np.float64), model.faces[model.receiver_face], EDGE_M
    )
    triangles = np.asarray(vertices)[faces]
    near = cKDTree(np.concatenate([vertices, triangles.mean(1)]))
    boxes, open_ = [], [np.arange(len(triangles))]
    while open_:
        rows = open_.pop()
        box, local = _around(triangles[rows])
        if len(rows) == 1 or _fits(box, near):
            boxes.append(box)
        else:
            open_ += _halves(rows, local)
    return np.stack(boxes)


def _around(triangles: Array) -> tuple[Array, Array]:
    """The box about triangles that lies in the plane that fits them best, and their middles in its frame."""
    points = triangles.reshape(-1, 3)
    center = points.mean(0)
    _, _, R = np.linalg.svd(points - center, full_matrices=False)
    R[2] *= np.sign(np.linalg.det(R))
    local = (points - center) @ R.T
    low, high = local.min(0), local.max(0)
    half = np.maximum((high - low) / 2, THICK_M / 4)
    middle = center + (low + high) / 2 @ R
    return np.stack([middle, half, *R.T]), local.reshape(-1, 3, 3).mean(1)


def _fits(box: Array, near: cKDTree) -> bool:
    half = box[1]
    if 2 * half[2] > THICK_M:
        return False
    at = [np.linspace(-h, h, int(np.ceil(2 * h / EDGE_M)) + 1) for h in half[:2]]
    plane = np.stack([*np.meshgrid(*at, indexing="ij"), np.zeros((len(at[0]), len(at[1])))], -1)
    distance, _ = near.query(plane.reshape(-1, 3) @ box[2:].T + box[0], distance_upper_bound=OVER_M)
    return bool(np.isfinite(distance).all())


def _halves(rows: NDArray[np.int64], local: Array) -> list[NDArray[np.int64]]:
    """Two parts of a box's triangles: across that axis which leaves the boxes the least volume."""
    best: tuple[float, NDArray[np.bool_]] | None = None
    for axis in range(3):
        first = local[:, axis] < (local[:, axis].min() + local[:, axis].max()) / 2
        if first.all() or not first.any():
            continue
        sizes = [np.ptp(local[part], axis=0) + THICK_M for part in (first, ~first)]
        volume = float(sum(s.prod() for s in sizes))
        if best is None or volume < best[0]:
            best = volume, first
    split = np.arange(len(rows)) < len(rows) // 2 if best is None else best[1]
    return [rows[split], rows[~split]]
