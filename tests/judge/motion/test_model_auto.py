"""`model="auto"`: the arm alone where a contact is ruled out, the whole scene everywhere else, and nothing in between."""

import copy
from dataclasses import replace
from unittest import mock

import mujoco
import numpy as np
import pytest
import torch
from motions import ARM, BRIEF, MUJOCO, N, into_the_table, placed, problems, reference_run, run
from problems import default_evaluator
from rounds import each

import r2h_batch.judge.motion.execute as module
from r2h_batch import load_benchmark
from r2h_batch.config import CLEARANCE_TOLERANCE_M, EvalConfig, PlanConfig
from r2h_batch.judge.motion import sim_mujoco
from r2h_batch.judge.motion.execute import FINGER_GIVE_M, NEAR_M, Executed, execute, nothing_pushes
from r2h_batch.judge.motion.time_law import time_path
from r2h_batch.methods import oracle
from r2h_batch.scene.dynamics import Payload
from r2h_batch.scene.model import TrialScene
from r2h_batch.types import Outcome, PlanReason

AUTO = replace(MUJOCO, model="auto")
SCENE = replace(MUJOCO, model="scene")


def auto(clearance_m: torch.Tensor, rows: torch.Tensor | None = None) -> Executed:
    """With nothing to go by but the clearance: the walk along the motion rules nothing out."""
    p = problems()
    rows = torch.arange(N) if rows is None else rows
    path, length = p.plan.path[rows], p.plan.length[rows]
    motion = time_path(path, length, AUTO)
    near, never = clearance_m[rows], mock.Mock(return_value=torch.zeros_like(length, dtype=torch.bool))
    with mock.patch.object(module, "nothing_pushes", never):
        return execute(default_evaluator().scene, placed(rows), path, length, motion, AUTO, clearance_m=near)


def same(a: Executed, b: Executed, i: int, j: int) -> bool:
    n = int(a.length[i])
    return n == int(b.length[j]) and torch.equal(a.path[i, :n], b.path[j, :n]) and bool(a.settled[i] == b.settled[j])


def test_a_row_is_the_arms_where_its_clearance_rules_contacts_out_and_the_scenes_elsewhere():
    p, arm, scene = problems(), reference_run(ARM), reference_run(SCENE)
    found = torch.nonzero(p.plan.length > 0).flatten().tolist()
    # fingers that give way by micrometres are all that is new in the scene: no contact pushes on a certified path
    assert torch.equal(scene.length, arm.length) and 0 < float((scene.path - arm.path).abs().max()) < 5e-6
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


def test_without_a_certified_clearance_the_motion_itself_rules_contacts_out():
    path, length, low = into_the_table()
    config = replace(BRIEF, model="auto")
    e, scene, arm = (run(replace(config, model=m), path, length) for m in ("auto", "scene", "arm"))
    for i in torch.nonzero(length > 0).flatten().tolist():
        assert same(e, scene if i == low else arm, i, i)
    assert not e.settled[low] and arm.settled[low]  # alone the arm goes through the table
    # whoever has no bound says so and is asked in the same way: sampled edges, paths planned against an estimated hand
    batch = problems().batch
    for plan in (PlanConfig(edge_check="moveit"), PlanConfig(hand="estimated")):
        with mock.patch.object(module, "execute", wraps=execute) as moved:
            judge = copy.copy(default_evaluator())
            judge.config = EvalConfig(plan=plan)
            judge.score(batch.T_obj_ee[:2], batch.T_world_ee[:2], batch.trials[:2])
        assert moved.call_args.kwargs["clearance_m"] is None


def test_what_is_said_not_to_push_touches_nothing_in_mujoco_and_the_rest_does():
    """Straight motions to random postures, with the hand where it may be: MuJoCo's own contacts at 150 samples of each."""
    p, scene = problems(), default_evaluator().scene
    rng, n, steps = np.random.default_rng(5), 24, 150
    rows = torch.arange(n) % N
    trials = p.batch.trials
    body_poses = placed(rows)
    home = p.plan.path[0, 0].numpy()
    goal = home + rng.uniform(-1.8, 1.8, (n, 6))
    path = torch.from_numpy((home + np.linspace(0, 1, 26)[:, None] * (goal - home)[:, None]).astype(np.float32))
    length = torch.full((n,), 26, dtype=torch.int32)
    length[-1] = 0
    free = nothing_pushes(scene, body_poses, path, length, torch.zeros(n))
    scenes = scene.model(trials.hand_index.tolist(), SCENE)
    T_gripper_ee = np.linalg.inv(scene.robot.T_flange_gripper) @ scene.robot.T_flange_ee
    model = copy.copy(scenes.model)
    data = mujoco.MjData(model)
    touched = []
    for i in range(n - 1):
        k = int(rows[i])
        T_gripper_obj = T_gripper_ee @ np.linalg.inv(p.T_obj_ee_attached[k].double().numpy())
        o = int(trials.object_index[k])
        trial = TrialScene(
            Payload.of(scene.objects[o], T_gripper_obj), o, int(trials.hand_index[k]),
            trials.T_world_hand[k].double().numpy(), float(p.opening_m[k]),
        )  # fmt: skip
        scenes.load(model, trial, data)
        count = 0
        for f in np.linspace(0, 1, steps):
            data.qpos[:] = scenes.start(trial, home + f * (goal[i] - home))
            mujoco.mj_fwdPosition(model, data)
            count += data.ncon
        touched.append(count > 0)
    assert not free[-1]
    assert [not x for x in touched] == free[:-1].tolist()
    assert 4 < sum(touched) < n - 4
    # each body may be off by as much: none of them keeps a millimetre's half from itself for ever
    assert not nothing_pushes(scene, body_poses, path, length, torch.full((n,), 0.5 * NEAR_M)).any()
    some = nothing_pushes(scene, body_poses, path, length, torch.full((n,), 2e-4))
    assert (free | ~some).all()


def test_rows_do_not_depend_on_who_else_needs_the_scene():
    clearance = problems().plan.clearance_m.clone()
    clearance[::2] = 0.0
    whole = auto(clearance)
    found = torch.nonzero(problems().plan.length > 0).flatten()
    for rows in (found[:1], found[:5].flip(0)):
        part = auto(clearance, rows)
        for i, row in each(enumerate(rows.tolist())):
            assert same(part, whole, i, row) and torch.equal(part.slack_m[i], whole.slack_m[row])


def test_an_object_metres_out_of_the_robot_is_not_settled_and_not_simulated(monkeypatch):
    judge, simulate, rows = default_evaluator(), sim_mujoco.simulate, []
    monkeypatch.setattr(sim_mujoco, "simulate", lambda job, **k: rows.extend(job.rows) or simulate(job, **k))
    trials = load_benchmark("r2h-v0").trials(1, splits=["S0"])
    answer = oracle.predict(trials, judge.scene, evaluator=judge)
    far = answer.T_obj_ee.clone()
    far[:, :3, 3] -= 6.0 * far[:, :3, 2]
    both = trials[torch.zeros(2, dtype=torch.int64)]
    scores = judge.score(torch.cat([answer.T_obj_ee, far]), answer.T_world_ee.repeat(2, 1, 1), both)
    assert scores.path_len.gt(0).all() and rows == [0]
    assert scores.plan_reason.tolist() == [int(PlanReason.OK), int(PlanReason.NOT_SETTLED)]
    assert scores.outcome.tolist() == [int(Outcome.SUCCESS), int(Outcome.STABILITY)]
