"""The friction program against closed forms."""

import numpy as np
import pytest
from rounds import each
from transfer_twin import Contact
from transfer_twin import carried as other

from r2h_batch.closed_loop.transfer.friction import PadContacts, carried

N, MU, R = 30.0, 0.8, 0.005


def two_pads(lean_deg: float = 0.0, press_n: float = N) -> PadContacts:
    """One contact of each pad in the middle of a bar of 40 mm, with normals that lean against the closing axis."""
    lean = np.radians(lean_deg)
    normal = np.array([[0.0, np.cos(lean), np.sin(lean)], [0.0, -np.cos(lean), np.sin(lean)]])
    force = press_n * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    return PadContacts(np.array([0, 1]), np.array([[0.0, -0.02, 0.0], [0.0, 0.02, 0.0]]), normal, force)


@pytest.mark.parametrize("lever_m", [0.0, 0.004, 0.02])
@pytest.mark.parametrize("radius_m", [0.0025, 0.005, 0.008])
def test_two_opposite_contacts_carry_what_their_ellipses_allow(lever_m, radius_m):
    """A weight W at a lever l off the closing axis: each patch carries W / 2 and W l / 2, so that
    (W / 2 mu N)^2 (1 + (l / r)^2) = 1."""
    weight = np.array([0.0, 0.0, -10.0])
    com = np.array([lever_m, 0.0, 0.0])
    found = carried(two_pads(), com, weight, friction=MU, torsion_m=radius_m)
    exact = 2 * MU * N / 10.0 / np.hypot(1.0, lever_m / radius_m)
    assert 0.97 * exact < found <= exact * (1 + 1e-6)


def test_without_friction_nothing_is_carried():
    found = carried(two_pads(), np.zeros(3), np.array([0.0, 0.0, -1.0]), friction=0.0, torsion_m=R)
    assert found == pytest.approx(0.0, abs=1e-9)


def test_the_squeeze_alone_slips_off_faces_that_lean_more_than_friction_holds():
    """Coulomb's angle is atan(0.8) = 38.66 degrees."""
    weight = np.array([0.0, 0.0, -1e-6])
    assert carried(two_pads(38.0), np.zeros(3), weight, friction=MU, torsion_m=R) >= 1.0
    assert np.isnan(carried(two_pads(39.5), np.zeros(3), weight, friction=MU, torsion_m=R))


def test_a_pad_that_does_not_press_carries_nothing():
    weight = np.array([0.0, 0.0, -1.0])
    assert two_pads(press_n=0.0).pads() == 0
    assert np.isnan(carried(two_pads(press_n=0.0), np.zeros(3), weight, friction=MU, torsion_m=R))


def test_another_program_says_the_same_of_the_same_contacts():
    """`transfer_twin` spreads points over the cone's ball instead; both polytopes are some percent smaller than the cone."""
    draw, compared = np.random.default_rng(8), 0
    for _ in each(range(12)):
        side = np.array([0, 0, 1, 1, 1])
        lean = np.c_[draw.normal(0, 0.25, 5), np.where(side == 0, 1.0, -1.0), draw.normal(0, 0.25, 5)]
        normal = lean / np.linalg.norm(lean, axis=1, keepdims=True)
        at = np.c_[draw.uniform(-0.011, 0.011, 5), np.where(side == 0, -0.02, 0.02), draw.uniform(-0.018, 0.018, 5)]
        force = np.c_[draw.normal(0, 2, 5), np.where(side == 0, 13.0, -26 / 3), draw.normal(0, 2, 5)]
        weight, com = 4.0 * normal[0] + draw.normal(0, 2, 3), draw.normal(0, 0.01, 3)
        mine = carried(PadContacts(side, at, normal, force), com, weight, friction=MU, torsion_m=R)
        own = [Contact(s == 0, a, n, f) for s, a, n, f in zip(side, at, normal, force, strict=True)]
        found = other(own, com, weight)
        assert np.isnan(mine) == np.isnan(found)
        if np.isfinite(mine):
            compared += 1
            assert found == pytest.approx(mine, rel=0.04)
    assert compared > 6
