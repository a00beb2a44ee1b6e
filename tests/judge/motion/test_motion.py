"""The executed motion: what the servos are told, what is recorded, when the arm has settled, and that engines agree."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import oracle
import pytest
import torch
import warp as wp
from motions import (
    ARM,
    BRIEF,
    BRIEF_WARP,
    MJWARP,
    MUJOCO,
    PLANNED,
    N,
    commands,
    into_the_table,
    placed,
    problems,
    reference_run,
    run,
)  # fmt: skip
from problems import default_evaluator
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.base.launch import init_warp, launch
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.config import EvalConfig, ExecConfig, Thresholds
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.distance import hand_distance
from r2h_batch.judge.motion import sim_mujoco
from r2h_batch.judge.motion.execute import execute
from r2h_batch.judge.motion.simulation import Job, Samples
from r2h_batch.judge.motion.time_law import Motion, time_at, time_path
from r2h_batch.kernels.robot.posture import duration
from r2h_batch.scene.model import SceneModel
from r2h_batch.scene.robot import ee_pose, forward_kinematics
from r2h_batch.types import Outcome, PlanReason

FEW = 4
"""Paths that MuJoCo-Warp moves the arm along here: on a CPU each takes seconds."""


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


@wp.kernel(enable_backward=False)
def durations(
    speed: wp.float64, acceleration: wp.float64, distance_in: wp.array(dtype=wp.float64),
    exact_out: wp.array(dtype=wp.float64), single_out: wp.array(dtype=float),
):  # fmt: skip
    i = wp.tid()
    exact_out[i] = duration(distance_in[i], speed, acceleration)
    single_out[i] = duration(float(distance_in[i]), float(speed), float(acceleration))


@pytest.mark.check
def test_servos_shortcuts_and_the_times_of_a_path_know_one_law():
    """The law stands in a kernel, in float64 for the servos and in float32 for shortcuts, and in torch for a path's times."""
    init_warp()
    speed, acceleration = PLANNED.scale * PLANNED.max_velocity_rad_s, PLANNED.scale * PLANNED.max_acceleration_rad_s2
    corner = speed**2 / acceleration  # below it the full speed is not reached
    distance = np.concatenate([[0.0], corner * np.geomspace(1e-6, 1e2, 200), [corner]])
    path = torch.zeros((len(distance), 2, 6))
    path[:, 1, 3] = torch.from_numpy(distance).float()
    distance = path[:, 1, 3].double().numpy()
    exact, single = wp.zeros(len(distance), dtype=wp.float64), wp.zeros(len(distance), dtype=float)
    inputs = {"speed": speed, "acceleration": acceleration, "distance": distance}
    launch(durations, len(distance), inputs=inputs, outputs={"exact": exact, "single": single}, device="cpu")
    times = time_path(path, torch.full((len(distance),), 2, dtype=torch.int32), PLANNED).time_s[:, 1]
    ramp = np.minimum(speed, np.sqrt(acceleration * distance)) / acceleration
    law = np.where(distance < corner, 2 * ramp, distance / speed + ramp)
    np.testing.assert_allclose(exact.numpy(), law, rtol=1e-14)
    np.testing.assert_allclose(times.numpy(), exact.numpy(), rtol=1e-7)
    np.testing.assert_allclose(single.numpy(), exact.numpy(), rtol=1e-6)


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
    tight = replace(ARM, settle_position_m=1e-7, payload="unknown", settle_s=1.0)
    e = run(tight)
    assert not e.settled[row] and torch.isnan(e.t_exec_s[row]) and bool(e.valid[row])
    reference_s = float(time_path(p.plan.path, p.plan.length, tight).t_exec_s[row])
    assert int(e.length[row]) == int(np.ceil((reference_s + 1.5) / e.sample_s)) + 1

    batch, strict, usual = problems().batch, copy(default_evaluator()), copy(default_evaluator())
    strict.config, usual.config = (
        EvalConfig(execute=x, thresholds=Thresholds(reach_radius_m=5.0)) for x in (tight, ARM)
    )
    bad, good = (x.score(batch.T_obj_ee, batch.T_world_ee, batch.trials) for x in (strict, usual))
    moved = good.plan_reason == int(PlanReason.OK)
    assert moved.sum() >= 8 and (bad.plan_reason[moved] == int(PlanReason.NOT_SETTLED)).all()
    assert torch.equal(bad.plan_reason[~moved], good.plan_reason[~moved])
    assert (bad.margin[moved, 1] == -torch.inf).all()
    assert not bad.passed[moved, 1].any() and bad.evaluated[moved, 1].all()
    held = moved & good.passed[:, 0]
    assert (bad.outcome[held] == int(Outcome.PLAN)).all() and torch.isnan(bad.t_exec_s[moved]).all()


@pytest.mark.parametrize("sim", ["none", "mujoco"])
def test_a_long_path_is_no_failure_in_any_engine(sim):
    """Some 42 s at a fiftieth of the limits: what takes long under its reference is on time when that ends."""
    p, slow = problems(), ExecConfig(sim=sim, model="arm", scale=0.02)
    rows = torch.nonzero(p.plan.length > 0).flatten()[:2]
    length = torch.zeros_like(p.plan.length)
    length[rows] = p.plan.length[rows]
    e, reference_s = run(slow, length=length), time_path(p.plan.path, length, slow).t_exec_s[rows]
    assert float(reference_s.min()) > 21 and e.settled[rows].all()
    np.testing.assert_allclose(e.t_exec_s[rows].numpy(), reference_s.numpy(), atol=1.0)  # the last millimetre


def test_every_step_of_the_motion_lies_within_the_slack_of_the_recorded_lines():
    p = problems()
    coarse, fine = reference_run(MUJOCO), run(replace(MUJOCO, record_steps=1, dwell_s=0.5))
    lever = default_evaluator().scene.motion_radii.numpy()
    k = 4
    for row in each(torch.nonzero(p.plan.length > 0).flatten().tolist()):
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
    plain = hand_distance(evaluator.scene, p.body_poses, e, active).distance_m
    slacker = replace(e, slack_m=e.slack_m + 1e-3, window_slack_m=e.window_slack_m + 1e-3)
    tighter = hand_distance(evaluator.scene, p.body_poses, slacker, active).distance_m
    moved = ~plain.isnan()
    np.testing.assert_allclose((plain - tighter)[moved].numpy(), 1e-3, atol=2e-5)  # now part by part
    bent = e.path.clone()
    row = int(torch.nonzero(moved & (plain < 0.045) & (plain > 0.003)).flatten()[0])
    k = int(e.length[row]) // 2
    goal = e.path[row, int(e.length[row]) - 1]
    for s in torch.linspace(0.0, 1.0, 60):  # beyond the goal, into the hand: every joint 15 % too far
        bent[row, k] = goal + 0.15 * s * (goal - e.path[row, 0])
        touch = hand_distance(evaluator.scene, p.body_poses, replace(e, path=bent), active)
        worse = touch.distance_m
        if float(worse[row]) < float(plain[row]) - 1e-3:
            break
    assert float(worse[row]) < float(plain[row]) - 1e-3 and int(touch.segment[row]) in (k - 1, k)
    keep = torch.arange(N) != row
    assert torch.equal(worse[keep & moved], plain[keep & moved])


@pytest.mark.parametrize("beside", [0.12, -0.12])
def test_a_motion_that_is_held_up_keeps_its_margin_at_every_step_of_mujoco(beside, monkeypatch):
    """The table stops the gripper and pushes its fingers by millimetres; a hand stands beside it. MuJoCo C in float64."""
    scene, p, states, seen = default_evaluator().scene, problems(), [], SceneModel.fingers
    path, length, row = into_the_table()
    length = torch.where(torch.arange(N) == row, length, 0)
    monkeypatch.setattr(SceneModel, "fingers", lambda self, trial, q: states.append((self, q)) or seen(self, trial, q))
    e = run(BRIEF, path, length)
    model, q = states[-1]
    assert len(q) == 4 * int(e.length[row] - 1) + 1
    assert float(e.slack_m[row]) > 1e-3  # as one part: no bound worth having

    trials = p.batch.trials
    hand = torch.eye(4).repeat(N, 1, 1)  # its palm beside the pads, where they come to rest
    there = ee_pose(scene.robot, q[-1, :6])[:3, 3] + [0, beside, 0.05]
    palm = scene.hands.vertices[trials.hand_index[row]].mean(0)
    hand[row, :3, 3] = torch.from_numpy(there).float() - palm
    body_poses = placed(T_world_hand=hand)
    active = torch.ones(N, dtype=torch.bool)
    margin = float(hand_distance(scene, body_poses, e, active).distance_m[row])

    names = [model.model.geom(i).name for i in range(model.model.ngeom)]
    names = [n for n in names if n.startswith(("robot/", "gripper/")) and not n.endswith("_visual")]
    assert len(names) == len(scene.part_names) - 1
    twin = SimpleNamespace(  # the fingers where they were pushed
        model=model.model, data=mujoco.MjData(model.model), robot=SimpleNamespace(links=["all"]), groups={"all": names}
    )
    stage = SimpleNamespace(hand_index=int(trials.hand_index[row]), T_world_hand=hand[row].double().numpy())
    triangles = oracle.hand_triangles(scene, stage)

    def nearest(postures: np.ndarray) -> tuple[float, int]:
        away = [oracle.MujocoScene.safe_at(twin, triangles, x, cap=0.05) for x in postures]
        return min(away), int(np.argmin(away))

    _, k = nearest(q[::16])
    some = q[max(16 * k - 16, 0) : 16 * k + 17]
    least, _ = nearest(np.concatenate([some, 0.5 * (some[:-1] + some[1:])]))
    print(f"\nmargin {1e3 * margin:.3f} mm, dense sampling {1e3 * least:.3f}, slack {1e3 * float(e.slack_m[row]):.3f}")
    assert 1e-3 < least < 0.049 and least - 1e-3 < margin <= least + 1e-6


@pytest.mark.parametrize(
    "config", [MUJOCO, MJWARP, pytest.param(BRIEF_WARP, marks=pytest.mark.slow)], ids=["mujoco", "mjwarp-arm", "mjwarp"]
)
def test_rows_do_not_depend_on_their_batch(config):
    p, whole = problems(), reference_run(config, FEW)
    found = torch.nonzero(p.plan.length > 0).flatten()[:FEW]
    for rows in (found[:1], found[1:3].flip(0)):
        path, length = p.plan.path[rows], p.plan.length[rows]
        motion = time_path(path, length, config)
        with on_threads(1):
            e = execute(default_evaluator().scene, placed(rows), path, length, motion, config)
        for i, row in each(enumerate(rows.tolist())):
            n = int(whole.length[row])
            assert int(e.length[i]) == n and torch.equal(e.path[i, :n], whole.path[row, :n])
            assert torch.equal(e.slack_m[i], whole.slack_m[row]) and torch.equal(e.settled[i], whole.settled[row])


@pytest.mark.parametrize("engines", [(ARM, MJWARP), (BRIEF, BRIEF_WARP)], ids=["arm", "scene"])
def test_both_engines_move_the_arm_the_same_way(engines):
    c, w = (reference_run(e, FEW) for e in engines)
    assert torch.equal(c.length, w.length) and (c.length > 100).sum() == FEW
    assert float((c.path - w.path).abs().max()) < 5e-6
    np.testing.assert_allclose(c.t_exec_s.numpy(), w.t_exec_s.numpy(), atol=c.sample_s * 1.01)
    assert float((c.slack_m - w.slack_m).abs().max()) < 1e-6
    # joint by joint in one engine, step by step in the other: both are bounds
    less = c.window_slack_m - w.window_slack_m
    assert float(less.min()) > -1e-6 and float(less.max()) < 5e-5
    assert float((c.window_opening_m - w.window_opening_m).abs().max()) < 1e-6
    lag = np.abs(c.path.numpy() - run(PLANNED).path[:, :1].numpy()).max()
    assert lag > (0.1 if engines[0] is ARM else 0.01)  # it moved


@pytest.mark.parametrize("config", [ARM, MJWARP], ids=["mujoco", "mjwarp"])
def test_the_arm_alone_is_stopped_by_the_limits_of_its_joints(config):
    p, joint = problems(), 2
    upper = float(default_evaluator().scene.robot.upper[joint])
    path, row = p.plan.path.clone(), int(torch.nonzero(p.plan.length > 0)[1])
    path[row, 1:] = path[row, 0]
    path[row, 1:, joint] = upper + 0.3
    length = torch.zeros_like(p.plan.length)
    length[row] = 2
    e = run(config, path=path, length=length)
    end = float(e.path[row, int(e.length[row]) - 1, joint])
    assert upper < end < upper + 0.15 and e.valid[row] and not e.settled[row]


def test_the_deviation_bounds_how_far_any_body_was_from_its_plan():
    """Against the robot's and the object's own points, at every recorded time and at times between."""
    p, e, evaluator = problems(), reference_run(MUJOCO), default_evaluator()
    motion = time_path(p.plan.path, p.plan.length, MUJOCO)
    n = e.path.shape[1]
    reference = commands(p.plan.path, p.plan.length, motion, 2 * n, lead=0.0, step_s=e.sample_s / 2)
    robot, rows = evaluator.scene.robot, torch.nonzero(p.plan.length > 0).flatten().tolist()[:5]
    share = []
    for row in rows:
        k = int(e.length[row]) - 1
        q = e.path[row, : k + 1].double().numpy()
        between = np.stack([q[:-1], (q[:-1] + q[1:]) / 2], 1).reshape(-1, 6)
        T = [forward_kinematics(robot, x) for x in (between, reference[row, : 2 * k])]
        o = evaluator.scene.objects[int(p.batch.trials.object_index[row])]
        T_gripper_ee = np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee
        T_gripper_obj = T_gripper_ee @ np.linalg.inv(p.T_obj_ee_attached[row].double().numpy())
        held = T_gripper_obj @ np.c_[o.hull_vertices, np.ones(len(o.hull_vertices))].T
        worst = np.linalg.norm((T[0][:, 7] @ held - T[1][:, 7] @ held)[:, :3], axis=1).max()
        for link in range(7):
            tips = robot.arm.T_link_prim[robot.arm.link == link][:, :3, 3]
            points = np.c_[tips, np.ones(len(tips))].T
            worst = max(worst, np.linalg.norm((T[0][:, link] @ points - T[1][:, link] @ points)[:, :3], axis=1).max())
        assert worst <= float(e.deviation_m[row]) + 1e-6
        share.append(worst / float(e.deviation_m[row]))
        assert 1e-6 < worst < 1e-3 and float(e.deviation_m[row]) < 2e-3
    assert max(share) > 0.3  # it is no bound out of thin air
    certified = (e.deviation_m < p.plan.clearance_m - 1e-4)[rows]
    assert certified.float().mean() > 0.5


@pytest.mark.gpu
def test_a_gpu_moves_the_arm_as_mujoco_does_on_the_cpu():
    b = problems(64).batch
    on_cpu = Evaluator(load_benchmark("r2h-v1"), EvalConfig(execute=MUJOCO)).score(b.T_obj_ee, b.T_world_ee, b.trials)
    on_gpu = (
        Evaluator(load_benchmark("r2h-v1"), device="cuda")
        .score(b.T_obj_ee.cuda(), b.T_world_ee.cuda(), b.trials.to("cuda"))
        .to("cpu")
    )
    same_path = (on_cpu.path_len == on_gpu.path_len) & ((on_cpu.path - on_gpu.path).abs().amax((1, 2)) < 1e-5)
    assert same_path.sum() > 32
    a, g = on_cpu[same_path], on_gpu[same_path]
    assert torch.equal(a.outcome[~a.borderline], g.outcome[~a.borderline])
    np.testing.assert_allclose(a.t_exec_s.numpy(), g.t_exec_s.numpy(), atol=0.017)


def test_only_what_touches_is_simulated_with_the_contacts_of_the_scene_and_all_of_it_keeps_its_bits(monkeypatch):
    path, length, row = into_the_table()
    honest, asked = sim_mujoco.simulate, {True: set[int](), False: set[int]()}

    def counted(job: Job) -> Samples:
        asked[job.contacts] |= set(job.rows.tolist())
        return honest(job)

    monkeypatch.setattr(sim_mujoco, "simulate", counted)
    found = run(BRIEF, path=path, length=length)
    assert asked[False] == set(torch.nonzero(length > 0).flatten().tolist()) and asked[True] == {row}
    monkeypatch.setattr(sim_mujoco, "simulate", lambda job: honest(replace(job, contacts=True)))
    whole = run(BRIEF, path=path, length=length)
    for i in torch.nonzero(length > 0).flatten().tolist():
        assert torch.equal(found.path[i, : int(found.length[i])], whole.path[i, : int(whole.length[i])])
    for name in ("length", "settled", "slack_m", "deviation_m", "window_slack_m", "window_opening_m"):
        assert torch.equal(getattr(found, name), getattr(whole, name)), name
