"""Properties of the stored grasps, recomputed with manifold3d, fcl and float64 rays."""

import json
from dataclasses import replace
from functools import cache
from importlib import resources

import numpy as np
import pytest
import trimesh
from fcl_twin import distance, primitive, surface
from grasp_cases import material64
from needs import needs
from rounds import each

from r2h_batch.base.launch.threads import on_threads
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.methods.grasps import FRICTION, sample_grasps
from r2h_batch.scene.arrays import arrays_digest
from r2h_batch.scene.objects import ObjectModel, load_objects, object_digest, stored_objects
from r2h_batch.scene.robot import Robot, ShapeKind, drive_from_gap, gripper_primitives_at, pad_center_z
from r2h_batch.scene.robot_file import load_robot

BAND = 1e-4
ROBOT, PANDA, STEP = load_robot(), load_robot("panda_hand"), 50
FOLDER = resources.files("r2h_batch.assets.objects")
MODELS = stored_objects()


@cache
def _stored() -> dict[str, np.ndarray]:
    with np.load(str(FOLDER / "grasps.npz"), allow_pickle=False) as data:
        return {name: data[name] for name in data.files}


def _report() -> dict:
    return json.loads((FOLDER / "grasps_report.json").read_text())


def _in_ee(model: ObjectModel, T_obj_ee: np.ndarray, faces: np.ndarray | None = None) -> trimesh.Trimesh:
    vertices = trimesh.transform_points(model.vertices.astype(np.float64), np.linalg.inv(T_obj_ee.astype(np.float64)))
    return trimesh.Trimesh(vertices, model.faces if faces is None else faces, process=False)


def _pad_z(gap: float, robot: Robot) -> float:
    z = pad_center_z(robot, drive_from_gap(robot, gap))
    return float(z + robot.T_flange_gripper[2, 3] - robot.T_flange_ee[2, 3])


def _distance(mesh: trimesh.Trimesh, opening: float, moving_only: bool, robot: Robot = ROBOT) -> float:
    """Least fcl distance of the gripper's primitives to the surface, below 2 mm (0: they touch it)."""
    least, middle, shapes = 2e-3, mesh.triangles.mean(axis=1), robot.gripper
    radius = np.linalg.norm(mesh.triangles - middle[:, None], axis=2).max(axis=1)
    poses = gripper_primitives_at(robot, opening)
    for kind, size, motion, T in zip(shapes.kind, shapes.size, robot.gripper_motion, poses, strict=True):
        if moving_only and motion == "fixed":
            continue
        half = (
            size
            if kind == ShapeKind.BOX
            else np.array([size[0], size[0], size[1] + size[0] * (kind == ShapeKind.CAPSULE)])
        )
        beyond = np.abs((middle - T[:3, 3]) @ T[:3, :3]) - half
        near = np.linalg.norm(np.maximum(beyond, 0), axis=1) - radius < 2e-3
        if near.any():
            least = min(least, distance(surface(mesh.triangles[near]), primitive(kind, size, T)))
    return least


def test_there_are_100_of_every_object_and_the_report_belongs_to_them() -> None:
    stored, report = _stored(), _report()
    assert set(stored) == {f"{name}/{key}" for name in MODELS for key in ("T_obj_ee", "width", "score", "part")}
    for name in MODELS:
        T, score, part = stored[f"{name}/T_obj_ee"], stored[f"{name}/score"], stored[f"{name}/part"]
        assert T.shape == (100, 4, 4) and T.dtype == np.float32 and part.dtype == np.uint8
        assert np.abs(T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max() < 1e-5
        assert (np.linalg.det(T[:, :3, :3]) > 0.99).all() and (T[:, 3] == [0, 0, 0, 1]).all()
        assert (np.diff(score) <= 0).all() and score[-1] > 0 and score[0] <= 1
        assert part.max() < len(MODELS[name].part_names)
    assert report["digest"] == arrays_digest(stored)
    assert report["objects_digest"] == object_digest(load_objects()), "objects changed: run build_grasps.py"
    assert report["robot_digest"] == ROBOT.digest, "the robot changed: run build_grasps.py"


@needs("rtree")
@pytest.mark.parametrize(
    ("name", "robot"),
    [
        *(pytest.param(n, ROBOT, marks=[pytest.mark.slow] * (k % 3 > 0)) for k, n in enumerate(MODELS)),
        *(("hammer", PANDA), ("wineglass", PANDA)),
    ],
)
def test_a_grasp_is_narrow_centred_clear_and_within_the_friction_cone(name: str, robot: Robot) -> None:
    """The Panda's hand is tried with its own shapes: some of the 2F-85's are wider than its 80 mm, its pads are half as
    long."""
    model, T_obj_ee, widths = MODELS[name], _stored()[f"{name}/T_obj_ee"], _stored()[f"{name}/width"]
    if robot is PANDA:
        (found,) = candidates_of((model,), robot=PANDA)
        assert len(found) == 100 and found.width.max() <= 0.0772 and not np.array_equal(found.T_obj_ee, T_obj_ee)
        T_obj_ee, widths = found.T_obj_ee, found.width
    for T, width in each(zip(T_obj_ee[::STEP], map(float, widths[::STEP]), strict=True)):
        mesh, gap = _in_ee(model, T), max(width, robot.closed_gap_m + 1e-4)
        low, high = material64(model.mesh, T, gap, robot=robot)
        assert high - low == pytest.approx(width, abs=BAND) and width <= robot.open_gap_m
        assert abs(low + high) / 2 <= 1e-3
        assert _distance(mesh, robot.open_gap_m, False, robot) >= 1e-3 - BAND
        touched, cosine = _contact(mesh, gap, width, robot)
        assert touched >= 1 and cosine >= 1 / np.hypot(1, FRICTION) - 0.02


def _contact(mesh: trimesh.Trimesh, gap: float, width: float, robot: Robot) -> tuple[int, float]:
    """Rays from the lesser pad that meet the surface within 1.5 mm of it, and the mean cosine over both pads."""
    wide, _, high = robot.linkage.pad_half_size
    x, z = np.meshgrid(wide * (np.arange(5) - 2) / 2.5, high * (np.arange(7) - 3) / 3.5)
    start = np.stack([x.ravel(), np.full(x.size, -1.0), z.ravel() + _pad_z(gap, robot)], 1)
    at, ray, face = mesh.ray.intersects_location(start, np.tile([0.0, 1.0, 0.0], (x.size, 1)))
    least, cosines = 99, []
    for side in (-1, 1):
        depth = width / 2 + 1.5e-3 - side * at[:, 1]
        reached = np.flatnonzero((depth >= 0) & (depth <= 3e-3))
        first = {ray[k]: k for k in sorted(reached, key=lambda k: -depth[k])}
        cosines += [max(0.0, side * mesh.face_normals[face[k], 1]) for k in first.values()]
        least = min(least, len(first))
    return least, float(np.mean(cosines))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[pytest.mark.slow] * (k % 3 > 0))
        for k, n in enumerate([n for n, model in MODELS.items() if model.split == "S1"][::2])
    ],
)
def test_at_least_25_keep_the_fingers_off_the_receivers_region(name: str) -> None:
    model, stored, passed = MODELS[name], _stored(), 0
    for T_obj_ee, width in zip(stored[f"{name}/T_obj_ee"], stored[f"{name}/width"], strict=True):
        region = _in_ee(model, T_obj_ee, model.faces[model.receiver_face])
        passed += _distance(region, max(float(width) - 1e-3, 0.0), moving_only=True) > BAND
    assert passed >= 25
    assert abs(passed - _report()["objects"][name]["pass_affordance"]) <= 2


@pytest.mark.parametrize("name", MODELS)
def test_grasps_are_spread_over_the_object_and_no_two_are_alike(name: str) -> None:
    T = _stored()[f"{name}/T_obj_ee"].astype(np.float64)
    place, z = T[:, :3, 3], T[:, :3, 2]
    apart = np.linalg.norm(place[:, None] - place[None], axis=2)
    turn = np.arccos(np.clip(z @ z.T, -1, 1))
    alike = (apart < 2e-3) & (turn < 0.1) & ~np.eye(100, dtype=bool)
    axis = np.abs(np.einsum("ik,jk->ij", T[:, :3, 1], T[:, :3, 1])) > np.cos(0.1)
    assert not (alike & axis).any()
    assert np.ptp(place, axis=0).max() > 0.4 * np.ptp(MODELS[name].vertices, axis=0).max()
    assert np.linalg.norm(z.mean(axis=0)) < 0.9, "approaches come from more than one side"


def test_the_same_object_gives_the_stored_grasps_again_with_one_thread() -> None:
    with on_threads(1):
        again = sample_grasps(MODELS["hammer"])
    for key in ("T_obj_ee", "width", "score", "part"):  # made before products were kept apart from sums: nanometres
        np.testing.assert_allclose(getattr(again, key), _stored()[f"hammer/{key}"], rtol=0, atol=1e-8)


def _other(name: str, mesh: trimesh.Trimesh, split: str) -> ObjectModel:
    """An object with just what the sampler reads; people take the upper half."""
    faces = mesh.faces.astype(np.int32)
    return replace(
        MODELS["hammer"], name=name, split=split, vertices=mesh.vertices.astype(np.float32), faces=faces,
        face_part=np.zeros(len(faces), np.uint8), com=np.zeros(3),
        receiver_face=(mesh.triangles_center[:, 2] > 0) & (split == "S1"),
    )  # fmt: skip


def test_a_users_mesh_gets_grasps_that_leave_its_region_free_or_is_refused_or_warned_of() -> None:
    rod = trimesh.creation.cylinder(0.02, 0.2, sections=24).subdivide()
    found = sample_grasps(_other("rod", rod, "S1"), count=40)
    assert len(found) == 40 and (found.width <= 0.0822).all() and (found.region_m > 0).sum() >= 10
    with pytest.raises(ValueError, match=r"ball: no grasp found.*85 mm"):
        sample_grasps(_other("ball", trimesh.creation.icosphere(1, 0.06), "S0"))
    small = _other("pin", trimesh.creation.icosphere(2, 0.02), "S1")
    small = replace(small, receiver_face=np.ones(len(small.faces), bool))
    with pytest.warns(UserWarning, match=r"pin: 0 of 10 grasps"):
        sample_grasps(small, count=10)


def test_grasps_along_a_direction_approach_within_60_degrees_of_it_and_are_others_than_the_candidates() -> None:
    model, down = MODELS["hammer"], np.array([0.0, 0.6, -0.8])
    every, found = (sample_grasps(model, count=24, enough=60, along=along) for along in (None, down))
    towards = found.T_obj_ee[:, :3, 2] @ down
    assert len(found) == 24 and (towards >= 0.5).all() and (towards < 0.8).any()
    assert (every.T_obj_ee[:, :3, 2] @ down < 0.5).any()
    assert not (every.T_obj_ee[:, None, :3, :3] == found.T_obj_ee[None, :, :3, :3]).all((2, 3)).any()
    stored = _stored()["hammer/T_obj_ee"]
    assert not np.isclose(stored[:, None, :3, :3], found.T_obj_ee[None, :, :3, :3], atol=1e-6).all((2, 3)).any()
    for T, width in zip(found.T_obj_ee[::6], found.width[::6], strict=True):
        assert _distance(_in_ee(model, T), ROBOT.open_gap_m, moving_only=False) > 1e-3 - BAND
        assert 0 < width <= ROBOT.open_gap_m - 0.003 + 1e-6
