"""Inside other people's programs: forks, loaders' workers, copies, pickles, other defaults of torch, wrong arguments."""

import concurrent.futures.thread
import copy
import multiprocessing
import pickle
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from other_defaults import everything
from problems import assert_same, default_evaluator, make_batch
from rounds import each
from torch._subclasses.fake_tensor import FakeTensorMode

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.judge.calls.torch_op import score_op
from r2h_batch.scene.objects import load_objects

ROWS = 64
WAIT_S = 300
DEFAULTS = Path(__file__).parent / "support" / "other_defaults.py"


# --- processes -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def evaluator() -> Evaluator:
    """Two threads, however many cores there are: one thread needs no pool, and no pool can hang."""
    return Evaluator(load_benchmark("r2h-v1"), threads=2)


@pytest.fixture(scope="module")
def batch(evaluator):
    return make_batch(evaluator.scene, ROWS)


def outcomes(evaluator, batch, stages="all") -> np.ndarray:
    return evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages).margin.numpy()


def answer(queue, evaluator, batch) -> None:
    """Output of a child process: its margins, and that torch itself uses threads there."""
    large = float(torch.ones(1 << 20, dtype=torch.float32).exp().sum())
    queue.put((outcomes(evaluator, batch), large))


@pytest.mark.parametrize("way", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_a_child_process_scores_after_its_parent_has(evaluator, batch, way):
    here = outcomes(evaluator, batch)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    torch.ones(1 << 20, dtype=torch.float32).exp().sum()  # starts torch's own threads, which a fork leaves behind too
    context = multiprocessing.get_context(way)
    queue = context.Queue()
    child = context.Process(target=answer, args=(queue, evaluator, batch), daemon=True)
    child.start()
    try:
        margin, large = queue.get(timeout=WAIT_S)
        child.join(WAIT_S)
    finally:
        child.kill()
        torch.set_num_threads(threads)
    assert child.exitcode == 0 and large > 1 << 20
    assert margin.tobytes() == here.tobytes()


def test_a_handler_that_interrupts_a_call_at_its_pool_and_scores_gets_the_same_rows(evaluator, batch):
    """The interrupted thread holds locks of the pool, which a handler of its own would wait for without end."""
    here, inside = outcomes(evaluator, batch, "pose"), []
    for _ in range(3):  # the first calls of a size are recorded, by one thread; later ones use the pool
        outcomes(evaluator, batch, "pose")

    def handler(number, frame):
        if number == signal.SIGALRM:
            raise TimeoutError("the handler waits for its own thread")
        inside.append(outcomes(evaluator, batch, "pose"))

    def at_the_pool(frame, event, _):
        if event == "call" and frame.f_code.co_filename == concurrent.futures.thread.__file__ and len(inside) < 20:
            signal.raise_signal(signal.SIGUSR1)

    before = {s: signal.signal(s, handler) for s in (signal.SIGUSR1, signal.SIGALRM)}
    signal.alarm(60)
    sys.setprofile(at_the_pool)
    try:
        rows = outcomes(evaluator, batch, "pose")
    finally:
        sys.setprofile(None)
        signal.alarm(0)
        for number, old in before.items():
            signal.signal(number, old)
    assert inside and all(x.tobytes() == here.tobytes() for x in [rows, *inside])
    outcomes(evaluator, batch, "pose")  # the pool takes part again


# --- copies --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_a_copied_evaluator_gives_the_same_rows(batch, how):
    mine = load_objects(["cup", "hammer"])
    first = Evaluator(
        load_benchmark("r2h-v1").with_objects(mine), replace(default_evaluator().config, width="whole"), threads=1
    )
    few = make_batch(first.scene, 8)
    second = how(first)
    assert (second.config, second.threads, second.scene.device) == (first.config, 1, "cpu")
    assert second.scene.objects == mine  # built-in objects go by name and are the very same
    arguments = few.T_obj_ee, few.T_world_ee, few.trials
    assert_same(second.score(*arguments, "pose"), first.score(*arguments, "pose"))
    assert_same(second.kinematic.score(*arguments), first.kinematic.score(*arguments))
    # the operator of torch.compile finds each by itself
    t = few.trials
    rows = t.trial_id, t.object_index, t.hand_index, t.T_world_hand, t.receiver
    assert second.handle != first.handle
    assert len(score_op(few.T_obj_ee, few.T_world_ee, *rows, second.handle, "pose"))


# --- other defaults of torch ---------------------------------------------------------------------------------------


def differing(other) -> list[str]:
    plain = everything()
    assert plain.keys() == other.keys() and len(plain) > 80
    return [k for k in plain if (plain[k].dtype, plain[k].tobytes()) != (other[k].dtype, other[k].tobytes())]


def test_defaults_of_the_callers_program_change_no_bit():
    """Trials, all methods, scores, gradients, rewards; `meta` fails whatever lands there."""
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    try:
        other = everything()
    finally:
        torch.set_default_dtype(dtype)
        torch.set_default_device(None)
    assert differing(other) == []


@pytest.mark.slow
def test_defaults_that_were_set_before_the_first_import_change_no_bit(tmp_path):
    line = [sys.executable, str(DEFAULTS), "bfloat16", "meta", str(tmp_path / "out.npz")]
    subprocess.run(line, timeout=900, check=True)
    with np.load(tmp_path / "out.npz") as data:
        assert differing(dict(data)) == []


# --- arguments -----------------------------------------------------------------------------------------------------


def test_torch_func_and_sparse_poses_are_refused_by_name():
    batch = make_batch(default_evaluator().scene, 4)

    def margin(T_obj_ee):
        return default_evaluator().score(T_obj_ee, batch.T_world_ee, batch.trials, "pose").margin

    margin(batch.T_obj_ee)  # what is refused must not pass for inputs that are known to be right
    for transform in (torch.func.vmap, torch.func.jacrev):
        with pytest.raises(TypeError, match=r"T_obj_ee is inside torch\.func .*give all rows in one call"):
            transform(margin)(batch.T_obj_ee[None])
    with pytest.raises(TypeError, match=r"T_obj_ee is a tensor of layout sparse_coo; .* call \.to_dense"):
        margin(batch.T_obj_ee.to_sparse())
    with pytest.raises(TypeError, match="T_obj_ee is a tensor of layout nested"):
        margin(torch.nested.nested_tensor(list(batch.T_obj_ee)))


def without_memory(kind, T):
    if kind == "fake":
        with FakeTensorMode():
            return torch.zeros(T.shape)
    T = T.clone()
    T.untyped_storage().resize_(0)
    return T


@pytest.mark.filterwarnings("ignore:Accessing the data pointer of FakeTensor")
@pytest.mark.parametrize("kind", ["fake", "freed"])
def test_poses_without_memory_are_refused_by_name(kind):
    batch = make_batch(default_evaluator().scene, 4)
    gone = without_memory(kind, batch.T_world_ee)
    with pytest.raises(TypeError, match="T_world_ee has no memory for its numbers"):
        default_evaluator().score(batch.T_obj_ee, gone, batch.trials, "pose")
    trials = replace(batch.trials, T_world_hand=gone)
    with pytest.raises(TypeError, match=r"trials\.T_world_hand has no memory for its numbers"):
        default_evaluator().score(batch.T_obj_ee, batch.T_world_ee, trials, "pose")


def test_a_negative_bit_is_part_of_the_number():
    batch = make_batch(default_evaluator().scene, 8)
    plain = default_evaluator().score(batch.T_obj_ee, batch.T_world_ee, batch.trials, "pose")
    T_obj_ee, T_world_ee, T_world_hand, trial_id = (
        torch._neg_view(-x)
        for x in (batch.T_obj_ee, batch.T_world_ee, batch.trials.T_world_hand, batch.trials.trial_id)
    )
    trials = replace(batch.trials, T_world_hand=T_world_hand, trial_id=trial_id)
    scores = default_evaluator().score(T_obj_ee, T_world_ee, trials, "pose")
    assert T_obj_ee.is_neg() and trials.trial_id.is_neg()
    assert_same(scores, plain)


def test_an_optimizers_step_in_place_does_not_change_what_scores_were_asked_about(evaluator, batch):
    grasp, handover = batch.T_obj_ee.clone().requires_grad_(), batch.T_world_ee.clone()
    scores = evaluator.score(grasp, handover, batch.trials, stages="pose")
    with torch.no_grad():
        grasp.add_(1.0)
        handover.zero_()
    assert torch.equal(scores.inputs.T_obj_ee, batch.T_obj_ee)
    assert torch.equal(scores.inputs.T_world_ee, batch.T_world_ee)


def test_second_derivatives_raise():
    batch = make_batch(default_evaluator().scene, 12)
    moving = batch.T_obj_ee.clone().requires_grad_(), batch.T_world_ee.clone().requires_grad_()

    def total() -> torch.Tensor:
        return default_evaluator().score(*moving, batch.trials, "pose").margin.nan_to_num().sum()

    first = torch.autograd.grad(total(), moving, create_graph=True)
    plain = torch.autograd.grad(total(), moving)
    for a, b in each(zip(first, plain, strict=True)):
        assert b.any() and torch.equal(a, b)
        with pytest.raises(RuntimeError, match="first derivatives only"):
            torch.autograd.grad(a.square().sum(), moving, retain_graph=True, allow_unused=True)
