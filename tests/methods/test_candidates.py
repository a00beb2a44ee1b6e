"""Grasp candidates as generated: antipodal and clear of three boxes, but not tried on the evaluator's own gripper."""

import json
import warnings
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
import torch
from problems import default_evaluator
from rounds import each

from r2h_batch.judge.grasp import close_gripper
from r2h_batch.methods.box_grasps import three_boxes
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.methods.grasps import generate_grasps
from r2h_batch.scene.arrays import arrays_digest, stored_arrays
from r2h_batch.scene.grasp_set import GraspSet
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot_file import load_robot

OBJECTS = load_objects()


def judged(kind):
    """How many of an object's candidates pass Stability, for each object."""
    scene, counts = default_evaluator().scene, []
    for i, c in enumerate(candidates_of(scene.objects, kind)):
        T, index = torch.from_numpy(c.T_obj_ee), torch.full((len(c),), i, dtype=torch.int32)
        counts.append(int((close_gripper(scene.grasp_tables, T, index).margin_m >= 0).sum()))
    return counts


def test_methods_can_fail_stability_with_grasps_as_generated_and_not_with_filtered_ones():
    report = json.loads((resources.files("r2h_batch.assets.objects") / "grasps_as_generated_report.json").read_text())
    assert judged("filtered") == [100] * 16
    raw = judged("as-generated")
    assert raw == [report["objects"][o.name]["pass_stability"] for o in OBJECTS] and 1400 < sum(raw) < 1600
    assert arrays_digest(stored_arrays("objects", "grasps_as_generated.npz")) == report["digest"]


def test_no_cloud_point_lies_in_the_boxes_of_the_open_gripper():
    low, high, rest_low, rest_high = three_boxes(load_robot())
    for model, c in each(zip(OBJECTS[::5], candidates_of(OBJECTS, "as-generated")[::5], strict=True)):
        for T in each(c.T_obj_ee.astype(np.float64)[::9]):
            p = (model.points.astype(np.float64) - T[:3, 3]) @ T[:3, :3]
            for x, a, b in ((p, low, high), (p * [1, -1, 1], low, high), (p, rest_low, rest_high)):
                assert not ((x > a + 1e-5) & (x < b - 1e-5)).all(1).any()


@pytest.mark.slow
def test_the_stored_ones_are_made_again():
    stored = stored_arrays("objects", "grasps_as_generated.npz")
    for model in each(OBJECTS[6:8]):
        assert np.array_equal(generate_grasps(model).T_obj_ee, stored[f"{model.name}/T_obj_ee"])


def test_a_users_own_grasps_are_taken_as_they_are():
    T = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    T[:, 2, 3] = [0.3, 0.0, 0.1]  # the first holds nothing at all
    own = GraspSet(T, np.zeros(3, np.float32), np.array([0.2, 0.9, 0.5], np.float32), np.full(3, -1, np.int32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (found,) = candidates_of((replace(OBJECTS[6], grasps=own),), "as-generated")
    assert np.array_equal(found.T_obj_ee[:, 2, 3], np.float32([0.0, 0.1, 0.3])) and found.score[0] == np.float32(0.9)
