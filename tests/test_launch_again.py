"""A launch that is repeated: tensors that are like those of the call before, and loading before the first one."""

import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import pytest
import torch
import warp as wp

from r2h_batch.launch import cached, launch_trials, load, threads
from r2h_batch.launch.arguments import TensorLayoutGuard


def test_a_kernel_is_loaded_before_its_first_row():
    @wp.kernel(module="unique")
    def later(first: int, x_out: wp.array(dtype=float)):
        x_out[first + wp.tid()] = 1.0

    load(later, "cpu")
    assert (known := dict(later.module.execs))
    launch_trials(later, 3, inputs={}, outputs={"x": torch.zeros(3)}, device="cpu")
    assert later.module.execs == known


def test_loading_is_silent_where_it_is_what_starts_warp():
    first = "from r2h_batch.judge.plan import load_searches; load_searches('cpu')"
    process = subprocess.run([sys.executable, "-c", first], capture_output=True, text=True, timeout=300)
    assert (process.returncode, process.stdout) == (0, ""), process.stderr


def test_tensors_are_alike_by_class_type_shape_and_strides():
    x, y = torch.rand(3, 4), torch.rand(3, 4)
    like = TensorLayoutGuard((x, y, x))
    u, v = torch.rand(3, 4), torch.rand(3, 4)
    assert like((x, y, x)) and like((u, v, u)) and not like((u, v, v)) and not like((u, v, torch.rand(3, 4)))
    for other in (torch.rand(2, 4), torch.rand(3, 4).double(), torch.rand(4, 3).T, torch.rand(3, 4).requires_grad_()):
        assert not like((u, other, u))
        assert not like((u, torch.nn.Parameter(torch.rand(3, 4)), u))


@pytest.mark.parametrize("guards", [True, False])
def test_a_repeated_call_takes_tensors_that_are_given_twice_and_sees_them_change(monkeypatch, guards):
    if not guards:  # a torch without them
        monkeypatch.setattr("r2h_batch.launch.arguments.TENSOR_GUARDS", None)

    @wp.kernel(module="unique")
    def added(first: int, a_in: wp.array(dtype=float), b_in: wp.array(dtype=float), sum_out: wp.array(dtype=float)):
        i = first + wp.tid()
        sum_out[i] = a_in[i] + b_in[i]

    for n in (3, 3, 5, 5):
        x, y, out = torch.rand(n), torch.rand(n), torch.empty(n)
        for a, b in ((x, x), (x, y), (y, x), (y, y), (x, x)):
            launch_trials(added, n, inputs={"a": a, "b": b}, outputs={"sum": out}, device="cpu")
            assert torch.equal(out, a + b)
    wrong = torch.rand(5, dtype=torch.float64)
    for a, b in ((wrong, wrong), (x, wrong), (wrong, x)):
        with pytest.raises(TypeError, match=r"is a tensor of float64 with shape \(5,\)"):
            launch_trials(added, 5, inputs={"a": a, "b": b}, outputs={"sum": out}, device="cpu")
    with pytest.raises(ValueError, match="has 5 rows; 6 trials write 6 or more"):
        launch_trials(added, 6, inputs={"a": torch.rand(6), "b": torch.rand(6)}, outputs={"sum": out}, device="cpu")


def test_a_warp_without_the_privates_that_are_read_launches_plainly(monkeypatch):
    @wp.kernel(module="unique")
    def numbered(first: int, x_in: wp.array(dtype=float), y_out: wp.array2d(dtype=float)):
        i, k = wp.tid()
        y_out[first + i, k] = x_in[first + i] + float(k)

    x = torch.rand(100)
    for privates in (("a name that no Warp has",), cached.PRIVATES):
        monkeypatch.setattr(cached, "PRIVATES", privates)
        for chunk, workers in ((32, 2), (200, 1)):
            out = torch.zeros(100, 3)
            launch_trials(
                numbered, 90, inputs={"x": x}, outputs={"y": out}, device="cpu", width=3, first=10, chunk=chunk,
                threads=workers,
            )  # fmt: skip
            expected = torch.where(torch.arange(100)[:, None] >= 10, x[:, None] + torch.arange(3), 0.0)
            assert torch.equal(out, expected)


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
        threads.share(run, 0, 100, 3, 1)
    assert at_work == []
    begun = len(chunks)
    time.sleep(0.2)
    assert len(chunks) == begun <= 4


def test_a_program_that_is_going_down_works_on_the_calling_thread():
    """No pool takes work then: what is scored at exit is scored all the same."""
    pool, done = ThreadPoolExecutor(2), []
    pool.shutdown()
    with mock.patch.object(threads, "thread_pool", lambda _: pool):
        threads.share(lambda worker, start, rows: done.append((worker, start, rows)), 3, 10, 3, 4)
    assert done == [(0, 3, 4), (0, 7, 4), (0, 11, 2)]
