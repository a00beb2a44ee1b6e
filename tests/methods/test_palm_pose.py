"""Directions, frames and rolls of handover poses, on hands and axes made by hand."""

import math

import numpy as np
import pytest
import torch

from r2h_batch.bodies.robot import load_robot
from r2h_batch.judge.ik import solve_ik
from r2h_batch.methods.placing import (
    approach_frames,
    first_true,
    least,
    poses_at,
    reachable,
    roll_angles,
    rolled,
    turned_inward,
)

X, Y, Z = (torch.tensor([v], dtype=torch.float64) for v in ([1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]))


def close(a: torch.Tensor, b: torch.Tensor) -> bool:
    return bool((a.double() - b.double()).abs().max() < 1e-12)


def is_rotation(R: torch.Tensor) -> bool:
    R = R.reshape(-1, 3, 3)
    return close(R @ R.mT, torch.eye(3).expand_as(R)) and bool((torch.linalg.det(R) > 0.999).all())


def test_a_frame_has_its_approach_as_z_and_leans_its_x_towards_what_was_asked():
    (R,) = approach_frames(-Z, -X)  # the gripper at home: down, x backwards
    assert close(R[:, 2], -Z[0]) and close(R[:, 0], -X[0]) and close(R[:, 1], Y[0])
    z = torch.tensor([[1.0, 2.0, -2.0]], dtype=torch.float64)
    (R,) = approach_frames(z, -X)
    assert is_rotation(R) and close(R[:, 2], z[0] / 3)
    turns = [rolled(R[None], [a])[0, 0] for a in np.linspace(-3, 3, 61)]
    assert max(float(-t[0, 0]) for t in turns) <= float(-R[0, 0]) + 1e-12  # no other roll has x nearer to -X


@pytest.mark.parametrize("z", [X, -X, X + 1e-9 * Y])
def test_an_approach_along_the_asked_direction_still_gets_a_frame(z):
    R = approach_frames(z, X)
    assert is_rotation(R) and close(R[0, :, 2], z[0] / z.norm())


@pytest.mark.check
def test_rolls_turn_about_the_approach_the_smallest_turns_first():
    assert np.allclose(np.degrees(roll_angles(8)), [0, 45, -45, 90, -90, 135, -135, 180])
    R = approach_frames(torch.tensor([[0.3, -0.5, 0.8], [0.0, 1.0, 0.0]], dtype=torch.float64), -X)
    turned = rolled(R, roll_angles(8))
    assert turned.shape == (2, 8, 3, 3) and is_rotation(turned) and close(turned[:, 0], R)
    for k, angle in enumerate(roll_angles(8)):
        assert close(turned[:, k, :, 2], R[:, :, 2])
        relative = R.mT @ turned[:, k]  # a turn about z in the frame itself
        expected = torch.tensor([[math.cos(angle), math.sin(angle)]] * 2, dtype=torch.float64)
        assert close(relative[:, :2, 0], expected)
    about_x = rolled(R, [0.4], axis=0)
    assert close(about_x[:, 0, :, 0], R[:, :, 0]) and is_rotation(about_x)


@pytest.mark.parametrize("name", ["right", "left"])
def test_inward_is_towards_the_thumb_of_a_flat_mano_hand(name):
    """A flat right hand points along -x, its palm towards -y, its thumb to +z; a left one is its mirror image in x."""
    side = torch.tensor([("right", "left").index(name)], dtype=torch.int8)
    fingers = -X if name == "right" else X
    turned = turned_inward(fingers, -Y, side, 15.0)
    assert turned[0, 2] == pytest.approx(math.sin(math.radians(15))) and abs(turned[0, 1]) < 1e-15
    assert float((turned * fingers).sum()) == pytest.approx(math.cos(math.radians(15)))
    opposed = turned_inward(-fingers, -Y, side, 15.0)
    assert close(opposed, -turned)
    raised = turned_inward(fingers + 0.7 * Y, -Y, side, 15.0)  # what leaves the palm plane is laid into it first
    assert close(raised, turned)
    assert close(turned_inward(fingers, -Y, side, 0.0), fingers)


def test_the_first_true_of_each_row_and_0_where_there_is_none():
    rows = torch.tensor([[0, 1, 1], [0, 0, 0], [1, 0, 1], [0, 0, 1]], dtype=torch.bool)
    assert first_true(rows).tolist() == [1, 0, 0, 2]


def test_the_least_allowed_score_wins_and_the_first_of_equals():
    rng = np.random.default_rng(0)
    score = torch.from_numpy(rng.integers(0, 6, (200, 9)).astype(np.float64))
    allowed, usable = (torch.from_numpy(rng.random((200, 9)) < p) for p in (0.15, 0.8))
    usable[:, 0] = True
    chosen = least(score, allowed & usable, usable)
    nothing = 0
    for i in range(200):
        pool = [k for k in range(9) if allowed[i, k] and usable[i, k]]
        nothing += not pool
        pool = pool or [k for k in range(9) if usable[i, k]]
        assert int(chosen[i]) == min(pool, key=lambda k: (float(score[i, k]), k))
    assert 10 < nothing < 190


def test_poses_are_reachable_where_the_arm_has_a_solution():
    R = approach_frames(torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0]]), -X)
    T = poses_at(rolled(R, roll_angles(8)), torch.tensor([[0.42, 0.0, 0.45], [3.0, 0.0, 0.45]]))
    assert T.dtype == torch.float32 and T.shape == (2, 8, 4, 4)
    assert reachable(load_robot(), T).tolist() == [[True] * 8, [False] * 8]
    heights = torch.tensor([[[0.42, 0.0, z] for z in (0.1, 0.9, 1.2)]] * 2)
    each = poses_at(R[:, None].expand(2, 3, 3, 3), heights)
    assert torch.equal(reachable(load_robot(), each).flatten(), solve_ik(each.reshape(-1, 4, 4).contiguous()).reachable)
