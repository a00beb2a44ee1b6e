"""Many objects built on all cores, before somebody asks for them one by one: workers fill the
folder of what is kept.

`python -m r2h_batch.bodies.mesh_import.build_ahead` is a worker: a build's arguments as one line of JSON on its
stdin, one line back when it is done. What goes wrong in a worker goes wrong again where the object
is asked for, and is said there.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import Empty, SimpleQueue
from typing import Any

from r2h_batch.bodies.objects import build_object, is_built
from r2h_batch.command_line import tell
from r2h_batch.io.cache import cache_folder

__all__ = ["build_ahead"]

Call = Mapping[str, Any]
SILENT_S = 5.0


def build_ahead(calls: Sequence[Call], *, cores: int | None = None) -> int:
    """Builds what these arguments of `build_object` name and is not kept yet, with a bar on a
    terminal; returns how many were handed out. One alone, and anything where nothing is kept, is
    left to who asks for it."""
    if cache_folder() is None:
        return 0
    todo = [call for call in calls if not is_built(**call)]
    workers = min(len(todo), cores or len(os.sched_getaffinity(0)))
    if workers < 2:
        return 0
    queue: SimpleQueue[str] = SimpleQueue()
    for call in todo:
        queue.put(json.dumps(call, default=str))
    with _bar(len(todo), workers) as advance, ThreadPoolExecutor(workers) as pool:
        for future in [pool.submit(_drive, queue, advance) for _ in range(workers)]:
            future.result()
    return len(todo)


def _drive(queue: SimpleQueue[str], advance: Callable[[], None]) -> None:
    """One worker, fed as long as there is work; one that ends early leaves its object to who asks
    for it."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p or os.getcwd() for p in sys.path)}
    worker = subprocess.Popen(
        [sys.executable, "-P", "-m", "r2h_batch.bodies.mesh_import.build_ahead"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True,
    )  # fmt: skip
    assert worker.stdin is not None and worker.stdout is not None
    try:
        while True:
            worker.stdin.write(queue.get_nowait() + "\n")
            worker.stdin.flush()
            if not worker.stdout.readline():
                return
            advance()
    except (Empty, BrokenPipeError):
        return
    finally:
        with contextlib.suppress(BrokenPipeError):
            worker.stdin.close()
        try:
            worker.wait(SILENT_S)
        except subprocess.TimeoutExpired:
            worker.kill()
            worker.wait()
        worker.stdout.close()


@contextlib.contextmanager
def _bar(total: int, workers: int) -> Iterator[Callable[[], None]]:
    """A bar on a terminal, else a plain line every 5 s, on stderr."""
    if sys.stderr.isatty() and os.environ.get("TERM", "dumb") != "dumb":
        from rich.console import Console
        from rich.progress import Progress

        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(f"building objects on {workers} cores", total=total)
            yield lambda: bar.advance(task, 1)
        return
    lock, done, said = threading.Lock(), 0, time.monotonic()

    def count() -> None:
        nonlocal done, said
        with lock:
            done += 1
            if time.monotonic() - said > SILENT_S:
                said = time.monotonic()
                tell(f"building objects on {workers} cores: {done} of {total}")

    yield count


def work() -> int:
    """A worker's life; its exit code."""
    answer, sys.stdout = sys.stdout, sys.stderr  # whatever a library prints is no answer
    for line in sys.stdin:
        # both come again where the object is asked for
        with (
            warnings.catch_warnings(),
            contextlib.suppress(Exception),
        ):
            warnings.simplefilter("ignore")
            build_object(**json.loads(line))
        answer.write("done\n")
        answer.flush()
    return 0


if __name__ == "__main__":
    sys.exit(work())
