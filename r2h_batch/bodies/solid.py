"""What solids are made of and asked about: signed distance, winding number, voxels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

Tick = Callable[[float], None] | None

POINTS_AT_ONCE = 2048
"""Points measured between two looks at the clock, each on its own."""


class Surface:
    """A mesh, closed or not, ready to be asked how far points are from it (on a CPU, float32 about
    its middle)."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        import warp as wp  # here: loading built-in objects needs no Warp

        from r2h_batch.launch import init_warp

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

    def signed(
        self, points: NDArray[np.float64], tick: Tick = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(N,) distance, negative where the winding number is above 0.5; (N, 3) closest points.

        `tick` is told the share that is done, every now and then; it may raise to end the work.
        """
        import warp as wp

        from r2h_batch.kernels.geometry.mesh_distance import signed_distance as kernel

        closest = wp.empty(len(points), dtype=wp.vec3, device="cpu")
        reach = 4.0 * self.size + float(np.abs(points - self.center).max(initial=0.0))
        distance = self._ask(kernel, points, reach, tick, closest=closest)
        return distance, closest.numpy().astype(np.float64) + self.center

    def within(
        self, points: NDArray[np.float64], reach: float, tick: Tick = None
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """(N,) distance without a sign, `reach` where nothing is nearer; (N,) the face there, -1
        for none."""
        import warp as wp

        from r2h_batch.kernels.geometry.mesh_distance import nearest_face as kernel

        face = wp.empty(len(points), dtype=wp.int32, device="cpu")
        distance = self._ask(kernel, points, reach, tick, face=face)
        return distance, face.numpy().astype(np.int64)

    def _ask(
        self, kernel: Any, points: NDArray[np.float64], reach: float, tick: Tick, **more: Any
    ) -> NDArray[np.float64]:
        import warp as wp

        from r2h_batch.launch import launch

        where: Any = wp.array(
            np.asarray(points - self.center, np.float32), dtype=wp.vec3, device="cpu"
        )
        distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
        for first in range(0, len(points), POINTS_AT_ONCE):
            if tick is not None:
                tick(first / len(points))
            part = slice(first, min(first + POINTS_AT_ONCE, len(points)))
            launch(
                kernel,
                part.stop - first,
                inputs={"mesh": self.mesh.id, "reach": reach, "points": where[part]},
                outputs={"distance": distance[part], **{k: v[part] for k, v in more.items()}},
                device="cpu",
            )
        return np.asarray(distance.numpy(), np.float64)


def signed_distance(
    mesh: trimesh.Trimesh, points: NDArray[np.float64], tick: Tick = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`Surface.signed` of a mesh that is used once."""
    return Surface(mesh).signed(points, tick)


def winding_number(solid: trimesh.Trimesh, count: int) -> NDArray[np.int64]:
    """(n, n, n) winding number at the voxels' centres of :func:`solid_occupancy`'s grid."""
    origin, pitch = _grid(solid, count)
    return winding_of_nodes(solid.triangles, origin + pitch / 2, pitch, (count,) * 3)


def winding_of_nodes(
    triangles: NDArray[np.float64], low: NDArray[np.float64], pitch: float, shape: Sequence[int]
) -> NDArray[np.int64]:
    """Winding number of a closed surface (F, 3, 3) at the nodes `low` + `pitch` (i, j, k) of a grid
    of this shape."""
    count = max(shape)
    i, j, z, sign = _column_crossings(triangles, low - pitch / 2, pitch, count)
    above = np.zeros((count, count, count + 1), np.int64)
    layer = np.ceil((z - low[2]) / pitch).astype(np.int64).clip(0, count)
    np.add.at(above, (i, j, layer), sign)
    return np.cumsum(above, axis=2)[: shape[0], : shape[1], : shape[2]]


def _grid(solid: trimesh.Trimesh, count: int) -> tuple[NDArray[np.float64], float]:
    low, high = solid.bounds
    pitch = float((high - low).max() / (count - 2.5))  # more than one voxel to spare on each side
    return (low + high) / 2 - pitch * count / 2, pitch


def _column_crossings(
    triangles: NDArray[np.float64], origin: NDArray[np.float64], pitch: float, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
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

    def area(
        u: NDArray[np.float64], v: NDArray[np.float64], w: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return (v[:, 0] - u[:, 0]) * (w[:, 1] - u[:, 1]) - (v[:, 1] - u[:, 1]) * (w[:, 0] - u[:, 0])

    wa, wb, wc = area(b, c, p), area(c, a, p), area(a, b, p)
    total = wa + wb + wc
    hit = ((wa > 0) & (wb > 0) & (wc > 0)) | ((wa < 0) & (wb < 0) & (wc < 0))
    z = (wa * a[:, 2] + wb * b[:, 2] + wc * c[:, 2])[hit] / total[hit]
    return i[hit], j[hit], z, -np.sign(total[hit]).astype(np.int64)


def solid_occupancy(
    solid: trimesh.Trimesh, count: int
) -> tuple[NDArray[np.bool_], NDArray[np.float64], float]:
    """((n, n, n) bool, lowest corner, pitch): a voxel is full when its centre is inside the closed
    surface or the surface passes through it. The grid is a cube around the bounding box with one
    empty voxel to spare on each side."""
    origin, pitch = _grid(solid, count)
    full = winding_number(solid, count) > 0
    full |= _surface_voxels(solid.triangles, origin, pitch, count)
    return full, origin, pitch


def _surface_voxels(
    triangles: NDArray[np.float64], origin: NDArray[np.float64], pitch: float, count: int
) -> NDArray[np.bool_]:
    """(n, n, n) bool: the voxels that a triangle touches (separating axis test of triangle and
    cube)."""
    full = np.zeros((count,) * 3, bool)
    corners = (triangles - origin) / pitch
    low = np.floor(corners.min(axis=1)).astype(np.int64).clip(0, count - 1)
    span = np.floor(corners.max(axis=1)).astype(np.int64).clip(0, count - 1) - low + 1
    cells = span.prod(axis=1)
    full[tuple(low[cells == 1].T)] = True
    edges = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(edges[:, 0], edges[:, 1])
    more = np.flatnonzero(cells > 1)
    for block in np.array_split(more, max(1, int(cells[more].sum() // 2_000_000))):
        face, cell = _cells_at_planes(block, normal, corners, low, span)
        n = normal[face]
        height = np.einsum("ij,ij->i", n, corners[face, 0] - (cell + 0.5))
        # of the axes, the one that rules out most
        rows = np.flatnonzero(np.abs(height) <= 0.5 * np.abs(n).sum(axis=1))
        rows = rows[~full[tuple(cell[rows].T)]]
        face, cell = face[rows], cell[rows]
        t, edge = corners[face] - (cell + 0.5)[:, None, :], edges[face]
        for axis in range(3):  # with each edge: edge x unit vector = u e_v - v e_u
            u, v = (axis + 1) % 3, (axis + 2) % 3
            for k in range(3):
                along, across = edge[:, k, v], edge[:, k, u]
                a, b, c = (along * t[:, i, u] - across * t[:, i, v] for i in range(3))
                radius = 0.5 * (np.abs(along) + np.abs(across))
                touches = np.minimum(np.minimum(a, b), c) <= radius
                touches &= np.maximum(np.maximum(a, b), c) >= -radius
                cell, t, edge = cell[touches], t[touches], edge[touches]
        hit = cell
        full[hit[:, 0], hit[:, 1], hit[:, 2]] = True
    return full


def _cells_at_planes(
    block: NDArray[np.int64],
    normal: NDArray[np.float64],
    corners: NDArray[np.float64],
    low: NDArray[np.int64],
    span: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(n,) faces of `block` and (n, 3) cells of their bounding boxes: all that the faces meet, and
    some beside these.

    Columns of cells stand along the axis that a plane is the most across. Left out are those that
    pass a face by, and of the others all but the few cells in which they meet the face's plane.
    """
    axes = (np.abs(normal[block]).argmax(axis=1)[:, None] + np.arange(3)) % 3
    n = np.take_along_axis(normal[block], axes, 1)
    first, width = (np.take_along_axis(x[block], axes, 1) for x in (low, span))
    # (faces, corner, 2) as the columns see them
    flat = np.take_along_axis(corners[block], axes[:, None, 1:], 2)
    edge = np.roll(flat, -1, axis=1) - flat
    columns = width[:, 1] * width[:, 2]
    row = np.repeat(np.arange(len(block)), columns)
    rank = np.arange(len(row)) - np.repeat(np.cumsum(columns) - columns, columns)
    at = (first[row, 1:] + np.stack([rank // width[row, 2], rank % width[row, 2]], axis=1)).astype(
        np.float64
    ) + 0.5
    for k in range(3):
        along, across = edge[row, k, 1], edge[row, k, 0]
        a, b, c = (
            along * (flat[row, i, 0] - at[:, 0]) - across * (flat[row, i, 1] - at[:, 1])
            for i in range(3)
        )
        radius = 0.5 * (np.abs(along) + np.abs(across)) + 1e-6
        meets = (np.minimum(np.minimum(a, b), c) <= radius) & (
            np.maximum(np.maximum(a, b), c) >= -radius
        )
        row, at = row[meets], at[meets]
    height = np.einsum("ij,ij->i", normal[block], corners[block, 0])
    begin, end = first[row, 0], first[row, 0] + width[row, 0] - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = 0.5 * np.abs(n).sum(axis=1) / np.abs(n[:, 0]) + 1e-3
        middle = (height[row] - (n[row, 1:] * at).sum(axis=1)) / n[row, 0] - 0.5
        # a face without area is in no plane: all its cells
        sure = np.isfinite(middle) & np.isfinite(reach[row])
        begin = np.where(sure, np.maximum(begin, np.floor(middle - reach[row])), begin)
        end = np.where(sure, np.minimum(end, np.ceil(middle + reach[row])), end)
    count = np.maximum(end - begin + 1, 0).astype(np.int64)
    column = np.repeat(np.arange(len(row)), count)
    along_column = (
        begin[column] + np.arange(len(column)) - np.repeat(np.cumsum(count) - count, count)
    )
    cell = np.empty((len(column), 3), np.int64)
    found = np.concatenate([along_column[:, None], at[column] - 0.5], axis=1)
    np.put_along_axis(cell, axes[row[column]], np.round(found).astype(np.int64), 1)
    return block[row[column]], cell


def sample_surface(
    solid: trimesh.Trimesh, count: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(count, 3) points and their faces: systematic over the area, so that every part gets its
    share. Fixed seed."""
    rng = np.random.Generator(np.random.Philox(key=20482048))
    area = np.cumsum(solid.area_faces)
    face = np.searchsorted(
        area, (np.arange(count) + rng.random(count)) / count * area[-1], side="right"
    )
    face = np.minimum(face, len(area) - 1)
    a, b = rng.random(count), rng.random(count)
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    corner, u, v = solid.triangles[face, 0], solid.triangles[face, 1], solid.triangles[face, 2]
    return corner + a[:, None] * (u - corner) + b[:, None] * (v - corner), face
