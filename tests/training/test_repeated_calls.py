"""A size that comes back is scored by what was recorded of it: the same bits, in memory that nobody writes again."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from unittest import mock

import pytest
import torch
from problems import Batch, assert_same, default_evaluator, make_batch
from torch.utils._python_dispatch import TorchDispatchMode

from r2h_batch import launch
from r2h_batch.config import EvalConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.launch.recorded import Recorded
from r2h_batch.training import repeated_calls
from r2h_batch.types import Scores

N = 96
FILL = ("aten.full", "aten.full_like", "aten.zeros", "aten.zeros_like")
VIEW = ("aten.unbind", "aten.view", "aten.select", "aten.detach")


def ready() -> Evaluator:
    """An evaluator that keeps nothing yet."""
    return copy.copy(default_evaluator())


def batches(n: int, how_many: int) -> list[Batch]:
    """Different trials, the same number of them: sensible, random, moved, turned over, and rows that are no poses."""
    whole = make_batch(default_evaluator().scene, n * how_many, random_share=0.4)
    g = torch.Generator().manual_seed(1)
    whole.T_obj_ee[::5, :3, 3] += 0.02 * torch.randn((len(whole.T_obj_ee[::5]), 3), generator=g)
    found = [whole.rows(slice(i * n, i * n + n)) for i in range(how_many)]
    found[1].T_world_ee[: n // 2] = torch.nan  # what those rows held before must not be seen in them
    found[2].T_obj_ee[n // 2 :, 3, 3] = 2.0
    found[3].T_world_ee[:, :3, 3] += 2.0  # out of reach
    return found


def score(evaluator: Evaluator, b: Batch) -> Scores:
    return evaluator.score(b.T_obj_ee, b.T_world_ee, b.trials, "pose")


def signed_late(x: torch.Tensor) -> torch.Tensor:
    """The same numbers, whose memory holds the opposite ones: torch keeps the sign for later."""
    late = torch.complex(torch.zeros_like(x), -x).conj().imag
    assert late.is_neg() and torch.equal(late, x)
    return late


def recorded_sizes(evaluator: Evaluator) -> list[int]:
    return [kept.asked.rows for kept in evaluator._repeated._kept]


@pytest.mark.parametrize(("n", "threads"), [(1, None), (7, 1), (40, 1), (40, 3), (N, None), (300, 2)])
def test_a_recorded_call_gives_the_same_bits_as_one_that_is_not(n, threads):
    evaluator = ready()
    evaluator.threads = threads
    rounds = batches(n, 5)
    expected = [score(ready(), b) for b in rounds]  # the first call of a size is never a recorded one
    found = [score(evaluator, b) for b in (rounds[0], *rounds)][1:]
    assert recorded_sizes(evaluator) == [n]
    for one, other in zip(found, expected, strict=True):  # compared at last: no call has written into one before
        assert_same(one, other)
    if n == N:
        assert len(torch.unique(torch.cat([s.outcome for s in found]))) > 3


def test_what_is_recorded_is_launches_and_memory_and_nothing_else():
    """No operation of torch would be done again: it may ask for memory, and fill what no kernel writes."""
    operations: list[str] = []
    filled: list[torch.Tensor] = []
    written: set[int] = set()

    class Watched(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            out = function(*args, **(kwargs or {}))
            name = str(function.overloadpacket)
            operations.append(name)
            if name in FILL:
                filled.append(out)
            return out

    honest = Recorded.add

    def add(recorded, packed, first, n, width, kept):
        written.update(x.untyped_storage().data_ptr() for x in kept[1].values() if isinstance(x, torch.Tensor))
        return honest(recorded, packed, first, n, width, kept)

    evaluator, b = ready(), batches(N, 4)[0]
    with Watched(), mock.patch.object(Recorded, "add", add):
        t = b.trials
        given = [b.T_obj_ee, b.T_world_ee, t.T_world_hand, t.trial_id, t.object_index, t.hand_index]
        asked = repeated_calls._Asked(evaluator.scene, evaluator.config, N)
        repeated_calls._recorded(evaluator._judge_pose, asked, given)
    copies, rest = operations[: len(given)], set(operations[len(given) :])
    assert copies == ["aten.clone"] * len(given)  # of the inputs
    assert rest <= {"aten.empty", "aten.empty_like", *FILL, *VIEW}, rest
    assert filled and len(written) > 20
    assert not written & {x.untyped_storage().data_ptr() for x in filled}


def test_a_size_is_recorded_when_it_comes_back_and_the_oldest_make_room():
    evaluator = ready()
    whole = batches(N, 4)[0]

    def of(n: int) -> None:
        score(evaluator, whole.rows(slice(0, n)))

    for n in (3, 4, 3, 4):
        of(n)
    assert recorded_sizes(evaluator) == []
    of(4)
    of(3), of(3)
    assert recorded_sizes(evaluator) == [4, 3]
    of(4), of(4)
    assert recorded_sizes(evaluator) == [3, 4]
    with mock.patch.object(repeated_calls, "KEPT_ROWS", 20), mock.patch.object(repeated_calls, "ROWS", 16):
        of(16), of(16)
        assert recorded_sizes(evaluator) == [4, 16]
        of(17), of(17), of(0), of(0)
        assert recorded_sizes(evaluator) == [4, 16]
    assert recorded_sizes(copy.copy(evaluator)) == [] and recorded_sizes(copy.deepcopy(evaluator)) == []


@pytest.mark.parametrize(("calls", "kept"), [(1, 0), (2, 4)])
def test_configurations_that_change_with_every_call_are_not_recorded_and_others_make_room(calls, kept):
    evaluator, b = ready(), batches(1, 4)[0]
    limits = evaluator.config.thresholds
    for i in range(6):
        changed = replace(limits, reach_radius_m=0.05 + 0.01 * i)
        evaluator.config = replace(evaluator.config, thresholds=changed)
        with mock.patch.object(repeated_calls, "KEPT_CALLS", 4):
            for _ in range(calls):
                score(evaluator, b)
    assert recorded_sizes(evaluator) == [1] * kept


@pytest.mark.parametrize("garbage", [torch.nan, 1e30, 0.0])
def test_nothing_of_the_call_before_is_seen(garbage):
    """Whatever the launches wrote is made garbage; what the next call does not write itself would come back as that."""
    evaluator, rounds = ready(), batches(N, 5)
    expected = [score(ready(), b) for b in rounds]
    score(evaluator, rounds[0]), score(evaluator, rounds[0])
    for b, same in zip(rounds, expected, strict=True):
        (kept,) = evaluator._repeated._kept
        for _, outputs in kept.posed._kept[:-1]:  # of each launch; the last one is inputs
            written = {name: x for name, x in outputs.items() if name != "slip_m"}  # which `verdict` adds: a constant
            for x in written.values():
                x.fill_(garbage if x.is_floating_point() else 127)
        assert_same(score(evaluator, b), same)


@pytest.mark.parametrize("rows", [5, N])
def test_a_call_from_within_a_recording_is_its_own(rows):
    """As a signal's handler or a finaliser makes it: not refused for its size, and nothing that is run or written again."""
    evaluator, (b, other, *_) = ready(), batches(N, 4)
    inner = Batch(other.trials, other.T_obj_ee.clone(), other.T_world_ee.clone()).rows(slice(0, rows))
    expected, expected_inner = score(ready(), b), score(ready(), inner)
    found: list[Scores] = []
    honest = Recorded.add

    def add(recorded, *args):
        honest(recorded, *args)
        if not found:
            found.append(score(ready(), inner))

    score(evaluator, b)
    with mock.patch.object(Recorded, "add", add):
        assert_same(score(evaluator, b), expected)
    inner.T_world_ee.fill_(torch.nan)
    assert_same(score(evaluator, b), expected)
    assert_same(found[0], expected_inner)


def test_another_configuration_is_another_call():
    evaluator, b = ready(), batches(N, 4)[0]
    for _ in range(3):
        plain = score(evaluator, b)
    config = evaluator.config
    evaluator.config = replace(config, thresholds=replace(config.thresholds, reach_radius_m=0.02))
    tight = score(evaluator, b)
    assert_same(score(evaluator, b), tight)
    assert recorded_sizes(evaluator) == [N, N] and int(tight.passed[:, 2].sum()) < int(plain.passed[:, 2].sum())
    evaluator.config = config
    assert_same(score(evaluator, b), plain)


def test_a_configuration_that_changes_during_a_recording_is_not_what_is_recorded():
    evaluator, b = ready(), batches(N, 4)[0]
    config, expected = evaluator.config, score(ready(), b)
    other = replace(config, thresholds=replace(config.thresholds, reach_radius_m=0.02, w_max_m=0.03))
    honest = Recorded.add

    def add(recorded, *args):
        evaluator.config = other
        honest(recorded, *args)

    score(evaluator, b)
    with mock.patch.object(Recorded, "add", add):
        assert_same(score(evaluator, b), expected)
    evaluator.config = config
    for _ in range(2):
        assert_same(score(evaluator, b), expected)


@pytest.mark.parametrize(
    "changed",
    [
        {"stability": "physics"},
        {"ik": {"solver": "pytorch-kinematics"}},
        {"plan": {"goals": "one"}},
        {"plan": {"hand": "estimated"}},
    ],
)
def test_what_is_more_than_launches_is_not_recorded(changed):
    config = EvalConfig()
    for name, value in changed.items():
        new = replace(getattr(config, name), **value) if isinstance(value, dict) else value
        config = replace(config, **{name: new})
    evaluator, b = ready(), batches(4, 4)[0]
    evaluator.config = config
    first = score(evaluator, b)
    assert_same(score(evaluator, b), first)
    assert recorded_sizes(evaluator) == []


def test_tensors_of_any_kind_that_the_plain_call_takes():
    """Strided ones, one tensor for two arguments, in inference mode, without gradients, each after each."""
    evaluator, b = ready(), batches(N, 4)[0]
    wide = torch.zeros(N, 4, 8)
    wide[:, :, ::2] = b.T_obj_ee
    expected, twice = score(ready(), b), Batch(b.trials, b.T_obj_ee, b.T_obj_ee)
    expected_twice = score(ready(), twice)
    for _ in range(2):
        for mode in (torch.inference_mode, torch.no_grad, torch.enable_grad):
            with mode():
                assert_same(score(evaluator, b), expected)
                assert_same(score(evaluator, Batch(b.trials, wide[:, :, ::2], b.T_world_ee)), expected)
                assert_same(score(evaluator, twice), expected_twice)
    assert recorded_sizes(evaluator) == [N]
    late = Batch(
        replace(b.trials, T_world_hand=signed_late(b.trials.T_world_hand)), signed_late(b.T_obj_ee), b.T_world_ee
    )
    for evaluator_ in (evaluator, ready()):
        assert_same(score(evaluator_, late), expected)
    T = b.T_obj_ee.clone().requires_grad_()
    margin = score(evaluator, Batch(b.trials, T, b.T_world_ee)).margin
    assert margin.requires_grad and torch.equal(margin.detach().nan_to_num(7.0), expected.margin.nan_to_num(7.0))


def test_threads_of_a_program_that_share_an_evaluator():
    evaluator, rounds = ready(), batches(N, 4)
    expected = [score(ready(), b) for b in rounds]

    def many(i: int) -> None:
        for _ in range(30):
            assert_same(score(evaluator, rounds[i]), expected[i])

    with ThreadPoolExecutor(4) as pool:
        for done in [pool.submit(many, i) for i in range(4)]:
            done.result()
    assert set(recorded_sizes(evaluator)) == {N} and len(recorded_sizes(evaluator)) <= 4


def test_after_an_interrupt_the_memory_is_another():
    evaluator, b = ready(), batches(N, 4)[0]
    expected = [score(evaluator, b) for _ in range(3)][-1]
    (before,) = evaluator._repeated._kept
    honest, calls = launch.repeated.Repeated.run, []

    def run(packed, *args):
        calls.append(packed)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return honest(packed, *args)

    with mock.patch.object(launch.repeated.Repeated, "run", run), pytest.raises(KeyboardInterrupt):
        score(evaluator, b)
    assert recorded_sizes(evaluator) == []
    assert_same(score(evaluator, b), expected)
    (after,) = evaluator._repeated._kept
    assert after is not before
