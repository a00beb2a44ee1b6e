"""Pick: the way to the grasp on the table, closing, the way up. Against MuJoCo C and float64 surfaces on sampled ways."""

from collections import Counter
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
import torch
from oracle import CLASSES
from pick_twin import PickTwin, RestingWorld
from planning_twins import jacobian_ik
from problems import kinematic_evaluator
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.base import se3
from r2h_batch.base.launch import over_trials
from r2h_batch.judge.grasp import close_gripper
from r2h_batch.judge.ik import solve_ik
from r2h_batch.judge.pick import ROWS, Picked, PickReason, picked
from r2h_batch.judge.plan import path_clearances
from r2h_batch.judge.straight_way import MOST_OFF_M, STEPS, resampled, straight_ways
from r2h_batch.kernels.plan.line import follow_lines
from r2h_batch.observe import moments
from r2h_batch.report.compare.stored import stored_rows
from r2h_batch.runs.store import load_run
from r2h_batch.scene.resting import with_resting, without
from r2h_batch.scene.robot import ee_pose, gripper_primitives_at
from r2h_batch.types import CollidingPair


@cache
def scene():
    return kinematic_evaluator("r2h-v2").scene


@cache
def asked(first, n):
    """Stored grasps of r2h-v2, n of each method: where their objects rest, and the trials."""
    folder = next(f for f in stored_rows() if f.name == "r2h-v2")
    run = load_run(folder)
    ids, grasps = [], []
    for e in run.entries:
        rows = run.poses(e.name).slice(first, n).to_pylist()
        ids += [r["trial_id"] for r in rows]
        grasps += [r["T_obj_ee"] for r in rows]
    trials = load_benchmark("r2h-v2").trials_with_ids(torch.tensor(ids))
    return torch.tensor(grasps).reshape(-1, 4, 4), moments(scene(), trials), trials


@cache
def found(first, n):
    return picked(scene(), *asked(first, n))


def row_of(result, i):
    return Picked(*(getattr(result, f.name)[i : i + 1] for f in fields(Picked)))


def twin_of(first, n, i):
    T_obj_ee, T_world_obj, trials = asked(first, n)
    return PickTwin(scene(), trials[i : i + 1], T_obj_ee[i], T_world_obj[i], row_of(found(first, n), i))


@pytest.mark.parametrize("of_each_pair", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_verdicts_and_margins_are_those_of_sampled_ways(of_each_pair):
    """One row of each reason, the last that passes too; slow: of each reason and pair that decides."""
    result = found(0, 14)
    seen = {}
    for i in range(len(result.reason)):
        seen.setdefault((int(result.reason[i]), int(result.pair[i]) if of_each_pair else -1), i)
    seen[int(PickReason.OK), -2] = int(result.picked.nonzero()[-1])
    assert {r for r, _ in seen} >= {
        PickReason.OK,
        PickReason.OUT_OF_REACH,
        PickReason.GRASP_COLLIDES,
        PickReason.APPROACH_COLLIDES,
    }
    # a finger or the palm beside the object decides some that pass
    beside = result.picked & (result.pair == int(CollidingPair.OBJECT_ROBOT))
    assert (beside & (result.body >= len(scene().tables.arm_order))).sum() > 5
    for i in each(seen.values()):
        assert twin_of(0, 14, i).wrong() == "", i


def test_no_branch_of_a_grasp_that_fails_by_its_branches_is_free():
    """All that follow, at the closest spacing, on sampled postures: MuJoCo C meets something on each way in or up."""
    result, s = found(0, 14), scene()
    fails = sum(result.reason == int(k) for k in (PickReason.APPROACH_COLLIDES, PickReason.LIFT_COLLIDES)) > 0
    arm = ~torch.isin(result.pair, torch.tensor([int(CollidingPair.OBJECT_ROBOT)])) & fails
    looked_at = 0
    for i in each(arm.nonzero().flatten().tolist()):
        twin, T = twin_of(0, 14, i), result.T_world_ee[i : i + 1]
        if twin.entered() < 0:
            continue
        ik = solve_ik(T, robot=s.robot, home=s.config.workplace.home_q)
        ways = straight_ways(s, T, ik.q, ik.valid, STEPS[-1])
        for slot in ways.whole[0].nonzero().flatten().tolist():
            twin.ways = tuple(x[0, slot].double().numpy() for x in (ways.way_in, ways.way_up))
            assert min(twin.approach(), twin.lift()) < 2e-4, (i, slot)
            looked_at += 1
    assert looked_at > 3


@pytest.mark.check
def test_a_way_has_the_same_straight_lines_at_any_number_of_waypoints():
    rng = np.random.default_rng(1)
    for steps in each(STEPS):
        path = torch.tensor(rng.uniform(-2, 2, (3, steps + 1, 6)), dtype=torch.float32)
        more, n = resampled(path), STEPS[-1] // steps
        assert more.shape == (3, STEPS[-1] + 1, 6) and torch.equal(more[:, ::n], path)
        at = np.linspace(0, steps, STEPS[-1] + 1)
        for j in range(6):
            true = np.interp(at, np.arange(steps + 1), path[0, :, j].double().numpy())
            assert np.allclose(more[0, :, j].numpy(), true, atol=1e-6)


def test_no_half_way_between_two_waypoints_is_farther_from_the_line_than_is_said():
    """Both ways, in float64. The turn of the gripper counts on top, so that less is never said."""
    s, result = scene(), found(0, 14)
    T = result.T_world_ee[result.reason != int(PickReason.OUT_OF_REACH)].contiguous()
    ik = solve_ik(T, robot=s.robot, home=s.config.workplace.home_q)
    ways = straight_ways(s, T, ik.q, ik.valid, STEPS[0])
    row, slot = ways.whole.nonzero(as_tuple=True)
    apart = []
    for path in (ways.way_in[row, slot], ways.way_up[row, slot]):
        q = path.double()
        ends = ee_pose(s.robot, q[:, [0, -1]].reshape(-1, 6).numpy())[..., :3, 3].reshape(-1, 2, 3)
        middle = ee_pose(s.robot, (0.5 * (q[:, 1:] + q[:, :-1])).reshape(-1, 6).numpy())[..., :3, 3]
        share = (np.arange(STEPS[0]) + 0.5)[:, None] / STEPS[0]
        line = ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])
        apart.append(np.linalg.norm(middle.reshape(line.shape) - line, axis=-1).max(1))
    said = ways.off_m[row, slot].double().numpy()
    assert len(said) > 20 and (np.maximum(*apart) <= said + 5e-6).all()
    assert (apart[1] > apart[0] + 1e-5).any() and (apart[0] > apart[1] + 1e-5).any()


def test_a_branch_that_leaves_the_line_at_a_wide_spacing_follows_at_a_closer_one():
    s, result = scene(), found(0, 14)
    T = result.T_world_ee[result.reason != int(PickReason.OUT_OF_REACH)].contiguous()
    ik = solve_ik(T, robot=s.robot, home=s.config.workplace.home_q)
    wide, middle, close = (straight_ways(s, T, ik.q, ik.valid, steps) for steps in STEPS)
    assert (wide.whole <= middle.whole).all() and (middle.whole <= close.whole).all()
    assert wide.whole.sum() < middle.whole.sum() < close.whole.sum()
    for ways in each((wide, middle, close)):
        assert ways.off_m[ways.whole].max() <= MOST_OFF_M
    assert close.off_m[wide.whole].max() < wide.off_m[wide.whole].max()
    got = result.picked.nonzero().flatten()
    assert (result.off_m[got] <= MOST_OFF_M).all()


@pytest.mark.slow
def test_verdicts_and_margins_of_eighty_rows_are_those_of_sampled_ways():
    result = found(14, 14)
    assert Counter(result.picked.tolist())[True] >= 15
    for i in each(range(len(result.reason))):
        assert twin_of(14, 14, i).wrong() == "", i


def test_a_row_has_the_same_bits_alone_in_any_batch_and_order():
    T_obj_ee, T_world_obj, trials = asked(0, 14)
    whole, n = found(0, 14), len(trials)
    order = torch.from_numpy(np.random.default_rng(0).permutation(n))
    again = picked(scene(), T_obj_ee[order], T_world_obj[order], trials[order])
    passes = int(whole.picked.nonzero()[0])
    one = slice(passes, passes + 1)
    alone = picked(scene(), T_obj_ee[one], T_world_obj[one], trials[one])
    over = torch.arange(ROWS + 8) % n
    many = picked(scene(), T_obj_ee[over], T_world_obj[over], trials[over])
    assert len(many.picked) > ROWS
    for f in each(fields(Picked)):
        a = getattr(whole, f.name)
        for b, rows in ((again, order), (alone, torch.tensor([passes])), (many, over)):
            x, y = (np.ascontiguousarray(t.numpy()) for t in (a[rows], getattr(b, f.name)))
            assert x.tobytes() == y.tobytes(), f.name


def test_an_object_that_rests_is_as_far_from_the_robot_as_mujoco_says():
    s, (T_obj_ee, T_world_obj, trials) = scene(), asked(0, 14)
    rows = torch.arange(0, 36)
    open_m = torch.full((36,), s.robot.open_gap_m)
    poses = s.body_poses(
        trials.object_index[rows], trials.hand_index[rows], T_obj_ee[rows], trials.T_world_hand[rows], open_m
    )
    alone = with_resting(s, without(s, poses, attached=True, table=True, others=True), T_world_obj[rows])
    q = found(0, 14).way_in[rows][:, :1].nan_to_num(nan=0.3).contiguous()
    one = torch.ones(36, dtype=torch.int32)
    whole, pair, body = path_clearances(s, alone, q, one)
    no_gripper = with_resting(
        s, without(s, poses, attached=True, table=True, others=True, gripper=True), T_world_obj[rows]
    )
    arm, _, arm_body = path_clearances(s, no_gripper, q, one)
    near, met = torch.nonzero((whole < 0.05) & (whole > 0)).flatten().tolist(), set()
    for i in each(near):
        twin = twin_of(0, 14, i)
        world = twin._world(s.robot.open_gap_m, kind=RestingWorld)
        true = world.clearances(q[i, 0].double().numpy()).distance[CLASSES[0]]
        assert float(whole[i]) == pytest.approx(true, abs=3e-5) and int(pair[i]) == CollidingPair.HAND
        of_gripper = int(body[i]) >= len(s.tables.arm_order)
        assert int(arm_body[i]) < len(s.tables.arm_order)
        assert arm[i] > whole[i] if of_gripper else arm[i] == whole[i]
        met.add(of_gripper)
    assert met == {True, False}


def test_a_grasp_that_pushes_the_object_into_the_table_fails_by_what_the_pads_do_not_give():
    """The object stands before the robot, the closing axis upright, the pads' middle to either side of the object's: closing
    lowers it or lifts it."""
    s, (T_obj_ee, _, trials) = scene(), asked(0, 14)
    T_world_ee = torch.eye(4)
    T_world_ee[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    T_world_ee[:3, 3] = torch.tensor([0.5, -0.25, 0.35])
    rows = (found(0, 14).picked & (found(0, 14).margin_m > 0.006)).nonzero().flatten()[:4]
    squeeze = s.config.thresholds.pad_squeeze_m
    reasons = set()
    for off in each((-0.004, 0.0, 0.004)):
        grasp = T_obj_ee[rows].clone()
        grasp[:, :3, 3] += off * grasp[:, :3, 1]
        closed = close_gripper(s.grasp_tables, grasp.contiguous(), trials.object_index[rows])
        result = picked(s, grasp, T_world_ee @ se3.inverse(grasp), trials[rows])
        for i in each(range(len(rows))):
            reason, room = PickReason(int(result.reason[i])), squeeze - float(closed.shift_m[i])
            reasons.add(reason)
            if reason == PickReason.CLOSING_COLLIDES:
                assert int(result.pair[i]) == CollidingPair.OBJECT_TABLE
                assert float(result.margin_m[i]) == pytest.approx(room, abs=1e-5) and room < 0
            elif reason == PickReason.OK:
                assert room >= 0
    assert reasons >= {PickReason.CLOSING_COLLIDES, PickReason.OK}, reasons


def test_a_person_in_the_way_makes_it_fail():
    s, (T_obj_ee, T_world_obj, trials) = scene(), asked(0, 14)
    i = int(found(0, 14).picked.nonzero()[0])
    one = trials[i : i + 1]
    T, first = found(0, 14).T_world_ee[i], len(s.tables.arm_order)
    # across the gripper, or behind it where the arm is
    for back, reason in each(((0.10, PickReason.GRASP_COLLIDES), (0.24, PickReason.APPROACH_COLLIDES))):
        receiver = one.receiver.clone()
        middle = T[:3, 3] - back * T[:3, 2]
        receiver[0, 1, :3], receiver[0, 2, :3] = middle - 0.02 * T[:3, 0], middle + 0.02 * T[:3, 0]
        receiver[0, 1, 3] = 0.01
        row = picked(s, T_obj_ee[i : i + 1], T_world_obj[i : i + 1], replace(one, receiver=receiver))
        assert PickReason(int(row.reason)) == reason and float(row.margin_m) < 0
        if reason == PickReason.GRASP_COLLIDES:
            assert int(row.pair) == CollidingPair.HAND and first <= int(row.body) < len(s.part_names) - 1


def tip_z(robot, gap_m):
    """How far the fingers reach along z of the ee, m."""
    at = gripper_primitives_at(robot, gap_m)
    return max(T[2, 3] + np.abs(T[2, :3]) @ size for T, size in zip(at, robot.gripper.size, strict=True))


def with_forearm(trial, T_world_ee, ends, radius):
    """The trial with a thin forearm between two points of the ee's frame; the upper arm comes from beyond."""
    receiver, R, p = trial.receiver.clone(), T_world_ee[:3, :3], T_world_ee[:3, 3]
    receiver[0, 1, :3], receiver[0, 2, :3] = (R @ torch.tensor(x, dtype=torch.float32) + p for x in ends)
    receiver[0, 0, :3] = receiver[0, 1, :3] + 0.25 * T_world_ee[:3, 2]
    receiver[0, :2, 3] = radius
    return replace(trial, receiver=receiver)


@pytest.mark.parametrize(
    "across", [pytest.param(True, marks=pytest.mark.whole(part="judge")), False], ids=["across", "beside"]
)
def test_a_person_before_closing_fingers_counts(across):
    """A forearm before the open fingers' tips, which go 13 mm along z as they close: across both, or along one of them that is
    past it when it has closed."""
    s, (T_obj_ee, T_world_obj, trials) = scene(), asked(0, 14)
    result, robot = found(0, 14), scene().robot
    if across:
        radius = 0.01
        z = tip_z(robot, robot.open_gap_m) + radius + 0.003
        ends = (0.0, -0.06, z), (0.0, 0.06, z)
    else:
        radius, y = 0.005, 0.034
        z = tip_z(robot, 2 * y) + radius - 0.001
        ends = (-0.06, y, z), (0.06, y, z)
    closed = close_gripper(s.grasp_tables, T_obj_ee.contiguous(), trials.object_index)
    rows = result.picked & (across | (closed.opening_m < 0.025))
    reasons = []
    for i in each(rows.nonzero().flatten().tolist()[:6]):
        before = with_forearm(trials[i : i + 1], result.T_world_ee[i], ends, radius)
        row = picked(s, T_obj_ee[i : i + 1], T_world_obj[i : i + 1], before)
        reasons.append(PickReason(int(row.reason)))
        if reasons[-1] == PickReason.CLOSING_COLLIDES:
            assert int(row.pair) == CollidingPair.HAND and -0.012 < float(row.margin_m) < 0
            assert PickTwin(s, before, T_obj_ee[i], T_world_obj[i], row).wrong() == ""
    assert reasons.count(PickReason.CLOSING_COLLIDES) > 3, reasons


def test_a_person_above_makes_the_way_up_fail_where_the_way_in_is_free():
    """A thin forearm lies across, above the gripper at the grasp of those that come from the side."""
    s, (T_obj_ee, T_world_obj, trials) = scene(), asked(0, 14)
    result = found(0, 14)
    flat = result.picked & (result.T_world_ee[:, 2, 2].abs() < 0.7)
    reasons = []
    for i in each(flat.nonzero().flatten().tolist()):
        T, one = result.T_world_ee[i], trials[i : i + 1]
        receiver = one.receiver.clone()
        middle = T[:3, 3] - 0.06 * T[:3, 2] + torch.tensor([0.0, 0.0, 0.13])
        receiver[0, 1, :3], receiver[0, 2, :3] = middle - 0.05 * T[:3, 1], middle + 0.05 * T[:3, 1]
        receiver[0, 1, 3] = 0.01
        rest = T_world_obj[i : i + 1]
        row = picked(s, T_obj_ee[i : i + 1], rest, replace(one, receiver=receiver))
        reasons.append(PickReason(int(row.reason)))
        twin = PickTwin(s, replace(one, receiver=receiver), T_obj_ee[i], rest[0], row)
        if row.picked:
            assert twin.lift() > 0
        if reasons[-1] == PickReason.LIFT_COLLIDES:
            assert not row.picked and float(row.margin_m) <= 0
            assert twin.lift() < 0 < twin.approach()
    assert PickReason.LIFT_COLLIDES in reasons, reasons


def test_the_path_ends_where_the_way_in_begins_and_ways_are_ten_centimetres():
    result = found(0, 14)
    home = np.array(scene().config.workplace.home_q, np.float32)
    for i in each(result.picked.nonzero().flatten().tolist()):
        assert np.array_equal(result.path[i, 0].numpy(), home)
        assert torch.equal(result.path[i, int(result.length[i]) - 1], result.way_in[i, 0])
        assert torch.allclose(result.way_in[i, -1], result.way_up[i, -1])
        twin = twin_of(0, 14, i)
        ends = [twin.open.ee(w[i, 0].double().numpy())[:3, 3] for w in (result.way_in, result.way_up)]
        grasp = result.T_world_ee[i].double().numpy()
        assert np.allclose(ends[0], grasp[:3, 3] - 0.1 * grasp[:3, 2], atol=2e-5)
        assert np.allclose(ends[1], grasp[:3, 3] + [0, 0, 0.1], atol=2e-5)


def test_rows_that_are_no_poses_are_not_evaluated_and_leave_the_others_alone():
    T_obj_ee, T_world_obj, trials = (x[:6] for x in asked(0, 14))
    broken = T_obj_ee.clone()
    broken[2] = torch.nan
    row = picked(scene(), broken, T_world_obj, trials)
    assert PickReason(int(row.reason[2])) == PickReason.NOT_EVALUATED and not row.picked[2] and row.margin_m[2].isnan()
    keep = torch.tensor([0, 1, 3, 4, 5])
    assert torch.equal(row.reason[keep], found(0, 14).reason[:6][keep])
    with pytest.raises(ValueError, match="T_world_obj has shape"):
        picked(scene(), T_obj_ee, T_world_obj[:2], trials)


def test_unreachable_grasps_are_told_by_how_far_the_gripper_stays_away():
    T_obj_ee, T_world_obj, trials = (x[:4] for x in asked(0, 14))
    far = T_world_obj.clone()
    far[:, :3, 3] += torch.tensor([2.0, 0.0, 0.0])
    row = picked(scene(), T_obj_ee, far, trials)
    for i in each(range(4)):
        assert PickReason(int(row.reason[i])) == PickReason.OUT_OF_REACH
        assert jacobian_ik(scene().robot, row.T_world_ee[i].double().numpy()) is None
        assert -2.5 < float(row.margin_m[i]) < -0.5


def followed(q, valid, T, *, most_turn=0.5, most_off=10.0):
    """`follow_lines` of branches (1, K, 8, 6) at waypoints (1, K, 4, 4): path (8, K, 6), followed (8,), off (8,)."""
    s, k = scene(), q.shape[1]
    sizes = {"path": (8, k, 6), "followed": 8, "off": 8}
    made = over_trials(s.sized(follow_lines), 1, s.device, sizes=sizes)(
        most_turn=most_turn, most_off=most_off, lever=0.2, world=s.world, tool=s.tool, q=q, valid=valid, T_world_ee=T
    )
    return made["path"][0], made["followed"][0], made["off"][0]


@pytest.mark.check
def test_a_line_is_followed_from_branch_to_nearest_branch_at_any_turn_within_limits():
    k, rng = 5, np.random.default_rng(0)
    start = torch.tensor(rng.uniform(-1, 1, (8, 6)), dtype=torch.float32)
    steps = torch.tensor(rng.uniform(-0.05, 0.05, (k, 8, 6)), dtype=torch.float32).cumsum(0)
    start[1], steps[:, 1] = start[0], steps[:, 0]
    start[1, 0] += 0.2  # two branches side by side
    true = start + steps
    true[:, :, 5] += 2 * np.pi - 1.3
    true[:, 3, 5] = 2 * np.pi - 0.07 + 0.04 * torch.arange(k)  # beyond the upper limit of 2 pi from the third on
    mixed = true.clone()
    for i in each(range(k)):  # slots change places, joints turn round
        mixed[i] = true[i, torch.from_numpy(rng.permutation(8))] if i else true[i]
        mixed[i, :, 5] -= 2 * np.pi * (i % 2)
    T = torch.eye(4).repeat(1, k, 1, 1)
    valid = torch.ones((1, k, 8), dtype=torch.bool)
    upper = float(scene().world.upper.numpy()[5])
    path, count, _ = followed(mixed[None].contiguous(), valid, T)
    kinds = set()
    for slot in each(range(8)):
        within = (true[:, slot, 5] <= upper).to(torch.int8)
        most = k if within[1:].all() else 1 + int(within[1:].argmin())
        kinds.add(most == k)
        assert int(count[slot]) == most
        own = path[slot].flip(0)[:most]
        assert torch.allclose(own, true[:most, slot], atol=1e-5)
    assert kinds == {True, False}
    valid[0, 3] = False
    assert followed(mixed[None].contiguous(), valid, T)[1].max() == 3
    assert followed(mixed[None].contiguous(), ~valid, T)[1].max() == 0
    valid[0, 3] = True
    assert followed(mixed[None].contiguous(), valid, T, most_turn=0.01)[1].max() < k


@pytest.mark.check
def test_a_branch_that_takes_the_gripper_off_the_line_is_not_followed():
    """Joint 1 turns by 0.1 rad: half way the ee is r (1 - cos 0.05) outside the chord, and turned as at neither end."""
    q = torch.tensor(scene().config.workplace.home_q, dtype=torch.float32).expand(1, 2, 8, 6).clone()
    q[0, 1, :, 0] += 0.1
    ends = torch.from_numpy(ee_pose(scene().robot, q[0, :, 0].double().numpy())).float()
    T = ends.clone()
    middle = ee_pose(scene().robot, q[0, :, 0].double().numpy().mean(0))
    T[1, :3, :3] = torch.from_numpy(middle[:3, :3]).float()
    valid = torch.ones((1, 2, 8), dtype=torch.bool)
    bow = np.linalg.norm(middle[:3, 3] - ends[:, :3, 3].double().numpy().mean(0))
    _, count, off = followed(q, valid, T[None].contiguous())
    assert off.numpy() == pytest.approx(bow, abs=2e-6) and bow > 4e-4 and (count == 2).all()
    assert (followed(q, valid, T[None].contiguous(), most_off=0.9 * bow)[1] == 1).all()
    turned = followed(q, valid, ends[None].contiguous())[2].numpy()
    assert turned == pytest.approx(bow + 0.2 * np.sin(0.05), abs=2e-6)


def test_a_hand_near_home_decides_the_margin_of_the_way_from_there():
    """Nothing else of these rows is as near: ways in, closing and lift happen elsewhere."""
    T_obj_ee, T_world_obj, trials = asked(0, 14)
    result = found(0, 14)
    rows = torch.nonzero(result.picked & (result.margin_m > 0.009)).flatten()[:3]
    home = torch.tensor(scene().config.workplace.home_q)[None]
    for i in each(rows.tolist()):
        one, rest = trials[i : i + 1], T_world_obj[i : i + 1]
        ee = torch.from_numpy(ee_pose(scene().robot, home.double().numpy())[0, :3, 3]).float()
        low, high = 0.05, 0.9
        for _ in range(12):  # above the gripper at home, as far as leaves 4 mm
            middle, there = (low + high) / 2, one.T_world_hand.clone()
            there[:, :3, 3] = ee + torch.tensor([0.0, 0.0, middle])
            poses = scene().body_poses(
                one.object_index, one.hand_index, T_obj_ee[i : i + 1], there, torch.full((1,), scene().robot.open_gap_m)
            )
            alone = without(scene(), poses, attached=True, table=True)
            kept = float(path_clearances(scene(), alone, home[:, None], torch.ones(1, dtype=torch.int32))[0])
            low, high = (middle, high) if kept < 0.004 else (low, middle)
        moved = replace(one, T_world_hand=there)
        again = picked(scene(), T_obj_ee[i : i + 1], rest, moved)
        assert bool(again.picked) and 0.0 < float(again.margin_m) <= kept + 5e-4 < 0.008
