"""Capacities of grasps: closed forms, and grasps of the held-out set."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from r2h_batch.scene.hand import load_hand
from r2h_batch.scene.objects import load_objects
from r2h_batch.trials.holding.capacity import (
    GRIP_BASE_N,
    MOST_GRIP_N,
    SAFETY,
    capacity_of,
    usual_grips,
)
from r2h_batch.trials.holding.held_out import GRAVITY, load_held_out

HALF = 0.03
PINCH = np.array([[HALF, 0, 0], [-HALF, 0, 0]]), np.array([[1.0, 0, 0], [-1, 0, 0]])


@pytest.mark.check
@pytest.mark.parametrize("friction", [0.3, 0.6])
def test_a_pinch_of_two_points_has_its_closed_form(friction):
    total, capacity = capacity_of(*PINCH, np.zeros(6), friction)
    assert total == GRIP_BASE_N
    # along the pinch one point may press alone; across it both rub; about it a point resists nothing
    closed = [1.0, friction, friction, 0.0, friction * HALF, friction * HALF]
    assert capacity == pytest.approx(closed, abs=1e-9)


def test_a_load_is_carried_by_the_least_grip_and_a_margin_and_a_pinch_cannot_carry_a_moment_about_itself():
    weight, friction = 6.0, 0.5
    total, capacity = capacity_of(*PINCH, np.array([0, 0, weight, 0, 0, 0.0]), friction)
    least = weight / friction
    assert total == pytest.approx(max(SAFETY * least, GRIP_BASE_N + 5 * weight))
    # what is left of the friction, and the load's own part
    assert capacity[2] == pytest.approx((total * friction - weight + weight) / total)
    about = np.array([0, 0, weight, 0.1, 0, 0])
    assert capacity_of(*PINCH, about, friction) == (0.0, pytest.approx(np.zeros(6)))
    heavy = np.array([0, 0, 1.01 * MOST_GRIP_N * friction, 0, 0, 0])
    assert capacity_of(*PINCH, heavy, friction)[0] == 0.0


def test_capacities_turn_with_the_axes_of_the_contacts():
    R = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    arm, normal = PINCH
    _, straight = capacity_of(arm, normal, np.zeros(6), 0.6)
    _, turned = capacity_of(arm @ R.T, normal @ R.T, np.zeros(6), 0.6)
    assert turned == pytest.approx(straight[[1, 0, 2, 4, 3, 5]], abs=1e-9)


def test_held_out_grasps_that_carry_the_object_withstand_more_than_its_weight():
    objects = load_objects(["hammer", "cup"])
    held_out = load_held_out(objects)
    carries = held_out.grip_n[:, 2] < 20.0
    of = [torch.nonzero(carries & (held_out.grasps.object_index == k))[:2, 0] for k in (0, 1)]
    rows = torch.cat(of).numpy()
    grips = usual_grips(held_out, objects, rows, np.repeat(GRAVITY[2:3], len(rows), axis=0))
    index = held_out.grasps.object_index.numpy()[rows]
    weight = np.array([float(o.mass) * 9.81 for o in objects])[index]
    assert (grips.total_n > 0).all() and (grips.total_n <= MOST_GRIP_N).all()
    assert (grips.capacity[:, 2] * grips.total_n >= weight - 1e-6).all()
    assert load_hand() is held_out.grasps.hand
