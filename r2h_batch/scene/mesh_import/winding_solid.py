"""A solid from surfaces that are not closed, by generalised winding number.

The generalised winding number of a surface with holes is near 1 inside and near 0 outside (Jacobson
et al. 2013, Barill et al. 2018). The solid is the set where it is above 1/2. Its surface is found
by marching cubes on cells near the given surface, refined from coarse to fine, and followed across
the holes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from r2h_batch.scene.mesh_import.limits import MOST_BODIES, Budget, ObjectMeshError
from r2h_batch.scene.mesh_import.manifold import connected_bodies, joined, part_of, simplified
from r2h_batch.scene.solid import Surface

CELLS, CELLS_OF_THIN_WALLS = 80_000, 250_000
"""The area of all open bodies divided by the area of a cell's side. Open sheets need 250,000 for a
surface within 0.3 mm, which costs about 1.6 times the CPU time of 120,000."""
FINEST_M, COARSEST_SHARE = 2.5e-4, 1 / 64
"""Smallest cell, and largest cell as a share of the largest side."""
WALL_CELLS = 1.25
"""A wall thinner than this many cells may fall between the nodes; it is thickened to that."""
MOUTH_SHARE = 1 / 8
"""An opening whose widest inscribed ball has a larger radius than this share of the largest side
is a vessel's mouth, not a hole: what is inside cannot be told."""
NEAR_SHARE = 0.02
"""Bodies nearer to each other than this share of the largest side get one grid."""
LEVELS = 4
"""Cells are halved this many times from coarse to fine."""
AT_ONCE = 32_768
SPECK_CELLS = 4
LONGEST_SHARE = 1 / 16
"""Edges longer than this share of the largest side are cut: long needles make trees of boxes slow."""
MOST_CUT_FACES = 1_000_000
"""Faces at most that such cuts may add."""
MOST_FACES = 20_000

# igl's order of a cell's corners
CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)
STEPS = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def winding_solid(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """The closed surface of the solid that open surfaces enclose.

    Args:
        mesh: The open surfaces, m.
        budget: CPU time that may be used.
        done: Receives one line for each solid that was made.

    Returns:
        A closed surface with at most 20,000 faces for each group of bodies near each other.

    Raises:
        ObjectMeshError: The surfaces enclose nothing, or the time is used up.
    """
    area = float(mesh.area)
    groups = _groups(mesh, budget.label)
    return joined([_solid_of_group(part, area, budget, done) for part in groups])


def _solid_of_group(
    mesh: trimesh.Trimesh, area: float, budget: Budget, done: list[str]
) -> trimesh.Trimesh:
    doing = f"rebuilding the surface of {len(mesh.faces)} faces"
    _check_cuts(mesh, budget.label)
    field = _Field(mesh, lambda: budget.spend(doing))
    coarsest = max(field.size * COARSEST_SHARE, FINEST_M)
    fine, coarse = (
        float(np.clip((area / count) ** 0.5, FINEST_M, coarsest))
        for count in (CELLS_OF_THIN_WALLS, CELLS)
    )
    sheet = field.opening() > MOUTH_SHARE * field.size
    thickness = np.zeros(len(field.faces)) if sheet else field.thickness(2 * coarse)
    cell = _cell_size(field, thickness, fine, coarse)
    wall = WALL_CELLS * cell
    grow = np.maximum(wall - thickness, 0) / 2
    vertices, faces = _marched(field, cell, grow, sheet)
    made = trimesh.Trimesh(vertices, faces, process=False)
    made, _ = simplified(made, 0.05 * cell, MOST_FACES, budget)
    if len(made.faces):
        body, volumes, _ = connected_bodies(made)
        small = np.abs(volumes) < SPECK_CELLS * cell**3  # bodies and voids of a few cells
        made = part_of(made, ~small[body]) if small.any() else made
    if len(made.faces) == 0 or not made.volume > 0:
        raise ObjectMeshError(
            f"{budget.label}: the surface encloses nothing that can be rebuilt; give a mesh of a solid"
        )
    line = f"surface rebuilt by winding number with cells of {cell * 1e3:.2f} mm"
    if sheet:
        line += f", open sheets made {wall * 1e3:.2f} mm thick"
    elif grow.any():
        share = 100 * field.area[grow > 0].sum() / field.area.sum()
        line += f", walls thinner than {wall * 1e3:.2f} mm ({share:.0f} % of the surface) made that thick"
    done.append(line)
    return made


def _check_cuts(mesh: trimesh.Trimesh, label: str) -> None:
    """Refuse a mesh whose long faces become too many when they are cut.

    Each cut of a face, at the middle of its three edges, makes four.
    """
    t = mesh.triangles
    edge = np.linalg.norm(t - np.roll(t, -1, axis=1), axis=2).max(axis=1)
    cuts = np.ceil(np.log2(edge.clip(1e-12) / (mesh.extents.max() * LONGEST_SHARE))).clip(0)
    if (more := float((4.0**cuts - 1).sum())) > MOST_CUT_FACES:
        raise ObjectMeshError(
            f"{label}: {int((cuts > 0).sum())} open faces are longer than a {round(1 / LONGEST_SHARE)}th of the object; "
            f"cut to that they would be {more:.2g} more, at most {MOST_CUT_FACES} are allowed: close its surface in a "
            "modelling tool"
        )


def _cell_size(field: _Field, thickness: F64, fine: float, coarse: float) -> float:
    """Cells (m) between `fine` and `coarse` that suit all but the thinnest twentieth of the
    surface."""
    order = np.argsort(thickness)
    covered = np.searchsorted(np.cumsum(field.area[order]), 0.05 * field.area.sum())
    return float(np.clip(thickness[order[covered]] / WALL_CELLS, fine, coarse))


class _Field:
    """Distances and winding numbers of a mesh (m), asked in blocks between looks at the clock."""

    def __init__(self, mesh: trimesh.Trimesh, tick: Callable[[], None]) -> None:
        import igl  # here: whoever only loads the built-in objects needs it not

        self.tick = tick
        self.size = float(mesh.extents.max())
        vertices, faces = trimesh.remesh.subdivide_to_size(
            mesh.vertices, mesh.faces, self.size * LONGEST_SHARE, max_iter=20
        )[:2]
        fine = trimesh.Trimesh(vertices, faces, process=False)
        fine.update_faces(fine.area_faces > 0)
        self.faces, self.area = fine.faces, fine.area_faces
        self.centers, self.normals, self.bounds = (
            fine.triangles_center,
            fine.face_normals,
            fine.bounds,
        )
        self._surface, self._tree = Surface(fine), igl.FastWindingNumberBVH()
        self._tree.init(
            np.ascontiguousarray(fine.vertices, np.float64),
            np.ascontiguousarray(fine.faces, np.int64),
            1,
        )

    def winding(self, points: F64) -> F64:
        """(N,) winding number, to about 0.3 near the surface and better elsewhere."""
        out = np.empty(len(points))
        for first in range(0, len(points), AT_ONCE):
            self.tick()
            block = np.ascontiguousarray(points[first : first + AT_ONCE])
            out[first : first + AT_ONCE] = self._tree.winding_number(block, 1.0)
        return out

    def distance(self, points: F64, cutoff: float) -> tuple[F64, I64]:
        """(N,) distance, `cutoff` where no face is nearer; (N,) the nearest face, -1 for none."""
        return self._surface.within(points, cutoff, lambda share: self.tick())

    def thickness(self, most: float) -> F64:
        """(F,) depth of the inside behind the middle of each face: a multiple of `most` / 8."""
        depth = np.full(len(self.faces), most)
        thin = np.flatnonzero(self.winding(self.centers - most * self.normals) < 0.5)
        depth[thin] = 0
        for step in np.linspace(0, most, 9)[1:-1]:
            points = self.centers[thin] - step * self.normals[thin]
            thin = thin[self.winding(points) > 0.5]
            depth[thin] = step
        return depth

    def opening(self) -> float:
        """How far (m) from the given surface the solid's surface passes, to a 32nd of the size.

        Between two neighbouring nodes of different sign the distance changes by at most their
        spacing, so the surface between them is at least that far away.
        """
        step = self.size / 32
        low = self.bounds[0] - 1.37 * step
        shape = np.ceil((self.bounds[1] + 1.5 * step - low) / step).astype(np.int64) + 1
        nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
        points = low + nodes * step
        distance = self.distance(points, 4 * self.size)[0].reshape(shape)
        inside = self.winding(points).reshape(shape) > 0.5
        widest = 0.0
        for axis in range(3):
            d, s = np.moveaxis(distance, axis, 0), np.moveaxis(inside, axis, 0)
            off = (d[1:] + d[:-1] - step) / 2
            widest = max(widest, float(off[s[1:] != s[:-1]].max(initial=0.0)))
        return widest


def _marched(field: _Field, cell: float, grow: F64, sheet: bool) -> tuple[F64, I64]:
    """Vertices and faces of the solid's surface, faces grown by `grow` (F,) m to both sides."""
    import igl

    low = field.bounds[0] - 3 * cell - grow.max()

    def values(keys: I64) -> F64:
        """Signed distance; across holes, where it would jump, the winding number instead."""
        points = low + cell * _indices(keys)
        distance, face = field.distance(points, 4 * cell)
        value = distance - np.where(face >= 0, grow[face], 0)
        if not sheet:
            winding = field.winding(points)
            smooth = np.minimum(distance, 2 * cell * np.abs(1 - 2 * winding))
            value = np.minimum(value, np.where(winding > 0.5, -smooth, smooth))
        least = 1e-3 * cell  # no vertex on a node: its faces would have no area
        return np.where(np.abs(value) < least, np.where(value < 0, -least, least), value)

    keys, value = np.zeros(0, np.int64), np.zeros(0)
    new = visited = np.sort(_keys(_cells_near(field, low, cell, float(grow.max()))))
    crossed = []
    while len(new):
        corner = _keys((_indices(new)[:, None] + CORNERS).reshape(-1, 3))
        ask = _not_in(keys, np.unique(corner))
        where = np.searchsorted(keys, ask)
        keys, value = np.insert(keys, where, ask), np.insert(value, where, values(ask))
        inside = (value[np.searchsorted(keys, corner)] < 0).reshape(-1, 8)
        cross = inside.any(axis=1) & ~inside.all(axis=1)
        crossed.append(new[cross])
        new = _not_in(visited, _beside(new[cross], inside[cross]))
        visited = np.insert(visited, np.searchsorted(visited, new), new)
    cells = np.concatenate(crossed)
    if not len(cells):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    corner = _keys((_indices(cells)[:, None] + CORNERS).reshape(-1, 3))
    used, index = np.unique(corner, return_inverse=True)
    vertices, faces, _ = igl.marching_cubes(
        value[np.searchsorted(keys, used)],
        np.ascontiguousarray(low + cell * _indices(used)),
        np.ascontiguousarray(index.reshape(-1, 8)),
        0.0,
    )
    return vertices, faces


def _cells_near(field: _Field, low: F64, cell: float, grow: float) -> I64:
    """(N, 3) indices of the cells that the surface, grown, may pass through."""
    step = cell * 2**LEVELS
    shape = np.ceil((field.bounds[1] + 3 * cell + grow - low) / step).astype(np.int64) + 1
    cells = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    for level in range(LEVELS + 1):
        cutoff = step * 3**0.5 / 2 * 1.001 + grow  # half a cell's diagonal
        cells = cells[field.distance(low + (cells + 0.5) * step, cutoff)[1] >= 0]
        if level < LEVELS:
            cells, step = (2 * cells[:, None] + CORNERS).reshape(-1, 3), step / 2
    return cells


def _beside(cells: I64, inside: NDArray[np.bool_]) -> I64:
    """Keys of the cells behind those sides of the cells that the surface passes through.

    The level set of a harmonic function has no closed part in free space, so all of it is reached
    from the cells near the given surface.
    """
    found = []
    for step in STEPS:
        axis = int(np.abs(step).argmax())
        side = inside[:, CORNERS[:, axis] == (step[axis] > 0)]
        passed = side.any(axis=1) & ~side.all(axis=1)
        found.append(_keys(_indices(cells[passed]) + step))
    return np.unique(np.concatenate(found))


def _not_in(known: I64, wanted: I64) -> I64:
    """Those of `wanted` that are not in `known`; both sorted."""
    if not len(known):
        return wanted
    at = np.searchsorted(known, wanted).clip(max=len(known) - 1)
    return wanted[known[at] != wanted]


def _keys(index: I64) -> I64:
    """(N,) one number for each cell or node (N, 3); the indices are above -1,024."""
    i = np.asarray(index, np.int64) + 1024
    return (i[:, 0] << 42) | (i[:, 1] << 21) | i[:, 2]


def _indices(keys: I64) -> I64:
    low = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & low, keys & low], axis=1) - 1024


def _groups(mesh: trimesh.Trimesh, label: str) -> list[trimesh.Trimesh]:
    """The bodies of the mesh, those together whose bounding boxes are near each other."""
    body = connected_bodies(mesh)[0]
    count, t = int(body.max()) + 1, mesh.triangles
    if count > MOST_BODIES:
        raise ObjectMeshError(
            f"{label}: its open surface is {count} sheets, which meet at an edge of three faces or more, or not at all; "
            f"at most {MOST_BODIES} are allowed: close its surface in a modelling tool"
        )
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, body, t.min(axis=1))
    np.maximum.at(high, body, t.max(axis=1))
    gap = NEAR_SHARE * float(mesh.extents.max())
    close = (low[:, None] <= high[None] + gap).all(axis=2)
    group = connected_components(close & close.T, directed=False)[1][body]
    return [part_of(mesh, group == g) for g in range(group.max() + 1)]
