"""Hands that move: strokes against their closed form, the bound of their way, the arm that follows, imported motions."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from r2h_batch import load_benchmark
from r2h_batch.base import rng
from r2h_batch.closed_loop.moving import KINDS, MovingHands, ReceiverMotion, Taken, elbow_of, minimum_jerk
from r2h_batch.data.data_sets import HandMotion
from r2h_batch.data.hand_sets import Collected, motion_file, write
from r2h_batch.scene.hand import load_hand_set
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.draw.receivers import OF_PERSON, OF_POSTURE, propose

STROKES = [k for k in KINDS if k not in ("still", "replay")]


@pytest.fixture(scope="module")
def trials():
    return load_benchmark("r2h-v1").trials(12)


def skin(scene, trials, T):
    """Points of the hands in the world, float64."""
    own = scene.hands.vertices[trials.hand_index.long()].double()[:, ::20]
    return torch.einsum("nij,nvj->nvi", T[:, :3, :3].double(), own) + T[:, None, :3, 3].double()


def test_a_stroke_is_the_polynomial_of_least_jerk_at_rest_at_both_ends():
    x = torch.linspace(0, 1, 11, dtype=torch.float64)
    assert np.allclose(minimum_jerk(x), np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])(x.numpy()), atol=1e-14)
    assert minimum_jerk(torch.tensor([-3.0, 7.0])).tolist() == [0.0, 1.0]


def moved_down(T):
    """Ten centimetres below."""
    T = T.clone()
    T[:, 2, 3] -= 0.1
    return T


@pytest.mark.check
@pytest.mark.parametrize("kind", STROKES)
def test_no_point_of_a_hand_goes_farther_than_is_said_and_motions_are_smooth(scene, trials, kind):
    trials = trials[torch.arange(0, len(trials), 5)]
    hands, goal = MovingHands.of(scene, trials, ReceiverMotion(kind)), trials.T_world_hand.roll(1, 0)
    if kind == "withdraws":
        hands.react(3.0, torch.full((len(trials),), 0.01))
    if kind == "takes":
        now, own = torch.full((len(trials),), 7.0, dtype=torch.float64), trials.hand_index.long()
        before_it = moved_down(goal)
        hands.take(
            now,
            torch.arange(len(trials)),
            Taken(before_it, goal, scene.hands.vertices[own], scene.hands.joints[own]),
        )
        assert (hands.pose(hands.taken_s - 0.5 * hands._drawn["take"]) - before_it).abs().max() < 1e-5
    before, speeds = skin(scene, trials, hands.pose(0.0)), []
    for a, b in pairwise(np.linspace(0.0, 12.0, 241).tolist()):
        after = skin(scene, trials, hands.pose(b))
        far = (after - before).norm(dim=2).amax(1)
        assert (far <= hands.travel(a, b).double() + 1e-5).all()
        speeds.append(far / (b - a))
        before = after
    speeds, end = torch.stack(speeds), hands.pose(1e3)
    # no jumps: the speed changes by no more in a step than the sharpest stroke's acceleration allows
    assert (speeds[1:] - speeds[:-1]).abs().max() < 1.5 and speeds.max() > 0.1
    assert kind != "takes" or (end - goal).abs().max() < 1e-5
    assert (end[:, :3, :3].double().det() - 1).abs().max() < 1e-5


def test_hands_stand_until_they_leave_reaching_hands_begin_before_the_body_and_pauses_stand(scene, trials):
    still = MovingHands.of(scene, trials, ReceiverMotion("still"))
    assert (still.pose(9.0) - trials.T_world_hand).abs().max() < 1e-6
    moves = MovingHands.of(scene, trials, ReceiverMotion("moves"))
    assert torch.equal(moves.pose(2.0), moves.pose(0.0)) and not torch.equal(moves.pose(8.0), moves.pose(0.0))
    reaches = MovingHands.of(scene, trials, ReceiverMotion("reaches"))
    assert torch.allclose(reaches.pose(99.0), moves.pose(99.0), atol=1e-5)  # the same place in the end
    body = reaches.people(reaches.pose(0.0))
    lengths = [(trials.receiver[:, k + 1, :3] - trials.receiver[:, k, :3]).norm(dim=1) for k in (0, 1)]
    ahead = torch.stack([trials.receiver[:, 3, 3], trials.receiver[:, 4, 3], torch.zeros(len(trials))], 1)
    level = trials.receiver[:, 0, :3] + lengths[1][:, None] * ahead
    level[:, 2] -= lengths[0]
    assert (body[:, 2, :3] - level).abs().max() < 1e-4
    hesitates = MovingHands.of(scene, trials, ReceiverMotion("hesitates"))
    begin, stroke, pause = (hesitates._drawn[k] for k in ("reacts", "stroke", "pause"))
    a, b = (hesitates.way.pose(begin + stroke + x * pause) for x in (0.01, 0.99))
    assert (a - b).abs().max() < 1e-9
    done = (a - hesitates.way.pose(0 * begin))[:, :3, 3].norm(dim=1)
    whole = (hesitates.way.pose(begin + 99) - hesitates.way.pose(0 * begin))[:, :3, 3].norm(dim=1)
    assert ((done / whole - 0.6).abs() < 0.35).all()


def test_rows_are_the_same_in_any_batch_and_differ_by_seed(scene, trials):
    for kind in STROKES:
        whole = MovingHands.of(scene, trials, ReceiverMotion(kind)).pose(4.3)
        some = MovingHands.of(scene, trials[[3, 11]], ReceiverMotion(kind)).pose(4.3)
        assert torch.equal(whole[[3, 11]], some)
        if kind != "reaches":
            assert not torch.equal(MovingHands.of(scene, trials, ReceiverMotion(kind, seed=1)).pose(99.0), whole)


@pytest.mark.parametrize("turn_deg", [20.0, 35.0])
def test_the_turn_of_a_hand_that_moves_has_the_root_mean_square_that_is_asked(scene, turn_deg):
    trials = replace(load_benchmark("r2h-v1").trials(400), receiver=None)  # hands without arms have no ranges
    hands = MovingHands.of(scene, trials, ReceiverMotion("moves", 0.1, turn_deg))
    before, after = (hands.pose(t)[:, :3, :3].double().numpy() for t in (0.0, 99.0))
    turned = np.degrees(Rotation.from_matrix(after @ before.transpose(0, 2, 1)).magnitude())
    # of 3 normal numbers a row the mean square is known to sqrt(2 / (3 n)) of it, its root to half of that
    assert abs(np.sqrt((turned**2).mean()) / turn_deg - 1) < 5 * 0.5 * np.sqrt(2 / (3 * len(turned)))


def test_a_hand_withdraws_once(scene, trials):
    near, far = torch.full((len(trials),), 0.01), torch.full((len(trials),), 0.2)
    hands = MovingHands.of(scene, trials, ReceiverMotion("withdraws"))
    hands.react(3.0, far)
    assert torch.equal(hands.pose(99.0), MovingHands.of(scene, trials, ReceiverMotion("moves")).pose(99.0))
    hands.react(4.0, near)
    times = (4.2, 4.5, 6.0, 9.0, 99.0)
    once = [hands.pose(t) for t in times]
    assert (once[1] - once[-1])[:, :3, 3].norm(dim=1).min() > 0.1
    for again in (4.1, 7.0):
        hands.react(again, near)
        assert all(torch.equal(hands.pose(t), x) for t, x in zip(times, once, strict=True))


def test_elbows_are_those_from_which_persons_are_drawn_and_arms_keep_their_lengths(scene, trials):
    """The same person and swivel with the wrist elsewhere: `propose` has the elbow."""
    n = 500
    ids, side = np.arange(n), np.arange(n) % 2
    who = rng.uniforms(rng.key_of("who"), ids, OF_PERSON, purpose=1)
    first, second = (rng.uniforms(rng.key_of(k), ids, OF_POSTURE, purpose=2) for k in ("one", "other"))
    second[[0, 1, 2, 6]] = first[[0, 1, 2, 6]]  # where they stand and look, and the swivel
    a, b = (propose(who, v, side, 0.5) for v in (first, second))
    receiver = torch.from_numpy(a.table()).double()
    for k, x in enumerate((a.shoulder, a.elbow, a.wrist)):
        receiver[:, k, :3] = torch.from_numpy(x)
    out = torch.where(torch.from_numpy(side) == 0, -1.0, 1.0).double()
    elbow = elbow_of(receiver, torch.from_numpy(b.wrist), out)
    assert np.abs(elbow.numpy() - b.elbow).max() < 1e-9 and np.abs(a.wrist - b.wrist).max() > 0.3
    hands = MovingHands.of(scene, trials, ReceiverMotion("moves", 0.3))
    waiting, moved = trials.receiver.double(), hands.people(hands.pose(99.0)).double()
    for i, j in ((0, 1), (1, 2)):
        old, new = ((x[:, j, :3] - x[:, i, :3]).norm(dim=1) for x in (waiting, moved))
        assert (old - new).abs().max() < 1e-5
    assert (hands.people(hands.pose(0.0)) - trials.receiver).abs().max() < 1e-4


def test_an_imported_motion_ends_at_the_trials_pose_and_goes_as_it_was_recorded(tmp_path, scene):
    """Written as `import hands` writes it; poses between frames against scipy's, relative to the last frame."""
    own, found, random = load_hand_set(), Collected(), np.random.default_rng(0)
    recorded = []
    for i in (0, len(own) - 1):
        turns = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.05, (40, 3)), 0))
        places = np.cumsum(random.normal(0, 0.01, (40, 3)), 0)
        T = np.tile(np.eye(4), (40, 1, 1))
        T[:, :3, :3], T[:, :3, 3] = turns.as_matrix(), places
        side, pose = int(own.side[i]), own.pose[i].numpy().astype(np.float64)
        fingers = np.tile(pose[3:], (40, 1))
        hand = HandMotion("made", side, T, fingers, own.shape[i].double().numpy(), rate_hz=20.0)
        about = Collected.row_of(hand, 30, "made", wrist=pose[:3], held_s=np.nan, mover=True)
        found.add(about, hand)
        recorded.append((turns, places))
    out = tmp_path / "hands.npz"
    write(out, found)
    small = Scene(replace(load_benchmark("r2h-v1").with_objects(scene.objects[:2]), hand_set=load_hand_set(out)))
    trials = replace(load_benchmark("r2h-v1").with_objects(small.objects), hand_set=small.hands.set).trials(
        4, splits=["S0"]
    )
    motion = ReceiverMotion.parse(f"replay:{motion_file(out)}")
    hands = MovingHands.of(small, trials, motion)
    assert (hands.pose(99.0) - trials.T_world_hand).abs().max() < 1e-5
    begin = hands.way.begin
    for row, hand in enumerate(trials.hand_index.tolist()):
        turns, places = recorded[hand]
        k = 11.3
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Slerp(np.arange(40), turns)(k).as_matrix(), places[11] + 0.3 * (places[12] - places[11])
        last = np.eye(4)
        last[:3, :3], last[:3, 3] = turns[30].as_matrix(), places[30]
        asked = trials.T_world_hand[row].double().numpy() @ np.linalg.inv(last) @ T
        there = hands.way.pose(begin + k / 20.0)[row].numpy()
        assert np.abs(there - asked).max() < 1e-5
    for a in np.linspace(0, 9, 40):
        far = (skin(small, trials, hands.pose(a + 0.07)) - skin(small, trials, hands.pose(a))).norm(dim=2).amax(1)
        assert (far <= hands.travel(a, a + 0.07).double() + 1e-5).all()
    with pytest.raises(ValueError, match="no hand"):
        MovingHands.of(scene, load_benchmark("r2h-v1").trials(2), motion)
