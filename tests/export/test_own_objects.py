"""A trial of a run with meshes of its user's own: its object alone is built, and everything shown is as if all were."""

import json
import os
import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import trimesh

from r2h_batch.__main__ import main
from r2h_batch.benchmark.build import BenchmarkOverrides
from r2h_batch.export.stored import Reader, StoredTrial

TIMES = ("t_plan_s", "t_method_s")
SIZES = {"brick": (0.03, 0.06, 0.16), "plank": (0.02, 0.05, 0.2), "slab": (0.025, 0.09, 0.12)}


def built(cache: Path) -> int:
    """Objects that were built since this folder was new."""
    return len(list((cache / "objects").glob("*.npz")))


@pytest.fixture
def cache(run, tmp_path, monkeypatch):
    """A cache in which no object is kept yet; what was found for them is, for that takes long."""
    shutil.copytree(run.parent / "cache" / "candidates", tmp_path / "new" / "candidates")
    monkeypatch.setenv("R2H_BATCH_CACHE", str(tmp_path / "new"))
    return tmp_path / "new"


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
    before = os.environ.get("R2H_BATCH_CACHE")
    os.environ["R2H_BATCH_CACHE"] = str(folder.parent / "cache")
    try:
        assert main([*map(str, line), "--objects", str(meshes), "--out", str(folder)]) == 0
    finally:
        os.environ.pop("R2H_BATCH_CACHE")
        if before is not None:
            os.environ["R2H_BATCH_CACHE"] = before
    return folder


def as_before_objects_had_digests(reader: Reader) -> Reader:
    del reader.run.header["digests"]["each_object"]
    return reader


def assert_same(one: StoredTrial, two: StoredTrial) -> None:
    assert one.note == two.note == ""
    for f in fields(StoredTrial):
        a, b = getattr(one, f.name), getattr(two, f.name)
        if isinstance(a, np.ndarray):
            assert np.array_equal(a, b), f.name
        elif f.name == "row":
            assert {k: v for k, v in a.items() if k not in TIMES} == {k: v for k, v in b.items() if k not in TIMES}
        elif f.name == "object_model":
            assert a.name == b.name and np.array_equal(a.vertices, b.vertices)


def test_an_exported_trial_builds_its_own_object_alone(run, meshes, cache, tmp_path, capsys):
    words = ["--objects", str(meshes)]
    line = ["scene", "--run", str(run), "--trial", "2", "--method", "random", "--out", str(tmp_path / "x"), *words]
    assert main(line) == 0 and built(cache) == 1
    assert json.loads((tmp_path / "x" / "trial.json").read_text())["object"] == "plank"
    page = tmp_path / "page.html"
    assert main(["view", str(run), "--trial", "2", "--method", "random", "--html", str(page), *words]) == 0
    assert page.stat().st_size > 10_000 and built(cache) == 1
    capsys.readouterr()


def test_everything_of_a_trial_is_as_if_all_objects_had_been_built_and_an_older_run_builds_them(run, meshes, cache):
    given = BenchmarkOverrides(objects=str(meshes))
    one, every = Reader(run, given), as_before_objects_had_digests(Reader(run, given))
    for k in (0, 1):
        for method in one.run.methods:
            assert_same(one.trial(k, method), every.trial(k, method))
        assert built(cache) == len(SIZES)


def test_what_many_trials_need_is_built_together_and_no_more(run, meshes, cache):
    reader = Reader(run, BenchmarkOverrides(objects=str(meshes)))
    reader.build_for({"random": [0, 2, 4], "handover-va": [0]})
    assert built(cache) == 2
    assert reader.trial(4, "random").object_model is reader.trial(0, "random").object_model


def test_only_a_change_of_the_trials_own_object_hands_or_place_is_refused(run, meshes, cache, tmp_path, capsys):
    own = tmp_path / "own"
    own.mkdir()
    for file in meshes.iterdir():
        (own / file.name).write_bytes(file.read_bytes())
    trimesh.creation.box((0.03, 0.06, 0.15)).subdivide().export(own / "brick.obj")
    line = [
        "scene",
        "--run",
        str(run),
        "--method",
        "random",
        "--objects",
        str(own),
        "--overwrite",
        "--out",
        str(tmp_path / "x"),
    ]
    assert main([*line, "--trial", "2"]) == 0  # of plank
    capsys.readouterr()
    assert main([*line, "--trial", "0"]) == 2
    assert "was made with other objects (brick)" in capsys.readouterr().err
    (own / "brick.obj").rename(own / "block.obj")
    assert main([*line, "--trial", "2"]) == 2
    assert "was made with other objects" in capsys.readouterr().err


def test_digests_of_objects_that_the_runs_hash_does_not_cover_are_refused(run, meshes, tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    for file in run.rglob("*"):
        if file.is_file():
            (folder / file.relative_to(run)).parent.mkdir(parents=True, exist_ok=True)
            (folder / file.relative_to(run)).write_bytes(file.read_bytes())
    header = json.loads((run / "run.json").read_text())
    header["objects"][0]["digest"] = "0" * 64
    (folder / "run.json").write_text(json.dumps(header))
    line = ["scene", "--run", str(folder), "--trial", "0", "--method", "random", "--out", str(tmp_path / "x")]
    assert main([*line, "--objects", str(meshes)]) == 2
    assert "each_object; restore it" in capsys.readouterr().err
