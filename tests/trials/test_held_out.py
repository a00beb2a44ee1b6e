"""Held-out grasps of some objects: those that reception poses."""

import pytest
import torch

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.trials.holding.held_out import load_held_out


@pytest.mark.parametrize("objects", [{3}, {1, 4}])
def test_the_grasps_of_some_objects_are_found_where_their_first_one_is_said_to_be(objects):
    scene = Evaluator(load_benchmark("r2h-v1"), threads=1).scene
    every = load_held_out(scene.objects, scene.hands.model)
    some = every.only(frozenset(objects))
    assert some.loaded == objects and len(some.grip_n) == sum(
        int((every.grasps.object_index == o).sum()) for o in objects
    )
    for o in objects:
        n = int((every.grasps.object_index == o).sum())
        there, here = int(every.first[o]), int(some.first[o])
        assert n > 0 and bool((some.grasps.object_index[here : here + n] == o).all())
        assert torch.equal(some.grip_n[here : here + n], every.grip_n[there : there + n])
