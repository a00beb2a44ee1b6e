"""Receivers with bodies (r2h-v1): what is drawn lies within what is published, and is the same on every machine."""

import numpy as np
import pytest
import torch
from hand_twins import palms
from scipy import stats

from r2h_batch.bodies.hand import load_hand, load_hand_set
from r2h_batch.trials import receivers
from r2h_batch.trials.protocol import make_trials, trials_digest, trials_with_ids
from r2h_batch.types import Trials

N = 1500
FROZEN = "67a519ecb7e700f6284e0ee9b02eabdb2e2f2fd4f3c28ec20ef40f8601e95fa4"
"""Of 500 trials a split: r2h-v1 never changes; docs/choices.md names it too."""


@pytest.fixture(scope="module")
def people() -> Trials:
    return make_trials(trials=N, protocol="r2h-v1")


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def parts(trials: Trials) -> tuple[np.ndarray, ...]:
    assert trials.receiver is not None
    r = trials.receiver.double().numpy()
    return r[:, 0, :3], r[:, 1, :3], r[:, 2, :3], r


def test_the_functions_of_the_draw_are_sine_cosine_and_the_normal_quantile():
    degrees = np.linspace(-180, 180, 4001)
    s, c = receivers.sine_cosine(degrees)
    np.testing.assert_allclose(s, np.sin(np.radians(degrees)), atol=1e-12)
    np.testing.assert_allclose(c, np.cos(np.radians(degrees)), atol=1e-12)
    p = np.linspace(0.025, 0.975, 4001)
    np.testing.assert_allclose(receivers.normal_quantile(p), stats.norm.ppf(p), atol=1e-8)


@pytest.mark.check
def test_the_protocol_is_frozen_and_r2h_v0_is_untouched():
    assert trials_digest(make_trials(trials=500, protocol="r2h-v1")) == FROZEN
    v0 = "ae15c731e024708c9c09de56fd9102a25c0816eae951a93d4b5944d619ddda1f"
    assert trials_digest(make_trials(trials=500)) == v0 and make_trials(trials=1).receiver is None
    with pytest.raises(ValueError, match=r"r2h-v2.*allowed are r2h-v0, r2h-v1"):
        make_trials(trials=1, protocol="r2h-v2")


def test_a_person_is_the_same_alone_in_another_order_and_in_a_longer_run(people):
    assert people.receiver is not None
    rows = torch.tensor([4, 1777, 12, 2999])
    again = trials_with_ids(people.trial_id[rows], protocol="r2h-v1")
    assert again.receiver is not None and torch.equal(again.receiver, people.receiver[rows])
    assert torch.equal(again.T_world_hand, people.T_world_hand[rows]) and torch.equal(
        again.hand_index, people.hand_index[rows]
    )


def test_arms_have_the_lengths_of_the_survey_and_half_the_people_are_women(people):
    shoulder, elbow, wrist, r = parts(people)
    upper, lower = (np.linalg.norm(x, axis=1) for x in (elbow - shoulder, wrist - elbow))
    # 5th percentile of women to 95th of men, ANSUR II's own tables (not mean and sd)
    assert 0.896 * 0.283 - 2e-3 < upper.min() < 0.896 * 0.29 and 0.896 * 0.36 < upper.max() < 0.896 * 0.365 + 2e-3
    assert 0.218 - 2e-3 < lower.min() < 0.224 and 0.289 < lower.max() < 0.295 + 2e-3
    thick = 2 * np.pi * r[:, 0, 3]  # of a flexed upper arm: the sexes overlap little
    assert thick.min() > 0.254 and thick.max() < 0.418
    woman = stats.norm(0.3056, 0.0308).pdf(thick) > stats.norm(0.3581, 0.0346).pdf(thick)
    assert 0.4 < woman.mean() < 0.6
    standing = 2 * r[:, 4, 2] < 0.46  # hip to shoulder 0.38 m in the mean; seat to shoulder 0.59
    assert 1 - standing.mean() == pytest.approx(receivers.SEATED, abs=0.04)
    top = r[standing, 3, 2] + r[standing, 4, 2] + 0.74 - 0.025  # above the floor, without shoes
    assert 1.242 - 5e-3 < top.min() < 1.29 and 1.49 < top.max() < 1.546 + 5e-3


def test_joints_are_within_their_ranges(people):
    shoulder, elbow, wrist, _ = parts(people)
    bent = angle(elbow - shoulder, wrist - elbow)
    assert bent.min() >= 30 - 0.01 and bent.max() <= 100.01 and bent.min() < 33 and bent.max() > 97
    hands, rows = load_hand_set(), people.hand_index.long()
    joints = load_hand().pose(hands.pose, hands.shape, hands.side).joints.double()[rows].numpy()
    T = people.T_world_hand.double().numpy()
    world = np.einsum("nij,nkj->nki", T[:, :3, :3], joints) + T[:, None, :3, 3]
    np.testing.assert_allclose(world[:, 0], wrist, atol=1e-6)  # the forearm ends in the hand's wrist
    _, palm = palms(people)
    along = world[:, 4] - world[:, 0]
    along -= (along * palm).sum(1, keepdims=True) * palm
    off = angle(along, wrist - elbow)
    assert off.max() <= np.degrees(np.arccos(np.cos(np.radians(40)) * np.cos(np.radians(20)))) + 0.1
    assert 8 < np.median(off) < 20
    # supination: of the palm about the forearm from facing the body's middle, the thumb's side up
    forearm = (wrist - elbow) / np.linalg.norm(wrist - elbow, axis=1, keepdims=True)
    upper = elbow - shoulder
    thumb = (upper * forearm).sum(1, keepdims=True) * forearm - upper
    thumb /= np.linalg.norm(thumb, axis=1, keepdims=True)
    left = hands.side.numpy()[rows] == 1
    inwards = np.where(left[:, None], -1.0, 1.0) * np.cross(thumb, forearm)
    turn = np.degrees(np.arctan2((palm * thumb).sum(1), (palm * inwards).sum(1)))
    assert np.percentile(turn, 1) > -25 and np.percentile(turn, 99) < 85


def test_palms_lie_in_the_set_of_r2h_v0_and_arms_keep_off_body_and_table(people):
    c, n = palms(people)
    _, elbow, wrist, r = parts(people)
    far = np.hypot(c[:, 0], c[:, 1])
    assert far.min() > 0.45 - 1e-5 and far.max() < 0.80 + 1e-5 and c[:, 2].min() > 0.1 - 1e-5 and c[:, 2].max() < 0.6001
    to_robot = angle(n, -c * [1, 1, 0])
    assert (np.minimum(to_robot, angle(n, np.tile([0.0, 0, 1], (len(n), 1)))) < 75.01).all() and to_robot.max() < 120.01
    t = np.linspace(0, 1, 33)[None, :, None]
    points = elbow[:, None] + t * (wrist - elbow)[:, None]
    low, high = np.array([-0.5, -0.6, -0.05]), np.array([0.45, 0.6, 0.0])
    gap = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=2).min(1)
    assert (gap > r[:, 1, 3] - 0.003).all()
    d = points - r[:, None, 3, :3]
    ahead = d[..., 0] * r[:, None, 3, 3] + d[..., 1] * r[:, None, 4, 3]
    aside = d[..., 1] * r[:, None, 3, 3] - d[..., 0] * r[:, None, 4, 3]
    depth = (r[:, None, 4, :3] - np.abs(np.stack([ahead, aside, d[..., 2]], 2))).min(2)
    assert depth.max() < 0.01  # between the points that were asked
    assert (r[:, 3, 0] - r[:, 4, 0] > 0.45 + 0.049).all()  # chests stand beyond the table's edge
    faces = angle(np.c_[r[:, 3, 3], r[:, 4, 3], np.zeros(len(r))], -r[:, 3, :3] * [1, 1, 0])
    assert faces.max() <= 20.01
