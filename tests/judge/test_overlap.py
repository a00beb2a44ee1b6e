"""How deep things meet: paths that were only sampled, and motions that touch the hand, against dense float64 samples."""

import numpy as np
import pytest
import torch
from convex_twin import primitive_distance
from oracle import deepest_along, hand_triangles, kind_of, mujoco_scene
from planning_twins import staged
from problems import Problems, default_evaluator, make_batch, solve

from r2h_batch.config import BORDERLINE_M, PlanConfig
from r2h_batch.judge.distance import hand_distance
from r2h_batch.judge.motion.execute import Executed

SAMPLED = PlanConfig(goals="one", edge_check="moveit", hand_clearance_m=0.0)


@pytest.fixture(scope="module")
def sampled() -> Problems:
    scene = default_evaluator().scene
    return solve(scene, make_batch(scene, 192, random_share=0.3), SAMPLED)


def test_a_sampled_path_says_how_deep_it_passes_through_things(sampled):
    plan, scene = sampled.plan, default_evaluator().scene
    through = torch.nonzero((plan.length > 0) & (plan.clearance_m < 0)).flatten().tolist()
    assert len(through) >= 6
    deep, ratio = [], []
    for row in through[:4]:
        twin = mujoco_scene(scene, staged(sampled, row))
        path = plan.path[row, : int(plan.length[row])].double().numpy()
        depth = deepest_along(twin.model, twin.data, twin.pairs, path)
        said = -float(plan.clearance_m[row])
        assert 0 < said <= depth + 1e-4, (row, said, depth)
        deep.append(depth)
        ratio.append(said / depth)
    assert max(deep) > 5e-3 and np.median(ratio) > 0.2, (deep, ratio)
    said = plan.clearance_m[through]
    assert (said.abs() < BORDERLINE_M).float().mean() < 0.1  # -1e-6 for each of them before


def test_safe_says_how_deep_the_hand_is_in_the_robot(sampled):
    scene, plan = default_evaluator().scene, sampled.plan
    n = len(plan.length)
    free, found = torch.zeros(n), plan.length > 0
    moved = Executed(plan.path, plan.length, free, found, plan.length >= 0, free, free, free, plan.length, None)
    touch = hand_distance(scene, sampled.body_poses, moved, torch.ones(n, dtype=torch.bool))
    rows = torch.nonzero(touch.distance_m < 0).flatten().tolist()
    assert len(rows) >= 2
    for row in rows[:2]:
        s = staged(sampled, row)
        twin, triangles = mujoco_scene(scene, s), hand_triangles(scene, s)
        i, f = int(touch.segment[row]), float(touch.fraction[row])
        q = (1 - f) * plan.path[row, i].double().numpy() + f * plan.path[row, i + 1].double().numpy()
        twin.safe_at(triangles, q)  # puts the model there
        weights = np.array([[a, b, 8 - a - b] for a in range(9) for b in range(9 - a)]) / 8
        points = np.einsum("wk,fkd->fwd", weights, triangles).reshape(-1, 3)
        m, depth = twin.model, np.inf
        for link in scene.robot.links:
            for name in twin.groups[link]:
                g = m.geom(name).id
                local = (points - twin.data.geom_xpos[g]) @ twin.data.geom_xmat[g].reshape(3, 3)
                depth = min(depth, float(primitive_distance(kind_of(m, g), m.geom_size[g], local).min()))
        assert depth < 0 and float(touch.distance_m[row]) == pytest.approx(depth, abs=max(1.5e-4, 0.05 * abs(depth)))
