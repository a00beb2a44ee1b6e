"""Trials: objects and hands by turns, the reachable set, independence, frozen draws."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from hand_twins import palms

from r2h_batch import load_benchmark
from r2h_batch.base import rng
from r2h_batch.config import HOME_Q, EvalConfig, PlanConfig, Workplace
from r2h_batch.evaluate import Evaluator
from r2h_batch.scene.hand import load_hand_set
from r2h_batch.scene.objects import build_object, load_objects
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.trials.benchmark import trials_digest
from r2h_batch.types import PlanReason, Trials

MANY = 5_000


@cache
def many() -> Trials:
    """10,000 trials, generated once."""
    return load_benchmark("r2h-v1").trials(MANY)


def test_objects_alternate_and_every_object_meets_both_hands_alike():
    trials = load_benchmark("r2h-v1").trials(120)
    assert trials.trial_id.tolist() == [2 * i for i in range(120)] + [2 * i + 1 for i in range(120)]
    assert trials.object_index[:120].tolist() == [i % 6 for i in range(120)]
    assert trials.object_index[120:].tolist() == [6 + i % 10 for i in range(120)]
    side = load_hand_set().side[trials.hand_index.long()]
    for split in (side[:120], side[120:]):
        assert split[:6].tolist() == [0, 1, 0, 1, 0, 1]
    met = Counter(zip(trials.object_index.tolist(), side.tolist(), strict=True))
    assert set(met.values()) == {10, 6} and len(met) == 32


def test_a_users_object_takes_its_turn_and_an_odd_number_of_objects_still_meets_both_hands():
    mine = build_object(trimesh.creation.box((0.05, 0.04, 0.1)), "mine", "S0")
    trials = load_benchmark("r2h-v1").with_objects((*load_objects(), mine)).trials(140, splits=["S0"])
    assert trials.object_index[:8].tolist() == [0, 1, 2, 3, 4, 5, 16, 0]
    side = load_hand_set().side[trials.hand_index.long()]
    met = Counter(zip(trials.object_index.tolist(), side.tolist(), strict=True))
    assert set(met.values()) == {10} and len(met) == 14


def test_poses_are_rigid_and_palms_lie_in_the_reachable_set():
    trials = many()
    R = trials.T_world_hand[:, :3, :3].double()
    assert (R @ R.mT - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-6 and torch.linalg.det(R).min() > 0.999
    assert torch.equal(trials.T_world_hand[:, 3], torch.tensor([0.0, 0, 0, 1]).expand(2 * MANY, 4))
    c, n = palms(trials)
    r, azimuth = np.hypot(c[:, 0], c[:, 1]), np.degrees(np.arctan2(c[:, 1], c[:, 0]))
    to_robot = np.degrees(np.arccos(np.clip(-(c[:, 0] * n[:, 0] + c[:, 1] * n[:, 1]) / r, -1, 1)))
    up = np.degrees(np.arccos(np.clip(n[:, 2], -1, 1)))
    slack = 1e-5
    assert r.min() > 0.45 - slack and r.max() < 0.80 + slack and np.abs(azimuth).max() < 50 + slack * 100
    assert c[:, 2].min() > 0.10 - slack and c[:, 2].max() < 0.60 + slack
    assert (np.minimum(to_robot, up) < 75.01).all() and to_robot.max() < 120.01
    assert r.min() < 0.455 and r.max() > 0.795 and np.abs(azimuth).max() > 49 and to_robot.max() > 119  # and fill it
    assert c[:, 2].min() < 0.105 and c[:, 2].max() > 0.595 and np.minimum(to_robot, up).max() > 74.5


def test_a_trial_is_the_same_alone_in_another_order_and_in_a_longer_run():
    trials = load_benchmark("r2h-v1").trials(500)
    row = trials.trial_id.tolist().index(37)
    alone = load_benchmark("r2h-v1").trials_with_ids(torch.tensor([37]))
    assert torch.equal(alone.T_world_hand[0], trials.T_world_hand[row])
    assert (alone.object_index[0], alone.hand_index[0]) == (trials.object_index[row], trials.hand_index[row])
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(1))
    shuffled = load_benchmark("r2h-v1").trials_with_ids(trials.trial_id[order])
    assert trials_digest(shuffled) == trials_digest(trials[order])
    longer = many()
    assert trials_digest(longer[torch.cat([torch.arange(500), MANY + torch.arange(500)])]) == trials_digest(trials)
    assert len(load_benchmark("r2h-v1").trials(0)) == 0


@pytest.mark.check
def test_the_draws_are_frozen_whatever_the_assets_are():
    """Which hand of 200 and which proposal: changes only with the protocol. (trials_digest changes with any asset.)"""
    (u,) = rng.uniforms(rng.key_of("r2h-v0"), np.arange(6), 1, purpose=0)
    assert rng.choice(u, 200).tolist() == FROZEN_HANDS
    first = rng.uniforms(rng.key_of("r2h-v0"), np.array([0, 1, 1000, 2**40]), 7, purpose=1, attempt=2)
    assert [int(x) for x in (first[[0, 6]] * 2**32).ravel()] == FROZEN_WORDS


FROZEN_HANDS = [88, 186, 42, 71, 47, 141]
FROZEN_WORDS = [3602869735, 3313465624, 2751513646, 3665985258, 2951970252, 2807896769, 1581692607, 3825774211]


def test_no_trial_starts_in_collision():
    """The robot at home, a cup in the gripper: 2,000 trials."""
    trials = load_benchmark("r2h-v1").trials(1000)
    cup = load_objects(["cup"])
    trials = Trials(trials.trial_id, torch.zeros_like(trials.object_index), trials.hand_index, trials.T_world_hand)
    evaluator = Evaluator(
        load_benchmark("r2h-v1").with_objects(cup), EvalConfig(plan=PlanConfig(rounds=(1,), shortcuts=0))
    )
    grasp = torch.eye(4).repeat(len(trials), 1, 1)
    grasp[:, 2, 3] = -0.12
    out_of_reach = torch.eye(4).repeat(len(trials), 1, 1)
    out_of_reach[:, 0, 3] = 3.0  # so that nothing is planned after the start was looked at
    reasons = evaluator.score(grasp, out_of_reach, trials).plan_reason
    assert reasons.unique().tolist() == [int(PlanReason.IK_UNREACHABLE)]
    into = Trials(trials.trial_id[:8], trials.object_index[:8], trials.hand_index[:8], trials.T_world_hand[:8].clone())
    ball, normal = palms(into)
    shift = ee_pose(load_robot(), HOME_Q)[:3, 3] - ball + 0.12 * normal
    into.T_world_hand[:, :3, 3] += torch.from_numpy(shift).float()
    reasons = evaluator.score(grasp[:8], out_of_reach[:8], into).plan_reason
    assert reasons.unique().tolist() == [int(PlanReason.START_IN_COLLISION)]


@pytest.mark.parametrize("protocol", ["r2h-v0", "r2h-v1"])
def test_a_table_that_leaves_no_place_for_a_hand_is_told_in_seconds(protocol):
    everywhere = EvalConfig(workplace=Workplace(table_center=(0.6, 0.0, 0.3), table_half=(5.0, 5.0, 5.0)))
    with pytest.raises(
        ValueError, match=r"no place for a hand where r2h-v\d draws them: .*Table \(center \(0.6, 0.0, 0.3\)"
    ):
        replace(load_benchmark(protocol), workplace=everywhere.workplace, thresholds=everywhere.thresholds).trials(
            40, splits=("S0",)
        )
