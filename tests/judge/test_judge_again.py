"""The second judge (`judge_twin`) agrees with the first one, and notices what is put wrong into it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from judge_twin import Again
from people_twin import episode_of, reception_of
from problems import kinematic_evaluator

from r2h_batch import Evaluator, load_benchmark, stages
from r2h_batch.closed_loop.env import End, HandoverEnv
from r2h_batch.closed_loop.episodes import play
from r2h_batch.closed_loop.policies import POLICIES, kind_of_action
from r2h_batch.judge import plan
from r2h_batch.judge.motion import time_law
from r2h_batch.judge.reception import reception
from r2h_batch.methods import oracle
from r2h_batch.report.compare.stored import ROWS
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.rows import TrialNames
from r2h_batch.sweep.scoring import judged_tables
from r2h_batch.types import Predictions, Trials

SHIPPED = load_run(ROWS / "v1")


def again(place: int) -> Again:
    """A shipped answer of FC, scored now, and the second judge of its row."""
    row = SHIPPED.poses(SHIPPED.named("fc")).slice(place, 1)
    trial_id = torch.tensor(row["trial_id"].to_numpy())
    T = [torch.tensor(np.array(row[k].to_pylist(), np.float32)).view(1, 4, 4) for k in ("T_obj_ee", "T_world_ee")]
    every = load_benchmark("r2h-v1").trials(int(trial_id) // 2 + 1)
    return scored(kinematic_evaluator("r2h-v1"), every[every.trial_id == trial_id], Predictions(trial_id, *T))


def scored(evaluator: Evaluator, trials: Trials, answer: Predictions) -> Again:
    """The second judge of the row that one trial gets."""
    names = TrialNames.of(evaluator.scene)
    columns: dict[str, Any] = {}
    for table in judged_tables(evaluator, trials, answer, None, ("details", "paths"), names).values():
        for found in table.to_pylist():
            columns |= found
    return Again(evaluator.scene, evaluator.config, trials, columns, answer.T_obj_ee[0], answer.T_world_ee[0])


@pytest.fixture(scope="module")
def first() -> Again:
    return again(0)


def test_a_row_of_each_split_is_right_in_all_that_it_says():
    """The first succeeds, fingers of the second hold the region; both have a path and are judged on everything."""
    for place, split in ((0, "S0"), (501, "S1")):
        twin = again(place)
        found = list(twin.findings())
        assert twin.row["split"] == split and len(twin.q) and [f for f in found if not f.holds] == []
        assert {f.name for f in found} >= {"stability", "plan", "reach", "safe", "outcome", "opening_m", "t_exec_s"}


def further(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reach measures 2 % less."""
    own = stages.reached

    def nearer(*a: Any, **k: Any) -> Any:
        found = own(*a, **k)
        return replace(found, distance_m=0.98 * found.distance_m)

    monkeypatch.setattr(stages, "reached", nearer)


def freer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths claim 1 mm of clearance that they have not."""
    own = plan.plan_paths

    def planned(*a: Any, **k: Any) -> Any:
        found = own(*a, **k)
        return replace(found, clearance_m=found.clearance_m + 1e-3)

    monkeypatch.setattr(plan, "plan_paths", planned)


def beside(monkeypatch: pytest.MonkeyPatch) -> None:
    """The arm ends a thousandth of a radian beside the handover pose."""
    own = stages.solve_ik

    def solved(*a: Any, **k: Any) -> Any:
        found = own(*a, **k)
        return replace(found, q=found.q + 1e-3)

    monkeypatch.setattr(stages, "solve_ik", solved)


def faster(monkeypatch: pytest.MonkeyPatch) -> None:
    """Motions take a percent less."""
    own = time_law.time_path

    def timed(*a: Any, **k: Any) -> Any:
        found = own(*a, **k)
        return replace(found, time_s=0.99 * found.time_s, t_exec_s=0.99 * found.t_exec_s)

    monkeypatch.setattr(time_law, "time_path", timed)


def shifted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The object stays where it was between the pads."""
    own = stages.attach_object

    def attached(scene: Any, T_obj_ee: Any, *a: Any) -> Any:
        found = own(scene, T_obj_ee, *a)
        return replace(found, grasp=replace(found.grasp, shift_m=found.grasp.shift_m + 2e-4))

    monkeypatch.setattr(stages, "attach_object", attached)


@pytest.mark.parametrize(
    ("mutant", "noticed", "criteria"),
    [
        (further, "reach", ("reach",)),
        (freer, "plan", ("plan",)),
        (beside, "end beside the handover pose, m", ()),
        (faster, "t_exec_s", ()),
        (shifted, "grasp_shift_m", ()),
    ],
)
def test_a_fault_of_the_judge_is_noticed(mutant, noticed, criteria, monkeypatch):
    mutant(monkeypatch)
    assert noticed in {f.name for f in again(0).findings(criteria) if not f.holds}


@pytest.mark.parametrize(
    ("changes", "noticed"),
    [
        ({"passed_reach": False}, "reach passes"),
        ({"outcome": "safe"}, "outcome"),
        ({"passed_reach": False, "outcome": "reach"}, "reach passes"),
        ({"opening_m": 0.001}, "opening_m"),
        ({"width_m": None}, "nothing is held"),
    ],
)
def test_a_row_that_lies_is_noticed(changes, noticed, first):
    told = Again(first.scene, first.config, first.trials, first.row | changes, first.T_obj_ee, first.T_world_ee)
    assert noticed in {f.name for f in told.findings(("reach",)) if not f.holds}


@pytest.fixture(scope="module")
def handed_over() -> tuple[Again, Any]:
    """A trial that the oracle solves, and its scores."""
    evaluator = kinematic_evaluator("r2h-v1")
    trials = load_benchmark("r2h-v1").trials(1)[:1]
    answer = oracle.predict(trials, evaluator.scene, evaluator=evaluator)
    scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials)
    return scored(evaluator, trials, answer), scores


def test_a_reception_is_right_and_one_that_lies_is_noticed(handed_over, monkeypatch):
    twin, scores = handed_over
    found = reception(scores)
    assert bool(found.received[0]) and [f for f in reception_of(twin, found, 0) if not f.holds] == []
    nearer = found.T_world_hand.clone()
    nearer[:, :3, 3] += 0.3 * (scores.inputs.T_world_ee[:, :3, 3] - nearer[:, :3, 3])
    farther = found.T_obj_ee.clone()
    farther[:, 0, 3] += 1e-4
    lies = {
        "effort": replace(found, effort=found.effort + 2e-4),
        "travel, m": replace(found, travel_m=found.travel_m + 2e-4),
        "turn, degrees": replace(found, turn_deg=found.turn_deg + 0.1),
        "hand beside its grasp": replace(found, T_world_hand=nearer),
        "upper arm, m": replace(found, elbow=found.elbow + 0.01),
        "held beside where it closes, m": replace(found, T_obj_ee=farther),
        "counts fall": replace(found, count=found.count.flip(1) - torch.arange(6, dtype=torch.int16)),
        "body to robot, and head to object, m": replace(found, elbow=scores.inputs.T_world_ee[:, :3, 3]),
    }
    for noticed, lie in lies.items():
        assert noticed in {f.name for f in reception_of(twin, lie, 0) if not f.holds}, noticed
    assert twin.receiver is not None
    deep = twin.receiver.copy()
    deep[4, 0] = 1.0  # a torso that reaches through the robot
    monkeypatch.setattr(twin, "receiver", deep)
    assert {f.name for f in reception_of(twin, found, 0) if not f.holds} == {"body to robot, and head to object, m"}


@pytest.mark.slow
def test_an_episode_is_right_and_one_that_lies_is_noticed(handed_over):
    twin, scores = handed_over
    policy = POLICIES["servo"]
    env = HandoverEnv(scores, "moves", action=kind_of_action(policy))
    play(env, policy)
    said = env.episodes()
    assert [f for f in episode_of(twin, env, 0) if not f.holds] == []
    lies = {
        "least_m": replace(said, least_m=said.least_m + 2e-4),
        "hand_path_m": replace(said, hand_path_m=said.hand_path_m + 2e-4),
        "robot_idle": replace(said, robot_idle=said.robot_idle + 0.01),
        "dropped": replace(said, end=torch.full_like(said.end, End.DROP)),
    }
    for noticed, lie in lies.items():
        told = SimpleNamespace(episodes=lambda lie=lie: lie, config=env.config, trace=env.trace)
        assert noticed in {f.name for f in episode_of(twin, told, 0) if not f.holds}, noticed
