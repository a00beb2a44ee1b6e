"""The receiver's arm and torso in planning and Safe, and reported beside it: against MuJoCo C; refused without a body."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from oracle import MujocoScene, Staged, deepest_along, geom_depth
from seven import with_hulls

from r2h_batch import load_benchmark
from r2h_batch.config import CLEARANCE_CAP_M, EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.distance import NearestApproach, nearer_of
from r2h_batch.methods import fc
from r2h_batch.scene.robot_file import load_robot

PLAN, SAFE = 1, 4
FORCED = 40
"""Trials whose person is moved towards the robot: otherwise one motion in eight comes within 5 cm."""


@cache
def evaluator(receiver):
    return Evaluator(load_benchmark("r2h-v1"), EvalConfig(execute=ExecConfig(sim="none"), receiver=receiver))


@pytest.fixture(scope="module")
def asked():
    """Answers for receivers of r2h-v1, the first of them 25 cm nearer to the robot than they stood (arm and torso alone)."""
    trials = load_benchmark("r2h-v1").trials(36)
    receiver = trials.receiver.clone()
    receiver[:FORCED, :4, 0] -= 0.25
    trials = replace(trials, receiver=receiver)
    answer = fc.predict(trials, evaluator("hand").scene)
    return answer.T_obj_ee, answer.T_world_ee, trials


@pytest.fixture(scope="module")
def as_paper(asked):
    return evaluator("hand").score(*asked)


@pytest.fixture(scope="module")
def with_bodies(asked):
    return evaluator("body").score(*asked)


def twin_of(scene, trials, scores, i):
    """One trial in MuJoCo C: the robot's primitives against capsules and box, in double precision."""
    hand, receiver = (x[i].double().numpy() for x in (trials.T_world_hand, trials.receiver))
    staged = Staged(int(trials.object_index[i]), int(trials.hand_index[i]), np.eye(4), hand, float(scores.opening_m[i]))
    return MujocoScene(scene, staged, receiver=receiver)


def test_distances_at_a_posture_are_those_of_mujoco(asked):
    judge = evaluator("hand")
    posed = judge.score(*asked, stages="pose")
    near = torch.nonzero(posed.body_m < CLEARANCE_CAP_M).flatten().tolist()
    assert len(near) >= 8 and (posed.body_m[near] > 0).sum() >= 3 and (posed.body_m[near] < 0).sum() >= 3
    for i in [*near[:3], *near[-3:], 71]:
        twin = twin_of(judge.scene, asked[2], posed, i)
        found, true = float(posed.body_m[i]), twin.person_at(posed.q_goal[i].numpy())
        if true > 0:
            assert found == pytest.approx(true, abs=2e-5), i
        else:  # a bound: no more than the depth, and with one pair that meets mostly all of it
            depth = max(geom_depth(twin.model, twin.data, int(a), int(b)) for a, b in twin.pairs_with_person())
            assert 0.2 * depth < -found <= 1.002 * depth + 1e-4, (i, found, depth)


def test_what_robot_and_object_keep_from_the_head_is_taken_off_its_distance(asked):
    """Against MuJoCo's capsule of the head, swept by a sphere; a metre's third, so that many a head is the nearest."""
    kept = replace(load_benchmark("r2h-v1"), receiver="body", head_clearance_m=0.3)
    judge, plain = Evaluator(kept, EvalConfig(execute=ExecConfig(sim="none"))), evaluator("body")
    trials = replace(kept.trials(36), receiver=asked[2].receiver)
    posed, before = judge.score(*asked[:2], trials, stages="pose"), plain.score(*asked, stages="pose")
    same = (posed.q_goal == before.q_goal).all(1)
    of_head = torch.nonzero(same & (posed.body_m < before.body_m - 1e-3)).flatten().tolist()
    apart = [i for i in of_head if posed.body_m[i] > 0]
    assert len(of_head) >= 8 and len(apart) >= 2
    for i in [*apart[:3], *of_head[:5]]:
        found, q = float(posed.body_m[i]), posed.q_goal[i].numpy()
        true = twin_of(plain.scene, trials, posed, i).head_at(q, cap=0.4) - 0.3
        if found > 0:
            assert found == pytest.approx(true, abs=2e-5), i
        else:
            assert true - 1e-4 <= found < 0, (i, found, true)
        assert twin_of(judge.scene, trials, posed, i).head_at(q, cap=0.4) == pytest.approx(true, abs=2e-5) or true < 0
    goal = posed.margin[:, PLAN] < 0  # Plan and Safe too
    assert goal[[i for i in of_head if posed.body_m[i] < 0]].all()


def test_distances_of_an_arm_of_hulls_are_those_of_mujoco(asked):
    robot = with_hulls(load_robot())
    judge = Evaluator(load_benchmark("r2h-v1").on(robot), EvalConfig(execute=ExecConfig(sim="none")))
    posed = judge.score(*asked, stages="pose")
    apart = torch.nonzero((posed.body_m > 0) & (posed.body_m < CLEARANCE_CAP_M)).flatten().tolist()
    assert len(apart) >= 3
    for i in apart:
        true = twin_of(judge.scene, asked[2], posed, i).person_at(posed.q_goal[i].numpy())
        assert float(posed.body_m[i]) == pytest.approx(true, abs=2e-5), i


def test_the_smallest_distance_along_a_path_is_that_of_mujoco_sampled_finely(asked, as_paper):
    scene, rows = evaluator("hand").scene, torch.nonzero(as_paper.body_m.abs() < CLEARANCE_CAP_M).flatten().tolist()
    assert len(rows) >= 6
    for i in [*rows[:2], *rows[-2:]]:
        twin = twin_of(scene, asked[2], as_paper, i)
        path = as_paper.path[i, : int(as_paper.path_len[i])].double().numpy()
        steps = [a + s * (b - a) for a, b in pairwise(path) for s in np.linspace(0, 1, 120)]
        least = min(twin.person_at(q) for q in steps)
        found = float(as_paper.body_m[i])
        if found > 0:  # samples come as near as the path does, but for the curve between two of them
            assert -3e-5 < least - found < 2e-3, i
        else:
            assert least < 1e-3, i


def test_an_overlap_with_the_body_is_said_to_be_no_deeper_than_it_is(asked, as_paper):
    rows = torch.nonzero(as_paper.body_m < -1e-4).flatten().tolist()
    assert len(rows) >= 4
    ratio = []
    for i in rows[:4]:
        twin = twin_of(evaluator("hand").scene, asked[2], as_paper, i)
        path = as_paper.path[i, : int(as_paper.path_len[i])]
        pairs = twin.pairs_with_person()
        depth, said = deepest_along(twin.model, twin.data, pairs, path.double().numpy()), -float(as_paper.body_m[i])
        assert said <= depth + 1e-4, (i, said, depth)
        ratio.append(said / depth)
    assert np.median(ratio) > 0.1, ratio


def test_reported_only_nothing_else_of_a_row_changes(asked, as_paper):
    T_obj_ee, T_world_ee, trials = asked
    bare = evaluator("hand").score(T_obj_ee, T_world_ee, replace(trials, receiver=None))
    assert torch.isnan(bare.body_m).all() and not torch.isnan(as_paper.body_m[as_paper.path_len > 0]).any()
    for name in ("outcome", "margin", "path", "t_exec_s", "witness_point", "plan_pair"):
        assert torch.equal(getattr(bare, name).nan_to_num(), getattr(as_paper, name).nan_to_num()), name


def test_with_bodies_paths_go_round_them_and_goals_in_them_fail(asked, as_paper, with_bodies):
    met = as_paper.body_m < 0
    assert met.sum() >= 5 and as_paper.passed[met, SAFE].any()  # judged as the paper: an arm that is hit passes
    found = with_bodies.path_len > 0
    assert (with_bodies.body_m[found] > 0.0028).all()  # kept as from the hand: 3 mm, less what goals have
    assert (with_bodies.margin[found, SAFE] <= with_bodies.body_m[found] + 1e-7).all()
    assert (with_bodies.margin[found, PLAN] <= with_bodies.body_m[found] + 1e-4).all()
    assert (met & found).any() and (met & ~found).any()
    lost = (as_paper.path_len > 0) & ~found
    assert set(with_bodies.plan_pair[lost].tolist()) <= {1, 4, 0, 3} and lost.any()


def test_safe_counts_the_body_where_a_path_knows_nothing_of_it(asked, as_paper, with_bodies):
    """The same motions: the nearer of hand and body, of what was planned without the body."""
    n = len(as_paper.body_m)
    still = torch.zeros(n, dtype=torch.int32), torch.zeros(n)
    hand = NearestApproach(as_paper.margin[:, SAFE], as_paper.witness_part[:, 1], *still, as_paper.witness_point)
    new = nearer_of(hand, as_paper.body_m, torch.full((n,), 5))
    moved, met = as_paper.path_len > 0, as_paper.body_m < 0
    assert torch.equal(new.distance_m[moved], torch.minimum(hand.distance_m, as_paper.body_m)[moved])
    assert (new.distance_m[met] < 0).all() and (new.body[met] == 5).all() and torch.isnan(new.point[met]).all()
    farther = moved & (as_paper.body_m >= hand.distance_m)
    assert farther.any() and torch.equal(new.body[farther], hand.body[farther].to(new.body.dtype))


def test_a_row_alone_has_the_bits_of_its_batch(asked, with_bodies):
    T_obj_ee, T_world_ee, trials = asked
    judge = evaluator("body")
    for i in (0, 17, 65):
        one = judge.score(T_obj_ee[i : i + 1], T_world_ee[i : i + 1], trials[i : i + 1])
        for name in ("margin", "body_m", "outcome", "q_goal", "t_exec_s"):
            whole = getattr(with_bodies, name)[i : i + 1]
            assert torch.equal(getattr(one, name).nan_to_num(), whole.nan_to_num()), name
    posed = judge.score(*asked, stages="pose")
    again = judge.score(T_obj_ee[30:41], T_world_ee[30:41], trials[30:41], stages="pose")
    assert torch.equal(posed.margin[30:41].nan_to_num(), again.margin.nan_to_num())
    assert torch.equal(posed.passed[:, PLAN] | ~with_bodies.passed[:, PLAN], torch.ones_like(posed.success))


def test_without_a_body_it_is_refused(asked):
    T_obj_ee, T_world_ee, trials = asked
    with pytest.raises(ValueError, match="these trials have none; take a benchmark of people"):
        evaluator("body").score(T_obj_ee, T_world_ee, replace(trials, receiver=None))


@pytest.mark.parametrize(("place", "value"), [((1, 0), torch.nan), ((0, 0), 1e30), ((0, 3), -1.0), ((4, 1), 0.0)])
def test_a_body_with_a_number_that_is_none_is_refused_by_its_row(asked, place, value):
    T_obj_ee, T_world_ee, trials = asked
    receiver = trials.receiver.clone()
    receiver[2, *place] = value
    with pytest.raises(ValueError, match=r"trials\.receiver of row 2 has NaN, infinity or a number beyond"):
        evaluator("body").score(T_obj_ee, T_world_ee, replace(trials, receiver=receiver), "pose")
