"""The search for primitives that cover the meshes of the UR5e and the 2F-85 closely: starts by hand, then CMA-ES.

Everything is float64 NumPy and deterministic.
"""

from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from r2h_batch.data.robot_shapes import (
    BOX,
    CAPSULE,
    CYLINDER,
    Array,
    Shape,
    Target,
    exposed_surface,
    thinned,
    union_distance,
)  # fmt: skip

ARM_STEP_M = 1.5e-3
"""First step of the search in lengths of the arm's primitives."""


class SearchTarget(Target):
    """A mesh to be covered, with a grid of distances that the search interpolates."""

    def __init__(self, triangles: Array, mouths: list[Array]) -> None:
        super().__init__(triangles, mouths)
        self.area = float(trimesh.triangles.area(triangles).sum())
        self.spacing = float(np.clip(np.sqrt(self.area / 2000.0), 1.0e-3, 8.0e-3))
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
        return map_coordinates(self._grid, ((points - self._low) / self._cell).T, order=1, mode="nearest")


def cost(target: SearchTarget, shapes: list[Shape], extra: Array) -> float:
    """Cost of the search: mean overshoot in mm, its square, and a steep price for samples left outside."""
    if min(float(s.size.min()) for s in shapes) < 5e-4:
        return 1e6
    points, areas = exposed_surface(shapes, target.spacing)
    if len(points) == 0:
        return 1e6
    overshoot = 1e3 * target.quick_overshoot(points)
    outside = 1e3 * np.maximum(union_distance(shapes, extra), 0.0)
    return float(
        ((overshoot + overshoot**2 / 20.0) * areas).sum() / target.area + 30.0 * outside.mean() + 3.0 * outside.max()
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
        ps = (1 - cs) * ps + np.sqrt(cs * (2 - cs) * mueff) * (vectors @ ((vectors.T @ y_mean) / scale))
        step *= float(np.exp((cs / damps) * (np.linalg.norm(ps) / chi - 1)))
        pc = (1 - cc) * pc + np.sqrt(cc * (2 - cc) * mueff) * y_mean
        C = (1 - c1 - cmu) * C + c1 * np.outer(pc, pc) + cmu * (chosen.T * w) @ chosen
        if step * scale.max() < 2e-3:
            break
    return np.asarray(best), best_value


def covered(target: SearchTarget, shapes: list[Shape], margin: float) -> list[Shape]:
    """The shapes, grown as little as needed until every dense face sample is inside by `margin`."""
    for _ in range(200):
        distance = np.array([s.signed_distance(target.dense) for s in shapes])
        worst = int(distance.min(axis=0).argmax())
        need = float(distance[:, worst].min())
        if need <= -margin:
            return shapes
        nearest = int(distance[:, worst].argmin())
        shapes = [s.grown(need + margin + 1e-6) if i == nearest else s for i, s in enumerate(shapes)]
    raise RuntimeError("growing the primitives did not cover the mesh")


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


def fit(recipe: Recipe, mesh: SearchTarget, length: float) -> list[Shape]:
    """The primitives of one link: least overshoot from the recipe on, then grown until every face sample is inside."""
    numbers, steps = start(recipe[1], length)
    samples = mesh.coarse
    for seed, (scale, rounds) in enumerate([(1.0, 150), (0.3, 60), (0.1, 60)]):

        def price(x: Array, seen: Array = samples) -> float:
            return cost(mesh, shapes_of(recipe, x), seen)

        numbers, _ = cmaes(price, numbers, scale * steps, rounds, seed)
        missed = mesh.dense[union_distance(shapes_of(recipe, numbers), mesh.dense) > 1e-4]
        if len(missed):
            samples = np.concatenate([samples, thinned(missed, 1.5e-3)])
    # Written numbers are rounded, so it is the rounded shapes that are grown (and then rounded up).
    return [rounded(s) for s in covered(mesh, [rounded(s) for s in shapes_of(recipe, numbers)], margin=2e-6)]


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
