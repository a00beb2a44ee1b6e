"""What criteria of other packages ask about the handover: shapes and words that they may get wrong."""

import numpy as np
import pytest
import torch
from problems import default_evaluator
from rounds import each

from r2h_batch.judge import metrics
from r2h_batch.methods.random import predict


@pytest.fixture(scope="module")
def evidence():
    """That of eight rows of r2h-v1, the second of which is no pose."""
    evaluator, kept = default_evaluator("r2h-v1"), []
    trials = evaluator.benchmark.trials(4)
    answer = predict(trials, evaluator.scene, seed=0)
    T_world_ee = answer.T_world_ee.clone()
    T_world_ee[1] = torch.nan
    with pytest.MonkeyPatch.context() as patch:
        judge = metrics.judge
        patch.setattr(metrics, "judge", lambda e: kept.append(e) or judge(e))
        evaluator.score(answer.T_obj_ee, T_world_ee, trials, stages="pose")
    return kept[-1]


PARTS = ("gripper", "object", "wanted", "sharp", "head")


@pytest.mark.parametrize("to", PARTS)
def test_a_distance_needs_a_point_for_each_row(evidence, to):
    point = evidence.palm.point
    for wrong in (point.repeat(2, 1), point[:3], point[:, None], point[:, :2], point.int()):
        with pytest.raises(
            ValueError, match=r"point is torch\.\w+ \(.*\); it must be a torch tensor \(8, 3\), a point for"
        ):
            evidence.distance(wrong, to)
    with pytest.raises(TypeError, match=r"it must be a torch tensor \(8, 3\)"):
        evidence.distance(point.numpy(), to)
    with pytest.raises(ValueError, match="to is 'blade'; allowed are gripper, object, wanted, sharp, head"):
        evidence.distance(point, "blade")


@pytest.mark.parametrize("to", PARTS)
def test_a_point_that_is_nan_has_no_distance_and_does_not_pass(evidence, to):
    point = evidence.palm.point.clone()
    point[3, 1] = torch.nan
    found = evidence.distance(point, to)
    assert found[3].isnan() and not found[[0, 2, 4, 5, 6, 7]].isnan().any()
    assert bool(found[1].isnan()) == (to != "head")  # the row is not judged; its receiver is there


@pytest.mark.parametrize("to", PARTS)
def test_eyes_which_are_of_float64_have_distances_too(evidence, to):
    eye = evidence.eyes[:, 0]
    assert eye.dtype == torch.float64
    found = evidence.distance(eye, to)
    assert found.dtype == torch.float32
    assert torch.equal(found.nan_to_num(), evidence.distance(eye.float(), to).nan_to_num())


def test_points_are_of_the_part_that_is_asked_for_and_up_is_of_vessels_alone(evidence):
    every, wanted, sharp = (evidence.points(role)[1].numpy() for role in ("object", "wanted", "sharp"))
    up, objects = evidence.up.numpy(), [evidence.scene.objects[i] for i in evidence.held.objects.tolist()]
    assert {o.split for o in objects} == {"S0", "S1"} and len({o.up is None for o in objects}) == 2
    for k, o in each(list(enumerate(objects))):
        assert every[k].all() and (sharp[k] == o.sharp_face[o.point_face]).all()
        assert (wanted[k] == (o.split == "S0") | o.receiver_face[o.point_face]).all()
        assert np.isnan(up[k]).all() == (o.up is None)
