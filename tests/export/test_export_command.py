"""The export command: what it refuses and says, a user's own mesh, and the README's line."""

import dataclasses
import json
import subprocess
import sys

import trimesh

from r2h_batch.bodies import hand
from r2h_batch.export import command as export_command
from r2h_batch.sweep import command as sweep


def refused(arguments, capsys):
    assert export_command.scene_main([str(a) for a in arguments]) == 2
    out = capsys.readouterr()
    assert out.out == "" and out.err.count("\n") == 1
    return out.err


def test_what_is_not_there_is_refused_with_what_is(run, tmp_path, capsys):
    out = ["--out", tmp_path / "x"]
    message = refused(["--run", run, "--trial", 0, *out], capsys)
    assert "--method" in message and "oracle" in message and "random" in message
    message = refused(["--run", run, "--trial", 0, "--method", "orcale", *out], capsys)
    assert "'orcale'" in message and "oracle, random" in message
    message = refused(["--run", run, "--trial", 77, "--method", "oracle", *out], capsys)
    assert "no trial 77" in message and "0, 2, 1, 3" in message
    assert "run.json" in refused(["--run", tmp_path, "--trial", 0, *out], capsys)
    assert not (tmp_path / "x").exists()


def test_a_run_without_paths_is_refused_naming_the_flag(tmp_path, capsys):
    bare = tmp_path / "bare"
    assert (
        sweep.main(["--method", "random", "--splits", "S0", "--trials", "1", "--sim", "none", "--out", str(bare)]) == 0
    )
    capsys.readouterr()
    assert "--save-paths" in refused(["--run", bare, "--trial", 0, "--out", tmp_path / "x"], capsys)


def test_a_run_of_other_assets_is_refused(run, tmp_path, capsys, monkeypatch):
    other = dataclasses.replace(hand.load_hand_set(), digest="0" * 64)
    monkeypatch.setattr("r2h_batch.export.trial.load_hand_set", lambda: other)
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
    assert export_command.scene_main([*map(str, command), "--object-mesh", str(file)]) == 0
    capsys.readouterr()
    assert json.loads((tmp_path / "x" / "trial.json").read_text())["object"] == "brick"
    trimesh.creation.box((0.03, 0.06, 0.15)).subdivide().subdivide().export(file)
    assert "objects" in refused([*command, "--object-mesh", file], capsys)


def test_the_command_of_the_readme_works(run, tmp_path):
    command = [
        sys.executable,
        "-m",
        "r2h_batch.scene",
        "--run",
        str(run),
        "--trial",
        "1",
        "--method",
        "oracle",
        "--out",
        str(tmp_path / "x"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(tmp_path / "x") and (tmp_path / "x" / "scene.xml").is_file()
