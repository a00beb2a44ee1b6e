"""Methods that change the process that judges them: one sweep of all of them, and an honest one behind."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from fake_bench import set_up as set_up_fake
from rounds import each
from sweep_command import PLAIN, in_process

from r2h_batch.__main__ import main
from r2h_batch.report.text import short_names
from r2h_batch.runs.store import load_run
from r2h_batch.sweep import jobs

SUPPORT = Path(__file__).parents[1] / "support"
HEAD = """
import atexit, builtins, json, os, resource, shutil, signal, sys, tempfile, threading, time, warnings
import torch

class Odd(torch.Tensor):
    @classmethod
    def __torch_function__(cls, function, kinds, args=(), kwargs=None):
        return 7

class Pair(tuple):
    def __iter__(self):
        raise RuntimeError("no pair")

def honest(trials):
    T = torch.eye(4, dtype=torch.float32, device="cpu").repeat(len(trials), 1, 1)
    return T, T

"""
FINE = {
    "float64": "torch.set_default_dtype(torch.float64)",
    "gradients": "torch.set_grad_enabled(False); torch.use_deterministic_algorithms(True)",
    "path": "sys.path[:] = []; sys.meta_path.clear()",
    "modules": "sys.modules.clear()",
    "recursion": "sys.setrecursionlimit(250)",
    "folder": "os.chdir('/')",
    "lost_folder": "d = tempfile.mkdtemp(); os.chdir(d); shutil.rmtree(d); os.chdir('/')",
    "signals": "[signal.signal(s, signal.SIG_IGN) for s in (2, 15)]; signal.pthread_sigmask(signal.SIG_BLOCK, {2, 15})",
    "alarm": "signal.alarm(1); signal.setitimer(signal.ITIMER_PROF, 0.1)",
    "child": "os.fork()",
    "child_raises": "os.fork() or 1 / 0",
    "closes": "os.closerange(0, 256)",
    "stdout": "os.dup2(os.open(os.devnull, os.O_WRONLY), 1)",
    "no_streams": "sys.stdout = sys.stderr = sys.stdin = None",
    "hooks": "sys.excepthook = threading.excepthook = None",
    "json": "json.dumps = json.loads = lambda *a, **k: {}; json.JSONEncoder.encode = lambda *a: '{}'",
    "still_time": "time.time = time.monotonic = time.perf_counter = lambda: 3.0",
    "nan_time": "time.time = time.perf_counter = lambda: float('nan'); time.strftime = lambda *a: ''",
    "renames": "os.replace = os.link = os.rename = os.fsync = lambda *a, **k: None",
    "limits": "resource.setrlimit(resource.RLIMIT_FSIZE, (10, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))",
    "warnings": "warnings.simplefilter('error')",
    "mask": "os.umask(0o777)",
    "thread": "threading.Thread(target=lambda: (time.sleep(0.1), os._exit(0)), daemon=True).start()",
}
"""What a method does, at its import or when it is asked, and answers all the same."""
REFUSED = {
    "device": (
        "torch.set_default_device('meta'); return 2 * (torch.eye(4).repeat(len(trials), 1, 1),)",
        "has no memory",
    ),
    "leaves": ("os._exit(0)", "os._exit(0) ends the process"),
    "replaces": ("os.execl('/bin/true', 'true')", "os.execv ends the process"),
    "rings": (
        "signal.setitimer(signal.ITIMER_REAL, 0.01); time.sleep(5)",
        "its alarm (signal.alarm, setitimer) went off",
    ),
    "no_builtins": ("builtins.len = builtins.open = builtins.zip = None; open('x')", "TypeError"),
    "odd_tensor": ("return Odd(torch.eye(4).repeat(len(trials), 1, 1)), 0", "kind Odd, which becomes no plain one"),
    "odd_pair": ("return Pair((1, 2))", "RuntimeError: no pair"),
    "ends": ("sys.exit(0)", "SystemExit: 0"),
    "deep": ("f = lambda: f(); f()", "RecursionError"),
}
"""What a method does when it is asked, and words of the line about it."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "set_up", set_up_fake)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield tmp_path
    for name in [n for n in sys.modules if n.startswith("evil_")]:
        del sys.modules[name]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # theirs, which called os._exit
def test_methods_that_change_the_process_cost_neither_rows_nor_the_table(folder, capsys):
    names = []
    for name, does in FINE.items():
        (folder / f"evil_in_{name}.py").write_text(
            f"{HEAD}\ndef f(trials, scene):\n    {does}\n    return honest(trials)\n"
        )
        (folder / f"evil_at_{name}.py").write_text(
            f"{HEAD}\n{does}\ndef f(trials, scene):\n    return honest(trials)\n"
        )
        names += [f"evil_in_{name}", f"evil_at_{name}"]
    for name, (does, _) in REFUSED.items():
        (folder / f"evil_no_{name}.py").write_text(f"{HEAD}\ndef f(trials, scene):\n    {does}\n")
        names.append(f"evil_no_{name}")
    methods = [f"{name}={folder / name}.py:f" for name in names]
    before = os.getcwd(), os.umask(0o22), sys.getrecursionlimit()
    os.umask(before[1])
    done = in_process(
        "--benchmark", "r2h-v1", "--method", *methods, "fake_bench:best", "--trials", 3, "--out", folder / "run"
    )
    mask = os.umask(0o22)
    os.umask(mask)
    assert (os.getcwd(), mask, sys.getrecursionlimit()) == before
    lines = done.stderr.splitlines()
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
    for name, (_, words) in each(REFUSED.items()):
        (line,) = (line for line in lines if line.startswith(f"sweep: method evil_no_{name}: "))
        assert words in line, line
    run = load_run(folder / "run")
    of_best = run.trials("fake_bench:best").select(["trial_id", "outcome"])
    shown = [*short_names(run.methods).values()]  # the sweep's own table has a line for each of the first 16
    assert all(re.search(rf"^{re.escape(name)} *\|", done.stdout, re.MULTILINE) for name in shown[:16]), done.stdout
    assert f"{len(shown) - 16} more methods, " in done.stdout
    assert main(["report", str(folder / "run"), "--format", "csv"]) == 1  # some are not scored
    full = capsys.readouterr().out
    for name in each(names[: 2 * len(FINE)]):
        assert run.trials(name).select(["trial_id", "outcome"]).equals(of_best), name
        assert name in full
    told = {line.partition(" closes ")[0].rpartition("/")[2] for line in lines if "descriptors" in line}
    assert told == {"evil_at_closes.py:f", "evil_in_closes"}


def test_a_method_that_would_have_ended_the_process_alone_ends_with_exit_code_1(folder):
    for place in ("imported", "asked"):
        leaves = "import os\nos._exit(0)\n" if place == "imported" else "import os\ndef f(trials, scene): os._exit(0)\n"
        (folder / f"evil_{place}.py").write_text(leaves)
        method = f"{folder}/evil_{place}.py:f"
        done = in_process("--benchmark", "r2h-v1", "--method", method, "--trials", 3, "--out", folder / place)
        assert (done.returncode, done.stdout) == (1, "")
        line = done.stderr.splitlines()[-1 if place == "imported" else -2]
        assert f"evil_{place}.py:f: Ended: os._exit(0) ends the process" in line


LAST = """
import atexit, os, threading, time, torch
atexit.register(lambda: 1 / 0)
atexit.register(os._exit, 7)
os.write(1, b"at its import\\n")
def f(trials, scene):
    threading.Thread(target=time.sleep, args=(1000,)).start()
    T = torch.eye(4).repeat(len(trials), 1, 1)
    print("asked")
    return T, T
"""


@pytest.mark.alone
def test_a_method_decides_neither_the_end_of_the_command_nor_what_stands_on_stdout(tmp_path):
    (tmp_path / "last.py").write_text(LAST)
    line = [sys.executable, SUPPORT / "fake_bench.py", "--benchmark", "r2h-v1", "--method", f"{tmp_path}/last.py:f"]
    line += ["--trials", "3", "--format", "json", "--out", tmp_path / "run"]
    path = os.pathsep.join(filter(None, [str(SUPPORT.parents[1]), PLAIN.get("PYTHONPATH")]))
    done = subprocess.run(
        list(map(str, line)), capture_output=True, text=True, env={**PLAIN, "PYTHONPATH": path}, timeout=300
    )
    assert done.returncode == 0 and done.stdout.startswith(("{", "[")), done.stdout + done.stderr
    said = done.stderr.splitlines()
    assert "at its import" in said and "last.py:f printed: asked" in said
    assert said[-1].startswith("last.py:f left the thread 'Thread-") and "Traceback" not in done.stderr
