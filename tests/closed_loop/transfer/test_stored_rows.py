"""Claims about transfers of rows that ship with the package."""

from pathlib import Path

import numpy as np
import pytest
import torch

from r2h_batch.closed_loop.transfer.batched import BatchedSimulator
from r2h_batch.closed_loop.transfer.cases import Case, Simulator
from r2h_batch.closed_loop.transfer.handed import handed_of
from r2h_batch.closed_loop.transfer.model import STEPS, Setting
from r2h_batch.judge.reception import reception
from r2h_batch.report import compare
from r2h_batch.report.compare.stored import ROWS
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.reevaluation import Judge

pytestmark = pytest.mark.slow
V2 = Path(compare.__file__).parent / "rows" / "r2h-v2"
TOUCHED = (
    (ROWS / "v1", "oracle", 16, "headphones", "robot_dropped"),
    (V2, "oracle", 3, "pliers_00", "kept"),
    (V2, "Handover-VA (oracle labels + noise)", 25, "knife_01", "robot_dropped"),
)
"""Run, method, trial, object and outcome of touches that no number marks: the object breaks away under the finger, at 0.1 to 0.5
m/s, and sticks in another place, or not at all, with half the step."""
TRIALS = np.arange(44, 58)
FORCES = [Case("load-share", "take", 0), Case("threshold", "take", 0), Case("load-share", "touch", 0)]
PROBES = [Case("probe", "touch", 0), Case("probe", "take", 0)]


@pytest.fixture(scope="module")
def received():
    """Received rows of the oracle, from trials that nothing was tuned on, and what simulates them."""
    return received_of(ROWS / "v1", "oracle", TRIALS)


def received_of(folder, method: str, ids):
    """Received rows of trials of a run, and their scene."""
    run = load_run(folder)
    judge = Judge(run)
    rows = {r["trial_id"]: r for r in run.poses(method).to_pylist()}
    grasp, handover = (
        torch.tensor(np.array([rows[i][k] for i in ids.tolist()], np.float32)).reshape(-1, 4, 4)
        for k in ("T_obj_ee", "T_world_ee")
    )
    asked, evaluator = judge.trials(ids), judge.evaluator
    found = reception(evaluator.kinematic.score(grasp, handover, asked, stages="pose"))
    return handed_of(found, ids, asked, evaluator.scene), evaluator.scene


def simulated(received, cases: list[Case], steps: int = STEPS):
    handed, scene = received
    return Simulator(scene.robot, tuple(scene.objects), Setting(steps=steps), 0)(handed, cases)


def test_half_the_time_step_changes_no_outcome(received):
    whole, half = (simulated(received, FORCES, n) for n in (STEPS, 2 * STEPS))
    assert len(received[0]) >= 10
    pairs = [
        (x, y)
        for a, b in zip(whole, half, strict=True)
        for x, y in zip(a.transfers.outcome, b.transfers.outcome, strict=True)
    ]
    assert [pair for pair in pairs if pair[0] != pair[1]] == []


@pytest.mark.parametrize("touched", TOUCHED, ids=lambda touched: touched[3])
def test_a_touch_that_half_the_step_ends_otherwise_is_undecided_on_both_engines(touched):
    folder, method, trial, word, outcome = touched
    handed, scene = received_of(folder, method, np.array([trial]))
    assert scene.objects[handed.object_index[0]].name == word
    given, case = (scene.robot, tuple(scene.objects), Setting(), 0), [Case("load-share", "touch", 0)]
    exact, batched = (engine(*given)(handed, case)[0].transfers for engine in (Simulator, BatchedSimulator))
    assert exact.outcome == batched.outcome == [outcome]
    assert exact.halved.all() and not exact.near_limit.any()
    assert exact.undecided.all() and batched.undecided.all()


def test_probe_keeps_what_is_touched_and_hands_over_what_is_gripped(received):
    touched, taken = (m.transfers.outcome for m in simulated(received, PROBES))
    assert "false_release" not in touched
    kept = [k for k, outcome in enumerate(touched) if outcome == "kept"]
    assert sum(taken[k] == "taken" for k in kept) >= 0.8 * len(kept)


def test_batched_worlds_of_many_objects_end_as_in_mujoco_c(received):
    handed, scene = received
    given = scene.robot, tuple(scene.objects), Setting(), 0
    exact, batched = (engine(*given)(handed, FORCES) for engine in (Simulator, BatchedSimulator))
    assert len(set(handed.object_index.tolist())) >= 5
    for one, two in zip(exact, batched, strict=True):
        assert one.transfers.outcome == two.transfers.outcome
        off = np.abs(one.transfers.pull_n - two.transfers.pull_n)
        assert np.median(off) < 0.01 and (off < 1.0).mean() >= 0.9
