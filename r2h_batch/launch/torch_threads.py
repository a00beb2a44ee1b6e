"""Torch on one thread for the length of our work on a CPU: its threads spin on the cores that our
kernels run on.

After each operation that torch shares among threads, OpenMP's idle ones go on turning for
milliseconds, in case there is more to do. Our kernels start at once, on all cores, and then have
two threads on one of them. There is no number of rows from which on more threads would pay: what
torch does takes 3% of a call of 4,096 rows, less of a larger one, and a second thread could save
half of that at most.
"""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch


@contextmanager
def one_torch_thread(device: str | torch.device) -> Iterator[None]:
    """On a CPU: torch works on one thread inside, in this thread of the program; what it was set to
    holds again after."""
    threads = torch.get_num_threads()
    if threads == 1 or str(device) != "cpu":
        yield
        return
    here = _of_this_thread()
    if here is None:
        torch.set_num_threads(1)
    else:
        here.openmp(1)
        mkl = here.mkl(1)
    try:
        yield
    finally:
        if here is None:
            torch.set_num_threads(threads)
        else:
            here.mkl(mkl)
            here.openmp(threads)


class _Setters(NamedTuple):
    """What sets a number of threads for the calling thread alone; MKL's returns what was set (0:
    what OpenMP says)."""

    openmp: Callable[[int], Any]
    mkl: Callable[[int], int]


@cache
def _of_this_thread() -> _Setters | None:
    """The functions behind `torch.set_num_threads`, where torch was built with them as its wheels
    for Linux are.

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
