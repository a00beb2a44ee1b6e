"""Output of every command when its stdout is closed, full or ASCII, and that no name in a file steers a terminal."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from made_runs import write_run

from r2h_batch.__main__ import main
from r2h_batch.base.io.log import LOG, telling
from r2h_batch.runs.files import RunError
from r2h_batch.runs.store import load_run
from r2h_batch.verdicts import Outcome

FORMULA = "=1+2é"
HOSTILE = "=1+2\x1b]0;owned\x07\u202eé"

OUTCOMES = np.resize([Outcome.SUCCESS, Outcome.PLAN, Outcome.REACH], 40)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of one method with a name that is a formula and not ASCII."""
    folder = tmp_path_factory.mktemp("output") / "run"
    thresholds = {"w_max_m": 0.085, "reach_radius_m": 0.1, "reach_offset_m": 0.12, "safe_margin_m": 0.0}
    configuration = {"name": "default", "thresholds": thresholds}
    write_run(folder, {FORMULA: OUTCOMES}, 20, 20, configuration=configuration)
    return folder


def lines(folder) -> dict[str, list[str]]:
    return {
        "report": ["report", str(folder)],
        "results": ["results", "digest", str(folder)],
        "rethreshold": ["results", "rethreshold", str(folder)],
        "version": ["--version"],
    }


def shell(redirection, line, **environment):
    command = " ".join([sys.executable, "-m", "r2h_batch", *line, redirection])
    return subprocess.run(
        command, shell=True, capture_output=True, text=True, env={**os.environ, **environment}, timeout=120, check=False
    )


@pytest.mark.parametrize(("name", "redirection"), [("report", "> /dev/full"), ("version", ">&-")])
def test_a_full_or_closed_stdout_is_one_line_and_exit_code_1(folder, name, redirection):
    done = shell(redirection, lines(folder)[name])
    assert done.returncode == 1, done.stderr
    assert "standard output" in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert ("No space left" if "full" in redirection else "closed") in done.stderr


def test_what_is_told_on_stderr_is_cleaned(capsys):
    LOG.info(f"{HOSTILE}\r\nnext")
    assert capsys.readouterr().err == "=1+2\\x1b]0;owned\\x07\\u202eé\\r\nnext\n"


FILLS_UP = """
import collections, os, shutil
shutil.disk_usage = lambda path: collections.namedtuple("u", "total used free")(1 << 30, 0, 7 << 20)
os.makedirs(os.environ["WARP_CACHE_PATH"] + "/wp_r2h_batch.kernels.another")
"""


def test_a_kernel_cache_that_takes_nothing_is_one_line_and_exit_code_1(tmp_path):
    """Where a full disk is needed, shutil is told that it is: the process would else be ended by LLVM.

    Another kernel is there already, so the cache was not full when it was begun.
    """
    code = (
        f"{FILLS_UP}\nimport sys\nfrom r2h_batch.base.command_line import exit_code_of\n"
        "from r2h_batch.base.launch import load\n"
    )
    code += "from r2h_batch.kernels.plan.rrt import rrt_connect as k\nsys.exit(exit_code_of('sweep', lambda: load([k], 'cpu')))"
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "kernel cache" in done.stderr.splitlines()[-1] and "WARP_CACHE_PATH" in done.stderr.splitlines()[-1]


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A run whose method's name is a window title and a reversed line, too: written by hand, the sweep refuses it."""
    folder = tmp_path_factory.mktemp("hostile") / "run"
    write_run(folder, {FORMULA: OUTCOMES}, 20, 20)
    (entry,) = (folder / "methods").glob("*.json")
    entry.write_text(json.dumps({**json.loads(entry.read_text()), "name": HOSTILE}))
    with pytest.raises(RunError, match="printable"):
        load_run(folder)
    return folder


@pytest.mark.parametrize("name", ["report", "results", "rethreshold"])
def test_names_in_files_reach_no_terminal_as_control_characters(hostile, name, capsys):
    assert main(lines(hostile)[name]) == 2
    out, error = capsys.readouterr()
    assert out == "" and error.count("\n") == 1 and not any(c in error for c in "\x1b\x07\u202e"), error
    assert "x1b]0;owned" in error and "printable" in error


def test_a_log_goes_into_a_file_of_its_own_alone(tmp_path):
    """`cp -al` gives a run's files second names: what the sweep adds to one is not in the other."""
    mine, log = tmp_path / "mine", tmp_path / "log.txt"
    mine.write_text("precious\n")
    with telling(quiet=True) as log_to:
        LOG.info("before")
        log.hardlink_to(mine)
        log_to(log)
        LOG.info("after")
        assert mine.read_text() == "precious\n"
        log.unlink()
        LOG.info("last")
    assert mine.read_text() == "precious\n" and log.read_text().endswith(" last\n")
