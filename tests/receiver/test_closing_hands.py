"""What the sampler leaves out because it cannot decide: as by asking everything."""

import numpy as np
import pytest

from r2h_batch.bodies.hand import load_hand
from r2h_batch.bodies.objects import load_objects
from r2h_batch.launch import init_warp
from r2h_batch.receiver.hand_closing import come_down, distance_field, field_distance, load_families
from r2h_batch.receiver.hand_contact import ObjectSurface, hand_depth, measure_contact
from r2h_batch.receiver.receiving import load_receiving
from r2h_batch.receiver.sampler import CONTACT_M, LOOKED_AT_M, THIN_DEPTH_M

OBJECTS = load_objects()


@pytest.fixture(scope="module")
def grasps():
    return load_receiving()


def test_an_open_hand_comes_down_as_far_as_by_asking_all_of_its_skin() -> None:
    init_warp()
    model, families, rng = OBJECTS[3], load_families(load_hand()), np.random.default_rng(5)
    field = distance_field(ObjectSurface(model.vertices, model.faces))
    n, farthest = 40, 0.5
    family = rng.integers(0, len(families.shape), n).astype(np.int32)
    R = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0].astype(np.float32)
    R *= np.sign(np.linalg.det(R))[:, None, None]
    direction = rng.normal(size=(n, 3))
    direction = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    skin = families.tables.open_skin.numpy().reshape(len(families.shape), -1, 3)[family]
    target = model.points[rng.integers(0, len(model.points), n)] + rng.normal(0, 0.03, (n, 3))
    start = (target - np.einsum("nij,nj->ni", R, skin[:, 5]) - 0.25 * direction).astype(np.float32)
    found = come_down(field, families, family, R, start, direction, farthest=farthest, threads=2)
    skin, travel = np.einsum("nij,nkj->nki", R, skin), np.zeros(n, np.float32)
    going = np.ones(n, bool)
    for _ in range(64):
        at = skin + (start + travel[:, None] * direction)[:, None]
        least = field_distance(field, at.reshape(-1, 3).astype(np.float32), None).reshape(n, -1).min(axis=1)
        going &= least >= 3e-4
        travel = np.where(going, np.minimum(travel + np.minimum(least, farthest), farthest), travel)
        going &= travel < farthest
    assert 5 < (travel < farthest - 0.01).sum() < n  # some touch, some pass by
    assert np.abs(found - travel).max() < 2e-5


def test_what_is_deep_in_a_hand_is_measured_though_what_is_not_is_left_out(grasps) -> None:
    init_warp()
    deep = shallow = 0
    for row in range(0, len(grasps), 101):
        model, side = OBJECTS[int(grasps.object_index[row])], int(grasps.side[row])
        points, skin = np.concatenate([model.points, model.vertices]), grasps.vertices[row].numpy()
        for into in (0.0, 0.004):  # pressed into the palm, that there is something to find
            moved = (skin + np.float32(into) * np.array([0, 1, 0], np.float32))[None]
            (every,), (some,) = (hand_depth(points, moved, side, least=x) for x in (0.0, THIN_DEPTH_M))
            assert some == every or some < every <= THIN_DEPTH_M
            deep, shallow = deep + (every > THIN_DEPTH_M), shallow + (some < every)
    assert deep > 2 and shallow > 2


def test_skin_that_the_field_says_is_farther_off_than_6_mm_decides_nothing(grasps) -> None:
    init_warp()
    for index in (0, 3, 14):
        model, skin = OBJECTS[index], grasps.vertices[grasps.rows_of(index)[::9]].numpy()
        surface = ObjectSurface(model.vertices, model.faces)
        about = field_distance(distance_field(surface), skin.reshape(-1, 3), None).reshape(skin.shape[:2])
        every, some = measure_contact(surface, skin), measure_contact(surface, skin, asked=about < LOOKED_AT_M)
        touching = every.gap <= CONTACT_M
        assert np.array_equal(touching, some.gap <= CONTACT_M) and touching.any()
        for k in ("gap", "normal", "point", "face"):
            assert np.array_equal(getattr(every, k)[touching], getattr(some, k)[touching])
        assert np.array_equal(every.depth, some.depth) and np.array_equal(every.back_depth, some.back_depth)
