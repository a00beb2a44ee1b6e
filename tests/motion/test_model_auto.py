"""`model="auto"`: the arm alone where a contact is ruled out, the whole scene everywhere else, and nothing in between."""

from dataclasses import replace
from unittest import mock

import pytest
import torch
from motions import ARM, MUJOCO, N, problems, reference_run
from problems import default_evaluator

from r2h_batch import evaluate
from r2h_batch.config import CLEARANCE_TOLERANCE_M, EvalConfig, PlanConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.motion.execute import FINGER_GIVE_M, Executed, execute
from r2h_batch.motion.time_law import time_path

AUTO = replace(MUJOCO, model="auto")
SCENE = replace(MUJOCO, model="scene")


def auto(clearance_m: torch.Tensor | None, rows: torch.Tensor | None = None) -> Executed:
    p = problems()
    rows = torch.arange(N) if rows is None else rows
    trials = p.batch.trials
    placed = default_evaluator().scene.place(
        trials.object_index[rows], trials.hand_index[rows], p.T_obj_ee_attached[rows], trials.T_world_hand[rows],
        p.opening_m[rows],
    )  # fmt: skip
    path, length = p.plan.path[rows], p.plan.length[rows]
    motion = time_path(path, length, AUTO)
    near = None if clearance_m is None else clearance_m[rows]
    return execute(default_evaluator().scene, placed, path, length, motion, AUTO, clearance_m=near)


def same(a: Executed, b: Executed, i: int, j: int) -> bool:
    n = int(a.length[i])
    return n == int(b.length[j]) and torch.equal(a.path[i, :n], b.path[j, :n]) and bool(a.settled[i] == b.settled[j])


def test_a_row_is_the_arms_where_its_clearance_rules_contacts_out_and_the_scenes_elsewhere():
    p, arm, scene = problems(), reference_run(ARM), reference_run(SCENE)
    found = torch.nonzero(p.plan.length > 0).flatten().tolist()
    clearance = p.plan.clearance_m.clone()
    near, just, exact = found[:3]  # too near by far; a hair more than both bodies may be off; a hair less
    off = 2 * (arm.deviation_m + FINGER_GIVE_M) + CLEARANCE_TOLERANCE_M
    clearance[near], clearance[just], clearance[exact] = 0.0, off[just] + 1e-6, off[exact] - 1e-6
    e = auto(clearance)
    for i in found:
        alone = bool(off[i] < clearance[i])
        assert same(e, arm if alone else scene, i, i)
        slack = arm.slack_m[i] + FINGER_GIVE_M if alone else scene.slack_m[i]
        assert float(e.slack_m[i]) == pytest.approx(float(slack), abs=1e-9)
        assert float(e.t_exec_s[i]) == pytest.approx(float(scene.t_exec_s[i]), abs=e.sample_s * 1.01)
        assert float(scene.slack_m[i]) <= float(arm.slack_m[i]) + FINGER_GIVE_M + 1e-7
    assert bool(off[just] < clearance[just]) and not bool(off[exact] < clearance[exact])
    assert not e.settled[p.plan.length == 0].any() and (e.length[p.plan.length == 0] == 0).all()


def test_without_a_certified_clearance_everything_moves_in_the_scene():
    e, scene = auto(None), reference_run(SCENE)
    assert torch.equal(e.path, scene.path) and torch.equal(e.slack_m, scene.slack_m)
    sampled = Evaluator(EvalConfig(plan=PlanConfig(edge_check="moveit")))
    batch = problems().batch
    with mock.patch.object(evaluate, "execute", wraps=execute) as moved:
        sampled.score(batch.T_obj_ee[:2], batch.T_world_ee[:2], batch.trials[:2])
    assert moved.call_args.kwargs["clearance_m"] is None


def test_rows_do_not_depend_on_who_else_needs_the_scene():
    clearance = problems().plan.clearance_m.clone()
    clearance[::2] = 0.0
    whole = auto(clearance)
    for rows in (torch.arange(1), torch.arange(1, 4), torch.randperm(N, generator=torch.Generator().manual_seed(1))):
        part = auto(clearance, rows)
        for i, row in enumerate(rows.tolist()):
            assert same(part, whole, i, row) and torch.equal(part.slack_m[i], whole.slack_m[row])
