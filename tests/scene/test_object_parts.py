"""Parts of a user's object out of its file's named groups, the receiver's region by a part's name, and builds kept on disk."""

import warnings

import numpy as np
import pytest
import trimesh

from r2h_batch.base.errors import FileError
from r2h_batch.scene import objects
from r2h_batch.scene.build_ahead import build_ahead
from r2h_batch.scene.mesh_import.cache import key_of
from r2h_batch.scene.objects import ObjectMeshError, build_object, is_built, object_digest, object_from_argument
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.edit import edited


def block(x0, x1):
    return trimesh.creation.box((x1 - x0, 0.02, 0.02)).apply_translation(((x0 + x1) / 2, 0, 0))


def obj_text(kind):
    """Two boxes that touch at x = 0, quads as Blender writes them, with groups, materials and normals' numbers."""
    lines, count = ["mtllib ../../etc/passwd", "s off"], 0
    for name, (x0, x1) in (("handle", (-0.1, 0.0)), ("blade #1", (0.0, 0.08))):
        lines += [f"v {x} {y} {z}" for x in (x0, x1) for y in (-0.01, 0.01) for z in (-0.01, 0.01)]
        lines.append(f"{kind} {name}")
        quads = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
        for quad in quads:
            relative = count == 0  # the first body by numbers from the end
            lines.append("f " + " ".join(f"{q - 9 if relative else q + count}//1" for q in quad))
        count += 8
    return "\n".join(lines)


@pytest.mark.parametrize("kind", ["g", "o"])
def test_named_groups_of_an_obj_are_parts_and_name_the_receivers_region(tmp_path, kind):
    (tmp_path / "knife.obj").write_text(obj_text(kind))
    model = object_from_argument(f"{tmp_path}/knife.obj:S1:handle", pieces=False)
    assert model.part_names == ("handle", "blade _1") and model.split == "S1"
    x = model.mesh.triangles_center[:, 0]
    either = 4  # the faces between the bodies
    assert ((model.face_part == 0) == (x <= 0.0)).sum() >= len(x) - either
    assert (model.receiver_face == (model.face_part == 0)).all()
    for region, words in {
        "handle,blade _1": "is the whole object",
        "guard": r"'guard' is neither .* nor the name of a part.*its parts are handle, blade _1",
    }.items():
        with pytest.raises(ObjectMeshError, match=words):
            object_from_argument(f"{tmp_path}/knife.obj:S1:{region}", pieces=False)


def test_nodes_of_a_glb_are_parts_where_they_stand(tmp_path):
    scene, moved = trimesh.Scene(), trimesh.transformations.translation_matrix((-0.05, 0, 0))
    scene.add_geometry(block(-0.05, 0.05), node_name="grip", transform=moved)
    scene.add_geometry(block(0.0, 0.08), node_name="tip")
    scene.export(tmp_path / "tool.glb")
    assert key_of(tmp_path / "tool.glb", {}) is not None
    (tmp_path / "two.glb").write_bytes((tmp_path / "tool.glb").read_bytes().replace(b'"byteLength"', b'"uri"      ', 1))
    assert key_of(tmp_path / "two.glb", {}) is None, "names another file: its own bytes do not say what it holds"
    model = build_object(tmp_path / "tool.glb", split="S1", receiver="grip", pieces=False)
    assert set(model.part_names) == {"grip", "tip"}
    assert model.mesh.bounds[:, 0] == pytest.approx((-0.1, 0.08), abs=1e-6)
    assert model.mesh.triangles_center[model.receiver_face, 0].max() < 1e-6


def test_a_build_is_kept_by_content_and_options_and_a_repair_is_told_once(tmp_path, monkeypatch):
    monkeypatch.setenv("R2H_BATCH_CACHE", str(tmp_path / "cache"))
    built, times = objects._built, []  # the private one: what is counted is work, not calls of build_object
    monkeypatch.setattr(objects, "_built", lambda *a, **k: times.append(1) or built(*a, **k))
    holed = block(-0.05, 0.05).subdivide()
    trimesh.Trimesh(holed.vertices, holed.faces[1:], process=False).export(tmp_path / "rod.ply")

    def build(**options):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model = build_object(tmp_path / "rod.ply", pieces=False, **options)
        return model, [str(w.message) for w in caught]

    (first, said), (again, said_again) = build(), build()
    assert len(times) == 1 and len(said) == 1 and "filled 1 holes" in said[0] and said_again == []
    assert object_digest(first) == object_digest(again) and first.repair == again.repair
    assert again.repair.steps == ("filled 1 holes",) and not again.vertices.flags.writeable
    for faces in (10, 12):
        np.save(tmp_path / "region.npy", np.arange(faces))
        build(split="S1", receiver=tmp_path / "region.npy")
    (tmp_path / "rod.ply").write_bytes((tmp_path / "rod.ply").read_bytes().replace(b"comment", b"comment "))
    assert len(times) == 3
    for file in (tmp_path / "cache" / "objects").glob("*.npz"):
        file.write_bytes(file.read_bytes()[:-100])
    model, _ = build()
    assert len(times) == 4 and object_digest(model) == object_digest(first), "a damaged file is made again"


def test_a_file_beside_a_mesh_says_split_parts_and_region(tmp_path):
    saw = block(-0.1, 0.08).subdivide()
    for name in ("saw", "cube"):
        saw.export(tmp_path / f"{name}.ply")
    np.save(tmp_path / "saw_parts.npy", (saw.triangles_center[:, 0] > 0).astype(np.uint8))
    parts = "parts: saw_parts.npy\npart_names: [handle, blade]\n"
    (tmp_path / "saw.yaml").write_text(f"split: S1\n{parts}receiver: handle\nmass: 0.3\n")
    cube, saw = edited(BenchmarkChoice(objects=str(tmp_path))).objects
    assert (cube.name, cube.split, cube.part_names) == ("cube", "S0", ("body",))
    assert (saw.split, saw.mass, saw.part_names) == ("S1", 0.3, ("handle", "blade"))
    assert (saw.receiver_face == (saw.mesh.triangles_center[:, 0] < 0)).all()
    for text, words in {
        parts.replace("saw", "../saw"): "points outside the folder",
        "file: other.ply": "file is not allowed here",
        "colour: red": "unknown field colour",
        "split: S9": "split is 'S9'",
    }.items():
        (tmp_path / "saw.yaml").write_text(text)
        with pytest.raises(FileError, match=words):
            edited(BenchmarkChoice(objects=str(tmp_path)))


def test_several_meshes_are_built_by_workers_and_asked_for_as_one(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("R2H_BATCH_CACHE", str(tmp_path / "cache"))
    for k in range(2):
        rod = block(-0.05, 0.05 + 0.01 * k)
        trimesh.Trimesh(rod.vertices, rod.faces[k:], process=False).export(tmp_path / f"rod{k}.ply")
    (tmp_path / "bad.ply").write_text("nothing")
    calls = [{"mesh": str(path), "pieces": False} for path in sorted(tmp_path.glob("*.ply"))]
    assert build_ahead(calls, cores=2) == 3
    assert [is_built(**call) for call in calls] == [False, True, True]
    assert capfd.readouterr().err.count("rod1: mesh repaired: ") == 1  # here, and not where the object is asked for
    monkeypatch.setattr(objects, "_built", lambda *_, **__: pytest.fail("built once more"))
    assert build_ahead(calls[1:], cores=2) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [build_object(**call).mesh.extents[0] for call in calls[1:]] == pytest.approx([0.1, 0.11])
    monkeypatch.undo()
    with pytest.raises(ObjectMeshError, match=r"bad\.ply"):
        build_object(**calls[0])
