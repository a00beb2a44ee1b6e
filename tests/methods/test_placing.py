"""Where a method holds an object above a palm does not depend on the frame of its mesh, but for objects of r2h-v1."""

import numpy as np
import pytest
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import fc, intent
from r2h_batch.methods.placing import center_of
from r2h_batch.scene.objects import BUILT_IN_NAMES, load_objects, turned
from r2h_batch.trials.edit import frame_of

ANY_TURN = "20,40,60"
INSTANCES = ["cup_02", "hammer_01", "eyeglasses_03", "power_drill_00", "bottle_04"]


@pytest.mark.parametrize(
    "instances", [INSTANCES[:2], pytest.param(INSTANCES, marks=pytest.mark.whole(part="methods"))], ids=["two", "all"]
)
def test_methods_give_the_same_poses_whatever_frame_an_objects_file_has(instances):
    own = load_objects(instances)
    other = tuple(turned(o, frame_of(ANY_TURN)) for o in own)
    for method in (fc, intent):
        answers = []
        for objects in (own, other):
            evaluator = Evaluator(load_benchmark("r2h-v1").with_objects(objects))
            trials = load_benchmark("r2h-v1").with_objects(objects).trials(15)
            answers.append(method.predict(trials, evaluator.scene, seed=0).T_world_ee)
        same = (answers[0] - answers[1]).abs().amax((1, 2)) < 1e-4
        assert len(same) == 30 and same.float().mean() > 0.95, method.TITLE  # equal scores may fall the other way


def test_the_centre_turns_with_the_object_and_is_the_boxs_for_objects_of_frozen_protocols():
    R = frame_of(ANY_TURN)
    for model in each(load_objects(INSTANCES)):
        center = center_of(model)
        assert np.abs(center_of(turned(model, R)) - R @ center).max() < 2e-5
        reach = np.linalg.norm(model.vertices - center, axis=1).max()
        assert 0.5 * np.linalg.norm(np.ptp(model.vertices, axis=0)) >= reach - 1e-5  # the box's ball holds it too
    for model in load_objects(BUILT_IN_NAMES):
        for one in (model, turned(model, R)):
            box = (one.vertices.min(0).astype(np.float64) + one.vertices.max(0)) / 2
            assert np.array_equal(center_of(one), box)
