"""Whether other processes are there, for tests that kill."""

import contextlib
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path


def alive(pid: int) -> bool:
    """Whether a process is there and no zombie."""
    with contextlib.suppress(ProcessLookupError, FileNotFoundError):
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def children_of(pid: int) -> list[int]:
    """Processes that a process started."""
    each = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for file in each for child in file.read_text().split()]


def until(condition: Callable[[], object], seconds: float) -> bool:
    """Whether a condition comes true within this time."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.1)
    return True


def all_end(pids: Iterable[int], seconds: float) -> bool:
    """Whether processes end within this time."""
    return until(lambda: not any(map(alive, pids)), seconds)
