"""The 16 objects against the facts they must have, recomputed here; and a user's mesh, good, broken and repaired."""

import json
import sys
import warnings
from dataclasses import replace
from importlib import resources

import mujoco
import numpy as np
import pytest
import trimesh

from r2h_batch.objects import (
    OBJECT_NAMES,
    S0_NAMES,
    S1_NAMES,
    ObjectMeshError,
    build_object,
    load_objects,
    object_digest,
    object_from_argument,
)

TABLE = {  # scene.md: box in metres, mass in kg
    "game_controller": (0.155, 0.100, 0.055, 0.25), "bowl": (0.161, 0.160, 0.055, 0.147),
    "headphones": (0.190, 0.170, 0.075, 0.25), "eyeglasses": (0.140, 0.145, 0.045, 0.03),
    "cup": (0.100, 0.080, 0.080, 0.04), "wineglass": (0.172, 0.071, 0.071, 0.15),
    "hammer": (0.330, 0.126, 0.032, 0.665), "pliers": (0.180, 0.055, 0.012, 0.2),
    "knife": (0.155, 0.035, 0.018, 0.08), "toothbrush": (0.165, 0.023, 0.012, 0.018),
    "screwdriver": (0.216, 0.034, 0.033, 0.097), "scissors": (0.198, 0.088, 0.015, 0.082),
    "power_drill": (0.186, 0.184, 0.057, 0.895), "binoculars": (0.142, 0.109, 0.048, 0.35),
    "bottle": (0.250, 0.075, 0.075, 0.6), "trigger_sprayer": (0.290, 0.100, 0.075, 0.55),
}  # fmt: skip
REGION_PATCHES = {"pliers": 2, "scissors": 2}
WALLS = {"bowl": 2.8e-3, "cup": 2.4e-3, "wineglass": 2.3e-3}
every_object = pytest.mark.parametrize("name", OBJECT_NAMES)


def one(name):
    return load_objects([name])[0]


def winding_number(mesh, points):
    """Sum of solid angles over 4 pi, float64 (van Oosterom and Strackee): independent of the voxels' columns."""
    total = np.zeros(len(points))
    for i, p in enumerate(points):
        a, b, c = (mesh.triangles - p).transpose(1, 0, 2)
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        top = np.einsum("ij,ij->i", a, np.cross(b, c))
        dot = lambda u, v: np.einsum("ij,ij->i", u, v)  # noqa: E731
        bottom = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        total[i] = 2 * np.arctan2(top, bottom).sum() / (4 * np.pi)
    return total


def surface_distance(mesh, p):
    """Distance to the nearest triangle (trimesh's closest_point is 0.7 mm off on triangles of 0.2 mm)."""
    corners = mesh.triangles
    height = np.einsum("ij,ij->i", p - corners[:, 0], mesh.face_normals)
    foot = p - height[:, None] * mesh.face_normals
    within = np.ones(len(corners), bool)
    best = np.inf
    for k in range(3):
        a, e = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        within &= np.einsum("ij,ij->i", np.cross(e, foot - a), mesh.face_normals) >= 0
        t = np.clip(np.einsum("ij,ij->i", p - a, e) / np.einsum("ij,ij->i", e, e), 0, 1)
        best = min(best, np.linalg.norm(p - a - t[:, None] * e, axis=1).min())
    return min(best, np.abs(height[within]).min(initial=np.inf))


def first_exit(mesh, origin, direction):
    """(t, face) of the nearest crossing of a ray beyond 1e-5 m."""
    a, b, c = mesh.triangles.transpose(1, 0, 2)
    e, f = b - a, c - a
    h = np.cross(direction, f)
    det = np.einsum("ij,ij->i", e, h)
    det = np.where(np.abs(det) < 1e-18, np.inf, det)
    s = origin - a
    u = np.einsum("ij,ij->i", s, h) / det
    q = np.cross(s, e)
    v = q @ direction / det
    t = np.einsum("ij,ij->i", f, q) / det
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-5), t, np.inf)
    return t.min(), int(np.argmin(t))


def patches(mesh, chosen):
    """Faces of every connected patch of the chosen faces."""
    pairs = mesh.face_adjacency
    pairs = pairs[chosen[pairs].all(axis=1)]
    return trimesh.graph.connected_components(pairs, nodes=np.flatnonzero(chosen))


def planes(mesh):
    return mesh.face_normals, np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles[:, 0])


def test_the_sixteen_objects_come_in_benchmark_order_with_their_splits():
    models = load_objects()
    assert [m.name for m in models] == list(OBJECT_NAMES) == list(TABLE)
    assert [m.split for m in models] == ["S0"] * len(S0_NAMES) + ["S1"] * len(S1_NAMES)
    with pytest.raises(ValueError, match="unknown object 'spoon'"):
        load_objects(["spoon"])


@every_object
def test_each_object_is_one_closed_outward_body_of_the_tables_size_and_mass(name):
    model = one(name)
    mesh = model.mesh
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0 and mesh.body_count == 1
    assert np.abs(np.sort(mesh.extents) / np.sort(TABLE[name][:3]) - 1).max() <= 0.10
    assert model.mass == pytest.approx(TABLE[name][3])
    assert np.abs(mesh.bounds.mean(axis=0)).max() < 1e-7
    assert 1000 <= len(mesh.faces) <= 8000
    assert model.vertices.dtype == np.float32 and model.faces.dtype == np.int32
    assert len(np.unique(model.vertices, axis=0)) == len(model.vertices)


@every_object
def test_triangles_are_even_and_no_slivers(name):
    mesh = one(name).mesh
    longest = mesh.edges_unique_length[mesh.faces_unique_edges].max(axis=1)
    quality = mesh.area_faces / (longest**2 * np.sqrt(3) / 4)  # 1 for an equilateral triangle
    assert np.median(quality) > 0.5
    assert np.quantile(quality, 0.02) > 0.10
    assert longest.max() < 9e-3


@every_object
def test_part_labels_are_clean_patches_and_all_used(name):
    model = one(name)
    mesh = model.mesh
    assert len(model.face_part) == len(model.receiver_face) == len(model.faces)
    assert set(model.face_part.tolist()) == set(range(len(model.part_names)))
    for k, part in enumerate(model.part_names):
        smallest = min(mesh.area_faces[p].sum() for p in patches(mesh, model.face_part == k))
        assert smallest > 1e-6, f"{part}: a speck of {smallest * 1e6:.2f} mm^2"


@every_object
def test_only_s1_objects_have_a_receiver_region_and_leave_the_robot_enough(name):
    model = one(name)
    share = model.mesh.area_faces[model.receiver_face].sum() / model.mesh.area
    if model.split == "S0":
        assert not model.receiver_face.any()
        return
    assert 0.1 < share < 0.85
    assert len(patches(model.mesh, model.receiver_face)) == REGION_PATCHES.get(name, 1)
    assert model.instruction.startswith("hand over the ") and model.instruction.endswith(" to human")


@every_object
def test_a_gripper_of_85_mm_finds_opposite_faces_and_for_s1_a_quarter_of_them_off_the_region(name):
    model = one(name)
    mesh = model.mesh
    pairs, free = 0, 0
    for k in range(0, 2048, 8):
        normal = model.normals[k].astype(float)
        t, face = first_exit(mesh, model.points[k].astype(float), -normal)
        if t <= 0.085 and mesh.face_normals[face] @ normal < -0.9:
            pairs += 1
            free += not (model.receiver_face[face] or model.receiver_face[model.point_face[k]])
    assert pairs >= 20
    assert free >= 0.25 * pairs or (name == "screwdriver" and free >= 0.1 * pairs)


@every_object
def test_the_hull_is_convex_moderate_and_encloses_the_mesh_closely(name):
    model = one(name)
    hull = trimesh.Trimesh(model.hull_vertices.astype(float), model.hull_faces, process=False)
    assert hull.is_watertight and hull.is_winding_consistent and len(hull.vertices) <= 256
    normal, offset = planes(hull)
    assert (hull.vertices @ normal.T - offset).max() < 1e-7, "not convex"
    assert (model.vertices @ normal.T - offset).max() < 1e-7, "a vertex of the mesh is outside"
    exact = trimesh.convex.convex_hull(model.vertices.astype(float))
    normal, offset = planes(exact)
    assert (hull.vertices @ normal.T - offset).max() < 1e-3
    assert 0.9999 < hull.volume / exact.volume < 1.04


@every_object
def test_convex_pieces_are_few_convex_and_cover_the_mesh(name):
    model = one(name)
    assert 2 <= len(model.pieces) <= 16
    depth = np.full(len(model.points), np.inf)
    volume = 0.0
    for vertices, faces in model.pieces:
        piece = trimesh.Trimesh(vertices.astype(float), faces, process=False)
        normal, offset = planes(piece)
        assert piece.is_watertight and (piece.vertices @ normal.T - offset).max() < 1e-7
        depth = np.minimum(depth, (model.points @ normal.T - offset).max(axis=1))
        volume += piece.volume
    assert depth.max() < 1e-4, "the pieces leave more than 0.1 mm of the surface outside"
    hull = trimesh.Trimesh(model.hull_vertices.astype(float), model.hull_faces, process=False)
    assert model.mesh.volume < 1.001 * volume
    assert volume < max(0.6 * hull.volume, 1.25 * model.mesh.volume)


@every_object
def test_surface_points_lie_on_their_faces_with_their_normals_labels_and_fair_shares(name):
    model = one(name)
    mesh = model.mesh
    assert model.points.shape == model.normals.shape == (2048, 3)
    corners = mesh.triangles[model.point_face]
    weight = trimesh.triangles.points_to_barycentric(corners, model.points.astype(float))
    assert weight.min() > -1e-4 and weight.max() < 1 + 1e-4
    assert np.abs(np.einsum("ij,ijk->ik", weight, corners) - model.points).max() < 1e-7
    assert np.abs(model.normals - mesh.face_normals[model.point_face]).max() < 1e-6
    assert (model.point_part == model.face_part[model.point_face]).all()
    share = np.bincount(model.face_part, mesh.area_faces, len(model.part_names)) / mesh.area
    assert np.abs(np.bincount(model.point_part, minlength=len(share)) / 2048 - share).max() < 0.012


@every_object
def test_voxels_agree_with_solid_angles_and_the_surface(name):
    model = one(name)
    occupancy = model.occupancy
    assert occupancy.shape == (64, 64, 64) and model.voxels.nbytes == 64**3 // 8
    rng = np.random.default_rng(3)
    grown = np.array([np.roll(occupancy, s, axis) for axis in range(3) for s in (-1, 1)]).any(axis=0)
    near = np.argwhere(occupancy | grown)
    ijk = np.concatenate([near[rng.choice(len(near), 220)], rng.integers(0, 64, (40, 3))])
    center = model.voxel_origin + (ijk + 0.5) * model.voxel_pitch
    inside = winding_number(model.mesh, center) > 0.5
    full = occupancy[tuple(ijk.T)]
    assert full[inside].all()
    for c in center[full & ~inside][:40]:
        assert surface_distance(model.mesh, c) <= model.voxel_pitch * np.sqrt(3) / 2 + 1e-9
    touched = np.floor((model.points - model.voxel_origin) / model.voxel_pitch).astype(int)
    assert occupancy[tuple(touched.T)].all(), "a voxel with surface in it is empty"
    assert not occupancy[0].any() and not occupancy[-1].any()


@pytest.mark.parametrize("name", WALLS)
def test_bowl_cup_and_wineglass_are_hollow_with_thin_walls(name):
    model = one(name)
    z = {"bowl": 0.005, "cup": 0.0, "wineglass": 0.045}[name]
    assert abs(winding_number(model.mesh, np.array([[0.0, 0.0, z]]))[0]) < 1e-6
    voxel = np.floor((np.array([0.0, 0.0, z]) - model.voxel_origin) / model.voxel_pitch).astype(int)
    assert not model.occupancy[tuple(voxel)]
    outer = model.points[np.abs(model.points[:, 2] - z) < 0.01].astype(float)
    normal = model.normals[np.abs(model.points[:, 2] - z) < 0.01].astype(float)
    wall = [first_exit(model.mesh, p, -n)[0] for p, n in zip(outer, normal)]
    assert 1.8e-3 < np.median(wall) < 3.5e-3


@every_object
def test_mass_center_and_inertia_agree_with_mujocos(name):
    model = one(name)
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="m")
    mesh.uservert, mesh.userface = model.vertices.ravel(), model.faces.ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT
    body = spec.worldbody.add_body(name="b")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m", mass=model.mass)
    compiled = spec.compile()
    b = compiled.body("b")
    assert b.ipos == pytest.approx(model.com, abs=2e-6)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, b.iquat)
    rotation = rotation.reshape(3, 3)
    reference = rotation @ np.diag(b.inertia) @ rotation.T
    assert np.abs(model.inertia - reference).max() < 1e-4 * np.trace(reference)


def test_the_digest_is_that_of_the_report_and_sees_one_moved_vertex():
    models = load_objects()
    with resources.files("r2h_batch.assets.objects").joinpath("report.json").open() as file:
        report = json.load(file)
    assert object_digest(models) == report["digest"]
    assert {m.name: object_digest(m) for m in models} == {n: r["digest"] for n, r in report["objects"].items()}
    moved = models[0].vertices.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], np.float32(1))
    assert object_digest(replace(models[0], vertices=moved)) != object_digest(models[0])


def test_arrays_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        one("bowl").vertices[0] = 0


def test_the_build_script_makes_the_committed_arrays_again():
    pytest.importorskip("coacd")
    pytest.importorskip("manifold3d")
    from r2h_batch.assets.objects.build_objects import SPECS, build

    assert set(SPECS) == set(OBJECT_NAMES)
    assert object_digest(build(SPECS["screwdriver"])) == object_digest(one("screwdriver"))


# A user's own mesh


def ball(subdivisions=3, radius=0.04):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def brick(x=0.10, y=0.04, z=0.03):
    return trimesh.creation.box((x, y, z)).subdivide().subdivide()


def built(mesh, **options):
    """The object, and the text of its warnings."""
    options.setdefault("pieces", False)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = build_object(mesh, **options)
    assert model.mesh.is_watertight and model.mesh.is_winding_consistent and model.mesh.volume > 0
    return model, " | ".join(str(w.message) for w in caught)


@pytest.mark.parametrize("suffix", ["obj", "ply", "off", "glb"])
def test_a_good_file_is_taken_as_it_is_in_its_own_frame(tmp_path, suffix):
    mesh = brick()
    mesh.apply_translation((0.02, 0.0, 0.3))
    path = tmp_path / f"brick.{suffix}"
    mesh.export(path)
    model, said = built(path, mass=0.2)
    assert said == ""
    assert model.name == "brick" and model.split == "S0" and model.part_names == ("body",)
    assert model.mesh.bounds == pytest.approx(mesh.bounds, abs=1e-6)
    assert model.com == pytest.approx((0.02, 0, 0.3), abs=1e-6)
    assert model.inertia[0, 0] == pytest.approx(0.2 / 12 * (0.04**2 + 0.03**2), rel=1e-5)
    assert model.occupancy.sum() * model.voxel_pitch**3 == pytest.approx(mesh.volume, rel=0.25)


def test_an_stl_has_its_corners_merged_and_says_so(tmp_path):
    brick().export(tmp_path / "brick.stl")
    model, said = built(tmp_path / "brick.stl")
    assert "merged" in said and "duplicate vertices" in said
    assert len(model.vertices) == len(brick().vertices)
    assert model.mass == pytest.approx(600 * 0.10 * 0.04 * 0.03, rel=1e-5)


def test_files_that_are_no_meshes_are_refused_with_what_to_do(tmp_path):
    (tmp_path / "empty.obj").write_text("")
    (tmp_path / "nothing.obj").write_text("# no faces\nv 0 0 0\n")
    (tmp_path / "noise.glb").write_bytes(b"\x00\x01noise")
    (tmp_path / "noise.stl").write_bytes(b"\x00" * 40)
    (tmp_path / "mesh.txt").write_text("v 0 0 0")
    trimesh.PointCloud(np.eye(3) * 0.1).export(tmp_path / "cloud.ply")
    for name, text in {
        "missing.obj": "no file .*missing.obj",
        "empty.obj": "is empty",
        "nothing.obj": "nothing.obj is empty",
        "noise.glb": "cannot be read",
        "noise.stl": "noise.stl is empty",
        "mesh.txt": r"is not one of \.obj, \.stl",
        "cloud.ply": "cloud.ply is empty: no triangles",
    }.items():
        with pytest.raises(ObjectMeshError, match=text):
            build_object(tmp_path / name)


def test_empty_infinite_and_ill_indexed_meshes_are_refused():
    with pytest.raises(ObjectMeshError, match=r"empty .0 vertices, 0 faces"):
        build_object(trimesh.Trimesh())
    for bad in (np.nan, np.inf):
        mesh = brick()
        mesh.vertices[7, 1] = bad
        with pytest.raises(ObjectMeshError, match="1 vertices are not finite"):
            build_object(mesh)
    mesh = brick()
    with pytest.raises(ObjectMeshError, match="names vertex 999999"):
        build_object(trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, [0, 1, 999999]]), process=False))


def test_millimetres_and_other_units_are_refused_and_scale_mends_them():
    thousandfold = brick(100, 40, 30)
    with pytest.raises(ObjectMeshError, match=r"largest side is 100 m.*scale=0.001"):
        build_object(thousandfold)
    model, said = built(thousandfold, scale=0.001)
    assert model.mesh.extents == pytest.approx((0.1, 0.04, 0.03), abs=1e-7) and said == ""
    with pytest.raises(ObjectMeshError, match=r"largest side is 0\.0001 m"):
        build_object(brick(1e-4, 4e-5, 3e-5))
    for scale in (0.0, -1.0, np.nan):
        with pytest.raises(ObjectMeshError, match="scale is"):
            build_object(brick(), scale=scale)
    far = brick()
    far.apply_translation((0, 30, 0))
    with pytest.raises(ObjectMeshError, match=r"more than 10\.0 m from the origin"):
        build_object(far)


def test_degenerate_and_repeated_faces_are_dropped_by_name():
    mesh = brick()
    faces = np.vstack([mesh.faces, [3, 3, 5], [4, 9, 4], mesh.faces[10], np.roll(mesh.faces[11], 1)])
    model, said = built(trimesh.Trimesh(mesh.vertices, faces, process=False))
    assert "dropped 2 degenerate faces" in said and "dropped 2 repeated faces" in said
    assert (model.faces == mesh.faces).all()


def test_wrong_winding_is_mended():
    mesh = ball()
    faces = mesh.faces.copy()
    faces[::7] = faces[::7, ::-1]
    model, said = built(trimesh.Trimesh(mesh.vertices, faces, process=False))
    assert "turned" in said and model.mesh.volume == pytest.approx(mesh.volume, rel=1e-5)
    model, said = built(trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False))
    assert "inside-out" in said and model.mesh.volume == pytest.approx(mesh.volume, rel=1e-5)


def test_nearly_equal_vertices_are_welded():
    mesh = ball()
    rng = np.random.default_rng(0)
    soup = mesh.triangles.reshape(-1, 3) + rng.uniform(-2e-7, 2e-7, (3 * len(mesh.faces), 3))
    model, said = built(trimesh.Trimesh(soup, np.arange(len(soup)).reshape(-1, 3), process=False))
    assert "welded" in said and model.mesh.volume == pytest.approx(mesh.volume, rel=1e-3)


def test_a_small_hole_is_filled():
    mesh = ball()
    south = int(np.argmin(mesh.vertices[:, 2]))
    away = (mesh.faces == south).any(axis=1)
    away[int(np.argmax(mesh.triangles_center[:, 2]))] = True
    model, said = built(trimesh.Trimesh(mesh.vertices, mesh.faces[~away], process=False))
    assert "filled 2 holes" in said and model.mesh.volume == pytest.approx(mesh.volume, rel=5e-3)


def test_an_open_sheet_is_rebuilt_as_a_hollow_shell_and_the_deviation_is_stated():
    mesh = trimesh.creation.cylinder(0.035, 0.09, sections=48)
    cup = trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.face_normals[:, 2] < 0.9], process=False)
    model, said = built(cup)
    assert "rebuilt from its distance field" in said and "open sheets made" in said and "largest deviation" in said
    assert float(said.split("largest deviation ")[1].split(" mm")[0]) < 2.0
    assert abs(winding_number(model.mesh, np.array([[0.0, 0, 0]]))[0]) < 1e-6, "the cup must stay hollow"
    assert len(model.faces) <= 20_000
    assert np.abs(model.mesh.extents - cup.extents).max() < 3e-3


def test_two_faces_of_a_flat_sheet_enclose_nothing_and_are_rebuilt():
    corners = [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]]
    both = [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]]
    sheet = trimesh.Trimesh(corners, both, process=False)
    model, said = built(sheet)
    assert "open sheets made" in said and model.mesh.volume > 0.5e-5 * 0.1
    wire = trimesh.creation.cylinder(2e-4, 0.1, sections=8)
    wire.apply_translation((0.0507, 0.0491, 0.05))
    model, said = built(trimesh.util.concatenate([sheet, wire]))
    assert "to keep thin parts" in said and model.mesh.bounds[1, 2] > 0.099


def test_overlapping_bodies_are_united_and_a_cavity_stays():
    slab, other = brick(), brick()
    other.apply_translation((0.05, 0.01, 0.005))
    model, said = built(trimesh.util.concatenate([slab, other]))
    overlap = 0.05 * 0.03 * 0.025
    assert "united 2 overlapping bodies" in said
    assert model.mesh.volume == pytest.approx(2 * slab.volume - overlap, rel=1e-4)
    hollow = ball(3, 0.02)
    hollow.invert()
    model, said = built(trimesh.util.concatenate([ball(3, 0.04), hollow]))
    assert said == "" and model.mesh.volume == pytest.approx(ball(3, 0.04).volume - ball(3, 0.02).volume, rel=1e-4)
    assert not model.occupancy[32, 32, 32]


def test_a_million_faces_are_decimated_and_the_shape_stays():
    mesh = ball(subdivisions=8, radius=0.05)
    assert len(mesh.faces) > 1_000_000
    model, said = built(mesh)
    assert "decimated 1310720 faces" in said
    assert len(model.faces) <= 20_000 and model.mesh.volume == pytest.approx(mesh.volume, rel=5e-3)


def test_a_receiver_region_can_be_given_in_four_ways(tmp_path):
    mesh = brick()
    with pytest.warns(UserWarning, match="no receiver region given for an S1 object; taking"):
        model = build_object(mesh, split="S1", pieces=False)
    assert model.receiver_face.any() and not model.receiver_face.all()
    low = mesh.triangles_center[:, 0] < -0.02
    np.save(tmp_path / "region.npy", low)
    for receiver in ("x<0.3", low, np.flatnonzero(low), tmp_path / "region.npy"):
        model, said = built(mesh, split="S1", receiver=receiver)
        assert said == "" and (model.receiver_face == low).all()


def test_the_default_region_is_the_lighter_half():
    head = brick(0.02, 0.08, 0.03)
    head.apply_translation((0.055, 0, 0))
    with pytest.warns(UserWarning, match="'x<0.5'"):
        model = build_object(trimesh.util.concatenate([brick(), head]), split="S1", pieces=False)
    assert model.mesh.triangles_center[model.receiver_face, 0].max() < 0.02


@pytest.mark.parametrize(
    ("receiver", "text"),
    [
        ("x<0.0", "region is empty"),
        ("x<2", "region is the whole object"),
        ("handle", "neither an existing .npy file nor"),
        (np.array([0, 10**6]), "receiver array is int64"),
        (np.array([-1]), "receiver array is int64"),
        (np.ones(3, bool), "receiver array is bool"),
        (np.ones(3), "receiver array is float64"),
    ],
)
def test_bad_receiver_regions_are_refused(receiver, text):
    with pytest.raises(ObjectMeshError, match=text):
        build_object(brick(), split="S1", receiver=receiver, pieces=False)


def test_labels_of_a_mesh_that_had_to_be_repaired_are_refused(tmp_path):
    mesh = ball()
    holed = trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False)
    with (
        pytest.warns(UserWarning, match="filled 1 holes"),
        pytest.raises(ObjectMeshError, match="had to be repaired"),
    ):
        build_object(holed, split="S1", receiver=np.arange(20), pieces=False)
    with pytest.raises(ObjectMeshError, match="2 part labels for a mesh"):
        build_object(mesh, face_part=np.zeros(2, int), pieces=False)
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(ObjectMeshError, match=r"not a plain \.npy array"):
        build_object(mesh, split="S1", receiver=tmp_path / "objects.npy", pieces=False)


def test_wrong_options_are_refused():
    with pytest.raises(ValueError, match="split is 'S2'"):
        build_object(brick(), split="S2")
    with pytest.raises(ValueError, match="for an S0 object"):
        build_object(brick(), receiver="x<0.3")
    with pytest.raises(ValueError, match="mass is -1"):
        build_object(brick(), mass=-1)


def test_the_command_lines_form_names_file_split_and_region(tmp_path):
    brick().export(tmp_path / "saw.ply")
    assert object_from_argument(f"{tmp_path}/saw.ply").split == "S0"
    model = object_from_argument(f"{tmp_path}/saw.ply:S1:x>0.6")
    assert model.split == "S1" and model.mesh.triangles_center[model.receiver_face, 0].min() > 0.009
    with pytest.raises(ValueError, match="split is 'S3'"):
        object_from_argument(f"{tmp_path}/saw.ply:S3")


def test_without_coacd_the_hull_is_the_only_piece_and_without_manifold3d_rebuilding_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.warns(UserWarning, match="coacd is not installed"):
        model = build_object(brick())
    assert len(model.pieces) == 1 and len(model.pieces[0][0]) == len(model.hull_vertices)
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    mesh = ball()
    half = trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.triangles_center[:, 2] > 0], process=False)
    with pytest.raises(ObjectMeshError, match=r"manifold3d is needed to close its surface; .pip install"):
        build_object(half)
