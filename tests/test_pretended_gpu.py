"""The evaluator's use of a GPU, tested without one: tensors that say cuda:0 (tests/support/pretend_cuda.py)."""

from collections.abc import Iterator
from dataclasses import fields, replace

import pytest
import torch
from pretend_cuda import OnCuda, Seen, pretending

from r2h_batch import load_benchmark
from r2h_batch.config import CLEARANCE_CAP_M, HOME_Q, EvalConfig, ExecConfig, PlanConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.ik import home_posture
from r2h_batch.methods import oracle, random
from r2h_batch.scene.grasp_tables import gripper_tables
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Predictions, Scores, Trials

KINEMATIC = EvalConfig(execute=ExecConfig(sim="none"))


@pytest.fixture(scope="module")
def trials() -> Trials:
    return load_benchmark("r2h-v1").trials(32, splits=("S0", "S1"))


@pytest.fixture(scope="module")
def poses(scene: Scene, trials: Trials) -> Predictions:
    return random.predict(trials, scene, seed=0)


@pytest.fixture(scope="module")
def gpu() -> Iterator[tuple[Seen, Evaluator]]:
    with pretending() as seen:
        yield seen, Evaluator(load_benchmark("r2h-v1"), KINEMATIC, device="cuda:0")


def scored(gpu: tuple[Seen, Evaluator], poses: Predictions, trials: Trials, stages: str, **config: object) -> Scores:
    seen, evaluator = gpu
    evaluator.config = replace(KINEMATIC, **config)
    there = [x.to("cuda:0") for x in (poses.T_obj_ee, poses.T_world_ee, trials)]
    for list_ in (seen.waits, seen.arrays, seen.launches):
        list_.clear()
    return evaluator.score(*there, stages)


def bits(scores: Scores) -> dict[str, bytes]:
    kept = (f.name for f in fields(Scores) if f.name != "t_plan_s")
    return {name: getattr(scores, name).contiguous().numpy().tobytes() for name in kept}


@pytest.mark.check
def test_what_a_gpu_would_refuse_is_refused_and_what_it_would_wait_for_is_seen() -> None:
    with pretending() as seen:
        there, here = torch.arange(3, device="cuda:0"), torch.arange(3)
        assert there.is_cuda and str(there.device) == "cuda:0" and isinstance(there + 1, OnCuda) and not seen.waits
        with pytest.raises(RuntimeError, match="one device"):
            there + here
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()
        waits = {
            "item": lambda: int(there[0]),
            "nonzero": lambda: torch.nonzero(there),
            "index with a mask": lambda: there[there > 1],
            "copy to the CPU": lambda: there.cpu(),
            "tolist": lambda: there.tolist(),
        }
        for what, ask in waits.items():
            seen.waits.clear()
            ask()
            assert [w for w, _ in seen.waits] == [what]
        there[there > 1] = 7  # one number under a mask: nothing to wait for
        assert len(seen.waits) == 1 and there.tolist() == [0, 1, 7]
    assert not torch.cuda.is_available() or torch.cuda.device_count()


def test_a_graph_repeats_what_was_captured_and_old_numbers_where_the_host_read_some() -> None:
    with pretending() as seen:
        x, graph = torch.ones(2, device="cuda:0"), torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            doubled, read = 2.0 * x, x * float(x[0])
        x.fill_(3.0)
        graph.replay()
        assert [w for w, _ in seen.waits] == ["item"]
        assert doubled.tolist() == [6.0, 6.0] and read.tolist() == [3.0, 3.0]


def test_the_pose_stage_never_waits_for_the_device_and_gives_the_rows_of_a_cpu(
    gpu: tuple[Seen, Evaluator], scene: Scene, trials: Trials, poses: Predictions
) -> None:
    there = scored(gpu, poses, trials, "pose")
    assert gpu[0].waits == [] and len(gpu[0].launches) >= 8
    assert gpu[0].arrays == []  # the very first call finds all tables: one that is captured may not make them
    here = Evaluator(load_benchmark("r2h-v1"), KINEMATIC).score(poses.T_obj_ee, poses.T_world_ee, trials, "pose")
    assert bits(there.to("cpu")) == bits(here)


@pytest.mark.parametrize("receiver", ["hand", "body"])
def test_a_captured_call_needs_nothing_of_the_host_and_writes_where_it_did_before(
    receiver: str, gpu: tuple[Seen, Evaluator], trials: Trials, poses: Predictions
) -> None:
    seen, evaluator = gpu
    evaluator.config = config = replace(KINEMATIC, receiver=receiver)
    seen.waits.clear()
    captured = evaluator.capture(8)
    assert seen.waits == []
    seen.launches.clear()
    places = {f.name: getattr(captured.scores, f.name).data_ptr() for f in fields(Scores)}
    for first in (0, 8, 24):  # rows that are told from those of the capture by every stage
        rows = slice(first, first + 8)
        there = captured(*(x[rows].to("cuda:0") for x in (poses.T_obj_ee, poses.T_world_ee, trials)))
        assert seen.waits == [] and seen.launches == []
        assert places == {f.name: getattr(there, f.name).data_ptr() for f in fields(Scores)}
        here = Evaluator(load_benchmark("r2h-v1"), config).score(
            poses.T_obj_ee[rows], poses.T_world_ee[rows], trials[rows], "pose"
        )
        copied = bits(there.to("cpu"))
        seen.waits.clear()
        assert copied == bits(here)
        assert len({*here.outcome.tolist()}) > 1


@pytest.mark.parametrize("plan", [PlanConfig(), PlanConfig(goals="one", edge_check="moveit")], ids=["exact", "moveit"])
def test_a_whole_chunk_waits_at_most_four_times_and_its_rows_leave_in_one_copy(
    plan: PlanConfig, gpu: tuple[Seen, Evaluator], scene: Scene, trials: Trials, poses: Predictions
) -> None:
    seen = gpu[0]
    there = scored(gpu, poses, trials, "all", plan=plan)
    assert 1 <= len(seen.waits) <= 4 + (trials.receiver is not None), seen.waits  # bodies have a queue of their own
    assert {"rrt_connect", "shortcut", "straight_lines", "safe_distance"} <= {*seen.launches}
    seen.waits.clear()
    copied = there.to("cpu")
    assert [what for what, _ in seen.waits] == ["copy to the CPU"]
    assert copied.inputs is not None and copied.inputs.trials.T_world_hand.device.type == "cpu"
    evaluator = Evaluator(load_benchmark("r2h-v1"), replace(KINEMATIC, plan=plan))
    here = evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials)
    assert bits(copied) == bits(here)


def test_a_receivers_body_costs_one_wait_more(gpu: tuple[Seen, Evaluator], scene: Scene) -> None:
    trials = load_benchmark("r2h-v1").trials(16)
    poses = random.predict(trials, scene, seed=0)
    there = scored(gpu, poses, trials, "all", receiver="body")
    assert len(gpu[0].waits) <= 5, gpu[0].waits
    copied = there.to("cpu")
    here = Evaluator(load_benchmark("r2h-v1"), replace(KINEMATIC, receiver="body")).score(
        poses.T_obj_ee, poses.T_world_ee, trials
    )
    assert bits(copied) == bits(here) and (here.body_m[here.path_len > 0] <= CLEARANCE_CAP_M).sum() >= 3


def test_tables_that_were_made_while_pretending_do_not_outlive_it() -> None:
    with pretending():
        home_posture("cuda:0", HOME_Q), gripper_tables(load_robot(), "cuda:0")
        assert home_posture.cache_info().currsize and gripper_tables.cache_info().currsize
    assert home_posture.cache_info().currsize == gripper_tables.cache_info().currsize == 0


def test_methods_answer_on_the_device(gpu: tuple[Seen, Evaluator], trials: Trials) -> None:
    for method, few in ((random, {}), (oracle, {"rounds": 1})):
        answer = method.predict(trials[:1].to("cuda:0"), gpu[1].scene, seed=0, **few)
        assert answer.T_obj_ee.is_cuda and answer.T_world_ee.is_cuda
