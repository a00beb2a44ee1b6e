"""Claims about transfers of rows that ship with the package."""

import numpy as np
import pytest
import torch

from r2h_batch.closed_loop.transfer.batched import BatchedSimulator
from r2h_batch.closed_loop.transfer.cases import Case, Simulator
from r2h_batch.closed_loop.transfer.handed import handed_of
from r2h_batch.closed_loop.transfer.model import STEPS, Setting
from r2h_batch.judge.reception import reception
from r2h_batch.report.compare.stored import ROWS
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.reevaluation import Judge

pytestmark = pytest.mark.slow
TRIALS = np.arange(44, 58)
FORCES = [Case("load-share", "take", 0), Case("threshold", "take", 0), Case("load-share", "touch", 0)]
PROBES = [Case("probe", "touch", 0), Case("probe", "take", 0)]


@pytest.fixture(scope="module")
def received():
    """Received rows of the oracle, from trials that nothing was tuned on, and what simulates them."""
    run = load_run(ROWS / "v1")
    judge = Judge(run)
    rows = {r["trial_id"]: r for r in run.poses("oracle").to_pylist()}
    grasp, handover = (
        torch.tensor([rows[i][k] for i in TRIALS.tolist()]).reshape(-1, 4, 4) for k in ("T_obj_ee", "T_world_ee")
    )
    asked, evaluator = judge.trials(TRIALS), judge.evaluator
    found = reception(evaluator.kinematic.score(grasp, handover, asked, stages="pose"))
    handed = handed_of(found, TRIALS, asked, evaluator.scene)
    return handed, evaluator.scene


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
