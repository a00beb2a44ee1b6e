"""Launches a kernel over trials: all CPU cores on a CPU, one launch on a GPU; arguments by name
(arguments.py)."""

import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from functools import cache, lru_cache, partial
from typing import Any

import torch
import warp as wp

from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.progress import progress
from r2h_batch.base.launch import cached, repeated
from r2h_batch.base.launch.arguments import bind, new_outputs, written_shapes
from r2h_batch.base.launch.threads import (
    CHUNK,
    cpu_threads,
    one_torch_thread,
    share,
    thread_pool,
)

__all__ = [
    "BLOCK_DIM",
    "CACHE_BYTES",
    "CHUNK",
    "MODULE_BYTES",
    "NO_DRIVER",
    "UNEVEN_BLOCK_DIM",
    "cpu_threads",
    "init_warp",
    "launch",
    "launch_trials",
    "load",
    "new_outputs",
    "over_trials",
    "thread_pool",
]

CACHE_BYTES, MODULE_BYTES = 64 << 20, 8 << 20
BLOCK_DIM = 64
"""Threads of a block on CUDA (a CPU has one). Warp's 256 would leave most of a GPU without a block
(bench/gpu.py varies it)."""
UNEVEN_BLOCK_DIM = 32
"""The same of kernels whose trials differ a hundredfold: a block keeps its registers until its last
thread ends."""


def init_warp() -> None:
    """Starts Warp without its banner (stdout is for results)."""
    wp.config.log_level = wp.LOG_WARNING
    _start()
    _room_to_compile(wp.config.kernel_cache_dir or "")


NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"
"""A line that Warp's library writes to the process' stderr on a machine without a GPU. Users of a CPU
need not read it."""


@lru_cache(maxsize=1)
def _start() -> None:
    """Starts Warp once; of what its library writes to stderr meanwhile, all but NO_DRIVER is passed
    on."""
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
            output = b"".join(line for line in kept if not line.startswith(NO_DRIVER))
            with suppress(OSError):
                os.write(2, output)


@lru_cache(maxsize=1)
def _room_to_compile(cache: str) -> None:
    """Refuse an empty kernel cache on a full disk at once: LLVM ends the whole process when it
    cannot write."""
    if not os.path.isdir(cache) or any(
        name.startswith("wp_r2h_batch") for name in os.listdir(cache)
    ):
        return
    _refuse_below(CACHE_BYTES, cache)


@cache
def _room_for(module: Any) -> None:
    """The same for one module that is not compiled yet, asked before its first launch: the disk may
    have filled since."""
    folder = wp.config.kernel_cache_dir or ""
    if not os.path.isdir(folder) or shutil.disk_usage(folder).free >= MODULE_BYTES:
        return
    known = [
        module.get_module_identifier(block_dim)
        for block_dim in (1, BLOCK_DIM, UNEVEN_BLOCK_DIM, None)
    ]
    if not any(os.path.isdir(os.path.join(folder, name)) for name in known):
        _refuse_below(MODULE_BYTES, folder)


def _refuse_below(needed: int, cache: str) -> None:
    free = shutil.disk_usage(cache).free
    if free < needed:
        why = f"{free >> 20} MB free for the kernel cache, {needed >> 20} are needed; set WARP_CACHE_PATH to another"
        raise OSError(errno.ENOSPC, why, cache)


def launch_trials(
    kernel: Any,
    n: int,
    *,
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    device: str,
    threads: int | None = None,
    chunk: int | None = None,
    width: int = 1,
    first: int = 0,
    uneven: bool = False,
) -> None:
    """Runs `kernel` for trials first..first+n-1.

    Every name and kind is checked against the kernel before anything runs (`r2h_batch.base.launch.arguments.bind`). Warp
    runs a CPU kernel as one serial loop but releases the interpreter lock, so threads over pieces use all cores. Who
    computes a trial does not change its result.

    Args:
        kernel: over trials, which are `wp.tid()` plus its parameter `first`.
        n: number of trials.
        inputs: by the kernel's parameter names without `_in`; tensors or NumPy arrays.
        outputs: the same, without `_out`; they are written in place.
        device: cpu or cuda:N, where all of them lie.
        threads: of a CPU; None: as `cpu_threads` says.
        chunk: trials of a piece that one CPU thread takes; None: trials cost alike.
        width: numbers of the kernel's second index; 1: it has none.
        first: the first trial.
        uneven: some trials take a hundred times as long as others.
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


def over_trials(
    kernel: Any,
    n: int,
    device: str,
    *,
    outputs: Mapping[str, Any] | None = None,
    sizes: Mapping[str, int | tuple[int, ...]] | None = None,
    **options: Any,
) -> Callable[..., Any]:
    """`launch_trials` with the inputs as keywords: `over_trials(kernel, n, device)(cap=cap_m, q=q)`.

    Not `wp.from_torch` and `wp.launch(inputs=, outputs=)`: with these the closing of one gripper takes two (descriptors
    alone) to four times as long, kernel included.

    Args:
        kernel: over trials.
        n: number of trials.
        device: where it runs.
        outputs: what it writes to, by name; what is left out is new memory (`new_outputs`), in a
            recorded call memory of the recording (`repeated.RepeatedCalls`).
        sizes: of new memory with further dimensions.
        options: of `launch_trials`.

    Returns:
        A function of the kernel's inputs that runs it and returns the outputs.
    """

    def run(**inputs: Any) -> Any:
        recording = repeated.current()
        if recording is not None and n == recording.rows and device == "cpu":
            _room_for(kernel.module)
            width = options.get("width", 1)
            return recording.launch(kernel, inputs, outputs or {}, sizes or {}, width)
        given = outputs or {}
        # torch's second thread would spin for milliseconds after it has filled large memory
        with one_torch_thread(device):
            made = {
                name: new(shape, dtype=dtype, device=device)
                for name, new, shape, dtype in written_shapes(kernel, n, sizes or {}, given)
            }
        made.update(given)
        launch_trials(kernel, n, inputs=inputs, outputs=made, device=device, **options)
        return made

    return run


def _launch_on_cpu(
    kernel: Any,
    n: int,
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    threads: int | None,
    chunk: int | None,
    width: int,
    first: int,
) -> None:
    """`launch_trials` on all cores, with what this thread packed for the kernel before
    (cached.py)."""
    cached.refuse_graph(kernel.key)
    repeated.refuse()
    packed = cached.taken(kernel)
    if packed is None or not packed.refill(inputs, outputs, first + n):
        args = [first, *bind(kernel, inputs, outputs, "cpu", trials=first + n)]
        if n == 0:
            return
        _room_for(kernel.module)
        packed = cached.pack(kernel, args, inputs, outputs)
    workers = max(1, min(cpu_threads(threads), -(-n // (chunk or CHUNK))))
    if packed is None:  # another Warp

        def plain(worker: int, start: int, rows: int) -> None:
            dim = (rows, width) if width > 1 else rows
            wp.launch(kernel, dim=dim, inputs=[start, *args[1:]], device="cpu")

        share(plain, first, n, workers, chunk)
        return
    if workers > 1:
        packed.prepare(workers)
        share(
            lambda worker, start, rows: packed.run(worker, start, rows, width),
            first,
            n,
            workers,
            chunk,
        )
    elif n:  # nothing to share
        packed.run(0, first, n, width)
    cached.kept(packed)


def load(kernels: Sequence[Any], device: str) -> None:
    """Compiles the kernels' modules for the device, or loads them, as `launch_trials` of uneven rows
    does at its first row. Those that a CPU lacks are compiled on all cores at once, in this order; a
    line says so.

    Args:
        kernels: each module is loaded once.
        device: cpu or cuda:N.
    """
    init_warp()
    modules = list({kernel.module.name: kernel.module for kernel in kernels}.values())
    for module in modules:
        _room_for(module)
    workers, cache = 0, wp.config.kernel_cache_dir or ""
    if device == "cpu":
        names = [module.get_module_identifier(1) for module in modules]
        missing = sum(not os.path.isdir(os.path.join(cache, name)) for name in names)
        workers = min(cpu_threads(), missing)
        if missing > 1:
            LOG.info(
                f"compiling {missing} files of kernels, {workers} at a time, once for this version and processor: up to a"
                " minute"
            )
    block_dim = 1 if device == "cpu" else UNEVEN_BLOCK_DIM
    if workers < 2:
        wp.force_load(device, modules=modules, block_dim=block_dim, max_workers=0)
        return
    with (
        progress("compiling", len(modules), "files of kernels") as told,
        ThreadPoolExecutor(workers) as pool,
    ):
        one = partial(wp.force_load, device, block_dim=block_dim, max_workers=0)
        for done in as_completed([pool.submit(one, modules=[module]) for module in modules]):
            done.result()
            told(1)


def launch(
    kernel: Any, dim: int, *, inputs: Mapping[str, Any], outputs: Mapping[str, Any], device: str
) -> None:
    """Runs a kernel that has no parameter `first` once, on Warp's own stream.

    Args:
        kernel: a Warp kernel.
        dim: number of threads.
        inputs: by the kernel's parameter names without `_in`; tensors or NumPy arrays.
        outputs: the same, without `_out`; they are written in place.
        device: cpu or cuda:N, where all of them lie.
    """
    repeated.refuse()
    _room_for(kernel.module)
    wp.launch(kernel, dim=dim, inputs=bind(kernel, inputs, outputs, device), device=device)


def _stream(device: str) -> wp.Stream:
    """Torch's stream: what torch wrote before is there, what it reads after has been written,
    the host does not wait.

    Given to the launch itself: ScopedStream would make it wait for Warp's own stream, which no
    graph can capture.
    """
    return wp.stream_from_torch(torch.cuda.current_stream(torch.device(device)))
