"""What the sampler leaves out because it cannot decide: as by asking everything."""

import numpy as np
import pytest

from r2h_batch.bodies.objects import load_objects
from r2h_batch.launch import init_warp
from r2h_batch.receiver.hand_closing import distance_field, field_distance
from r2h_batch.receiver.hand_contact import ObjectSurface, hand_depth, measure_contact
from r2h_batch.receiver.receiving import load_receiving
from r2h_batch.receiver.sampler import CONTACT_M, LOOKED_AT_M, THIN_DEPTH_M

OBJECTS = load_objects()


@pytest.fixture(scope="module")
def grasps():
    return load_receiving()


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
