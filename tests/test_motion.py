"""The executed motion: what the servos are told, what is recorded, when the arm has settled, engines and faults."""

from dataclasses import replace
from functools import cache

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from problems import default_evaluator, make_batch, solve

from r2h_batch import metrics, se3, sim_mjwarp, sim_mujoco
from r2h_batch.config import EvalConfig, ExecConfig, Thresholds
from r2h_batch.evaluate import Evaluator
from r2h_batch.execute import Executed, Motion, execute, time_at, time_path
from r2h_batch.kernels.reference import Law, servo_commands
from r2h_batch.launch import init_warp
from r2h_batch.robot import ee_pose, forward_kinematics
from r2h_batch.simulation import Job, Samples
from r2h_batch.types import Outcome, PlanReason

MUJOCO, PLANNED = ExecConfig(sim="mujoco"), ExecConfig(sim="none")
ARM, MJWARP = ExecConfig(sim="mujoco", model="arm"), ExecConfig(sim="mjwarp", model="arm")
BRIEF, BRIEF_WARP = (ExecConfig(sim=s, settle_limit_s=0.2) for s in ("mujoco", "mjwarp"))
"""The whole scene, watched for 0.7 s only: MuJoCo-Warp on a CPU makes some 15,000 steps a second of it."""
N = 16


@cache
def problems(n: int = N):
    evaluator = default_evaluator()
    return solve(evaluator.scene, make_batch(evaluator.scene, n, seed=3, random_share=0.3))


def run(config: ExecConfig, path=None, length=None, motion=None, n: int = N) -> Executed:
    p = problems(n)
    path = p.plan.path if path is None else path
    length = p.plan.length if length is None else length
    motion = time_path(path, length, config) if motion is None else motion
    return execute(default_evaluator().scene, p.placed, path, length, motion, config)


@cache
def reference_run(config: ExecConfig) -> Executed:
    return run(config)


def commands(path, length, motion, steps: int, *, lead: float, step_s: float) -> np.ndarray:
    init_warp()
    law = Law()
    law.speed, law.acceleration = 0.1 * np.pi, 0.5
    law.lead, law.step = lead, step_s
    out = torch.zeros((len(path), steps, 6), dtype=torch.float64)
    index = torch.arange(len(path), dtype=torch.int32)
    arrays = [wp.from_torch(t.contiguous()) for t in (index, path, motion.time_s, length, out)]
    wp.launch(servo_commands, dim=(len(path), steps), inputs=[0, law, *arrays], device="cpu")
    return out.numpy()


def test_servos_follow_the_time_law_with_the_speed_fed_forward():
    rng = np.random.default_rng(0)
    path = torch.from_numpy(np.cumsum(rng.normal(size=(6, 5, 6)) * 0.5, 1).astype(np.float32))
    length = torch.tensor([2, 3, 4, 5, 5, 5], dtype=torch.int32)
    motion = time_path(path, length, PLANNED)
    step_s, steps = 0.01, 2500
    q = commands(path, length, motion, steps, lead=0.0, step_s=step_s)
    ahead = commands(path, length, motion, steps, lead=0.03, step_s=step_s)
    speed = np.gradient(q, step_s, axis=1)
    for row in range(6):
        n = int(length[row]) - 1
        end = float(motion.t_exec_s[row])
        # where the law says the arm is at given fractions of a segment, it is at the times the law gives
        fraction = torch.linspace(0.02, 0.98, 40)
        for k in range(n):
            at = time_at(
                path[row].expand(40, -1, -1), length[row].expand(40),
                Motion(motion.time_s[row].expand(40, -1), motion.t_exec_s[row].expand(40)),
                torch.full((40,), k, dtype=torch.int32), fraction, PLANNED,
            ).numpy()  # fmt: skip
            want = (path[row, k] + fraction[:, None] * (path[row, k + 1] - path[row, k])).numpy()
            got = np.stack([np.interp(at, np.arange(steps) * step_s, q[row, :, j]) for j in range(6)], 1)
            np.testing.assert_allclose(got, want, atol=0.5 * 0.5 * step_s**2 + 2e-6)
        rest = q[row, int(end / step_s) + 2 :]
        np.testing.assert_array_equal(rest, np.broadcast_to(path[row, n].double(), rest.shape))
        np.testing.assert_allclose((ahead - q)[row], 0.03 * speed[row], atol=0.03 * 0.5 * step_s * 1.01)
    assert np.abs(speed).max() == pytest.approx(0.1 * np.pi, rel=1e-6)


def test_rest_comes_where_a_walk_over_the_recorded_poses_finds_it():
    e, p = reference_run(MUJOCO), problems()
    found = np.flatnonzero(p.plan.length.numpy() > 0)
    assert len(found) >= 8 and e.settled[found].all() and e.valid.all()
    assert torch.isnan(e.t_exec_s[p.plan.length == 0]).all() and not e.settled[p.plan.length == 0].any()
    for row in found:
        n = int(e.length[row])
        T = ee_pose(default_evaluator().scene.robot, e.path[row, :n].double().numpy())
        G = ee_pose(default_evaluator().scene.robot, p.plan.path[row, int(p.plan.length[row]) - 1].double().numpy())
        far = np.linalg.norm(T[:, :3, 3] - G[:3, 3], axis=1)
        trace = np.einsum("nij,ij->n", T[:, :3, :3], G[:3, :3])
        angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
        outside = np.flatnonzero((far > 1e-3) | (angle > np.radians(0.5)))
        assert float(e.t_exec_s[row]) == pytest.approx((outside[-1] + 1) * e.sample_s, abs=e.sample_s * 1.01)
        assert torch.equal(e.path[row, 0], p.plan.path[row, 0])
        assert far[-1] < 1e-4


def test_a_motion_that_cannot_come_to_rest_in_time_is_run_to_the_limit_and_fails_plan():
    p = problems()
    row = int(torch.nonzero(p.plan.length > 0).flatten()[0])
    tight = replace(ARM, settle_position_m=1e-7, payload="unknown", settle_limit_s=9.0)
    e = run(tight)
    assert not e.settled[row] and torch.isnan(e.t_exec_s[row]) and bool(e.valid[row])
    assert int(e.length[row]) == int(np.ceil(9.5 / e.sample_s)) + 1
    late = run(replace(ARM, settle_limit_s=1.0))
    assert not late.settled.any() and int(late.length.max()) == int(np.ceil(1.5 / e.sample_s)) + 1

    evaluator, batch = default_evaluator(), problems().batch
    strict = Evaluator(EvalConfig(execute=tight, thresholds=Thresholds(reach_radius_m=5.0)))
    usual = Evaluator(EvalConfig(execute=ARM, thresholds=Thresholds(reach_radius_m=5.0)))
    bad, good = (x.score(batch.T_obj_ee, batch.T_world_ee, batch.trials) for x in (strict, usual))
    moved = good.plan_reason == int(PlanReason.OK)
    assert moved.sum() >= 8 and (bad.plan_reason[moved] == int(PlanReason.NOT_SETTLED)).all()
    assert torch.equal(bad.plan_reason[~moved], good.plan_reason[~moved])
    assert (
        (bad.margin[moved, 1] == -torch.inf).all() and not bad.passed[moved, 1].any() and bad.evaluated[moved, 1].all()
    )
    held = moved & good.passed[:, 0]
    assert (bad.outcome[held] == int(Outcome.PLAN)).all() and torch.isnan(bad.t_exec_s[moved]).all()
    assert evaluator.config.execute.sim == "auto"


def test_every_step_of_the_motion_lies_within_the_slack_of_the_recorded_lines():
    p = problems()
    coarse, fine = reference_run(MUJOCO), run(replace(MUJOCO, record_steps=1, dwell_s=0.5))
    lever = default_evaluator().scene.levers.numpy()
    k = 4
    for row in torch.nonzero(p.plan.length > 0).flatten().tolist():
        n = min(int(coarse.length[row]), (int(fine.length[row]) - 1) // k + 1)
        q = fine.path[row, : (n - 1) * k + 1].double().numpy()
        np.testing.assert_array_equal(q[::k], coarse.path[row, :n].double().numpy())
        f = (np.arange(len(q)) % k / k)[:-1, None]
        line = np.repeat(q[::k][:-1], k, 0) * (1 - f) + np.repeat(q[::k][1:], k, 0) * f
        off = np.abs(q[:-1] - line)
        assert (off @ lever.T).max() <= float(coarse.slack_m[row]) + 1e-6  # float32 samples
        assert 0 < float(coarse.slack_m[row]) < 2e-5


def test_safe_judges_the_recorded_motion_less_its_slack():
    """A recorded motion that strays from the plan is what counts: here it is bent into the hand by hand."""
    evaluator, p, e = default_evaluator(), problems(), reference_run(MUJOCO)
    active = torch.ones(N, dtype=torch.bool)
    plain, _ = metrics.safe(evaluator.scene, p.placed, e, active, Thresholds())
    tighter, _ = metrics.safe(evaluator.scene, p.placed, replace(e, slack_m=e.slack_m + 1e-3), active, Thresholds())
    moved = plain.evaluated
    np.testing.assert_allclose((plain.margin - tighter.margin)[moved].numpy(), 1e-3, atol=1e-6)
    bent = e.path.clone()
    row = int(torch.nonzero(moved & (plain.margin < 0.045) & (plain.margin > 0.003)).flatten()[0])
    k = int(e.length[row]) // 2
    goal = e.path[row, int(e.length[row]) - 1]
    for s in torch.linspace(0.0, 1.0, 60):  # beyond the goal, into the hand: every joint 15 % too far
        bent[row, k] = goal + 0.15 * s * (goal - e.path[row, 0])
        worse, touch = metrics.safe(evaluator.scene, p.placed, replace(e, path=bent), active, Thresholds())
        if float(worse.margin[row]) < float(plain.margin[row]) - 1e-3:
            break
    assert float(worse.margin[row]) < float(plain.margin[row]) - 1e-3 and int(touch.segment[row]) in (k - 1, k)
    keep = torch.arange(N) != row
    assert torch.equal(worse.margin[keep & moved], plain.margin[keep & moved])


@pytest.mark.parametrize("config", [MUJOCO, MJWARP, BRIEF_WARP], ids=["mujoco", "mjwarp-arm", "mjwarp"])
def test_rows_do_not_depend_on_their_batch(config):
    p, whole = problems(), reference_run(config)
    for rows in (torch.arange(1), torch.arange(7), torch.randperm(N, generator=torch.Generator().manual_seed(0))):
        placed = default_evaluator().scene.place(
            p.batch.trials.object_index[rows], p.batch.trials.hand_index[rows], p.T_obj_ee_attached[rows],
            p.batch.trials.T_world_hand[rows], p.opening_m[rows],
        )  # fmt: skip
        path, length = p.plan.path[rows], p.plan.length[rows]
        e = execute(default_evaluator().scene, placed, path, length, time_path(path, length, config), config, threads=1)
        for i, row in enumerate(rows.tolist()):
            n = int(whole.length[row])
            assert int(e.length[i]) == n and torch.equal(e.path[i, :n], whole.path[row, :n])
            assert torch.equal(e.slack_m[i], whole.slack_m[row]) and torch.equal(e.settled[i], whole.settled[row])


@pytest.mark.parametrize("engines", [(ARM, MJWARP), (BRIEF, BRIEF_WARP)], ids=["arm", "scene"])
def test_both_engines_move_the_arm_the_same_way(engines):
    c, w = (reference_run(e) for e in engines)
    assert torch.equal(c.length, w.length)
    assert float((c.path - w.path).abs().max()) < 5e-6
    np.testing.assert_allclose(c.t_exec_s.numpy(), w.t_exec_s.numpy(), atol=c.sample_s * 1.01)
    assert float((c.slack_m - w.slack_m).abs().max()) < 1e-6
    lag = np.abs(c.path.numpy() - run(PLANNED).path[:, :1].numpy()).max()
    assert lag > (0.1 if engines[0] is ARM else 0.01)  # it moved


def test_the_scene_around_the_arm_does_not_change_what_a_free_arm_does():
    """Fingers that give way by micrometres are all that is new; no contact pushes on a certified path."""
    scene, arm = reference_run(MUJOCO), reference_run(ARM)
    assert torch.equal(scene.length, arm.length) and torch.equal(
        torch.nan_to_num(scene.t_exec_s), torch.nan_to_num(arm.t_exec_s)
    )
    assert 0 < float((scene.path - arm.path).abs().max()) < 5e-6
    sway = (scene.slack_m - arm.slack_m)[scene.length > 0]
    assert float(sway.min()) > 0 and float(sway.max()) < 1e-5


def test_the_deviation_bounds_how_far_any_body_was_from_its_plan():
    """Against the robot's and the object's own points, at every recorded time and at times between."""
    p, e, evaluator = problems(), reference_run(MUJOCO), default_evaluator()
    motion = time_path(p.plan.path, p.plan.length, MUJOCO)
    n = e.path.shape[1]
    reference = commands(p.plan.path, p.plan.length, motion, 2 * n, lead=0.0, step_s=e.sample_s / 2)
    robot, rows = evaluator.scene.robot, torch.nonzero(p.plan.length > 0).flatten().tolist()
    share = []
    for row in rows:
        k = int(e.length[row]) - 1
        q = e.path[row, : k + 1].double().numpy()
        between = np.stack([q[:-1], (q[:-1] + q[1:]) / 2], 1).reshape(-1, 6)
        T = [forward_kinematics(robot, x) for x in (between, reference[row, : 2 * k])]
        o = evaluator.scene.objects[int(p.batch.trials.object_index[row])]
        T_gripper_obj = (
            np.linalg.inv(robot.T_flange_gripper)
            @ robot.T_flange_ee
            @ np.linalg.inv(p.T_obj_ee_attached[row].double().numpy())
        )
        held = T_gripper_obj @ np.c_[o.hull_vertices, np.ones(len(o.hull_vertices))].T
        worst = np.linalg.norm((T[0][:, 7] @ held - T[1][:, 7] @ held)[:, :3], axis=1).max()
        for link in range(7):
            tips = robot.arm.T_link_prim[robot.arm.link == link][:, :3, 3]
            points = np.c_[tips, np.ones(len(tips))].T
            worst = max(worst, np.linalg.norm((T[0][:, link] @ points - T[1][:, link] @ points)[:, :3], axis=1).max())
        assert worst <= float(e.deviation_m[row]) + 1e-6
        share.append(worst / float(e.deviation_m[row]))
        assert float(e.deviation_m[row]) < 2e-3
    assert max(share) > 0.3  # it is no bound out of thin air
    certified = (e.deviation_m < p.plan.clearance_m - 1e-4)[rows]
    assert certified.float().mean() > 0.5


def test_the_motion_follows_the_reference_within_a_fraction_of_a_millimetre():
    p, e = problems(), reference_run(MUJOCO)
    motion = time_path(p.plan.path, p.plan.length, MUJOCO)
    reference = commands(p.plan.path, p.plan.length, motion, e.path.shape[1], lead=0.0, step_s=e.sample_s)
    worst = 0.0
    for row in torch.nonzero(p.plan.length > 0).flatten().tolist():
        n = int(e.length[row])
        both = e.path[row, :n].double().numpy(), reference[row, :n]
        a, b = (ee_pose(default_evaluator().scene.robot, q)[:, :3, 3] for q in both)
        worst = max(worst, np.linalg.norm(a - b, axis=1).max())
    assert worst < 5e-4 and worst > 1e-6


@pytest.mark.parametrize("config", [BRIEF, BRIEF_WARP, MJWARP], ids=["mujoco", "mjwarp", "mjwarp-arm"])
@pytest.mark.parametrize("where", ["start", "goal"])
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


@pytest.mark.parametrize("config", [ARM, MJWARP], ids=["mujoco", "mjwarp"])
def test_what_the_simulator_failed_on_is_invalid_sim_and_not_scored(config, monkeypatch):
    engine = {"mujoco": sim_mujoco, "mjwarp": sim_mjwarp}[config.sim]
    batch = problems().batch
    evaluator = Evaluator(EvalConfig(execute=config))
    good = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials)
    honest, hit = engine.simulate, []

    def failing(job: Job, *, threads=None) -> Samples:
        answer = honest(job, threads=threads)
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
    assert (
        torch.isfinite(bad.motion[row, :5]).all() and torch.isnan(bad.motion[row, 5 : int(bad.motion_len[row])]).all()
    )
    assert bad.motion_len[row] > 5 and (bad.motion_len > 0).sum() == 1 and good.motion.shape[1] == 0
    keep = torch.arange(N) != row
    assert torch.equal(bad.outcome[keep], good.outcome[keep])
    assert torch.equal(torch.nan_to_num(bad.margin[keep]), torch.nan_to_num(good.margin[keep]))


def beyond_three_limits() -> tuple[torch.Tensor, torch.Tensor]:
    """Two paths; the second starts 0.02 rad beyond three joint limits: three constraints in one world."""
    robot = default_evaluator().scene.robot
    path = problems().plan.path[:2].clone()
    length = torch.tensor([2, 2], dtype=torch.int32)
    path[:, 0], path[:, 1] = torch.zeros(6), 0.1
    path[1, 0, :3] = torch.from_numpy(robot.upper[:3].copy()).float() + 0.02
    path[1, 1] = path[1, 0]
    path[1, 1, :3] -= 0.1
    return path, length


def test_too_few_constraints_are_noticed_and_the_trial_runs_again_with_more(monkeypatch):
    path, length = beyond_three_limits()
    enough = run(MJWARP, path, length, n=2)
    assert enough.valid.all()
    calls, honest = [], sim_mjwarp._run

    def counted(job, todo, worlds, njmax, naconmax):
        answer = honest(job, todo, worlds, njmax, naconmax)
        calls.append((todo.tolist(), njmax, answer.failed.tolist()))
        return answer

    monkeypatch.setattr(sim_mjwarp, "_run", counted)
    monkeypatch.setattr(sim_mjwarp, "NJMAX", 1)
    again = run(MJWARP, path, length, n=2)
    assert [c[1] for c in calls] == [1, 4] and len(calls[0][0]) == 2 and len(calls[1][0]) == 1
    assert again.valid.all() and torch.equal(again.path, enough.path)
    monkeypatch.setattr(sim_mjwarp, "TRIES", 1)
    hopeless = run(MJWARP, path, length, n=2)
    assert hopeless.valid.tolist() == [True, False]
    assert torch.equal(hopeless.path[0], enough.path[0])


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
    assert tried == [moved, moved // 2, moved // 4] and tried[-1] < moved  # worlds were refilled
    assert torch.equal(e.path, reference_run(MJWARP).path) and f"{moved // 4} worlds" in caplog.text
    with pytest.raises(RuntimeError, match="illegal"):
        monkeypatch.setattr(sim_mjwarp, "_run", lambda *a: (_ for _ in ()).throw(RuntimeError("illegal address")))
        run(MJWARP)


@pytest.mark.gpu
def test_a_gpu_moves_the_arm_as_mujoco_does_on_the_cpu():
    if not torch.cuda.is_available():
        pytest.skip("there is no GPU")
    b = problems(64).batch
    on_cpu = Evaluator(EvalConfig(execute=MUJOCO)).score(b.T_obj_ee, b.T_world_ee, b.trials)
    on_gpu = Evaluator(device="cuda").score(b.T_obj_ee.cuda(), b.T_world_ee.cuda(), b.trials.to("cuda")).to("cpu")
    same_path = (on_cpu.path_len == on_gpu.path_len) & ((on_cpu.path - on_gpu.path).abs().amax((1, 2)) < 1e-5)
    assert same_path.sum() > 32
    a, g = on_cpu[same_path], on_gpu[same_path]
    assert torch.equal(a.outcome[~a.borderline], g.outcome[~a.borderline])
    np.testing.assert_allclose(a.t_exec_s.numpy(), g.t_exec_s.numpy(), atol=0.017)


def test_more_contacts_than_there_is_room_for_are_noticed_by_their_count(monkeypatch):
    """Contacts are pooled over worlds and the simulator may stay silent: every trial of the pool is run again."""
    honest, sizes = sim_mjwarp._fields, []

    def crowded(model, data):
        fields = honest(model, data)
        sizes.append(data.naconmax)
        if len(sizes) < 3:
            fields.naconmax = -1  # less than the 0 contacts there are
        return fields

    monkeypatch.setattr(sim_mjwarp, "_fields", crowded)
    e = run(MJWARP)
    assert (
        len(sizes) == 3
        and sizes == [sizes[0] * 4**k for k in range(3)]
        and e.valid.all()
        and torch.equal(e.path, reference_run(MJWARP).path)
    )
    monkeypatch.setattr(sim_mjwarp, "TRIES", 2)
    sizes.clear()
    assert run(MJWARP).valid.tolist() == (problems().plan.length == 0).tolist()


def into_the_table() -> tuple[torch.Tensor, torch.Tensor, int]:
    """The first paths, one of which now goes down to fingertips 13 cm below the table's top; which."""
    p = problems()
    found = torch.nonzero(p.plan.length > 0).flatten()[:4]
    path, length = p.plan.path.clone(), torch.zeros_like(p.plan.length)
    length[found] = p.plan.length[found]
    row = int(found[1])
    path[row, 1:] = path[row, 0] + torch.tensor([0, 0.8, 0.8, -1.0, 0, 0])
    length[row] = 2
    assert ee_pose(default_evaluator().scene.robot, path[row, 1].double().numpy())[2, 3] < -0.1
    return path, length, row


FAST, FAST_WARP = (replace(c, scale=1.0, settle_limit_s=0.7) for c in (BRIEF, BRIEF_WARP))


def test_the_table_stops_the_gripper_and_nobody_else_notices():
    path, length, row = into_the_table()
    with_crash = {c: run(c, path, length) for c in (FAST, FAST_WARP)}
    clear = path.clone()
    clear[row, 1] = path[row, 0] + 0.01
    for config, e in with_crash.items():
        assert e.valid.all() and not e.settled[row]
        n = int(e.length[row])
        low = forward_kinematics(default_evaluator().scene.robot, e.path[row, n - 1].double().numpy())[7] @ [
            0,
            0,
            0.1,
            1,
        ]
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
    enough = run(FAST_WARP, path, length)
    honest, calls = sim_mjwarp._run, []

    def counted(job, todo, worlds, njmax, naconmax):
        answer = honest(job, todo, worlds, njmax, naconmax)
        calls.append((len(todo), naconmax, int((answer.failed != 0).sum())))
        return answer

    monkeypatch.setattr(sim_mjwarp, "_run", counted)
    monkeypatch.setattr(sim_mjwarp, "NACON_PER_WORLD", 1)
    again = run(FAST_WARP, path, length)
    assert calls[0] == (4, 4, 4) and [c[1] for c in calls] == [4, 16, 64][: len(calls)] and len(calls) > 1
    assert again.valid.all() and torch.equal(again.path, enough.path)
    monkeypatch.setattr(sim_mjwarp, "TRIES", 1)
    hopeless = run(FAST_WARP, path, length)
    assert hopeless.valid.tolist() == (length == 0).tolist()
    assert torch.isfinite(hopeless.failed_state[length > 0]).all()


def test_constraints_beyond_a_worlds_room_concern_that_world_alone(monkeypatch):
    path, length, row = into_the_table()
    enough = run(FAST_WARP, path, length)
    monkeypatch.setattr(sim_mjwarp, "NJMAX", 9)  # seven hold the fingers together, a contact takes four
    again = run(FAST_WARP, path, length)
    assert again.valid.all() and torch.equal(again.path, enough.path)
    monkeypatch.setattr(sim_mjwarp, "TRIES", 1)
    hopeless = run(FAST_WARP, path, length)
    keep = torch.arange(N) != row
    assert not hopeless.valid[row] and hopeless.valid[keep].all()
    assert torch.isfinite(hopeless.failed_state[row]).all() and torch.isnan(hopeless.failed_state[keep]).all()
    for i in torch.nonzero(keep & (length > 0)).flatten().tolist():
        assert torch.equal(hopeless.path[i, : int(hopeless.length[i])], enough.path[i, : int(enough.length[i])])


def test_a_failing_simulator_writes_no_log_into_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    p = problems()
    path = p.plan.path.clone()
    path[torch.nonzero(p.plan.length > 0).flatten()[0], 0, 3] = torch.nan
    said = []
    assert not run(BRIEF, path=path, motion=time_path(p.plan.path, p.plan.length, BRIEF)).valid.all()
    assert list(tmp_path.iterdir()) == [] and mujoco.get_mju_user_warning() is None
    mujoco.set_mju_user_warning(said.append)  # a user's own handler stays in charge
    try:
        run(BRIEF, path=path, motion=time_path(p.plan.path, p.plan.length, BRIEF))
        assert said and mujoco.get_mju_user_warning() is not None
    finally:
        mujoco.set_mju_user_warning(None)


def test_the_simulator_counts_contacts_beyond_its_room():
    """What the check above rests on: four worlds with four contacts each in a pool of eight."""
    init_warp()
    xml = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
      <body pos="0 0 0.0499"><freejoint/><geom type="box" size=".05 .05 .05"/></body></worldbody></mujoco>"""
    host = mujoco.MjModel.from_xml_string(xml)
    model = mjw.put_model(host)
    model.opt.warn_overflow = 0
    data = mjw.make_data(host, nworld=4, njmax=64, naconmax=8)
    mjw.step(model, data)
    assert int(data.nacon.numpy()[0]) == 16 > data.naconmax


@pytest.mark.parametrize("config", [MUJOCO, BRIEF_WARP], ids=["mujoco", "mjwarp"])
def test_a_hand_wholly_inside_the_arm_is_touched_and_does_not_change_the_motion(config):
    evaluator, p, e = default_evaluator(), problems(), reference_run(config)
    row = int(torch.nonzero(p.plan.length > 0).flatten()[0])
    trials = p.batch.trials
    T_world_hand = se3.orthonormalise(trials.T_world_hand).clone()
    q = p.plan.path[row, 0].double().numpy()
    upper_arm = forward_kinematics(evaluator.scene.robot, q)[2]
    T_world_hand[row, :3, 3] = torch.from_numpy((upper_arm @ [-0.2, 0, 0.138, 1])[:3]).float()
    placed = evaluator.scene.place(
        trials.object_index, trials.hand_index, p.T_obj_ee_attached, T_world_hand, p.opening_m
    )
    inside = execute(
        evaluator.scene, placed, p.plan.path, p.plan.length, time_path(p.plan.path, p.plan.length, config), config
    )
    assert torch.equal(inside.path, e.path) and inside.valid.all()
    active = torch.ones(N, dtype=torch.bool)
    judged, _ = metrics.safe(evaluator.scene, placed, inside, active, Thresholds())
    before, _ = metrics.safe(evaluator.scene, p.placed, e, active, Thresholds())
    assert float(judged.margin[row]) < -0.005 and not judged.passed[row]
    keep = (torch.arange(N) != row) & before.evaluated
    assert torch.equal(judged.margin[keep], before.margin[keep])


def test_configurations_that_mean_nothing_are_refused():
    for bad in (
        {"sim": "bullet"},
        {"model": "hand"},
        {"step_s": 0.0},
        {"record_steps": 2.5},
        {"payload": "heavy"},
        {"dwell_s": -1.0},
    ):
        with pytest.raises(ValueError, match=next(iter(bad))):
            ExecConfig(**bad)
    assert ExecConfig().engine("cpu") == "mujoco" and ExecConfig().engine("cuda:0") == "mjwarp"
    assert ExecConfig(sim="none").engine("cuda") == "none"
