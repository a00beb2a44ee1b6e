"""A run folder has its benchmark's files: copied by the sweep, found by whoever opens the run, wherever it was moved to."""

import hashlib
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields

import pytest
import trimesh

from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError
from r2h_batch.runs.header import read_header
from r2h_batch.runs.store import load_run
from r2h_batch.trials import run_files
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.run_files import files_of, placed

YAML = """\
objects: [{file: meshes/cup.obj, parts: meshes/parts.npy, receiver: meshes/faces.npy, part_names: [body]}, {built_in: hammer}]
hand_model: hand.npz
hand_set: [hands.npz]
trials: t.npz
robot: arm
people: own.csv
"""
OF_YAML = (
    "meshes/cup.obj meshes/parts.npy meshes/faces.npy hand.npz hands.npz t.npz arm/robot.yaml arm/robot.npz own.csv"
)


def written(folder, names, text="x"):
    for name in names.split():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text} {name}")
    return folder


@pytest.fixture
def choice(tmp_path):
    """Flags that name every kind of file and folder there is."""
    theirs = tmp_path / "theirs"
    written(theirs / "mine", OF_YAML + " unnamed.obj")
    (theirs / "mine" / "benchmark.yaml").write_text(YAML)
    written(theirs, "set.npz a/cup.obj b/cup.obj faces.npy b/cup.h5 t.parquet tall.csv arm/robot.yaml arm/robot.npz")
    written(theirs / "things", "mug.obj jar.stl faces.npy notes.txt")
    (theirs / "things" / "mug.yaml").write_text("{split: S1, receiver: faces.npy}")
    written(theirs / "poses", "mug.npz jar.npz")
    return BenchmarkChoice(
        benchmark=str(theirs / "mine"), hands=str(theirs / "set.npz"), objects=str(theirs / "things"),
        object_mesh=(f"{theirs}/a/cup.obj", f"{theirs}/b/cup.obj:S1:{theirs}/faces.npy"),
        grasps=(f"{theirs}/poses", f"cup={theirs}/b/cup.h5:panda-hand"), trials_file=str(theirs / "t.parquet"),
        robot=str(theirs / "arm"), people=str(theirs / "tall.csv"), persons="as-for-ur5e", turn="half",
    )  # fmt: skip


def test_every_file_is_copied_and_found_again_once_the_others_are_gone(choice, tmp_path):
    run, theirs = tmp_path / "run", tmp_path / "theirs"
    (theirs / "mine" / "hand.npz").unlink()  # a hand model: the next test
    (theirs / "mine" / "benchmark.yaml").write_text(YAML.replace("hand_model: hand.npz\n", ""))
    files = files_of(choice, run)
    assert files.left_out == () and len(files.copied) == 24
    assert not {"unnamed.obj", "notes.txt"} & {file.name for file in files.copied.values()}
    files.copy_into(run)
    before = {place: file.read_bytes() for place, file in files.copied.items()}
    shutil.rmtree(theirs)
    moved = run.rename(tmp_path / "elsewhere")
    found, at = placed(choice, moved, ()), moved / "benchmark"
    assert found == BenchmarkChoice(
        benchmark=str(at / "benchmark.yaml"), hands=str(at / "hands/set.npz"), objects=str(at / "objects/things"),
        object_mesh=(f"{at}/object-mesh/cup.obj", f"{at}/object-mesh/2/cup.obj:S1:{at}/object-mesh/faces.npy"),
        grasps=(f"{at}/grasps/poses", f"cup={at}/grasps/cup.h5:panda-hand"), trials_file=f"{at}/trials-file/t.parquet",
        robot=f"{at}/robot/arm", people=f"{at}/people/tall.csv", persons="as-for-ur5e", turn="half",
    )  # fmt: skip
    assert {place: (moved / place).read_bytes() for place in before} == before
    assert {*(str(p.relative_to(moved)) for p in at.rglob("*") if p.is_file())} == {*before}


def test_a_hand_model_and_what_is_too_large_stay_where_they_are_and_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(run_files, "MOST_FILE_BYTES", 100)
    written(tmp_path, "MANO.pkl small.npz")
    written(tmp_path, "large.npz", "x" * 200)
    choice = BenchmarkChoice(hands=str(tmp_path / "large.npz"), hand_model=str(tmp_path / "MANO.pkl"))
    files, run = files_of(choice, tmp_path / "run"), tmp_path / "run"
    assert files.copied == {}
    large, hand = files.left_out
    assert large["sha256"] == hashlib.sha256((tmp_path / "large.npz").read_bytes()).hexdigest()
    assert large["place"] == "benchmark/hands/large.npz" and large["bytes"] == 210
    assert "all together" in files.lines()[0] and "licence" in files.lines()[1] and "licence" in hand["why"]
    assert placed(choice, run, ()) == choice
    (tmp_path / "large.npz").unlink()
    to = run / "benchmark" / "hands" / "large.npz"
    with pytest.raises(FileError, match=f"given --hands {choice.hands}; it is not there any more: put it at {to}"):
        placed(choice, run, ())
    written(to.parent, "large.npz")
    assert placed(choice, run, ()).hands == str(to)


def test_files_that_no_folder_may_hold_all_together_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(run_files, "MOST_BYTES", 30)
    written(tmp_path / "things", "a.obj b.obj c.obj")  # 7 bytes each
    written(tmp_path / "things", "d.obj", "x" * 20)
    files = files_of(BenchmarkChoice(objects=str(tmp_path / "things")), tmp_path / "run")
    assert [file.name for file in files.copied.values()] == ["a.obj", "b.obj", "c.obj"]
    assert [left["place"] for left in files.left_out] == ["benchmark/objects/things/d.obj"]


def test_a_benchmark_file_whose_copy_lacks_something_is_read_where_the_sweep_found_it(tmp_path):
    theirs, run = tmp_path / "mine", tmp_path / "run"
    written(theirs, "hand.npz hands.npz")
    (theirs / "benchmark.yaml").write_text("{hand_model: hand.npz, hand_set: hands.npz}")
    choice = BenchmarkChoice(benchmark=str(theirs / "benchmark.yaml"))
    files_of(choice, run).copy_into(run)
    assert placed(choice, run, ()) == choice
    shutil.rmtree(theirs)
    to = run / "benchmark"
    with pytest.raises(FileError, match=f"names hand.npz, which is not there: put it at {to / 'hand.npz'}"):
        placed(choice, run, ())
    written(to, "hand.npz")
    assert placed(choice, run, ()).benchmark == str(to / "benchmark.yaml")


def test_several_writers_at_once_leave_whole_files_and_one_that_changed_is_replaced(tmp_path):
    written(tmp_path, "set.npz", "x" * 1_000_000)
    choice, run = BenchmarkChoice(hands=str(tmp_path / "set.npz")), tmp_path / "run"
    files, to = files_of(choice, run), run / "benchmark" / "hands" / "set.npz"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: files.copy_into(run), range(16)))
    assert to.read_bytes() == (tmp_path / "set.npz").read_bytes() and [*to.parent.iterdir()] == [to]
    inode = to.stat().st_ino
    files.copy_into(run)
    assert to.stat().st_ino == inode  # it is there already
    to.write_text("half of it")
    files.copy_into(run)
    assert to.read_bytes() == (tmp_path / "set.npz").read_bytes()


def test_what_lies_in_the_run_folder_is_not_copied_again(tmp_path):
    written(tmp_path / "run" / "imported-1", "hands.npz")
    (tmp_path / "run" / "imported-1" / "benchmark.yaml").write_text("{hand_set: hands.npz}")
    choice = BenchmarkChoice(benchmark=str(tmp_path / "run" / "imported-1" / "benchmark.yaml"))
    assert files_of(choice, tmp_path / "run").copied == {}
    moved = (tmp_path / "run").rename(tmp_path / "moved")
    assert placed(choice, moved, ()).benchmark == str(moved / "imported-1" / "benchmark.yaml")


@pytest.mark.parametrize(
    ("said", "spec", "own", "then"),
    [
        ({"benchmark": "mine.bench:make"}, "mine.bench:make", "mine.bench:make", "mine.bench:make"),
        ({"benchmark": "here/b.py:make"}, "here/b.py:make", "there/b.py:make", "there/b.py:make"),
        ({"objects": "families:cup, f.py:KNOB x 2"}, "f.py:KNOB", "../f.py:KNOB", "families:cup, ../f.py:KNOB x 2"),
    ],
)
def test_code_that_a_run_names_runs_only_if_the_user_names_it_too(said, spec, own, then, tmp_path):
    choice = BenchmarkChoice(**said)
    for code in ((), ("other:make",)):
        with pytest.raises(FileError, match=f"starts no code by itself; say that this may run: --code {spec}"):
            placed(choice, tmp_path, code)
    found = placed(choice, tmp_path, (own,))
    assert [getattr(found, f.name) for f in fields(found) if getattr(found, f.name)] == [then]
    with pytest.raises(FileError, match="--code a:b: the run names"):
        placed(choice, tmp_path, (own, "a:b"))


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine").mkdir()
    trimesh.creation.box((0.03, 0.06, 0.16)).export(folder / "mine" / "brick.obj")
    trimesh.creation.box((0.05, 0.06, 0.1)).export(folder / "mine" / "block.obj")
    (folder / "mine" / "block.yaml").write_text("{split: S1, receiver: z<0.3}")
    line = ["--method", "random", "--objects", str(folder / "mine"), "--trials", "4", "--execute.sim", "none"]
    assert main(["sweep", *line, "--quiet", "--out", str(folder / "run")]) == 0
    assert main(["sweep", *line, "--quiet", "--out", str(folder / "run")]) == 0  # the same command goes on
    shutil.rmtree(folder / "mine")
    return folder / "run"


def test_a_run_that_was_moved_is_reported_explained_and_judged_again_without_its_sources(swept, tmp_path, capsys):
    run = shutil.move(swept, tmp_path / "moved")
    files = sorted(p.name for p in (run / "benchmark" / "objects" / "mine").iterdir())
    assert files == ["block.obj", "block.yaml", "brick.obj"]
    assert main(["results", "reevaluate", str(run), "--rows", "8"]) == 0
    said = capsys.readouterr().out
    assert "8 of 8 rows judged again" in said and "none differs, 8 are equal bit for bit" in said
    for line in (["report"], ["why", "0"], ["results", "verify"]):
        words = [line[0], *line[1:2], str(run)] if line[0] == "results" else [line[0], str(run), *line[1:]]
        assert main(words) == 0, capsys.readouterr().err
    assert main(["export", "scene", str(run), "--trial", "1", "--out", str(tmp_path / "x")]) == 0
    assert json.loads((tmp_path / "x" / "trial.json").read_text())["object"] == "block"
    capsys.readouterr()
    assert main(["why", str(run), "0", "--objects", "mine"]) == 2
    assert "why --objects: r2h_batch 0.3 had it" in capsys.readouterr().err
    assert main(["report", str(run), "--out", str(run / "benchmark" / "x.md")]) == 2
    assert "the run folder" in capsys.readouterr().err and load_run(run).methods
    files = (run / "benchmark").rename(tmp_path / "files")
    (run / "benchmark").symlink_to(files)
    with pytest.raises(FileError, match="a symbolic link; a run folder holds its own files"):
        read_header(run)


def test_a_sweep_that_goes_on_with_a_file_that_changed_names_the_file(tmp_path, capsys):
    mesh = tmp_path / "brick.obj"
    trimesh.creation.box((0.03, 0.06, 0.16)).export(mesh)
    line = ["sweep", "--method", "random", "--object-mesh", str(mesh), "--benchmark", "r2h-v1", "--splits", "S0"]
    line += ["--trials", "7", "--execute.sim", "none", "--quiet", "--out", str(tmp_path / "run")]
    assert main(line) == 0
    trimesh.creation.box((0.03, 0.06, 0.15)).export(mesh)
    capsys.readouterr()
    assert main(line) == 2
    assert f"choose another --out; {mesh} changed since" in capsys.readouterr().err
