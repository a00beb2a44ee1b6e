"""Scoring inside torch programs: compiled, captured, without gradients; on CUDA without a word from the host."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from problems import assert_same, default_evaluator, make_batch

from r2h_batch import load_benchmark, reward
from r2h_batch.base.registry import DEFAULT_BENCHMARK
from r2h_batch.config import CLEARANCE_CAP_M, EvalConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.calls import torch_op
from r2h_batch.judge.calls.capture import check_capture
from r2h_batch.methods import oracle, random
from r2h_batch.types import Outcome, Predictions, Scores, Trials

B = 24


@pytest.fixture(scope="module")
def batch():
    return make_batch(default_evaluator().scene, B, random_share=0.4)


@pytest.mark.parametrize("stages", ["pose", "all"])
def test_the_operator_is_correct_and_its_shapes_are_what_it_returns(batch, stages):
    t = batch.trials
    rows = (t.trial_id, t.object_index, t.hand_index, t.T_world_hand, t.receiver)
    arguments = (batch.T_obj_ee, batch.T_world_ee, *rows)
    handle = default_evaluator().kinematic.handle
    checks = "test_schema", "test_faketensor", "test_autograd_registration"
    torch.library.opcheck(torch_op.score_op, (*arguments, handle, stages), test_utils=checks)
    direct = default_evaluator().kinematic.score(batch.T_obj_ee, batch.T_world_ee, t, stages)
    assert_same(torch_op.call(handle, batch.T_obj_ee, batch.T_world_ee, t, stages), direct)


def test_a_compiled_training_step_scores_as_the_plain_one_in_one_graph(batch):
    evaluator = default_evaluator()

    def step(T_obj_ee: torch.Tensor, T_world_ee: torch.Tensor, trials: Trials) -> tuple[torch.Tensor, torch.Tensor]:
        scores = evaluator.score(T_obj_ee, T_world_ee, trials, stages="pose")
        return reward.margin_vector(scores) * 2.0, scores.success

    compiled = torch.compile(step, backend="aot_eager", fullgraph=True)
    T_obj_ee = batch.T_obj_ee.clone().requires_grad_()
    for given in (batch.T_obj_ee, T_obj_ee):
        margin, success = compiled(given, batch.T_world_ee, batch.trials)
        expected = step(batch.T_obj_ee, batch.T_world_ee, batch.trials)
        assert torch.equal(margin, expected[0]) and torch.equal(success, expected[1])
    plain = T_obj_ee.detach().clone().requires_grad_()
    (wanted,) = torch.autograd.grad(step(plain, batch.T_world_ee, batch.trials)[0].sum(), plain)
    (given,) = torch.autograd.grad(margin.sum(), T_obj_ee)
    assert wanted.any() and torch.equal(given, wanted)
    with torch.inference_mode():
        assert torch.equal(step(batch.T_obj_ee.clone(), batch.T_world_ee, batch.trials)[0], expected[0])
    with torch.no_grad():
        assert torch.equal(compiled(batch.T_obj_ee, batch.T_world_ee, batch.trials)[0], expected[0])


def test_wrong_inputs_of_a_compiled_call_are_refused(batch):
    evaluator = default_evaluator()
    compiled = torch.compile(lambda g, h, t: evaluator.score(g, h, t, "pose").success, backend="eager")
    with pytest.raises(Exception, match="object_index"):
        compiled(batch.T_obj_ee, batch.T_world_ee, replace(batch.trials, object_index=batch.trials.object_index + 99))


@pytest.mark.parametrize("stages", ["pose", "all"])
def test_candidates_per_trial_are_rows_in_order(batch, stages):
    n, k = B // 4, 4
    evaluator = default_evaluator().kinematic
    g, h = batch.T_obj_ee.view(n, k, 4, 4), batch.T_world_ee.view(n, k, 4, 4)
    trials = batch.trials[torch.arange(n)]
    rows = torch.arange(n).repeat_interleave(k)
    s = evaluator.score(g, h, trials, stages)
    assert_same(s, evaluator.score(batch.T_obj_ee, batch.T_world_ee, trials[rows], stages))
    assert s.by_trial(k).trial_id.eq(trials.trial_id[:, None]).all()
    assert len(evaluator.score(g[:, :0], h[:, :0], trials, stages)) == 0
    assert_same(evaluator.score(g.transpose(0, 1).contiguous().transpose(0, 1), h, trials, stages), s)


def test_a_captured_call_repeats_the_plain_one_in_the_same_memory(batch):
    evaluator = default_evaluator()
    captured = evaluator.capture(B)
    first = captured(batch.T_obj_ee, batch.T_world_ee, batch.trials)
    assert_same(first, evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials, "pose"))
    before = {f.name: getattr(first, f.name).data_ptr() for f in fields(Scores)}
    order = torch.arange(B).flip(0)
    T_obj_ee = batch.T_obj_ee[order].clone()
    T_obj_ee[3] = torch.nan
    second = captured(T_obj_ee, batch.T_world_ee[order], batch.trials[order])
    assert_same(second, evaluator.score(T_obj_ee, batch.T_world_ee[order], batch.trials[order], "pose"))
    assert int(second.outcome[3]) == Outcome.INVALID_INPUT
    assert {f.name: getattr(second, f.name).data_ptr() for f in fields(Scores)} == before
    captured.T_obj_ee.copy_(batch.T_obj_ee[order])  # a generator may write there itself
    assert_same(
        captured(), evaluator.score(batch.T_obj_ee[order], batch.T_world_ee[order], batch.trials[order], "pose")
    )
    with pytest.raises(ValueError, match=r"T_obj_ee is torch.float32 \(23, 4, 4\)"):
        captured(batch.T_obj_ee[1:])
    with pytest.raises(ValueError, match="b is 0"):
        evaluator.capture(0)


@pytest.fixture(
    scope="module", params=[DEFAULT_BENCHMARK, pytest.param("r2h-v3", marks=pytest.mark.whole(part="judge"))]
)
def before_people(request):
    """Poses on benchmarks whose receivers have arm and torso; r2h-v3 also asks for Pick and Received."""
    benchmark = load_benchmark(request.param)
    evaluator, trials = Evaluator(benchmark), benchmark.trials(B)[:B]
    known = benchmark.certificates(trials.trial_id.numpy())
    if known.known.all():  # nothing is searched that a file has
        poses = Predictions(
            trials.trial_id, *(torch.from_numpy(np.array(x)) for x in (known.T_obj_ee, known.T_world_ee))
        )
    else:
        poses = oracle.predict(trials, evaluator.scene)
    some = torch.arange(B) % 3 == 0
    other = random.predict(trials, evaluator.scene, seed=0)
    T_obj_ee, T_world_ee = (
        torch.where(some[:, None, None], getattr(other, k), getattr(poses, k)).contiguous()
        for k in ("T_obj_ee", "T_world_ee")
    )
    return evaluator, T_obj_ee, T_world_ee, trials


@pytest.mark.parametrize("stages", ["pose", "all"])
def test_before_people_captured_compiled_and_plain_calls_are_equal_in_every_field(before_people, stages):
    evaluator, *asked = before_people
    plain = evaluator.score(*asked, stages)
    assert evaluator.benchmark.receiver == "body" and (plain.body_m < CLEARANCE_CAP_M).any()
    if "received" in plain.criteria and stages == "all":
        assert plain.evaluated[:, plain.criteria.index("received")].any()
    names = [f.name for f in fields(plain)]

    def score(g: torch.Tensor, h: torch.Tensor, t: Trials) -> list[torch.Tensor]:
        scores = evaluator.score(g, h, t, stages)
        return [getattr(scores, name) for name in names]

    compiled = torch.compile(score, backend="aot_eager", fullgraph=True)(*asked)
    assert_same(type(plain)(**dict(zip(names, compiled, strict=True))), plain)
    captured = evaluator.capture(B, stages=stages)
    for order in (torch.arange(B).flip(0), torch.arange(B)):
        repeated = captured(*(x[order] for x in asked))
        assert_same(repeated, plain[order])
        assert type(repeated) is type(plain) and repeated.inputs is None
    with pytest.raises(TypeError, match=r"trials\.receiver is None; it must be a torch tensor \(24, 5, 4\)"):
        captured(trials=replace(asked[2], receiver=None))


def test_before_people_a_compiled_call_has_the_gradient_of_the_plain_one(before_people):
    evaluator, g, h, trials = before_people

    def quality(T_world_ee: torch.Tensor) -> torch.Tensor:
        return evaluator.score(g, T_world_ee, trials, "pose").soft(temperature_m=0.01, log=True).sum()

    found = []
    for function in (quality, torch.compile(quality, backend="aot_eager", fullgraph=True)):
        T_world_ee = h.clone().requires_grad_()
        found += torch.autograd.grad(function(T_world_ee), T_world_ee)
    assert found[0].flatten(1).any(1).sum() >= 5 and torch.equal(*found)


def test_what_cuda_cannot_capture_is_refused_by_name():
    benchmark, device = load_benchmark("r2h-v3"), torch.device("cuda")
    with pytest.raises(ValueError, match=r"r2h-v3 asks for Pick, .* call score\(\.\.\., stages='pose'\)"):
        check_capture(benchmark, EvalConfig(), device, "pose")
    check_capture(benchmark, EvalConfig(), torch.device("cpu"), "all")
    check_capture(load_benchmark(), EvalConfig(), device, "pose")


# --- CUDA ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cuda() -> Evaluator:
    return Evaluator(load_benchmark("r2h-v1"), device="cuda")


def on_cuda(batch) -> tuple[torch.Tensor, torch.Tensor, Trials]:
    return batch.T_obj_ee.cuda(), batch.T_world_ee.cuda(), batch.trials.to("cuda")


@pytest.mark.gpu
def test_a_pose_call_does_not_synchronise_and_allocates_nothing_new(cuda, batch):
    arguments = on_cuda(batch)
    for _ in range(3):
        s = cuda.score(*arguments, "pose")
    torch.cuda.synchronize()
    allocated = torch.cuda.memory_stats()["num_alloc_retries"], torch.cuda.memory_reserved()
    mode = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("error")
    try:
        s = cuda.score(*arguments, "pose")
        reward.rank_of_k(reward.quality(s), 4), reward.best_of_k(reward.quality(s), 4), reward.first_failure(s)
    finally:
        torch.cuda.set_sync_debug_mode(mode)
    assert (torch.cuda.memory_stats()["num_alloc_retries"], torch.cuda.memory_reserved()) == allocated
    assert s.outcome.is_cuda


@pytest.mark.gpu
def test_bad_rows_and_indices_are_invalid_on_cuda_and_leave_their_neighbours_alone(cuda, batch):
    g, h, trials = on_cuda(batch)
    good = cuda.score(g, h, trials, "pose")
    index, hand, poses = trials.object_index.clone(), trials.hand_index.clone(), g.clone()
    index[2], index[3], hand[5], poses[7] = 99, -1, 10**6, torch.nan
    s = cuda.score(poses, h, Trials(trials.trial_id, index, hand, trials.T_world_hand), "pose")
    bad = torch.zeros(B, dtype=torch.bool, device="cuda")
    bad[[2, 3, 5, 7]] = True
    assert (s.outcome[bad] == int(Outcome.INVALID_INPUT)).all() and torch.isnan(s.margin[bad]).all()
    assert_same(s[~bad].to("cpu"), good[~bad].to("cpu"))


@pytest.mark.gpu
def test_a_graph_on_another_stream_gives_the_bits_of_the_plain_call(cuda, batch):
    g, h, trials = on_cuda(batch)
    plain = cuda.score(g, h, trials, "pose")
    captured = cuda.capture(B)
    assert_same(captured(g, h, trials).to("cpu"), plain.to("cpu"))
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        mine = captured(g.flip(0), h.flip(0), trials[torch.arange(B - 1, -1, -1, device="cuda")])
        eager = cuda.score(g, h, trials, "pose")
    stream.synchronize()
    assert_same(mine.to("cpu"), plain[torch.arange(B - 1, -1, -1, device="cuda")].to("cpu"))
    assert_same(eager.to("cpu"), plain.to("cpu"))
    with pytest.raises(ValueError, match="cannot be captured"):
        cuda.capture(B, stages="all")


@pytest.mark.gpu
def test_a_compiled_step_on_cuda_equals_the_plain_one(cuda, batch):
    g, h, trials = on_cuda(batch)
    compiled = torch.compile(lambda g, h, t: reward.margin_vector(cuda.score(g, h, t, "pose")), fullgraph=True)
    assert torch.equal(compiled(g, h, trials), reward.margin_vector(cuda.score(g, h, trials, "pose")))


@pytest.mark.gpu
def test_verdicts_of_cuda_and_cpu_differ_only_near_a_threshold(cuda):
    b = make_batch(default_evaluator().scene, 2048, random_share=0.4)
    on_cpu = default_evaluator().score(b.T_obj_ee, b.T_world_ee, b.trials, "pose")
    on_gpu = cuda.score(*on_cuda(b), "pose").to("cpu")
    differ = on_cpu.outcome != on_gpu.outcome
    assert not (differ & ~on_cpu.borderline & ~on_gpu.borderline).any()
