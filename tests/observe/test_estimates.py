"""Estimates that a method that sees is told (r2h_batch.observe.estimates)."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from rays_twin import RIG, cell
from rounds import each

from r2h_batch.config import OBJECT_ERRORS, ObjectErrors
from r2h_batch.methods.predictors import predict_parts, predict_target
from r2h_batch.observe.estimates import believed_objects, believed_receiver, image_keys
from r2h_batch.observe.seeing import look
from r2h_batch.observe.seen import LABELS, packed
from r2h_batch.scene.tables import MIDDLE_ROOT


def angles(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1)))


def test_hands_are_estimated_as_methods_that_are_told_see_them():
    scene, trials, _ = cell(count=60)
    exact, believed = (believed_receiver(scene, trials, seed=0, noise=k) for k in (0.0, 1.0))
    palm, normal, _ = scene.palm(trials.hand_index, trials.T_world_hand)
    assert torch.equal(exact.palm, palm) and torch.equal(exact.normal, normal)
    joints = scene.hands.joints.double()[trials.hand_index.long()]
    T = trials.T_world_hand.double()
    along = torch.einsum("nij,nj->ni", T[:, :3, :3], joints[:, MIDDLE_ROOT] - joints[:, 0])
    along = along - (along * normal).sum(1, keepdim=True) * normal
    along = along / along.norm(dim=1, keepdim=True)
    assert (angles(along.numpy(), exact.along.double().numpy()) < 0.1).all()
    assert exact.left.sum() == (scene.hands.set.side[trials.hand_index.long()] == 1).sum() > 0
    off = (believed.palm - palm).norm(dim=1).numpy()
    # three normal numbers of 12 mm: a mean length of 19 mm
    assert off.mean() == pytest.approx(0.012 * np.sqrt(8 / np.pi), rel=0.15)
    assert 5 < angles(believed.normal.numpy(), normal.numpy()).mean() < 11
    told = predict_target(trials, scene, seed=0)
    assert (believed.palm - told.palm_point).abs().max() < 1e-6
    assert (believed.normal - told.palm_normal).abs().max() < 1e-6


def test_known_objects_lie_where_the_level_of_error_puts_them():
    scene, trials, T = cell(count=60)
    exact = believed_objects(scene, trials, T, ObjectErrors())
    assert torch.equal(exact.T_world_obj, T)
    for i in each(range(0, len(trials), 17)):
        model = scene.objects[int(trials.object_index[i])]
        assert np.array_equal(exact.vertices[int(exact.mesh[i])], model.vertices)
        assert np.array_equal(exact.faces[int(exact.mesh[i])], model.faces)
    for level in each(("lab", "field", "rgb")):
        shift, turn = OBJECT_ERRORS[level]
        seen = believed_objects(scene, trials, T, ObjectErrors(shift, turn)).T_world_obj.double().numpy()
        E = np.linalg.inv(T.double().numpy()) @ seen
        turned = np.degrees(np.arccos(np.clip((np.trace(E[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
        assert np.sqrt((turned**2).mean() / 3) == pytest.approx(turn, rel=0.15)


def test_keys_are_of_the_images_and_differ_from_trial_to_trial():
    scene, trials, T = cell()
    seen = look(scene, trials, RIG, T)
    assert torch.equal(image_keys(seen.object, seen.hand), seen.key)
    assert len(torch.unique(seen.key)) == len(trials) and bool((seen.key >= 0).all())
    part = look(scene, trials[torch.tensor([2])], RIG, T[2:3])
    assert int(part.key[0]) == int(seen.key[2])
    assert not torch.equal(look(scene, trials, RIG, T, seed=1).key, seen.key)


@cache
def told(noise=1.0, **more):
    scene, trials, T = cell()
    return look(scene, trials, RIG, T, noise=noise, region="told", **more)


def measured(seen, row, camera):
    """Pixels (v, u) of the object with a depth, and the points there in the object's frame, by the true cameras; NumPy."""
    _, _, T = cell()
    images = seen.object
    shown = (images.label[row, camera] == LABELS.index("object")) & (images.depth_m[row, camera] > 0)
    v, u = np.nonzero(shown.numpy())
    z = images.depth_m[row, camera].double().numpy()[v, u]
    rays = np.stack([u + 0.5, v + 0.5, np.ones(len(u))]) * z
    local = np.linalg.inv(images.K[row, camera].double().numpy()) @ rays
    world = RIG.T_world_camera[camera].double().numpy() @ np.vstack([local, np.ones(len(u))])
    return (v, u), (np.linalg.inv(T[row].double().numpy()) @ world)[:3].T


def test_without_errors_a_pixel_is_told_the_region_of_the_face_that_it_shows():
    scene, trials, _ = cell()
    seen, shares = told(0.0), []
    for row in each(range(4, 8)):
        model = scene.objects[int(trials.object_index[row])]
        for camera in each(range(2)):
            (v, u), points = measured(seen, row, camera)
            _, away, face = trimesh.proximity.closest_point(model.mesh, points[::7])
            assert away.max() < 3e-4
            right = model.receiver_face[face] == seen.region[row, camera].numpy()[v, u][::7]
            shares.append(right.mean())
            assert 0 < model.receiver_face[face].mean() < 1
    # the border is known to the spacing of the cloud, 3 mm
    assert min(shares) > 0.94 and np.mean(shares) > 0.97


def test_borders_are_misplaced_as_those_that_methods_told_the_truth_get():
    scene, trials, _ = cell()
    seen, parts = told(), predict_parts(trials, scene, seed=0)
    moved = 0
    for row in each(range(4, 8)):
        model = scene.objects[int(trials.object_index[row])]
        for camera in each(range(2)):
            (v, u), points = measured(seen, row, camera)
            away = np.linalg.norm(points[::5, None] - model.points[None].astype(np.float64), axis=2)
            nearest = away.argmin(1)
            own = seen.region[row, camera].numpy()[v, u][::5]
            assert (own == parts.usage[row].numpy()[nearest]).mean() > 0.999
            moved += (own != model.receiver_face[model.point_face[nearest]]).sum()
    assert moved > 50
    assert not torch.equal(told(seed=1).region, seen.region) and torch.equal(seen.region, told().region)


def test_nothing_but_the_region_of_what_was_seen_is_told():
    scene, trials, T = cell()
    for more in each(({}, {"labels": "missed", "seed": 3}, {"labels": "grown"})):
        hidden, seen = look(scene, trials, RIG, T, **more), told(**more)
        assert hidden.region is None and "region" not in packed(hidden)
        # the same images, keys and estimates, bit for bit
        for name, array in each(packed(hidden).items()):
            assert np.array_equal(array, packed(seen)[name])
        shown = (seen.object.label == LABELS.index("object")) & (seen.object.depth_m > 0)
        assert seen.region.dtype == torch.bool and not bool((seen.region & ~shown).any())
        # an object of S0 has no region, one of S1 has
        assert not bool(seen.region[:4].any()) and bool(seen.region[4:].flatten(1).any(1).all())


def test_the_told_region_has_the_same_bits_alone_and_in_any_order():
    scene, trials, T = cell()
    for rows in each((torch.tensor([7, 2, 5]), torch.tensor([6]))):
        some = look(scene, trials[rows], RIG, T[rows], region="told")
        assert torch.equal(some.region, told().region[rows])


def test_the_region_of_a_cloud_is_that_of_its_own_points():
    seen = told()
    # a region that can be seen from a point alone: the upper half of the picture
    upper = torch.zeros_like(seen.region)
    upper[..., :96, :] = True
    marked = replace(seen, region=upper)
    cloud, mask = seen.cloud(600, seed=4)
    inside = marked.cloud_region(600, seed=4)
    assert inside.shape == mask.shape and not bool((inside & ~mask).any()) and 0 < int(inside.sum()) < int(mask.sum())
    for row in each(range(len(seen))):
        rows = np.zeros((2, 600))
        for camera in each(range(2)):
            T, K = (x[row, camera].double().numpy() for x in (seen.T_world_camera, seen.object.K))
            local = np.linalg.inv(T) @ np.vstack([cloud[row].double().numpy().T, np.ones(600)])
            rows[camera] = K[1, 1] * local[1] / local[2] + K[1, 2] - 96
        # above the middle in one camera or the other; where both agree, it is known which
        both = (np.abs(rows) > 0.5).all(0) & ((rows < 0).all(0) | (rows > 0).all(0)) & mask[row].numpy()
        assert both.sum() > 5 and np.array_equal(inside[row].numpy()[both], (rows[0] < 0)[both])
    with pytest.raises(ValueError, match="region is not told; look with region=told"):
        replace(seen, region=None).cloud_region(600)
