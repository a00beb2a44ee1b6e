"""Slow twins in float64 NumPy: distance of convex bodies with certified bounds, and of primitives to a closed mesh."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from r2h_batch.scene.robot import ShapeKind

Array = NDArray[np.float64]

MESH_PAIR_GAP_M = 1e-9


@dataclass(frozen=True)
class Bodies:
    """N convex bodies in world coordinates: conv(points) + disc about local z + ball. Points (N, P, 3) in the body frame."""

    points: Array
    disc: Array  # (N,) radius of a disc in the local xy plane that the points are swept by (cylinders)
    ball: Array  # (N,)
    R: Array  # (N, 3, 3)
    p: Array  # (N, 3)

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: Any) -> "Bodies":
        return Bodies(self.points[rows], self.disc[rows], self.ball[rows], self.R[rows], self.p[rows])

    def support(self, d: Array) -> Array:
        """Farthest points (N, 3) of the bodies without their balls along world directions d (N, 3)."""
        local = np.einsum("nij,ni->nj", self.R, d)
        at = np.einsum("npj,nj->np", self.points, local).argmax(1)
        best = self.points[np.arange(len(self)), at].copy()
        across = np.hypot(local[:, 0], local[:, 1])
        scale = np.divide(self.disc, across, out=np.zeros_like(across), where=across > 1e-300)
        best[:, :2] += scale[:, None] * local[:, :2]
        return np.einsum("nij,nj->ni", self.R, best) + self.p


def core_of(kind: int, size: Any, points: Any = None, sides: int = 0) -> tuple[Array, float, float]:
    """Corners (P, 3) of a body, and the radii of the disc about z and of the ball that they are swept by.

    A cylinder with `sides` is a prism around it instead, so many sides: corners alone.
    """
    z = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    if kind == ShapeKind.SPHERE:
        return np.zeros((1, 3)), 0.0, float(size[0])
    if kind == ShapeKind.CAPSULE:
        return z * size[1], 0.0, float(size[0])
    if kind == ShapeKind.BOX:
        return np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T * size, 0.0, 0.0
    if kind != ShapeKind.CYLINDER:
        return np.asarray(points, np.float64), 0.0, 0.0
    if not sides:
        return z * size[1], float(size[0]), 0.0
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = size[0] / np.cos(np.pi / sides) * np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    return (ring[:, None] + z * size[1]).reshape(-1, 3), 0.0, 0.0


def bodies(kinds: ArrayLike, sizes: Any, T: Array, points: Any = None) -> Bodies:
    """Bodies from kinds, MuJoCo-like sizes and poses (N, 4, 4); `points[i]` are a HULL's points."""
    found = [
        core_of(
            int(k), None if sizes is None else np.asarray(sizes[i], np.float64), None if points is None else points[i]
        )
        for i, k in enumerate(np.asarray(kinds))
    ]
    cores = [core for core, _, _ in found]
    most = max(map(len, cores), default=1)
    padded = [np.concatenate([c, np.repeat(c[:1], most - len(c), 0)]) for c in cores]
    T, disc, ball = np.asarray(T, np.float64), np.array([d for _, d, _ in found]), np.array([b for _, _, b in found])
    return Bodies(np.array(padded).reshape(len(cores), most, 3), disc, ball, T[:, :3, :3].copy(), T[:, :3, 3].copy())


def convex_distance(a: Bodies, b: Bodies, *, iterations: int = 300, gap: float = 1e-10) -> tuple[Array, Array]:
    """Lower and upper bounds (N,) of the pairs' distances: GJK with every subset of the simplex tried, so nothing is lost.

    Both bounds are certificates in float64 whatever happened on the way: a separating plane, and two points of the bodies.
    Cores that meet have bounds minus the balls; both are then <= 0.
    """
    n = len(a)
    v = a.p - b.p
    v[np.einsum("ni,ni->n", v, v) < 1e-24] = (1.0, 0.0, 0.0)
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    simplex, used = np.zeros((n, 4, 3)), np.zeros((n, 4), bool)
    live = np.arange(n)
    for _ in range(iterations):
        if not len(live):
            break
        va = v[live]
        length = np.linalg.norm(va, axis=1)
        w = a[live].support(-va) - b[live].support(va)
        lower[live] = np.maximum(lower[live], np.einsum("ni,ni->n", va, w) / length)
        open_ = upper[live] - lower[live] > gap
        live, w = live[open_], w[open_]
        if not len(live):
            break
        slot = used[live].argmin(1)  # a simplex of four never gets here
        simplex[live, slot] = w
        used[live, slot] = True
        best, weights = _nearest_in_simplex(simplex[live], used[live])
        size = np.linalg.norm(best, axis=1)
        fell = size < upper[live]
        upper[live] = np.minimum(upper[live], size)
        v[live] = best
        used[live] = weights > 0
        live = live[fell & (size > 1e-12) & ~(weights > 0).all(1)]
    inside = upper <= 1e-12
    lower = np.where(inside, np.minimum(lower, 0.0), lower)
    return lower - a.ball - b.ball, upper - a.ball - b.ball


def penetration_depth(a: Array, b: Array, grown: float = 0.0) -> float:
    """Length of the shortest translation that parts conv(a) and conv(b), one of them grown by a ball; 0 where they are apart.

    The least distance from the origin to a face of their Minkowski difference; Qhull gives all its faces.
    """
    try:
        inside = -float(ConvexHull((a[:, None] - b).reshape(-1, 3)).equations[:, 3].max())
    except QhullError:  # two segments: a flat difference, which holds no ball
        inside = 0.0
    if inside <= 0:  # the cores are apart: their ball reaches farther than that
        one, other = (bodies([ShapeKind.HULL], None, np.eye(4)[None], [x]) for x in (a, b))
        inside = -max(float(convex_distance(one, other)[0][0]), 0.0)
    return max(inside + grown, 0.0)


_SUBSETS = [[i for i in range(4) if m >> i & 1] for m in range(1, 16)]


def _nearest_in_simplex(points: Array, used: Array) -> tuple[Array, Array]:
    """Nearest point to the origin in conv(points[used]) and its weights (N, 4), by trying all subsets."""
    n = len(points)
    best, best_weights, best_size = np.zeros((n, 3)), np.zeros((n, 4)), np.full(n, np.inf)
    for subset in _SUBSETS:
        rows = np.flatnonzero(used[:, subset].all(1))
        if not len(rows):
            continue
        k = len(subset)
        w = points[rows][:, subset]
        if k == 1:
            part = np.ones((len(rows), 1))
        else:
            edges = w[:, 1:] - w[:, :1]
            gram = np.einsum("nik,njk->nij", edges, edges)
            right = -np.einsum("nik,nk->ni", edges, w[:, 0])
            good = np.linalg.det(gram) > 1e-14 * np.prod(np.einsum("nii->ni", gram), axis=1)
            rows, w, gram, right = rows[good], w[good], gram[good], right[good]
            tail = np.linalg.solve(gram, right[..., None])[..., 0] if len(rows) else np.zeros((0, k - 1))
            part = np.concatenate([1 - tail.sum(1, keepdims=True), tail], 1)
            good = (part > 0).all(1)
            rows, w, part = rows[good], w[good], part[good]
        point = np.einsum("ni,nik->nk", part, w)
        if k == 4:
            point = np.zeros_like(point)
        size = np.linalg.norm(point, axis=1)
        better = size < best_size[rows]
        rows, part, point, size = rows[better], part[better], point[better], size[better]
        best[rows], best_size[rows] = point, size
        best_weights[rows] = 0.0
        best_weights[rows[:, None], subset] = part
    return best, best_weights


def primitive_distance(kind: int, size: Any, x: Array) -> Array:
    """Signed distance of points x (..., 3), in the primitive's frame, to its surface: negative inside. Closed form."""
    if kind == ShapeKind.BOX:
        q = np.abs(x) - size
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
    if kind == ShapeKind.CYLINDER:
        q = np.stack([np.hypot(x[..., 0], x[..., 1]) - size[0], np.abs(x[..., 2]) - size[1]], -1)
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
    along = np.clip(x[..., 2], -size[1], size[1]) if kind == ShapeKind.CAPSULE else 0.0 * x[..., 2]
    return np.linalg.norm(x - along[..., None] * np.array([0.0, 0.0, 1.0]), axis=-1) - size[0]


def point_to_segment(x: Array, a: Array, b: Array) -> Array:
    """Distance of points x (..., 3) to segments from a to b."""
    u = b - a
    s = np.clip(((x - a) * u).sum(-1) / np.maximum((u * u).sum(-1), 1e-30), 0, 1)
    return np.linalg.norm(a + s[..., None] * u - x, axis=-1)


def winding_number(x: Array, triangles: Array) -> float:
    """How often the closed surface (F, 3, 3) goes round x (van Oosterom and Strackee 1983)."""
    t = triangles - x
    length = np.linalg.norm(t, axis=2)
    a, b, c = t[:, 0], t[:, 1], t[:, 2]
    la, lb, lc = length.T
    dot = lambda u, w: np.einsum("fi,fi->f", u, w)  # noqa: E731
    angle = np.arctan2(
        np.einsum("fi,fi->f", a, np.cross(b, c)), la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    )
    return float(angle.sum() / (2 * np.pi))


def mesh_distance(kind: int, size: Array, T: Array, triangles: Array, *, cap: float = np.inf) -> float:
    """Distance of a primitive at T to a closed surface's triangles (F, 3, 3): 0 where they meet, -1 where one holds the other.

    Exact to 1e-9 m below `cap`, `cap` above.
    """
    inverse = np.linalg.inv(T)
    local = triangles @ inverse[:3, :3].T + inverse[:3, 3]
    corners = primitive_distance(kind, size, local)
    best = min(float(cap), max(float(corners.min()), 0.0))
    if corners.min() < 0 < corners.max():
        return 0.0
    if corners.max() <= 0:
        return -1.0
    if best > 0:
        center = local.mean(1)
        lower = primitive_distance(kind, size, center) - np.linalg.norm(local - center[:, None], axis=2).max(1)
        order = np.argsort(lower)
        for first in range(0, len(order), 16):
            faces = order[first : first + 16]
            faces = faces[lower[faces] < best]
            if not len(faces):
                break
            n = len(faces)
            a = bodies([kind] * n, [size] * n, np.tile(np.eye(4), (n, 1, 1)))
            b = bodies([ShapeKind.HULL] * n, None, np.tile(np.eye(4), (n, 1, 1)), local[faces])
            best = min(best, float(np.maximum(convex_distance(a, b, gap=MESH_PAIR_GAP_M)[1], 0.0).min()))
            if best < MESH_PAIR_GAP_M:
                return 0.0
    return -1.0 if abs(winding_number(np.zeros(3), local)) > 0.5 else best
