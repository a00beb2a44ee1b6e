"""Implicit surface -> even triangle mesh: marching tetrahedra, then split / collapse / flip / relax with projection.

Pure numpy and deterministic, so that the hand can be rebuilt bit for bit without a meshing dependency.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Field = Callable[[np.ndarray], np.ndarray]

# Kuhn's six tetrahedra of a cube; corner bits are x=1, y=2, z=4. Neighbouring cubes share their face diagonals.
_TETS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])


def marching_tetrahedra(
    field: Field, lower: np.ndarray, upper: np.ndarray, pitch: float
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V,3) and outward faces (F,3) of field = 0 (negative inside), a closed manifold inside the box."""
    shape = np.ceil((upper - lower) / pitch).astype(int) + 1
    index = np.indices(shape).reshape(3, -1).T
    points = lower + pitch * index
    values = np.concatenate([field(chunk) for chunk in np.array_split(points, max(1, len(points) // 200_000))])
    values = np.where(np.abs(values) < 1e-6 * pitch, 1e-6 * pitch, values)
    stride = np.array([shape[1] * shape[2], shape[2], 1])
    corner = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)]) @ stride
    cubes = np.flatnonzero(np.all(index < shape - 1, axis=1))
    tets = (cubes[:, None] + corner)[:, _TETS].reshape(-1, 4)
    inside = values[tets] < 0
    count = inside.sum(axis=1)
    tets, inside, count = (a[(count > 0) & (count < 4)] for a in (tets, inside, count))
    order = np.argsort(~inside, axis=1, kind="stable")  # the inside corners first
    tets = np.take_along_axis(tets, order, axis=1)
    a, b, c, d = tets.T
    one, two, three = count == 1, count == 2, count == 3
    edges = np.concatenate(
        [
            np.stack([a, b, a, c, a, d], 1)[one],
            np.stack([a, d, b, d, c, d], 1)[three],
            np.stack([a, c, a, d, b, d], 1)[two],
            np.stack([a, c, b, d, b, c], 1)[two],
        ]
    ).reshape(-1, 3, 2)
    into, out = np.concatenate([a[one], a[three], a[two], a[two]]), np.concatenate([d[one], d[three], d[two], d[two]])
    keys, faces = np.unique(np.sort(edges, axis=2).reshape(-1, 2), axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3)
    t = values[keys[:, 0]] / (values[keys[:, 0]] - values[keys[:, 1]])
    vertices = points[keys[:, 0]] + t[:, None] * (points[keys[:, 1]] - points[keys[:, 0]])
    p = vertices[faces]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    # The plane of each triangle separates an inside corner from an outside corner: that fixes the orientation.
    flip = np.einsum("ij,ij->i", normal, points[out] - points[into]) < 0
    faces[flip] = faces[flip][:, ::-1]
    return vertices, faces


def project(field: Field, points: np.ndarray, *, steps: int = 4, eps: float = 0.05) -> np.ndarray:
    """Points moved onto field = 0 along its gradient (Newton, step limited)."""
    for _ in range(steps):
        gradient = np.stack(
            [(field(points + eps * e) - field(points - eps * e)) / (2 * eps) for e in np.eye(3)], axis=1
        )
        norm2 = np.maximum(np.sum(gradient**2, axis=1), 0.05)
        step = np.clip(field(points) / norm2, -1.5, 1.5)
        points = points - step[:, None] * gradient
    return points


class _Mesh:
    """A triangle mesh under edit: a list of points, faces by id, and the ids of the faces around every vertex."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.p = [np.array(v) for v in vertices]
        self.f = {i: tuple(int(v) for v in face) for i, face in enumerate(faces)}
        self.around: list[set[int]] = [set() for _ in self.p]
        for i, face in self.f.items():
            for v in face:
                self.around[v].add(i)
        self.next = len(self.f)

    def edges(self) -> list[tuple[int, int]]:
        return sorted(
            {(min(a, b), max(a, b)) for f in self.f.values() for a, b in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}
        )

    def ring(self, v: int) -> set[int]:
        return {w for i in self.around[v] for w in self.f[i]} - {v}

    def sides(self, a: int, b: int) -> list[int]:
        return sorted(self.around[a] & self.around[b])

    def remove(self, i: int) -> None:
        for v in self.f.pop(i):
            self.around[v].discard(i)

    def add(self, face: tuple[int, int, int]) -> None:
        self.f[self.next] = face
        for v in face:
            self.around[v].add(self.next)
        self.next += 1

    def normal(self, face: tuple[int, ...], moved: dict[int, np.ndarray] | None = None) -> np.ndarray:
        p, q, r = ((moved or {}).get(v, self.p[v]) for v in face)
        u, w = q - p, r - p
        return np.array([u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]])

    def length(self, a: int, b: int) -> float:
        d = self.p[a] - self.p[b]
        return float(np.sqrt(d @ d))

    def split(self, a: int, b: int) -> None:
        m = len(self.p)
        self.p.append(0.5 * (self.p[a] + self.p[b]))
        self.around.append(set())
        for i in self.sides(a, b):
            face = self.f[i]
            self.remove(i)
            self.add(tuple(m if v == b else v for v in face))  # type: ignore[arg-type]
            self.add(tuple(m if v == a else v for v in face))  # type: ignore[arg-type]

    def collapse(self, a: int, b: int, longest: float) -> bool:
        """b merged into a at the midpoint, unless topology, a triangle's direction or an edge length forbids it."""
        shared = self.ring(a) & self.ring(b)
        if len(shared) != 2 or any(len(self.around[v]) <= 3 for v in shared):
            return False
        middle = 0.5 * (self.p[a] + self.p[b])
        if any(np.sum((self.p[v] - middle) ** 2) > longest**2 for v in (self.ring(a) | self.ring(b)) - {a, b}):
            return False
        dead = set(self.sides(a, b))
        for i in (self.around[a] | self.around[b]) - dead:
            old, new = self.normal(self.f[i]), self.normal(self.f[i], {a: middle, b: middle})
            if old @ new < 0.3 * np.sqrt((old @ old) * (new @ new)):
                return False
        for i in dead:
            self.remove(i)
        for i in sorted(self.around[b]):
            face = self.f[i]
            self.remove(i)
            self.add(tuple(a if v == b else v for v in face))  # type: ignore[arg-type]
        self.p[a] = middle
        return True

    def flip(self, a: int, b: int) -> None:
        """Edge a-b replaced by the other diagonal when that brings the vertices nearer to six neighbours."""
        pair = self.sides(a, b)
        if len(pair) != 2:
            return
        c, d = (next(v for v in self.f[i] if v not in (a, b)) for i in pair)
        if d in self.ring(c):
            return
        before = sum(abs(len(self.around[v]) - 6) for v in (a, b, c, d))
        after = sum(abs(len(self.around[v]) + s - 6) for v, s in ((a, -1), (b, -1), (c, 1), (d, 1)))
        face = self.f[pair[0]]
        forward = face[(face.index(a) + 1) % 3] == b  # a -> b in the face that holds c
        new = ((a, d, c), (d, b, c)) if forward else ((a, c, d), (c, b, d))
        n_old = [self.normal(self.f[i]) for i in pair]
        n_new = [self.normal(f) for f in new]
        mean = n_old[0] + n_old[1]
        good = all(n @ mean > 0.7 * np.sqrt((n @ n) * (mean @ mean)) for n in n_new)
        if after < before and good:
            for i in pair:
                self.remove(i)
            for f in new:
                self.add(f)

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        faces = np.array([self.f[i] for i in sorted(self.f)])
        used, inverse = np.unique(faces, return_inverse=True)
        return np.array(self.p)[used], inverse.reshape(-1, 3)


def remesh(
    field: Field, size: Field, vertices: np.ndarray, faces: np.ndarray, rounds: int
) -> tuple[np.ndarray, np.ndarray]:
    """The same surface with edges near size(x) long and vertices of about six neighbours."""
    for turn in range(rounds):
        mesh = _Mesh(vertices, faces)
        target = list(size(vertices))
        for a, b in mesh.edges():
            if mesh.length(a, b) > 4 / 3 * 0.5 * (target[a] + target[b]):
                mesh.split(a, b)
                target.append(0.5 * (target[a] + target[b]))
        for a, b in mesh.edges():
            if mesh.around[a] and mesh.around[b] and b in mesh.ring(a):
                want = 0.5 * (target[a] + target[b])
                if mesh.length(a, b) < 0.8 * want:
                    mesh.collapse(a, b, 4 / 3 * want)
        for a, b in mesh.edges():
            mesh.flip(a, b)
        vertices, faces = mesh.arrays()
        for _ in range(2 if turn else 0):
            vertices = project(field, _relax(vertices, faces), steps=2)
    return project(field, vertices, steps=6), faces


def _relax(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Every vertex moved in its tangent plane halfway to the area-weighted centre of the triangles around it."""
    p = vertices[faces]
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    area = np.linalg.norm(cross, axis=1)
    normal, total, centre = np.zeros_like(vertices), np.zeros(len(vertices)), np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normal, faces[:, k], cross)
        np.add.at(total, faces[:, k], area)
        np.add.at(centre, faces[:, k], area[:, None] * p.mean(axis=1))
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
    move = centre / np.maximum(total, 1e-12)[:, None] - vertices
    return vertices + 0.6 * (move - np.sum(move * normal, axis=1)[:, None] * normal)
