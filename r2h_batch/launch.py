"""Launches a kernel over trials: all CPU cores on a CPU, one launch on a GPU."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import warp as wp

CHUNK = 32
"""Trials a thread takes at a time: small enough that one hard trial does not leave the other core idle."""


def init_warp() -> None:
    """Starts Warp without its banner (stdout is for results)."""
    wp.config.log_level = wp.LOG_WARNING
    wp.init()


def cpu_threads(threads: int | None = None) -> int:
    """The number of worker threads: as asked, or one per core this process may use."""
    if threads is not None:
        if threads < 1:
            raise ValueError(f"threads is {threads}; it must be 1 or more")
        return threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def one_torch_thread(device: str) -> Iterator[None]:
    """On a CPU: torch works on one thread inside. Its tensors here are small, and its idle threads spin on our cores."""
    import torch

    threads = torch.get_num_threads()
    if device != "cpu" or threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@lru_cache(maxsize=4)
def thread_pool(threads: int) -> ThreadPoolExecutor:
    """The process' worker threads."""
    return ThreadPoolExecutor(threads, thread_name_prefix="r2h")


def launch_trials(
    kernel: Any,
    n: int,
    inputs: Sequence[Any],
    *,
    device: str,
    threads: int | None = None,
    chunk: int = CHUNK,
    width: int = 1,
) -> None:
    """Runs `kernel(first, *inputs)` for trials 0..n-1, trial = first + wp.tid() (and a second index if `width` > 1).

    Warp runs a CPU kernel as one serial loop but releases the interpreter lock, so threads over chunks use all cores.
    Chunks only say who computes a trial: results do not depend on them.
    """
    if n == 0:
        return
    if device != "cpu":
        import torch

        # torch's stream: what torch wrote before is there, what it reads after has been written, nobody waits on the host.
        # Given to the launch itself: ScopedStream would make it wait for Warp's own stream, which no graph can capture.
        stream = wp.stream_from_torch(torch.cuda.current_stream(torch.device(device)))
        wp.launch(kernel, dim=(n, width) if width > 1 else n, inputs=[0, *inputs], stream=stream)
        return
    workers = min(cpu_threads(threads), -(-n // chunk))
    # Arguments are packed once per worker (here: the first packing compiles the module); a launch then costs microseconds.
    commands = [wp.launch(kernel, dim=1, inputs=[0, *inputs], device="cpu", record_cmd=True) for _ in range(workers)]
    firsts = iter(range(0, n, chunk))  # next() is atomic: whoever is free takes the next chunk

    def work(command: wp.Launch) -> None:
        size = 0
        for first in firsts:
            rows = min(chunk, n - first)
            if rows != size:
                size = rows
                command.set_dim((rows, width) if width > 1 else rows)
            command.set_param_at_index(0, first)
            command.launch()

    futures = [thread_pool(workers).submit(work, command) for command in commands[1:]]
    work(commands[0])
    for future in futures:
        future.result()
