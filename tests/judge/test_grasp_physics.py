"""Closing and shaking in physics: the rest opening of convex parts is their width, and weight decides what is held."""

import re
from dataclasses import replace
from functools import cache
from operator import attrgetter
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from seven import with_jaws, with_table
from staging import frame

from r2h_batch import load_benchmark
from r2h_batch.base.launch import init_warp
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge import grasp_physics
from r2h_batch.judge.grasp import attach, close_gripper
from r2h_batch.judge.grasp_physics import close_in_physics
from r2h_batch.scene.grasp_tables import grasp_tables
from r2h_batch.scene.objects import build_object
from r2h_batch.scene.robot import Robot, drive_from_gap, gap_from_drive
from r2h_batch.scene.robot_file import load_robot

X, Y, Z = np.eye(3)
JAWS, TABLE = with_jaws(load_robot()), with_table(load_robot())


@cache
def parts():
    """Convex parts, 60 mm long or wide where the pads do not go: boxes, a cylinder, a hexagonal bar, a ball."""
    lying = trimesh.transformations.rotation_matrix(np.pi / 2, Y)
    made = {
        "box_10": trimesh.creation.box((0.06, 0.010, 0.06)),
        "box_40": trimesh.creation.box((0.06, 0.040, 0.06)),
        "box_80": trimesh.creation.box((0.06, 0.080, 0.06)),
        "cylinder_30": trimesh.creation.cylinder(0.015, 0.08, sections=64).apply_transform(lying),
        "hexagon": trimesh.creation.cylinder(0.02, 0.08, sections=6).apply_transform(lying),
        "ball_50": trimesh.creation.icosphere(subdivisions=3, radius=0.025),
    }  # fmt: skip
    init_warp()
    return tuple(build_object(m.subdivide(), name, pieces=True) for name, m in made.items())


def geometric(index: np.ndarray, T_obj_ee: np.ndarray, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Opening and attached grasps from the exact geometry."""
    T = torch.from_numpy(T_obj_ee.astype(np.float32))
    g = close_gripper(grasp_tables(parts(), robot), T, torch.from_numpy(index.astype(np.int32)))
    assert (g.margin_m >= 0).all()
    return g.opening_m.numpy(), attach(T, g.shift_m).numpy().astype(np.float64)


@pytest.mark.parametrize(
    ("off_m", "robot"),
    [(0.0, load_robot()), (0.002, load_robot()), (0.002, JAWS), pytest.param(0.002, TABLE, marks=pytest.mark.slow)],
)
def test_rigid_convex_parts_stop_the_fingers_at_their_geometric_width(off_m, robot):
    index = np.flatnonzero([p.name != "box_80" or robot.open_gap_m > 0.081 for p in parts()])
    T = np.stack([frame(Z, Y, np.array([0.0, off_m * (parts()[i].name != "box_80"), 0.0])) for i in index])
    opening, _ = geometric(index, T, robot)
    closed = close_in_physics(parts(), index, T, robot)
    # contacts are soft: pads sink in by 0.3 mm where they lie on edges or faces, by 0.6 mm at the ball's two points (jaws 0.65)
    np.testing.assert_allclose(closed.opening_m, opening, atol=6e-4 if robot == load_robot() else 7e-4)
    assert np.abs(closed.opening_m - opening)[:-1].max() < 5e-4
    # an object off the middle is pushed there
    pushed = closed.moved_m[np.array([parts()[i].name != "box_80" for i in index])]
    assert (np.abs(pushed - off_m) < 1e-3).all()


def test_without_an_object_between_them_the_pads_close_to_the_linkages_end():
    far = frame(Z, Y, np.array([0.0, 0.0, 0.5]))  # the part is half a metre behind the gripper
    closed = close_in_physics(parts(), np.array([0]), far[None], load_robot())
    assert closed.opening_m[0] == pytest.approx(float(gap_from_drive(load_robot(), 0.8)), abs=5e-4)
    assert closed.moved_m[0] < 1e-9


@pytest.mark.parametrize(
    "robot", [load_robot(), JAWS, pytest.param(TABLE, marks=pytest.mark.slow)], ids=lambda r: r.name
)
def test_a_light_part_is_held_through_the_shake_and_a_heavy_one_drops(robot):
    box = parts()[1]
    light = replace(box, mass=0.1, inertia=box.inertia * (0.1 / box.mass))
    heavy = replace(box, mass=12.0, inertia=box.inertia * (12.0 / box.mass))
    T = np.stack([frame(Z, Y, np.zeros(3))] * 2)
    closed = close_in_physics((light, heavy), np.array([0, 1]), T, robot, shake=True)
    assert closed.slip_m[0] < 1e-3 and closed.slip_m[1] > 0.05
    unshaken = close_in_physics((light,), np.array([0]), T[:1], robot)
    assert np.isnan(unshaken.slip_m).all()


def test_the_weight_pulls_out_of_the_gripper_alone_and_then_beside_a_shake_along_each_axis(monkeypatch):
    pulls, step = [], mujoco.mj_step
    monkeypatch.setattr(mujoco, "mj_step", lambda m, *more: (pulls.append(m.opt.gravity.copy()), step(m, *more)))
    close_in_physics(parts()[1:2], np.array([0]), frame(Z, Y, np.zeros(3))[None], load_robot(), shake=True)
    weight = np.array([0.0, 0.0, 9.81])  # z of the ee points from the palm to the fingertips: at home, down
    shaken = np.unique(np.sign(np.round(np.array(pulls) - weight, 6)), axis=0)
    assert any((p == weight).all() for p in pulls)
    assert {tuple(s) for s in shaken} >= {tuple(s * axis) for s in (-1, 1) for axis in np.eye(3)}


def test_rows_do_not_depend_on_their_batch_and_an_empty_one_is_empty():
    index = np.arange(3)
    T = np.stack([frame(Z, Y, np.zeros(3))] * 3)
    whole = close_in_physics(parts(), index, T, load_robot())
    with on_threads(1):
        alone = close_in_physics(parts(), index[1:2], T[1:2], load_robot())
    assert whole.opening_m[1] == alone.opening_m[0]
    assert close_in_physics(parts(), index[:0], T[:0], load_robot()).opening_m.shape == (0,)


def test_stability_by_physics_fails_what_drops_and_tells_the_slip_in_its_margin():
    box = parts()[1]
    heavy = replace(box, name="heavy", mass=12.0, inertia=box.inertia * (12.0 / box.mass))
    objects = (replace(box, mass=0.1, inertia=box.inertia * (0.1 / box.mass)), heavy)
    T = torch.from_numpy(np.stack([frame(Z, Y, np.zeros(3))] * 3).astype(np.float32))
    T[2, 0, 0] = torch.nan
    trials = load_benchmark("r2h-v1").with_objects(objects).trials_with_ids(torch.tensor([0, 2, 4]))
    trials = replace(trials, object_index=torch.tensor([0, 1, 0], dtype=torch.int32))
    config = EvalConfig(stability="physics", execute=ExecConfig(sim="none"))
    plain = Evaluator(load_benchmark("r2h-v1").with_objects(objects), replace(config, stability="geometric")).score(
        T, T, trials
    )
    shaken = Evaluator(load_benchmark("r2h-v1").with_objects(objects), config).score(T, T, trials)
    assert plain.passed[:, 0].tolist() == [True, True, False]
    assert shaken.passed[:, 0].tolist() == [True, False, False]
    assert shaken.evaluated[:, 0].tolist() == [True, True, False]
    slip = shaken.slip_m
    assert 0 <= slip[0] < 0.001 and slip[1] > 0.05
    expected = torch.minimum(plain.margin[:2, 0], 0.02 - slip[:2])  # geometry's margin counts 1 cm at most
    assert shaken.margin[:2, 0] == pytest.approx(expected, abs=1e-6) and shaken.margin[1, 0] < -0.03
    assert torch.equal(plain.margin[:2, 2], shaken.margin[:2, 2])


def closing(k: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The model of a part in the open gripper."""
    m = grasp_physics.gripper_spec(load_robot(), parts()[k], frame(Z, Y, np.zeros(3))).compile()
    d = mujoco.MjData(m)
    d.qpos[: m.nq - 7] = grasp_physics.finger_posture(load_robot(), load_robot().open_gap_m)
    return m, d


def test_parts_of_a_finger_weigh_where_they_are():
    """MuJoCo's compiler puts the mass of a body that says no place at twice the body's own: 63 mm off the driver's pivot."""
    m, d = closing(1)
    mujoco.mj_kinematics(m, d)
    for name in grasp_physics.FINGERS:
        pivot, pin = d.joint(name).xanchor, d.joint(f"{name}_pad").xanchor
        assert d.body(name).xipos == pytest.approx((pivot + pin) / 2, abs=1e-9)
        assert d.body(f"{name}_pad").xipos == pytest.approx(d.geom(name).xpos, abs=1e-9)


@pytest.mark.parametrize("k", [0, 2, 5])
def test_pads_that_press_stay_upright(k):
    """With the impedance that MuJoCo gives ties by default they lean by 0.9 to 1.2 mrad."""
    m, d = closing(k)
    m.dof_damping[-6:] = parts()[k].mass * 50  # nothing drifts off at a touch
    for gap in np.arange(load_robot().open_gap_m, 0.0, -0.15 * 0.005):
        d.ctrl[:] = drive_from_gap(load_robot(), gap)
        mujoco.mj_step(m, d, 10)
    d.ctrl[:] = drive_from_gap(load_robot(), 0.0)
    mujoco.mj_step(m, d, 700)
    for name in grasp_physics.FINGERS:
        assert abs(float(d.joint(name).qpos[0] + d.joint(f"{name}_pad").qpos[0])) < 4e-4


SECTION = (Path(__file__).resolve().parents[2] / "docs" / "choices.md").read_text("utf-8")
SECTION = SECTION.split("### Contacts of the physics test")[1].split("\n## ")[0]
SI = {"mm": 1e-3, "cm/s": 1e-2, "ms": 1e-3}
ROWS = [line.strip("|").split("|") for line in SECTION.splitlines() if "`grasp_physics." in line]


@pytest.mark.check
@pytest.mark.parametrize(("what", "value", "code"), ROWS, ids=[row[0].strip() for row in ROWS])
def test_numbers_of_the_page_are_those_of_the_code(what, value, code):
    said = []
    for group in value.split(";"):  # the unit stands behind the last of its numbers
        unit, own = "", []
        for part in reversed(group.split(",")):
            if number := re.fullmatch(r"(-?[\d.]+(?:e-?\d+)?)\s*(.*)", part.strip()):
                unit = number[2] or unit
                own.append(float(number[1]) * SI.get(unit, 1.0))
        said += own[::-1]
    names = re.findall(r"`grasp_physics\.([\w.]+)`", code)
    found = [x for name in names for x in np.atleast_1d(np.asarray(attrgetter(name)(grasp_physics), float)).tolist()]
    assert said == pytest.approx(found, rel=1e-6), what


def test_the_page_has_every_number_of_the_contacts():
    named = set(re.findall(r"`grasp_physics\.([A-Z_0-9]+)`", SECTION))
    numbers = {
        name for name, value in vars(grasp_physics).items() if name.isupper() and isinstance(value, (int, float, tuple))
    }
    assert numbers - named == {"JAW_GAINS", "SETTLE_S", "G", "DROPPED_M", "FINGERS", "HINGE", "SLIDE"} & numbers
