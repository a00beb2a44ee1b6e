"""Overlap of the gripper with an object, and the distance of its fingers from a region: against float64 and
python-fcl."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from convex_twin import primitive_distance, winding_number
from fcl_twin import primitive, surface, touch
from grasp_cases import BAND, model_of, pose_at, random_grasps, shapes, tables_of_shapes, upper

from r2h_batch.config import OPEN_GAP_M
from r2h_batch.judge.grasp import CUT_CAP_M, close_gripper, open_clearance, region_distance
from r2h_batch.scene.grasp_tables import grasp_tables
from r2h_batch.scene.robot import ShapeKind, gripper_primitives_at
from r2h_batch.scene.robot_file import load_robot


def _clearance64(triangles: np.ndarray, kind: int, size: np.ndarray, T_ee_prim: np.ndarray, cap: float) -> float:
    """Least signed distance of the triangles' points (ee frame) to a primitive, below the cap."""
    tri = trimesh.transform_points(triangles.reshape(-1, 3), np.linalg.inv(T_ee_prim)).reshape(-1, 3, 3)
    best = min(cap, float(primitive_distance(kind, size, tri).min()))
    middle = tri.mean(axis=1)
    radius = np.linalg.norm(tri - middle[:, None], axis=-1).max(axis=1)
    tri = tri[primitive_distance(kind, size, middle) - radius < best - 1e-9]
    if len(tri) == 0:
        return best

    def along(u: np.ndarray) -> np.ndarray:  # least over the chord at fraction u from the first corner
        a = tri[:, 0] + u[:, None] * (tri[:, 1] - tri[:, 0])
        b = tri[:, 0] + u[:, None] * (tri[:, 2] - tri[:, 0])
        return _golden(lambda v: primitive_distance(kind, size, a + v[:, None] * (b - a)), len(tri))

    return min(best, float(_golden(along, len(tri)).min()))


def _golden(f, count: int) -> np.ndarray:
    """Least values of `count` convex functions on [0, 1], to 7e-5 of the interval."""
    g = (np.sqrt(5) - 1) / 2
    low, high = np.zeros(count), np.ones(count)
    a, b = high - g * (high - low), low + g * (high - low)
    fa, fb = f(a), f(b)
    for _ in range(20):
        left = fa < fb
        low, high = np.where(left, low, a), np.where(left, b, high)
        new = np.where(left, high - g * (high - low), low + g * (high - low))
        f_new = f(new)
        a, b = np.where(left, new, b), np.where(left, a, new)
        fa, fb = np.where(left, f_new, fb), np.where(left, fa, f_new)
    return np.minimum(fa, fb)


def _gripper_clearance64(
    mesh: trimesh.Trimesh, T_obj_ee: np.ndarray, gap: float, cap: float, moving_only: bool, solid: bool
) -> float:
    robot = load_robot()
    T_ee_prim = gripper_primitives_at(robot, gap)
    T_ee_obj = np.linalg.inv(T_obj_ee.astype(np.float64))
    triangles = trimesh.transform_points(mesh.triangles.reshape(-1, 3), T_ee_obj).reshape(-1, 3, 3)
    used = [i for i, motion in enumerate(robot.gripper_motion) if not (moving_only and motion == "fixed")]
    corners = triangles.reshape(-1, 3)
    best = cap
    for i in used:  # the corners first: they spare most triangles
        x = trimesh.transform_points(corners, np.linalg.inv(T_ee_prim[i]))
        best = min(best, float(primitive_distance(robot.gripper.kind[i], robot.gripper.size[i], x).min()))
    for i in used:
        kind = robot.gripper.kind[i]
        size = robot.gripper.size[i] if kind == ShapeKind.BOX else robot.gripper.size[i][:2]
        best = min(best, _clearance64(triangles, kind, size, T_ee_prim[i], best))
        center = trimesh.transform_points(T_ee_prim[i][:3, 3][None], T_obj_ee.astype(np.float64))
        if solid and abs(winding_number(center[0], mesh.triangles)) > 0.5:
            best = min(best, -float(size.min() if kind != ShapeKind.CAPSULE else size[0]))
    return best


@pytest.mark.parametrize("count", [14, pytest.param(84, marks=pytest.mark.slow)])
def test_cut_agrees_with_float64_and_with_fcl(count: int) -> None:
    T, index = random_grasps(count, seed=7)
    back = 0.09 * torch.rand(count, 1, generator=torch.Generator().manual_seed(0))
    T[:, :3, 3] -= T[:, :3, 2] * back * (torch.arange(count) % 4 != 0)[:, None]
    cap = 0.02
    cut, _ = open_clearance(tables_of_shapes(), T, index, cap_m=cap)
    meshes = list(shapes().values())
    robot = load_robot()
    T_ee_prim = gripper_primitives_at(robot, OPEN_GAP_M)
    seen = {"cut": 0, "near": 0, "far": 0}
    for i in range(len(T)):
        mesh, T_obj_ee = meshes[index[i]], T[i].double().numpy()
        twin = _gripper_clearance64(mesh, T_obj_ee, OPEN_GAP_M, cap, False, True)
        seen["cut" if twin < 0 else "near" if twin < cap else "far"] += 1
        assert float(cut[i]) == pytest.approx(twin, abs=2e-5), i
        if abs(float(cut[i])) > BAND:
            skin = surface(trimesh.transform_points(mesh.triangles.reshape(-1, 3), np.linalg.inv(T_obj_ee)))
            parts = zip(robot.gripper.kind, robot.gripper.size, T_ee_prim, strict=True)
            centers = trimesh.transform_points(T_ee_prim[:, :3, 3], T_obj_ee)
            hits = any(touch(skin, primitive(*part)) for part in parts)
            hits = hits or any(abs(winding_number(x, mesh.triangles)) > 0.5 for x in centers)
            assert hits == (float(cut[i]) < 0), i
    assert min(seen.values()) >= count // 10, seen


def test_a_pad_wholly_inside_the_object_and_an_object_wholly_inside_the_palm_are_cuts() -> None:
    robot = load_robot()
    boxes = [model_of(trimesh.creation.box((size, size, size))) for size in (0.4, 0.01)]
    tables = grasp_tables(boxes, robot)
    pad = robot.gripper.names.index("left_pad")
    palm = gripper_primitives_at(robot, OPEN_GAP_M)[robot.gripper_part.index("body"), :3, 3]
    T = torch.tensor(np.stack([pose_at(), np.linalg.inv(pose_at(*palm))]), dtype=torch.float32)
    cut, part = open_clearance(tables, T, torch.tensor([0, 1], dtype=torch.int32), cap_m=0.001)
    assert cut[0] <= -robot.gripper.size[pad].min() and cut[1] < 0 and part[1] == robot.gripper_part.index("body")
    only_pad = T[:1].clone()
    assert close_gripper(tables, only_pad, torch.tensor([0], dtype=torch.int32)).margin_m.item() < 0


def test_touching_pads_pass_and_deeper_cuts_have_smaller_margins() -> None:
    tables = grasp_tables([model_of(trimesh.creation.box((0.02, 0.03, 0.02)))], load_robot())
    # the box reaches y = offset + 15 mm; the pad begins at 42.5 mm
    offsets = [0.0, 0.022, 0.027, 0.02749, 0.027501, 0.0276, 0.029, 0.0305]
    T = torch.tensor(np.stack([np.linalg.inv(pose_at(y=y)) for y in offsets]), dtype=torch.float32)
    grasp = close_gripper(tables, T, torch.zeros(len(offsets), dtype=torch.int32))
    assert grasp.margin_m[0].item() == pytest.approx(CUT_CAP_M)  # at least that far from the pads, and 55 mm narrower
    assert grasp.margin_m[1:6].tolist() == pytest.approx([0.0055, 5e-4, 1e-5, -1e-6, -1e-4], abs=1e-5)
    assert (grasp.margin_m[:4] >= 0).all() and (grasp.margin_m[4:] < 0).all()
    assert (grasp.margin_m.diff() < 0).all()  # no jump where the box meets the pad


@pytest.mark.parametrize("count", [16, pytest.param(112, marks=pytest.mark.slow)])
def test_region_distance_agrees_with_float64(count: int) -> None:
    T, index = random_grasps(count, seed=11)
    opening = torch.tensor(np.random.default_rng(1).uniform(0, 0.085, len(T)), dtype=torch.float32)
    distance, part = region_distance(tables_of_shapes(), T, index, opening)
    meshes = list(shapes().values())
    seen = {"in": 0, "near": 0, "far": 0, "none": 0}
    for i in range(len(T)):
        if index[i] % 2:
            seen["none"] += 1
            assert torch.isnan(distance[i])
            continue
        mesh = meshes[index[i]]
        region = trimesh.Trimesh(mesh.vertices, mesh.faces[upper(mesh)], process=False)
        twin = _gripper_clearance64(region, T[i].numpy(), float(opening[i]), 0.05, True, False)
        seen["in" if twin < 0 else "near" if twin < 0.05 else "far"] += 1
        assert float(distance[i]) == pytest.approx(twin, abs=2e-5), i
        assert (part[i] < 0) == (twin >= 0.05)
    assert min(seen.values()) >= count // 37, seen


def test_of_a_gripper_in_a_region_of_boxes_the_fingers_count_and_the_palm_does_not() -> None:
    robot, gap, cap = load_robot(), 0.05, 0.05
    cubes = [trimesh.creation.box((size, size, size)) for size in (0.02, 0.03, 0.09)]
    boxes = [np.array([[[0.0] * 3, [c.extents[0] / 2] * 3, *np.eye(3)]]) for c in cubes]
    tables = grasp_tables([replace(model_of(c), receiver_boxes=b) for c, b in zip(cubes, boxes)], robot)
    middles = gripper_primitives_at(robot, gap)[:, :3, 3]
    palm, pad = middles[robot.gripper_part.index("body")], middles[robot.gripper.names.index("left_pad")]
    T = np.stack([np.linalg.inv(pose_at(*at)) for at in (palm, pad, pad)])
    opening = torch.full((3,), gap)
    found, part = region_distance(tables, torch.tensor(T).float(), torch.arange(3, dtype=torch.int32), opening)
    twin = [_gripper_clearance64(c, x, gap, cap, True, True) for c, x in zip(cubes, T)]
    assert found.tolist() == pytest.approx(twin, abs=2e-5)
    assert found[0] > 0 > found[1:].max()
    assert all(robot.gripper_motion[int(i)] != "fixed" for i in part if i >= 0)
