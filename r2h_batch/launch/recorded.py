"""Launches over the rows of a batch, kept with the memory they had: the next call of that size runs
them again.

What a small call costs beside its kernels is the way from one to the next: memory asked for,
tensors wrapped, arguments bound, by code that the kernels have driven out of the caches meanwhile.
None of that depends on what the rows hold. So it is done once; a recorded call writes into the
launches where its inputs lie now, and walks through them.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from r2h_batch.launch.arguments import parameters
from r2h_batch.launch.repeated import Repeated, refuse_graph
from r2h_batch.launch.workers import cpu_threads, share

CHUNK, TURNS = 16, 16
"""A thread takes so many rows at a time through all kernels at least, and in a large batch comes so
many times for more."""

R = TypeVar("R")


class Recorded(Generic[R]):
    """`recorded(*tensors)` is `function(*tensors)`, whose result lies in memory that the next call
    writes again.

    `function` may launch kernels over all `rows`, and ask for memory that they fill or that nobody
    writes: what else torch did in it would not be done again. A row may depend on its own inputs
    alone: the threads share the rows once, and each takes its own through all kernels. One call at
    a time.
    """

    def __init__(self, function: Callable[..., R], tensors: Sequence[Tensor], rows: int) -> None:
        """`tensors`: contiguous, on a CPU; later ones have their shapes and data types."""
        self.rows = rows
        self._launches: list[tuple[Repeated, int]] = []  # and the width of each
        self._kept: list[Any] = []  # what owns the memory that they read and write
        with torch.inference_mode(False), torch.no_grad():
            # of its own: inputs that lie in one place could not be told apart
            inputs = [x.clone() for x in tensors]
            before, _of_thread.recording = current(), self
            try:
                self.result = function(*inputs)
            finally:
                _of_thread.recording = before
        self._kept.append(inputs)
        which = {x.data_ptr(): i for i, x in enumerate(inputs)}
        arrays = [
            (k, p.label)
            for k, _ in self._launches
            for p in parameters(k.kernel)
            if p.array is not None
        ]
        found = [
            (packed, label, which.get(getattr(packed.arguments, label).data))
            for packed, label in arrays
        ]
        self._inputs = [
            (packed, label, i) for packed, label, i in found if i is not None
        ]  # who reads which
        self._read: list[
            list[tuple[Any, int]]
        ] = []  # the same of each worker: descriptors among its arguments

    def add(self, packed: Repeated, first: int, n: int, width: int, kept: Any) -> None:
        """Takes what has just run; ValueError where that was not over all rows."""
        if (first, n) != (0, self.rows):
            raise ValueError(
                f"kernel {packed.kernel.key} ran over trials {first} to {first + n - 1} of a recorded call of {self.rows} rows; "
                "what is recorded runs over all of them"
            )
        self._launches.append((packed, width))
        self._kept.append(kept)

    def __call__(self, *tensors: Tensor, threads: int | None = None) -> R:
        """What `function` returned, the same object each time, with the numbers of these
        tensors."""
        refuse_graph("a recorded call")
        workers = 1 if self.rows <= CHUNK else min(cpu_threads(threads), -(-self.rows // CHUNK))
        while len(self._read) < workers:
            self._read.append(self._of_worker(len(self._read)))
        addresses = [x.data_ptr() for x in tensors]
        for read in self._read[:workers]:
            for descriptor, i in read:
                descriptor.data = addresses[i]
        if workers > 1:
            share(self._run, 0, self.rows, workers, max(CHUNK, self.rows // (TURNS * workers)))
        else:
            self._run(0, 0, self.rows)
        return self.result

    def _run(self, worker: int, first: int, rows: int) -> None:
        for packed, width in self._launches:
            packed.run(worker, first, rows, width)

    def _of_worker(self, worker: int) -> list[tuple[Any, int]]:
        """Arguments of its own for a worker; the descriptors of inputs among them."""
        for packed, _ in self._launches:
            packed.prepare(worker + 1)
        return [(getattr(packed.copies[worker], label), i) for packed, label, i in self._inputs]


def current() -> "Recorded[Any] | None":
    """What records this thread's launches just now."""
    recording: Recorded[Any] | None = getattr(_of_thread, "recording", None)
    return recording


@contextmanager
def unrecorded() -> Iterator[None]:
    """Launches inside are their own: a signal's handler or a finaliser may score while its thread
    records another call."""
    before = current()
    if before is None:
        yield
        return
    _of_thread.recording = None
    try:
        yield
    finally:
        _of_thread.recording = before


_of_thread = threading.local()
