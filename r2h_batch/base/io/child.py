"""Readers of other people's formats, each in a process of its own: a damaged file can make a
library run for ever, take all memory or crash.

The child gets the opened file as its stdin. It answers with arrays on stdout, or with one line on
stderr and the exit code `REFUSED`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable

MOST_WAITS = 10
"""The child may wait this many times longer than it may work: for a busy machine, not for ever."""
SILENT_SECONDS = 5.0
MEMORY_BYTES = 8 << 30
MEMORY_PER_BYTE = 40
"""The child's address space: some for the libraries, and some for each byte of the file (text takes
most)."""
ASKED_EVERY_S = 0.5
"""How often a child asks whether its parent lives."""
REFUSED = 3
_NO_MEMORY = "asks for more memory than any file of its size needs"


def read_in_child(
    module: str,
    file: BinaryIO,
    options: Mapping[str, Any],
    *,
    count: int | None,
    seconds: float,
    doing: str,
) -> list[Any]:
    """The arrays that a reader's process answers with.

    Args:
        module: run with `python -m`; it calls `answer_parent`.
        file: opened for reading.
        options: for the reader; JSON. `memory` is the child's address space, bytes, if it is not to
            follow from the size of the file.
        count: number of arrays; None: as many as the reader sends.
        seconds: CPU time that the child may take.
        doing: what is being done, for a line every five seconds.

    Raises:
        FileError: what is wrong with the file, without its name.
    """
    size = os.fstat(file.fileno()).st_size
    words = json.dumps({**options, "bytes": size, "seconds": seconds, "parent": os.getpid()})
    # modules from where this process has them, and from nowhere else: the folder may be the file's,
    # with a numpy.py in it
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p or os.getcwd() for p in sys.path)}
    with tempfile.TemporaryFile() as answer:
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", module, words],
            stdin=file, stdout=answer, stderr=subprocess.PIPE, env=environment,
        )  # fmt: skip
        try:
            error = _wait(child, seconds, doing).decode("utf-8", "replace")
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
        if child.returncode == REFUSED:
            raise FileError(error.strip().rpartition("\n")[2])
        if child.returncode < 0:
            cpu = f"takes more than {seconds:g} s of CPU time"
            raise FileError(f"{cpu}, or ends its reader ({-child.returncode})")
        if child.returncode:
            raise FileError("cannot be read: its reader ended with an error")
        size = answer.seek(0, os.SEEK_END)
        answer.seek(0)
        arrays: list[Any] = []
        while answer.tell() < size if count is None else len(arrays) < count:
            arrays.append(np.load(answer, allow_pickle=False))
        return arrays


def _wait(child: subprocess.Popen[bytes], seconds: float, doing: str) -> bytes:
    """The child's stderr, once it has ended."""
    start = time.monotonic()
    while True:
        try:
            return child.communicate(timeout=SILENT_SECONDS)[1]
        except subprocess.TimeoutExpired:
            waited = time.monotonic() - start
            if waited > MOST_WAITS * seconds:
                raise FileError(f"is not read after {waited:.0f} s") from None
            LOG.info(f"{doing}, {waited:.0f} s")


def answer_parent(read: Callable[[bytes, dict[str, Any]], Sequence[Any]]) -> int:
    """The exit code of the child, which sends the arrays of `read(data, options)` to its parent.

    Of a `FileError` the parent gets the message; of any other error its type too.
    """
    options = json.loads(sys.argv[1])
    end_with(options["parent"])
    size = options["bytes"]
    memory = options.get("memory", MEMORY_BYTES + MEMORY_PER_BYTE * size)
    _limit(int(options["seconds"]), memory)
    answer, sys.stdout = sys.stdout.buffer, sys.stderr  # whatever a reader prints is no answer
    try:
        for array in read(sys.stdin.buffer.read(), options):
            np.save(answer, array, allow_pickle=False)
        answer.flush()
        return 0
    except MemoryError:
        message = _NO_MEMORY
    except FileError as error:
        message = str(error)
    except RuntimeError as error:  # torch has no class of its own for it
        message = _NO_MEMORY if "can't allocate memory" in str(error) else _other(error)
    except Exception as error:  # readers raise whatever their parser meets
        message = _other(error)
    sys.stderr.write(f"\n{message}")
    return REFUSED


def end_with(parent: int) -> None:
    """Ends this process soon after the process `parent`, which started it, has ended: one that is killed ends no
    child."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(ASKED_EVERY_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _other(error: Exception) -> str:
    words = " ".join(printable(error).split())[:300]
    return f"cannot be read: {type(error).__name__}: {words}"


def _limit(seconds: int, memory: int) -> None:
    """CPU time and address space of this process, where the system has such limits."""
    try:
        import resource
    except ImportError:
        return
    for kind, most in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_AS, memory)):
        _, hard = resource.getrlimit(kind)  # a child of a child has no more than its parent
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most if kind == resource.RLIMIT_CPU else hard))
