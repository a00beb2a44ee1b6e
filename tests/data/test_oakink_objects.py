"""OakInk's objects with OakBase's parts, written as they are on disk and read back: frame, labels, region, refusals."""

import json

import numpy as np
import pytest
import trimesh

from r2h_batch.__main__ import main
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.edit import edited


def block(x0, x1):
    mesh = trimesh.creation.box((x1 - x0, 0.02, 0.02)).subdivide()
    mesh.apply_translation(((x0 + x1) / 2, 0.3, 0.0))  # off the origin, as scans are
    return mesh


@pytest.fixture
def oakink(tmp_path):
    """A knife with parts, a mug without and with two meshes, a virtual knife; one object that is not on this disk, and two
    invalid entries."""
    shape = tmp_path / "oakink" / "shape"
    (shape / "metaV2").mkdir(parents=True)
    real = {"C10001": "knife 1", "C20001": "mug", "C90001": "elsewhere", "C9": None, "C8": "../../x"}
    for name, ids in (("object_id", real), ("virtual_object_id", {"s10101": "knife v"})):
        (shape / "metaV2" / f"{name}.json").write_text(json.dumps({k: {"name": v} for k, v in ids.items()}))
    for file, x0, x1 in (
        ("OakInkObjectsV2/knife 1/align_ds/scan_align.ply", -0.1, 0.08),
        ("OakInkObjectsV2/mug/align/scan_align.obj", -0.1, 0.08),
        ("OakInkObjectsV2/mug/align/a_first.ply", -0.3, 0.24),
        ("OakInkVirtualObjectsV2/knife v/align_ds/scan_align.obj", -0.1, 0.08),
    ):
        (shape / file).parent.mkdir(parents=True, exist_ok=True)
        block(x0, x1).export(shape / file)
    parts = tmp_path / "oakink" / "OakBase" / "knife" / "knife 1"
    parts.mkdir(parents=True)
    for k, (name, span, attr) in enumerate(
        [("handle", (-0.1, 0.0), ["held_by_hand", "no_function"]), ("blade", (0.0, 0.08), ["cut_something"])]
    ):
        block(*span).export(parts / f"part_{k:02}.ply")
        (parts / f"part_{k:02}.json").write_text(json.dumps({"name": name, "attr": attr}))
    return tmp_path / "oakink"


def test_objects_come_in_the_frame_of_the_hands_with_parts_and_region(oakink, tmp_path, capsys):
    out = tmp_path / "mine"
    assert main(["import", "objects", str(oakink), "--from", "oakink", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "3 objects of oakink (1 with a receiver's region)" in said.out
    assert "C9 has no name; left out" in said.err and "points outside" in said.err
    found = {o.name: o for o in edited(BenchmarkChoice(objects=str(out))).objects}
    assert set(found) == {"knife_1", "mug", "knife_v"}
    knife = found["knife_1"]
    assert knife.mesh.bounds.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-7), "its loader's frame"
    assert knife.split == "S1" and knife.part_names == ("handle", "blade")
    assert (knife.receiver_face == (knife.mesh.triangles_center[:, 0] < 0.01)).all(), "parts meet 1 cm off the middle"
    assert found["mug"].mesh.extents[0] == pytest.approx(0.18), "of two meshes the one that is called align"
    assert found["mug"].split == "S0" and found["mug"].part_names == ("body",)


def test_what_is_not_as_it_should_be_is_named_and_skipped_or_refused(oakink, tmp_path, capsys):
    far = block(-0.1, 0.0).apply_translation((0, 0.2, 0))
    for part in (oakink / "OakBase" / "knife" / "knife 1").glob("*.ply"):
        far.export(part)
    line = ["import", "objects", str(oakink), "--from", "oakink", "--out", str(tmp_path / "mine")]
    assert main([*line, "--strict"]) == 2
    assert "its parts are" in capsys.readouterr().err and not (tmp_path / "mine").exists()
    assert main(line) == 0
    said = capsys.readouterr()
    assert "skipped: knife 1: knife 1: its parts are" in said.err and "1 skipped" in said.out
    assert main(line) == 2
    assert "new or empty folder" in capsys.readouterr().err


def imported(folder, meta, capsys):
    """Lines of a refused import of a list of objects."""
    (folder / "shape" / "metaV2").mkdir(parents=True)
    (folder / "shape" / "metaV2" / "object_id.json").write_text(meta)
    assert main(["import", "objects", str(folder), "--from", "oakink", "--out", str(folder / "mine")]) == 2
    assert not (folder / "mine").exists()
    return capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(
    ("vertices", "words"),
    [
        ("v 1e30 0 0\nv 1 0 0\nv 0 1e30 0\n", "the largest side is 1e+30 m"),
        ("v 0 0 0\n" * 3, "the largest side is 0 m"),
    ],
)
def test_a_mesh_that_no_benchmark_takes_is_not_imported(tmp_path, capsys, vertices, words):
    at = tmp_path / "shape" / "OakInkObjectsV2" / "mug" / "align"
    at.mkdir(parents=True)
    (at / "scan.obj").write_text(f"{vertices}f 1 2 3\n")
    said = imported(tmp_path, '{"C1": {"name": "mug"}}', capsys)
    assert said[0].startswith("skipped: mug: mug: ") and words in said[0]


@pytest.mark.parametrize(
    ("meta", "words"),
    [
        ('{"X1": {"name": "../../../etc"}}', "points outside the folder"),
        ('{"X1": {"name": 7}}', "X1 has no name; left out"),
        ("[1]", "needs objects by their ID"),
        ('{"X1": {"name": "nowhere"}}', "no folder OakInkObjectsV2/NAME is here"),
    ],
)
def test_hostile_and_empty_lists_of_objects_are_one_line(tmp_path, capsys, meta, words):
    *entries, refused = said = imported(tmp_path, meta, capsys)
    assert any(words in line for line in said) and len(entries) <= 1 and refused.startswith("import: ")
