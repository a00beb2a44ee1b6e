"""Each criterion's margin against float64 NumPy and trimesh; when touching passes; where a criterion is defined."""

import sys
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import oracle
import pytest
import torch
import trimesh
from convex_twin import winding_number
from planning_twins import motion_samples, posture_at, staged
from problems import Batch, Problems, default_evaluator, make_batch, solve

from r2h_batch.config import CLEARANCE_CAP_M, EvalConfig, ExecConfig, Thresholds
from r2h_batch.judge import metrics
from r2h_batch.judge.distance import bound_with_slack, hand_distance
from r2h_batch.judge.grasp import CUT_CAP_M, Grasp, attach, close_gripper, open_clearance, region_distance, squeezed
from r2h_batch.judge.motion.execute import Executed, execute
from r2h_batch.judge.motion.time_law import time_path
from r2h_batch.judge.reach import reached
from r2h_batch.judge.scores import verdict
from r2h_batch.scene.robot import gripper_primitives_at
from r2h_batch.types import CRITERIA, MarginKind, PlanReason, Scores
from r2h_batch.verdicts import CRITERION, REGISTRY, SPLITS, CriterionEntry

STABILITY, PLAN, REACH, AFFORDANCE, SAFE = range(5)
N = 256


@cache
def scored() -> tuple[Batch, Problems, Scores]:
    evaluator = default_evaluator()
    batch = make_batch(evaluator.scene, N, random_share=0.4)
    scores = evaluator.kinematic.score(batch.T_obj_ee, batch.T_world_ee, batch.trials)
    return batch, solve(evaluator.scene, batch), scores


def as_planned(problems: Problems) -> Executed:
    """The planned motion itself as what was executed."""
    config, plan = ExecConfig(sim="none"), problems.plan
    motion = time_path(plan.path, plan.length, config)
    return execute(default_evaluator().scene, problems.body_poses, plan.path, plan.length, motion, config)


STAGES = ("clearance_m", "goal_reached", "moves", "reason", "nearest", "reached")


def evidence(active: torch.Tensor, safe_margin_m: float = 0.0, **found: Any) -> Any:
    """Results of the named stages alone."""
    config = EvalConfig(thresholds=Thresholds(safe_margin_m=safe_margin_m))
    held = SimpleNamespace(active=active, **{k: v for k, v in found.items() if k not in STAGES})
    stages = {k: v for k, v in found.items() if k in STAGES}
    scene = default_evaluator().scene
    return SimpleNamespace(scene=scene, config=config, held=held, slip_m=None, **stages)


def of_object(scores_row: int) -> trimesh.Trimesh:
    batch = scored()[0]
    model = default_evaluator().scene.objects[int(batch.trials.object_index[scores_row])]
    return trimesh.Trimesh(model.vertices.astype(np.float64), model.faces, process=False)


def verdict_of(number: torch.Tensor, evaluated: torch.Tensor) -> dict[str, torch.Tensor]:
    """The verdict of rows with this margin in every criterion."""
    lengths = dict.fromkeys(("width_m", "opening_m", "shift_m"), number)
    held = SimpleNamespace(active=evaluated, grasp=SimpleNamespace(**lengths))
    return verdict(REGISTRY, [metrics.Criterion(number, evaluated) for _ in CRITERIA], held, None)  # type: ignore[arg-type]


# --- the rule ------------------------------------------------------------------------------------------------------


def test_touching_passes_where_the_paper_says_so():
    margin = torch.tensor([0.0, 1e-9, -1e-9])
    everywhere = torch.ones(3, dtype=torch.bool)
    touching = {"stability", "reach", *(entry.name for entry in REGISTRY[5:] if entry.touching_passes)}
    for name in CRITERIA:
        assert verdict_of(margin, everywhere)["passed"][:, CRITERIA.index(name)].tolist() == [
            name in touching, True, False
        ], name  # fmt: skip
    unknown = verdict_of(torch.full((3,), torch.nan), everywhere)
    assert not unknown["passed"].any() and unknown["evaluated"].all(0).tolist() == [
        name != "affordance" for name in CRITERIA
    ]


def test_scores_are_consistent_with_their_margins():
    _, _, s = scored()
    assert torch.equal(torch.isnan(s.margin), ~s.evaluated)
    apart = s.evaluated & (s.margin != 0)
    assert torch.equal(s.passed[apart], s.margin[apart] > 0) and not s.passed[~s.evaluated].any()
    assert s.evaluated[:, :3].all() and torch.equal(s.evaluated[:, SAFE], s.path_len > 0)
    assert len(CRITERIA) == s.margin.shape[1]


# --- Stability -----------------------------------------------------------------------------------------------------


def test_stability_is_the_least_of_aperture_less_width_and_the_open_grippers_clearance():
    batch, _, s = scored()
    grasp = close_gripper(default_evaluator().scene.grasp_tables, batch.T_obj_ee, batch.trials.object_index)
    found = metrics.stability(evidence(torch.ones(N, dtype=torch.bool), grasp=grasp, margin_kind=None))
    assert torch.equal(found.margin, grasp.margin_m)
    held = ~grasp.empty & (grasp.cut_m > 0)
    assert held.sum() > 0.9 * N
    tables = default_evaluator().scene.grasp_tables
    spare, _ = open_clearance(tables, batch.T_obj_ee, batch.trials.object_index, cap_m=CUT_CAP_M)
    limit = torch.minimum(torch.minimum(Thresholds().w_max_m - s.width_m, s.width_m - Thresholds().w_min_m), spare)
    torch.testing.assert_close(s.margin[held, STABILITY], limit[held], atol=1e-6, rtol=0)
    assert (spare[held] < CUT_CAP_M).sum() > 0.2 * N


# --- Reach ---------------------------------------------------------------------------------------------------------


def test_reach_is_the_balls_radius_less_its_centres_distance_to_the_solid():
    batch, problems, s = scored()
    scene = default_evaluator().scene
    _, _, center = scene.palm(batch.trials.hand_index, batch.trials.T_world_hand)
    inside = 0
    for row in range(0, N, 3):
        T_obj_ee, T_world_ee = (T[row].double().numpy() for T in (problems.T_obj_ee_attached, batch.T_world_ee))
        x = T_obj_ee @ np.linalg.inv(T_world_ee) @ np.append(center[row].double().numpy(), 1.0)
        mesh = of_object(row)
        distance = float(trimesh.proximity.closest_point_naive(mesh, x[None, :3])[1][0])
        if abs(winding_number(x[:3], mesh.triangles)) > 0.5:
            distance, inside = 0.0, inside + 1
        assert float(s.margin[row, REACH]) == pytest.approx(0.10 - distance, abs=3e-5), row
    assert inside >= 3


def test_the_balls_centre_is_twelve_centimetres_out_of_the_palm():
    batch, _, _ = scored()
    scene = default_evaluator().scene
    point, normal, center = scene.palm(batch.trials.hand_index, batch.trials.T_world_hand)
    joints = scene.hands.joints[batch.trials.hand_index.long()].double().numpy()
    T = batch.trials.T_world_hand.double().numpy()
    world = np.einsum("nij,nkj->nki", T[:, :3, :3], joints) + T[:, None, :3, 3]
    roots = world[:, [0, 1, 4, 7, 10]]  # wrist, index, middle, pinky, ring
    np.testing.assert_allclose(point.numpy(), roots.mean(1), atol=1e-6)
    n = np.cross(world[:, 1] - world[:, 0], world[:, 7] - world[:, 0])
    n *= np.where(scene.hands.set.side[batch.trials.hand_index.long()].numpy() == 1, -1.0, 1.0)[:, None]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    np.testing.assert_allclose(normal.numpy(), n, atol=2e-6)
    np.testing.assert_allclose(center.numpy(), roots.mean(1) + 0.12 * n, atol=2e-6)
    # out of the palm: relaxed fingers curl to this side
    skin = scene.hands.vertices[batch.trials.hand_index.long()].double().numpy()
    tips = skin[:, scene.hands.model.tip_vertices.numpy()]
    tips = np.einsum("nij,nkj->nki", T[:, :3, :3], tips) + T[:, None, :3, 3]
    along = np.einsum("nki,ni->nk", tips - roots.mean(1)[:, None], n).mean(1)
    assert (along > -0.02).all() and along.mean() > 0.01


@pytest.mark.parametrize(("gap", "passes"), [(0.0999, True), (0.1001, False)])
def test_reach_passes_up_to_the_balls_radius(gap, passes):
    scene = default_evaluator().scene
    top = float(scene.objects[0].vertices[:, 0].max())
    corner = scene.objects[0].vertices[scene.objects[0].vertices[:, 0].argmax()]
    center = torch.tensor([[top + gap, float(corner[1]), float(corner[2])]])
    found = reached(scene, torch.zeros(1, dtype=torch.int32), center)
    c = metrics.reach(evidence(torch.ones(1, dtype=torch.bool), reached=found))
    assert bool(c.margin[0] >= 0) is passes


# --- Affordance ----------------------------------------------------------------------------------------------------


def test_affordance_is_the_closed_fingers_distance_to_the_region_and_only_asked_in_s1():
    batch, problems, s = scored()
    scene = default_evaluator().scene
    compared = met = 0
    for row in range(N):
        model = scene.objects[int(batch.trials.object_index[row])]
        assert bool(s.evaluated[row, AFFORDANCE]) is (model.split == "S1")
        if model.split == "S0" or row % 8 != 1:
            continue
        region = model.vertices.astype(np.float64)[model.faces[model.receiver_face]]
        opening = max(float(problems.opening_m[row]) - 0.001, 0.0)
        T = problems.T_obj_ee_attached[row].double().numpy() @ gripper_primitives_at(scene.robot, opening)
        least = CLEARANCE_CAP_M
        for i, motion in enumerate(scene.robot.gripper_motion):
            if motion != "fixed":
                kind = int(scene.robot.gripper.kind[i])
                least = min(least, oracle.open_surface_distance(kind, scene.robot.gripper.size[i], T[i], region, least))
        compared += 1
        if least <= 1e-6:
            met += 1
            assert float(s.margin[row, AFFORDANCE]) <= 1e-6
        else:
            assert float(s.margin[row, AFFORDANCE]) == pytest.approx(least, abs=2e-5), row
    assert compared >= 12 and met >= 2


def test_fingers_that_hold_the_region_itself_meet_it_by_the_pads_squeeze():
    """The closed pads touch what they hold: without the squeeze the margin would be rounding noise around 0."""
    batch, _, s = scored()
    scene = default_evaluator().scene
    grasp = close_gripper(scene.grasp_tables, batch.T_obj_ee, batch.trials.object_index)
    closed = attach(batch.T_obj_ee, grasp.shift_m), batch.trials.object_index
    raw, _ = region_distance(scene.grasp_tables, *closed, grasp.opening_m, cap_m=CLEARANCE_CAP_M)
    holding = (raw.abs() < 1e-4) & s.evaluated[:, AFFORDANCE]
    assert holding.any()
    assert (s.margin[holding, AFFORDANCE] < -1e-4).all()
    too_wide = Grasp(**{**grasp.__dict__, "width_m": torch.full((N,), 0.2), "opening_m": torch.full((N,), 0.085)})
    open_m = squeezed(too_wide, Thresholds())
    everywhere = torch.ones(N, dtype=torch.bool)
    c = metrics.affordance(evidence(everywhere, attached=closed[0], objects=closed[1], squeezed_m=open_m))
    open_, _ = region_distance(scene.grasp_tables, *closed, too_wide.opening_m, cap_m=CLEARANCE_CAP_M)
    region = ~open_.isnan()  # of objects that have one
    assert torch.equal(c.margin[region], open_[region]) and torch.equal(c.margin.isnan(), ~region)


# --- Plan, Safe ----------------------------------------------------------------------------------------------------


def test_plans_margin_is_the_smallest_clearance_or_what_a_failure_lacks():
    _, problems, s = scored()
    found = s.path_len > 0
    assert torch.equal(found, s.plan_reason == int(PlanReason.OK))
    assert torch.equal(s.margin[found, PLAN], problems.plan.clearance_m[found])
    assert (s.margin[~found, PLAN] < 0).all()
    searched = s.plan_reason == int(PlanReason.NO_PATH_IN_BUDGET)
    assert torch.equal(s.margin[:, PLAN] == -torch.inf, searched)
    assert (s.margin[found, PLAN] > 0).all() and (s.margin[found, PLAN] <= CLEARANCE_CAP_M).all()


def test_safe_is_the_smallest_distance_of_the_timed_motion_and_the_witness_says_where_and_when():
    _, problems, s = scored()
    evaluator = default_evaluator()
    near = torch.nonzero((s.path_len > 0) & (s.margin[:, SAFE] < CLEARANCE_CAP_M)).flatten().tolist()
    assert len(near) >= 20
    for row in near[:4]:
        twin = oracle.mujoco_scene(evaluator.scene, staged(problems, row))
        triangles = oracle.hand_triangles(evaluator.scene, twin.staged)
        k = int(s.path_len[row])
        path, times = s.path[row, :k].double().numpy(), s.path_time_s[row, :k].double().numpy()
        when = float(s.witness_time_s[row])
        assert 0 <= when <= float(s.t_exec_s[row])
        # where the motion is at that time, from its dense samples
        q = posture_at(path, times, when, evaluator.config.execute)
        there = twin.safe_at(triangles, q, cap=2 * CLEARANCE_CAP_M)
        assert there == pytest.approx(float(s.margin[row, SAFE]), abs=1e-4)
        samples = motion_samples(path, times, evaluator.config.execute, step_rad=1 / 20)
        assert min(twin.safe_at(triangles, x, cap=0.2) for x in samples[::3]) >= float(s.margin[row, SAFE]) - 1e-4
        twin.safe_at(triangles, q)  # puts the model there
        name = evaluator.scene.part_names[int(s.witness_part[row, 1])]
        assert twin.distance_to(name, s.witness_point[row]) == pytest.approx(float(s.margin[row, SAFE]), abs=1e-4)


def test_a_safety_margin_is_taken_off():
    _, problems, s = scored()
    scene = default_evaluator().scene
    active = torch.ones(N, dtype=torch.bool)
    nearest = hand_distance(scene, problems.body_poses, as_planned(problems), active)
    found = s.path_len > 0
    plain, strict = (metrics.safe(evidence(active, moves=found, nearest=nearest, safe_margin_m=m)) for m in (0.0, 0.02))
    assert torch.equal(plain.margin[found], s.margin[found, SAFE])
    torch.testing.assert_close(strict.margin[found], plain.margin[found] - 0.02)
    assert int((strict.margin > 0).sum()) < int((plain.margin > 0).sum())


def test_a_margin_says_whether_it_is_a_distance_a_bound_or_a_cap():
    """Every margin of whole trials and of the pose stage, by what else is known of the row."""
    batch, _, s = scored()
    scene = default_evaluator().scene
    p = default_evaluator().score(batch.T_obj_ee, batch.T_world_ee, batch.trials, "pose")
    grasp = close_gripper(scene.grasp_tables, batch.T_obj_ee, batch.trials.object_index)
    distance, bound, cap = (int(k) for k in (MarginKind.DISTANCE, MarginKind.BOUND, MarginKind.CAP))
    for scores in (s, p):
        margin, kind = scores.margin, scores.margin_kind
        assert torch.equal(kind == int(MarginKind.NONE), ~scores.evaluated) and torch.equal(margin.isnan(), kind == 0)
        cuts = grasp.cut_m < torch.where(grasp.empty, -1.0, grasp.margin_m + 1e-7)
        expected = torch.where(cuts, torch.where(grasp.cut_m < 0, bound, distance), distance)
        expected[cuts & (grasp.cut_m == CUT_CAP_M)] = cap
        expected[~cuts & grasp.empty] = cap
        assert torch.equal(kind[:, STABILITY].int(), expected.int())
        assert (kind[:, REACH] == distance).all()
        missed = scores.plan_reason == int(PlanReason.IK_UNREACHABLE)
        by_length = {
            PLAN: ~missed & margin[:, PLAN].isfinite(), AFFORDANCE: scores.evaluated[:, AFFORDANCE],
            SAFE: scores.evaluated[:, SAFE],
        }  # fmt: skip
        for column, rows in by_length.items():
            m, k = margin[rows, column], kind[rows, column]
            assert torch.equal(k == cap, m >= 0.05) and torch.equal(k == bound, m < 0)
            assert torch.equal(k == distance, (m >= 0) & (m < 0.05))
            assert (k == cap).any() and (k == distance).any()
        assert (kind[margin.isinf()] == cap).all()
        assert (kind[missed & margin[:, PLAN].isfinite(), PLAN] == distance).all()
        finite = margin[:, PLAN][(kind[:, PLAN] != cap) & (kind[:, PLAN] != 0)].double()
        assert scores.scalars()["margin_m/plan"] == pytest.approx(float(finite.mean()))
    assert (p.margin_kind[:, PLAN] == bound).any() and (p.margin_kind[:, SAFE] == bound).any()


def test_a_clearance_is_a_bound_below_0_and_no_length_from_its_cap_on_or_where_it_is_minus_infinity():
    least = torch.finfo(torch.float32).min
    number = torch.tensor([-torch.inf, least, -0.001, 0.0, 0.0499, 0.05, 1.0, torch.inf])
    held = SimpleNamespace(active=number > -1, grasp=SimpleNamespace(width_m=number, opening_m=number, shift_m=number))
    everywhere, (distance, bound, cap) = torch.ones(8, dtype=torch.bool), list(MarginKind)[1:]
    for to, expected in ((0.05, [cap, bound, bound, distance, distance, cap, cap, cap]), (0.0, [distance] * 8)):
        criteria = [metrics.Criterion(number, everywhere, cap=to) for _ in CRITERIA]
        found = verdict(REGISTRY, criteria, held, None)["margin_kind"]  # type: ignore[arg-type]
        assert all(column.tolist() == expected for column in found.T), to


def test_up_is_where_a_vessels_opening_points_in_the_world_and_nowhere_without_one():
    scene, turns = default_evaluator().scene, trimesh.transformations.random_rotation_matrix
    T = np.stack([turns(np.random.default_rng(k).random(3)) for k in range(len(scene.objects))])
    held = SimpleNamespace(objects=torch.arange(len(T), dtype=torch.int32))
    given: Any = SimpleNamespace(scene=scene, held=held, T_world_obj=torch.from_numpy(T).float())
    expected = [np.full(3, np.nan) if o.up is None else x[:3, :3] @ o.up for x, o in zip(T, scene.objects, strict=True)]
    np.testing.assert_allclose(metrics.Evidence.up.fget(given), np.stack(expected), atol=1e-6)
    assert 0 < np.isnan(expected).any(1).sum() < len(T)


def test_slack_takes_off_what_is_apart_and_what_is_deep_but_never_makes_an_overlap_of_a_gap():
    distance = torch.tensor([0.03, 0.001, 0.0, -0.001, -0.03, torch.nan])
    found = bound_with_slack(distance, torch.full_like(distance, 0.002))
    expected = torch.tensor([0.028, -1e-6, -1e-6, -1e-6, -0.028, torch.nan])
    torch.testing.assert_close(found, expected, equal_nan=True)


def test_a_criterion_of_some_objects_is_evaluated_where_it_is_and_the_object_is_one_of_them(monkeypatch):
    """Neither alone: what a failed stage leaves open stays open for the objects that the criterion concerns."""
    evaluated = torch.tensor([True, True, False, False])
    rule = SimpleNamespace(rule=lambda e: metrics.Criterion(torch.zeros(4), evaluated))
    monkeypatch.setitem(sys.modules, "a_rule", rule)
    every = CriterionEntry("every", "f_every", "F_every", 5, "#666666", SPLITS, True, function="a_rule:rule")
    cups = every._replace(name="cups", applies=lambda o: o == "cup")
    monkeypatch.setattr(metrics, "criteria_of", lambda asks: (every, cups))
    for entry in (every, cups):
        monkeypatch.setitem(CRITERION._things, entry.name, entry)
    scene = SimpleNamespace(objects=("cup", "hammer"), benchmark=SimpleNamespace(asks=()))
    held = SimpleNamespace(objects=torch.tensor([0, 1, 0, 1], dtype=torch.int32), active=evaluated)
    found = metrics.judge(SimpleNamespace(scene=scene, held=held))
    assert [x.evaluated.tolist() for x in found] == [evaluated.tolist(), [True, False, False, False]]
