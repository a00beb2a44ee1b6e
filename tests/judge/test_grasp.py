"""Width, closing, cuts and region distance against manifold3d, fcl and float64 NumPy."""

import numpy as np
import pytest
import torch
import trimesh
from grasp_cases import BAND, material64, model_of, pose_at, random_grasps, shapes, tables_of_shapes, width64

from r2h_batch.config import CLOSED_GAP_M, OPEN_GAP_M
from r2h_batch.judge.grasp import CUT_CAP_M, attach, close_gripper, gripper_poses
from r2h_batch.scene.grasp_tables import grasp_tables, gripper_tables
from r2h_batch.scene.robot import gap_from_drive, gripper_primitives_at
from r2h_batch.scene.robot_file import load_robot


def test_opening_is_the_largest_gap_that_the_material_fills() -> None:
    T, index = random_grasps(126, seed=3)
    grasp = close_gripper(tables_of_shapes(), T, index)
    meshes = list(shapes().values())
    checked = {"held": 0, "empty": 0, "wide": 0}
    for i in range(len(T)):
        mesh, T_i = meshes[index[i]], T[i].numpy()
        opening, width = float(grasp.opening_m[i]), float(grasp.width_m[i])
        if grasp.empty[i]:
            checked["empty"] += 1
            assert np.isnan(width) and opening == pytest.approx(OPEN_GAP_M) and grasp.shift_m[i] == 0
            stop = 0.0016
        elif width > OPEN_GAP_M:
            checked["wide"] += 1
            assert opening == pytest.approx(OPEN_GAP_M) and grasp.margin_m[i] < 0
            # wide at the open gap, or at the gap where the tips meet a step
            assert any(width64(mesh, T_i, g, BAND) >= width - BAND for g in np.linspace(OPEN_GAP_M, 0.0016, 40))
            continue
        else:
            checked["held"] += 1
            stop = opening
            at = [width64(mesh, T_i, opening, grow) for grow in (-BAND, 0.0, BAND)]
            assert max(at) >= width - BAND and min(at) <= width + BAND, (i, at, width)
            if opening > 0.0016:
                assert width >= opening - BAND, "the pads stop where the material fills the gap"
            low, high = material64(mesh, T_i, opening, BAND) or (0, 0)
            if abs(width - (high - low)) < 2 * BAND:
                assert float(grasp.shift_m[i]) == pytest.approx((low + high) / 2, abs=2 * BAND)
        for gap in np.linspace(stop + 2 * BAND, OPEN_GAP_M, 8)[:-1] if stop < OPEN_GAP_M - 1e-3 else []:
            assert width64(mesh, T_i, gap, -BAND) < gap + BAND, (i, gap, opening, width)
    assert min(checked.values()) >= 3, checked


def _one(name: str, T: np.ndarray, **options):
    names = list(shapes())
    return close_gripper(
        tables_of_shapes(),
        torch.tensor(T[None], dtype=torch.float32),
        torch.tensor([names.index(name)], dtype=torch.int32),
        **options,
    )


def test_a_block_wider_than_the_stroke_is_too_wide_and_not_empty() -> None:
    grasp = _one("block", pose_at(z=-0.03))
    assert not grasp.empty and grasp.width_m.item() == pytest.approx(0.1, abs=1e-6)
    assert grasp.opening_m.item() == pytest.approx(OPEN_GAP_M) and grasp.margin_m.item() < -0.0149


def test_a_block_larger_than_the_prism_has_only_sheets_in_it_and_its_inside_counts() -> None:
    grasp = _one("sheet_block", pose_at(y=0.004, z=-0.08))
    assert grasp.width_m.item() == pytest.approx(0.05, abs=1e-6)
    assert grasp.shift_m.item() == pytest.approx(-0.004, abs=1e-6)
    assert grasp.opening_m.item() == pytest.approx(0.05, abs=2e-5)


def test_nothing_between_the_pads_is_empty_and_fails_by_the_whole_stroke() -> None:
    grasp = _one("block", pose_at(z=-0.2))
    assert grasp.empty and torch.isnan(grasp.width_m).all() and grasp.margin_m.item() == pytest.approx(-OPEN_GAP_M)
    inside_pipe = _one("pipe", pose_at(x=0.0, about=(1, 0, 0), angle=0.0))
    assert not inside_pipe.empty  # the pipe's two walls lie between the pads: outermost to outermost
    assert inside_pipe.width_m.item() == pytest.approx(0.06, abs=1e-4)


@pytest.mark.parametrize(("thick_m", "holds"), [(0.0004, False), (0.001505, False), (0.00152, True), (0.004, True)])
def test_what_is_thinner_than_the_closed_pads_gap_is_not_held(thick_m: float, holds: bool) -> None:
    assert float(gap_from_drive(load_robot(), load_robot().linkage.drive_upper)) == pytest.approx(
        CLOSED_GAP_M, abs=1e-7
    )
    tables = grasp_tables([model_of(trimesh.creation.box((0.1, thick_m, 0.004)))], load_robot())
    T = torch.tensor(np.linalg.inv(pose_at(z=0.01))[None], dtype=torch.float32)
    grasp = close_gripper(tables, T, torch.zeros(1, dtype=torch.int32))
    assert grasp.width_m.item() == pytest.approx(thick_m, abs=1e-6) and not grasp.empty
    assert grasp.opening_m.item() == pytest.approx(max(thick_m, CLOSED_GAP_M), abs=2e-5)
    assert grasp.margin_m.item() == pytest.approx(min(thick_m - CLOSED_GAP_M, CUT_CAP_M), abs=1e-6)
    assert (grasp.margin_m.item() >= 0) == holds


def test_a_bowls_rim_is_as_wide_as_its_wall_and_the_whole_bowl_is_too_wide() -> None:
    T = pose_at(x=0.0735, z=0.043, about=(0, 1, 0), angle=np.pi) @ trimesh.transformations.rotation_matrix(
        np.pi / 2, (0, 0, 1)
    )
    rim = _one("bowl", T)
    whole = _one("bowl", T, mode="whole")
    assert 0.002 < rim.width_m.item() < 0.03 and 0 < rim.margin_m.item() <= CUT_CAP_M
    assert whole.width_m.item() == pytest.approx(0.15, abs=1e-3) and whole.margin_m.item() < 0


def test_a_run_that_goes_on_beyond_the_open_gap_counts_whole() -> None:
    grasp = _one("l_shape", pose_at(z=0.06, about=(1, 0, 0), angle=np.pi))
    assert grasp.width_m.item() == pytest.approx(0.1, abs=1e-5)


def test_closing_moves_the_object_to_the_middle_of_the_pads() -> None:
    T, index = random_grasps(120, seed=5)
    grasp = close_gripper(tables_of_shapes(), T, index)
    held = ~grasp.empty & (grasp.width_m <= OPEN_GAP_M) & (grasp.shift_m.abs() < 0.01)
    moved = close_gripper(tables_of_shapes(), attach(T, grasp.shift_m)[held].contiguous(), index[held])
    same = (moved.width_m - grasp.width_m[held]).abs() < 1e-5  # else another piece comes between the pads
    assert same.sum() > 20
    assert moved.shift_m[same].abs().max() < 1e-5
    T_ee_obj = np.linalg.inv(attach(T, grasp.shift_m)[0].double().numpy())
    expected = pose_at(y=-float(grasp.shift_m[0])) @ np.linalg.inv(T[0].double().numpy())
    np.testing.assert_allclose(T_ee_obj, expected, atol=1e-6)


# --- clearance: least signed distance over a triangle by nested golden section search in float64 (it is convex) ---


def test_finger_poses_agree_with_the_robots_own() -> None:
    opening = torch.linspace(0.0, 0.087, 200)
    R, p = gripper_poses(load_robot(), opening)
    T = gripper_primitives_at(load_robot(), opening.double().numpy())
    np.testing.assert_allclose(R.numpy(), T[..., :3, :3], atol=1e-6)
    np.testing.assert_allclose(p.numpy(), T[..., :3, 3], atol=1e-6)
    assert gripper_tables(load_robot(), "cpu").kind.shape[0] == T.shape[1]
