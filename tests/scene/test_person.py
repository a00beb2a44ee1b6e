"""A person's arm, torso and head as pieces of a hand: placed as NumPy places them in float64, and held by their bounds."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from oracle import head_of
from problems import default_evaluator, make_batch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.judge.attach import attach_object
from r2h_batch.judge.distance import HandTables, hand_distance_at
from r2h_batch.scene import Scene
from r2h_batch.scene import person as pieces_of
from r2h_batch.scene.person import HEAD_M, MADE_OF, PIECES, heads_of, with_person

N = 40


@pytest.fixture(scope="module")
def held():
    scene = default_evaluator().scene
    batch, trials = make_batch(scene, N), load_benchmark("r2h-v1").trials(N)[:N]
    return attach_object(scene, batch.T_obj_ee, batch.T_world_ee, trials, scene.config).body_poses, trials


def test_heads_are_the_capsules_that_numpy_makes_and_stand_above_the_shoulders_with_the_eyes_in_them():
    receiver = load_benchmark("r2h-v2").trials(N).receiver
    found, eyes = heads_of(receiver), pieces_of.eyes_of(receiver)
    for row, (low, high) in enumerate(each(found.double().numpy())):
        a, b, radius = head_of(receiver[row].double().numpy())
        assert np.abs(low[:3] - a).max() < 2e-7 and np.abs(high[:3] - b).max() < 2e-7
        assert low[3] == high[3] and abs(low[3] - radius) < 1e-8
        assert 0.08 < radius < 0.13 and high[2] > low[2] > float(receiver[row, 0, 2]) + radius - 0.03
        for eye in eyes[row].numpy():
            along = np.clip((eye - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            assert np.linalg.norm(eye - a - along * (b - a)) < radius + 0.01


def test_the_heads_of_other_receivers_are_given():
    """In a closed loop the arm follows the hand, and the head stays."""
    scene, trials = default_evaluator().scene, load_benchmark("r2h-v1").trials(4)
    bodies = attach_object(
        scene, make_batch(scene, 4).T_obj_ee, make_batch(scene, 4).T_world_ee, trials[:4], scene.config
    ).body_poses
    own, moved = heads_of(trials[:4].receiver), trials[:4].receiver.clone()
    moved[:, 1, :3] += 0.1
    first = with_person(scene, bodies, trials[:4].receiver, hand=False).world
    other = with_person(scene, bodies, moved, hand=False, head=own).world
    head = slice(PIECES.index("head"), None, len(PIECES))
    for name in each(("piece_center", "piece_radius", "piece_round")):
        a, b = (wp.to_torch(getattr(w, name))[head] for w in (first, other))
        assert torch.equal(a, b), name
    assert not torch.equal(own, heads_of(moved))


def test_planning_sees_a_head_that_is_larger_by_what_is_kept_from_it(held):
    """The true one is that of `heads_of`; arm, torso and hand stay as they are."""
    bodies, trials = held
    scene = default_evaluator().scene
    large = Scene(replace(load_benchmark("r2h-v1"), receiver="body", head_clearance_m=0.1))
    for hand in (False, True):
        first, other = (with_person(s, bodies, trials.receiver, hand=hand).world for s in (scene, large))
        for name, grown in each({"piece_center": 0.0, "piece_radius": 0.1, "piece_round": 0.1}.items()):
            a, b = (wp.to_torch(getattr(w, name)).reshape(N, first.n_pieces, -1) for w in (first, other))
            assert torch.equal(a[:, :-1], b[:, :-1]) and torch.allclose(b[:, -1], a[:, -1] + grown, atol=1e-6), name
    assert float(heads_of(trials.receiver)[0, 0, 3]) < 0.13


def test_what_a_person_is_made_of_is_written_down_whole():
    """Whoever adds a piece or changes the head changes this text, and with it the digests of benchmarks whose person counts."""
    assert [line.partition(":")[0] for line in MADE_OF.splitlines()] == list(PIECES)
    numbers = [f"{x:g}" for pair in HEAD_M.values() for x in pair]
    assert [w for w in MADE_OF.splitlines()[-1].split() if w[0].isdigit()] == numbers


def corners_of(receiver, T_world_hand):
    """Cores (4, 8, 3) in the hand's frame and by how much they are grown, float64."""
    shoulder, elbow, wrist, middle, half = receiver[:, :3]
    facing = np.array([receiver[3, 3], receiver[4, 3], 0.0])
    axes = np.stack([facing, np.cross([0.0, 0.0, 1.0], facing), [0.0, 0.0, 1.0]])
    signs = np.array([s[::-1] for s in itertools.product((-1.0, 1.0), repeat=3)])
    torso = middle + (signs * half) @ axes
    low, high, head = head_of(receiver)
    world = np.stack([[elbow, wrist] * 4, [shoulder, elbow] * 4, torso, [low, high] * 4])
    local = (world - T_world_hand[:3, 3]) @ T_world_hand[:3, :3]
    return local, np.array([receiver[1, 3], receiver[0, 3], 0.0, head])


@pytest.mark.parametrize("hand", [False, True], ids=["alone", "beside the hand"])
def test_pieces_are_where_the_person_is_and_lie_within_their_bounds(held, hand):
    scene, (bodies, trials) = default_evaluator().scene, held
    person = with_person(scene, bodies, trials.receiver, hand=hand)
    table = {k: wp.to_torch(getattr(person.world, k)).numpy() for k in vars(person.world)["tensors"] if k != "base"}
    own = scene.world.n_pieces if hand else 0
    pieces = own + len(PIECES)
    assert person.world.n_pieces == pieces and len(table["piece_start"]) == N * pieces
    assert vars(person.bodies)["tensors"]["hand"].tolist() == [*range(N)]
    assert person.world.points.ptr == scene.world.points.ptr  # nothing of the scene's is copied
    for row in range(N):
        T = trials.T_world_hand[row].double().numpy()
        cores, grown = corners_of(trials.receiver[row].double().numpy(), T)
        center, radius = (table[k].reshape(N, pieces, -1)[row] for k in ("piece_center", "piece_radius"))
        whole = table["hand_center"][row], table["hand_radius"][row]
        for k in range(len(PIECES)):
            at = row * pieces + own + k
            assert table["piece_blocks"][at] == 1 and table["piece_round"][at] == np.float32(grown[k])
            start = -1 - table["piece_start"][at]
            found = table["own_points"][start : start + 16].reshape(3, 16).T
            assert np.array_equal(found[:8], found[8:]) and np.abs(found[:8] - cores[k]).max() < 3e-7
            far = np.linalg.norm(found - center[own + k], axis=1).max() + grown[k]
            assert far <= radius[own + k] <= far + 3e-6
            assert np.linalg.norm(center[own + k] - whole[0]) + radius[own + k] <= whole[1]
        if hand:  # the hand's own pieces as before
            first = int(bodies.hand_index[row]) * own
            for name in ("piece_start", "piece_center", "piece_radius"):
                of_scene = wp.to_torch(getattr(scene.world, name)).numpy()[first : first + own]
                assert np.array_equal(table[name].reshape(N, pieces, -1)[row, :own], of_scene.reshape(own, -1))


def test_the_distance_from_the_hand_takes_no_persons_pieces(held):
    """Its kernels read points of the scene alone: a person's pieces would be read from wrong memory."""
    scene, (bodies, trials) = default_evaluator().scene, held
    person = with_person(scene, bodies, trials.receiver, hand=True)
    q, active = torch.zeros(N, 6), torch.ones(N, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"give those that Scene\.body_poses made"):
        hand_distance_at(scene, person, q, active)
    with pytest.raises(ValueError, match=r"give those that Scene\.body_poses made"):
        hand_distance_at(scene, bodies, q, active, hands=HandTables(person.world, scene.hand_mesh))
    reached = hand_distance_at(scene, bodies, q, active, hands=HandTables(scene.world, scene.hand_mesh))
    assert torch.isfinite(reached.distance_m).all()
