"""A user's meshes: what is taken, mended, rebuilt or refused, and what is said about it."""

import warnings

import numpy as np
import pytest
import trimesh

from r2h_batch.scene.objects import ObjectMeshError, build_object
from r2h_batch.scene.solid import solid_occupancy


def ball(radius=0.04):
    return trimesh.creation.icosphere(subdivisions=3, radius=radius)


def brick(x=0.10, y=0.04, z=0.03):
    return trimesh.creation.box((x, y, z)).subdivide().subdivide()


def plain(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False)


def built(mesh, **options):
    """The object, and the text of its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = build_object(mesh, pieces=False, **options)
    assert model.mesh.is_watertight and model.mesh.is_winding_consistent and model.mesh.volume > 0
    return model, " | ".join(str(w.message) for w in caught)


@pytest.mark.parametrize("suffix", ["obj", "ply", "off", "glb", "stl"])
def test_a_good_file_is_taken_as_it_is_in_its_own_frame(tmp_path, suffix):
    mesh = brick().apply_translation((0.02, 0.0, 0.3))
    path = tmp_path / f"brick.{suffix}"
    mesh.export(path)
    model, said = built(path)
    assert said == "" or (suffix == "stl" and "merged" in said and "duplicate vertices" in said)
    assert model.name == "brick" and model.split == "S0" and model.part_names == ("body",)
    assert len(model.vertices) == len(mesh.vertices) and model.mesh.bounds == pytest.approx(mesh.bounds, abs=1e-6)
    assert model.com == pytest.approx((0.02, 0, 0.3), abs=1e-6)
    assert model.mass == pytest.approx(600 * 0.10 * 0.04 * 0.03, rel=1e-5)
    assert model.inertia[0, 0] == pytest.approx(model.mass / 12 * (0.04**2 + 0.03**2), rel=1e-5)
    assert model.occupancy.sum() * model.voxel_pitch**3 == pytest.approx(mesh.volume, rel=0.25)


def test_files_that_are_no_meshes_are_refused_with_what_to_do(tmp_path):
    (tmp_path / "empty.obj").write_text("")
    (tmp_path / "nothing.obj").write_text("# no faces\nv 0 0 0\n")
    (tmp_path / "noise.glb").write_bytes(b"\x00\x01noise")
    (tmp_path / "mesh.txt").write_text("v 0 0 0")
    (tmp_path / "named.stl").write_text("# of a modeller\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "words.stl").write_text("a mesh\n")
    (tmp_path / "pulled.stl").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n")
    for name, text in {
        "missing.obj": "no file .*missing.obj",
        "empty.obj": "is empty",
        "nothing.obj": "nothing.obj is empty: no triangles",
        "noise.glb": "cannot be read",
        "named.stl": r"named\.stl is text without a facet, so no STL; rename it \.obj",
        "words.stl": r"words\.stl is text without a facet, so no STL; export it as STL",
        "pulled.stl": r"pulled\.stl is a pointer of Git LFS, not the mesh; run git lfs pull",
        "mesh.txt": r"is not one of \.obj, \.stl",
    }.items():
        with pytest.raises(ObjectMeshError, match=text):
            build_object(tmp_path / name)


def test_empty_infinite_and_ill_indexed_meshes_are_refused():
    with pytest.raises(ObjectMeshError, match=r"empty .0 vertices, 0 faces"):
        build_object(trimesh.Trimesh())
    mesh = brick()
    with pytest.raises(ObjectMeshError, match="names vertex 999999"):
        build_object(plain(mesh.vertices, np.vstack([mesh.faces, [0, 1, 999999]])))
    with pytest.raises(ObjectMeshError, match="none of its 192 faces has three corners apart"):
        build_object(plain(mesh.vertices * [1.0, 0.0, 0.0], mesh.faces))  # a line
    mesh.vertices[7, 1] = np.nan
    with pytest.raises(ObjectMeshError, match="1 vertices are not finite"):
        build_object(mesh)


def test_millimetres_and_other_units_are_refused_and_scale_mends_them():
    thousandfold = brick(100, 40, 30)
    model, said = built(thousandfold, scale=0.001)
    assert model.mesh.extents == pytest.approx((0.1, 0.04, 0.03), abs=1e-7) and said == ""
    for mesh, scale, words in (
        (thousandfold, 1.0, r"largest side is 100 m.*scale=0.001"),
        (brick(1e-4, 4e-5, 3e-5), 1.0, r"largest side is 0\.0001 m"),
        (brick(), -1.0, "scale is"),
        (brick().apply_translation((0, 30, 0)), 1.0, r"more than 10\.0 m from the origin"),
    ):
        with pytest.raises(ObjectMeshError, match=words):
            build_object(mesh, scale=scale)


def test_faces_are_dropped_turned_and_filled_in_by_name():
    mesh, whole = brick(), ball()
    faces = np.vstack([mesh.faces, [3, 3, 5], [4, 9, 4], mesh.faces[10], np.roll(mesh.faces[11], 1)])
    model, said = built(plain(mesh.vertices, faces))
    assert "dropped 2 degenerate faces" in said and "dropped 2 repeated faces" in said
    assert (model.faces == mesh.faces).all()
    some = whole.faces.copy()
    some[::7] = some[::7, ::-1]
    south = int(np.argmin(whole.vertices[:, 2]))
    away = (whole.faces == south).any(axis=1)
    away[int(np.argmax(whole.triangles_center[:, 2]))] = True
    for faces, words, rel in (
        (some, "turned", 1e-5),
        (whole.faces[:, ::-1], "inside-out", 1e-5),
        (whole.faces[~away], "filled 2 holes", 5e-3),
    ):
        model, said = built(plain(whole.vertices, faces))
        assert words in said and model.mesh.volume == pytest.approx(whole.volume, rel=rel)


def test_two_faces_of_a_flat_sheet_enclose_nothing_and_are_rebuilt_and_a_wire_beside_them_stays():
    corners = [[0, 0, 0], [0.04, 0, 0], [0.04, 0.04, 0], [0, 0.04, 0]]
    sheet = plain(corners, [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])
    wire = trimesh.creation.cylinder(2e-4, 0.1, sections=8).apply_translation((0.0207, 0.0191, 0.05))
    model, said = built(trimesh.util.concatenate([sheet, wire]))
    assert "made that thick" in said and model.mesh.volume > 5e-5 * 0.04**2
    assert model.mesh.bounds[1, 2] == pytest.approx(0.1, abs=1e-6)
    assert np.ptp(model.vertices[model.vertices[:, 2] > 0.05], axis=0)[:2].max() == pytest.approx(4e-4, rel=1e-3)


def test_overlapping_bodies_are_united_and_a_cavity_stays():
    slab, other = brick(), brick().apply_translation((0.05, 0.01, 0.005))
    model, said = built(trimesh.util.concatenate([slab, other]))
    assert "united 2 overlapping bodies" in said
    assert model.mesh.volume == pytest.approx(2 * slab.volume - 0.05 * 0.03 * 0.025, rel=1e-4)
    hollow = ball(0.02)
    hollow.invert()
    model, said = built(trimesh.util.concatenate([ball(), hollow]))
    assert said == "" and model.mesh.volume == pytest.approx(ball().volume - ball(0.02).volume, rel=1e-4)
    assert not model.occupancy[32, 32, 32]


@pytest.mark.parametrize("subdivisions", [5, pytest.param(8, marks=pytest.mark.slow)])
def test_up_to_a_million_faces_are_decimated_and_the_shape_stays(subdivisions):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.05)
    model, said = built(mesh)
    assert f"decimated {20 * 4**subdivisions} faces" in said
    assert len(model.faces) <= 20_000 and model.mesh.volume == pytest.approx(mesh.volume, rel=5e-3)


def test_a_receiver_region_can_be_given_in_four_ways(tmp_path):
    mesh = brick()
    with pytest.raises(ObjectMeshError, match="an S1 object needs the receiver's region"):
        build_object(mesh, split="S1", pieces=False)
    low = mesh.triangles_center[:, 0] < -0.02
    np.save(tmp_path / "region.npy", low)
    for receiver in ("x<0.3", low, np.flatnonzero(low), tmp_path / "region.npy"):
        model, said = built(mesh, split="S1", receiver=receiver)
        assert said == "" and (model.receiver_face == low).all()


def test_labels_and_faces_of_a_file_are_carried_over_to_the_repaired_mesh(tmp_path):
    mesh, names = ball(), ("low", "high")
    holed = plain(mesh.vertices, mesh.faces[1:])
    above = holed.triangles_center[:, 2] > 0
    for receiver in (above, np.flatnonzero(above)):
        model, said = built(holed, split="S1", receiver=receiver, face_part=above.astype(int), part_names=names)
        assert "filled 1 holes" in said and len(model.faces) == len(mesh.faces)
        assert (model.receiver_face == (model.mesh.triangles_center[:, 2] > 0)).all()
        assert (model.face_part == model.receiver_face).all() and model.part_names == names
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    for options, words in (
        ({"face_part": np.zeros(2, int)}, "2 part labels for a mesh that has 1280 faces"),
        ({"face_part": np.arange(1280) % 4, "part_names": names}, "labels go from 0 to 3; there are 2 part names"),
        ({"split": "S1", "receiver": tmp_path / "objects.npy"}, r"not a plain \.npy array"),
    ):
        with pytest.raises(ObjectMeshError, match=words):
            build_object(mesh, pieces=False, **options)


def test_long_thin_faces_fill_the_voxels_that_they_pass_and_no_others() -> None:
    rng = np.random.default_rng(1)
    for turn in (np.eye(4), trimesh.transformations.random_rotation_matrix(rng.random(3))):
        ring = trimesh.creation.cylinder(0.05, 0.012, sections=90)  # its caps are fans of needles, as drawn meshes have
        ring.apply_transform(turn)
        full, origin, pitch = solid_occupancy(ring, 40)
        share = rng.dirichlet((1, 1, 1), (len(ring.faces), 300))
        on = np.einsum("fnk,fkj->fnj", share, ring.triangles).reshape(-1, 3)
        assert full[tuple(np.floor((on - origin) / pitch).astype(int).T)].all()
        center = origin + (np.argwhere(full) + 0.5) * pitch
        z = center @ turn[:3, 2]
        beside = np.maximum(np.linalg.norm(center - z[:, None] * turn[:3, 2], axis=1) - 0.05, 0)
        assert (np.hypot(beside, np.maximum(np.abs(z) - 0.006, 0)) <= pitch * 3**0.5 / 2 + 1e-9).all()
