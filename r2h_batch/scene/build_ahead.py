"""Many objects built on all cores, before they are loaded one by one: workers fill the cache.

`python -m r2h_batch.scene.build_ahead` is a worker: the arguments of its builds as JSON
on its stdin. What goes wrong in a worker goes wrong again where the object is asked for, and is said
there.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from r2h_batch.base.io.cache import cache_folder
from r2h_batch.base.io.child import end_with
from r2h_batch.base.io.log import LOG
from r2h_batch.scene.mesh_import.limits import REPAIRED
from r2h_batch.scene.objects import build_object, is_built


def build_ahead(calls: Sequence[Mapping[str, Any]], *, cores: int | None = None) -> int:
    """Build what these arguments of `build_object` name and the cache does not hold.

    One object alone, and all of them where the cache is off, are left to who asks for them.

    Args:
        calls: arguments of `build_object`.
        cores: number of workers; default: all cores.

    Returns:
        How many were handed out.
    """
    todo = [] if cache_folder() is None else [call for call in calls if not is_built(**call)]
    workers = min(len(todo), cores or len(os.sched_getaffinity(0)))
    if workers < 2:
        return 0
    LOG.info(f"building {len(todo)} objects on {workers} cores")
    path = os.pathsep.join(p or os.getcwd() for p in sys.path)
    command = [sys.executable, "-P", "-m", "r2h_batch.scene.build_ahead", str(os.getpid())]
    started: list[subprocess.Popen[str]] = []
    try:
        for k in range(workers):
            worker = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
                env={**os.environ, "PYTHONPATH": path},
            )  # fmt: skip
            started.append(worker)
            assert worker.stdin is not None
            with contextlib.suppress(BrokenPipeError), worker.stdin as stream:
                json.dump(todo[k::workers], stream, default=str)
        for worker in started:
            worker.wait()
    finally:
        for worker in started:
            worker.kill()
            worker.wait()
    return len(todo)


def work() -> None:
    """Build what stdin names."""
    end_with(int(sys.argv[1]))
    for call in json.load(sys.stdin):
        # errors and warnings come again where the object is asked for, but for a repair
        with warnings.catch_warnings(record=True) as caught, contextlib.suppress(Exception):
            warnings.simplefilter("always")
            build_object(**call)
            LOG.info(f"built {Path(call['mesh']).name}")
        for text in (str(w.message) for w in caught):
            if REPAIRED in text:
                LOG.info(text)


if __name__ == "__main__":
    work()
