"""Isotropic remeshing that keeps sharp edges and label borders: booleans leave slivers, contacts and samplers hate them.

Split long edges, collapse short ones, flip towards Delaunay, relax along the surface (Botsch and Kobbelt 2004); edges
that are sharp or separate two labels are features: they are split and collapsed along themselves only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.scene.solid import signed_distance

Vec = tuple[float, float, float]
LONG, SHORT = 1.35, 0.75
SHARP_COS = float(np.cos(np.radians(32.0)))


class Surface:
    """A closed triangle surface with one label per face, edited edge by edge."""

    def __init__(
        self, vertices: NDArray[np.float64], faces: NDArray[np.int64], label: NDArray[np.int64]
    ) -> None:
        self.size: list[float] = []
        self.v: list[Vec] = [(float(x), float(y), float(z)) for x, y, z in vertices]
        self.f: list[tuple[int, int, int] | None] = [(int(a), int(b), int(c)) for a, b, c in faces]
        self.label: list[int] = [int(x) for x in label]
        self.of: list[set[int]] = [set() for _ in self.v]
        for k, face in enumerate(self.f):
            assert face is not None
            for a in face:
                self.of[a].add(k)

    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """(vertices, faces, label) without gaps."""
        live = [k for k, face in enumerate(self.f) if face is not None]
        faces = np.array([self.f[k] for k in live], np.int64)
        used, inverse = np.unique(faces, return_inverse=True)
        return (
            np.array(self.v)[used],
            inverse.reshape(-1, 3),
            np.array([self.label[k] for k in live], np.int64),
        )

    def edges(self) -> list[tuple[int, int]]:
        found = set()
        for face in self.f:
            if face is not None:
                a, b, c = face
                found.add((a, b) if a < b else (b, a))
                found.add((b, c) if b < c else (c, b))
                found.add((c, a) if c < a else (a, c))
        return sorted(found)

    def sides(self, a: int, b: int) -> list[int]:
        return sorted(self.of[a] & self.of[b])

    def length(self, a: int, b: int) -> float:
        p, q = self.v[a], self.v[b]
        return float(((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2) ** 0.5)

    def scale(self, a: int, b: int) -> float:
        """The edge length wanted here: of the finer part beside the edge."""
        return min(self.size[self.label[k]] for k in self.of[a] & self.of[b])

    def normal(self, a: Vec, b: Vec, c: Vec) -> tuple[float, float, float, float]:
        """Unit normal and twice the area."""
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        n = (x * x + y * y + z * z) ** 0.5
        return (x / n, y / n, z / n, n) if n > 0 else (0.0, 0.0, 0.0, 0.0)

    def face_normal(self, k: int) -> tuple[float, float, float, float]:
        a, b, c = self.f[k]  # type: ignore[misc]
        return self.normal(self.v[a], self.v[b], self.v[c])

    def is_feature(self, a: int, b: int) -> bool:
        pair = self.sides(a, b)
        if len(pair) != 2 or self.label[pair[0]] != self.label[pair[1]]:
            return True
        n, m = self.face_normal(pair[0]), self.face_normal(pair[1])
        return n[0] * m[0] + n[1] * m[1] + n[2] * m[2] < SHARP_COS

    def third(self, k: int, a: int, b: int) -> int:
        x, y, z = self.f[k]  # type: ignore[misc]
        return x if x not in (a, b) else y if y not in (a, b) else z

    def split(self, a: int, b: int, at: Vec) -> int:
        """Put a vertex on edge ab."""
        m = len(self.v)
        self.v.append(at)
        self.of.append(set())
        for k in self.sides(a, b):
            x, y, z = self.f[k]  # type: ignore[misc]
            new = len(self.f)
            self.f[k] = (m if x == b else x, m if y == b else y, m if z == b else z)
            self.f.append((m if x == a else x, m if y == a else y, m if z == a else z))
            self.label.append(self.label[k])
            c = self.third(k, a, m)
            self.of[b].discard(k)
            self.of[b].add(new)
            self.of[c].add(new)
            self.of[m] |= {k, new}
        return m

    def neighbours(self, a: int) -> set[int]:
        return {x for k in self.of[a] for x in self.f[k]} - {a}  # type: ignore[union-attr]

    def collapse(
        self, a: int, b: int, at: Vec, longest: float, least_turn: float, rounder: bool = True
    ) -> bool:
        """Move a and b to one point, unless that would fold, pinch or stretch the surface."""
        pair = self.of[a] & self.of[b]
        if len(pair) != 2:
            return False
        around_a, around_b = self.neighbours(a), self.neighbours(b)
        if len(around_a & around_b) != 2 or len(around_a | around_b) <= 5:
            return False
        for keep, faces in ((a, self.of[a] - pair), (b, self.of[b] - pair)):
            for k in faces:
                x, y, z = self.f[k]  # type: ignore[misc]
                px, py, pz = self.v[x], self.v[y], self.v[z]
                old = self.normal(px, py, pz)
                corners = (
                    at if x == keep else px,
                    at if y == keep else py,
                    at if z == keep else pz,
                )
                new = self.normal(*corners)
                turn = new[0] * old[0] + new[1] * old[1] + new[2] * old[2]
                if new[3] <= 0 or (old[3] > 1e-12 and turn < least_turn):
                    return False
                worst = max(
                    _gap(corners[0], corners[1]),
                    _gap(corners[1], corners[2]),
                    _gap(corners[2], corners[0]),
                )
                before = max(_gap(px, py), _gap(py, pz), _gap(pz, px))
                if worst > longest and worst > before:
                    return False
                flatter = new[3] / worst**2 < 0.12 and new[3] / worst**2 < old[3] / before**2
                if rounder and flatter:
                    return False
        for k in pair:
            for x in self.f[k]:  # type: ignore[union-attr]
                self.of[x].discard(k)
            self.f[k] = None
        self.v[a] = at
        for k in self.of[b]:
            x, y, z = self.f[k]  # type: ignore[misc]
            self.f[k] = (a if x == b else x, a if y == b else y, a if z == b else z)
            self.of[a].add(k)
        self.of[b] = set()
        return True

    def flip(self, a: int, b: int) -> bool:
        """Turn the edge inside its two triangles where that makes them rounder and does not bend the surface."""
        pair = self.sides(a, b)
        if len(pair) != 2 or self.label[pair[0]] != self.label[pair[1]]:
            return False
        k, m = pair
        x, y, z = self.f[k]  # type: ignore[misc]
        if (a, b) not in ((x, y), (y, z), (z, x)):
            k, m = m, k
        c, d = self.third(k, a, b), self.third(m, a, b)
        if d in self.neighbours(c):
            return False
        pa, pb, pc, pd = self.v[a], self.v[b], self.v[c], self.v[d]
        if _cot(pc, pa, pb) + _cot(pd, pa, pb) >= -1e-9:
            return False
        n, o = self.normal(pa, pb, pc), self.normal(pb, pa, pd)
        p, q = self.normal(pa, pd, pc), self.normal(pd, pb, pc)
        flat = n[0] * o[0] + n[1] * o[1] + n[2] * o[2]
        after = p[0] * q[0] + p[1] * q[1] + p[2] * q[2]
        if p[3] <= 0 or q[3] <= 0 or after < min(0.999, flat - 0.02):
            return False
        if n[3] > 1e-11 and o[3] > 1e-11:
            if flat < SHARP_COS:
                return False
            mean = [n[i] * n[3] + o[i] * o[3] for i in range(3)]
            if (
                sum(mean[i] * p[i] for i in range(3)) <= 0
                or sum(mean[i] * q[i] for i in range(3)) <= 0
            ):
                return False
        self.f[k], self.f[m] = (a, d, c), (d, b, c)
        self.of[a].discard(m)
        self.of[b].discard(k)
        self.of[c].add(m)
        self.of[d].add(k)
        return True


def _gap(p: Vec, q: Vec) -> float:
    return float(((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2) ** 0.5)


def _cot(apex: Vec, p: Vec, q: Vec) -> float:
    ux, uy, uz = p[0] - apex[0], p[1] - apex[1], p[2] - apex[2]
    vx, vy, vz = q[0] - apex[0], q[1] - apex[1], q[2] - apex[2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return float((ux * vx + uy * vy + uz * vz) / max((x * x + y * y + z * z) ** 0.5, 1e-18))


def heights(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """(F,) least heights of triangles: twice the area over the longest side."""
    corner = vertices.astype(np.float64)[faces]
    side = np.linalg.norm(corner - np.roll(corner, 1, 1), axis=2).max(1)
    double = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    return np.asarray(double / np.maximum(side, 1e-300))


def without_slivers(surface: Surface, least: float, short: float) -> int:
    """Removes triangles lower than ``least``: a needle's side shorter than ``short`` is collapsed, a cap's longest side is
    flipped into the triangle beyond it, whose label both halves take. Corners stay or move by less than ``short``.

    Returns:
        Number of triangles that stay, since neither is possible without a fold in the surface.
    """
    left = 0
    for _ in range(50):
        vertices, faces, _ = _live(surface)
        low = np.flatnonzero(heights(vertices, faces) < least)
        left = len(low)
        live = [k for k, face in enumerate(surface.f) if face is not None]
        changed = False
        for k in (live[i] for i in low):
            face = surface.f[k]
            if face is not None and _height(surface, face) < least:
                changed |= _remove_sliver(surface, k, short)
        if not changed:
            break
    return left


def _live(
    surface: Surface,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Vertices as they are numbered, and the faces that are left."""
    faces = [face for face in surface.f if face is not None]
    labels = [surface.label[k] for k, face in enumerate(surface.f) if face is not None]
    return np.array(surface.v), np.array(faces, np.int64), np.array(labels, np.int64)


def _height(surface: Surface, face: tuple[int, int, int]) -> float:
    return float(
        heights(np.array([surface.v[x] for x in face]), np.array([[0, 1, 2]], np.int64))[0]
    )


def _remove_sliver(surface: Surface, k: int, short: float) -> bool:
    a, b, c = surface.f[k]  # type: ignore[misc]
    edges = sorted(((a, b), (b, c), (c, a)), key=lambda e: surface.length(*e))
    if surface.length(*edges[0]) < short:
        # one way or the other; where neighbours are needles too, whatever their shape and normal become
        ways = (edges[0], edges[0][::-1])
        return any(surface.collapse(i, j, surface.v[i], np.inf, 0.7) for i, j in ways) or any(
            surface.collapse(i, j, surface.v[i], np.inf, -np.inf, rounder=False) for i, j in ways
        )
    p, q = edges[-1]
    pair = surface.sides(p, q)
    if len(pair) != 2:
        return False
    other = pair[0] if pair[1] == k else pair[1]
    apex, beyond = surface.third(k, p, q), surface.third(other, p, q)
    if beyond in surface.neighbours(apex):
        return False
    surface.f[k], surface.f[other] = (p, beyond, apex), (beyond, q, apex)
    surface.label[k] = surface.label[other]
    surface.of[p].discard(other)
    surface.of[q].discard(k)
    surface.of[apex].add(other)
    surface.of[beyond].add(k)
    return True


def imprint(surface: Surface, height: Callable[[Vec], float], snap: float) -> None:
    """Split edges so that no face crosses height = 0 (linear along edges); vertices nearer than ``snap`` count as on it."""

    def level(a: int) -> float:
        h = height(surface.v[a])
        return 0.0 if abs(h) < snap else h

    while True:
        crossed = [(a, b) for a, b in surface.edges() if level(a) * level(b) < 0]
        if not crossed:
            return
        for a, b in crossed:
            if not surface.sides(a, b):
                continue
            s = level(a) / (level(a) - level(b))
            p, q = surface.v[a], surface.v[b]
            surface.split(a, b, tuple(p[i] + s * (q[i] - p[i]) for i in range(3)))  # type: ignore[arg-type]


def remesh(surface: Surface, size: Sequence[float], rounds: int = 6) -> None:
    """Edges of about ``size[label]``."""
    surface.size = list(size)
    vertices, faces, _ = surface.arrays()
    target = trimesh.Trimesh(vertices, faces, process=False)
    for turn in range(rounds):
        for a, b in reversed(_by_length(surface, LONG, np.inf)):
            if surface.sides(a, b) and surface.length(a, b) > LONG * surface.scale(a, b):
                p, q = surface.v[a], surface.v[b]
                surface.split(a, b, ((p[0] + q[0]) / 2, (p[1] + q[1]) / 2, (p[2] + q[2]) / 2))
        _collapse_short(surface)
        for _ in range(3):
            if not sum(surface.flip(a, b) for a, b in surface.edges()):
                break
        if turn < rounds - 1:
            _relax(surface, target)


def _by_length(surface: Surface, low: float, high: float) -> list[tuple[int, int]]:
    """The edges of which length / wanted length is between the two, shortest first."""
    measured = [(surface.length(a, b) / surface.scale(a, b), a, b) for a, b in surface.edges()]
    return [(a, b) for x, a, b in sorted(measured) if low < x < high]


def _feature_degree(surface: Surface) -> tuple[list[list[int]], set[tuple[int, int]]]:
    """Per vertex the other ends of its feature edges; and those edges."""
    degree: list[list[int]] = [[] for _ in surface.v]
    features = set()
    for a, b in surface.edges():
        if surface.is_feature(a, b):
            degree[a].append(b)
            degree[b].append(a)
            features.add((a, b))
    return degree, features


def _corner(surface: Surface, a: int, ends: list[int]) -> bool:
    """Whether a vertex is the end, junction or bend (> 32 degrees) of feature lines."""
    if len(ends) != 2:
        return len(ends) > 0
    p, q, r = surface.v[ends[0]], surface.v[a], surface.v[ends[1]]
    u = [q[i] - p[i] for i in range(3)]
    w = [r[i] - q[i] for i in range(3)]
    size = max((sum(x * x for x in u) * sum(x * x for x in w)) ** 0.5, 1e-18)
    return sum(u[i] * w[i] for i in range(3)) / size < SHARP_COS


def _collapse_short(surface: Surface) -> None:
    for _ in range(4):
        degree, features = _feature_degree(surface)
        touched: set[int] = set()
        done = 0
        for a, b in _by_length(surface, 0.0, SHORT):
            if a in touched or b in touched or not surface.sides(a, b):
                continue
            line = (a, b) in features
            on_a, on_b = len(degree[a]) > 0, len(degree[b]) > 0
            fixed_a = _corner(surface, a, degree[a]) or (on_a and not line)
            fixed_b = _corner(surface, b, degree[b]) or (on_b and not line)
            p, q = surface.v[a], surface.v[b]
            if fixed_a and fixed_b:
                continue
            if fixed_a or (on_a and not on_b):
                at = p
            elif fixed_b or (on_b and not on_a):
                at = q
            else:
                at = ((p[0] + q[0]) / 2, (p[1] + q[1]) / 2, (p[2] + q[2]) / 2)
                if line:
                    at = p
            around = surface.neighbours(a) | surface.neighbours(b)
            longest = LONG * max(
                surface.size[surface.label[k]] for k in surface.of[a] | surface.of[b]
            )
            if surface.collapse(a, b, at, longest, 0.8 if line or on_a or on_b else 0.7):
                touched |= around
                done += 1
        if not done:
            return


def _relax(surface: Surface, target: trimesh.Trimesh) -> None:
    """Move free vertices to the middle of their neighbours, then back onto the surface."""
    degree, _ = _feature_degree(surface)
    free = [a for a, faces in enumerate(surface.of) if faces and not degree[a]]
    if not free:
        return
    moved = np.zeros((len(free), 3))
    for row, a in enumerate(free):
        ring = [surface.v[x] for x in sorted(surface.neighbours(a))]
        moved[row] = np.mean(ring, axis=0)
    old = np.array([surface.v[a] for a in free])
    _, closest = signed_distance(target, old + 0.7 * (moved - old))
    for row, a in enumerate(free):
        before = surface.v[a]
        normals = {k: surface.face_normal(k) for k in surface.of[a]}
        surface.v[a] = (float(closest[row, 0]), float(closest[row, 1]), float(closest[row, 2]))
        for k, n in normals.items():
            m = surface.face_normal(k)
            if m[3] <= 1e-12 or (n[3] > 1e-12 and n[0] * m[0] + n[1] * m[1] + n[2] * m[2] < 0.7):
                surface.v[a] = before
                break
