"""Bounding capsules and lever arms for the collision kernels (float64 NumPy, on loading a
scene)."""

import hashlib
import json
from collections.abc import Sequence
from functools import cache, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from r2h_batch.scene.arrays import asset
from r2h_batch.scene.robot import (
    Primitives,
    Robot,
    ShapeKind,
    corners_of,
    gripper_primitives_at,
    lever_bound_for_sphere,
    lever_bounds,
)

Array = NDArray[np.float64]

OPENINGS_M = np.linspace(0.0015, 0.086, 60)
BETWEEN_OPENINGS_M = 1e-3
"""The pads' parts move less than this between two sampled openings (1.4 mm of gap)."""


def capsule_of_primitive(kind: int, size: Array) -> tuple[Array, float]:
    """Half axis (3,) and radius of a capsule about the primitive's centre that holds it."""
    if kind == ShapeKind.BOX:
        long = int(np.argmax(size))
        axis = np.zeros(3)
        axis[long] = size[long]
        return axis, float(np.linalg.norm(np.delete(size, long)))
    if kind in (ShapeKind.CAPSULE, ShapeKind.CYLINDER):
        return np.array([0.0, 0.0, size[1]]), float(size[0])
    return np.zeros(3), float(size[0])


def capsule_of_shape(shapes: Primitives, i: int) -> tuple[Array, float]:
    """The same of a robot's shape, whatever its kind."""
    corners = corners_of(shapes)[i]
    if len(corners) == 0:
        return capsule_of_primitive(int(shapes.kind[i]), shapes.size[i])
    found = []
    for half in np.linspace(0.0, float(np.abs(corners[:, 2]).max()), 9):
        over = np.maximum(np.abs(corners[:, 2]) - half, 0.0)
        radius = float(np.hypot(np.hypot(corners[:, 0], corners[:, 1]), over).max()) + 1e-6
        found.append((radius**2 * (2 * half + 4 / 3 * radius), half, radius))
    _, half, radius = min(found)
    return np.array([0.0, 0.0, half]), radius


def capsule_of_balls(centers: Array, radii: Array) -> tuple[Array, Array, float]:
    """End points and radius of a small capsule that holds all balls (N, 3), (N,); exact
    containment, greedy axis."""
    candidates = [
        *np.eye(3),
        np.linalg.svd(centers - centers.mean(0), full_matrices=False)[2][0]
        if len(centers) > 1
        else np.eye(3)[0],
    ]
    axes = np.array(candidates)
    along = np.stack([centers @ axis for axis in axes])
    # all axes at once, (3, axes, N): one coordinate of all points is contiguous
    across = centers - along[..., None] * axes[:, None]
    across = np.ascontiguousarray(across.transpose(2, 0, 1))
    middle = (across.min(2) + across.max(2)) / 2
    # of a slanted axis' box it is not across
    middle = np.stack([m - (m @ axis) * axis for m, axis in zip(middle.T, axes, strict=True)], 1)
    # a few steps towards the smallest enclosing circle (Badoiu and Clarkson 2003)
    for _ in range(50):
        far = (_length(across - middle[:, :, None]) + radii).argmax(1)
        middle = middle + (across[:, np.arange(len(axes)), far] - middle) * 0.05
    best: tuple[float, Array, Array, float] | None = None
    for axis, height, off, center in zip(
        axes, along, _length(across - middle[:, :, None]), middle.T, strict=True
    ):
        radius = float((off + radii).max())
        slack = np.sqrt(np.maximum((radius - radii) ** 2 - off**2, 0.0))
        low, high = float((height + slack).min()), float((height - slack).max())
        if low > high:
            low = high = (low + high) / 2
        volume = np.pi * radius**2 * (high - low) + 4 / 3 * np.pi * radius**3
        if best is None or volume < best[0]:
            best = (volume, center + low * axis, center + high * axis, radius)
    assert best is not None
    return best[1], best[2], best[3] + 1e-6


def _length(vectors: Array) -> Array:
    """Lengths of vectors (3, ...)."""
    x, y, z = vectors
    return np.sqrt(x * x + y * y + z * z)


def capsule_of_points(points: Array) -> tuple[Array, Array, float]:
    """End points and radius of a small capsule that holds the points (N, 3)."""
    return capsule_of_balls(points, np.zeros(len(points)))


def ball_inside(points: Array) -> Array:
    """`inner_ball`, read from `BALLS` where it is there: the linear programs and scipy would take a sixth of a process' start."""
    stored = _stored_balls().get(hull_key(points))
    return inner_ball(points) if stored is None else np.array(stored)


BALLS = "inner_balls.json"
"""In assets/objects: `hull_key` -> `inner_ball` of the hulls of all shipped objects (assets/objects/build_inner_balls.py)."""


def hull_key(points: Array) -> str:
    """Name of a hull in `BALLS`: sha256 (hex) of its float64 points."""
    return hashlib.sha256(points.tobytes()).hexdigest()


@cache
def _stored_balls() -> dict[str, list[float]]:
    balls: dict[str, list[float]] = json.loads(asset("objects", BALLS).read_text(encoding="utf-8"))
    return balls


def inner_ball(points: Array) -> Array:
    """Centre and radius (4,) of the largest ball inside the points' hull (of equals the most
    central), a little less."""
    from scipy.optimize import linprog  # 0.5 s with ConvexHull
    from scipy.spatial import ConvexHull

    faces = ConvexHull(points).equations  # unit normals: n . x + d + r <= 0
    n, d = faces[:, :3], faces[:, 3]
    one = np.ones((len(n), 1))
    free = [(None, None)] * 3
    largest = linprog([0, 0, 0, -1], A_ub=np.hstack([n, one]), b_ub=-d, bounds=[*free, (0, None)])
    if not largest.success:
        raise ValueError(f"no ball fits into a hull of {len(points)} points: {largest.message}")
    radius = 0.999 * largest.x[3]
    middle, eye = (points.min(0) + points.max(0)) / 2, np.eye(3)
    A = np.vstack([np.hstack([n, 0 * n]), np.hstack([eye, -eye]), np.hstack([-eye, -eye])])
    central = linprog(
        [0, 0, 0, 1, 1, 1], A_ub=A, b_ub=np.r_[-d - radius, middle, -middle], bounds=[*free, *free]
    )
    center = central.x[:3] if central.success else largest.x[:3]
    return np.append(center, max(radius - 1e-6, 1e-6))


def outer_ball(points: Array) -> Array:
    """Centre and radius (4,) of the smallest ball that holds the points (N, 3).

    With t = r^2 - |c|^2 it is the least |c|^2 + t such that |p|^2 - 2 p . c <= t for each point p: a convex problem of four
    variables.
    """
    from scipy.optimize import minimize  # 0.5 s

    middle = points.mean(0)
    size = float(np.sqrt(((points - middle) ** 2).sum(1).max()))
    p = (points - middle) / size
    square, away = (p * p).sum(1), np.hstack([2.0 * p, np.ones((len(p), 1))])
    found = minimize(
        lambda v: v[:3] @ v[:3] + v[3],
        [0.0, 0.0, 0.0, float(square.max())],
        jac=lambda v: np.append(2.0 * v[:3], 1.0),
        constraints={"type": "ineq", "fun": lambda v: away @ v - square, "jac": lambda v: away},
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 200},
    )
    center = middle + size * found.x[:3]
    return np.append(center, np.sqrt(((points - center) ** 2).sum(1).max()))


BLOCK_POINTS = 16
"""As in kernels/geometry/shape.py (tests/kernels/test_codes.py)."""


def point_blocks(
    points: NDArray[np.floating], start: ArrayLike
) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Rows of hulls for geometry/shape.py, BLOCKS: 16 points at a time, their x, y and z one after
    the other; and where each hull's rows start. Points start[k] to start[k + 1] - 1 are hull k's;
    its last one fills its last block."""
    first, end = np.asarray(start)[:-1], np.asarray(start)[1:]
    count = -(-(end - first) // BLOCK_POINTS) * BLOCK_POINTS
    rows = np.cumsum(np.append(0, count))
    index = np.arange(rows[-1]) + np.repeat(first - rows[:-1], count)
    full = points[np.minimum(index, np.repeat(end - 1, count))]
    return full.reshape(-1, BLOCK_POINTS, 3).transpose(0, 2, 1).reshape(-1, 3), rows


CELLS_PER_EDGE = 6
"""As in kernels/geometry/shape.py (tests/kernels/test_codes.py)."""


def support_cells(points: Array) -> Array:
    """Rows (216 + n, 3) of a hull for geometry/shape.py: first row and number of points of each
    direction cell, then blocks.

    A cell keeps every point that can be farthest along some direction of it (`_farthest`). Of what
    a side of the cube keeps, its rows of cells keep a part, and of that its cells.
    """
    whole = (-1.0, 1.0)
    windows = list(pairwise(np.linspace(*whole, CELLS_PER_EDGE + 1)))
    sides = [(axis, sign) for axis in range(3) for sign in whole[::-1]]
    kept: list[Array] = []
    around = [_corners(*side, whole, whole) for side in sides]
    for side, of_side in zip(sides, _farthest(points, around), strict=True):
        rows = _farthest(of_side, [_corners(*side, u, whole) for u in windows])
        for u, row in zip(windows, rows, strict=True):
            kept += _farthest(row, [_corners(*side, u, v) for v in windows])
    count = np.array([len(cell) for cell in kept])
    blocks, first = point_blocks(np.concatenate(kept), np.cumsum(np.append(0, count)))
    header = np.stack([len(kept) + first[:-1], count, np.zeros_like(count)], 1)
    return np.concatenate([header.astype(np.float64), blocks])


def _corners(axis: int, sign: float, u: tuple[float, float], v: tuple[float, float]) -> Array:
    """(4, 3) corners of the directions whose coordinate `axis` is `sign` and whose next two lie in u
    and v."""
    corner = np.empty((4, 3))
    corner[:, axis] = sign
    corner[:, (axis + 1) % 3] = u[0], u[0], u[1], u[1]
    corner[:, (axis + 2) % 3] = v[0], v[1], v[0], v[1]
    return corner


def _farthest(points: Array, corners: Sequence[Array]) -> list[Array]:
    """For each window of directions (its corners) the points that can be farthest along one of them.

    Left out is what one other point beats along all four corners: a linear function that is smaller
    at the corners is smaller in between.
    """
    height = points @ np.concatenate(corners).T
    at = np.ascontiguousarray(height.T).reshape(len(corners), 4, -1)
    rivals = np.concatenate([at.argmax(2), at.sum(1).argsort(1)[:, -8:]], 1)
    least = np.take_along_axis(at, rivals[:, None], 2) - 1e-9
    worse = at[:, :, None] < least[..., None]  # (windows, 4, rivals, points)
    beaten = np.any(np.all(worse, axis=1), axis=1)
    return [points[~left_out] for left_out in beaten]


def gripper_balls(robot: Robot) -> tuple[Array, Array]:
    """Ends of the gripper primitives' capsules at every opening, (G, n, 3) in the wrist_3 frame,
    and radii (G,)."""
    T_wrist_ee = robot.T_wrist3_flange @ robot.T_flange_ee
    T = np.einsum("ij,ngjk->gnik", T_wrist_ee, gripper_primitives_at(robot, OPENINGS_M))
    ends, radii = [], []
    for g in range(len(robot.gripper.names)):
        axis, radius = capsule_of_primitive(int(robot.gripper.kind[g]), robot.gripper.size[g])
        turned = T[g, :, :3, :3] @ axis
        ends.append(np.concatenate([T[g, :, :3, 3] - turned, T[g, :, :3, 3] + turned]))
        radii.append(radius + BETWEEN_OPENINGS_M)
    return np.stack(ends), np.array(radii)


@lru_cache(maxsize=4)
def robot_levers(robot: Robot) -> Array:
    """(N, 6) bounds for arm and gripper primitives: largest distance of any point from each joint's
    axis, any posture."""
    joints = len(robot.joints)
    ends, radii = gripper_balls(robot)
    gripper = [
        np.max(
            [lever_bound_for_sphere(robot, joints, c, r) for c in e[:: max(1, len(e) // 24)]]
            + [lever_bound_for_sphere(robot, joints, e[-1], r)],
            axis=0,
        )
        + BETWEEN_OPENINGS_M * 6
        for e, r in zip(ends, radii, strict=True)
    ]
    return np.concatenate([lever_bounds(robot).T, np.array(gripper)])
