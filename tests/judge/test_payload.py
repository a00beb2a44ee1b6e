"""The weight that a grasp carries, in closed form, against numerical integrals and against closing in a simulator."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from problems import default_evaluator, make_batch
from staging import frame

from r2h_batch import load_benchmark
from r2h_batch.base.launch import init_warp
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.grasp_physics import TORSION_M, close_in_physics
from r2h_batch.judge.payload import GRIP_N, payload
from r2h_batch.scene.objects import build_object
from r2h_batch.scene.robot import load_robot

X, Y, Z = np.eye(3)
MASSES = (0.5, 1.5, 4.0)
LEVERS = (0.0, 0.03, 0.06)


@pytest.fixture(scope="module")
def bars():
    """A bar of 60 x 40 x 60 mm, which covers the pads, with other masses and centres of mass."""
    init_warp()
    bar = build_object(trimesh.creation.box((0.06, 0.04, 0.06)).subdivide(), "bar", pieces=True)
    return [
        replace(bar, name=f"bar_{m}_{x}", mass=m, com=np.array([x, 0.0, 0.0]), inertia=np.eye(3) * m * 1e-3)
        for m in MASSES
        for x in LEVERS
    ]


def scored(objects, R):
    """The bars held at their middles with these directions of the gripper (columns) in the world."""
    n = len(objects)
    T_obj_ee = torch.eye(4).expand(n, 4, 4).clone()
    T_world_ee = torch.from_numpy(np.tile(frame(R[:, 2], R[:, 1], np.array([0.5, 0.0, 0.4])), (n, 1, 1))).float()
    trials = load_benchmark("r2h-v1").with_objects(objects).trials_with_ids(2 * torch.arange(n))
    trials = replace(trials, object_index=torch.arange(n, dtype=torch.int32))
    judge = Evaluator(load_benchmark("r2h-v1").with_objects(objects), EvalConfig(execute=ExecConfig(sim="none")))
    return judge.score(T_obj_ee, T_world_ee, trials, "pose")


def mean_radius():
    """Mean distance of a pad's points from its middle, m."""
    half = load_robot().linkage.pad_half_size
    grid = [(np.arange(400) + 0.5) / 200 - 1] * 2
    return np.hypot(*np.meshgrid(half[0] * grid[0], half[2] * grid[1])).mean()


DOWN = np.array([X, -Y, -Z]).T  # z of the gripper points down: the weight pulls the bar out along z


@pytest.mark.check
def test_lever_moment_and_factor_are_those_of_an_integral_over_the_pads(bars):
    found = payload(scored(bars, DOWN))
    radius = mean_radius()
    mass, lever = np.repeat(MASSES, len(LEVERS)), np.tile(LEVERS, len(MASSES))
    moment = mass * 9.81 * lever  # gravity along z, the lever along x
    factor = 2 * 0.8 * GRIP_N / np.hypot(mass * 9.81, moment / radius)
    # the pads are not quite at the TCP: they travel along z while they close
    assert np.allclose(found.pivot_torque_nm, moment, atol=1e-9)
    assert np.allclose(found.payload_factor, factor, rtol=1e-5)
    travel = np.sqrt(found.lever_m**2 - lever**2)
    assert np.ptp(travel) < 1e-4 and travel.max() < 0.014  # of opening: 40 mm
    assert (found.any_posture_factor <= found.payload_factor * (1 + 1e-9)).all()


def test_weight_along_the_closing_axis_turns_nothing(bars):
    found = payload(scored(bars, np.array([X, Z, -Y]).T))
    assert np.allclose(found.pivot_torque_nm, 0, atol=1e-6)
    assert (found.payload_factor > 1e5).all() and np.isfinite(found.any_posture_factor).all()


def test_a_simulator_holds_what_the_closed_form_holds_and_turns_what_it_turns(bars):
    """A pad's pressure lies on its four corners there, each with a patch of its own: it holds up to 2.3 times the moment of
    even pressure."""
    half, radius = load_robot().linkage.pad_half_size, mean_radius()
    most = (np.hypot(half[0], half[2]) + TORSION_M) / radius
    factor = payload(scored(bars, DOWN)).payload_factor
    every = np.arange(len(bars))
    T = np.tile(np.eye(4), (len(bars), 1, 1))
    closed = close_in_physics(bars, every, T, load_robot(), shake=True, shake_m_s2=0.0)
    stays = (np.degrees(closed.turned_rad) < 5) & closed.held
    assert stays[factor > 1].all() and (factor > 1).sum() >= 3
    assert not stays[factor < 1 / most].any() and (factor < 1 / most).sum() >= 2


def test_rows_that_hold_nothing_have_no_payload():
    judge = default_evaluator()
    batch = make_batch(judge.scene, 4)
    grasp = batch.T_obj_ee.clone()
    grasp[1, 0, 0] = torch.nan
    grasp[3, :3, 3] += 1.0  # a metre beside the object: the pads close on air
    found = payload(judge.score(grasp, batch.T_world_ee, batch.trials, "pose"))
    for column in (found.payload_factor, found.lever_m, found.pivot_torque_nm, found.any_posture_factor):
        assert np.isfinite(column).tolist() == [True, False, True, False]
