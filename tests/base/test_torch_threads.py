"""Torch's threads: one while a call of ours works on a CPU, as many as before after it, in every thread of a program."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from problems import default_evaluator, make_batch
from torch.overrides import TorchFunctionMode

from r2h_batch.base import launch
from r2h_batch.base.launch.threads import on_threads, one_torch_thread
from r2h_batch.judge.ik import solve_ik


@pytest.fixture(autouse=True)
def two_threads():
    """A program whose torch works on two threads, whatever this machine has."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def batch(scene):
    return make_batch(scene, 24)


@pytest.fixture
def seen(monkeypatch) -> set[int]:
    """How many threads torch had at each launch of the stages."""
    found: set[int] = set()
    plain = launch.launch_trials

    def watched(*args, **kwargs):
        found.add(torch.get_num_threads())
        plain(*args, **kwargs)

    monkeypatch.setattr(launch, "launch_trials", watched)
    return found


def score(batch, stages="pose"):
    return default_evaluator().score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages)


def with_gradients(batch):
    T = batch.T_world_ee.clone().requires_grad_()
    scores = default_evaluator().score(batch.T_obj_ee, T, batch.trials, "pose")
    scores.margin[scores.evaluated].sum().backward()


CALLS = {"everything": lambda batch: score(batch, "all"), "gradients": with_gradients}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_a_call_works_on_one_thread_and_leaves_two(batch, seen, call):
    call(batch)
    assert seen == {1} and torch.get_num_threads() == 2


def test_a_stage_called_alone_fills_its_memory_on_one_thread():
    """After 1 MB of zeros torch's second thread spins for milliseconds: 4,096 rows of IK took 1.6 times the process time."""
    threads = []

    class Zeros(TorchFunctionMode):
        def __torch_function__(self, func, types, args=(), kwargs=None):
            if func is torch.zeros:
                threads.append(torch.get_num_threads())
            return func(*args, **(kwargs or {}))

    with Zeros():
        solve_ik(torch.eye(4).repeat(3, 1, 1))
    assert set(threads) == {1} and torch.get_num_threads() == 2


def test_a_thread_that_begins_during_a_call_has_the_programs_number():
    """torch.set_num_threads(1) would be what it starts with, and keeps: others of the program worked on one core then."""
    with one_torch_thread("cpu"), ThreadPoolExecutor(1) as other:
        assert torch.get_num_threads() == 1
        assert other.submit(torch.get_num_threads).result() == 2


@pytest.mark.parametrize(("asked", "torch_has"), [(1, 1), (2, 2), (None, 2)])
def test_one_worker_is_one_thread_of_torch_too(asked, torch_has):
    """Two sweeps with `--threads 1` on two cores: torch's threads of both spun, and one with networks took twice its time."""
    with on_threads(asked):
        assert torch.get_num_threads() == torch_has
    assert torch.get_num_threads() == 2
