"""Capacities of grasps: closed forms, scipy's linprog, and grasps of the held-out set."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation
from usual_grips import usual_grips

from r2h_batch import load_benchmark
from r2h_batch.data.people import people_hand
from r2h_batch.scene.hand import load_hand
from r2h_batch.scene.objects import load_objects, turned
from r2h_batch.trials.holding import capacity as programs_of
from r2h_batch.trials.holding import held_out as sampled
from r2h_batch.trials.holding.capacity import (
    FORM,
    GRIP_BASE_N,
    MOST_GRIP_N,
    SAFETY,
    Withstood,
    capacities,
)
from r2h_batch.trials.holding.contact_forces import ContactForces
from r2h_batch.trials.holding.held_out import FRICTION, GRAVITY, friction_edges, grip_forces, load_held_out

HALF = 0.03
PINCH = np.array([[HALF, 0, 0], [-HALF, 0, 0]]), np.array([[1.0, 0, 0], [-1, 0, 0]])


def capacity_of(arm, normal, held, friction):
    """One load of `capacity.capacity_of`."""
    total, found = programs_of.capacity_of(arm, normal, held[None], friction)
    return total[0], found[0]


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
    slippery, _ = capacity_of(*PINCH, np.array([0, 0, weight, 0, 0, 0.0]), 0.1)
    assert slippery == pytest.approx(SAFETY * weight / 0.1) and slippery < MOST_GRIP_N
    about = np.array([0, 0, weight, 0.1, 0, 0])
    assert capacity_of(*PINCH, about, friction) == (0.0, pytest.approx(np.zeros(6)))
    assert np.array_equal(
        programs_of.capacity_of(*PINCH, np.stack([about, 0 * about]), friction)[0], [0.0, GRIP_BASE_N]
    )
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
    every = Withstood.of(objects, load_hand())
    for k, down in enumerate(GRAVITY):
        pulled = usual_grips(held_out, objects, rows, np.repeat(down[None], len(rows), axis=0))
        assert np.array_equal(pulled.total_n, every.total_n[rows, k].astype(np.float64))
        assert np.array_equal(pulled.capacity, every.capacity[rows, k].astype(np.float64))
    assert np.ptp(every.capacity[rows], axis=1).max() > 0.01  # directions differ


def least_and_most(edges, load, total=None):
    """scipy's linprog: the least sum of normal forces that carries a load, inf: none. With `total`: how far the load may
    grow along each axis, less of both signs."""
    n = edges.shape[1]
    if total is None:
        made = linprog(np.ones(n), A_eq=edges, b_eq=load, method="highs")
        return made.fun if made.status == 0 else np.inf
    found = []
    for axis in np.concatenate([np.eye(6), -np.eye(6)]):
        most = {"A_ub": np.r_[np.ones(n), 0.0][None], "b_ub": [total]}
        made = linprog(np.r_[np.zeros(n), -1.0], A_eq=np.c_[edges, -axis], b_eq=load, **most, method="highs")
        assert made.status == 0
        found.append(-made.fun)
    return np.reshape(found, (2, 6)).min(0)


@pytest.mark.parametrize("contacts", [1, 2, 3, 12, 60])
def test_programs_over_contacts_are_linprogs(contacts):
    """Random contacts of an ellipsoid, and two rows of the same ones; loads that few of them carry."""
    rng = np.random.Generator(np.random.Philox(key=contacts))
    normal = rng.normal(size=(contacts, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    edges = friction_edges(normal * [0.02, 0.03, 0.07], -normal, FRICTION)
    edges = np.repeat(edges, 2, axis=1) if contacts == 12 else edges
    loads = rng.normal(size=(8, 6)) * [3, 3, 3, 1, 1, 1]
    loads[0], loads[1] = 0.0, edges[:, :3].sum(1)
    programs = ContactForces(edges)
    least, basis = programs.carry(loads, 200.0)
    expected = np.array([least_and_most(edges, load) for load in loads])
    carried = expected <= 200.0
    assert (np.isfinite(least) == carried).all() and carried.sum() >= 1
    assert least[carried] == pytest.approx(expected[carried], abs=1e-6)
    total = 1.3 * least[carried] + 5.0
    most = programs.withstand(loads[carried], total, basis[carried])
    twin = [least_and_most(edges, load, t) for load, t in zip(loads[carried], total, strict=True)]
    assert most == pytest.approx(np.array(twin), abs=1e-6)
    assert contacts < 12 or (carried.sum() == 8 and (most > 0.1).all())


@pytest.mark.parametrize(
    "name, hand", [("bowl", load_hand), ("pliers", load_hand), ("cup", people_hand), ("hammer_04", people_hand)]
)
def test_stored_capacities_are_those_of_the_programs_again_and_of_linprog(name, hand, monkeypatch):
    def asked(*args):
        raise AssertionError("computed")

    monkeypatch.setattr(programs_of, "of_held_out", asked)
    (model,) = load_objects([name])
    held_out = load_held_out((model,), hand())
    stored = Withstood.of((model,), held_out.grasps.hand)
    rows = np.arange(5, len(held_out.grip_n), 170)
    skin = held_out.grasps[torch.from_numpy(rows)].vertices.numpy()
    made = capacities(model, skin, held_out.grasps.hand)
    forces = grip_forces(model, skin[:1], held_out.grasps.hand)
    assert forces == pytest.approx(held_out.grip_n[rows[:1]].numpy(), rel=1e-5)
    for field in FORM:
        assert getattr(stored, field)[rows] == pytest.approx(made[field], rel=1e-6, abs=1e-6), field
    carries = (stored.total_n > 0) == np.isfinite(held_out.grip_n.numpy())
    assert carries.mean() > 0.9  # the rest: friction needs more than MOST_GRIP_N, or contacts at the very cutoff


@pytest.mark.whole(part="trials")
def test_hands_on_all_objects_of_the_default_benchmark_are_shipped_with_what_they_withstand(monkeypatch):
    def asked(*args, **words):
        raise AssertionError("sampled at first use")

    monkeypatch.setattr(sampled, "sample_held_out", asked)
    monkeypatch.setattr(programs_of, "of_held_out", asked)
    benchmark = load_benchmark()
    held_out = load_held_out(benchmark.objects, people_hand())
    every = Withstood.of(benchmark.objects, held_out.grasps.hand)
    per_object = np.bincount(held_out.grasps.object_index.numpy(), minlength=len(benchmark.objects))
    assert len(per_object) == 96 and per_object.min() > 100 and len(every.total_n) == per_object.sum()


def test_a_turned_object_has_the_capacities_of_its_own_frame():
    objects = load_objects(["hammer"])
    R = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    rows, down = np.array([3, 77, 300]), np.repeat(GRAVITY[2:3], 3, axis=0)
    own = usual_grips(load_held_out(objects), objects, rows, down)
    other = (turned(objects[0], R),)
    found = usual_grips(load_held_out(other), other, rows, down @ R.T)
    assert np.array_equal(found.capacity, own.capacity) and np.array_equal(found.total_n, own.total_n)
    assert found.center == pytest.approx(own.center @ R.T) and found.axes == pytest.approx(np.stack([R] * 3))


def test_capacities_of_a_users_object_are_kept_for_its_hand_its_mesh_and_its_mass(monkeypatch):
    """An empty store: what differs in anything that decides the figures has a key of its own."""
    keys = []

    def kept(folder, key, make, form):
        keys.append((folder, key))
        return {
            name: np.zeros([1 if n == "holds" else n for n in spec.shape], spec.dtype) for name, spec in form.items()
        }

    monkeypatch.setattr(programs_of, "cached", kept)
    (cup,) = load_objects(["cup"])
    heavy, heavier = (replace(cup, name="own", mass=cup.mass + more) for more in (0.123, 0.124))
    for hand in (load_hand(), people_hand()):
        for own in (heavy, heavier):
            assert Withstood.of([own], hand).capacity.shape == (1, 6, 6)
    assert len(set(keys)) == 4 and {folder for folder, _ in keys} == {"capacity"}
