"""A user's meshes: what is taken, mended, rebuilt or refused, and what is said about it."""

import warnings

import numpy as np
import pytest
import trimesh
from convex_twin import winding_number

from r2h_batch.bodies.objects import ObjectMeshError, build_object


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


def test_a_small_hole_is_filled():
    mesh = ball()
    south = int(np.argmin(mesh.vertices[:, 2]))
    away = (mesh.faces == south).any(axis=1)
    away[int(np.argmax(mesh.triangles_center[:, 2]))] = True
    model, said = built(trimesh.Trimesh(mesh.vertices, mesh.faces[~away], process=False))
    assert "filled 2 holes" in said and model.mesh.volume == pytest.approx(mesh.volume, rel=5e-3)


def test_an_open_sheet_is_rebuilt_as_a_hollow_shell_and_the_deviation_is_stated():
    mesh = trimesh.creation.cylinder(0.015, 0.03, sections=48)
    cup = trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.face_normals[:, 2] < 0.9], process=False)
    model, said = built(cup)
    assert "rebuilt by winding number" in said and "open sheets made" in said
    assert float(said.split("changed by up to ")[1].split(" mm")[0]) < 0.3
    assert abs(winding_number(np.zeros(3), model.mesh.triangles)) < 1e-6, "the cup must stay hollow"
    assert len(model.faces) <= 20_000
    assert np.abs(model.mesh.extents - cup.extents).max() < 3e-3


def test_two_faces_of_a_flat_sheet_enclose_nothing_and_are_rebuilt():
    corners = [[0, 0, 0], [0.04, 0, 0], [0.04, 0.04, 0], [0, 0.04, 0]]
    both = [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]]
    sheet = trimesh.Trimesh(corners, both, process=False)
    model, said = built(sheet)
    assert "made that thick" in said and model.mesh.volume > 5e-5 * 0.04**2
    wire = trimesh.creation.cylinder(2e-4, 0.1, sections=8)
    wire.apply_translation((0.0207, 0.0191, 0.05))
    model, said = built(trimesh.util.concatenate([sheet, wire]))
    assert "made that thick" in said and model.mesh.bounds[1, 2] == pytest.approx(0.1, abs=1e-6), (
        "the wire stays as it is"
    )
    assert np.ptp(model.vertices[model.vertices[:, 2] > 0.05], axis=0)[:2].max() == pytest.approx(4e-4, rel=1e-3)


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


@pytest.mark.parametrize("subdivisions", [6, pytest.param(8, marks=pytest.mark.slow)])
def test_up_to_a_million_faces_are_decimated_and_the_shape_stays(subdivisions):
    mesh = ball(subdivisions=subdivisions, radius=0.05)
    assert len(mesh.faces) == 20 * 4**subdivisions
    model, said = built(mesh)
    assert f"decimated {len(mesh.faces)} faces" in said
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


def test_labels_and_faces_of_a_file_are_carried_over_to_the_repaired_mesh(tmp_path):
    mesh = ball()
    holed = trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False)
    above = holed.triangles_center[:, 2] > 0
    for receiver in (above, np.flatnonzero(above)):
        model, said = built(
            holed, split="S1", receiver=receiver, face_part=above.astype(int), part_names=("low", "high")
        )
        assert "filled 1 holes" in said and len(model.faces) == len(mesh.faces)
        assert (model.receiver_face == (model.mesh.triangles_center[:, 2] > 0)).all()
        assert (model.face_part == model.receiver_face).all() and model.part_names == ("low", "high")
    with pytest.raises(ObjectMeshError, match="2 part labels for a mesh that has 1280 faces"):
        build_object(mesh, face_part=np.zeros(2, int), pieces=False)
    with pytest.raises(ObjectMeshError, match="labels go from 0 to 3; there are 2 part names"):
        build_object(mesh, face_part=np.arange(1280) % 4, part_names=("a", "b"), pieces=False)
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(ObjectMeshError, match=r"not a plain \.npy array"):
        build_object(mesh, split="S1", receiver=tmp_path / "objects.npy", pieces=False)


def test_long_thin_faces_fill_the_voxels_that_they_pass_and_no_others() -> None:
    from r2h_batch.bodies.solid import solid_occupancy

    rng = np.random.default_rng(1)
    for turn in range(3):
        ring = trimesh.creation.cylinder(
            0.05, 0.012, sections=90
        )  # its caps are fans of needles, as many a drawn mesh has
        ring.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)) if turn else np.eye(4))
        full, origin, pitch = solid_occupancy(ring, 40)
        share = rng.dirichlet((1, 1, 1), (len(ring.faces), 300))
        on = np.einsum("fnk,fkj->fnj", share, ring.triangles).reshape(-1, 3)
        assert full[tuple(np.floor((on - origin) / pitch).astype(int).T)].all()
        center = origin + (np.argwhere(full) + 0.5) * pitch
        along = ring.principal_inertia_vectors[np.argmax(ring.principal_inertia_components)]
        z = center @ along
        beside = np.maximum(np.linalg.norm(center - z[:, None] * along, axis=1) - 0.05, 0)
        assert (np.hypot(beside, np.maximum(np.abs(z) - 0.006, 0)) <= pitch * 3**0.5 / 2 + 1e-9).all()
