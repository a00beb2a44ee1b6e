"""Presented: angle and distance of the receiver's region, made again in float64; it says what it should and decides nothing."""

import numpy as np
import pytest
import trimesh
from problems import default_evaluator

from r2h_batch import load_benchmark
from r2h_batch.methods import random as random_method


@pytest.mark.check
def test_angle_and_distance_are_those_of_the_region_and_s0_has_none():
    evaluator = default_evaluator("r2h-v1")
    trials = load_benchmark("r2h-v1").trials(20)
    asked = random_method.predict(trials, evaluator.scene)
    scores = evaluator.score(asked.T_obj_ee, asked.T_world_ee, trials, stages="pose")
    palm, _, ball = (x.double().numpy() for x in evaluator.scene.palm(trials.hand_index, trials.T_world_hand))
    seen = 0
    for i in range(len(trials)):
        model = evaluator.scene.objects[int(trials.object_index[i])]
        angle, distance = (float(getattr(scores, f"presented_{k}")[i]) for k in ("angle_deg", "distance_m"))
        if not model.receiver_face.any():
            assert np.isnan(angle) and np.isnan(distance) and not scores.presented[i]
            continue
        T_obj_ee, T_world_ee = asked.T_obj_ee[i].double().numpy().copy(), asked.T_world_ee[i].double().numpy()
        T_obj_ee[:3, 3] += T_obj_ee[:3, 1] * float(scores.grasp_shift_m[i])  # the pads have moved the object along y
        T = T_world_ee @ np.linalg.inv(T_obj_ee)
        triangles = model.vertices.astype(float)[model.faces[model.receiver_face]] @ T[:3, :3].T + T[:3, 3]
        area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
        to_region = np.average(triangles.mean(1), axis=0, weights=area) - T_world_ee[:3, 3]
        to_palm = palm[i] - T_world_ee[:3, 3]
        cos = to_region @ to_palm / np.linalg.norm(to_region) / np.linalg.norm(to_palm)
        assert angle == pytest.approx(np.degrees(np.arccos(cos)), abs=0.01)
        nearest = trimesh.triangles.closest_point(triangles, np.tile(ball[i], (len(triangles), 1)))
        assert distance == pytest.approx(np.linalg.norm(nearest - ball[i], axis=1).min(), abs=2e-6)
        assert bool(scores.presented[i]) == (angle <= 90 and distance <= 0.10)
        seen += bool(scores.presented[i])
    assert 0 < seen < 20
