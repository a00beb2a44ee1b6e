"""Solids that the objects are made of (millimetres), and the bookkeeping of which surface belongs to which part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from manifold3d import CrossSection, Manifold, Mesh
from numpy.typing import ArrayLike, NDArray

Point = Sequence[float] | NDArray[np.float64]

Cut = tuple[str, tuple[float, ...], float, str]
"""(part, normal, offset in mm, new part)"""

Plane = tuple[tuple[float, float, float], float]


@dataclass
class Parts:
    """Names the surfaces of solids; booleans carry the names along (Manifold's original ids)."""

    names: dict[int, str] = field(default_factory=dict)
    solids: list[tuple[str, Manifold]] = field(default_factory=list)
    """(part, solid) that add material"""
    cuts: list[Cut] = field(default_factory=list)

    def __call__(self, name: str, solid: Manifold) -> Manifold:
        self.solids.append((name, solid))
        return self.hole(name, solid)

    def hole(self, name: str, solid: Manifold) -> Manifold:
        """A solid that is taken away; the walls that it leaves have the name."""
        marked = solid.as_original()
        self.names[marked.original_id()] = name
        return marked

    def divided(self, name: str, solid: Manifold, *cuts: tuple[str, Point, float]) -> Manifold:
        """A solid of several parts: each cut (new name, normal n, offset d) names what lies at n.p > d of the rest."""
        self.cuts += [
            (name, tuple(float(x) for x in normal), float(offset), new)
            for new, normal, offset in cuts
        ]
        return self(name, solid)


@dataclass(frozen=True)
class Spec:
    """Parameters of one object; ``size`` is scene.md's box.

    ``edge`` is the triangles' size, ``fine`` that of single parts. ``cuts`` divide a part along a plane: faces with
    n.p > d get the new name. ``receiver`` names the parts of the receiver's region, ``take`` its name in the
    instruction.
    """

    name: str
    split: str
    size: tuple[float, float, float]
    mass: float
    edge: float
    parts: tuple[str, ...]
    solid: Callable[[Parts], Manifold]
    cuts: tuple[tuple[str, Plane, str], ...] = ()
    fine: tuple[tuple[str, float], ...] = ()
    receiver: tuple[str, ...] = ()
    take: str = ""
    frame: str = ""


def box(
    x: float, y: float, z: float, r: float = 0.0, at: Sequence[float] = (0, 0, 0), n: int = 12
) -> Manifold:
    """A box, its edges rounded with radius r."""
    if r <= 0:
        return Manifold.cube((x, y, z), True).translate(at)
    corners = [
        Manifold.sphere(r, n).translate((sx * (x / 2 - r), sy * (y / 2 - r), sz * (z / 2 - r)))
        for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)
    ]  # fmt: skip
    return Manifold.batch_hull(corners).translate(at)


def revolve(profile: ArrayLike, n: int = 48) -> Manifold:
    """A closed (r, z) profile turned about z.

    Args:
        profile: (K, 2) corners, mm; the first is not repeated.
        n: sides of the solid.
    """
    return Manifold.revolve(CrossSection([_ccw(profile)]), n)


def extrude(outline: ArrayLike, z0: float, z1: float) -> Manifold:
    """An (x, y) outline between two heights."""
    return Manifold.extrude(CrossSection([_ccw(outline)]), z1 - z0).translate((0, 0, z0))


def cylinder(
    p: ArrayLike, q: ArrayLike, r: float, r1: float | None = None, n: int = 32
) -> Manifold:
    """A cylinder or cone from p to q."""
    start, end = np.asarray(p, float), np.asarray(q, float)
    axis = end - start
    length = float(np.linalg.norm(axis))
    return _along(Manifold.cylinder(length, r, r if r1 is None else r1, n), axis / length, start)


def capsule(p: Point, q: Point, r: float, r1: float | None = None, n: int = 16) -> Manifold:
    """The hull of two balls."""
    return Manifold.batch_hull(
        [
            Manifold.sphere(r, n).translate(tuple(p)),
            Manifold.sphere(r if r1 is None else r1, n).translate(tuple(q)),
        ]
    )


def chain(points: ArrayLike, radii: ArrayLike, n: int = 12) -> Manifold:
    """Capsules along a polyline."""
    p = np.asarray(points, float)
    r = np.broadcast_to(np.asarray(radii, float), len(p))
    return union(
        capsule(p[i], p[i + 1], float(r[i]), float(r[i + 1]), n) for i in range(len(p) - 1)
    )


def union(solids: object) -> Manifold:
    """All of them as one."""
    total = Manifold()
    for solid in solids:  # type: ignore[attr-defined]
        total = total + solid
    return total


def oval(a: float, b: float, n: int = 24, power: float = 2.0) -> NDArray[np.float64]:
    """(n, 2) superellipse with half axes a, b."""
    t = 2 * np.pi * (np.arange(n) + 0.5) / n
    c, s = np.cos(t), np.sin(t)
    return np.stack(
        [a * np.sign(c) * np.abs(c) ** (2 / power), b * np.sign(s) * np.abs(s) ** (2 / power)],
        axis=1,
    )


def loft(rings: Sequence[NDArray[np.float64]], closed: bool = False) -> Manifold:
    """Skin over rings of equally many 3-D points; ends are closed by fans, or the last ring joins the first."""
    r = np.asarray(rings, float)
    count, m = r.shape[:2]
    vertices = r.reshape(-1, 3)
    faces = []
    for i in range(count if closed else count - 1):
        for j in range(m):
            a, b = i * m + j, i * m + (j + 1) % m
            c, d = (i + 1) % count * m + j, (i + 1) % count * m + (j + 1) % m
            faces += [(a, b, d), (a, d, c)]
    if not closed:
        ends = len(vertices) + np.arange(2)
        vertices = np.concatenate([vertices, r[:1].mean(axis=1), r[-1:].mean(axis=1)])
        for j in range(m):
            faces.append((ends[0], (j + 1) % m, j))
            faces.append((ends[1], (count - 1) * m + j, (count - 1) * m + (j + 1) % m))
    f = np.array(faces, np.uint32)
    t = vertices[f]
    if np.einsum("ij,ij->i", t[:, 0], np.cross(t[:, 1], t[:, 2])).sum() < 0:
        f = f[:, ::-1]
    solid = Manifold(Mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(f)))
    if solid.is_empty():
        raise ValueError(f"loft: {solid.status()}")
    return solid


def sweep(
    path: ArrayLike,
    sections: Sequence[NDArray[np.float64]],
    up: ArrayLike = (0, 0, 1),
    closed: bool = False,
) -> Manifold:
    """(M, 2) sections carried along a path; a section's second axis stays as near to ``up`` as it can."""
    p = np.asarray(path, float)
    if closed:
        tangent = np.roll(p, -1, axis=0) - np.roll(p, 1, axis=0)
    else:
        tangent = np.gradient(p, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(np.asarray(up, float), tangent)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    top = np.cross(tangent, side)
    rings = [
        p[i] + s[:, :1] * side[i] + s[:, 1:] * top[i]
        for i, s in enumerate(sections if len(sections) == len(p) else list(sections) * len(p))
    ]
    return loft(rings, closed)


def along_x(
    stations: list[tuple[float, float, float]], count: int, power: float = 2.4, n: int = 24
) -> Manifold:
    """A straight loft: (x, half width y, half height z) stations, smoothed."""
    x, a, b = spline(stations, count).T
    return loft(
        [np.column_stack([np.full(n, x[i]), oval(a[i], b[i], n, power)]) for i in range(count)]
    )


def spline(points: ArrayLike, count: int, closed: bool = False) -> NDArray[np.float64]:
    """(count, D) a smooth curve through points."""
    from scipy.interpolate import CubicSpline

    p = np.asarray(points, float)
    if closed:
        p = np.concatenate([p, p[:1]])
    t = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    curve = CubicSpline(t, p, bc_type="periodic" if closed else "natural")
    return np.asarray(curve(np.linspace(0, t[-1], count, endpoint=not closed)))


def round_cone(
    p: NDArray[np.float64], a: ArrayLike, b: ArrayLike, ra: float, rb: float
) -> NDArray[np.float64]:
    """(N,) signed distance (negative inside, near enough) to balls swept from a to b."""
    start, along = np.asarray(a, float), np.asarray(b, float) - np.asarray(a, float)
    t = np.clip((p - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(p - start - t[:, None] * along, axis=1) - (ra + t * (rb - ra))


def round_box(
    p: NDArray[np.float64], center: ArrayLike, half: ArrayLike, r: float
) -> NDArray[np.float64]:
    """(N,) signed distance to a rounded box."""
    q = np.abs(p - np.asarray(center, float)) - (np.asarray(half, float) - r)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0) - r


def smooth_min(a: NDArray[np.float64], b: NDArray[np.float64], k: float) -> NDArray[np.float64]:
    """A union with a fillet of size k."""
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - h * h * k / 4


def _ccw(outline: ArrayLike) -> NDArray[np.float64]:
    p = np.asarray(outline, float)
    x, y = p.T
    return p if float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) > 0 else p[::-1].copy()


def _along(solid: Manifold, axis: NDArray[np.float64], at: NDArray[np.float64]) -> Manifold:
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return solid.transform(np.stack([x, np.cross(axis, x), axis, at], axis=1))
