"""Contact predictors that never saw some categories: their file, the things they learned from, their features."""

import hashlib
import json
from importlib import resources

import numpy as np
import pytest
import torch
from rounds import each
from scipy import ndimage
from sklearn.ensemble import GradientBoostingRegressor

from r2h_batch.assets.families.other_things import LIKE, THINGS
from r2h_batch.assets.families.train_contacts import area, turned
from r2h_batch.assets.families.train_unseen import POOLS, Example, pool, stored_trees
from r2h_batch.methods.predictors.grid import contact_grids, voxel_of_points
from r2h_batch.methods.predictors.shape_features import blurred, depth, shape_features
from r2h_batch.methods.predictors.unseen import LEFT_OUT, STORED_FILE, FromShape, load_unseen, mean_of
from r2h_batch.scene.families.draw import draw_instance
from r2h_batch.scene.families.family import FAMILIES
from r2h_batch.scene.objects import OBJECT_NAMES, load_objects

FOLDER = resources.files("r2h_batch.assets.families")
LOG = json.loads((FOLDER / "unseen.json").read_text())


def test_the_stored_trees_are_the_logged_ones_and_each_category_is_left_out_once() -> None:
    stored = (FOLDER / STORED_FILE).read_bytes()
    assert len(stored) <= 2_000_000 and hashlib.sha256(stored).hexdigest() == LOG["sha256"]
    assert sorted(c for group in LEFT_OUT for c in group) == sorted(OBJECT_NAMES)
    assert {len(group) for group in LEFT_OUT} == {4}
    assert LOG["training_categories"] == 12 + len(THINGS) and not {*THINGS} & {*OBJECT_NAMES}
    assert len({load_unseen(group[0]).digest for group in LEFT_OUT} | {load_unseen(None).digest}) == 5


def test_what_trees_learn_from_has_no_category_of_the_group() -> None:
    one = np.zeros(1, np.float32)
    every = [Example(c, one, one, None) for c in (*OBJECT_NAMES, *THINGS)]
    for group in each(LEFT_OUT):
        of = {name: {e.category for e in pool(name, group, every)} for name in POOLS}
        assert of["all"] == {*OBJECT_NAMES, *THINGS} - {*group}
        assert of["without_look_alikes"] == of["all"] - {thing for c in group for thing in LIKE.get(c, ())}
        assert of["without_other_things"] == {*OBJECT_NAMES} - {*group}


@pytest.mark.whole(part="methods")
def test_the_logged_areas_are_those_of_the_stored_trees() -> None:
    net, found = load_unseen("hammer"), []
    for model in each(load_objects([f"hammer_{k:02d}" for k in range(6)]), 6):  # the log has their mean
        answer = net(contact_grids([model]))[0][tuple(voxel_of_points(model).T)]
        found.append(area(answer.numpy(), model.receiver_face[model.point_face]))
    assert np.mean(found) == pytest.approx(LOG["left_out"]["all"]["hammer"]["region"], abs=0.02)
    assert LOG["mean_region"]["all"] > LOG["mean_region"]["without_other_things"] + 0.1


@pytest.mark.check
def test_trees_answer_as_scikit_learn_does_and_merged_ones_with_the_mean() -> None:
    draw = np.random.default_rng(3)
    x = draw.normal(size=(400, 5)).astype(np.float32)
    made = [
        GradientBoostingRegressor(
            n_estimators=7, learning_rate=0.08, max_leaf_nodes=n, max_depth=None, random_state=n
        ).fit(x, y)
        for n, y in ((5, x[:, 0] > 0.1), (9, np.abs(x[:, 1]) > 0.5))
    ]
    answers = [FromShape(stored_trees(m)).of_features(torch.from_numpy(x)).numpy() for m in made]
    for answer, m in each(zip(answers, made, strict=True)):
        np.testing.assert_allclose(answer, m.predict(x).clip(0, 1), atol=1e-5)
        assert answer.std() > 0.05
    both = FromShape(mean_of([stored_trees(m) for m in made])).of_features(torch.from_numpy(x))
    np.testing.assert_allclose(both.numpy(), np.mean([m.predict(x) for m in made], 0).clip(0, 1), atol=1e-5)


def test_depths_and_sums_around_are_those_of_scipy() -> None:
    draw = np.random.default_rng(5)
    full = ndimage.gaussian_filter(draw.normal(size=(24, 24, 24)), 2) > 0.02
    inside = ndimage.distance_transform_edt(np.pad(full, 1))[1:-1, 1:-1, 1:-1]
    np.testing.assert_allclose(depth(torch.from_numpy(full)).numpy(), inside, atol=1e-4)
    field = full.astype(np.float64)
    wanted = ndimage.gaussian_filter(field, 2.5, mode="constant", truncate=12) * (2.5 * np.sqrt(2 * np.pi)) ** 3
    np.testing.assert_allclose(
        blurred(torch.from_numpy(field)[None].float(), 2.5)[0].numpy(), wanted, rtol=1e-3, atol=1e-2
    )


def test_features_and_answers_are_of_the_shape_and_not_of_its_frame() -> None:
    (model,) = load_objects(["screwdriver_01"])
    c, s = np.cos(0.7), np.sin(0.7)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    skew = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
    )
    (grid,) = contact_grids([model])
    features, voxel = shape_features(grid)
    assert bool(features.isfinite().all()) and features.std(0).gt(0).sum() > 90
    around = grid.clone()
    around[0] = grid[0].flip(0, 1)  # a half turn about z
    other, place = shape_features(around)
    row = torch.full(grid.shape[1:], -1)
    row[tuple(place.T)] = torch.arange(len(place))
    n = grid.shape[1] - 1
    same = other[row[n - voxel[:, 0], n - voxel[:, 1], voxel[:, 2]]]
    off = (same - features).abs().amax(1).quantile(0.95)
    assert off < 0.1  # a slice is cut from the other end: some voxels go to the next one
    net, answers = load_unseen("screwdriver"), []
    for R in (np.eye(3), quarter, skew):
        there = turned(model, R)
        answers.append(net(contact_grids([there]))[0][tuple(voxel_of_points(there).T)].numpy())
    assert np.corrcoef(answers)[0].min() > 0.9


def test_an_empty_grid_and_voxels_beside_the_solid_have_answers() -> None:
    (model,) = load_objects(["cup_00"])
    grid = contact_grids([model])
    nothing = grid.clone()
    nothing[:, 0] = 0
    net = load_unseen("cup")
    assert not net(nothing).any()
    full = grid[0, 0] > 0.5
    beside = (blurred(full[None].float(), 0.7)[0] > 0.3) & ~full
    field = net(grid)[0]
    assert beside.any() and field[beside].min() > 0 and bool(((field >= 0) & (field <= 1)).all())


@pytest.mark.parametrize("category", [*THINGS][::9])
def test_other_things_are_closed_bodies_of_which_a_part_is_taken(category) -> None:
    found = draw_instance(THINGS[category], 1, 0)
    mesh = found.mesh
    taken = np.isin(found.face_part, [found.family.parts.index(p) for p in found.family.receiver])
    assert mesh.is_watertight and mesh.body_count == 1
    assert 0.04 < mesh.area_faces[taken].sum() / mesh.area < 0.95
    assert list(FAMILIES) == list(OBJECT_NAMES)  # what a network learned from changes no `families:*`
