"""Queries of closed meshes: signed distance, winding number, voxels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import trimesh

Tick = Callable[[float], None] | None
F64 = NDArray[np.float64]

SIDES = (16, 4, 1)
"""Sides of the cells that are tried for a surface, the largest first, in voxels."""

POINTS_AT_ONCE = 2048
"""Points measured between two looks at the clock, each on its own."""


class Surface:
    """A mesh, closed or not, ready to be asked how far points are from it (on a CPU, float32 about
    its middle)."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        import warp as wp  # here: loading built-in objects needs no Warp

        from r2h_batch.base.launch import init_warp

        init_warp()
        self.center = mesh.bounds.mean(axis=0)
        self.size = float(np.linalg.norm(mesh.extents))
        self.mesh = wp.Mesh(
            wp.array(
                np.asarray(mesh.vertices - self.center, np.float32), dtype=wp.vec3, device="cpu"
            ),
            wp.array(np.asarray(mesh.faces, np.int32).ravel(), dtype=wp.int32, device="cpu"),
            support_winding_number=True,
        )

    def signed(self, points: F64, tick: Tick = None) -> tuple[F64, F64]:
        """(N,) distance, negative where the winding number is above 0.5; (N, 3) closest points.

        `tick` is told the share that is done, every now and then; it may raise to end the work.
        """
        import warp as wp

        from r2h_batch.kernels.geometry.mesh_distance import signed_distance as kernel

        closest = wp.empty(len(points), dtype=wp.vec3, device="cpu")
        cutoff = 4.0 * self.size + float(np.abs(points - self.center).max(initial=0.0))
        distance = self._ask(kernel, points, cutoff, tick, closest=closest)
        return distance, closest.numpy().astype(np.float64) + self.center

    def within(
        self, points: F64, cutoff: float, tick: Tick = None
    ) -> tuple[F64, NDArray[np.int64]]:
        """(N,) distance without a sign, `cutoff` where nothing is nearer; (N,) the face there, -1
        for none."""
        import warp as wp

        from r2h_batch.kernels.geometry.mesh_distance import nearest_face as kernel

        face = wp.empty(len(points), dtype=wp.int32, device="cpu")
        distance = self._ask(kernel, points, cutoff, tick, face=face)
        return distance, face.numpy().astype(np.int64)

    def _ask(self, kernel: Any, points: F64, cutoff: float, tick: Tick, **more: Any) -> F64:
        import warp as wp

        from r2h_batch.base.launch import launch

        about = np.asarray(points - self.center, np.float32)
        where: Any = wp.array(about, dtype=wp.vec3, device="cpu")
        distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
        for first in range(0, len(points), POINTS_AT_ONCE):
            if tick is not None:
                tick(first / len(points))
            part = slice(first, min(first + POINTS_AT_ONCE, len(points)))
            launch(
                kernel,
                part.stop - first,
                inputs={"mesh": self.mesh.id, "cutoff": cutoff, "points": where[part]},
                outputs={"distance": distance[part], **{k: v[part] for k, v in more.items()}},
                device="cpu",
            )
        return np.asarray(distance.numpy(), np.float64)


def signed_distance(mesh: trimesh.Trimesh, points: F64, tick: Tick = None) -> tuple[F64, F64]:
    """`Surface.signed` of a mesh that is used once."""
    return Surface(mesh).signed(points, tick)


def winding_number(solid: trimesh.Trimesh, count: int) -> NDArray[np.int64]:
    """(n, n, n) winding number at the voxels' centres of :func:`solid_occupancy`'s grid."""
    origin, pitch = _grid(solid, count)
    return winding_of_nodes(solid.triangles, origin + pitch / 2, pitch, (count,) * 3)


def winding_of_nodes(
    triangles: F64, low: F64, pitch: float, shape: Sequence[int]
) -> NDArray[np.int64]:
    """Winding number of a closed surface (F, 3, 3) at the nodes `low` + `pitch` (i, j, k) of a grid
    of this shape."""
    count = max(shape)
    i, j, z, sign = _column_crossings(triangles, low - pitch / 2, pitch, count)
    above = np.zeros((count, count, count + 1), np.int64)
    layer = np.ceil((z - low[2]) / pitch).astype(np.int64).clip(0, count)
    np.add.at(above, (i, j, layer), sign)
    return np.cumsum(above, axis=2)[: shape[0], : shape[1], : shape[2]]


def _grid(solid: trimesh.Trimesh, count: int) -> tuple[F64, float]:
    low, high = solid.bounds
    pitch = float((high - low).max() / (count - 2.5))  # more than one voxel to spare on each side
    return (low + high) / 2 - pitch * count / 2, pitch


def _column_crossings(
    triangles: F64, origin: F64, pitch: float, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], F64, NDArray[np.int64]]:
    """(i, j, z, sign): where vertical lines through the centres of a count x count grid's columns
    cross the triangles.

    sign is +1 where the line enters through the triangle (its normal points down), -1 where it
    leaves. Lines are moved by 1e-5 of the pitch off the centres: symmetric meshes have edges
    exactly there.
    """
    first = origin[:2] + pitch * (0.5 + np.array([1.0e-5, 0.618034e-5]))
    flat = triangles[:, :, :2]
    low = np.ceil((flat.min(axis=1) - first) / pitch).astype(np.int64).clip(0, count)
    high = np.floor((flat.max(axis=1) - first) / pitch).astype(np.int64).clip(-1, count - 1)
    span = np.maximum(high - low + 1, 0)
    cells = span[:, 0] * span[:, 1]
    face = np.repeat(np.arange(len(triangles)), cells)
    rank = np.arange(cells.sum()) - np.repeat(np.cumsum(cells) - cells, cells)
    i = low[face, 0] + rank // np.maximum(span[face, 1], 1)
    j = low[face, 1] + rank % np.maximum(span[face, 1], 1)
    p = first + pitch * np.stack([i, j], axis=1)
    a, b, c = triangles[face, 0], triangles[face, 1], triangles[face, 2]

    def area(u: F64, v: F64, w: F64) -> F64:
        return (v[:, 0] - u[:, 0]) * (w[:, 1] - u[:, 1]) - (v[:, 1] - u[:, 1]) * (w[:, 0] - u[:, 0])

    wa, wb, wc = area(b, c, p), area(c, a, p), area(a, b, p)
    total = wa + wb + wc
    hit = ((wa > 0) & (wb > 0) & (wc > 0)) | ((wa < 0) & (wb < 0) & (wc < 0))
    z = (wa * a[:, 2] + wb * b[:, 2] + wc * c[:, 2])[hit] / total[hit]
    return i[hit], j[hit], z, -np.sign(total[hit]).astype(np.int64)


def solid_occupancy(solid: trimesh.Trimesh, count: int) -> tuple[NDArray[np.bool_], F64, float]:
    """((n, n, n) bool, lowest corner, pitch): a voxel is full when its centre is inside the closed
    surface or the surface passes through it. The grid is a cube around the bounding box with one
    empty voxel to spare on each side."""
    origin, pitch = _grid(solid, count)
    full = winding_number(solid, count) > 0
    full |= _surface_voxels(solid.triangles, origin, pitch, count)
    return full, origin, pitch


def _surface_voxels(triangles: F64, origin: F64, pitch: float, count: int) -> NDArray[np.bool_]:
    """(n, n, n) bool: the voxels that a triangle touches. Of a large cell that one touches, the
    smaller cells inside are tried."""
    full = np.zeros((count,) * 3, bool)
    corners = (triangles - origin) / pitch
    edges = np.roll(corners, -1, axis=1) - corners
    low, high = (
        np.floor(x).astype(np.int64).clip(0, count - 1)
        for x in (corners.min(axis=1), corners.max(axis=1))
    )
    largest = (high // SIDES[0] - low // SIDES[0] + 1).prod(axis=1)
    blocks = np.array_split(np.arange(len(corners)), max(1, int(largest.sum()) // 30_000))
    for face in blocks:
        first, last = low[face] // SIDES[0], high[face] // SIDES[0]
        for side, smaller in zip(SIDES, (*SIDES[1:], 1), strict=True):
            face, cell = _cells_between(face, first, last)
            if side == 1:
                missing = ~full[tuple(cell.T)]
                face, cell = face[missing], cell[missing]
            # a little too large: rounding must not lose a smaller cell at the rim
            size = side + 1e-6 if side > 1 else 1.0
            rows = _touching(corners[face] - side * (cell + 0.5)[:, None], edges[face], size)
            face, cell = face[rows], cell[rows]
            ratio = side // smaller
            first = np.maximum(ratio * cell, low[face] // smaller)
            last = np.minimum(ratio * (cell + 1) - 1, high[face] // smaller)
        full[tuple(cell.T)] = True
    return full


def _cells_between(
    face: NDArray[np.int64], first: NDArray[np.int64], last: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Each face (n,) again for every cell from `first` to `last` (n, 3), and these cells."""
    span = last - first + 1
    cells = span.prod(axis=1)
    row = np.repeat(np.arange(len(face)), cells)
    rank = np.arange(len(row)) - np.repeat(np.cumsum(cells) - cells, cells)
    x, yz = np.divmod(rank, span[row, 1] * span[row, 2])
    return face[row], first[row] + np.stack([x, *np.divmod(yz, span[row, 2])], axis=1)


def _touching(t: F64, edges: F64, side: float) -> NDArray[np.int64]:
    """Rows of the triangles (N, 3, 3) with these edges that touch the cube of this side about the
    origin, where bounding boxes meet (separating axis test)."""
    normal = np.cross(edges[:, 0], edges[:, 1])
    height = np.einsum("ij,ij->i", normal, t[:, 0])
    # of the axes, the one that rules out most
    rows = np.flatnonzero(np.abs(height) <= 0.5 * side * np.abs(normal).sum(axis=1))
    for axis in range(3):  # with each edge: edge x unit vector = u e_v - v e_u
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for k in range(3):
            along, across = edges[rows, k, v], edges[rows, k, u]
            a, b, c = (along * t[rows, i, u] - across * t[rows, i, v] for i in range(3))
            radius = 0.5 * side * (np.abs(along) + np.abs(across))
            touches = np.minimum(np.minimum(a, b), c) <= radius
            touches &= np.maximum(np.maximum(a, b), c) >= -radius
            rows = rows[touches]
    return rows


def sample_surface(solid: trimesh.Trimesh, count: int) -> tuple[F64, NDArray[np.int64]]:
    """(count, 3) points and their faces: systematic over the area, so that every part gets its
    share. Fixed seed."""
    rng = np.random.Generator(np.random.Philox(key=20482048))
    area = np.cumsum(solid.area_faces)
    at = (np.arange(count) + rng.random(count)) / count * area[-1]
    face = np.searchsorted(area, at, side="right")
    face = np.minimum(face, len(area) - 1)
    a, b = rng.random(count), rng.random(count)
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    corner, u, v = solid.triangles[face, 0], solid.triangles[face, 1], solid.triangles[face, 2]
    return corner + a[:, None] * (u - corner) + b[:, None] * (v - corner), face
