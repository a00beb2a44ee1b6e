"""Grasp files of ACRONYM, GraspNet, isaac_grasp and our own: small files in their formats, one grasp type out."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from grasp_files import poses, write_acronym, write_isaac
from needs import needs
from scipy.spatial.transform import Rotation

from r2h_batch.base.errors import FileError
from r2h_batch.data.grasp_files import PAD_HALF_M, T_gripper_ee, read_file_of
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.methods.grasps import seat_grasps
from r2h_batch.scene.grasp_set import GraspSet, read_grasps
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.edit import edited

RNG = np.random.default_rng(4)


def fingers(T_obj_ee, half_gap=0.02):
    """Where a grasp's two fingertips are, and its approach, in the object's frame."""
    tip = np.array([[0.0, s * half_gap, PAD_HALF_M, 1.0] for s in (1, -1)])
    return (T_obj_ee @ tip.T).transpose(0, 2, 1)[:, :, :3], T_obj_ee[:, :3, 2]


@needs("h5py")
def test_acronym_fingertips_and_approach_stay_where_they_were(tmp_path):
    T, held = poses(50), (np.arange(50) % 3 > 0).astype(np.int64)
    found, left_out = read_file_of("acronym", write_acronym(tmp_path / "mug.h5", T, held))
    assert len(found) == held.sum() and left_out == (held == 0).sum() and found.gripper == "acronym-panda"
    tips, approach = fingers(found.T_obj_ee.astype(np.float64))
    theirs = np.array([[s * 0.02, 0.0, 0.11217, 1.0] for s in (1, -1)])  # the Panda of ACRONYM closes along its x
    want = (T[held > 0] @ theirs.T).transpose(0, 2, 1)[:, :, :3]
    assert np.abs(tips - want).max() < 1e-6 and np.abs(approach - T[held > 0][:, :3, 2]).max() < 1e-6
    assert np.abs(np.linalg.det(found.T_obj_ee[:, :3, :3]) - 1).max() < 1e-5


def test_graspnet_vectors_of_one_object_out_of_the_cameras_frame(tmp_path):
    R = Rotation.random(8, rng=RNG).as_matrix()
    t, depth, width = RNG.normal(0, 0.2, (8, 3)), RNG.uniform(0.01, 0.04, 8), RNG.uniform(0.02, 0.08, 8)
    ids = np.array([5, 5, 7, 5, 7, 5, 5, 5])
    rows = np.column_stack([np.linspace(1, 0.1, 8), width, np.full(8, 0.02), depth, R.reshape(8, 9), t, ids])
    np.save(tmp_path / "scene.npy", rows)
    with pytest.raises(FileError, match="2 objects; choose one with --object-id"):
        read_file_of("graspnet", tmp_path / "scene.npy")
    camera = poses(1, 9)[0]
    found, left_out = read_file_of("graspnet", tmp_path / "scene.npy", object_id=5, T_obj_source=camera)
    mine = ids == 5
    assert len(found) == 6 and left_out == 2 and np.allclose(found.width, width[mine])
    tips, approach = fingers(found.T_obj_ee.astype(np.float64), 0.03)
    ends = t + depth[:, None] * R[:, :, 0]  # fingers end at depth along x, and close along y
    want = np.stack([ends + 0.03 * R[:, :, 1], ends - 0.03 * R[:, :, 1]], 1)[mine] @ camera[:3, :3].T + camera[:3, 3]
    assert np.abs(tips - want).max() < 1e-6
    assert np.abs(approach - R[mine][:, :, 0] @ camera[:3, :3].T).max() < 1e-6


@pytest.mark.parametrize("kind, gripper, closing, tip", [
    ("isaac", "panda-hand", 1, 0.1122), ("poses", "acronym-panda", 0, 0.1122), ("graspgen", "graspgen-franka", 0, 0.1122),
    ("graspgen", "graspgen-2f-85", 0, 0.1422 + PAD_HALF_M), ("isaac", "graspgen-2f-140", 0, 0.195 + PAD_HALF_M),
])  # fmt: skip
def test_a_file_without_a_frame_takes_the_named_grippers(tmp_path, kind, gripper, closing, tip):
    """Fingertips stand where GraspGen's robot files have them: pads of the open 2F-85 at z 0.1303, 0.1422 at half stroke."""
    T, confidence, path = poses(12, 3), np.linspace(1, 0, 12), tmp_path / "g"
    if kind == "isaac":
        write_isaac(path, T, confidence)
    elif kind == "graspgen":
        confidence, held = np.ones(12), np.arange(15) % 5 > 0
        every = np.tile(np.eye(4), (15, 1, 1))
        every[held] = T
        grasps = {"transforms": every.tolist(), "object_in_gripper": held.tolist()}
        path.write_text(json.dumps({"object": {"file": "a.obj", "scale": 0.1}, "grasps": grasps}))
    else:
        np.save(path, T)
        path = path.with_suffix(".npy")
    found, left_out = read_file_of(kind, path, gripper)
    assert left_out == (3 if kind == "graspgen" else 0)
    tips, approach = fingers(found.T_obj_ee.astype(np.float64))
    local = np.zeros((2, 4))
    local[:, closing], local[:, 2], local[:, 3] = (0.02, -0.02), tip, 1.0
    want = (T @ local.T).transpose(0, 2, 1)[:, :, :3]
    assert np.abs(tips - want).max() < 5e-5 and np.abs(approach - T[:, :3, 2]).max() < 1e-6
    assert np.abs(found.score - confidence).max() < 1e-6
    own = "2f-85" if gripper == "graspgen-2f-85" else gripper
    assert found.gripper == own, "our own gripper's stay where they are"


def test_labels_of_graspnet_are_the_grasps_that_graspnetAPI_makes_of_them(tmp_path):
    """One grasp computed with graspnetAPI's recipe: the view's axis, a turn about it, a depth along it."""
    grid = (2, 300, 12, 4)
    scores = np.full(grid, -1.0, np.float32)
    offsets = np.zeros((*grid, 3), np.float32)
    collision = np.zeros(grid, bool)
    for at, score in (((0, 40, 3, 1), 0.2), ((1, 250, 7, 3), 0.1), ((1, 9, 0, 0), 0.3), ((0, 9, 0, 0), 0.9)):
        scores[at], offsets[at] = score, (at[2] * np.pi / 12, 0.01 * (at[3] + 1), 0.05)
    collision[1, 9, 0, 0] = True
    points = np.array([[0.01, 0.02, 0.03], [-0.02, 0.0, 0.01]])
    path = tmp_path / "005_labels.npz"
    np.savez(path, points=points, offsets=offsets, scores=scores, collision=collision)
    found, left_out = read_file_of("graspnet", path)
    assert len(found) == 2 and left_out == scores.size - 2 and np.allclose(found.score, [1.0, 0.9])
    tips, approach = fingers(found.T_obj_ee.astype(np.float64))
    for row, (point, view, angle, depth) in enumerate([(1, 250, 7, 3), (0, 40, 3, 1)]):
        z = (2 * view + 1) / 300 - 1
        turn = 2 * view * np.pi * (np.sqrt(5) - 1) / 2
        axis = -np.array([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
        level = np.array([-axis[1], axis[0], 0]) / np.hypot(axis[0], axis[1])
        closing = Rotation.from_rotvec(axis * angle * np.pi / 12).apply(level)
        end = points[point] + 0.01 * (depth + 1) * axis
        assert np.abs(approach[row] - axis).max() < 1e-6
        assert np.abs(tips[row] - [end + 0.02 * closing, end - 0.02 * closing]).max() < 1e-6
    assert edited(BenchmarkChoice("r2h-v1", grasps=(f"cup={path}",))).objects


def test_our_own_gripper_and_our_own_format_need_no_new_place(tmp_path):
    T = poses(5)
    found, _ = read_file_of("isaac", write_isaac(tmp_path / "g.yaml", T, np.ones(5)), "ee")
    assert found.gripper == "2f-85" and np.abs(found.T_obj_ee - T).max() < 1e-6
    base = load_robot().T_flange_ee.copy()
    base[2, 3] -= 0.011  # the UR coupling between flange and the gripper's base
    off = np.abs(T_gripper_ee("2f-85-base") - base)
    assert off[:3, :3].max() < 1e-6 and off[:3, 3].max() < 5e-4
    arrays = {"T_obj_ee": T.astype(np.float32), "width": np.full(5, 0.03, np.float32),
              "score": np.linspace(0, 1, 5).astype(np.float32), "part": np.arange(5, dtype=np.int32) - 1}  # fmt: skip
    np.savez(tmp_path / "grasps.npz", **arrays)
    found = read_grasps(tmp_path / "grasps.npz")
    assert all(np.array_equal(v, arrays[k]) for k, v in found.arrays().items()) and found.gripper == "2f-85"
    np.savez(tmp_path / "few.npz", T_obj_ee=arrays["T_obj_ee"])
    few = read_grasps(tmp_path / "few.npz")
    assert (few.part == -1).all() and (few.score == 1).all() and few.digest != found.digest


def as_set(candidates, gripper="2f-85", T=None):
    score = np.linspace(1, 0, len(candidates)).astype(np.float32)
    T_obj_ee = candidates.T_obj_ee if T is None else T
    return GraspSet(T_obj_ee, candidates.width, score, candidates.part.astype(np.int32), gripper)


def test_grasps_of_our_gripper_stay_and_those_of_another_are_seated_anew_or_dropped_and_counted():
    (hammer,) = load_objects(["hammer"])
    (own,) = candidates_of((hammer,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (found,) = candidates_of((replace(hammer, grasps=as_set(own)),))
    assert np.abs(found.T_obj_ee - own.T_obj_ee).max() < 2e-6 and np.array_equal(found.part, own.part)
    assert np.array_equal(found.score, as_set(own).score), "the user's scores rank"
    T = own.T_obj_ee.copy()
    T[:, :3, 3] -= 0.012 * T[:, :3, 2]  # fingers that are 12 mm longer
    T[:10, :3, 3] += 5.0  # nowhere near
    with pytest.warns(UserWarning, match=r"of 100 grasps of the panda-hand, \d+ seated elsewhere, \d+ dropped"):
        found = seat_grasps(hammer, as_set(own, "panda-hand", T))
    assert 80 <= len(found) <= 90 and (np.diff(found.score) <= 0).all()
    assert np.linalg.norm(found.T_obj_ee[:, :3, 3] - hammer.com, axis=1).max() < 0.5
    with pytest.warns(UserWarning, match="dropped"):
        kept = seat_grasps(hammer, as_set(own, T=T))
    assert len(kept) < len(found), "our own gripper's grasps stay where they are"
    T[:] = T[0]
    with pytest.raises(ValueError, match="hammer: none of 100 grasps can be held"):
        seat_grasps(hammer, as_set(own, T=T))


@pytest.mark.parametrize(
    ("said", "asked"),
    [("panda-hand", "acronym-panda or graspgen-franka"), ("2f-85", "graspgen-2f-85 or 2f-85-base")],
)
def test_grasps_whose_fingers_close_along_another_axis_ask_for_their_grippers_name(said, asked):
    (hammer,) = load_objects(["hammer"])
    (own,) = candidates_of((hammer,))
    T = own.T_obj_ee.copy()
    T[:, :3, :2] = np.stack([T[:, :3, 1], -T[:, :3, 0]], 2)  # read as closing along x
    words = rf"; turned by 90 degrees \d+ of 100 hold, as they are \d+: is GRIPPER {asked}\?"
    with pytest.warns(UserWarning, match=words):
        seat_grasps(hammer, as_set(own, said, T))
