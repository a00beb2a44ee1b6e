"""The voxels that depth cameras leave of an object, against rays cast in float64."""

import numpy as np
import torch

from r2h_batch import load_benchmark
from r2h_batch.methods.predictors import DepthView, contacts, depth_view, predict_contacts
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.scene import Scene

ROW = 5  # wineglass: a thin wall, a stem, a hollow


def nearest_hit(start, rays, corners):
    """(n,) factor on each ray to the first triangle it meets (Moeller and Trumbore 1997); inf: none."""
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    found = np.full(len(rays), np.inf)
    for i, ray in enumerate(rays):
        h = np.cross(ray, v)
        with np.errstate(divide="ignore", invalid="ignore"):
            f = 1.0 / (u * h).sum(1)
            s = start - a
            q = np.cross(s, u)
            b, c, t = f * (s * h).sum(1), f * (ray * q).sum(1), f * (v * q).sum(1)
        hit = (b >= 0) & (c >= 0) & (b + c <= 1) & (t > 0)
        found[i] = t[hit].min() if hit.any() else np.inf
    return found


def test_depth_is_that_of_rays_in_float64(scene):
    model, half = scene.objects[ROW], 60
    middle = model.voxel_origin + 32 * model.voxel_pitch
    T = depth_view._camera(middle, 3 * 8, DepthView(cameras=1), (1, 2))
    depth = depth_view._depth(scene, ROW, T, half)
    pixels = np.random.default_rng(0).integers(0, depth.size, 150)
    i, j = np.unravel_index(pixels, depth.shape)
    rays = np.stack([(i - half) * depth_view.PIXEL, (j - half) * depth_view.PIXEL, np.ones(len(i))], 1)
    expected = nearest_hit(T[:3, 3], rays @ T[:3, :3].T, model.vertices[model.faces].astype(np.float64))
    found = depth[i, j]
    assert np.isfinite(found).sum() > 20 and (np.isfinite(found) == np.isfinite(expected)).mean() > 0.98
    both = np.isfinite(found) & np.isfinite(expected)
    off = abs(found[both] - expected[both])
    assert np.median(off) < 1e-6 and (off < 1e-4).mean() > 0.98


def test_cameras_carve_nothing_of_the_solid_more_of_them_leave_less_and_a_camera_elsewhere_shows_it_elsewhere(scene):
    solid = scene.objects[ROW].occupancy
    one, four = (depth_view.carved(scene, ROW, DepthView(n, noise=0), 0, 0) for n in (1, 4))
    assert all((full & solid).sum() > 0.99 * solid.sum() for full in (one, four))
    assert solid.sum() < four.sum() < one.sum() < 64**3
    assert depth_view.carved(scene, ROW, DepthView(1, lost=1), 0, 0).mean() > 0.99  # nothing is known
    wrong = depth_view.carved(scene, ROW, DepthView(4, 0, 0, 0.02), 0, 0)
    assert (wrong & solid).sum() < 0.9 * (four & solid).sum()


def test_a_trials_view_depends_on_seed_and_id_alone(monkeypatch):
    """A predictor that says how much it is shown, so that no network has to run."""
    monkeypatch.setattr(contacts, "DRAWS", 2)
    scene, view = Scene(load_benchmark("r2h-v1").with_objects(load_objects(["wineglass"]))), DepthView(cameras=1)
    trials = load_benchmark("r2h-v1").with_objects(scene.objects).trials(4, splits=["S0"])

    def shown(grid):
        return grid[:, 0].mean().expand(grid[:, 0].shape)

    def see(part, seed=0):
        return predict_contacts(part, scene, predictor=lambda grid: shown(grid), view=view, seed=seed)  # not cached

    found, order = see(trials), torch.tensor([2, 0, 3])
    assert torch.equal(see(trials[order]), found[order]) and not torch.equal(see(trials, seed=1), found)
