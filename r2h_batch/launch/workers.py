"""The process' worker threads, and how they share the rows of a batch on a CPU."""

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

from r2h_batch.checks import whole


def cpu_threads(threads: int | None = None) -> int:
    """The number of worker threads: as asked, or one per core this process may use."""
    if threads is not None:
        return whole(1)("threads", threads)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@lru_cache(maxsize=4)
def thread_pool(threads: int) -> ThreadPoolExecutor:
    """The process' worker threads."""
    return ThreadPoolExecutor(threads, thread_name_prefix="r2h")


def _after_fork() -> None:
    """A child has the pools without their threads, and waits for ever for what it hands them: it starts its own.

    Torch's (OpenMP) threads stay behind too, and the first larger operation waits for them: a child works on one.
    """
    thread_pool.cache_clear()
    torch = sys.modules.get("torch")
    if torch is not None and torch.get_num_threads() > 1:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_after_fork)


def share(run: Callable[[int, int, int], None], first: int, n: int, workers: int, chunk: int) -> None:
    """`run(worker, start, rows)` of trials first..first+n-1 by chunks: whoever of the workers is free takes the next one.

    The calling thread is worker 0. Compiled kernels let go of the interpreter's lock: they run at once.
    """
    starts = iter(range(first, first + n, chunk))  # next() is atomic

    def work(worker: int) -> None:
        for start in starts:
            run(worker, start, min(chunk, first + n - start))

    futures = [thread_pool(workers).submit(work, worker) for worker in range(1, workers)]
    work(0)
    for future in futures:
        future.result()
