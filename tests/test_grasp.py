"""Width, closing, cuts and region distance against manifold3d, fcl and float64 NumPy."""

from functools import cache
from types import SimpleNamespace

import fcl
import manifold3d
import numpy as np
import pytest
import torch
import trimesh
import warp as wp

from r2h_batch.grasp import (
    OPEN_GAP_M,
    attach,
    close_gripper,
    grasp_tables,
    gripper_poses,
    gripper_tables,
    open_clearance,
    region_distance,
)
from r2h_batch.kernels.surface import Surfaces, inverse_pose
from r2h_batch.kernels.width import material_between
from r2h_batch.robot import Kind, drive_from_gap, gripper_primitives_at, load_robot, pad_center_z

BAND = 1e-4
PAD_X, PAD_Z = 0.011, 0.01875


def _solid(shape: manifold3d.Manifold) -> trimesh.Trimesh:
    mesh = shape.to_mesh()
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], mesh.tri_verts, process=True)


def _box(size, at=(0.0, 0.0, 0.0)) -> manifold3d.Manifold:
    return manifold3d.Manifold.cube(size, True).translate(at)


def _rod(length: float, radius: float) -> manifold3d.Manifold:
    return manifold3d.Manifold.cylinder(length, radius, radius, 64, True)


@cache
def _shapes() -> dict[str, trimesh.Trimesh]:
    """Shapes that a gripper closes on in different ways, each watertight."""
    outline = [(0.0, 0.0), (0.03, 0.0), (0.075, 0.045), (0.072, 0.047), (0.029, 0.004), (0.0, 0.004)]
    bowl = manifold3d.Manifold.revolve(manifold3d.CrossSection([outline]), 96)
    comb = _box((0.02, 0.12, 0.01), (0, 0, -0.02))
    for i in range(-5, 6):
        comb += _box((0.02, 0.004, 0.04), (0, 0.011 * i, 0))
    out = {
        "bowl": bowl,
        "l_shape": _box((0.03, 0.02, 0.12)) + _box((0.03, 0.10, 0.025), (0, 0.04, 0.06)),
        "block": _box((0.1, 0.1, 0.1)),
        "sheet_block": _box((0.2, 0.05, 0.2)),
        "dumbbell": manifold3d.Manifold.cylinder(0.16, 0.011, 0.016, 64, True)
        + manifold3d.Manifold.sphere(0.04, 64).translate((0, 0, 0.09)),
        "comb": comb,
        "pipe": _rod(0.14, 0.03) - _rod(0.2, 0.027),
    }  # fmt: skip
    return {name: _solid(shape) for name, shape in out.items()}


def _model(mesh: trimesh.Trimesh, region=None) -> SimpleNamespace:
    faces = np.asarray(mesh.faces, np.int32)
    receiver = np.zeros(len(faces), bool) if region is None else region(mesh)
    return SimpleNamespace(vertices=np.asarray(mesh.vertices, np.float32), faces=faces, receiver_face=receiver)


def _upper(mesh: trimesh.Trimesh) -> np.ndarray:
    return mesh.triangles_center[:, 2] > 0.02


@cache
def _tables():
    return grasp_tables([_model(m, _upper if i % 2 == 0 else None) for i, m in enumerate(_shapes().values())])


def _grasps(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Random grasps near the surfaces of all shapes; a third of them square with the object's axes."""
    rng = np.random.default_rng(seed)
    meshes = list(_shapes().values())
    index = np.arange(count) % len(meshes)
    T = np.tile(np.eye(4), (count, 1, 1))
    for i, k in enumerate(index):
        R = trimesh.transformations.random_rotation_matrix(rng.random(3))
        if i % 3 == 0:
            R = trimesh.transformations.euler_matrix(*(rng.integers(0, 4, 3) * np.pi / 2))
        T[i] = R
        T[i, :3, 3] = meshes[k].triangles_center[rng.integers(len(meshes[k].faces))] + rng.normal(0, 0.012, 3)
    return torch.tensor(T, dtype=torch.float32), torch.tensor(index, dtype=torch.int32)


# --- width: the prism cut out of the solid by manifold3d; each connected piece is an interval of y ---


def _material64(
    mesh: trimesh.Trimesh, T_obj_ee: np.ndarray, gap: float, grow: float = 0.0
) -> tuple[float, float] | None:
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(
            trimesh.transform_points(mesh.vertices, np.linalg.inv(T_obj_ee.astype(np.float64))),
            mesh.faces.astype(np.uint64),
        )
    )
    z = float(pad_center_z(drive_from_gap(gap))) + float(
        load_robot().T_flange_gripper[2, 3] - load_robot().T_flange_ee[2, 3]
    )
    prism = _box((2 * (PAD_X + grow), 2.0, 2 * (PAD_Z + grow)), (0, 0, z))
    runs: list[list[float]] = []
    for piece in (solid ^ prism).decompose():
        box = piece.bounding_box()
        runs.append([box[1], box[4]])
    runs.sort()
    merged: list[list[float]] = []
    for low, high in runs:
        if merged and low <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], high)
        else:
            merged.append([low, high])
    held = [r for r in merged if r[1] > -OPEN_GAP_M / 2 and r[0] < OPEN_GAP_M / 2]
    return (held[0][0], held[-1][1]) if held else None


def _width64(mesh, T_obj_ee, gap, grow=0.0) -> float:
    held = _material64(mesh, T_obj_ee, gap, grow)
    return held[1] - held[0] if held else -1.0


@wp.kernel
def _material_kernel(
    first: int,
    surfaces: Surfaces,
    T_obj_ee_in: wp.array(dtype=wp.mat44),
    object_index_in: wp.array(dtype=wp.int32),
    z_in: wp.array(dtype=wp.float32),
    low_out: wp.array(dtype=wp.float32),
    high_out: wp.array(dtype=wp.float32),
):
    trial = first + wp.tid()
    R, t = inverse_pose(T_obj_ee_in[trial])
    z = z_in[trial]
    low, high = material_between(surfaces, object_index_in[trial], R, t, 0.011, z - 0.01875, z + 0.01875, 0.0425)
    low_out[trial] = low
    high_out[trial] = high


def test_material_at_a_given_gap_is_what_manifold3d_cuts_out() -> None:
    T, index = _grasps(500, seed=1)
    gap = np.random.default_rng(2).uniform(0.002, 0.085, len(T))
    z = pad_center_z(drive_from_gap(gap)) + load_robot().T_flange_gripper[2, 3] - load_robot().T_flange_ee[2, 3]
    low, high = torch.empty(len(T)), torch.empty(len(T))
    surfaces = _tables().surfaces
    arrays = [
        wp.from_torch(T, dtype=wp.mat44),
        *(wp.from_torch(x) for x in (index, torch.tensor(z, dtype=torch.float32), low, high)),
    ]
    wp.launch(_material_kernel, dim=len(T), inputs=[0, surfaces, *arrays], device="cpu")
    meshes = list(_shapes().values())
    filled, steps = 0, 0
    for i in range(len(T)):
        twin = _material64(meshes[index[i]], T[i].numpy(), gap[i])
        filled += twin is not None
        found = (float(low[i]), float(high[i])) if low[i] <= high[i] else None
        if (twin is None) == (found is None) and (twin is None or np.allclose(twin, found, rtol=0, atol=BAND)):
            continue
        # a corner or a face within 0.1 mm of the prism's side: the answer lies between a thinner and a thicker prism's
        steps += 1
        thin, thick = (_width64(meshes[index[i]], T[i].numpy(), gap[i], grow) for grow in (-BAND, BAND))
        width = found[1] - found[0] if found else -1.0
        assert thin - BAND <= width <= thick + BAND, (i, twin, found)
    assert filled > 300
    assert steps <= 10, "only steps at the prism's side may differ"


def test_opening_is_the_largest_gap_that_the_material_fills() -> None:
    T, index = _grasps(252, seed=3)
    grasp = close_gripper(_tables(), T, index)
    meshes = list(_shapes().values())
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
            gaps = np.linspace(0.0016, OPEN_GAP_M, 60)
            assert max(_width64(mesh, T_i, g, BAND) for g in gaps) >= width - BAND
            continue
        else:
            checked["held"] += 1
            stop = opening
            at = [_width64(mesh, T_i, opening, grow) for grow in (-BAND, 0.0, BAND)]
            assert max(at) >= width - BAND and min(at) <= width + BAND, (i, at, width)
            if opening > 0.0016:
                assert width >= opening - BAND, "the pads stop where the material fills the gap"
            low, high = _material64(mesh, T_i, opening, BAND) or (0, 0)
            if abs(width - (high - low)) < 2 * BAND:
                assert float(grasp.shift_m[i]) == pytest.approx((low + high) / 2, abs=2 * BAND)
        for gap in np.linspace(stop + 2 * BAND, OPEN_GAP_M, 12)[:-1] if stop < OPEN_GAP_M - 1e-3 else []:
            assert _width64(mesh, T_i, gap, -BAND) < gap + BAND, (i, gap, opening, width)
    assert min(checked.values()) >= 10, checked


def _one(name: str, T: np.ndarray, **options):
    names = list(_shapes())
    return close_gripper(
        _tables(),
        torch.tensor(T[None], dtype=torch.float32),
        torch.tensor([names.index(name)], dtype=torch.int32),
        **options,
    )


def _at(x=0.0, y=0.0, z=0.0, about=None, angle=0.0) -> np.ndarray:
    T = np.eye(4) if about is None else trimesh.transformations.rotation_matrix(angle, about)
    T[:3, 3] = x, y, z
    return T


def test_a_block_wider_than_the_stroke_is_too_wide_and_not_empty() -> None:
    grasp = _one("block", _at(z=-0.03))
    assert not grasp.empty and grasp.width_m.item() == pytest.approx(0.1, abs=1e-6)
    assert grasp.opening_m.item() == pytest.approx(OPEN_GAP_M) and grasp.margin_m.item() < -0.0149


def test_a_block_larger_than_the_prism_has_only_sheets_in_it_and_its_inside_counts() -> None:
    grasp = _one("sheet_block", _at(y=0.004, z=-0.08))
    assert grasp.width_m.item() == pytest.approx(0.05, abs=1e-6)
    assert grasp.shift_m.item() == pytest.approx(-0.004, abs=1e-6)
    assert grasp.opening_m.item() == pytest.approx(0.05, abs=2e-5)


def test_nothing_between_the_pads_is_empty_and_fails_by_the_whole_stroke() -> None:
    grasp = _one("block", _at(z=-0.2))
    assert grasp.empty and torch.isnan(grasp.width_m).all() and grasp.margin_m.item() == pytest.approx(-OPEN_GAP_M)
    inside_pipe = _one("pipe", _at(x=0.0, about=(1, 0, 0), angle=0.0))
    assert not inside_pipe.empty  # the pipe's two walls lie between the pads: outermost to outermost
    assert inside_pipe.width_m.item() == pytest.approx(0.06, abs=1e-4)


def test_a_bowls_rim_is_as_wide_as_its_wall_and_the_whole_bowl_is_too_wide() -> None:
    T = _at(x=0.0735, z=0.043, about=(0, 1, 0), angle=np.pi) @ trimesh.transformations.rotation_matrix(
        np.pi / 2, (0, 0, 1)
    )
    rim = _one("bowl", T)
    whole = _one("bowl", T, mode="whole")
    assert 0.002 < rim.width_m.item() < 0.03 and rim.margin_m.item() > 0.05
    assert whole.width_m.item() == pytest.approx(0.15, abs=1e-3) and whole.margin_m.item() < 0


def test_a_run_that_goes_on_beyond_the_open_gap_counts_whole() -> None:
    grasp = _one("l_shape", _at(z=0.06, about=(1, 0, 0), angle=np.pi))
    assert grasp.width_m.item() == pytest.approx(0.1, abs=1e-5)


def test_closing_moves_the_object_to_the_middle_of_the_pads() -> None:
    T, index = _grasps(120, seed=5)
    grasp = close_gripper(_tables(), T, index)
    held = ~grasp.empty & (grasp.width_m <= OPEN_GAP_M) & (grasp.shift_m.abs() < 0.01)
    moved = close_gripper(_tables(), attach(T, grasp.shift_m)[held].contiguous(), index[held])
    same = (moved.width_m - grasp.width_m[held]).abs() < 1e-5  # else another piece comes between the pads
    assert same.sum() > 20
    assert moved.shift_m[same].abs().max() < 1e-5
    T_ee_obj = np.linalg.inv(attach(T, grasp.shift_m)[0].double().numpy())
    expected = _at(y=-float(grasp.shift_m[0])) @ np.linalg.inv(T[0].double().numpy())
    np.testing.assert_allclose(T_ee_obj, expected, atol=1e-6)


# --- clearance: least signed distance over a triangle by nested golden section search in float64 (it is convex) ---


def _signed64(kind: int, size: np.ndarray, x: np.ndarray) -> np.ndarray:
    if kind == Kind.BOX:
        q = np.abs(x) - size
    elif kind == Kind.CYLINDER:
        q = np.stack([np.hypot(x[..., 0], x[..., 1]) - size[0], np.abs(x[..., 2]) - size[1]], -1)
    elif kind == Kind.CAPSULE:
        end = np.stack([x[..., 0], x[..., 1], np.maximum(np.abs(x[..., 2]) - size[1], 0)], -1)
        return np.linalg.norm(end, axis=-1) - size[0]
    else:
        raise AssertionError(kind)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def _clearance64(triangles: np.ndarray, kind: int, size: np.ndarray, T_ee_prim: np.ndarray, cap: float) -> float:
    """Least signed distance of the triangles' points (ee frame) to a primitive, below the cap."""
    tri = trimesh.transform_points(triangles.reshape(-1, 3), np.linalg.inv(T_ee_prim)).reshape(-1, 3, 3)
    best = min(cap, float(_signed64(kind, size, tri).min()))
    middle = tri.mean(axis=1)
    radius = np.linalg.norm(tri - middle[:, None], axis=-1).max(axis=1)
    tri = tri[_signed64(kind, size, middle) - radius < best - 1e-9]
    if len(tri) == 0:
        return best

    def along(u: np.ndarray) -> np.ndarray:  # least over the chord at fraction u from the first corner
        a = tri[:, 0] + u[:, None] * (tri[:, 1] - tri[:, 0])
        b = tri[:, 0] + u[:, None] * (tri[:, 2] - tri[:, 0])
        return _golden(lambda v: _signed64(kind, size, a + v[:, None] * (b - a)), len(tri))

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
        a, fa, b, fb = (
            np.where(left, new, b),
            np.where(left, f_new, fb),
            np.where(left, a, new),
            np.where(left, fa, f_new),
        )
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
        best = min(best, float(_signed64(robot.gripper.kind[i], robot.gripper.size[i], x).min()))
    for i in used:
        kind = robot.gripper.kind[i]
        size = robot.gripper.size[i] if kind == Kind.BOX else robot.gripper.size[i][:2]
        best = min(best, _clearance64(triangles, kind, size, T_ee_prim[i], best))
        center = trimesh.transform_points(T_ee_prim[i][:3, 3][None], T_obj_ee.astype(np.float64))
        if solid and _winding(mesh, center[0]) > 0.5:
            best = min(best, -float(size.min() if kind != Kind.CAPSULE else size[0]))
    return best


def _winding(mesh: trimesh.Trimesh, x: np.ndarray) -> float:
    """Solid angle of the surface seen from x over 4 pi (van Oosterom and Strackee)."""
    a, b, c = (mesh.triangles[:, k] - x for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    det = np.einsum("ij,ij->i", a, np.cross(b, c))
    div = (
        la * lb * lc
        + np.einsum("ij,ij->i", a, b) * lc
        + np.einsum("ij,ij->i", b, c) * la
        + np.einsum("ij,ij->i", c, a) * lb
    )
    return float(np.abs(np.arctan2(det, div).sum() / (2 * np.pi)))


def test_cut_agrees_with_float64_and_with_fcl() -> None:
    T, index = _grasps(84, seed=7)
    back = 0.09 * torch.rand(84, 1, generator=torch.Generator().manual_seed(0))
    T[:, :3, 3] -= T[:, :3, 2] * back * (torch.arange(84) % 4 != 0)[:, None]
    cap = 0.02
    cut, _ = open_clearance(_tables(), T, index, cap_m=cap)
    meshes = list(_shapes().values())
    robot = load_robot()
    T_ee_prim = gripper_primitives_at(robot, OPEN_GAP_M)
    seen = {"cut": 0, "near": 0, "far": 0}
    for i in range(len(T)):
        mesh, T_obj_ee = meshes[index[i]], T[i].double().numpy()
        twin = _gripper_clearance64(mesh, T_obj_ee, OPEN_GAP_M, cap, False, True)
        seen["cut" if twin < 0 else "near" if twin < cap else "far"] += 1
        assert float(cut[i]) == pytest.approx(twin, abs=2e-5), i
        if abs(float(cut[i])) > BAND:
            surface = _fcl_model(trimesh.transform_points(mesh.vertices, np.linalg.inv(T_obj_ee)), mesh.faces)
            hits = any(
                _fcl_hits(surface, *p) for p in zip(robot.gripper.kind, robot.gripper.size, T_ee_prim, strict=True)
            )
            centers = trimesh.transform_points(T_ee_prim[:, :3, 3], T_obj_ee)
            assert (hits or any(_winding(mesh, x) > 0.5 for x in centers)) == (float(cut[i]) < 0), i
    assert min(seen.values()) >= 8, seen


def _fcl_model(vertices: np.ndarray, faces: np.ndarray) -> fcl.BVHModel:
    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(vertices, faces)
    model.endModel()
    return model


def _fcl_hits(model: fcl.BVHModel, kind: int, size: np.ndarray, T: np.ndarray) -> bool:
    shape = (
        fcl.Box(*(2 * size))
        if kind == Kind.BOX
        else (fcl.Cylinder if kind == Kind.CYLINDER else fcl.Capsule)(size[0], 2 * size[1])
    )
    a, b = fcl.CollisionObject(model), fcl.CollisionObject(shape, fcl.Transform(T[:3, :3], T[:3, 3]))
    return fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()) > 0


def test_a_pad_wholly_inside_the_object_and_an_object_wholly_inside_the_palm_are_cuts() -> None:
    tables = grasp_tables(
        [_model(trimesh.creation.box((0.4, 0.4, 0.4))), _model(trimesh.creation.box((0.01, 0.01, 0.01)))]
    )
    robot = load_robot()
    pad = robot.gripper.names.index("left_pad")
    palm = gripper_primitives_at(robot, OPEN_GAP_M)[robot.gripper_part.index("body"), :3, 3]
    T = torch.tensor(np.stack([_at(), np.linalg.inv(_at(*palm))]), dtype=torch.float32)
    cut, part = open_clearance(tables, T, torch.tensor([0, 1], dtype=torch.int32), cap_m=0.001)
    assert cut[0] <= -robot.gripper.size[pad].min() and cut[1] < 0 and part[1] == robot.gripper_part.index("body")
    only_pad = T[:1].clone()
    assert close_gripper(tables, only_pad, torch.tensor([0], dtype=torch.int32)).margin_m.item() < 0


def test_touching_pads_pass_and_deeper_cuts_have_smaller_margins() -> None:
    tables = grasp_tables([_model(trimesh.creation.box((0.02, 0.03, 0.02)))])
    offsets = [0.0, 0.0274, 0.0276, 0.029, 0.0305]  # the box reaches y = offset + 15 mm; the pad begins at 42.5 mm
    T = torch.tensor(np.stack([np.linalg.inv(_at(y=y)) for y in offsets]), dtype=torch.float32)
    grasp = close_gripper(tables, T, torch.zeros(len(offsets), dtype=torch.int32))
    assert (grasp.margin_m[:2] > 0.05).all()
    assert grasp.margin_m[2].item() == pytest.approx(-1e-4, abs=1e-5)
    assert (grasp.margin_m[2:].diff() < -1e-4).all()


def test_region_distance_agrees_with_float64() -> None:
    T, index = _grasps(112, seed=11)
    opening = torch.tensor(np.random.default_rng(1).uniform(0, 0.085, len(T)), dtype=torch.float32)
    distance, part = region_distance(_tables(), T, index, opening)
    meshes = list(_shapes().values())
    seen = {"in": 0, "near": 0, "far": 0, "none": 0}
    for i in range(len(T)):
        if index[i] % 2:
            seen["none"] += 1
            assert torch.isnan(distance[i])
            continue
        mesh = meshes[index[i]]
        region = trimesh.Trimesh(mesh.vertices, mesh.faces[_upper(mesh)], process=False)
        twin = _gripper_clearance64(region, T[i].numpy(), float(opening[i]), 0.05, True, False)
        seen["in" if twin < 0 else "near" if twin < 0.05 else "far"] += 1
        assert float(distance[i]) == pytest.approx(twin, abs=2e-5), i
        assert (part[i] < 0) == (twin >= 0.05)
    assert min(seen.values()) >= 3, seen


def test_finger_poses_agree_with_the_robots_own() -> None:
    opening = torch.linspace(0.0, 0.087, 200)
    R, p = gripper_poses(opening)
    T = gripper_primitives_at(load_robot(), opening.double().numpy())
    np.testing.assert_allclose(R.numpy(), T[..., :3, :3], atol=1e-6)
    np.testing.assert_allclose(p.numpy(), T[..., :3, 3], atol=1e-6)
    assert gripper_tables("cpu").kind.shape[0] == T.shape[1]


@pytest.mark.parametrize("count", [0, 1, 2, 33])
def test_rows_do_not_depend_on_batch_order_or_threads(count: int) -> None:
    T, index = _grasps(66, seed=13)
    full = close_gripper(_tables(), T, index, threads=1)
    opening = torch.nan_to_num(full.width_m, nan=0.05)
    far, _ = region_distance(_tables(), T, index, opening, threads=1)
    rows = torch.randperm(66, generator=torch.Generator().manual_seed(count))[:count]
    for threads in (1, 2):
        part = close_gripper(_tables(), T[rows].contiguous(), index[rows].contiguous(), threads=threads)
        for name in ("width_m", "opening_m", "shift_m", "empty", "cut_m", "margin_m", "cut_part"):
            assert torch.equal(
                torch.nan_to_num(getattr(part, name).float()), torch.nan_to_num(getattr(full, name)[rows].float())
            )
        again, _ = region_distance(
            _tables(), T[rows].contiguous(), index[rows].contiguous(), opening[rows].contiguous(), threads=threads
        )
        assert torch.equal(torch.nan_to_num(again), torch.nan_to_num(far[rows]))


def test_no_rows_left_by_a_filter_are_no_rows() -> None:
    T, index = _grasps(4, seed=0)
    none = torch.zeros(4, dtype=torch.bool)
    empty = close_gripper(_tables(), T[none].contiguous(), index[none])
    assert all(len(getattr(empty, name)) == 0 for name in ("width_m", "opening_m", "cut_m", "margin_m"))


def test_wrong_shapes_types_and_indices_are_refused() -> None:
    T, index = _grasps(4, seed=0)
    bad = [((T[:, :3].contiguous(), index), "T_obj_ee"), ((T.double(), index), "T_obj_ee")]
    bad += [((T, index.long()), "object_index"), ((T, index + 99), "object_index")]
    for args, named in bad:
        with pytest.raises(ValueError, match=named):
            close_gripper(_tables(), *args)
    with pytest.raises(ValueError, match=r"pads.*whole"):
        close_gripper(_tables(), T, index, mode="object")  # type: ignore[arg-type]


def test_a_row_that_is_not_finite_leaves_its_neighbours_alone() -> None:
    T, index = _grasps(5, seed=17)
    bad = T.clone()
    bad[2] = torch.nan
    good, mixed = close_gripper(_tables(), T, index), close_gripper(_tables(), bad, index)
    rows = [0, 1, 3, 4]
    assert torch.equal(torch.nan_to_num(good.margin_m[rows]), torch.nan_to_num(mixed.margin_m[rows]))
    assert mixed.empty[2]
