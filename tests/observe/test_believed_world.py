"""The world that planning believes: objects, hands and persons of it against what they are made of."""

from functools import cache

import numpy as np
import pytest
import torch
import warp as wp
from problems import default_evaluator
from rounds import each
from scipy.spatial import cKDTree

from r2h_batch.observe.believed_world import ROOM_M, believed_world
from r2h_batch.observe.estimates import believed_receiver
from r2h_batch.observe.known import known_moments
from r2h_batch.observe.sees import Sees
from r2h_batch.scene.person import PIECES, with_person
from r2h_batch.trials.noise import PredictorNoise, estimated_hand


@cache
def scene():
    return default_evaluator("r2h-v3").scene


def world(sees, n=6):
    trials = scene().benchmark.trials(n)
    return trials, believed_world(scene(), trials, Sees.parse(sees).on(scene().benchmark))


def test_a_known_object_without_errors_is_the_true_one_where_it_lies():
    trials, found = world("cell-v1,noise=0,model=known,object=none")
    assert torch.equal(found.row, torch.arange(len(trials)))
    rest = known_moments(scene()).of(trials)
    assert torch.allclose(found.T_world_obj.float(), rest, atol=1e-6)
    for i in each(range(len(trials))):
        own = found.scene.objects[int(found.trials.object_index[i])]
        true = scene().objects[int(trials.object_index[i])]
        assert cKDTree(own.vertices).query(true.vertices)[0].max() < 1e-5


@pytest.mark.whole(part="observe")
def test_a_completed_solid_lies_about_what_was_seen_of_the_object():
    trials, found = world("cell-v1,noise=0")
    rest = known_moments(scene()).of(trials).double().numpy()
    for i, row in enumerate(each(found.row.tolist())):
        own = found.scene.objects[int(found.trials.object_index[i])]
        true = scene().objects[int(trials.object_index[row])]
        T = found.T_world_obj[i].numpy()
        solid = own.vertices @ T[:3, :3].T + T[:3, 3]
        points = true.points @ rest[row][:3, :3].T + rest[row][:3, 3]
        assert np.median(cKDTree(points).query(solid)[0]) < 0.012
        assert np.abs(solid.mean(0) - points.mean(0)).max() < 0.05


def pieces(scene, trials):
    """By how much each piece of the persons is rounded (n, 4), and its points in the world (n, 4, 16, 3)."""
    n, eye = len(trials), torch.eye(4).repeat(len(trials), 1, 1)
    bodies = scene.body_poses(trials.object_index, trials.hand_index, eye, trials.T_world_hand, torch.zeros(n))
    world = with_person(scene, bodies, trials.receiver, hand=False).world
    points = wp.to_torch(world.own_points).reshape(n, len(PIECES), 3, 16).transpose(2, 3).double()
    T = trials.T_world_hand.double()[:, None, None]
    placed = (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]
    return wp.to_torch(world.piece_round).reshape(n, -1).numpy(), placed.numpy()


def test_hands_and_persons_stand_where_the_estimate_says_and_are_grown():
    sees = "cell-v1,noise=0.5,seed=4"
    trials, found = world(sees)
    trials = trials[found.row]
    palm, normal = (getattr(believed_receiver(scene(), trials, seed=4, noise=0.5), k) for k in ("palm", "normal"))
    own, own_normal, _ = scene().palm(found.trials.hand_index, found.trials.T_world_hand)
    assert torch.allclose(own, palm, atol=1e-5) and torch.allclose(own_normal, normal, atol=1e-5)
    true = scene().palm(trials.hand_index, trials.T_world_hand)[0]
    off = (own - true).norm(dim=1)
    assert 1e-3 < off.mean() < 0.03
    before, after = trials.receiver, found.trials.receiver
    assert torch.allclose(after[:, :4, :3] - before[:, :4, :3], (own - true)[:, None].expand(-1, 4, 3), atol=1e-6)
    assert torch.equal(after[:, :, 3], before[:, :, 3]) and torch.equal(after[:, 4], before[:, 4])
    assert found.scene.hand_room_m == ROOM_M
    (round_true, points_true), (round_seen, points_seen) = pieces(scene(), trials), pieces(found.scene, found.trials)
    arms_and_head = [PIECES.index(name) for name in ("forearm", "upper_arm", "head")]
    grown = round_seen - round_true
    assert np.allclose(grown[:, arms_and_head], ROOM_M, atol=1e-6) and not grown[:, PIECES.index("torso")].any()
    moved = points_seen - points_true - (own - true).numpy()[:, None, None]
    assert np.abs(moved[:, arms_and_head]).max() < 3e-6  # a head on a box that has grown would stand higher
    at = moved[:, PIECES.index("torso")]
    assert np.allclose(np.abs(at[..., 2]), ROOM_M, atol=3e-6)
    assert np.allclose(np.linalg.norm(at, axis=-1), 3**0.5 * ROOM_M, atol=3e-6)
    T = estimated_hand(
        scene(), trials.trial_id, trials.hand_index, trials.T_world_hand, seed=4, noise=PredictorNoise().scaled(0.5)
    )
    assert torch.allclose(T, found.trials.T_world_hand, atol=1e-5)


def test_a_trial_is_believed_alone_as_among_others():
    _, found = world("cell-v1")
    trials = scene().benchmark.trials(6)
    i = int(found.row[2])
    one = believed_world(scene(), trials[i : i + 1], Sees.parse("cell-v1").on(scene().benchmark))
    assert torch.equal(one.T_world_obj[0], found.T_world_obj[2])
    assert torch.equal(one.trials.T_world_hand[0], found.trials.T_world_hand[2])
    a, b = one.scene.objects[0], found.scene.objects[int(found.trials.object_index[2])]
    assert np.array_equal(a.vertices, b.vertices) and a.name == b.name


def test_a_grasp_is_the_same_in_the_world():
    _, found = world("cell-v1")
    T = torch.eye(4, dtype=torch.float64).repeat(len(found.row), 1, 1)
    T[:, :3, 3] = torch.tensor([0.4, -0.1, 0.2], dtype=torch.float64)
    again = found.T_world_obj @ found.grasps(T).double()
    assert torch.allclose(again, T, atol=1e-6)
