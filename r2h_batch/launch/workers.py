"""The process' worker threads, and how they share the rows of a batch on a CPU."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

from r2h_batch.validate import integer


def cpu_threads(threads: int | None = None) -> int:
    """The number of worker threads: as asked, or one per core this process may use."""
    if threads is not None:
        return integer(1)("threads", threads)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@lru_cache(maxsize=4)
def thread_pool(threads: int) -> ThreadPoolExecutor:
    """The process' worker threads."""
    return ThreadPoolExecutor(threads, thread_name_prefix="r2h")


def _after_fork() -> None:
    """A child has the pools without their threads, and waits for ever for what it hands them: it
    starts its own.

    Torch's (OpenMP) threads stay behind too, and the first larger operation waits for them: a child
    works on one.
    """
    thread_pool.cache_clear()
    torch = sys.modules.get("torch")
    if torch is not None and torch.get_num_threads() > 1:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_after_fork)


def share(
    run: Callable[[int, int, int], None], first: int, n: int, workers: int, chunk: int
) -> None:
    """`run(worker, start, rows)` of trials first..first+n-1 by chunks: whoever of the workers is
    free takes the next one.

    The calling thread is worker 0. Compiled kernels let go of the interpreter's lock: they run at
    once. However this ends, an interrupt of the calling thread included, no worker is active any
    more: the caller may free the memory.
    """
    starts = iter(range(first, first + n, chunk))  # next() is atomic
    busy: set[int] = set()

    def work(worker: int) -> None:
        for start in starts:
            run(worker, start, min(chunk, first + n - start))

    def help_out(worker: int) -> None:
        busy.add(worker)  # before it takes a chunk
        try:
            work(worker)
        finally:
            busy.discard(worker)

    futures = []
    try:
        for worker in range(1, workers):
            try:
                futures.append(thread_pool(workers).submit(help_out, worker))
            except (
                RuntimeError
            ):  # the interpreter is going down, or has no thread left to give: this one does it all
                break
        work(0)
        for future in futures:
            future.result()
    finally:
        _call_back(starts, busy)


def _call_back(starts: Iterator[int], busy: set[int]) -> None:
    """Returns when no chunk is left and no worker is active; an interrupt meanwhile is raised after
    that."""
    interrupt = None
    while True:
        try:
            for _ in starts:
                pass
            while busy:
                time.sleep(1e-4)
            break
        except BaseException as e:
            interrupt = e
    if interrupt is not None:
        raise interrupt
