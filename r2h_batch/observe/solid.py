"""A closed solid completed from what cameras saw of an object: what they look through is carved away, the rest is filled.

Nothing is asked but the images. What no camera saw is taken to be inside the convex hull of what was seen and of its shadow
straight down on the table, as far as no camera looks through it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter, minimum_filter
from scipy.spatial import ConvexHull, QhullError, cKDTree

from r2h_batch.observe.seen import LABELS, Observation

CELLS = 44
"""Cells along the longest side of what was seen [choice]: 2 to 6 mm, about what a surface is off by."""
CELL_M = (0.002, 0.006)
LEAST_POINTS = 30
"""Fewer pixels than this show no solid [choice]."""
STRAY_M = 0.012
"""A body of the cloud whose points are nearer to each other than this stays if it is large enough [choice]."""
STRAY_SHARE = 0.04
LEAST_OF_TABLE = 500
"""Fewer pixels than this say nothing of how the table lies [choice]."""
SMOOTH_PX, STEP_M = 2, 0.010
"""Depths are averaged over a square of so many pixels each way, over those no further off than this [choice]."""
LEAST_ALIKE = 5
"""A depth that so few pixels of the square share, itself counted, is a flying one [choice]."""
MASK_PX = 1
"""A mask may be this much too small: errors of calibration turn a camera by as much [choice]."""
PAIR_M, PAIR_ROUNDS = (0.015, 0.005), 12
"""Points of two cameras are pairs if they are this near, first and at last, m [choice]."""
SHELL_M = 0.0025
"""Least half thickness of what was seen [choice]: errors of calibration else carve thin things away."""

BORDER_M, ROWS_AT_ONCE = 1e-9, 4096
"""Nodes this near to the hull are asked again."""

VOTES = 5
"""A face belongs to the region if most of so many nearest told points do [choice]: cameras may disagree at its border."""

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Solid:
    """A closed surface in the world, m: V vertices, F faces, counter-clockwise from outside.

    Attributes:
        vertices: (V, 3), m.
        faces: (F, 3) rows of the vertices.
        region: (F,) faces of the receiver's region; None: none is told.
    """

    vertices: Float64[np.ndarray, "v 3"]
    faces: Int64[np.ndarray, "f 3"]
    region: Bool[np.ndarray, " f"] | None = None


@dataclass(frozen=True)
class View:
    """One camera's window: depth (0: none), whether the object's mask, how it looks at the world, and what is told of the
    region (None: nothing)."""

    depth_m: F64
    mask: NDArray[np.bool_]
    K: F64
    T_world_camera: F64
    region: NDArray[np.bool_] | None = None

    def told(self) -> NDArray[np.bool_]:
        """Whether each of `points` is in the receiver's region."""
        assert self.region is not None
        return self.region[self.mask & (self.depth_m > 0)]

    def points(self) -> F64:
        """Points of the object that it saw, world, m."""
        v, u = np.nonzero(self.mask & (self.depth_m > 0))
        z = self.depth_m[v, u]
        x = (u + 0.5 - self.K[0, 2]) / self.K[0, 0] * z
        y = (v + 0.5 - self.K[1, 2]) / self.K[1, 1] * z
        return _turned(self.T_world_camera, np.stack([x, y, z], 1))

    def carves(self, points: F64) -> NDArray[np.bool_]:
        """Whether it looks through points (world)."""
        R, p = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        x, y, z = _turned_back(R, points - p)
        z = np.maximum(z, 1e-3)
        u = np.floor(x / z * self.K[0, 0] + self.K[0, 2]).astype(np.int64)
        v = np.floor(y / z * self.K[1, 1] + self.K[1, 2]).astype(np.int64)
        h, w = self.mask.shape
        inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
        u, v = np.where(inside, u, 0), np.where(inside, v, 0)
        beside = ~self._grown[v, u]
        # what stands in front of a point says nothing about it
        beside &= (self._background[v, u] == 0) | (self._background[v, u] > z)
        before = self.mask[v, u] & (z < self.depth_m[v, u])
        return inside & (beside | before)

    @property
    def _grown(self) -> NDArray[np.bool_]:
        return binary_dilation(self.mask, iterations=MASK_PX)

    @property
    def _background(self) -> F64:
        """Nearest depth beside the object within a pixel; 0: none was measured."""
        d = np.where(self.mask | (self.depth_m <= 0), np.inf, self.depth_m)
        near = minimum_filter(d, 3)
        return np.where(np.isfinite(near), near, 0.0)


def completed(seen: Observation, row: int) -> Solid | None:
    """The solid that a trial's images show, in the world; None: too little of it was seen.

    Args:
        seen: of N trials.
        row: which of them.
    """
    views, table_m = levelled(seen, row)
    points = np.concatenate([v.points() for v in views])
    points = _without_strays(points)
    points = points[points[:, 2] > table_m]
    if len(points) < LEAST_POINTS:
        return None
    low, high = points.min(0), points.max(0)
    low[2] = table_m
    cell = float(np.clip((high - low).max() / CELLS, *CELL_M))
    low, high = low - 3 * cell, high + 3 * cell
    shape = np.ceil((high - low) / cell).astype(np.int64) + 1
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    nodes = low + cell * index
    full = _in_hull(points, table_m, nodes)
    for view in views:
        rows = np.flatnonzero(full)
        full[rows[view.carves(nodes[rows])]] = False
    full &= nodes[:, 2] > table_m
    inside = gaussian_filter(full.reshape(shape).astype(np.float64), 0.7) - 0.5
    shell = max(SHELL_M, 0.7 * cell)
    away, _ = cKDTree(points).query(nodes, distance_upper_bound=3 * shell)
    near = (shell - np.minimum(away, 3 * shell)) / (2 * cell)
    value = np.maximum(inside, near.reshape(shape))
    for axis in range(3):  # the surface closes inside the grid
        edge = np.moveaxis(value, axis, 0)
        edge[0] = edge[-1] = np.minimum(edge[0], -0.5)
    solid = _largest(_surface(value, low, cell))
    if solid is None or seen.region is None:
        return solid
    return replace(solid, region=region_of_faces(views, solid.vertices, solid.faces))


def region_of_faces(
    views: Sequence[View], vertices: Float64[np.ndarray, "v 3"], faces: Int64[np.ndarray, "f 3"]
) -> Bool[np.ndarray, " f"]:
    """(F,) the faces of a surface that lie in the receiver's region: most of the told points nearest to their middles do.

    Args:
        views: cameras that are told the region.
        vertices: (V, 3) of the surface, world, m.
        faces: (F, 3).
    """
    told, points = (np.concatenate([own(v) for v in views]) for own in (View.told, View.points))
    if not told.any():
        return np.zeros(len(faces), bool)
    votes = min(VOTES, len(points))
    _, nearest = cKDTree(points).query(vertices[faces].mean(1), np.arange(1, votes + 1))
    found: NDArray[np.bool_] = 2 * told[nearest].sum(1) > votes
    return found


def views_of(seen: Observation, row: int) -> list[View]:
    """A trial's cameras where they are believed to stand.

    Args:
        seen: of N trials.
        row: which of them.
    """
    images, told = seen.object, None if seen.region is None else seen.region[row].cpu().numpy()
    label, depth = images.label[row].cpu().numpy(), images.depth_m[row].double().cpu().numpy()
    K, T = (x[row].double().cpu().numpy() for x in (images.K, seen.T_world_camera))
    masks = label == LABELS.index("object")
    return [
        View(depth[c], masks[c], K[c], T[c], None if told is None else told[c])
        for c in range(len(label))
    ]


def levelled(seen: Observation, row: int) -> tuple[list[View], float]:
    """The cameras, levelled: their tables are one level plane. And its height, m; -inf: no camera shows a table."""
    views, planes, label = [], [], seen.object.label[row].cpu().numpy()
    for c, view in enumerate(views_of(seen, row)):
        mask, depth = view.mask, view.depth_m
        smooth = np.where(mask, _averaged(np.where(mask, depth, 0.0)), depth)
        views.append(replace(view, depth_m=smooth))
        shown = replace(view, mask=label[c] == LABELS.index("table")).points()
        planes.append(_plane(shown) if len(shown) >= LEAST_OF_TABLE else None)
    known = [p for p in planes if p is not None]
    if not known:
        return views, -np.inf
    table_m = float(np.mean([height for _, _, height in known]))
    for c, plane in enumerate(planes):
        if plane is not None:
            level = _level(*plane, table_m)
            T = np.stack([level @ column for column in views[c].T_world_camera.T], 1)
            views[c] = replace(views[c], T_world_camera=T)
    return _together(views), table_m


def _together(views: list[View]) -> list[View]:
    """The cameras, shifted level so that what two of them saw of the object lies together: each to the middle of its shifts
    to all."""
    clouds = [_without_strays(v.points()) for v in views]
    found = []
    for c, view in enumerate(views):
        shifts = [_shift(clouds[c], other) for k, other in enumerate(clouds) if k != c]
        T = view.T_world_camera.copy()
        T[:2, 3] += np.sum(shifts, 0) / len(views) if shifts else 0.0
        found.append(replace(view, T_world_camera=T))
    return found


def _shift(points: F64, onto: F64) -> F64:
    """(2,) the level shift that brings a cloud onto another one: ICP of the pairs that are each other's nearest."""
    shift = np.zeros(3)
    if min(len(points), len(onto)) < LEAST_POINTS:
        return shift[:2]
    tree, first = cKDTree(onto), points
    for near in np.geomspace(*PAIR_M, PAIR_ROUNDS):
        moved = first + shift
        away, to = tree.query(moved, distance_upper_bound=near)
        rows = np.flatnonzero(np.isfinite(away))
        if len(rows) < LEAST_POINTS:
            break
        _, back = cKDTree(moved).query(onto[to[rows]])
        rows = rows[back == rows]
        if len(rows) < LEAST_POINTS:
            break
        shift[:2] += np.median(onto[to[rows]] - moved[rows], 0)[:2]
    return shift[:2]


def _plane(points: F64) -> tuple[F64, F64, float]:
    """A point of the plane through points that lie nearly level, its normal (upwards), its height there: least squares, then
    again without those that are far off."""
    for _ in range(2):
        middle = points.mean(0)
        x, y, z = (points - middle).T
        xx, xy, yy, xz, yz = ((a * b).sum() for a, b in ((x, x), (x, y), (y, y), (x, z), (y, z)))
        det = max(xx * yy - xy * xy, 1e-12)
        a, b = (xz * yy - yz * xy) / det, (yz * xx - xz * xy) / det
        off = np.abs(z - a * x - b * y)
        points = points[off <= np.median(off) * 4 + 1e-6]
    normal = np.array([-a, -b, 1.0])
    return middle, normal / np.sqrt((normal * normal).sum()), float(middle[2])


def _level(middle: F64, normal: F64, height: float, table_m: float) -> F64:
    """(4, 4) the least motion that lays a plane level at a height."""
    x, y, c = normal
    # the turn that takes the normal to z
    k = 1.0 / (1.0 + c)
    R = np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, c]])
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = middle + [0, 0, table_m - height] - R @ middle
    return T


def _averaged(depth: F64) -> F64:
    """Mean depth of a pixel and of those about it that are as far within `STEP_M`; 0 stays 0."""
    k = SMOOTH_PX
    wide = np.pad(depth, k)
    total, count = np.zeros_like(depth), np.zeros_like(depth)
    h, w = depth.shape
    for dv in range(2 * k + 1):
        for du in range(2 * k + 1):
            other = wide[dv : dv + h, du : du + w]
            near = (other > 0) & (np.abs(other - depth) < STEP_M)
            total += np.where(near, other, 0.0)
            count += near
    return np.where((depth > 0) & (count >= LEAST_ALIKE), total / np.maximum(count, 1), 0.0)


def _without_strays(points: F64) -> F64:
    """Points of the cloud's larger bodies."""
    if len(points) < LEAST_POINTS:
        return points[:0]
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    cell = np.floor(points / (0.5 * STRAY_M)).astype(np.int64)
    cells, of = np.unique(cell, axis=0, return_inverse=True)
    of = of.ravel()
    pairs = cKDTree(cells.astype(np.float64)).query_pairs(2.0, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2)
    _, body = connected_components(links, directed=False)
    count = np.bincount(body[of])
    kept = count[body[of]] >= STRAY_SHARE * len(points)
    # a flying pixel has few others about it
    crowd = np.bincount(of)[of]
    return points[kept & (crowd > 1)]


def _in_hull(points: F64, table_m: float, nodes: F64) -> NDArray[np.bool_]:
    """Whether nodes are in the hull of the points and of their shadow on the table."""
    shadow = points * [1.0, 1.0, 0.0] + [0.0, 0.0, table_m]
    try:
        hull = ConvexHull(np.concatenate([points, shadow]))
    except QhullError:
        return np.zeros(len(nodes), bool)
    planes = np.unique(np.round(hull.equations, 9), axis=0)
    low, high = hull.min_bound - 1e-6, hull.max_bound + 1e-6  # planes are rounded
    rows = np.flatnonzero(((nodes >= low) & (nodes <= high)).all(1))
    beyond = np.concatenate(
        [(nodes[few] @ planes[:, :3].T + planes[:, 3]).max(1) for few in _split(rows)]
    )
    # the order of a matrix product's sums is nobody's: what is on the border is asked in ours
    border = np.flatnonzero(np.abs(beyond) < BORDER_M)
    x, y, z = nodes[rows[border]].T
    beyond[border] = -np.inf
    for a, b, c, d in planes:
        beyond[border] = np.maximum(beyond[border], a * x + b * y + c * z + d)
    inside = np.zeros(len(nodes), bool)
    inside[rows[beyond <= 0]] = True
    return inside


def _split(rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Rows in pieces whose planes fit a processor's cache; one piece at least."""
    return [rows[i : i + ROWS_AT_ONCE] for i in range(0, max(len(rows), 1), ROWS_AT_ONCE)]


def _surface(value: NDArray[np.float64], low: F64, cell: float) -> Solid:
    """Marching cubes where a field is 0."""
    value = np.where(np.abs(value) < 1e-3, -1e-3, value)
    nodes = np.stack(np.meshgrid(*map(np.arange, value.shape), indexing="ij"), -1)
    flat = value.ravel(order="F")
    grid = np.ascontiguousarray(low + cell * nodes.transpose(2, 1, 0, 3).reshape(-1, 3))
    vertices, faces, _ = igl.marching_cubes(-flat, grid, *value.shape, 0.0)
    return Solid(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))


def _largest(solid: Solid) -> Solid | None:
    """Its largest body, by volume."""
    import trimesh

    if not len(solid.faces):
        return None
    bodies = trimesh.Trimesh(solid.vertices, solid.faces, process=True).split(only_watertight=True)
    if not len(bodies):
        return None
    best = max(bodies, key=lambda b: abs(b.volume))
    if best.volume < 0:
        best.invert()
    return Solid(np.asarray(best.vertices, np.float64), np.asarray(best.faces, np.int64))


def _turned(T: F64, x: F64) -> F64:
    """T x of points, sums in a fixed order."""
    columns = [x[:, 0] * r[0] + x[:, 1] * r[1] + x[:, 2] * r[2] + r[3] for r in T[:3]]
    return np.stack(columns, 1)


def _turned_back(R: F64, x: F64) -> tuple[F64, F64, F64]:
    a, b, c = (x[:, 0] * R[0, k] + x[:, 1] * R[1, k] + x[:, 2] * R[2, k] for k in range(3))
    return a, b, c
