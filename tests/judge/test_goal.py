"""The pose stage: equal to the whole evaluation where both judge, and its own margins against float64 twins."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import geom_depth, hand_triangles, mujoco_scene
from planning_twins import staged
from problems import Batch, default_evaluator, make_batch
from scipy.optimize import linprog
from staging import GOAL, batch_of, staged_evaluator

from r2h_batch import load_benchmark
from r2h_batch.base import se3
from r2h_batch.config import HOME_Q, EvalConfig, ExecConfig, PlanConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.attach import attach_object
from r2h_batch.judge.goal import Goal, judge_goals
from r2h_batch.judge.grasp import attach, close_gripper
from r2h_batch.judge.ik import solve_ik
from r2h_batch.judge.planner import Planner
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot import ee_pose, forward_kinematics
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.types import CollidingPair, Outcome, PlanReason, Scores

STABILITY, PLAN, REACH, AFFORDANCE, SAFE = range(5)
LATER = (int(PlanReason.NO_PATH_IN_BUDGET), int(PlanReason.NOT_SETTLED))
"""Reasons that only a path can give."""


def perturbed(b: Batch, seed: int) -> Batch:
    """The same trials with poses a little off: more failures of every kind."""
    g = torch.Generator().manual_seed(seed)
    moved = b.T_obj_ee.clone()
    moved[:, :3, 3] += 0.01 * torch.randn(len(b), 3, generator=g)
    there = b.T_world_ee.clone()
    there[:, :3, 3] += 0.05 * torch.randn(len(b), 3, generator=g)
    return Batch(b.trials, moved, there)


def compare(b: Batch, evaluator: Evaluator) -> tuple[Scores, Scores]:
    """Both stages of a batch, after everything that has to agree was compared."""
    a = evaluator.score(b.T_obj_ee, b.T_world_ee, b.trials)
    p = evaluator.score(b.T_obj_ee, b.T_world_ee, b.trials, "pose")
    for column in (STABILITY, REACH, AFFORDANCE):
        for name in ("margin", "passed", "evaluated"):
            x, y = getattr(a, name)[:, column].contiguous(), getattr(p, name)[:, column].contiguous()
            assert x.numpy().tobytes() == y.numpy().tobytes(), (name, column)
    for name in ("trial_id", "width_m", "opening_m", "grasp_shift_m"):
        assert getattr(a, name).numpy().tobytes() == getattr(p, name).numpy().tobytes(), name
    free = p.plan_reason == int(PlanReason.OK)
    later = torch.isin(a.plan_reason, torch.tensor(LATER, dtype=torch.int8))
    assert torch.equal(a.plan_reason[~free], p.plan_reason[~free]) and torch.equal(
        a.plan_pair[~free], p.plan_pair[~free]
    )
    assert ((a.plan_reason == int(PlanReason.OK)) | later)[free].all()
    assert torch.equal(p.passed[:, PLAN], free) and not (a.passed[:, PLAN] & ~free).any()
    # what fails here fails there: a free goal keeps the hand, and without one there is no path
    assert not (a.success & ~p.success).any() and not (a.passed[:, SAFE] & ~p.passed[:, SAFE] & p.passed[:, PLAN]).any()
    assert p.passed[free, SAFE].all()
    order = torch.where(p.outcome == 0, 9, p.outcome)
    assert (torch.where(a.outcome == 0, 9, a.outcome) <= order).all()
    judged = p.outcome < int(Outcome.INVALID_INPUT)
    # a failure before any path is as far from its threshold in both, and so as near to flipping
    short = judged & ~free
    assert torch.equal(a.margin[short, PLAN], p.margin[short, PLAN])
    assert (a.margin[later, PLAN] == -torch.inf)[free[later]].all()
    assert torch.isfinite(p.margin[judged][:, [PLAN, SAFE]]).all() and torch.isfinite(p.q_goal[judged]).all()
    assert torch.equal(p.margin[judged, PLAN] > 0, p.passed[judged, PLAN])
    same = free & (a.path_len > 0) & (a.q_goal == p.q_goal).all(1)
    assert (a.margin[same, PLAN] <= p.margin[same, PLAN] + 1.01e-4).all()  # along a path located to 0.1 mm
    assert (a.margin[same, SAFE] <= p.margin[same, SAFE] + 1.1e-4).all()  # along a path to 0.2 %, here exact
    return a, p


@pytest.mark.check
def test_the_pose_stage_agrees_with_the_whole_evaluation():
    evaluator = default_evaluator().kinematic
    b = make_batch(evaluator.scene, 256, random_share=0.4)
    a, p = compare(b, evaluator)
    same = (a.path_len > 0) & (a.q_goal == p.q_goal).all(1)
    assert same.sum() > 60 and a.path.shape[1] == 32 and p.path.shape == (256, 0, 6) and not p.path_len.any()
    _, q = compare(perturbed(b, 1), evaluator)
    reasons = torch.cat([p.plan_reason, q.plan_reason]).tolist()
    assert {PlanReason.OK, PlanReason.IK_UNREACHABLE, PlanReason.IK_IN_COLLISION} <= {PlanReason(r) for r in reasons}
    assert (q.margin[:, STABILITY] < 0).any() and len(set(b.trials.object_index.tolist())) == 16


@pytest.mark.parametrize("plan", [PlanConfig(goals="one"), PlanConfig(object_collision="pieces")])
def test_other_ways_to_plan_agree_as_well(plan):
    objects = load_objects(["cup", "hammer", "pliers"])
    evaluator = Evaluator(
        load_benchmark("r2h-v1").with_objects(objects), EvalConfig(plan=plan, execute=ExecConfig(sim="none"))
    )
    compare(make_batch(evaluator.scene, 32, random_share=0.5), evaluator)


def test_collisions_at_a_singular_wrist_prove_nothing():
    """At sin q5 = 0 solutions are a line, of which two points a pair are tried: another may be free, and some are."""
    evaluator, robot, n = default_evaluator().kinematic, load_robot(), 512
    b = make_batch(evaluator.scene, n)
    rng = np.random.default_rng(2)
    q = rng.uniform([-0.9, -2.2, 0.8, -2.5, 0, -3], [0.9, -0.8, 2.0, 0.5, 0, 3], (n, 6))
    hand = b.trials.T_world_hand.clone()  # about the wrist of that posture
    hand[:, :3, 3] = torch.from_numpy(
        forward_kinematics(robot, q)[:, 4, :3, 3] + 0.08 * rng.normal(size=(n, 3))
    ).float()
    T_world_ee = torch.from_numpy(ee_pose(robot, q).astype(np.float32))
    b = Batch(replace(b.trials, T_world_hand=hand), b.T_obj_ee, T_world_ee)
    compare(b.rows(slice(0, 32)), evaluator)
    p = evaluator.score(b.T_obj_ee, b.T_world_ee, b.trials, "pose")
    singular = solve_ik(b.T_world_ee).singular
    assert singular.sum() > 500 and not (singular & (p.plan_reason == int(PlanReason.IK_IN_COLLISION))).any()
    unproven = singular & (p.plan_reason == int(PlanReason.NO_PATH_IN_BUDGET))
    assert unproven.sum() > 50 and (p.plan_pair[unproven] != 0).all()
    # the very posture that the target was made from is a solution: where that is free, "proven" would be false
    body_poses = attach_object(evaluator.scene, b.T_obj_ee, b.T_world_ee, b.trials, evaluator.config).body_poses
    free, _, _ = Planner(evaluator.scene, body_poses).check(torch.from_numpy(q.astype(np.float32)), unproven, 1)
    assert free.any()


@pytest.mark.slow
def test_a_hundred_thousand_candidates_of_all_objects_agree():
    """pytest -m slow tests/judge/test_goal.py: several minutes."""
    evaluator, seen, objects = default_evaluator().kinematic, torch.zeros(5, dtype=torch.long), set()
    for part in range(25):
        b = make_batch(evaluator.scene, 4000, seed=part, random_share=0.4)
        _, p = compare(perturbed(b, part) if part % 2 else b, evaluator)
        seen += torch.bincount(p.plan_reason.long(), minlength=5)[:5]
        objects |= set(b.trials.object_index.tolist())
    assert int(seen.sum()) == 100_000 and len(objects) == 16 and (seen[:4] > 0).all()


def test_an_overlap_costs_more_the_deeper_it_is():
    """The stick's end sinks into the table: straight down, the bound falls at a fixed rate. Hardly in is borderline."""
    rows = []
    for depth in (0.00005, *np.arange(0.0005, 0.006, 0.001)):
        T = GOAL["OBJECT_TABLE"].T_world_ee.copy()
        T[2, 3] = 0.19 - depth  # the stick reaches 0.19 m below the fingers' centre
        rows.append(GOAL["OBJECT_TABLE"].but(T_world_ee=T))
    rows.append(rows[1].but(T_world_ee=rows[1].T_world_ee + np.array([[0] * 4, [0] * 4, [0, 0, 0, 0.0105], [0] * 4])))
    s = staged_evaluator().score(*batch_of(rows), "pose")
    m = s.margin[:, PLAN].double().numpy()
    assert m[-1] == pytest.approx(0.01, abs=1e-5) and int(s.plan_reason[-1]) == PlanReason.OK
    assert (m[:-1] < 0).all() and np.allclose(np.diff(m[1:-1]), -1e-4, atol=1e-6)  # 10 mm inside a half length of 100
    s = staged_evaluator().score(*batch_of([rows[0], rows[5]]))
    assert (s.outcome == int(Outcome.PLAN)).all() and (s.plan_reason == int(PlanReason.IK_IN_COLLISION)).all()
    assert s.borderline.tolist() == [True, False] and (-s.margin[:, PLAN].double().numpy() < [7e-5, 0.00452]).all()


# --- twins ---------------------------------------------------------------------------------------------------------


class Judged:
    """A batch at the pose stage with everything that a twin needs."""

    def __init__(self, n: int, seed: int) -> None:
        self.scene = default_evaluator().scene
        b = perturbed(make_batch(self.scene, n, seed=seed, random_share=0.3), seed)
        self.batch = b
        self.scores = default_evaluator().score(b.T_obj_ee, b.T_world_ee, b.trials, "pose")
        T_obj_ee, self.T_world_ee, T_world_hand = (
            se3.orthonormalise(T).contiguous() for T in (b.T_obj_ee, b.T_world_ee, b.trials.T_world_hand)
        )
        grasp = close_gripper(self.scene.grasp_tables, T_obj_ee, b.trials.object_index)
        self.T_obj_ee_attached, self.opening_m = attach(T_obj_ee, grasp.shift_m), grasp.opening_m
        self.T_world_hand = T_world_hand
        self.goal = self.goals(T_world_hand)

    def goals(self, T_world_hand: torch.Tensor) -> Goal:
        t = self.batch.trials
        body_poses = self.scene.body_poses(
            t.object_index, t.hand_index, self.T_obj_ee_attached, T_world_hand, self.opening_m
        )
        ik = solve_ik(self.T_world_ee)
        return judge_goals(self.scene, body_poses, self.T_world_ee, ik, ik.valid, torch.ones(len(t), dtype=torch.bool))


@pytest.fixture(scope="module")
def judged() -> Judged:
    return Judged(192, 3)


def test_clearance_and_safe_of_free_goals_agree_with_mujoco_and_a_float64_mesh_distance(judged):
    s = judged.scores
    rows = torch.nonzero((s.plan_reason == int(PlanReason.OK)) & (s.margin[:, PLAN] < 0.05)).flatten().tolist()[:20]
    assert len(rows) == 20
    near = 0
    for row in rows:
        twin, q = staged(judged, row), s.q_goal[row].double().numpy()
        scene = mujoco_scene(judged.scene, twin)
        found = scene.clearances(q)
        assert float(s.margin[row, PLAN]) == pytest.approx(found.least, abs=3e-5)
        if sorted(found.distance.values())[1] > found.least + 1e-4:
            assert CollidingPair(int(s.plan_pair[row])).name.lower() == found.nearest_class
        expected = scene.safe_at(hand_triangles(judged.scene, twin), q)
        assert float(s.margin[row, SAFE]) == pytest.approx(expected, abs=3e-5)
        near += expected < 0.05
    assert near >= 3


def growth(a: np.ndarray, middle: np.ndarray, b: np.ndarray) -> float:
    """The largest fraction to which conv(a) may be shrunk about `middle` and still touch conv(b): a linear program."""
    n, m = len(a), len(b)
    A = np.zeros((4, n + m))
    A[:3, :n], A[:3, n:], A[3, n:] = -(a - middle).T, b.T, 1.0
    found = linprog(np.r_[np.ones(n), np.zeros(m)], A_eq=A, b_eq=np.r_[middle, 1.0])
    return float(found.fun)


def test_overlaps_of_object_and_hand_are_growth_distances(judged):
    """All colliding goals against linear programs: none is missed, and where object and hand decide, the number is theirs."""
    scene, goal = judged.scene, judged.goal
    rows = torch.nonzero(goal.reason == int(PlanReason.IK_IN_COLLISION)).flatten().tolist()
    balls, robot, decided = scene.hull_balls.numpy(), load_robot(), 0
    for row in rows[:30]:
        o, hand = int(judged.batch.trials.object_index[row]), int(judged.batch.trials.hand_index[row])
        ee = forward_kinematics(robot, goal.q[row].double().numpy())[6] @ scene.T_wrist_ee
        T = ee @ np.linalg.inv(judged.T_obj_ee_attached[row].double().numpy())
        a = scene.objects[o].hull_vertices.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        middle, radius = T[:3, :3] @ balls[o, :3] + T[:3, 3], float(balls[o, 3])
        H = judged.T_world_hand[row].double().numpy()
        least = np.inf
        for k in range(len(scene.hands.model.piece_names)):
            b = scene.hands.piece_points(hand, k).astype(np.float64) @ H[:3, :3].T + H[:3, 3]
            if (b.min(0) < a.max(0)).all() and (b.max(0) > a.min(0)).all():
                least = min(least, -(1 - growth(a, middle, b)) * radius)
        if least < 0:
            assert float(goal.clearance_m[row]) <= least + 2e-5
        if int(goal.body[row]) == len(scene.part_names) - 1 and int(goal.other[row]) >= 0:
            pieces = goal.pair[row]  # the pair that blocked the first branch; the witness is the deepest
            assert pieces > 0 and float(goal.clearance_m[row]) == pytest.approx(least, abs=2e-5)
            decided += 1
    assert len(rows) > 20 and decided >= 2


def test_no_overlap_is_said_to_be_deeper_than_it_is(judged):
    """Minus the clearance of every goal in collision is at most its pair's penetration depth, as Qhull has it."""
    scene, goal = judged.scene, judged.goal
    rows = torch.nonzero((goal.clearance_m < 0) & (goal.body >= 0)).flatten().tolist()[:24]
    ratio, kinds = [], set()
    for row in rows:
        twin, pair = mujoco_scene(scene, staged(judged, row)), CollidingPair(int(goal.nearest_pair[row]))
        at_home = int(goal.reason[row]) == PlanReason.START_IN_COLLISION
        twin.clearances(HOME_Q if at_home else goal.q[row].double().numpy())  # puts the model there
        other = int(goal.other[row])
        names = {CollidingPair.HAND: f"hand_{other}", CollidingPair.OBJECT_HAND: f"hand_{other}"}
        on_table = pair in (CollidingPair.TABLE, CollidingPair.OBJECT_TABLE)
        mine = scene.part_names[int(goal.body[row])].replace("object", "object_0")
        met = "table" if on_table else names.get(pair, scene.part_names[other])
        depth = geom_depth(twin.model, twin.data, twin.model.geom(mine).id, twin.model.geom(met).id)
        said = -float(goal.clearance_m[row])
        assert said <= depth + 1e-6, (row, mine, met, said, depth)
        ratio.append(said / depth)
        kinds.add(pair)
    assert len(rows) == 24 and len(kinds) >= 3 and np.median(ratio) > 0.2, (len(rows), kinds, np.median(ratio))


def test_of_branches_that_all_collide_the_goal_is_the_one_that_overlaps_least():
    """Targets around the base, where the gripper or what it holds is in the arm or in the table: each branch asked alone."""
    scene, n = default_evaluator().scene, 192
    b = make_batch(scene, n, seed=5)
    T_obj_ee, T_world_ee, away = (
        se3.orthonormalise(T).contiguous() for T in (b.T_obj_ee, b.T_world_ee, b.trials.T_world_hand)
    )
    rng = np.random.default_rng(5)
    turn, r, z = rng.uniform([0, 0.1, 0], [2 * np.pi, 0.3, 0.5], (n, 3)).T
    T_world_ee[:, :3, 3] = torch.from_numpy(np.stack([r * np.cos(turn), r * np.sin(turn), z], 1))
    away[:, 2, 3] += 3.0  # no hand is near
    grasp, ik = close_gripper(scene.grasp_tables, T_obj_ee, b.trials.object_index), solve_ik(T_world_ee)
    attached = attach(T_obj_ee, grasp.shift_m)
    body_poses = scene.body_poses(b.trials.object_index, b.trials.hand_index, attached, away, grasp.opening_m)

    def goal_of(branches: torch.Tensor) -> Goal:
        everywhere = torch.ones(n, dtype=torch.bool)
        return judge_goals(scene, body_poses, T_world_ee, ik, branches, everywhere, from_home=False)

    goal = goal_of(ik.valid)
    alone = [goal_of(ik.valid & (torch.arange(8) == k)).clearance_m for k in range(8)]
    clearance = torch.where(ik.valid, torch.stack(alone, 1), -torch.inf)
    least, rows = clearance.amax(1), goal.reason == int(PlanReason.IK_IN_COLLISION)
    torch.testing.assert_close(goal.clearance_m[rows], least[rows], atol=1.1e-5, rtol=0)  # ties: the first
    first = clearance.gather(1, ik.valid.int().argmax(1, keepdim=True)).flatten()
    later = rows & (least > first + 1e-4)
    own = torch.isin(goal.nearest_pair, torch.tensor([int(CollidingPair.SELF), int(CollidingPair.OBJECT_ROBOT)]))
    assert (later & own).sum() > 10 and (later & ~own).any()


def test_the_witness_says_how_the_clearance_changes_when_the_hand_moves(judged):
    """0.1 mm along the push, away from the other body: the clearance grows by |push| times that."""
    goal = judged.goal
    hand = (goal.body >= 0) & (goal.push.norm(dim=1) > 0.05) & (goal.reason != int(PlanReason.START_IN_COLLISION))
    hand &= (goal.clearance_m < 0.049) & (goal.clearance_m.abs() > 1e-3)
    step = 1e-4
    moved = judged.T_world_hand.clone()
    length = goal.push.norm(dim=1, keepdim=True).clamp(min=1e-9)
    moved[:, :3, 3] -= step * goal.push / length
    after = judged.goals(moved)
    same = hand & (after.slot == goal.slot) & (after.body == goal.body) & (after.other == goal.other)
    change = (after.clearance_m - goal.clearance_m) / step
    by_hand = (goal.pair == int(CollidingPair.HAND)) | (goal.pair == int(CollidingPair.OBJECT_HAND))
    free = same & (goal.clearance_m > 0)
    assert (change[free & ~by_hand].abs() < 0.01).all()  # table and self do not feel the hand
    met = same & (goal.clearance_m < 0) & (change.abs() > 0.01)
    for name, rows in (("separated", free & by_hand), ("overlapping", met)):
        assert rows.sum() > 5, name
        off = (change[rows] / length[rows, 0] - 1).abs()
        assert off.median() < 0.02 and off.quantile(0.9) < 0.1, (name, off)


def test_a_branch_that_is_free_by_a_sixth_of_a_millimetre_is_free(judged):
    """Five hands pushed towards the object until MuJoCo says how little is left: on either side of 0 that is the verdict."""
    near = judged.goal.free & (judged.goal.nearest_pair == int(CollidingPair.OBJECT_HAND))
    rows = torch.nonzero(near).flatten().tolist()[:5]
    many = [len(judged.scene.objects[int(judged.batch.trials.object_index[r])].hull_vertices) for r in rows]
    assert len(rows) == 5 and sum(n > 256 for n in many) >= 3
    ik = solve_ik(judged.T_world_ee)

    def found(shift: dict[int, float]) -> dict[int, tuple[float, torch.Tensor]]:
        """Row -> the best branch's clearance in MuJoCo C, and where the hand stands."""
        out = {}
        for row, by in shift.items():
            scene, q = scenes[row], ik.q[row][ik.valid[row]].double().numpy()
            push = judged.goal.push[row]
            there = judged.T_world_hand[row, :3, 3] + by * push / push.norm()
            scene.model.body_pos[scene.model.body("hand").id] = there.double().numpy()
            out[row] = max(scene.least(x, cap=0.03)[0] for x in q), there
        return out

    scenes = {row: mujoco_scene(judged.scene, staged(judged, row)) for row in rows}
    for sign in (1, -1):
        wanted = dict(zip(rows, sign * np.linspace(1.5e-4, 4.6e-4, 5), strict=True))
        low, high = dict.fromkeys(rows, 0.0), dict.fromkeys(rows, 0.06)
        for _ in range(12):
            middle = {row: 0.5 * (low[row] + high[row]) for row in rows}
            for row, (clear, _) in found(middle).items():
                (low if clear > wanted[row] else high)[row] = middle[row]
        T = judged.T_world_hand.clone()
        left = found(low)
        for row in rows:
            T[row, :3, 3] = left[row][1]
        goal = judged.goals(T)
        for row in rows:
            assert abs(left[row][0] - wanted[row]) < 5e-5, row
            assert bool(goal.free[row]) is (sign > 0), (row, left[row][0], float(goal.clearance_m[row]))
            if sign > 0:
                best = max(float(goal.clearance_m[row]), 0.0)
                assert best == pytest.approx(left[row][0], abs=3e-5), row
