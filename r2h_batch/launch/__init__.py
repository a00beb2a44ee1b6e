"""Launches a kernel over trials: all CPU cores on a CPU, one launch on a GPU; arguments by name (arguments.py)."""

import errno
import os
import shutil
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, lru_cache
from typing import Any

import torch
import warp as wp

from r2h_batch.checks import whole
from r2h_batch.launch import repeated
from r2h_batch.launch.arguments import bind

CACHE_BYTES, MODULE_BYTES = 64 << 20, 8 << 20
BLOCK_DIM = 64
"""Threads of a block on CUDA (a CPU has one). Warp's 256 would leave most of a GPU without a block (bench/gpu.py varies it)."""
UNEVEN_BLOCK_DIM = 32
"""The same of kernels whose trials differ a hundredfold: a block keeps its registers until its last thread ends."""

CHUNK = 32
"""Trials a thread takes at a time: small enough that one hard trial does not leave the other core idle."""


def init_warp() -> None:
    """Starts Warp without its banner (stdout is for results)."""
    wp.config.log_level = wp.LOG_WARNING
    _start()
    _room_to_compile(wp.config.kernel_cache_dir or "")


NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"
"""What Warp's library writes to the process' stderr on a machine without a GPU: no news to whoever uses a CPU."""


@lru_cache(maxsize=1)
def _start() -> None:
    """Starts Warp once; of what its library writes to stderr meanwhile, all but NO_DRIVER is passed on."""
    if torch.cuda.is_available():
        wp.init()
        return
    try:
        before = os.dup(2)
    except OSError:  # stderr is closed
        wp.init()
        return
    with tempfile.TemporaryFile() as kept:
        os.dup2(kept.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(before, 2)
            os.close(before)
            kept.seek(0)
            said = b"".join(line for line in kept if not line.startswith(NO_DRIVER))
            with suppress(OSError):
                os.write(2, said)


@lru_cache(maxsize=1)
def _room_to_compile(cache: str) -> None:
    """Refuse an empty kernel cache on a full disk at once: LLVM ends the whole process when it cannot write."""
    if not os.path.isdir(cache) or any(name.startswith("wp_r2h_batch") for name in os.listdir(cache)):
        return
    _refuse_below(CACHE_BYTES, cache)


@cache
def _room_for(module: Any) -> None:
    """The same for one module that is not compiled yet, asked before its first launch: the disk may have filled since."""
    folder = wp.config.kernel_cache_dir or ""
    if not os.path.isdir(folder) or shutil.disk_usage(folder).free >= MODULE_BYTES:
        return
    known = [module.get_module_identifier(block_dim) for block_dim in (1, BLOCK_DIM, UNEVEN_BLOCK_DIM, None)]
    if not any(os.path.isdir(os.path.join(folder, name)) for name in known):
        _refuse_below(MODULE_BYTES, folder)


def _refuse_below(needed: int, cache: str) -> None:
    free = shutil.disk_usage(cache).free
    if free < needed:
        why = f"{free >> 20} MB free for the kernel cache, {needed >> 20} are needed; set WARP_CACHE_PATH to another"
        raise OSError(errno.ENOSPC, why, cache)


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


def launch_trials(
    kernel: Any,
    n: int,
    *,
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    device: str,
    threads: int | None = None,
    chunk: int = CHUNK,
    width: int = 1,
    first: int = 0,
    uneven: bool = False,
) -> None:
    """Runs `kernel` for trials first..first+n-1; they are wp.tid() + its parameter `first`; `width` > 1: of a second index.

    `inputs`, `outputs`: by the kernel's parameter names without `_in`, `_out`; tensors and NumPy arrays as they are. Every
    name and kind is checked against the kernel before anything runs (`r2h_batch.launch.arguments.bind`).
    `uneven`: some trials take a hundred times as long as others.
    Warp runs a CPU kernel as one serial loop but releases the interpreter lock, so threads over chunks use all cores.
    Chunks only say who computes a trial: results do not depend on them.
    """
    if device == "cpu":
        _launch_on_cpu(kernel, n, inputs, outputs, threads, chunk, width, first)
        return
    args = [first, *bind(kernel, inputs, outputs, device, trials=first + n)]
    if n == 0:
        return
    _room_for(kernel.module)
    dim = (n, width) if width > 1 else n
    block_dim = UNEVEN_BLOCK_DIM if uneven else BLOCK_DIM
    wp.launch(kernel, dim=dim, inputs=args, stream=_stream(device), block_dim=block_dim)


def _launch_on_cpu(
    kernel: Any,
    n: int,
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    threads: int | None,
    chunk: int,
    width: int,
    first: int,
) -> None:
    """`launch_trials` on all cores, with what this thread packed for the kernel before (repeated.py)."""
    if repeated.cpu().is_capturing:
        raise RuntimeError(
            f"Warp records a graph on the CPU, and {kernel.key} would be missing in it: it runs on threads of its own; call "
            "it before or after the recording (Evaluator.capture records calls on a GPU)"
        )
    packed = repeated.taken(kernel)
    if packed is None or not packed.refill(inputs, outputs, first + n):
        args = [first, *bind(kernel, inputs, outputs, "cpu", trials=first + n)]
        if n == 0:
            return
        _room_for(kernel.module)
        packed = repeated.Repeated(kernel, args, inputs, outputs)
    workers = 1 if n <= chunk else min(cpu_threads(threads), -(-n // chunk))
    if workers > 1:
        _share(packed, n, workers, chunk, width, first)
    elif n:  # nothing to share
        packed.run(0, first, n, width)
    repeated.kept(packed)


def _share(packed: repeated.Repeated, n: int, workers: int, chunk: int, width: int, first: int) -> None:
    """Trials first..first+n-1 by chunks: whoever of the workers is free takes the next one."""
    packed.prepare(workers)
    firsts = iter(range(first, first + n, chunk))  # next() is atomic

    def work(worker: int) -> None:
        for start in firsts:
            packed.run(worker, start, min(chunk, first + n - start), width)

    futures = [thread_pool(workers).submit(work, worker) for worker in range(1, workers)]
    work(0)
    for future in futures:
        future.result()


def load(kernel: Any, device: str) -> None:
    """Compiles the kernel's module for the device, or loads it, as `launch_trials` of uneven rows does at its first row."""
    init_warp()
    _room_for(kernel.module)
    wp.load_module(kernel.module, device=device, block_dim=1 if device == "cpu" else UNEVEN_BLOCK_DIM)


def launch(kernel: Any, dim: int, *, inputs: Mapping[str, Any], outputs: Mapping[str, Any], device: str) -> None:
    """Runs a kernel that has no parameter `first` once, on Warp's own stream; arguments as in `launch_trials`."""
    _room_for(kernel.module)
    wp.launch(kernel, dim=dim, inputs=bind(kernel, inputs, outputs, device), device=device)


def _stream(device: str) -> wp.Stream:
    """Torch's stream: what torch wrote before is there, what it reads after has been written, nobody waits on the host.

    Given to the launch itself: ScopedStream would make it wait for Warp's own stream, which no graph can capture.
    """
    return wp.stream_from_torch(torch.cuda.current_stream(torch.device(device)))
