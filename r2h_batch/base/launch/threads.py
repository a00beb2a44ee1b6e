"""Threads on a CPU: the process' workers share the rows of a batch; torch works on one thread
meanwhile.

After each operation that torch shares among threads, idle threads of OpenMP spin for milliseconds.
Our kernels start at once on all cores, so two threads would compete for one core. More threads for
torch never pay: what torch does takes 3 % of a call of 4,096 rows, and less of a larger one.
"""

import ctypes
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from functools import cache, lru_cache
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch

from r2h_batch.base.validate import integer

CHUNK = 32
"""Batches of at most so many trials are computed by the calling thread alone, unless a kernel's
caller says otherwise."""

_threads: ContextVar[int | None] = ContextVar("threads", default=None)


@contextmanager
def on_threads(threads: int | None) -> Iterator[None]:
    """Kernels that this thread of the program launches inside have so many workers; None: one per
    core. With one, torch works on one thread too: several such programs share a machine."""
    before = _threads.set(threads)
    try:
        with one_torch_thread("cpu") if threads == 1 else nullcontext():
            yield
    finally:
        _threads.reset(before)


def cpu_threads(threads: int | None = None) -> int:
    """The number of worker threads of a launch on the CPU.

    Args:
        threads: 1 or more; None: as `on_threads` says, else one per core this process may use.
    """
    threads = _threads.get() if threads is None else threads
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
    if torch.get_num_threads() > 1:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_after_fork)


_of_thread = threading.local()  # shares: whether this thread is inside `share`


TURNS, LEAST = 4, 16
"""Pieces of trials that cost alike: each is a TURNS-th of a worker's share of what is left, and has
LEAST trials at least."""


def _pieces(first: int, n: int, workers: int, chunk: int | None) -> Iterator[tuple[int, int]]:
    """The first trial of each piece and the one after its last; next() is atomic.

    Without a `chunk` pieces get smaller (guided self-scheduling, Polychronopoulos and Kuck 1987).
    Large ones keep neighbours, which often have one object and one hand, in one core's cache; with
    small ones at the end the workers finish together.
    """
    end = first + n
    if chunk is not None:
        return zip(range(first, end, chunk), chain(range(first + chunk, end, chunk), [end]))
    bounds = [first]
    while bounds[-1] < end:
        left = end - bounds[-1]
        bounds.append(bounds[-1] + min(left, max(LEAST, left // (TURNS * workers))))
    return pairwise(bounds)


def share(
    run: Callable[[int, int, int], None], first: int, n: int, workers: int, chunk: int | None
) -> None:
    """`run(worker, start, rows)` of trials first..first+n-1 in pieces: whoever of the workers is
    free takes the next one. `chunk`: trials of a piece; None: trials cost alike.

    The calling thread is worker 0. Compiled kernels let go of the interpreter's lock: they run at
    once. However this ends, an interrupt of the calling thread included, no worker is active any
    more: the caller may free the memory.

    A signal's handler may interrupt a thread that holds the pool's locks, and launch: its launches
    are computed by its thread alone.
    """
    outer = getattr(_of_thread, "shares", False)
    pieces = _pieces(first, n, workers, chunk)
    busy: set[int] = set()

    def work(worker: int) -> None:
        for start, end in pieces:
            run(worker, start, end - start)

    def help_out(worker: int) -> None:
        busy.add(worker)  # before it takes a chunk
        try:
            work(worker)
        finally:
            busy.discard(worker)

    futures = []
    try:
        _of_thread.shares = True
        for worker in range(1, 1 if outer else workers):
            try:
                futures.append(thread_pool(workers).submit(help_out, worker))
            # the interpreter is going down, or has no thread left to give: this one does it all
            except RuntimeError:
                break
        work(0)
        for future in futures:
            future.result()
    finally:
        try:
            _call_back(pieces, busy)
        finally:
            _of_thread.shares = outer


def _call_back(pieces: Iterator[tuple[int, int]], busy: set[int]) -> None:
    """Returns when no piece is left and no worker is active; an interrupt meanwhile is raised after
    that."""
    interrupt = None
    while True:
        try:
            for _ in pieces:
                pass
            while busy:
                time.sleep(1e-4)
            break
        except BaseException as e:
            interrupt = e
    if interrupt is not None:
        raise interrupt


@contextmanager
def one_torch_thread(device: str | torch.device) -> Iterator[None]:
    """On a CPU: torch works on one thread inside, in this thread of the program; what it was set to
    holds again after."""
    threads = torch.get_num_threads()
    if threads == 1 or str(device) != "cpu":
        yield
        return
    engine = _of_this_thread()
    if engine is None:
        torch.set_num_threads(1)
    else:
        engine.openmp(1)
        mkl = engine.mkl(1)
    try:
        yield
    finally:
        if engine is None:
            torch.set_num_threads(threads)
        else:
            engine.mkl(mkl)
            engine.openmp(threads)


class _Setters(NamedTuple):
    """Functions that set a number of threads for the calling thread alone; MKL's returns what was
    set (0: what OpenMP says)."""

    openmp: Callable[[int], Any]
    mkl: Callable[[int], int]


@cache
def _of_this_thread() -> _Setters | None:
    """The functions behind `torch.set_num_threads` (torch 2.13, wheels for Linux); None in another
    build, where `torch.set_num_threads` itself is called.

    `torch.set_num_threads` calls both, but is also what every thread starts with that has not used
    torch before: one whose first tensor falls into somebody else's call of ours would stay on one
    thread for good.
    """
    before = torch.get_num_threads()
    try:
        library = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libtorch_cpu.so"))
        openmp = library.omp_set_num_threads
    except (AttributeError, OSError):
        return None
    openmp(before + 1)
    works = torch.get_num_threads() == before + 1
    openmp(before)
    return (
        _Setters(openmp, getattr(library, "MKL_Set_Num_Threads_Local", lambda _: 0))
        if works
        else None
    )
