"""Rows at a time: as memory allows, half as many when it was not enough, never other results."""

import os
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest
import torch
from pretend_cuda import pretending

from r2h_batch import launching, load_benchmark
from r2h_batch.base.launch.memory import CUDA_ROWS, in_chunks
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.launching import POSE_CHUNK_CUDA
from r2h_batch.methods import random
from r2h_batch.work import Work

WORDS = {
    "torch": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    "torch on a CPU": RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
    "Warp": RuntimeError("Failed to allocate 4096 bytes on device 'cuda:0'"),
    "Python": MemoryError(),
}


@pytest.mark.parametrize("error", WORDS.values(), ids=WORDS.keys())
def test_out_of_memory_halves_the_rows_and_says_so(error: Exception, caplog: pytest.LogCaptureFixture) -> None:
    asked = []

    def judge(first: int, last: int) -> range:
        asked.append(last - first)
        if last - first > 3:
            raise error
        return range(first, last)

    parts = in_chunks(10, 8, judge)
    assert [i for part in parts for i in part] == list(range(10))
    assert asked == [8, 4, 2, 2, 2, 2, 2]
    assert [r.getMessage() for r in caplog.records] == [
        "out of memory with 8 rows: going on with 4 at a time",
        "out of memory with 4 rows: going on with 2 at a time",
    ]


def test_an_evaluator_that_runs_out_of_memory_gives_the_same_rows() -> None:
    config = EvalConfig(execute=ExecConfig(sim="none"))
    evaluator = Evaluator(load_benchmark("r2h-v1"), config)
    trials = load_benchmark("r2h-v1").trials(12, splits=("S0",))
    poses = random.predict(trials, evaluator.scene, seed=0)
    whole = evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials, "pose")
    judge, sizes = launching.scored, []

    def tight(work: Work, *args: object) -> object:
        sizes.append(len(work.trials))
        if len(work.trials) > 5:
            raise WORDS["Warp"]
        return judge(work, *args)

    with mock.patch.object(launching, "scored", tight):
        parts = evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials, "pose")
    assert sizes == [12, 6, 3, 3, 3, 3]
    assert torch.equal(parts.margin.nan_to_num(9.0), whole.margin.nan_to_num(9.0))
    assert parts.outcome.tolist() == whole.outcome.tolist()
    assert evaluator.rows_at_once("pose") == 4 * evaluator.rows_at_once("all") == 4 * config.chunk
    with pretending():
        there = Evaluator(load_benchmark("r2h-v1"), replace(config, chunk=64), device="cuda:0")
        assert there.rows_at_once("pose") == POSE_CHUNK_CUDA and there.rows_at_once("all") == CUDA_ROWS


@pytest.mark.alone
def test_hundreds_of_calls_of_one_row_take_no_more_memory_than_the_first() -> None:
    judge = Evaluator(load_benchmark("r2h-v1"), EvalConfig(execute=ExecConfig(sim="none")), threads=1)
    trials = load_benchmark("r2h-v1").trials(2)
    answer = random.predict(trials, judge.scene, seed=0)

    def memory_mib(calls: int) -> float:
        for i in range(calls):
            row = slice(i % len(trials), i % len(trials) + 1)
            stages = "pose" if i % 10 else "all"
            judge.score(answer.T_obj_ee[row], answer.T_world_ee[row], trials[row], stages)
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20

    settled = memory_mib(100)
    assert memory_mib(500) - settled < 2.0  # 4 kB a call
