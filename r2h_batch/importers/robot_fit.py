"""Primitives (capsules, cylinders, boxes) that cover a mesh closely: distances, samples, overshoot, and the search.

Everything is float64 NumPy and deterministic.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
BOX, CYLINDER, CAPSULE, HULL = "box", "cylinder", "capsule", "hull"


@dataclass(frozen=True)
class Shape:
    """One primitive in the frame of its mesh; `R`'s columns are its axes, `size` as in MuJoCo."""

    kind: str
    pos: Array
    R: Array
    size: Array

    def signed_distance(self, points: Array) -> Array:
        """Distance of points (P, 3) from the shape's surface, negative inside; exact outside."""
        local = (points - self.pos) @ self.R
        if self.kind == BOX:
            over = np.abs(local) - self.size
        else:
            radial = np.hypot(local[:, 0], local[:, 1])
            if self.kind == CAPSULE:
                return (
                    np.hypot(radial, np.maximum(np.abs(local[:, 2]) - self.size[1], 0.0))
                    - self.size[0]
                )
            over = np.stack([radial - self.size[0], np.abs(local[:, 2]) - self.size[1]], axis=1)
        return np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0)

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (P, 3) spread over the surface and the area (P,) that each stands for."""
        if self.kind == BOX:
            local, area = _box_surface(self.size, spacing)
        else:
            local, area = _round_surface(
                self.kind, float(self.size[0]), float(self.size[1]), spacing
            )
        return local @ self.R.T + self.pos, area

    def triangles(self) -> Array:
        """Faces (F, 3, 3) of about the shape, none of them outside."""
        if self.kind == BOX:
            mesh = trimesh.creation.box(2 * self.size)
        else:
            radius, length = float(self.size[0]), 2 * float(self.size[1])
            if self.kind == CYLINDER:
                mesh = trimesh.creation.cylinder(radius, length, sections=48)
            else:
                mesh = trimesh.creation.capsule(length, radius, count=[48, 24])
                mesh.apply_translation(-mesh.bounds.mean(0))
        return np.asarray(mesh.triangles) @ self.R.T + self.pos

    def grown(self, amount: float) -> "Shape":
        """The shape with every size larger by `amount` (a capsule only in radius)."""
        size = self.size + (np.array([amount, 0.0]) if self.kind == CAPSULE else amount)
        return Shape(self.kind, self.pos, self.R, size)


def union_distance(shapes: list[Any], points: Array) -> Array:
    """Signed distance of points to the nearest shape: at most 0 where the union covers them."""
    return np.min([s.signed_distance(points) for s in shapes], axis=0)


def exposed_surface(shapes: list[Any], spacing: float) -> tuple[Array, Array]:
    """Points and areas of the union's outer surface: those of each shape that lie inside no other shape."""
    points, areas = [], []
    for i, shape in enumerate(shapes):
        p, a = shape.surface(spacing)
        outside = np.ones(len(p), bool)
        for j, other in enumerate(shapes):
            if j != i:  # of two coincident faces the first counts
                outside &= other.signed_distance(p) > (1e-7 if j < i else -1e-7)
        points.append(p[outside])
        areas.append(a[outside])
    return np.concatenate(points), np.concatenate(areas)


def lattice(triangles: Array, spacing: float) -> Array:
    """Points on triangles (F, 3, 3), corners and edges included, at most `spacing` apart along the edges."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(1, np.ceil(edges / spacing)).astype(int)
    points = []
    for n in np.unique(steps):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
        keep = i + j <= n
        weights = np.stack([i[keep], j[keep], n - i[keep] - j[keep]], axis=1) / n
        points.append(np.einsum("pk,fkd->fpd", weights, triangles[steps == n]).reshape(-1, 3))
    return np.concatenate(points)


def thinned(points: Array, cell: float) -> Array:
    """One of the points per cubic cell, in a fixed order."""
    cells = np.round(points / cell).astype(np.int64)
    cells -= cells.min(0)
    _, first = np.unique(np.ravel_multi_index(tuple(cells.T), cells.max(0) + 1), return_index=True)
    return points[np.sort(first)]


def disc(center: Array, normal: Array, radius: float, spacing: float) -> Array:
    """Points on a flat disc."""
    _, _, axes = np.linalg.svd(normal[None])
    grid = np.arange(-radius, radius + spacing, spacing)
    u, v = (g.ravel() for g in np.meshgrid(grid, grid))
    keep = np.hypot(u, v) <= radius
    return center + np.outer(u[keep], axes[1]) + np.outer(v[keep], axes[2])


PROTRUSION_SPACING_M = 0.4e-3
ARM_STEP_M = 1.5e-3
"""First step of the search in lengths of the arm's primitives."""


class Target:
    """A mesh to be covered: `dense` are its face samples, `surface` (with mouths) is what overshoot is measured to."""

    def __init__(self, triangles: Array, mouths: list[Array], area: float) -> None:
        self.triangles = triangles
        self.dense = thinned(lattice(triangles, 1.0e-3), 0.5e-3)
        self.surface = np.concatenate([self.dense, *mouths])
        self.tree = cKDTree(self.surface)
        self.bare = cKDTree(self.dense) if mouths else self.tree
        self.mouth_first = len(self.dense)
        self.area = area
        self.spacing = float(np.clip(np.sqrt(area / 2000.0), 1.0e-3, 8.0e-3))
        self.coarse = thinned(self.dense, self.spacing)
        self._low = self.dense.min(axis=0) - 0.03
        self._cell = float(np.clip(self.spacing / 2.0, 1.0e-3, 3.0e-3))
        shape = np.ceil((self.dense.max(axis=0) + 0.03 - self._low) / self._cell).astype(int) + 1
        axes = [self._low[k] + self._cell * np.arange(shape[k]) for k in range(3)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        near = cKDTree(thinned(self.surface, 0.7 * self._cell))
        self._grid = near.query(grid.reshape(-1, 3))[0].reshape(shape)

    def quick_overshoot(self, points: Array) -> Array:
        """Interpolated distance to the surface; beyond the grid its edge value."""
        return map_coordinates(
            self._grid, ((points - self._low) / self._cell).T, order=1, mode="nearest"
        )

    def protrusion(self, shapes: list[Any]) -> float:
        """How far the mesh sticks out of the shapes (m): of all its corners and a finer lattice than the fit has seen."""
        parts = np.array_split(self.triangles, max(1, len(self.triangles) // 2000))
        # hulls hold what their planes cut the triangles into
        spacing = 2e-3 if all(s.kind == HULL for s in shapes) else PROTRUSION_SPACING_M
        return max(float(union_distance(shapes, lattice(p, spacing)).max()) for p in parts)

    def mean_overshoot_mm(self, shapes: list[Any]) -> float:
        """The mean, on samples 3 mm apart."""
        points, areas = exposed_surface(shapes, 3.0e-3)
        return 1e3 * float((self.tree.query(points)[0] * areas).sum() / areas.sum())

    def report(self, shapes: list[Any]) -> dict[str, Any]:
        """The committed figures, on dense samples."""
        points, areas = exposed_surface(shapes, 1.0e-3)
        overshoot, nearest = self.tree.query(points)
        order = np.argsort(overshoot)
        share = np.cumsum(areas[order]) / areas.sum()
        return {
            "primitives": len(shapes),
            "mean_mm": 1e3 * float((overshoot * areas).sum() / areas.sum()),
            "p95_mm": 1e3 * float(overshoot[order][np.searchsorted(share, 0.95)]),
            "max_mm": 1e3 * float(overshoot.max()),
            "mean_without_mouths_mm": 1e3
            * float((self.bare.query(points)[0] * areas).sum() / areas.sum()),
            "worst_protrusion_mm": 1e3 * self.protrusion(shapes),
            "surface_m2": float(areas.sum()),
            "mouth_share": float(areas[nearest >= self.mouth_first].sum() / areas.sum()),
            "face_samples": len(self.dense),
        }


def cost(target: Target, shapes: list[Shape], extra: Array) -> float:
    """What the search minimises: mean overshoot in mm, its square, and a steep price for samples left outside."""
    if min(float(s.size.min()) for s in shapes) < 5e-4:
        return 1e6
    points, areas = exposed_surface(shapes, target.spacing)
    if len(points) == 0:
        return 1e6
    overshoot = 1e3 * target.quick_overshoot(points)
    outside = 1e3 * np.maximum(union_distance(shapes, extra), 0.0)
    return float(
        ((overshoot + overshoot**2 / 20.0) * areas).sum() / target.area
        + 30.0 * outside.mean()
        + 3.0 * outside.max()
    )


def cmaes(function: Any, start: Array, sigma: Array, rounds: int, seed: int) -> tuple[Array, float]:
    """Best point and value of a covariance matrix adaptation (Hansen's defaults); first steps have size `sigma`."""
    rng = np.random.default_rng(seed)
    n = len(start)
    lam = 4 + int(3 * np.log(n)) + 4
    mu = lam // 2
    w = np.log(mu + 0.5) - np.log(np.arange(1, mu + 1))
    w /= w.sum()
    mueff = 1.0 / (w**2).sum()
    cc, cs = (4 + mueff / n) / (n + 4 + 2 * mueff / n), (mueff + 2) / (n + mueff + 5)
    c1 = 2 / ((n + 1.3) ** 2 + mueff)
    cmu = min(1 - c1, 2 * (mueff - 2 + 1 / mueff) / ((n + 2) ** 2 + mueff))
    damps = 1 + 2 * max(0.0, np.sqrt((mueff - 1) / (n + 1)) - 1) + cs
    chi = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))
    mean, step, C, pc, ps = np.zeros(n), 1.0, np.eye(n), np.zeros(n), np.zeros(n)
    best, best_value = start, float(function(start))
    for _ in range(rounds):
        values, vectors = np.linalg.eigh(C)
        scale = np.sqrt(np.maximum(values, 1e-12))
        y = (rng.standard_normal((lam, n)) * scale) @ vectors.T
        x = mean + step * y
        f = np.array([function(start + sigma * row) for row in x])
        order = np.argsort(f, kind="stable")
        if f[order[0]] < best_value:
            best, best_value = start + sigma * x[order[0]], float(f[order[0]])
        chosen = y[order[:mu]]
        y_mean = w @ chosen
        mean = mean + step * y_mean
        ps = (1 - cs) * ps + np.sqrt(cs * (2 - cs) * mueff) * (
            vectors @ ((vectors.T @ y_mean) / scale)
        )
        step *= float(np.exp((cs / damps) * (np.linalg.norm(ps) / chi - 1)))
        pc = (1 - cc) * pc + np.sqrt(cc * (2 - cc) * mueff) * y_mean
        C = (1 - c1 - cmu) * C + c1 * np.outer(pc, pc) + cmu * (chosen.T * w) @ chosen
        if step * scale.max() < 2e-3:
            break
    return np.asarray(best), best_value


def covered(target: Target, shapes: list[Shape], margin: float) -> list[Shape]:
    """The shapes, grown as little as needed until every dense face sample is inside by `margin`."""
    for _ in range(200):
        distance = np.array([s.signed_distance(target.dense) for s in shapes])
        worst = int(distance.min(axis=0).argmax())
        need = float(distance[:, worst].min())
        if need <= -margin:
            return shapes
        nearest = int(distance[:, worst].argmin())
        shapes = [
            s.grown(need + margin + 1e-6) if i == nearest else s for i, s in enumerate(shapes)
        ]
    raise RuntimeError("growing the primitives did not cover the mesh")


# Sleeves of the visual meshes that the next link closes: centre, normal, radius in the link frame.
MOUTHS: dict[str, list[tuple[tuple[float, float, float], tuple[float, float, float], float]]] = {
    "upper_arm": [((-0.425, 0.0, 0.0602), (0.0, 0.0, 1.0), 0.058)],
    "forearm": [
        ((0.0, 0.0, 0.0604), (0.0, 0.0, 1.0), 0.058),
        ((-0.3922, 0.0, 0.0604), (0.0, 0.0, 1.0), 0.0375),
    ],
    "wrist_1": [
        ((0.0, 0.0, -0.0736), (0.0, 0.0, 1.0), 0.0375),
        ((0.0, -0.0536, 0.0), (0.0, 1.0, 0.0), 0.0375),
    ],
    "wrist_2": [
        ((0.0, 0.0, -0.0461), (0.0, 0.0, 1.0), 0.0375),
        ((0.0, 0.0531, 0.0), (0.0, 1.0, 0.0), 0.0375),
    ],
    "wrist_3": [((0.0, 0.0, -0.0458), (0.0, 0.0, 1.0), 0.0375)],
}

# Where the search starts, per link: the normal of the link's mirror plane, in which all axes stay, and one row a
# primitive: kind, (u, v) of its centre in the plane (the two other axes in order), angle of its own z axis from u to v
# in rad, size (round: radius, half length; box: half sides along normal, across, along z); a fifth entry makes it a
# mirrored pair at +- that distance from the plane.
UP = np.pi / 2
Row = tuple[Any, ...]
Recipe = tuple[str, list[Row]]
RECIPES: dict[str, Recipe] = {
    "base": ("x", [
        (CYLINDER, (0.0, 0.0190), UP, (0.0755, 0.0191)),
        (CYLINDER, (0.0, 0.0341), UP, (0.0698, 0.0340)),
        (CYLINDER, (0.0, 0.0598), UP, (0.0603, 0.0394)),
    ]),
    "shoulder": ("x", [
        (CYLINDER, (-0.0002, -0.0016), UP, (0.0603, 0.0626)),
        (CYLINDER, (-0.0314, -0.0001), 0.0, (0.0590, 0.0432)),
        (CYLINDER, (-0.0134, 0.0170), 1.44, (0.0543, 0.0490)),
    ]),
    "upper_arm": ("y", [
        (CYLINDER, (-0.0004, 0.1407), UP - 0.025, (0.0608, 0.0679)),
        (CYLINDER, (-0.4236, 0.1342), UP + 0.016, (0.0606, 0.0750)),
        (CYLINDER, (-0.2092, 0.1379), 0.0, (0.0431, 0.2088)),
        (CAPSULE, (-0.0282, 0.1421), 0.20, (0.0636, 0.0221)),
        (CAPSULE, (-0.3979, 0.1323), 0.17, (0.0607, 0.0323)),
    ]),
    "forearm": ("y", [
        (CYLINDER, (-0.0011, 0.0389), UP - 0.010, (0.0597, 0.0223)),
        (CYLINDER, (-0.3919, 0.0057), UP + 0.006, (0.0394, 0.0554)),
        (CYLINDER, (-0.1950, 0.0064), 0.0, (0.0380, 0.2030)),
        (CAPSULE, (-0.0321, 0.0149), 0.27, (0.0528, 0.0280)),
    ]),
    "wrist_1": ("x", [
        (CYLINDER, (0.0011, -0.0007), 0.0, (0.0395, 0.0553)),
        (CYLINDER, (0.0002, -0.0322), UP, (0.0378, 0.0419)),
    ]),
    "wrist_2": ("x", [
        (CYLINDER, (-0.0015, -0.0003), 0.0, (0.0394, 0.0553)),
        (CYLINDER, (-0.0005, -0.0196), UP, (0.0379, 0.0266)),
    ]),
    "wrist_3": ("x", [
        (CYLINDER, (0.0006, -0.0229), UP, (0.0377, 0.0229)),
        (CAPSULE, (-0.0371, -0.0315), 0.0, (0.0060, 0.0046)),
    ]),
    "body": ("x", [  # the coupling is part of it
        (CYLINDER, (0.0, 0.0120), UP, (0.0396, 0.0231)),
        (CAPSULE, (0.0, 0.0375), 0.0, (0.0360, 0.0064)),
        (CAPSULE, (0.0, 0.0526), 0.0, (0.0212, 0.0236)),
        (CAPSULE, (0.0, 0.0718), 0.0, (0.0217, 0.0146)),
    ]),
    "outer_knuckle": ("x", [
        (BOX, (0.0157, 0.0011), 0.014, (0.0055, 0.0114, 0.0232)),
        (BOX, (0.0246, 0.0084), 0.036, (0.0120, 0.0044, 0.0024)),
    ]),
    "outer_finger": ("x", [(BOX, (0.0031, 0.0236), UP - 0.129, (0.0135, 0.0060, 0.0298))]),
    "inner_finger": ("x", [
        (BOX, (-0.0097, 0.0041), -0.361, (0.0075, 0.0066, 0.0166)),
        (BOX, (-0.0151, 0.0251), UP + 0.034, (0.0072, 0.0042, 0.0198)),
    ]),
    "inner_knuckle": ("x", [
        (BOX, (0.0109, 0.0128), 0.864, (0.0041, 0.0061, 0.0229), 0.0155),
        (BOX, (0.0300, 0.0351), 0.864, (0.0136, 0.0061, 0.0170)),
    ]),
}  # fmt: skip


def start(rows: list[Row], length: float) -> tuple[Array, Array]:
    """A recipe's numbers as one vector, and the first step of the search in each (`length`, m, and
    0.05 rad)."""
    numbers, steps = [], []
    for _, (u, v), angle, *rest in rows:
        sizes = [*rest[0], *rest[1:]]
        numbers += [u, v, angle, *sizes]
        steps += [length, length, 0.05, *[length] * len(sizes)]
    return np.array(numbers), np.array(steps)


def shapes_of(recipe: Recipe, numbers: Array) -> list[Shape]:
    """The primitives that a vector stands for."""
    normal, rows = recipe
    n = "xyz".index(normal)
    across, u_axis, v_axis = np.eye(3)[n], *np.delete(np.eye(3), n, axis=0)
    shapes, at = [], 0
    for kind, _, _, size, *pair in rows:
        u, v, angle = numbers[at : at + 3]
        sizes = np.abs(numbers[at + 3 : at + 3 + len(size)])
        along = np.cos(angle) * u_axis + np.sin(angle) * v_axis
        R = np.stack([across, np.cross(along, across), along], axis=1)
        at += 3 + len(size) + len(pair)
        for offset in (-numbers[at - 1], numbers[at - 1]) if pair else (0.0,):
            shapes.append(Shape(kind, u * u_axis + v * v_axis + offset * across, R, sizes))
    return shapes


def fit(recipe: Recipe, mesh: Target, length: float) -> list[Shape]:
    """The primitives of one link: least overshoot from the recipe on, then grown until every face sample is inside."""
    numbers, steps = start(recipe[1], length)
    samples = mesh.coarse
    for seed, (scale, rounds) in enumerate([(1.0, 150), (0.3, 60), (0.1, 60)]):

        def price(x: Array, seen: Array = samples) -> float:
            return cost(mesh, shapes_of(recipe, x), seen)

        numbers, _ = cmaes(price, numbers, scale * steps, rounds, seed)
        missed = mesh.dense[union_distance(shapes_of(recipe, numbers), mesh.dense) > 1e-4]
        samples = np.concatenate([samples, thinned(missed, 1.5e-3)])
    # Written numbers are rounded, so it is the rounded shapes that are grown (and then rounded up).
    return [
        rounded(s)
        for s in covered(mesh, [rounded(s) for s in shapes_of(recipe, numbers)], margin=2e-6)
    ]


def rounded(shape: Shape) -> Shape:
    """The shape that robot.json's digits stand for: micrometres, sizes rounded up."""
    return read(write(shape))


def write(shape: Shape) -> dict[str, Any]:
    quat_wxyz = Rotation.from_matrix(shape.R).as_quat(canonical=True, scalar_first=True)
    return {
        "kind": shape.kind,
        "pos": (np.round(shape.pos, 6) + 0.0).tolist(),
        "quat_wxyz": (np.round(quat_wxyz, 9) + 0.0).tolist(),
        "size": (np.ceil(shape.size * 1e6 - 1e-3) / 1e6).tolist(),
    }


def read(row: dict[str, Any]) -> Shape:
    R = Rotation.from_quat(row["quat_wxyz"], scalar_first=True).as_matrix()
    return Shape(row["kind"], np.array(row["pos"]), R, np.array(row["size"]))


def mouths_for(name: str, box: Array, other: Array) -> list[Array]:
    """Discs in the sleeves of a link that the next link closes, stretched to the box of another mesh."""
    scale, found = (other[1] - other[0]) / (box[1] - box[0]), []
    for center, normal, radius in MOUTHS.get(name, []):
        at = other[0] + (np.array(center) - box[0]) * scale
        across = float(scale[np.array(normal) == 0].mean())
        found.append(disc(at, np.array(normal), radius * across, 4.0e-4))
    return found


def box_of(triangles: Array) -> Array:
    """Low and high corner (2, 3) of triangles (F, 3, 3)."""
    corners = triangles.reshape(-1, 3)
    return np.stack([corners.min(0), corners.max(0)])


def target(triangles: Array, mouths: list[Array]) -> Target:
    """The mesh of a link or gripper part, ready to be covered."""
    return Target(triangles, mouths, float(trimesh.triangles.area(triangles).sum()))


def _spaced(half: float, spacing: float) -> tuple[Array, float]:
    """Midpoints of equal intervals over [-half, half], and the interval."""
    n = max(2, int(np.ceil(2 * half / spacing)))
    return np.asarray((np.arange(n) + 0.5) * (2 * half / n) - half, dtype=np.float64), 2 * half / n


def _box_surface(size: Array, spacing: float) -> tuple[Array, Array]:
    points, areas = [], []
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        (u, du), (v, dv) = _spaced(size[i], spacing), _spaced(size[j], spacing)
        grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        for sign in (-1.0, 1.0):
            face = np.empty((len(grid), 3))
            face[:, k], face[:, i], face[:, j] = sign * size[k], grid[:, 0], grid[:, 1]
            points.append(face)
            areas.append(np.full(len(grid), du * dv))
    return np.concatenate(points), np.concatenate(areas)


def _round_surface(kind: str, radius: float, half: float, spacing: float) -> tuple[Array, Array]:
    n = max(12, int(np.ceil(2 * np.pi * radius / spacing)))
    turn = 2 * np.pi * (np.arange(n) + 0.5) / n
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    z, dz = _spaced(half, spacing)
    profile = [(radius, height, 2 * np.pi * radius * dz / n) for height in z]
    m = max(3, int(np.ceil(radius / spacing)))
    for sign in (-1.0, 1.0):
        if kind == CYLINDER:
            r = radius * (np.arange(m) + 0.5) / m
            profile += [(ri, sign * half, 2 * np.pi * ri * (radius / m) / n) for ri in r]
        else:  # bands of equal height on a sphere have equal areas
            h = radius * (np.arange(m) + 0.5) / m
            profile += [
                (
                    np.sqrt(radius**2 - hi**2),
                    sign * (half + hi),
                    2 * np.pi * radius * (radius / m) / n,
                )
                for hi in h
            ]
    points = np.concatenate(
        [np.column_stack([r * ring, np.full(n, height)]) for r, height, _ in profile]
    )
    return points, np.repeat([a for _, _, a in profile], n)
