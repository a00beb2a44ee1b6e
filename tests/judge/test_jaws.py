"""A gripper with parallel jaws on slides: where its parts stand and where it closes, against NumPy and manifold3d."""

import numpy as np
import pytest
import torch
from grasp_cases import BAND, material64, model_of, random_grasps, shapes
from motions import ARM, BRIEF, BRIEF_WARP, MUJOCO
from problems import make_batch, solve
from seven import with_jaws, with_table

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.judge.grasp import close_gripper, gripper_poses
from r2h_batch.judge.motion.execute import FINGER_GIVE_M, execute
from r2h_batch.judge.motion.time_law import time_path
from r2h_batch.scene.grasp_tables import grasp_tables
from r2h_batch.scene.robot import gap_from_drive, gripper_primitives_at
from r2h_batch.scene.robot_file import load_robot

LINKAGE = load_robot()
JAWS, TABLE = with_jaws(LINKAGE), with_table(LINKAGE)


def test_jaws_stand_where_numpy_has_them_and_their_pads_are_the_gap_apart():
    gap = torch.linspace(0.0, 0.08, 9)
    R, p = gripper_poses(JAWS, gap)
    T = gripper_primitives_at(JAWS, gap.double().numpy())
    assert np.abs(R.numpy() - T[..., :3, :3]).max() < 1e-6 and np.abs(p.numpy() - T[..., :3, 3]).max() < 1e-7
    left, right = (T[:, JAWS.gripper_part.index("pad") + k, 1, 3] for k in (2, 0))
    assert np.allclose(right - left - 2 * JAWS.linkage.pad_half_size[1], gap, atol=1e-9)
    assert np.allclose(T[:, 2, 2, 3], 0.0) and float(gap_from_drive(JAWS, JAWS.linkage.drive_lower)) == JAWS.open_gap_m


def test_jaws_close_to_the_extent_of_what_is_between_them():
    T, index = random_grasps(70, seed=4)
    tables = grasp_tables([model_of(m) for m in shapes().values()], JAWS)
    grasp, meshes, seen = close_gripper(tables, T, index), list(shapes().values()), 0
    for i in range(len(T)):
        found = [material64(meshes[index[i]], T[i].double().numpy(), 0.0, grow, JAWS) for grow in (-BAND, 0.0, BAND)]
        low, high = np.array([f or (np.nan, np.nan) for f in found]).T
        width = high - low
        if not max(-low.min(), high.max()) < 0.0399:
            continue  # nothing, or the open jaws decide
        seen += 1
        assert width.min() - 3e-5 <= float(grasp.opening_m[i]) <= width.max() + 3e-5, i
        assert abs(float(grasp.shift_m[i]) - (low[1] + high[1]) / 2) <= 3e-5 + np.ptp(low) + np.ptp(high), i
    assert seen > 15


@pytest.mark.parametrize("robot", [JAWS, pytest.param(TABLE, marks=pytest.mark.slow)], ids=lambda r: r.name)
def test_the_whole_scene_with_jaws_moves_as_the_arm_alone_and_the_engines_agree(robot):
    """Jaws that give way by micrometres are all that is new, as of the 2F-85."""
    scene = Evaluator(load_benchmark("r2h-v1").on(robot)).scene
    p = solve(scene, make_batch(scene, 6, seed=3))
    length = torch.where(torch.cumsum(p.plan.length > 0, 0) <= 2, p.plan.length, 0)
    whole, alone, brief, warp = (
        execute(scene, p.body_poses, p.plan.path, length, time_path(p.plan.path, length, config), config)
        for config in (MUJOCO, ARM, BRIEF, BRIEF_WARP)
    )
    rows = whole.length > 0
    assert rows.sum() == 2 and torch.equal(whole.length, alone.length) and bool(whole.valid.all())
    assert 0 < float((whole.path - alone.path).abs().max()) < 5e-6
    sway = (whole.slack_m - alone.slack_m)[rows]
    assert float(sway.min()) > 0 and float(sway.max()) < FINGER_GIVE_M
    assert float((brief.path - warp.path).abs().max()) < 1e-4 and bool(warp.valid.all())
    assert float((brief.window_opening_m - warp.window_opening_m).abs().max()) < 1e-6


def test_a_table_of_the_linkage_moves_its_parts_as_the_linkage_does():
    """A sample every 1.3 mm: chords are within 6 um of the arcs; kernels and NumPy agree on the table."""
    gap = torch.linspace(float(LINKAGE.closed_gap_m), 0.085, 40)
    R, p = gripper_poses(TABLE, gap)
    T, exact = (gripper_primitives_at(robot, gap.double().numpy()) for robot in (TABLE, LINKAGE))
    assert np.abs(R.numpy() - T[..., :3, :3]).max() < 1e-6 and np.abs(p.numpy() - T[..., :3, 3]).max() < 1e-7
    assert np.abs(T[..., :3, 3] - exact[..., :3, 3]).max() < 6e-6 and np.abs(T - exact).max() < 1e-4


def test_fingers_of_a_table_close_where_the_linkage_does():
    T, index = random_grasps(150, seed=6)
    objects = [model_of(m) for m in shapes().values()]
    found, exact = (close_gripper(grasp_tables(objects, robot), T, index) for robot in (TABLE, LINKAGE))
    off = (found.opening_m - exact.opening_m).abs().nan_to_num(0.0)
    # the pads' height is off by micrometres: on a slope or at a step of the object this is as much again
    assert torch.equal(found.width_m.isnan(), exact.width_m.isnan()) and float(off.quantile(0.95)) < 3e-5
    assert float(off.max()) < 2e-3 and int((exact.opening_m < 0.08).sum()) > 30
