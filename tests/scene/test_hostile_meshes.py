"""Mesh files that are large, endless or look elsewhere: one line within the budget, and nothing read outside the folder."""

import base64
import json
import os
import threading
import time
import warnings

import numpy as np
import pytest
import trimesh

from r2h_batch.base.io import child
from r2h_batch.scene.mesh_import import closed, limits
from r2h_batch.scene.mesh_import import file as mesh_file
from r2h_batch.scene.mesh_import.limits import Budget
from r2h_batch.scene.objects import ObjectMeshError, build_object

BOX = trimesh.creation.box((0.1, 0.05, 0.03))


def refused(path, *parts):
    with pytest.raises(ObjectMeshError) as error:
        build_object(path, pieces=False)
    message = str(error.value)
    assert "\n" not in message and message.isprintable(), message
    for part in parts:
        assert part in message, message


def gltf(folder, **changes):
    """A box as a .gltf with its buffer inside, some fields changed."""
    files = trimesh.Scene(BOX).export(file_type="gltf")
    data = json.loads(files.pop("model.gltf"))
    for buffer, content in zip(data["buffers"], files.values(), strict=True):
        buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    data.update(changes)
    (folder / "box.gltf").write_text(json.dumps(data))
    return data, list(files.values())


def test_a_cloud_of_triangles_is_refused_before_any_repair(tmp_path):
    corners = np.random.default_rng(0).uniform(-0.1, 0.1, (6000, 3))
    trimesh.Trimesh(corners, np.arange(6000).reshape(-1, 3), process=False).export(tmp_path / "cloud.stl")
    refused(tmp_path / "cloud.stl", "in 2000 bodies that do not touch; at most 1000 are allowed")


def test_a_repair_that_takes_too_long_ends_with_one_line_that_says_where(monkeypatch, capsys):
    monkeypatch.setattr(closed, "Budget", lambda label: Budget(label, seconds=0.3))
    monkeypatch.setattr(limits, "SILENT_SECONDS", 0.0)
    corners = np.random.default_rng(0).uniform(-0.05, 0.05, (1200, 3))
    fan = trimesh.Trimesh(corners, [(0, k + 1, k + 2) for k in range(1198)], process=False)
    refused(fan, "more than 0.3 s of CPU time", "rebuilding the surface of", "; decimate it")
    assert "object: " in capsys.readouterr().err


def at_one_edge(count):
    """Faces that share the edge of vertices 0 and 1."""
    corners = np.random.default_rng(0).uniform(0, 0.1, (count + 2, 3))
    return trimesh.Trimesh(corners, [(0, 1, k) for k in range(2, count + 2)], process=False)


def test_rims_that_are_compared_with_each_other_end_within_the_time(monkeypatch):
    monkeypatch.setattr(closed, "Budget", lambda label: Budget(label, seconds=0.5))
    start = time.process_time()
    refused(at_one_edge(8000), "more than 0.5 s of CPU time", "comparing rims that may be two edges of one wall")
    assert time.process_time() - start < 4


def test_sheets_at_one_edge_are_refused_before_they_become_a_solid():
    refused(at_one_edge(1500), "its open surface is 1", "at most 1000 are allowed: close its surface")


def test_long_faces_are_refused_before_their_pieces_take_the_memory():
    refused(at_one_edge(900), "more, at most 1000000 are allowed: close its surface")


def test_the_time_of_a_mesh_counts_every_thread_of_the_process():
    budget = Budget("x", seconds=0.3)

    def work():
        start = time.thread_time()
        while time.thread_time() - start < 0.5:
            np.sort(np.random.default_rng(0).uniform(size=100_000))

    other = threading.Thread(target=work)
    other.start()
    other.join()
    with pytest.raises(ObjectMeshError, match=r"more than 0\.3 s of CPU time"):
        budget.spend("waiting for a thread")


@pytest.mark.usefixtures("own_process")
def test_a_scene_that_takes_too_long_to_read_is_ended_with_its_process(monkeypatch, tmp_path, capsys):
    nodes = [{"children": list(range(1, 200_001))}, *({"mesh": 0} for _ in range(200_000))]
    gltf(tmp_path, nodes=nodes, scenes=[{"nodes": [0]}], scene=0)
    monkeypatch.setattr(mesh_file, "MOST_SECONDS", 2)
    monkeypatch.setattr(child, "MOST_WAITS", 100)
    monkeypatch.setattr(child, "SILENT_SECONDS", 1)
    refused(tmp_path / "box.gltf", "takes more than 2 s of CPU time")
    assert "box: reading box.gltf" in capsys.readouterr().err


@pytest.mark.usefixtures("own_process")
def test_arrays_that_a_file_claims_and_does_not_hold_cost_no_memory(tmp_path):
    data, _ = gltf(tmp_path)
    for accessor in data["accessors"]:
        del accessor["bufferView"]
        accessor["count"] = 10**12
    gltf(tmp_path, accessors=data["accessors"])
    refused(tmp_path / "box.gltf", "more memory than any file of its size needs")


def test_buffers_outside_the_folder_and_special_and_oversized_files_are_not_read(tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    data, contents = gltf(folder)
    (tmp_path / "secret.bin").write_bytes(contents[0])
    (folder / "link.bin").symlink_to("../secret.bin")
    os.mkfifo(folder / "pipe.bin")
    for where, words in {
        "../secret.bin": "points outside the folder",
        "link.bin": "leads outside the folder",
        "pipe.bin": "not a regular file",
    }.items():
        gltf(folder, buffers=[{**data["buffers"][0], "uri": where}, *data["buffers"][1:]])
        refused(folder / "box.gltf", words)
    os.mkfifo(tmp_path / "pipe.obj")
    refused(tmp_path / "pipe.obj", "not a regular file")
    with (tmp_path / "huge.stl").open("wb") as file:
        file.truncate(1 << 40)
    refused(tmp_path / "huge.stl", f"{1 << 40} bytes; at most")


def test_a_heap_of_vertices_in_one_place_is_refused_before_its_pairs_are_listed():
    heap = np.random.default_rng(0).uniform(-1e-6, 1e-6, (12_000, 3))
    corners = np.concatenate([BOX.vertices, heap])
    faces = np.concatenate([BOX.faces, np.arange(12_000).reshape(-1, 3) + 8])
    refused(trimesh.Trimesh(corners, faces, process=False), "pairs of vertices are nearer than 0.01 mm; merge them")


def test_a_closed_sheet_thinner_than_the_tolerance_is_refused_and_a_thicker_one_is_not():
    thin, thick = (trimesh.creation.box((0.1, 0.1, thickness)) for thickness in (9e-5, 2e-4))
    refused(thin, "a closed sheet", "mm thick on average; at least 0.1 mm")
    assert build_object(thick, pieces=False).mesh.extents[2] == pytest.approx(2e-4, rel=1e-3)


def test_bodies_apart_are_counted_and_measured_and_bodies_that_touch_are_not():
    other = trimesh.creation.box((0.02, 0.02, 0.02)).apply_translation((0.0, 0.0, 0.025))  # stands on the box
    crumb = trimesh.creation.box((0.004, 0.002, 0.002)).apply_translation((0.2, 0.0, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        build_object(trimesh.util.concatenate([BOX, other]), pieces=False)
    with pytest.warns(UserWarning, match=r"2 bodies apart from each other \(largest sides 0\.1, 0\.004 m\)"):
        build_object(trimesh.util.concatenate([BOX, other, crumb]), pieces=False)
