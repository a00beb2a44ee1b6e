"""Launches that were recorded: run again with other inputs, on any number of threads, and refused where they cannot be."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import pytest
import torch
import warp as wp

from r2h_batch.launch import launch_trials, workers
from r2h_batch.launch.recorded import CHUNK, Recorded, current


@wp.kernel(module="unique")
def scaled(first: int, factor: float, x_in: wp.array(dtype=float), y_out: wp.array(dtype=float)):
    i = first + wp.tid()
    y_out[i] = factor * x_in[i]


@wp.kernel(module="unique")
def spread(first: int, x_in: wp.array(dtype=float), y_in: wp.array(dtype=float), z_out: wp.array2d(dtype=float)):
    i, k = wp.tid()
    z_out[first + i, k] = x_in[first + i] + float(k) * y_in[first + i]


def chain(x: torch.Tensor, y: torch.Tensor, rows: int | None = None, first: int = 0) -> torch.Tensor:
    """(n, 3): 6 x + k y, by three launches."""
    n = len(x) if rows is None else rows
    a, b, out = torch.empty_like(x), torch.empty_like(x), torch.empty(len(x), 3)
    for factor, given, made in ((2.0, x, a), (3.0, a, b)):
        outputs = {"y": made}
        launch_trials(scaled, n, inputs={"factor": factor, "x": given}, outputs=outputs, device="cpu", first=first)
    launch_trials(spread, n, inputs={"x": b, "y": y}, outputs={"z": out}, device="cpu", width=3, first=first)
    return out


@pytest.mark.parametrize("n", [1, CHUNK, CHUNK + 1, 1000])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_a_recorded_function_takes_other_inputs(n, threads):
    x, y = torch.rand(n), torch.rand(n)
    recorded = Recorded(chain, (x, y), n)
    assert torch.equal(recorded.result, chain(x, y)) and current() is None
    for _ in range(3):
        x, y = torch.rand(n), torch.rand(n)
        for a, b in ((x, y), (y, x), (x, x)):
            assert torch.equal(recorded(a, b, threads=threads), chain(a, b))
            assert torch.equal(recorded(a, b), chain(a, b))


def test_two_inputs_in_one_place_are_told_apart():
    x, y = torch.rand(50), torch.rand(50)
    recorded = Recorded(chain, (x, x), 50)
    assert torch.equal(recorded(x, y), chain(x, y))


def test_plain_launches_between_are_not_disturbed():
    x, y = torch.rand(50), torch.rand(50)
    recorded = Recorded(chain, (x, y), 50)
    other = chain(y, x)
    assert torch.equal(recorded(x, y), chain(x, y)) and torch.equal(other, chain(y, x))


@pytest.mark.parametrize(("rows", "first"), [(49, 0), (49, 1)])
def test_launches_over_other_rows_are_refused_by_name(rows, first):
    x = torch.rand(50)
    with pytest.raises(
        ValueError, match=rf"kernel scaled ran over trials {first} to {first + 48} of a recorded call of 50"
    ):
        Recorded(lambda x, y: chain(x, y, rows, first), (x, x), 50)
    assert current() is None
    assert torch.equal(chain(x, x), chain(x, x.clone()))


def test_a_graph_that_warp_records_would_miss_it():
    x = torch.rand(50)
    recorded = Recorded(chain, (x, x), 50)
    wp.capture_begin(device="cpu")
    try:
        with pytest.raises(RuntimeError, match="a recorded call would be missing"):
            recorded(x, x)
    finally:
        wp.capture_end(device="cpu")


def test_nobody_is_at_work_once_an_interrupt_has_left_the_call():
    """The caller frees its memory then: who still wrote there would end the process."""
    started, at_work, chunks = threading.Event(), [], []

    def run(worker: int, start: int, rows: int) -> None:
        if worker == 0:
            assert started.wait(10)
            raise KeyboardInterrupt
        at_work.append(start), chunks.append(start)
        started.set()
        time.sleep(0.1)
        at_work.remove(start)

    with pytest.raises(KeyboardInterrupt):
        workers.share(run, 0, 100, 3, 1)
    assert at_work == []
    begun = len(chunks)
    time.sleep(0.2)
    assert len(chunks) == begun <= 4


def test_a_program_that_is_going_down_works_on_the_calling_thread():
    """No pool takes work then: what is scored at exit is scored all the same."""
    pool, done = ThreadPoolExecutor(2), []
    pool.shutdown()
    with mock.patch.object(workers, "thread_pool", lambda _: pool):
        workers.share(lambda worker, start, rows: done.append((worker, start, rows)), 3, 10, 3, 4)
    assert done == [(0, 3, 4), (0, 7, 4), (0, 11, 2)]
