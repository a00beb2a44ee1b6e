"""When a simulator fails or meets what it should not: each fault has its outcome, and the neighbours keep their bits."""

from functools import cache

import numpy as np
import pytest
import torch
from motions import ARM, BRIEF, BRIEF_WARP, MJWARP, N, into_the_table, placed, problems, reference_run, run
from problems import default_evaluator

from r2h_batch import load_benchmark
from r2h_batch.base import se3
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.distance import hand_distance
from r2h_batch.judge.motion import sim_mjwarp, sim_mujoco
from r2h_batch.judge.motion.execute import Executed, execute
from r2h_batch.judge.motion.simulation import Job, Samples
from r2h_batch.judge.motion.time_law import time_path
from r2h_batch.scene.robot import forward_kinematics
from r2h_batch.types import Outcome


@pytest.mark.parametrize(
    ("where", "config"),
    [
        ("start", BRIEF),
        ("goal", BRIEF),
        pytest.param("start", BRIEF_WARP, marks=pytest.mark.slow),
        ("goal", BRIEF_WARP),
    ],
    ids=["start-mujoco", "goal-mujoco", "start-mjwarp", "goal-mjwarp"],
)
def test_a_world_with_nan_is_not_valid_and_its_neighbours_are_bitwise_unchanged(config, where):
    p, whole = problems(), reference_run(config)
    row = int(torch.nonzero(p.plan.length == 2).flatten()[1])
    path = p.plan.path.clone()
    motion = time_path(path, p.plan.length, config)
    path[row, 0 if where == "start" else 1, 3] = torch.nan
    e = run(config, path=path, motion=motion)
    assert not e.valid[row] and not e.settled[row] and int(e.length[row]) == 0 and torch.isnan(e.t_exec_s[row])
    keep = torch.arange(N) != row
    assert torch.isnan(e.failed_state[keep]).all()
    assert where == "start" or torch.isfinite(e.failed_state[row]).all()  # the last state that was one
    assert e.valid[keep].all() and torch.equal(e.length[keep], whole.length[keep])
    for i in torch.nonzero(keep).flatten().tolist():
        assert torch.equal(e.path[i, : int(e.length[i])], whole.path[i, : int(e.length[i])])


def test_what_the_simulator_failed_on_is_invalid_sim_and_not_scored(monkeypatch):
    batch, engine = problems().batch, sim_mujoco
    evaluator = Evaluator(load_benchmark("r2h-v1"), EvalConfig(execute=ARM))
    good = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials)
    honest, hit = engine.simulate, []

    def failing(job: Job) -> Samples:
        answer = honest(job)
        hit.append(int(job.rows[2]))
        answer.valid[2] = False
        answer.q[2, 5:] = np.nan
        return answer

    monkeypatch.setattr(engine, "simulate", failing)
    bad = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials)
    row = hit[0]
    assert int(bad.outcome[row]) == Outcome.INVALID_SIM and not bad.success[row]
    assert not bad.evaluated[row].any() and not bad.passed[row].any() and torch.isnan(bad.margin[row]).all()
    assert torch.isnan(bad.t_exec_s[row]) and torch.isnan(bad.witness_time_s[row])
    assert torch.isfinite(bad.motion[row, :5]).all()
    assert torch.isnan(bad.motion[row, 5 : int(bad.motion_len[row])]).all()
    assert bad.motion_len[row] > 5 and (bad.motion_len > 0).sum() == 1 and good.motion.shape[1] == 0
    keep = torch.arange(N) != row
    assert torch.equal(bad.outcome[keep], good.outcome[keep])
    assert torch.equal(torch.nan_to_num(bad.margin[keep]), torch.nan_to_num(good.margin[keep]))


def test_without_memory_for_all_worlds_half_as_many_give_the_same_motion(monkeypatch, caplog):
    honest, tried = sim_mjwarp._run, []

    def small(job, todo, worlds, njmax, naconmax):
        tried.append(worlds)
        if worlds > 3:
            raise RuntimeError(f"Failed to allocate {worlds} bytes on device 'cuda:0'")
        return honest(job, todo, worlds, njmax, naconmax)

    monkeypatch.setattr(sim_mjwarp, "_run", small)
    e = run(MJWARP)
    moved = int((problems().plan.length > 0).sum())
    assert tried == [4, 2] and tried[-1] < moved  # worlds were refilled
    assert torch.equal(e.path, reference_run(MJWARP).path) and "2 worlds" in caplog.text
    with pytest.raises(RuntimeError, match="illegal"):
        monkeypatch.setattr(sim_mjwarp, "_run", lambda *a: (_ for _ in ()).throw(RuntimeError("illegal address")))
        run(MJWARP)


@cache
def crash(config: ExecConfig) -> Executed:
    """The first paths, of which one goes into the table."""
    return run(config, *into_the_table()[:2])


def test_the_table_stops_the_gripper_and_nobody_else_notices():
    path, length, row = into_the_table()
    with_crash = {c: crash(c) for c in (BRIEF, BRIEF_WARP)}
    clear = path.clone()
    clear[row, 1] = path[row, 0] + 0.01
    for config, e in with_crash.items():
        assert e.valid.all() and not e.settled[row]
        n = int(e.length[row])
        T = forward_kinematics(default_evaluator().scene.robot, e.path[row, n - 1].double().numpy())[7]
        low = T @ [0, 0, 0.1, 1]
        assert 0.03 < low[2] < 0.08  # pads near the top; the reference is 13 cm below
        assert float(e.deviation_m[row]) > 0.1
        other = run(config, clear, length)
        for i in torch.nonzero(length > 0).flatten().tolist():
            assert i == row or torch.equal(e.path[i, : int(e.length[i])], other.path[i, : int(other.length[i])])
    a, b = with_crash.values()
    assert float((a.path - b.path).abs().max()) < 5e-3  # both engines find the same table


def test_contacts_beyond_the_pool_are_noticed_and_run_again(monkeypatch):
    """Contacts are pooled over worlds: all trials of the pool run again, and then nothing has changed for anybody."""
    path, length, _ = into_the_table()
    enough = crash(BRIEF_WARP)
    honest, calls = sim_mjwarp._run, []

    def counted(job, todo, worlds, njmax, naconmax):
        answer = honest(job, todo, worlds, njmax, naconmax)
        calls.append((len(todo), naconmax, int((answer.failed != 0).sum())))
        return answer

    monkeypatch.setattr(sim_mjwarp, "_run", counted)
    monkeypatch.setattr(sim_mjwarp, "NACON_PER_WORLD", 1)
    again = run(BRIEF_WARP, path, length)
    pools = [pool for trials, pool, _ in calls if trials == 4]  # afterwards the one that is not at rest runs longer
    assert calls[0] == (4, 4, 4) and pools == [4, 16, 64][: len(pools)] and len(pools) > 1
    assert again.valid.all() and torch.equal(again.path, enough.path)
    monkeypatch.setattr(sim_mjwarp, "TRIES", 1)
    hopeless = run(BRIEF_WARP, path, length)
    assert hopeless.valid.tolist() == (length == 0).tolist()
    assert torch.isfinite(hopeless.failed_state[length > 0]).all()


def test_constraints_beyond_a_worlds_room_concern_that_world_alone(monkeypatch):
    path, length, row = into_the_table()
    enough = crash(BRIEF_WARP)
    monkeypatch.setattr(sim_mjwarp, "NJMAX", 9)  # seven hold the fingers together, a contact takes four
    again = run(BRIEF_WARP, path, length)
    assert again.valid.all() and torch.equal(again.path, enough.path)
    monkeypatch.setattr(sim_mjwarp, "TRIES", 1)
    hopeless = run(BRIEF_WARP, path, length)
    keep = torch.arange(N) != row
    assert not hopeless.valid[row] and hopeless.valid[keep].all()
    assert torch.isfinite(hopeless.failed_state[row]).all() and torch.isnan(hopeless.failed_state[keep]).all()
    for i in torch.nonzero(keep & (length > 0)).flatten().tolist():
        assert torch.equal(hopeless.path[i, : int(hopeless.length[i])], enough.path[i, : int(enough.length[i])])


def test_a_hand_wholly_inside_the_arm_is_touched_and_does_not_change_the_motion():
    evaluator, p, config = default_evaluator(), problems(), BRIEF
    e = reference_run(config)
    row = int(torch.nonzero(p.plan.length > 0).flatten()[0])
    trials = p.batch.trials
    T_world_hand = se3.orthonormalise(trials.T_world_hand).clone()
    q = p.plan.path[row, 0].double().numpy()
    upper_arm = forward_kinematics(evaluator.scene.robot, q)[2]
    T_world_hand[row, :3, 3] = torch.from_numpy((upper_arm @ [-0.2, 0, 0.138, 1])[:3]).float()
    body_poses = placed(T_world_hand=T_world_hand)
    motion = time_path(p.plan.path, p.plan.length, config)
    inside = execute(evaluator.scene, body_poses, p.plan.path, p.plan.length, motion, config)
    assert torch.equal(inside.path, e.path) and inside.valid.all()
    active = torch.ones(N, dtype=torch.bool)
    judged = hand_distance(evaluator.scene, body_poses, inside, active).distance_m
    before = hand_distance(evaluator.scene, p.body_poses, e, active).distance_m
    assert float(judged[row]) < -0.005
    keep = (torch.arange(N) != row) & ~before.isnan()
    assert torch.equal(judged[keep], before[keep])
