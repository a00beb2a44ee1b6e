"""The export command: what it refuses and says, a user's own mesh, and what it prints."""

import dataclasses
import json

import numpy as np
import pyarrow as pa
import pytest
import trimesh

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.runs.files import RunError
from r2h_batch.scene import hand
from r2h_batch.sweep import command as sweep
from r2h_batch.view.stored import Reader

TIMES = ("t_plan_s", "t_method_s")


def refused(arguments, capsys):
    assert main(["export", "scene", *map(str, arguments)]) == 2
    out = capsys.readouterr()
    (said,) = [
        line for line in out.err.splitlines() if not line.endswith(" s")
    ]  # a slow machine says "reading ..., 5 s"
    assert out.out == ""
    return said


def test_what_a_run_does_not_store_is_computed_again_to_the_same_bits(run, tmp_path, capsys):
    bare = tmp_path / "bare"
    assert (
        sweep.main(["--benchmark", "r2h-v1", "--method", "random", "--trials", "2", "--no-poses", "--out", str(bare)])
        == 0
    )
    whole, part = Reader(run), Reader(bare)
    for k in (0, 1, 2, 3):
        one, two = whole.trial(k, "random"), part.trial(k, "random")
        rows = [{n: v for n, v in trial.row.items() if n not in TIMES} for trial in (one, two)]
        assert two.note == "" and rows[0] == rows[1]
        for name in ("T_obj_ee", "T_world_ee", "T_world_hand", "q", "time_s", "executed_q", "target_q"):
            assert np.array_equal(getattr(one, name), getattr(two, name)), (k, name)


def test_what_a_folder_names_is_neither_imported_nor_opened(run, tmp_path, monkeypatch):
    """A folder may come from anybody: the method that it names may be any code."""
    reader = Reader(run)
    entry = dataclasses.replace(
        reader.run.entry("oracle"), source={"kind": "method", "function": "evil_module:predict"}
    )
    monkeypatch.setattr(type(reader.run), "entry", lambda self, method: entry)
    reader.run = dataclasses.replace(reader.run, header={**reader.run.header, "stored": []})
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "evil_module.py").write_text("raise SystemExit('imported')")
    with pytest.raises(RunError, match="sweep without --no-poses"):
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
    with pytest.raises(RunError, match="trial 0 of 'oracle' is stored as no motion can be"):
        reader.trial(0, "oracle")


def test_a_run_of_other_assets_is_refused(run, tmp_path, capsys, monkeypatch):
    other = dataclasses.replace(
        load_benchmark("r2h-v1"), hand_set=dataclasses.replace(hand.load_hand_set(), digest="0" * 64)
    )
    monkeypatch.setattr("r2h_batch.trials.edit.load_benchmark", lambda *_, **__: other)
    assert "hand_set" in refused([run, "--trial", 0, "--method", "oracle", "--out", tmp_path / "x"], capsys)


def test_a_users_own_mesh_is_in_the_run_or_asked_for_and_comes_along(tmp_path, capsys):
    (tmp_path / "my files").mkdir()
    file = tmp_path / "my files" / "brick.obj"
    trimesh.creation.box((0.03, 0.06, 0.16)).subdivide().subdivide().export(file)
    folder = tmp_path / "run"
    # six built-in objects of S0 take their turns first: trial 12 is the user's
    arguments = ["--benchmark", "r2h-v1", "--method", "random", "--splits", "S0", "--trials", "7"]
    arguments += ["--save-paths", "--out", str(folder)]
    assert sweep.main([*arguments, "--object-mesh", str(file)]) == 0
    capsys.readouterr()
    command = [folder, "--trial", 12, "--out", tmp_path / "x"]
    assert main(["export", "scene", *map(str, command)]) == 0
    assert json.loads((tmp_path / "x" / "trial.json").read_text())["object"] == "brick"
    capsys.readouterr()
    copy, own = folder / "benchmark" / "object-mesh" / "brick.obj", tmp_path / "kept.obj"
    copy.rename(own)  # a run of 0.3 has none
    command += ["--overwrite"]
    assert main(["export", "scene", *map(str, command)]) == 0  # it is where the sweep found it
    assert capsys.readouterr().out.strip() == str(tmp_path / "x") and (tmp_path / "x" / "scene.xml").is_file()
    file.unlink()
    message = refused(command, capsys)
    assert f"--object-mesh {file}; it is not there any more: put it at {copy}" in message
    own.rename(copy)
    assert main(["export", "scene", *map(str, command)]) == 0
    assert json.loads((tmp_path / "x" / "trial.json").read_text())["object"] == "brick"
    capsys.readouterr()
    trimesh.creation.box((0.03, 0.06, 0.15)).subdivide().subdivide().export(copy)
    assert "objects (brick)" in refused(command, capsys)
