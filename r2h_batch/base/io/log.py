"""Lines that a command prints on stderr and, once a run folder exists, in its log file."""

import contextlib
import logging
import os
import stat
import sys
import time
from collections.abc import Callable, Iterator
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import TextIO

from r2h_batch import strangers
from r2h_batch.base.io.read import printable

MOST_KEPT = 1000
"""Lines kept until there is a log file."""


_said = 0
"""Lines on stderr so far."""


class _Stderr(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        global _said
        _said += 1
        try:
            print(printable(record.getMessage(), keep="\n"), file=sys.stderr, flush=True)
        except (OSError, ValueError):
            silence(sys.stderr)


class _LogFile(logging.Handler):
    """Appends whole lines, also if other processes write; never follows a link, opens a pipe, or writes into a file that has
    a second name: a copy by `cp -al`, or somebody's file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def emit(self, record: logging.LogRecord) -> None:
        stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(record.created))
        line = f"{stamp} {' '.join(printable(record.getMessage(), keep=chr(10)).split())}\n"
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_NOFOLLOW
        with contextlib.suppress(OSError):  # a full disk is the sweep's trouble, not the log's
            handle = os.open(self.path, flags, 0o666)
            try:
                found = os.fstat(handle)
                if stat.S_ISREG(found.st_mode) and found.st_nlink == 1:
                    os.write(handle, line.encode("utf-8", "replace"))
            finally:
                os.close(handle)


LOG = logging.Logger("r2h_batch", logging.DEBUG)
"""Logger of a command: errors, infos (not with --quiet) and debug lines (with --verbose)."""
_stderr = _Stderr(logging.INFO)
LOG.addHandler(_stderr)
strangers.say = LOG.info


@contextlib.contextmanager
def telling(*, quiet: bool = False, verbose: bool = False) -> Iterator[Callable[[Path], None]]:
    """Set how much is printed inside; gives `log_to(FILE)`, which stores all lines since the start."""
    before = MemoryHandler(MOST_KEPT, flushLevel=logging.CRITICAL + 1)
    added: list[logging.Handler] = [before]
    LOG.addHandler(before)
    level = _stderr.level
    _stderr.setLevel(logging.ERROR if quiet else logging.DEBUG if verbose else logging.INFO)

    def log_to(file: Path) -> None:
        added.append(_LogFile(file))
        before.setTarget(added[-1])
        LOG.removeHandler(before)
        before.flush()
        LOG.addHandler(added[-1])

    try:
        yield log_to
    finally:
        _stderr.setLevel(level)
        for handler in added:
            LOG.removeHandler(handler)


def lines_said() -> int:
    """How many lines stderr has got since the program began."""
    return _said


def is_quiet() -> bool:
    """Whether stderr is for errors alone."""
    return _stderr.level > logging.INFO


def silence(stream: TextIO) -> None:
    """Sends the rest of a broken stream to the null device: Python flushes streams again at exit
    and would fail."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
