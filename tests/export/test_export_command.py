"""The export command: what it refuses and says, a user's own mesh, and what it prints."""

import dataclasses
import json

import mujoco
import numpy as np
import pyarrow as pa
import pytest
import trimesh
from scipy.spatial import cKDTree

from r2h_batch.__main__ import main
from r2h_batch.benchmark.benchmark import built_in
from r2h_batch.bodies import hand
from r2h_batch.export.stored import ExportError, Reader
from r2h_batch.sweep import command as sweep

TIMES = ("t_plan_s", "t_method_s")


def refused(arguments, capsys):
    assert main(["scene", *map(str, arguments)]) == 2
    out = capsys.readouterr()
    (said,) = [
        line for line in out.err.splitlines() if not line.endswith(" s")
    ]  # a slow machine says "reading ..., 5 s"
    assert out.out == ""
    return said


def test_what_a_run_does_not_store_is_computed_again_to_the_same_bits(run, tmp_path, capsys):
    bare = tmp_path / "bare"
    assert sweep.main(["--method", "oracle", "random", "--trials", "2", "--no-poses", "--out", str(bare)]) == 0
    capsys.readouterr()
    whole, part = Reader(run), Reader(bare)
    for method in ("oracle", "random"):
        for k in (0, 1, 2, 3):
            one, two = whole.trial(k, method), part.trial(k, method)
            assert two.note == "" and {k: v for k, v in one.row.items() if k not in TIMES} == {
                k: v for k, v in two.row.items() if k not in TIMES
            }
            for name in ("T_obj_ee", "T_world_ee", "T_world_hand", "q", "time_s", "executed_q", "target_q"):
                assert np.array_equal(getattr(one, name), getattr(two, name)), (method, k, name)


def test_what_a_folder_names_is_neither_imported_nor_opened(run, tmp_path, monkeypatch):
    """A folder may come from anybody: the method that it names may be any code."""
    reader = Reader(run)
    entry = dataclasses.replace(
        reader.run.entry("oracle"), source={"kind": "method", "function": "evil_module:predict"}
    )
    monkeypatch.setattr(type(reader.run), "entry", lambda self, method: entry)
    reader.run.header["stored"][:] = []
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "evil_module.py").write_text("raise SystemExit('imported')")
    with pytest.raises(ExportError, match="sweep without --no-poses"):
        reader.trial(0, "oracle")


@pytest.mark.parametrize(
    ("kind", "column", "change"),
    [
        ("paths", "q", lambda numbers: []),
        ("paths", "time_s", lambda numbers: numbers[::-1]),
        ("paths", "executed_q", lambda numbers: [[np.nan] * 6]),
        ("poses", "T_world_ee", lambda numbers: [np.nan] * 16),
    ],
)
def test_a_stored_motion_that_cannot_be_is_one_line(run, monkeypatch, kind, column, change):
    reader = Reader(run)
    table = getattr(reader.run, kind)("oracle")
    forged = [{**row, column: change(row[column])} for row in table.to_pylist()]
    monkeypatch.setattr(type(reader.run), kind, lambda *_: pa.Table.from_pylist(forged, schema=table.schema))
    with pytest.raises(ExportError, match="trial 0 of 'oracle' is stored as no motion can be"):
        reader.trial(0, "oracle")


def test_a_run_of_other_assets_is_refused(run, tmp_path, capsys, monkeypatch):
    other = dataclasses.replace(built_in(), hand_set=dataclasses.replace(hand.load_hand_set(), digest="0" * 64))
    monkeypatch.setattr("r2h_batch.benchmark.build.built_in", lambda *_: other)
    assert "hand_set" in refused(["--run", run, "--trial", 0, "--method", "oracle", "--out", tmp_path / "x"], capsys)


def test_a_users_own_mesh_is_asked_for_and_comes_along(tmp_path, capsys):
    file = tmp_path / "brick.obj"
    trimesh.creation.box((0.03, 0.06, 0.16)).subdivide().subdivide().export(file)
    folder = tmp_path / "run"
    # six built-in objects of S0 take their turns first: trial 12 is the user's
    arguments = ["--method", "random", "--splits", "S0", "--trials", "7", "--save-paths", "--out", str(folder)]
    assert sweep.main([*arguments, "--object-mesh", str(file)]) == 0
    capsys.readouterr()
    command = ["--run", folder, "--trial", 12, "--out", tmp_path / "x"]
    message = refused(command, capsys)
    assert "brick" in message and "--object-mesh" in message
    assert main(["scene", *map(str, command), "--object-mesh", str(file)]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "x") and (tmp_path / "x" / "scene.xml").is_file()
    assert json.loads((tmp_path / "x" / "trial.json").read_text())["object"] == "brick"
    trimesh.creation.box((0.03, 0.06, 0.15)).subdivide().subdivide().export(file)
    assert "objects" in refused([*command, "--overwrite", "--object-mesh", file], capsys)


def test_a_run_of_another_benchmark_comes_with_its_hands_home_and_table(tmp_path, capsys):
    own = hand.load_hand_set()
    rows = [7, 250]
    arrays = {k: getattr(own, k).numpy()[rows] for k in ("pose", "shape", "side")}
    np.savez(tmp_path / "two.npz", **arrays, posture=np.array(["a", "b"]))
    home, table = [0.5, -1.6, 1.4, -1.3, -1.6, 1.0], "{center: [-0.1, 0, -0.03], half: [0.4, 0.5, 0.03]}"
    file, folder = tmp_path / "mine.yaml", tmp_path / "run"
    file.write_text(f"hand_set: two.npz\nhome: {home}\ntable: {table}\nobjects: [{{built_in: bowl}}]\n")
    arguments = ["--method", "random", "--splits", "S0", "--trials", "3", "--save-paths", "--sim", "none", "--out"]
    assert sweep.main([*arguments, str(folder), "--benchmark", str(file)]) == 0
    capsys.readouterr()
    command = ["--run", folder, "--trial", 2, "--out", tmp_path / "x"]
    message = refused(command, capsys)
    assert "benchmark" in message and f"--benchmark {file}" in message
    assert main(["scene", *map(str, command), "--benchmark", str(file)]) == 0
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "x" / "scene.xml"))
    assert np.allclose(model.key("home").qpos, home) and np.allclose(model.geom("table/top").size, [0.4, 0.5, 0.03])
    told = json.loads((tmp_path / "x" / "trial.json").read_text())
    assert told["side"] == "left" and told["hand_index"] == 1
    skin = own.model.pose(own.pose[rows], own.shape[rows], own.side[rows]).vertices[1].numpy()
    mesh, R = model.mesh("hand_mesh"), np.zeros(9)
    mujoco.mju_quat2Mat(R, model.mesh_quat[mesh.id])  # MuJoCo moves meshes to their own centre and axes
    found = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]] @ R.reshape(3, 3).T + model.mesh_pos[mesh.id]
    assert cKDTree(found).query(skin)[0].max() < 1e-6
    file.write_text("objects: [{built_in: bowl}]\n")
    capsys.readouterr()
    assert "hand_set" in refused([*command, "--overwrite", "--benchmark", file], capsys)
