"""A trial of a run with meshes of its user's own is shown with the meshes that it was judged with."""

import json
import shutil

import pytest
import trimesh

from r2h_batch.__main__ import main
from r2h_batch.benchmark.build import BenchmarkOverrides
from r2h_batch.export.stored import Reader

SIZES = {"brick": (0.03, 0.06, 0.16), "plank": (0.02, 0.05, 0.2), "slab": (0.025, 0.09, 0.12)}


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """Three objects of S0, one of which takes part in S1: `slab`, whose lower half the receiver wants."""
    folder = tmp_path_factory.mktemp("meshes")
    for name, size in SIZES.items():
        trimesh.creation.box(size).subdivide().export(folder / f"{name}.obj")
    (folder / "slab.yaml").write_text("split: S1\nreceiver: z<0.5\n")
    return folder


@pytest.fixture(scope="module")
def run(meshes, tmp_path_factory):
    """Four trials of each split of these objects, by two methods, without poses: what is shown is computed again."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    line = ["sweep", "--method", "random", "handover-va", "--trials", 4, "--sim", "none", "--no-poses"]
    assert main([*map(str, line), "--objects", str(meshes), "--out", str(folder)]) == 0
    return folder


def test_a_trial_with_a_mesh_of_ones_own_is_exported_and_shown_as_it_was_judged(run, meshes, tmp_path, capsys):
    words = ["--objects", str(meshes)]
    line = ["scene", "--run", str(run), "--trial", "2", "--method", "random", "--out", str(tmp_path / "x"), *words]
    assert main(line) == 0
    said = json.loads((tmp_path / "x" / "trial.json").read_text())
    assert said["object"] == "plank" and said["note"] == ""
    page = tmp_path / "page.html"
    assert main(["view", str(run), "--trial", "2", "--method", "random", "--html", str(page), *words]) == 0
    assert page.stat().st_size > 10_000
    capsys.readouterr()
    reader = Reader(run, BenchmarkOverrides(objects=str(meshes)))
    assert all(reader.trial(k, m).note == "" for k in (0, 1) for m in reader.run.methods)


def test_another_mesh_under_the_same_name_is_refused_by_its_name(run, meshes, tmp_path, capsys):
    own = shutil.copytree(meshes, tmp_path / "own")
    trimesh.creation.box((0.03, 0.06, 0.15)).subdivide().export(own / "brick.obj")
    line = ["scene", "--run", str(run), "--method", "random", "--objects", str(own), "--out", str(tmp_path / "x")]
    assert main([*line, "--trial", "2"]) == 2
    assert "was made with other objects (brick)" in capsys.readouterr().err
