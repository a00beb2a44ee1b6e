"""The nearest point of a surface: float64 over all triangles and their edges, and Warp's own tree to the last bit."""

import numpy as np
import pytest
import torch
import trimesh
import warp as wp

from r2h_batch import load_benchmark
from r2h_batch.base.launch import launch
from r2h_batch.judge.reach import reached
from r2h_batch.kernels.geometry.mesh_distance import nearest_face
from r2h_batch.scene.grasp_tables import surface_tables
from r2h_batch.scene.scene import Scene

COUNT = 100


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(load_benchmark("r2h-v1"))


def points_about(solid: trimesh.Trimesh, rng: np.random.Generator) -> np.ndarray:
    """Points around a solid, a micrometre to a centimetre off it, on it, and at its corners, where triangles are as near."""
    low, high = solid.bounds
    about = rng.uniform(low - 0.1, high + 0.1, (COUNT, 3))
    on, _ = trimesh.sample.sample_surface(solid, COUNT, seed=1)
    off = on + rng.normal(size=on.shape) * 10.0 ** rng.uniform(-6, -2, (COUNT, 1))
    corners = solid.vertices[rng.integers(0, len(solid.vertices), COUNT)]
    off_corner = corners + solid.vertex_normals[rng.integers(0, len(corners), COUNT)] * 0.01
    return np.concatenate([about, on, off, corners, off_corner]).astype(np.float32)


def signed_distances(x: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distances of x (N, 3) from the solid that triangles (T, 3, 3) bound, 0 inside, by another way: planes, else edges."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    found = np.empty(len(x))
    for i, p in enumerate(x):
        sides, above = [], np.ones(len(a), bool)
        for start, end in ((a, b), (b, c), (c, a)):
            along = end - start
            share = np.clip(((p - start) * along).sum(1) / np.maximum((along**2).sum(1), 1e-300), 0.0, 1.0)
            sides.append(np.linalg.norm(start + share[:, None] * along - p, axis=1))
            above &= (np.cross(along, p - start) * normal).sum(1) >= 0.0
        plane = np.where(above, np.abs(((p - a) * normal).sum(1)), np.inf)
        la, lb, lc = (np.linalg.norm(t - p, axis=1) for t in (a, b, c))
        top = np.linalg.det(np.stack([a - p, b - p, c - p], 1))
        low = (
            la * lb * lc
            + ((a - p) * (b - p)).sum(1) * lc
            + ((b - p) * (c - p)).sum(1) * la
            + ((c - p) * (a - p)).sum(1) * lb
        )
        winding = np.arctan2(top, low).sum() / (2 * np.pi)
        found[i] = 0.0 if abs(winding) > 0.5 else min(plane.min(), *(s.min() for s in sides))
    return found


@pytest.mark.parametrize("index", [0, 5, 9, 15])
def test_reach_measures_the_solid(scene: Scene, index: int) -> None:
    model = scene.objects[index]
    solid = trimesh.Trimesh(model.vertices, model.faces, process=False)
    x = points_about(solid, np.random.default_rng(index))
    found = reached(scene, torch.full((len(x),), index, dtype=torch.int32), torch.from_numpy(x)).distance_m.numpy()

    expected = signed_distances(x.astype(np.float64), model.vertices[model.faces].astype(np.float64))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)

    warp, face = torch.zeros(len(x)), torch.zeros(len(x), dtype=torch.int32)
    mesh = int(scene.object_mesh_ids.numpy()[index])
    launch(
        nearest_face, len(x), inputs={"mesh": mesh, "cutoff": 1.0, "points": torch.from_numpy(x)},
        outputs={"distance": warp, "face": face}, device="cpu",
    )  # fmt: skip
    outside = found > 0.0
    assert outside.mean() > 0.4
    assert np.array_equal(found[outside], warp.numpy()[outside])


def test_what_has_no_nearest_point_is_at_the_cap(scene: Scene) -> None:
    x = torch.tensor([[np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0], [1e30, 0.0, 0.0], [2e6, 0.0, 0.0]])
    found = reached(scene, torch.zeros(len(x), dtype=torch.int32), x).distance_m
    assert (found == 1e6).all()


def test_a_surface_without_triangles_has_no_nodes() -> None:
    tables = surface_tables([np.zeros((0, 3, 3), np.float32), np.eye(3, dtype=np.float32)[None]], [True, False])
    assert tables["surface_first"][0] == [0, 0, 1]
    assert wp.int32 is tables["surface_first"][1]
