"""What a stranger's code changes of this process is put back, and is there again when it runs again."""

import atexit
import builtins
import contextlib
import gc
import json
import logging
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import strangers
from r2h_batch.strangers import Ended, stranger

pytestmark = pytest.mark.check


def nothing(*_, **__):
    return 3.0


CHANGES = {
    "logging": (
        lambda: logging.basicConfig(level=5, force=True),
        lambda: (logging.root.level, [type(h).__name__ for h in logging.root.handlers]),
    ),
    "default device": (lambda: torch.set_default_device("meta"), lambda: torch.empty(0).device),
    "default dtype": (lambda: torch.set_default_dtype(torch.float64), torch.get_default_dtype),
    "gradients": (lambda: torch.set_grad_enabled(False), torch.is_grad_enabled),
    "products": (lambda: torch.set_float32_matmul_precision("medium"), torch.get_float32_matmul_precision),
    "numpy's errors": (lambda: np.seterr(all="raise"), np.geterr),
    "recursion": (lambda: sys.setrecursionlimit(sys.getrecursionlimit() // 2), sys.getrecursionlimit),
    "folder": (lambda: os.chdir("/"), os.getcwd),
    "mask": (lambda: os.umask(0o777), lambda: strangers._PYTHON[1].read()),
    "hooks": (lambda: setattr(sys, "excepthook", None), lambda: sys.excepthook),
    "hooks of threads": (lambda: setattr(threading, "excepthook", None), lambda: threading.excepthook),
    "gc": (gc.disable, gc.isenabled),
    "log": (lambda: logging.disable(logging.CRITICAL), lambda: logging.root.manager.disable),
    "warnings": (lambda: warnings.simplefilter("error"), lambda: warnings.filters[:]),
    "json": (lambda: setattr(json, "dumps", nothing), lambda: json.dumps),
    "time": (lambda: setattr(time, "time", nothing), lambda: time.time),
    "open": (lambda: setattr(builtins, "open", nothing), lambda: builtins.open),
    "replace": (lambda: setattr(os, "replace", nothing), lambda: os.replace),
}
"""What it does -> and what shows it: of all these a module has its own again in its next call."""
ONCE = {
    "path": (lambda: sys.path.clear(), lambda: sys.path[:]),
    "finders": (lambda: sys.meta_path.clear(), lambda: sys.meta_path[:]),
    "modules": (lambda: sys.modules.pop("json"), lambda: sys.modules.get("json")),
    "a class": (lambda: setattr(json.JSONEncoder, "encode", nothing), lambda: json.JSONEncoder.encode),
    "streams": (lambda: setattr(sys, "stderr", None) or setattr(sys, "stdout", None), lambda: (sys.stdout, sys.stderr)),
    "signals": (lambda: signal.signal(signal.SIGINT, signal.SIG_IGN), lambda: signal.getsignal(signal.SIGINT)),
    "blocked": (
        lambda: signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}),
        lambda: signal.pthread_sigmask(signal.SIG_BLOCK, ()),
    ),
    "alarm": (lambda: signal.alarm(1000), lambda: signal.getitimer(signal.ITIMER_REAL)[0]),
    "files": (
        lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (10, resource.getrlimit(resource.RLIMIT_FSIZE)[1])),
        lambda: resource.getrlimit(resource.RLIMIT_FSIZE),
    ),
    "stdout": (lambda: os.close(1), lambda: os.fstat(1).st_ino),
    "stderr": (lambda: os.dup2(os.open(os.devnull, os.O_WRONLY), 2), lambda: os.fstat(2).st_ino),
    "child": (lambda: os.fork(), os.getpid),
}


@pytest.mark.parametrize("late", [False, True], ids=["named", "named inside"])
def test_what_it_changes_is_put_back_and_is_there_again_in_its_next_call(late):
    for name, (change, shows) in each(CHANGES.items()):
        before = shows()
        with stranger("theirs", "" if late else "their_module") as code:
            change()
            own = shows()
            code.of = "their_module"
        assert shows() == before, name
        with stranger("others", "other_module"):
            assert shows() == before, name
        with stranger("theirs", "their_module"):
            assert shows() == own != before, f"{name}: {own}"
        assert shows() == before, name
        strangers._left.clear()


def test_what_nobody_needs_again_is_put_back():
    for name, (change, shows) in each(ONCE.items()):
        before = shows()
        with stranger("theirs", "their_module"):
            change()
        assert shows() == before, name
        assert not strangers._left, name


def test_a_call_that_changes_nothing_leaves_nothing():
    names = [dict(vars(module)) for module in (os, signal, resource, atexit)]
    with stranger("outer"), stranger("inner", "their_module"):
        assert os._exit is not names[0]["_exit"]
    assert [dict(vars(module)) for module in (os, signal, resource, atexit)] == names and not strangers._left


def test_it_cannot_end_this_process_and_a_child_of_its_own_may_end():
    def child():
        if not (pid := os.fork()):
            os._exit(5)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 5

    with stranger("theirs"):
        child()
    ends = {
        "os._exit(0)": lambda: os._exit(0),
        "os.execv ": lambda: os.execl("/bin/true", "true"),
        "alarm": lambda: [signal.setitimer(signal.ITIMER_REAL, 0.01), time.sleep(2)],
    }
    for words, end in each(ends.items()):
        with pytest.raises(Ended, match=words.replace("(", r"\(").replace(")", r"\)")), stranger("theirs"):
            end()


def test_of_a_flood_the_first_and_the_last_is_told(capsys):
    with stranger("theirs"):
        for k in range(100_000):
            print("line", k)
    said = capsys.readouterr().err
    assert len(said) < 1.1 * strangers.MOST_PRINTED and "characters left out]" in said
    assert said.startswith("theirs printed: line 0\nline 1\n") and said.endswith("line 99999\n")


def test_it_closes_its_own_files_and_no_others(tmp_path, capsys):
    with open(os.devnull) as ours:
        with stranger("theirs"):
            with tempfile.TemporaryDirectory() as folder:  # by descriptors
                (tmp_path / "x").write_text(folder)
            for handle in range(3, 100):
                with contextlib.suppress(OSError):
                    os.close(handle)
            os.closerange(3, 200)
            subprocess.run([sys.executable, "-S", "-c", ""], check=True)
        assert os.fstat(ours.fileno())
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "theirs closes descriptors of files that are not its own; they stay open"


def test_what_it_prints_past_python_goes_to_stderr_too(capfd):
    with stranger("theirs"):
        print("by print")
        os.write(1, b"by write\n")
        os.system("echo by a child")
    found = capfd.readouterr()
    assert found.out == "" and found.err.splitlines() == ["by write", "by a child", "theirs printed: by print"]


def test_a_limit_that_cannot_be_put_back_is_told_and_a_thread_that_stays_cannot_end_the_process():
    code = """
import os, resource, sys, threading, time
from r2h_batch.strangers import stranger, end_without_threads
with stranger("theirs"):
    resource.setrlimit(resource.RLIMIT_NOFILE, (50, 60))
    threading.Thread(target=lambda: (time.sleep(0.2), os._exit(0))).start()
    threading.Thread(target=time.sleep, args=(1000,), name="stays").start()
with stranger("honest"):
    pass
time.sleep(0.5)
end_without_threads(3)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 3
    assert done.stderr.splitlines() == [
        "theirs lowered RLIMIT_NOFILE of this process to 60, which cannot be put back",
        "theirs left the thread 'stays' running; this process ends without it",
    ]


def test_a_thread_that_stays_cannot_end_the_process_where_one_of_before_has_ended_meanwhile():
    code = """
import os, threading, time
from r2h_batch.strangers import stranger
before = threading.Thread(target=time.sleep, args=(0.05,))
before.start()
with stranger("theirs"):
    threading.Thread(target=lambda: (time.sleep(0.3), os._exit(0))).start()
    before.join()
time.sleep(0.6)
print("goes on")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "goes on\n"


def test_a_thread_that_stays_cannot_end_the_process_while_what_its_method_changed_is_put_back():
    code = """
import os, threading, time
from r2h_batch import strangers
go = threading.Event()
thread = threading.Thread(target=lambda: (go.wait(), os._exit(0)))
put_back = strangers._put_back_stdout
def slowly(*handles):
    put_back(*handles)
    go.set()
    thread.join()
strangers._put_back_stdout = slowly
with strangers.stranger("theirs"):
    thread.start()
print("goes on", os._exit is strangers._leave)
with strangers.stranger("another one"):
    pass
print(os._exit is strangers._leave)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "goes on False\nTrue\n"


def test_its_function_of_atexit_raises_in_a_line_and_decides_no_exit_code():
    code = """
import atexit, os, sys
from r2h_batch.strangers import stranger
with stranger("theirs"):
    atexit.register(lambda: 1 / 0)
    atexit.register(os._exit, 7)
    atexit.register(print, "taken back")
    atexit.unregister(print)
sys.exit(3)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.splitlines() == [
        "theirs: its function of atexit raised Ended: os._exit(7) ends the process; return an answer",
        "theirs: its function of atexit raised ZeroDivisionError: division by zero",
    ]


def test_blocks_of_two_threads_do_not_put_back_each_others_state():
    inside, go, seen = threading.Event(), threading.Event(), []

    def other():
        inside.wait()
        with stranger("second"):
            seen.append(os._exit)
        go.set()

    thread = threading.Thread(target=other)
    thread.start()
    before = os._exit
    with stranger("first"):
        inside.set()
        assert go.wait(10)
        assert os._exit is seen[0] is not before
    thread.join()
    assert os._exit is before
