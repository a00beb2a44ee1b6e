"""What newcomers met in their first hour: no silent mistake, and no command that dies of the environment."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest
from made_runs import write_run
from sweep_command import PLAIN, in_process

from r2h_batch.__main__ import main
from r2h_batch.report.table import brief, table_of
from r2h_batch.sweep.command import stop_signals
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


def test_the_sweeps_table_has_a_column_where_rows_could_not_be_judged(tmp_path):
    for name, outcome in (("good", Outcome.SUCCESS), ("bad", Outcome.INVALID_INPUT)):
        run = write_run(tmp_path / name, {"m": np.full(4, int(outcome))}, 2, 2)
        assert ("invalid" in brief(table_of(run)).split("\n")[0]) == (name == "bad")


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
