"""The kernels that a first call compiles at once: every file that it launches from, with a line that says so."""

import copy
import os
import subprocess
import sys
import threading

import pytest
import warp as wp
from problems import default_evaluator, make_batch

from r2h_batch.judge import compile as compiled
from r2h_batch.kernels.ik.nearest import nearest_posture
from r2h_batch.kernels.ik.step import solve_ik_kernel

TWO_FILES = """
from r2h_batch.base.launch import load
from r2h_batch.kernels.judge.presented import present
from r2h_batch.kernels.judge.verdict import judge_criterion
load([present, judge_criterion], "cpu")
"""


@pytest.mark.check
@pytest.mark.parametrize("stages", ["pose", "all"])
def test_every_file_that_a_call_launches_from_is_among_those_compiled_at_once(stages, monkeypatch):
    launched, launch = set(), wp.launch

    def listed(kernel, *given, **options):
        launched.add(kernel.module.name)
        return launch(kernel, *given, **options)

    monkeypatch.setattr(wp, "launch", listed)
    evaluator = copy.copy(default_evaluator().kinematic)
    batch = make_batch(evaluator.scene, 4)
    # a thread of its own has packed no launch yet
    thread = threading.Thread(target=evaluator.score, args=(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages))
    thread.start()
    thread.join()
    always = {k.module.name for k in (*compiled.SIZED, *compiled.SHARED, solve_ik_kernel, nearest_posture)}
    posed, planned = ({k.module.name for k in kernels} for kernels in (compiled.POSED, compiled.planned()))
    if stages == "pose":
        assert launched == always | posed
    else:
        assert always | planned <= launched and launched.isdisjoint(posed)


def test_missing_files_are_announced_and_compiled_once(tmp_path):
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path)}
    said = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", TWO_FILES], capture_output=True, text=True, env=environment, check=True
        )
        said.append(done.stderr)
    assert "compiling 2 files of kernels" in said[0] and said[1] == ""


POSE = """
import sys
import torch
from r2h_batch import Evaluator, load_benchmark
benchmark = load_benchmark("r2h-v0")
trials = benchmark.trials(1)[:1]
pose = torch.eye(4)[None]
Evaluator(benchmark).score(pose, trials.T_world_hand, trials, stages="pose")
print(*sorted(sys.modules))
"""


def test_a_first_verdict_on_a_pose_imports_nothing_for_motions_gradients_or_hulls():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", POSE], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "r2h_batch.kernels.judge.goal" in loaded
    needless = ("mujoco", "scipy", "trimesh", "yaml", "torch._dynamo", "r2h_batch.judge.plan", "r2h_batch.judge.motion")
    needless += ("r2h_batch.kernels.plan.rrt", "r2h_batch.kernels.ik.any_arm")
    assert loaded.isdisjoint(needless)
