"""Readers of other people's formats, each in a process of its own: a damaged file can make a
library run for ever, take all memory or crash.

The child gets the opened file as its stdin. It answers with arrays on stdout, or with one line on
stderr and the exit code `REFUSED`. A `StandingReader` is a child that is asked again and again: small
files would wait for its start.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import io
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import naming

MOST_WAITS = 10
"""The child may wait this many times longer than it may work: for a busy machine, not for ever."""
SILENT_SECONDS = 5.0
MEMORY_BYTES = 8 << 30
MEMORY_PER_BYTE = 40
"""The child's address space: some for the libraries, and some for each byte of the file (text takes
most)."""
STANDING_BYTES, STANDING_PER_BYTE = 1 << 30, 12
"""The same of a child that reads many small files."""
ASKED_EVERY_S = 0.5
"""How often a child asks whether its parent lives."""
REFUSED, FULL = 3, 4
"""Exit codes of a child that refuses its file, and of one whose answer does not fit on the disk."""
_NO_MEMORY = "asks for more memory than any file of its size needs"


@contextlib.contextmanager
def temporary_file() -> Iterator[Any]:
    """A file without a name, which ends with the block. An error of writing it names the folder of such files, and what
    sets it."""
    where = f"{tempfile.gettempdir()} (temporary files; TMPDIR names another folder)"
    with naming(Path(where)), tempfile.TemporaryFile() as file:
        yield file


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
    with temporary_file() as answer:
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", module, words],
            stdin=file, stdout=answer, stderr=subprocess.PIPE, env=_environment({}),
        )  # fmt: skip
        try:
            error = _wait(child, seconds, doing).decode("utf-8", "replace")
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
        if child.returncode == FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if child.returncode == REFUSED:
            raise FileError(error.strip().rpartition("\n")[2])
        if child.returncode < 0:
            raise FileError(_cut_off(seconds, child.returncode))
        if child.returncode:
            raise FileError("cannot be read: its reader ended with an error")
        size = answer.seek(0, os.SEEK_END)
        answer.seek(0)
        arrays: list[Any] = []
        while answer.tell() < size if count is None else len(arrays) < count:
            arrays.append(np.load(answer, allow_pickle=False))
        return arrays


class StandingReader:
    """A child that reads one file after the other, and ends with this process. One that dies is started again."""

    def __init__(self, module: str, *, seconds: float) -> None:
        """Starts nothing yet.

        Args:
            module: run with `python -m`; it calls `answer_often`.
            seconds: CPU time that the child may take for a file.
        """
        self.module, self.seconds = module, seconds
        self._child: subprocess.Popen[bytes] | None = None
        self._owner, self._one_at_a_time = 0, threading.Lock()

    def read(self, data: bytes) -> list[Any]:
        """The arrays that the child answers with; `FileError`: what is wrong with the data, without a file's name."""
        with self._one_at_a_time:
            child = self._running()
            assert child.stdin is not None and child.stdout is not None
            late = threading.Timer(MOST_WAITS * self.seconds, child.kill)
            late.daemon = True
            late.start()
            head, body = b"", b""
            try:
                with contextlib.suppress(BrokenPipeError):
                    child.stdin.write(len(data).to_bytes(8, "little") + data)
                    child.stdin.flush()
                    head = child.stdout.read(9)
                    body = child.stdout.read(int.from_bytes(head[1:], "little"))
            except BaseException:  # Ctrl-C: the answer would come to the next file
                self.close()
                raise
            finally:
                late.cancel()
            if len(head) < 9 or len(body) < int.from_bytes(head[1:], "little"):
                self.close()
                raise FileError(_cut_off(self.seconds, child.returncode))
        if head[0]:
            raise FileError(body.decode("utf-8", "replace"))
        stream, arrays = io.BytesIO(body), []
        while stream.tell() < len(body):
            arrays.append(np.load(stream, allow_pickle=False))
        return arrays

    def close(self) -> None:
        """End the child, if there is one."""
        if self._child is not None and self._owner == os.getpid():
            self._child.kill()
            self._child.communicate()
        self._child = None

    def _running(self) -> subprocess.Popen[bytes]:
        # in a fork of the process that started it, the child is somebody else's
        if self._child is None or self._owner != os.getpid():
            line = [sys.executable, "-P", "-m", self.module, str(os.getpid()), str(self.seconds)]
            own = {"OPENBLAS_NUM_THREADS": "1"}  # each thread reserves address space
            self._child = subprocess.Popen(
                line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=_environment(own)
            )  # fmt: skip
            self._owner = os.getpid()
            atexit.register(self.close)
        return self._child


def answer_often(read: Callable[[bytes], Sequence[Any]]) -> int:
    """The exit code of a `StandingReader`'s child, which sends the arrays of `read(data)` for each file to its parent."""
    end_with(int(sys.argv[1]))
    seconds, answer, sys.stdout = float(sys.argv[2]), sys.stdout.buffer, sys.stderr
    while len(head := sys.stdin.buffer.read(8)) == 8:
        size = int.from_bytes(head, "little")
        _limit(
            math.ceil(time.process_time() + seconds),
            STANDING_BYTES + STANDING_PER_BYTE * size,
            again=True,
        )
        body, refused = io.BytesIO(), 0
        try:
            for array in read(sys.stdin.buffer.read(size)):
                np.save(body, array, allow_pickle=False)
        except Exception as error:
            body, refused = io.BytesIO(_message(error).encode()), 1
        answer.write(bytes([refused]) + body.getbuffer().nbytes.to_bytes(8, "little"))
        answer.write(body.getbuffer())
        answer.flush()
    return 0


def _environment(own: Mapping[str, str]) -> dict[str, str]:
    """Modules from where this process has them, and from nowhere else: the folder may be the file's,
    with a numpy.py in it."""
    path = os.pathsep.join(p or os.getcwd() for p in sys.path)
    return {**os.environ, **own, "PYTHONPATH": path}


def _cut_off(seconds: float, code: int) -> str:
    return f"takes more than {seconds:g} s of CPU time, or ends its reader ({-code})"


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
        arrays = read(sys.stdin.buffer.read(), options)
    except Exception as error:  # readers raise whatever their parser meets
        sys.stderr.write(f"\n{_message(error)}")
        return REFUSED
    try:
        for array in arrays:
            np.save(answer, array, allow_pickle=False)
        answer.flush()
    except OSError:
        os._exit(FULL)  # Python would write again what is left
    return 0


def end_with(parent: int) -> None:
    """Ends this process soon after the process `parent`, which started it, has ended: one that is killed ends no
    child."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(ASKED_EVERY_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _message(error: Exception) -> str:
    """The message of a `FileError`; of any other error its type too."""
    if isinstance(error, FileError):
        return str(error)
    # torch has no class of its own for it
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return _NO_MEMORY
    words = " ".join(printable(error).split())[:300]
    return f"cannot be read: {type(error).__name__}: {words}"


def _limit(seconds: int, memory: int, *, again: bool = False) -> None:
    """CPU time and address space of this process, where the system has such limits; `again`: they may be set anew."""
    try:
        import resource
    except ImportError:
        return
    for kind, most in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_AS, memory)):
        _, hard = resource.getrlimit(kind)  # a child of a child has no more than its parent
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        final = kind == resource.RLIMIT_CPU and not again
        resource.setrlimit(kind, (most, most if final else hard))
