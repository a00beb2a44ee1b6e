"""What newcomers met in their first hour: no silent mistake, and no command that dies of the environment."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trimesh
from made_runs import write_run
from robot_files import read_arm, write_urdf
from sweep_command import PLAIN, in_process

from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError
from r2h_batch.base.io.parquet import read_parquet_arrays
from r2h_batch.base.io.tables import read_csv_arrays
from r2h_batch.methods.candidates import CandidateTable, candidate_table
from r2h_batch.report.table import brief, table_of
from r2h_batch.runs.store import join, load_run
from r2h_batch.scene.mesh_import.closed import closed_mesh
from r2h_batch.scene.mesh_import.file import load_mesh_file
from r2h_batch.scene.mesh_import.limits import ObjectMeshError
from r2h_batch.scene.scene import Scene
from r2h_batch.sweep.command import stop_signals
from r2h_batch.trials.load import load_benchmark
from r2h_batch.types import Outcome

NO_LIBRARY = """
import ctypes, ctypes.util
BAD = ("egl", "osmesa")
find, begin = ctypes.util.find_library, ctypes.CDLL.__init__
def bad(name): return bool(name) and any(b in str(name).lower() for b in BAD)
def load(self, name, *a, **k):
    if bad(name): raise OSError(f"{name}: no such library")
    begin(self, name, *a, **k)
ctypes.util.find_library = lambda name: None if bad(name) else find(name)
ctypes.CDLL.__init__ = load
"""
"""A machine without EGL and OSMesa, for Python's ctypes."""


def python(code, folder, *flags, **environment):
    folder.mkdir(exist_ok=True)
    (folder / "sitecustomize.py").write_text(NO_LIBRARY)
    given = {k: v for k, v in PLAIN.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    path = os.pathsep.join([str(folder), *filter(None, [given.get("PYTHONPATH")])])
    line = [sys.executable, *flags, "-c", code]
    return subprocess.run(
        line, capture_output=True, text=True, env=given | {"PYTHONPATH": path} | environment, timeout=300, check=False
    )


@pytest.mark.parametrize("value", ["egl", "osmesa", "nonsense"])
def test_mujoco_is_imported_whatever_opengl_the_environment_names(tmp_path, value):
    code = "import os, r2h_batch, mujoco; mujoco.MjModel.from_xml_string('<mujoco/>'); print(os.environ.get('PYOPENGL_PLATFORM'))"
    done = python(code, tmp_path, MUJOCO_GL=value)
    assert (done.returncode, done.stdout) == (0, "None\n"), done.stderr


def test_what_draws_says_the_variable_that_does_not(tmp_path):
    code = (
        "import r2h_batch\nfrom r2h_batch.scene import offscreen\noffscreen._works = lambda b: False\noffscreen.ready()"
    )
    done = python(code, tmp_path, MUJOCO_GL="egll")
    assert done.returncode and "MUJOCO_GL=egll is none of egl, osmesa, glfw" in done.stderr.splitlines()[-1]


def test_help_needs_no_docstrings(tmp_path):
    done = python("from r2h_batch.__main__ import main; main(['sweep', '--help'])", tmp_path, "-OO")
    assert done.returncode == 0 and "typing.Annotated" not in done.stdout and "--method" in done.stdout


def test_a_name_beyond_ascii_in_an_ascii_locale_is_told_how(tmp_path):
    code = "import sys; from r2h_batch.__main__ import main; sys.exit(main(['report', '/nowhere/\\udcc3\\udcbc']))"
    done = python(code, tmp_path, LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert done.returncode == 2 and "PYTHONUTF8=1" in done.stderr and done.stderr.count("\n") == 1


def test_a_thread_that_is_not_the_main_one_sweeps_without_signals():
    heard = []

    def work():
        with stop_signals() as stopping:
            heard.append(stopping())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert heard == [False]


def test_a_child_that_a_method_forks_ends_of_a_signal():
    """multiprocessing.Pool ends its processes so, and waits for them: with the sweep's handler it waited for ever."""
    lives, says = os.pipe()
    with stop_signals() as stopping:
        if not (child := os.fork()):
            os.write(says, b"1")
            for _ in range(100):
                time.sleep(0.05)
            os._exit(0)
        os.read(lives, 1)  # Python forgets signals that come while it forks
        os.kill(child, signal.SIGTERM)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGTERM and not stopping()


def test_the_sweeps_table_has_a_column_where_rows_could_not_be_judged(tmp_path):
    for name, outcome in (("good", Outcome.SUCCESS), ("bad", Outcome.INVALID_INPUT)):
        run = write_run(tmp_path / name, {"m": np.full(4, int(outcome))}, 2, 2)
        assert ("invalid" in brief(table_of(run)).split("\n")[0]) == (name == "bad")


def test_a_misspelt_method_is_looked_for_in_all_runs_of_a_comparison(tmp_path, capsys):
    for name, method in (("mine", "a"), ("other", "contact")):
        write_run(tmp_path / name, {method: np.zeros(4, int)}, 2, 2)
    folders = [str(tmp_path / "mine"), str(tmp_path / "other")]
    assert main(["compare", *folders, "--method", "a", "contcat"]) == 2
    said = capsys.readouterr().err
    assert said == ("compare: no run has a method 'contcat', did you mean contact?; they have a, contact\n")


METHOD = """
def poses(trials, scene):
    from r2h_batch.methods import random
    answer = random.predict(trials, scene, seed=0)
    grasp, pose = answer.T_obj_ee, answer.T_world_ee.clone()
    pose[1, 0, 0] = float("nan")
    return grasp.transpose(1, 2), pose
"""


def test_a_method_that_answers_no_poses_is_told_which_matrix_and_what_to_do(tmp_path, capsys):
    (tmp_path / "odd_answers.py").write_text(METHOD)
    done = in_process("--method", tmp_path / "odd_answers.py:poses", "--trials", 2, "--out", tmp_path / "run")
    assert done.returncode == 0
    said = [line for line in done.stderr.splitlines() if "count as invalid" in line]
    assert len(said) == 2 and "T_obj_ee" in said[0] and "transpose" in said[0] and "NaN" in said[1]
    assert main(["why", str(tmp_path / "run"), "0"]) == 0
    assert "T_obj_ee is no pose" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["tabs", "indents", "tabs in some lines", "lines that go on"])
def test_an_obj_with_other_white_space_is_read_as_a_whole(tmp_path, kind):
    ball = trimesh.creation.icosphere(1, 0.05)
    lines = [f"v {x} {y} {z}" for x, y, z in ball.vertices] + [f"f {a} {b} {c}" for a, b, c in ball.faces + 1]
    if kind == "tabs":
        lines = [line.replace(" ", "\t") for line in lines]
    elif kind == "indents":
        lines = [f"  {line}" for line in lines]
    elif kind == "tabs in some lines":
        lines = [line.replace(" ", "\t") if k % 7 == 0 else line for k, line in enumerate(lines)]
    else:
        lines = [line.replace(" ", " \\\n", 1) if line[0] == "f" else line for line in lines]
    (tmp_path / "ball.obj").write_text("\n".join(lines) + "\n")
    read = load_mesh_file(tmp_path / "ball.obj", "ball")
    np.testing.assert_array_equal(read.triangles, ball.triangles)


@pytest.mark.parametrize(
    ("side", "named"),
    [(90.0, "0.001"), (12.0, "0.01 (in centimetres it is 12 cm) or 0.0254"), (4.0, "0.01 "), (1e6, None), (1e-5, None)],
)
def test_a_mesh_in_another_unit_is_told_the_factors_that_give_a_things_size(side, named):
    with pytest.raises(ObjectMeshError) as refused:
        closed_mesh(trimesh.creation.box([side] * 3), "cup", 1.0)
    words = str(refused.value)
    assert ("give a scale of" in words) == (named is not None) and (
        named is None or f"give a scale of {named}" in words
    )


def test_the_factor_is_for_the_files_own_numbers():
    with pytest.raises(ObjectMeshError, match=r"give a scale of 0\.01 "):
        closed_mesh(trimesh.creation.box([8.0] * 3), "cup", 0.001)


NAMES = ["file://parts/block.stl", "file://localhost{}/parts/block.stl", "file://{}/parts/bl%6Fck.stl", "parts/bl%6Fck.stl",
         "model://parts/block.stl", "package://parts/bl%6Fck.stl"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_urdf_names_its_meshes_as_other_programs_do(tmp_path, name):
    mesh = f'"{name.format(tmp_path)}"'
    chain, links = read_arm(write_urdf(tmp_path, **{'"parts/block.stl"': mesh}))
    assert len(chain.joints) == 7 and all(len(link.triangles) for link in links[:6])


def test_limits_of_a_urdf_in_degrees_are_refused(tmp_path):
    file = write_urdf(tmp_path)
    text = file.read_text()
    first = text.index("<limit lower=")
    file.write_text(
        text[:first]
        + '<limit lower="-180" upper="180" effort="50" velocity="2"/>'
        + text[text.index("/>", first) + 2 :]
    )
    with pytest.raises(FileError, match=r"j1: limits -180 180 rad are 29 turns. Are they in degrees"):
        read_arm(file)


def test_the_index_of_a_frame_is_no_column(tmp_path):
    columns = {"trial_id": [3, 4], "__index_level_0__": [0, 1]}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    arrays, _ = read_parquet_arrays(tmp_path / "a.parquet", most=1 << 20, rows=10)
    assert list(arrays) == ["trial_id"]
    for index in ("", "Unnamed: 0"):
        (tmp_path / "a.csv").write_text(f"{index},trial_id\n0,3\n1,4\n")
        assert list(read_csv_arrays(tmp_path / "a.csv", {"trial_id": ("int64", 1)})) == ["trial_id"]


def test_an_object_that_gets_no_trial_is_refused_before_anything_is_judged(tmp_path):
    trimesh.creation.box([0.06, 0.06, 0.1]).export(tmp_path / "box.obj")
    line = ["--method", "random", "--object-mesh", tmp_path / "box.obj", "--splits", "S0", "--trials", 2]
    done = in_process(*line, "--out", tmp_path / "run")
    assert done.returncode == 2 and "box gets none of 2 trials of S0" in done.stderr
    assert not (tmp_path / "run").exists()


def test_a_run_that_was_played_shows_its_own_table_before_that_of_its_plans(capsys):
    assert main(["report", str(Path(__file__).parent / "frozen" / "closed_loop")]) == 0
    said = capsys.readouterr().out
    assert 0 <= said.index("Closed loop: servo") < said.index("judged with the hand at rest")


EDITED = """
def poses(trials, scene):
    from r2h_batch.methods import random
    answer = random.predict(trials, scene, seed={seed})
    return answer.T_obj_ee, answer.T_world_ee
"""


def test_an_edited_rule_is_told_by_its_file_and_judged_anew_where_that_is_asked(tmp_path):
    file, out = tmp_path / "edited_rule.py", tmp_path / "run"
    line = ["--method", file_of(file, 0), "random", "--trials", 2, "--out", out]
    assert in_process(*line).returncode == 0
    before, other = (load_run(out).poses(m).to_pydict() for m in ("edited_rule.py:poses", "random"))
    file_of(
        file, 10
    )  # of another size: Python takes a file of the same second and size for the one that it has compiled
    done = in_process(*line)
    assert done.returncode == 2 and "edited_rule changed since; add --overwrite" in done.stderr
    assert load_run(out).poses("edited_rule.py:poses").to_pydict() == before, "nothing is lost"
    done = in_process(*line, "--overwrite")
    assert done.returncode == 0 and "random: already in the run folder" in done.stderr
    after = load_run(out)
    assert after.poses("edited_rule.py:poses").to_pydict() != before and after.poses("random").to_pydict() == other
    assert main(["results", "verify", str(out)]) == 0


def file_of(file, seed):
    """The rule with this seed, as a method that is imported anew."""
    file.write_text(EDITED.format(seed=seed))
    sys.modules.pop(file.stem, None)
    return f"{file}:poses"


@pytest.mark.parametrize("place", ["imported", "asked", "asked, with a child that leaves"])
def test_a_method_that_leaves_the_process_is_told_and_the_command_goes_on(tmp_path, place):
    name = f"leaving_{len(place)}"
    child = "    if not os.fork(): os._exit(0)\n    os.wait()\n" if "child" in place else ""
    leave = "import os\nos._exit(0)\n" if place == "imported" else "import os\n"
    (tmp_path / f"{name}.py").write_text(f"{leave}def poses(trials, scene):\n{child}    os._exit(0)\n")
    done = in_process("--method", f"{tmp_path / name}.py:poses", "--trials", 2, "--out", tmp_path / "run")
    said = [line for line in done.stderr.splitlines() if "os._exit(0)" in line]
    assert done.returncode == 1 and len(said) == 1 and f"{name}.py, line" in said[0]


def test_what_a_method_is_given_prints_one_line_each():
    benchmark = load_benchmark("r2h-v0")
    scene = Scene(benchmark)
    things = [scene, *scene.objects, scene.hands, scene.hands.set, scene.hands.model, scene.robot, benchmark.trials(2)]
    things.append(candidate_table(scene))
    lines = [repr(thing) for thing in things]
    assert all(len(line) < 300 and "\n" not in line for line in lines)
    assert all(o.name in line for o, line in zip(scene.objects, lines[1:], strict=False))


def test_the_names_of_the_page_of_fields_are_there():
    root = Path(__file__).parents[1]
    rows = subprocess.run(
        [sys.executable, root / "tools" / "fields.py"], capture_output=True, text=True, check=True
    ).stdout
    scene = Scene(benchmark := load_benchmark("r2h-v2"))
    named = re.findall(r"`((?:trials|scene)\.[\w.\[\]]+)`", rows)
    assert len(named) > 60
    given = {"scene": scene, "trials": benchmark.trials(1), "i": 0}
    missing = {name for name in named if eval(name, given) is None}  # AttributeError: no such field
    optional = {"grasps", "roles", "words", "repair", "receiver_boxes", "category", "turn"}  # of a user's objects
    assert any(o.up is not None for o in scene.objects)
    optional |= {"up"}  # of open vessels
    assert missing <= {f"scene.objects[i].{k}" for k in optional} | {
        f"scene.hands.set.{k}" for k in ("skin", "in_body")
    }, missing
    fields = {f.name for f in dataclasses.fields(CandidateTable)}
    assert {"T_obj_ee", "opening_m", "width_m", "score", "count", "first"} <= fields


def test_the_gallery_of_a_run_of_two_folders_draws_each_method_in_its_own(tmp_path, monkeypatch):
    """As the stored rows of the built-in methods are: two folders of one name."""
    folders = [tmp_path / place / "rows" for place in ("first", "later")]
    runs = [write_run(f, {m: np.zeros(4, int)}, 2, 2) for f, m in zip(folders, ("fc", "learned"), strict=True)]
    drawn = []

    def draw(run, reader, n, pages, base):
        drawn.append((run.methods, reader, pages.name))
        return {m: [] for m in run.methods}

    monkeypatch.setattr("r2h_batch.commands.compare.load_runs", lambda *_: [join(runs)])
    monkeypatch.setattr("r2h_batch.scene.offscreen.ready", lambda: "none")
    monkeypatch.setattr("r2h_batch.view.gallery.pictures.gallery", draw)
    monkeypatch.setattr("r2h_batch.view.stored.Reader", lambda folder, _: folder)
    line = ["report", "any", "--format", "html", "--gallery", "1", "--out", str(tmp_path / "page.html")]
    assert main(line) == 0 and (tmp_path / "page.html").exists()
    assert drawn == [(("fc",), folders[0], "1"), (("learned",), folders[1], "2")]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (("ls", "benchmark", "utf16.yaml"), "is in UTF-16; save it in UTF-8"),
        (("report", "nothing"), "nothing: no such folder"),
        (("report", "utf16.yaml"), "is a file; give a run folder"),
        (("report", "empty"), "no run.json, so it is not a run folder"),
        (("report", "runs/copied"), "runs/copied: run.json is missing; copy it again\n"),
        (("sweep", "--config", "good.npz"), "good.npz: is no text in UTF-8; a YAML file in UTF-8 is allowed"),
        (("ls", "benchmark", "kids.yaml"), "kids.yaml: people is kids; allowed are adults,"),
        (("ls", "benchmark", "arm.yaml"), "arm.yaml: no robot is called 'UR5e', did you mean ur5e_2f85?; allowed are"),
        (("import", "robot", "a.URDF", "--base", "b", "--flange", "f", "--out", "o"), "write --urdf a.URDF"),
    ],
)
def test_what_a_path_is_is_told(line, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("runs/copied/shards").mkdir(parents=True)
    Path("runs/copied2").mkdir()
    Path("runs/copied2/run.json").write_text("{}")  # another run, of nearly the same name
    np.savez_compressed("good.npz", trial_id=np.arange(9))
    Path("kids.yaml").write_text("people: kids\n")
    Path("arm.yaml").write_text("robot: UR5e\n")
    Path("utf16.yaml").write_bytes("receiver: body\n".encode("utf-16"))
    assert main(list(line)) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
