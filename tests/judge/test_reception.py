"""Reception: the arm found again from how persons are drawn, and every step against python-fcl's distances."""

from dataclasses import replace
from functools import cache
from itertools import combinations

import fcl
import numpy as np
import pytest
import torch
import warp as wp
from fcl_twin import distance, hull, primitive
from oracle import head_of
from problems import kinematic_evaluator
from rounds import each
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation, Slerp
from usual_grips import usual_grips

from r2h_batch import load_benchmark
from r2h_batch.base.launch import launch_trials, new_outputs
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge import reception as judge
from r2h_batch.judge.grasp import gripper_poses
from r2h_batch.judge.reception import ANGLES, STEPS, chance_of_one, reception, rula
from r2h_batch.kernels.judge import reception as kernels
from r2h_batch.kernels.receiver.grasps import Receiving
from r2h_batch.methods import oracle
from r2h_batch.scene.hand import HandModel
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.person import heads_of
from r2h_batch.scene.robot import ShapeKind, ee_pose, forward_kinematics
from r2h_batch.trials.draw.receivers import arm_axes
from r2h_batch.trials.holding import held_out
from r2h_batch.trials.holding.held_out import (
    CONE_EDGES,
    FRICTION,
    GRAVITY,
    friction_edges,
    grip_forces,
    load_held_out,
    revolution_axis,
)
from r2h_batch.trials.holding.receiving import load_receiving
from r2h_batch.verdicts import MarginKind, Room

RANGES = {"elbow": (0, 150), "supination": (-80, 80), "wrist_flexion": (-70, 80), "ulnar_deviation": (-20, 30)}


@cache
def evaluator():
    return kinematic_evaluator("r2h-v1")


@pytest.fixture(scope="module")
def scores():
    trials = load_benchmark("r2h-v1").trials(16)
    answer = oracle.predict(trials, evaluator().scene, evaluator=evaluator())
    return evaluator().score(answer.T_obj_ee, answer.T_world_ee, trials)


@pytest.fixture(scope="module")
def found(scores):
    return reception(scores, margins=True)


@pytest.fixture(scope="module")
def steps(scores):
    """The batch, its arms and what each step says before the steps are counted together."""
    batch = judge._batch_of(scores)
    arms = judge._arms(batch, judge.LEANS_DEG)
    passes = torch.zeros((*arms["effort"].shape, len(STEPS)), dtype=torch.bool)
    passes[..., 0] = arms["effort"] >= 0
    way, _ = judge._come(batch, arms, passes)
    judge._beside_robot(batch, arms, passes)
    judge._let_go(batch, arms, passes)
    return batch, arms, passes, way


def test_turn_and_travel_are_those_of_the_hand_from_how_it_waits(scores, found):
    """From the poses of the hand: scipy's angle between them, and the way of the wrist joint."""
    rows = found.received.nonzero().flatten()
    trials = scores.inputs.trials[rows]
    before, after = (T.double().numpy() for T in (trials.T_world_hand, found.T_world_hand[rows]))
    turned = Rotation.from_matrix(after[:, :3, :3] @ before[:, :3, :3].transpose(0, 2, 1)).magnitude()
    assert len(rows) >= 4 and np.abs(np.degrees(turned) - found.turn_deg[rows].numpy()).max() < 0.05
    wrist = evaluator().scene.hands.joints[trials.hand_index.long(), 0].double().numpy()
    ends = [np.einsum("nij,nj->ni", T[:, :3, :3], wrist) + T[:, :3, 3] for T in (before, after)]
    assert np.abs(np.linalg.norm(ends[1] - ends[0], axis=1) - found.travel_m[rows].numpy()).max() < 1e-4
    assert found.turn_deg[rows].max() > 20 and found.travel_m[rows].max() > 0.05
    assert found.turn_deg[~found.received].isnan().all() and found.travel_m[~found.received].isnan().all()


# --- the arm ---------------------------------------------------------------------------------------------------------


def waiting(trials):
    """The waiting hands as grasps of an object that lies at the world's origin: one for each trial."""
    scene, n = evaluator().scene, len(trials)
    hands = scene.hands.directions[trials.hand_index.long()]
    R = trials.T_world_hand[:, :3, :3].double()
    vectors = [trials.receiver[:, 2, :3], *((R @ hands)[:, :, k].float() for k in (0, 1))]
    table = Receiving()
    for name, x in zip(("wrist", "along", "normal"), vectors, strict=True):
        setattr(table, name, wp.from_torch(x.contiguous(), dtype=wp.vec3))
    table.R = wp.from_torch(R.float().contiguous(), dtype=wp.mat33)
    table.axis, table.axis_point = (wp.zeros(1, dtype=wp.vec3) for _ in range(2))
    outwards = torch.where(scene.hands.set.side[trials.hand_index.long()] == 0, -1.0, 1.0)
    row, count, of = torch.arange(n, dtype=torch.int32), *torch.tensor([[1], [0]], dtype=torch.int32).expand(2, n)
    inputs = {
        "grasps": table, "lean": torch.zeros(1), "row": row, "count": count.contiguous(), "object": of.contiguous(),
        "outwards": outwards, "T_world_obj": torch.eye(4).repeat(n, 1, 1), "T_world_hand": trials.T_world_hand,
        "receiver": trials.receiver,
    }  # fmt: skip
    return inputs, vectors, outwards


def searched(inputs):
    made = new_outputs(kernels.reach_with_arm, len(inputs["row"]), "cpu", effort=2, turn=2, angles=2, elbow=2)
    launch_trials(kernels.reach_with_arm, len(inputs["row"]), inputs=inputs, outputs=made, device="cpu", width=2)
    return made["effort"][:, 0].double().numpy(), made["angles"][:, 0].double().numpy()


def effort_twin(trials, vectors, outwards, i):
    """Least effort of trial i's waiting hand over the swivels, in float64, from the equations of docs/r2h_v3.md."""
    body = trials.receiver[i].double().numpy()
    shoulder, elbow, wrist = body[0, :3], body[1, :3], body[2, :3]
    ahead = np.array([body[3, 3], body[4, 3], 0.0])
    out = float(outwards[i]) * np.array([-ahead[1], ahead[0], 0.0])
    a, n = (v[i].double().numpy() for v in vectors[1:])
    upper, lower = np.linalg.norm(elbow - shoulder), np.linalg.norm(wrist - elbow)
    to = wrist - shoulder
    r = np.linalg.norm(to)
    to /= r
    along = (upper**2 - lower**2 + r**2) / (2 * r)
    down = np.array([0, 0, -1.0])
    hanging = down - (down @ to) * to
    hanging /= np.linalg.norm(hanging)
    best = np.inf
    for swivel in np.radians(np.arange(-30, 130, 10)):
        way = np.cos(swivel) * hanging + np.sin(swivel) * float(outwards[i]) * np.cross(to, hanging)
        e = shoulder + along * to + np.sqrt(upper**2 - along**2) * way
        inside = [
            (abs((p - body[3, :3]) @ axis) < half).item()
            for p in np.linspace(e, wrist, 9)
            for axis, half in zip((ahead, out, [0, 0, 1]), body[4, :3], strict=True)
        ]
        if np.array(inside).reshape(9, 3).all(1).any():
            continue
        f, t, inward = (x[0] for x in arm_axes(shoulder[None], e[None], wrist[None], np.array([float(outwards[i])])))
        turn = np.arctan2(n @ t, n @ inward)
        flexion = -np.arcsin(n @ f)
        flat = f - (f @ n) * n
        deviation = np.arctan2(-a @ (np.cos(turn) * t - np.sin(turn) * inward), a @ flat / np.linalg.norm(flat))
        u = (e - shoulder) / upper
        deg = np.degrees
        bend = deg(np.arccos(u @ f))
        angles = deg(np.arctan2(u @ ahead, -u[2])), deg(np.arcsin(u @ out)), bend, *deg([turn, flexion, deviation])
        if not all(low <= x <= high for x, (low, high) in zip(angles[2:], RANGES.values(), strict=True)):
            continue
        scale = [(180, 60), (180, 75), None, (80, 80), (80, 70), (30, 20)]
        terms = [x / (s[0] if x >= 0 else s[1]) for x, s in zip(angles, scale, strict=True) if s] + [(bend - 80) / 75]
        best = min(best, sum(x * x for x in terms) / 6)
    return best


def test_the_arms_that_persons_were_drawn_with_are_found_and_have_the_twins_effort():
    trials = load_benchmark("r2h-v1").trials(150)
    inputs, vectors, outwards = waiting(trials)
    effort, angles = searched(inputs)
    assert (effort >= 0).all()
    for name, (low, high) in RANGES.items():
        x = angles[:, ANGLES.index(name)]
        assert low <= x.min() and x.max() <= high
    twin = np.array([effort_twin(trials, vectors, outwards, i) for i in range(0, 300, 12)])
    assert np.abs(effort[::12] - twin).max() < 1e-4


# --- bodies ----------------------------------------------------------------------------------------------------------


def turned_object(batch, trial, turn):
    held_out, obj = batch.grasps.held_out, int(batch.of_trial["object"][trial])
    axis, point = (x[obj].double().numpy() for x in (held_out.axis, held_out.axis_point))
    T = np.eye(4)
    if axis.any():
        T[:3, :3] = Rotation.from_rotvec(float(turn) * axis).as_matrix()
        T[:3, 3] = point - T[:3, :3] @ point
    return batch.of_trial["T_world_obj"][trial].double().numpy() @ T


def hand_pieces(batch, row, T):
    model = evaluator().scene.hands.model
    skin = batch.grasps.held_out.grasps[row : row + 1].vertices[0].double().numpy()
    return [(skin @ T[:3, :3].T + T[:3, 3])[ids.numpy()] for ids in model.pieces]


def gripper_bodies(batch, trial, opening, T_ee=None):
    """The gripper's primitives in the world, with the ee where the trial presents the object unless it is given."""
    robot = evaluator().scene.robot
    R, p = (x[0].double().numpy() for x in gripper_poses(robot, torch.tensor([opening], dtype=torch.float32)))
    if T_ee is None:
        T_ee = (
            batch.of_trial["T_world_obj"][trial].double().numpy() @ batch.of_trial["attached"][trial].double().numpy()
        )
    T = np.tile(np.eye(4), (len(p), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p
    return [primitive(*body) for body in zip(robot.gripper.kind, robot.gripper.size, T_ee @ T, strict=True)]


def least(a, b):
    """Least distance of two groups of bodies, 0 where any two meet."""
    return min(distance(x, y) for x in a for y in b)


def gap_to_gripper(batch, trial, row, turn, opening, shift=(0, 0, 0)):
    pieces = hand_pieces(batch, row, turned_object(batch, trial, turn))
    return least(gripper_bodies(batch, trial, opening), [hull(p + np.asarray(shift)) for p in pieces])


def arm_bodies(receiver, lean_deg, elbow, wrist, shoulder=None):
    """Forearm, upper arm, torso and head in the world; the shoulder of that lean unless it is given."""
    body = receiver.double().numpy()
    ahead, up = np.array([body[3, 3], body[4, 3], 0.0]), np.array([0, 0, 1.0])
    left = np.cross(up, ahead)
    lean = Rotation.from_rotvec(np.radians(lean_deg) * left)
    hip = body[3, :3] - body[4, 2] * up
    shoulder = hip + lean.apply(body[0, :3] - hip) if shoulder is None else shoulder
    low, high, radius = head_of(body)
    low, high = (hip + lean.apply(x - hip) for x in (low, high))
    arm = []
    for a, b, r in ((elbow, wrist, body[1, 3]), (shoulder, elbow, body[0, 3]), (low, high, radius)):
        z = (b - a) / np.linalg.norm(b - a)
        x = np.cross([0, 1.0, 0] if abs(z[0]) > 0.7 else [1.0, 0, 0], z)
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], 1), (a + b) / 2
        arm.append(primitive(ShapeKind.CAPSULE, [r, np.linalg.norm(b - a) / 2], T))
    T = np.eye(4)
    T[:3, :3] = lean.as_matrix() @ np.stack([ahead, left, up], 1)
    T[:3, 3] = hip + lean.apply(body[4, 2] * up)
    return [*arm[:2], primitive(ShapeKind.BOX, body[4, :3], T), arm[2]]


def gap_to_robot(batch, trial, q, arm):
    """Least distance of the robot's primitives at posture q to a person's bodies, and of the object to the head."""
    robot = evaluator().scene.robot
    T = forward_kinematics(robot, q)[robot.arm.link] @ robot.arm.T_link_prim
    links = [primitive(*body) for body in zip(robot.arm.kind, robot.arm.size, T, strict=True)]
    opening = float(batch.of_trial["opening"][trial])
    T_ee = ee_pose(robot, q)
    T_obj = T_ee @ np.linalg.inv(batch.of_trial["attached"][trial].double().numpy())
    model = evaluator().scene.objects[int(batch.of_trial["object"][trial])]
    held = hull(model.vertices.astype(np.float64) @ T_obj[:3, :3].T + T_obj[:3, 3])
    return min(least(links + gripper_bodies(batch, trial, opening, T_ee), arm), distance(held, arm[-1]))


def some(mask, n, seed=0):
    """n of the pairs (trial, k) where a mask holds."""
    pairs = torch.nonzero(mask)
    assert len(pairs) >= n
    return pairs[np.random.default_rng(seed).choice(len(pairs), n, replace=False)].tolist()


def test_hands_are_free_of_the_gripper_as_fcl_says(steps):
    batch, arms, passes, _ = steps
    within, clear = passes[..., 0], passes[..., 1]
    for mask, free in ((within & clear, True), (within & ~clear, False)):
        for i, k in each(some(mask, 30)):
            opening = float(batch.of_trial["opening"][i])
            gap = gap_to_gripper(batch, i, int(batch.first[i]) + k, arms["turn"][i, k], opening)
            assert gap > judge.ROOM_M - 2e-5 if free else gap < judge.ROOM_M + 2e-5, (i, k, gap)


def test_a_way_in_and_the_release_are_free_at_every_sample(steps):
    batch, arms, passes, way = steps
    table = batch.grasps
    for i, k in each(some(passes[..., :5].all(2), 3)):
        row, turn = int(batch.first[i]) + k, arms["turn"][i, k]
        T = turned_object(batch, i, turn)
        n, a = (x[row].double().numpy() for x in (table.owners[2], table.owners[1]))
        u = (n, a, (n + a) / np.linalg.norm(n + a))[int(way[i, k])]
        opening = float(batch.of_trial["opening"][i])
        gaps = [gap_to_gripper(batch, i, row, turn, opening, -s * T[:3, :3] @ u) for s in np.linspace(0, 0.1, 8)]
        assert min(gaps) > 0, (i, k)
        T_ee = batch.of_trial["T_world_obj"][i].double().numpy() @ batch.of_trial["attached"][i].double().numpy()
        back = [gap_to_gripper(batch, i, row, turn, 0.085, s * T_ee[:3, 2]) for s in np.linspace(0, 0.1, 5)]
        assert min(back) > 0, (i, k)


def test_arm_and_torso_are_clear_of_the_robot_as_fcl_says(scores, steps):
    batch, arms, passes, _ = steps
    asked = passes[..., :3].all(2)
    for mask, clear in ((asked & passes[..., 3], True), (asked & ~passes[..., 3], False)):
        for i, k in each(some(mask, 5)):
            trial, at = torch.tensor([i]), torch.tensor([k])
            wrist = batch.wrists(batch.pairs(trial, at, arms))[0].double().numpy()
            lean, elbow = float(arms["angles"][i, k, 6]), arms["elbow"][i, k].double().numpy()
            arm = arm_bodies(batch.robot["receiver"][i], lean, elbow, wrist)
            gap = gap_to_robot(batch, i, scores.q_goal[i].double().numpy(), arm)
            assert gap > 0 if clear else gap < 2e-5, (i, k, gap)


PALM_M, TOUCH_M, FAR_M, FCL_M = 0.1, 1e-4, 0.05, 2e-5


def own_rooms(receiver, angles):
    """Of the arm (`Room`): how much longer it is than it is stretched, and the least room of its joints."""
    upper, lower = (np.linalg.norm(receiver[k, :3] - receiver[k + 1, :3]) for k in (0, 1))
    said = dict(zip(ANGLES, angles, strict=True))
    stretched = np.sqrt(upper**2 + lower**2 + 2 * upper * lower * np.cos(np.radians(said["elbow"])))
    ends = [
        np.radians(high - said[name]) * (lower if name == "elbow" else PALM_M) for name, (_, high) in RANGES.items()
    ]
    ends += [np.radians(said[name] - low) * PALM_M for name, (low, _) in RANGES.items() if name != "elbow"]
    return upper + lower - stretched, min(ends)


def gaps_on_way(scores, batch, found, i):
    """A function of t (0 waiting, 1 before the grasp, 2 there) that gives FCL's distances of hand and gripper, and of body and
    robot, on the way to the grasp that trial i's person takes."""
    row = int(batch.grasps.first_of(scores.inputs.trials.object_index[i])) + int(found.grasp[i])
    receiver = batch.robot["receiver"][i]
    poses = scores.inputs.trials.T_world_hand, found.T_world_hand, found.T_world_before
    wait, there, before = (T[i].double().numpy() for T in poses)
    turn = Slerp([0, 1], Rotation.from_matrix([wait[:3, :3], there[:3, :3]]))
    model = evaluator().scene.hands.model
    skin = batch.grasps.held_out.grasps[row : row + 1].vertices[0].double().numpy()
    grasp = batch.grasps.held_out.grasps.T_obj_hand[row].double().numpy()
    of_object = there @ np.linalg.inv(grasp)  # the object's frame, turned about its axis
    at_grasp = skin @ of_object[:3, :3].T + of_object[:3, 3]
    pieces = [hull(at_grasp[ids.numpy()]) for ids in model.pieces]
    gripper = gripper_bodies(batch, i, float(batch.of_trial["opening"][i]))
    target = found.wrist[i].double().numpy()
    start, out = receiver[2, :3].double().numpy(), before[:3, 3] - there[:3, 3]
    lean, elbow = float(found.angles_deg[i, 6]), found.elbow[i].double().numpy()
    waits, q = receiver[1, :3].double().numpy(), scores.q_goal[i].double().numpy()

    def gaps(t):
        at = start + t * (target + out - start) if t < 1 else target + (2 - t) * out
        back = turn(min(t, 1.0)).as_matrix() @ there[:3, :3].T
        for piece in pieces:
            piece.setTransform(fcl.Transform(back, at - back @ target))
        arm = arm_bodies(receiver, 0.5 * t * lean, waits + 0.5 * t * (elbow - waits), at)
        return least(gripper, pieces), gap_to_robot(batch, i, q, arm)

    return gaps


def rooms_of(scores, batch, found, i, samples, rounds):
    """Each `Room` of the grasp that trial i's person takes: those of hand and body from samples of the way, more of them in
    each round around the nearest ones."""
    gaps = gaps_on_way(scores, batch, found, i)
    known = {t: gaps(t) for t in np.linspace(0, 2, samples)}
    width = 2 / (samples - 1)
    for _ in range(rounds):
        for which in (0, 1):
            nearest = min(known, key=lambda t, which=which: known[t][which])
            known |= {t: gaps(t) for t in np.clip(nearest + width * np.linspace(-1, 1, 9), 0, 2) if t not in known}
        width /= 4
    asked = np.array([judge.ROOM_M, TOUCH_M])
    beside = np.minimum(np.min(list(known.values()), axis=0), np.array(known[2.0]) - asked)
    beside = np.minimum(beside, FAR_M - asked)  # nobody looks farther
    receiver, angles = batch.robot["receiver"][i].double().numpy(), found.angles_deg[i].double().numpy()
    return np.array([*beside, *own_rooms(receiver, angles)])


def rooms_agree(scores, batch, found, rows, samples, rounds):
    """The stored margins are no more than any room, and near the least one, which they name; which ones they name."""
    named = []
    for i in each(rows):
        margin, room = float(found.margin_m[i]), int(found.room[i])
        rooms = rooms_of(scores, batch, found, i, samples, rounds)
        assert 0 < margin <= rooms.min() + FCL_M, (i, room, margin, rooms)
        assert rooms[room] <= 1.1 * margin + 2e-4, (i, room, margin, rooms)
        named.append(Room(room))
    return named


def test_margins_are_the_least_room_by_samples_of_the_whole_way(scores, steps, found):
    rows = torch.nonzero(found.received)[:, 0].tolist()
    assert len(rows) >= 20
    rooms_agree(scores, steps[0], found, rows[::9], 21, 1)


@pytest.mark.slow
def test_margins_of_many_are_the_least_room_by_many_samples():
    trials = load_benchmark("r2h-v1").trials(48)
    answer = oracle.predict(trials, evaluator().scene, evaluator=evaluator())
    scores = evaluator().score(answer.T_obj_ee, answer.T_world_ee, trials)
    found = reception(scores, margins=True)
    rows = torch.nonzero(found.received)[:, 0].tolist()
    assert len(rows) >= 60
    named = rooms_agree(scores, judge._batch_of(scores), found, rows, 81, 3)
    assert {Room.HAND, Room.JOINTS} <= set(named)


def test_margins_of_what_is_not_received_are_what_the_best_grasp_lacks(scores, steps, monkeypatch):
    """No arm is long enough, and no grasp leaves the hand 20 cm of room."""
    batch, _, passes, _ = steps
    trials = scores.inputs.trials
    away = trials.receiver.clone()
    away[:, :4, 0] += 0.7
    moved = scores.with_inputs(replace(scores.inputs, trials=replace(trials, receiver=away)))
    upright = reception(moved, leans_deg=(0.0,), margins=True)
    rows = torch.nonzero(upright.evaluated & (upright.count[:, 0] == 0))[:, 0]
    arms = judge._arms(judge._batch_of(moved), (0.0,))
    for i in each(rows[::5].tolist()):
        k = torch.arange(int(batch.known[i]))
        wrist = batch.wrists(batch.pairs(torch.full_like(k, i), k, arms)).double()
        body = away[i].double()
        long = (body[0, :3] - body[1, :3]).norm() + (body[1, :3] - body[2, :3]).norm()
        short = ((wrist - body[0, :3]).norm(dim=1) - long).min()
        assert float(upright.margin_m[i]) == pytest.approx(-float(short), abs=1e-5) and short > 0
    assert (upright.margin_kind[rows] == int(MarginKind.DISTANCE)).all() and (upright.room[rows] == -1).all()

    monkeypatch.setattr(judge, "ROOM_M", 0.2)
    wide = reception(scores[:8], margins=True)
    rows = torch.nonzero((wide.count[:, 0] > 0) & (wide.count[:, 1] == 0))[:, 0]
    arms = judge._arms(batch, judge.LEANS_DEG)
    for i in each(rows[:2].tolist()):
        opening = float(batch.of_trial["opening"][i])
        gaps = [
            gap_to_gripper(batch, i, int(batch.first[i]) + k, arms["turn"][i, k], opening)
            for k in torch.nonzero(passes[i, :, 0])[:, 0].tolist()
        ]
        assert float(wide.margin_m[i]) == pytest.approx(max(gaps) - 0.2, abs=2e-5)
    assert (wide.margin_kind[rows] == int(MarginKind.BOUND)).all()


def test_a_hand_in_the_gripper_lacks_more_the_deeper_it_is(steps):
    batch, arms, passes, _ = steps
    _, _, pair = pairs_of(batch, arms, passes[..., 0] & ~passes[..., 1], 400)
    columns = {k: pair[k] for k in judge._PAIR_COLUMNS}
    room = judge._launch(batch, kernels.overlap_of_hand, 400, **batch.tables, **columns)["room"]
    meets = ~beside_gripper(batch, pair, 1e-7)
    assert (room <= 0).all() and (room[meets] <= -judge.ROOM_M).all() and (room[~meets] > -judge.ROOM_M).all()
    deep = torch.nonzero(room < -0.004)[:, 0]
    assert len(deep) > 20
    for way in each(torch.eye(3)):  # who is so deep is not out after half as much, whichever way it goes
        step = -0.5 * (room + judge.ROOM_M)[:, None] * way
        assert not beside_gripper(batch, pair, 1e-7, attached=shifted(pair["attached"], step))[deep].any()


# --- the same verdicts on many pairs, from samples of what FCL was asked about above ------------------------------------

SAMPLES = 41
NEARLY_M = judge.ROOM_M + 0.5 * kernels.WAY_M / (SAMPLES - 1) + 1e-5
"""A straight way with less than `ROOM_M` somewhere has no more than this at one of its samples."""


def shifted(T_obj_ee, way):
    """The ee where the hand sees it after the hand went by `way`, ee frame."""
    return torch.cat([torch.cat([T_obj_ee[:, :3, :3], T_obj_ee[:, :3, 3:] - T_obj_ee[:, :3, :3] @ way[:, :, None]], 2),
                      T_obj_ee[:, 3:]], 1).contiguous()  # fmt: skip


def beside_gripper(batch, pair, room_m=judge.ROOM_M, **changed):
    """Whether the hands of pairs keep `room_m` from the gripper."""
    columns = {k: pair[k] for k in judge._PAIR_COLUMNS} | changed
    tables = batch.tables | {"eps": room_m}
    return judge._launch(batch, kernels.come_to_object, len(pair["row"]), **tables, **columns)["free"]


def straight(batch, pair, way, room_m, **changed):
    """Whether hands keep `room_m` at every sample while they go 10 cm along `way`, ee frame."""
    free = torch.ones(len(pair["row"]), dtype=torch.bool)
    for s in np.linspace(0, float(kernels.WAY_M), SAMPLES).tolist():
        free &= beside_gripper(batch, pair, room_m, attached=shifted(pair["attached"], s * way), **changed)
    return free


def ways_out(batch, pair):
    """The three directions in which each pair's hand may go back, ee frame."""
    table, row = batch.grasps, pair["row"].long()
    T = judge._about_axis(table, pair["object"].long(), pair["turn"])[:, :3, :3]
    n, a = table.owners[2][row], table.owners[1][row]
    R = pair["attached"][:, :3, :3].transpose(1, 2) @ T
    return [-(R @ u[:, :, None])[..., 0] for u in (n, a, torch.nn.functional.normalize(n + a, dim=1))]


def pairs_of(batch, arms, mask, n, moved_m=0.0):
    """Some pairs where a mask holds, with the gripper moved at random by up to `moved_m` along each axis."""
    trial, k = torch.tensor(some(mask, n)).T
    pair = batch.pairs(trial, k, arms)
    off = moved_m * torch.from_numpy(np.random.default_rng(2).uniform(-1, 1, (n, 3))).float()
    return trial, k, pair | {"attached": shifted(pair["attached"], off)}


def test_hands_come_the_first_way_on_which_samples_keep_off_the_gripper(steps):
    batch, arms, passes, _ = steps
    _, _, pair = pairs_of(batch, arms, passes[..., 0] & passes[..., 1], 400, moved_m=0.05)
    columns = {k: pair[k] for k in judge._PAIR_COLUMNS}
    made = judge._launch(batch, kernels.come_to_object, 400, **batch.tables, **columns)
    late = 0
    for which, way in enumerate(ways_out(batch, pair)):
        free, nearly = (straight(batch, pair, way, room_m) for room_m in (1e-6, NEARLY_M))
        assert free[made["way"] == which].all()
        blocked = made["free"] & ((made["way"] > which) | (made["way"] < 0))
        assert not (nearly & blocked).any()
        late += int((blocked & straight(batch, pair, 0.5 * way, NEARLY_M)).sum())
    assert late >= 3 and (made["way"] >= 0).sum() > 100  # some meet the gripper beyond 5 cm alone


def test_the_gripper_lets_go_where_samples_of_opening_and_backing_off_keep_off_the_hand(steps):
    batch, arms, passes, _ = steps
    n = 1500
    _, _, pair = pairs_of(batch, arms, passes[..., 0], n, moved_m=0.12)
    wide = batch.grasps.open_gap_m
    columns = {k: pair[k] for k in judge._PAIR_COLUMNS} | {"open_gap": wide}
    release = judge._launch(batch, kernels.let_go, n, **batch.tables, **columns)["back"] >= kernels.WAY_M
    third, two = (
        beside_gripper(batch, pair, opening=pair["opening"] + k / 3 * (wide - pair["opening"])) for k in (1, 2)
    )
    back = torch.tensor([[0.0, 0.0, 1.0]]).expand(n, 3)
    opened = torch.full((n,), wide)
    free, nearly = (straight(batch, pair, back, room_m, opening=opened) for room_m in (1e-6, NEARLY_M))
    assert (third & two & free)[release].all() and not (third & two & nearly)[~release].any()
    assert release.sum() > 50 and (third & two & ~free).sum() > 5 and (~two & third & free).sum() >= 1


def test_elbows_beside_links_are_clear_of_the_robot_as_fcl_says(scores, steps):
    """Shoulder, torso and head are where the person waits, lifted away; only elbow and wrist of a pair are at the robot."""
    batch, _, _, _ = steps
    robot, rng, found = evaluator().scene.robot, np.random.default_rng(6), []
    rows = torch.nonzero(batch.evaluated).flatten()
    n, q = len(rows), scores.q_goal[rows].double().numpy()
    receiver = batch.robot["receiver"].clone()
    receiver[:, :4, 2] += 2.0
    links = forward_kinematics(robot, q)
    elbow = links[np.arange(n), rng.integers(1, 7, n), :3, 3] + rng.uniform(-0.25, 0.25, (n, 3))
    wrist = elbow + np.array([0.0, 0.0, 0.3])
    moved = {"receiver": receiver, "head": heads_of(receiver), "trial": rows.to(torch.int32)}
    made = judge._launch(
        batch, kernels.arm_clears_robot, n, **batch.robot | moved, lean=torch.zeros(n),
        elbow=torch.from_numpy(elbow).float(), wrist=torch.from_numpy(wrist).float(),
    )["clear"]  # fmt: skip
    for i, row in enumerate(each(rows.tolist())):
        gap = gap_to_robot(batch, row, q[i], arm_bodies(receiver[row], 0.0, elbow[i], wrist[i]))
        found.append(bool(made[i]))
        assert gap > 0 if made[i] else gap < 2e-5, (row, gap)
    assert found.count(True) >= 3 and found.count(False) >= 3


def test_arms_that_only_the_torso_keeps_off_the_robot_are_as_fcl_says(scores, steps):
    """The torso, and with it the head, is moved to the robot's links; forearm and upper arm are far away."""
    batch, _, _, _ = steps
    robot, rng, found = evaluator().scene.robot, np.random.default_rng(4), []
    receiver = batch.robot["receiver"].clone()
    T = forward_kinematics(robot, scores.q_goal.double().numpy().astype(np.float64))
    for i in range(len(receiver)):
        place = T[i, rng.integers(1, 7), :3, 3] + rng.uniform(-0.25, 0.25, 3)
        receiver[i, 3, :3] = torch.from_numpy(place).float()
    far = torch.tensor([[5.0, 0.0, 1.0]]).repeat(len(receiver), 1)
    receiver[:, 0, :3] = far + torch.tensor([0.0, 0.3, 0.3])
    receiver[:, 1, :3] = far + torch.tensor([0.0, 0.3, 0.0])
    moved = {"receiver": receiver, "head": heads_of(receiver)}
    inputs = batch.robot | moved | {"trial": torch.arange(len(receiver), dtype=torch.int32)}
    made = judge._launch(
        batch, kernels.arm_clears_robot, len(receiver), **inputs, lean=torch.zeros(len(receiver)),
        elbow=far, wrist=far + torch.tensor([0.3, 0.0, 0.0]),
    )["clear"]  # fmt: skip
    for i in torch.nonzero(batch.evaluated).flatten().tolist():
        arm = arm_bodies(receiver[i], 0.0, far[i].double().numpy(), far[i].double().numpy() + [0.3, 0.0, 0.0])
        gap = gap_to_robot(batch, i, scores.q_goal[i].double().numpy(), arm)
        found.append(bool(made[i]))
        assert gap > 0 if made[i] else gap < 2e-5, (i, gap)
    assert found.count(True) >= 3 and found.count(False) >= 3


def test_whole_ways_are_free_where_every_sample_of_hand_and_arm_is(steps):
    batch, arms, passes, way = steps
    n, rooms = 120, np.linspace(0, 2, 161)
    trial, k, pair = pairs_of(batch, arms, passes[..., :3].all(2), n)
    pair["way"] = way[trial, k]
    made = judge._launch(batch, kernels.way_to_grasp, n, **batch.tables, **batch.robot, **pair)["free"]
    table, row = batch.grasps, pair["row"].long()
    turn = judge._about_axis(table, pair["object"].long(), pair["turn"]).double().numpy()
    T_world = pair["T_world_obj"].double().numpy() @ turn
    wrist, a, nrm = (table.owners[j][row].double().numpy() for j in (0, 1, 2))
    u = np.stack([nrm, a, (nrm + a) / np.linalg.norm(nrm + a, axis=1)[:, None]], 1)[np.arange(n), pair["way"].numpy()]
    receiver = batch.robot["receiver"][trial].double().numpy()
    inverse = np.linalg.inv(T_world)
    waits = np.einsum("nij,nj->ni", inverse[:, :3, :3], receiver[:, 2, :3]) + inverse[:, :3, 3]
    before = wrist - 0.1 * u
    R_waits = inverse[:, :3, :3] @ pair["T_world_hand"][:, :3, :3].double().numpy()
    turned = Rotation.from_matrix(table.owners[3][row].double().numpy() @ R_waits.transpose(0, 2, 1)).as_rotvec()
    wider = batch.robot["receiver"].clone()
    wider[:, :2, 3] += 0.006
    wider[:, 4, :2] += 0.006
    larger = batch.robot["head"].clone()
    larger[:, :, 3] += 0.006
    free = torch.ones(n, dtype=torch.bool)
    nearly, no_turn = free.clone(), torch.zeros(n)
    for t in rooms:
        at = waits + t * (before - waits) if t < 1 else before + (t - 1) * (wrist - before)
        M = np.tile(np.eye(4), (n, 1, 1))
        M[:, :3, :3] = Rotation.from_rotvec(-max(1 - t, 0) * turned).as_matrix()
        M[:, :3, 3] = at - np.einsum("nij,nj->ni", M[:, :3, :3], wrist)
        attached = torch.from_numpy(np.linalg.inv(turn @ M) @ pair["attached"].double().numpy()).float().contiguous()
        lean, elbow = 0.5 * t * pair["lean"], batch.robot["receiver"][trial, 1, :3]
        elbow = elbow + 0.5 * t * (pair["elbow"] - elbow)
        world = np.einsum("nij,nj->ni", T_world[:, :3, :3], at) + T_world[:, :3, 3]
        posture = {"trial": pair["trial"], "lean": lean, "elbow": elbow, "wrist": torch.from_numpy(world).float()}
        persons = (free, 1e-6, batch.robot["receiver"], batch.robot["head"]), (nearly, 0.012, wider, larger)
        for state, room_m, person, head in persons:
            state &= beside_gripper(batch, pair, room_m, attached=attached, turn=no_turn)
            inputs = batch.robot | {"receiver": person, "head": head}
            state &= judge._launch(batch, kernels.arm_clears_robot, n, **inputs, **posture)["clear"]
    assert free[made].all() and not nearly[~made].any()
    assert made.sum() > 20 and (~made).sum() > 5


def heads_at(batch, trial, lean_deg, x, radius):
    """Upright heads (n, 2, 4) whose middles are at x (n, 3) when the trunks of trials lean; 4 cm long, m."""
    receiver = batch["receiver"][trial].double().numpy()
    heads = np.zeros((len(trial), 2, 4))
    for i, (body, lean) in enumerate(zip(receiver, np.asarray(lean_deg), strict=True)):
        hip = body[3, :3] - [0, 0, body[4, 2]]
        back = Rotation.from_rotvec(-np.radians(lean) * np.cross([0, 0, 1.0], [body[3, 3], body[4, 3], 0.0]))
        heads[i, :, :3] = hip + back.apply(x[i] - hip) + [[0, 0, -0.02], [0, 0, 0.02]]
    heads[:, :, 3] = radius
    return torch.from_numpy(heads).float()


def test_robot_and_object_are_clear_of_the_leaned_head_as_fcl_says(scores, steps):
    """Heads beside links and objects, and nothing else of the person anywhere near."""
    batch, _, _, _ = steps
    robot, rng, found = evaluator().scene.robot, np.random.default_rng(5), []
    rows = torch.nonzero(batch.evaluated).flatten()
    n, q = len(rows), scores.q_goal[rows].double().numpy()
    lean = torch.from_numpy(rng.uniform(5, 30, n)).float()
    receiver = batch.robot["receiver"].clone()
    receiver[:, :, 2] += 5.0 * torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0])
    links, T_obj = forward_kinematics(robot, q), batch.of_trial["T_world_obj"][rows].double().numpy()
    x = np.where((np.arange(n) % 2)[:, None], T_obj[:, :3, 3], links[np.arange(n), rng.integers(1, 7, n), :3, 3])
    x += rng.uniform(-0.2, 0.2, (n, 3))
    head = torch.zeros(len(receiver), 2, 4)
    head[rows] = heads_at({"receiver": receiver}, rows, lean, x, 0.05)
    far = torch.tensor([[5.0, 0.0, 1.0]]).repeat(n, 1)
    inputs = batch.robot | {"receiver": receiver, "head": head, "trial": rows.to(torch.int32), "lean": lean}
    made = judge._launch(
        batch, kernels.arm_clears_robot, n, **inputs, elbow=far, wrist=far + torch.tensor([0.3, 0.0, 0.0])
    )["clear"]
    for i, row in enumerate(each(rows.tolist())):
        place = np.eye(4)
        turn = Rotation.from_rotvec(
            np.radians(float(lean[i])) * np.cross([0, 0, 1.0], [*receiver[row, 3:, 3].double().tolist(), 0.0])
        )
        place[:3, :3], place[:3, 3] = turn.as_matrix(), x[i]
        gap = gap_to_robot(batch, row, q[i], [primitive(ShapeKind.CAPSULE, [0.05, 0.02], place)])
        found.append((bool(made[i]), bool(i % 2)))
        assert gap > -2e-5 if made[i] else gap < 2e-5, (row, gap)
    for near in each((False, True)):  # beside links, beside objects
        assert 1 < sum(clear for clear, of in found if of == near) < sum(of == near for _, of in found) - 1


def test_what_robot_and_object_keep_from_the_head_is_not_asked_of_the_person(scores):
    kept = replace(load_benchmark("r2h-v1"), receiver="body", head_clearance_m=0.3)
    inputs = scores.inputs
    trials = kept.trials(16)
    found = Evaluator(kept, EvalConfig(execute=ExecConfig(sim="none"))).score(
        inputs.T_obj_ee, inputs.T_world_ee, trials, stages="pose"
    )
    assert torch.equal(trials.receiver, inputs.trials.receiver) and (found.body_m < 0).any()
    assert torch.equal(judge._batch_of(found).robot["head"], heads_of(trials.receiver))


def test_no_head_is_passed_by_between_two_steps_of_a_way(scores, steps):
    """Heads 2 m from the hips about which they lean, and links that they pass on the way: at samples, and as certified."""
    batch, arms, passes, way = steps
    trial, k, pair = pairs_of(batch, arms, passes[..., :3].all(2), 120)
    pair["way"], n, rng = way[trial, k], len(trial), np.random.default_rng(7)
    pair["lean"] = torch.full((n,), 30.0)
    # one row a pair: its own person, whose trunk is small and far behind
    rows = torch.arange(n, dtype=torch.int32)
    receiver = batch.robot["receiver"][trial].clone()
    facing = torch.stack([receiver[:, 3, 3], receiver[:, 4, 3], torch.zeros(n)], 1)
    hip = receiver[:, 3, :3] - 2.5 * facing
    receiver[:, 0, :3], receiver[:, 3, :3], receiver[:, 4, :3] = hip, hip, 0.05
    hands = scores.inputs.trials.hand_index[trial]
    bodies = evaluator().scene.body_poses(
        pair["object"], hands, pair["attached"], pair["T_world_hand"], pair["opening"]
    )
    q = batch.robot["q"][trial].contiguous()
    own = {"world": batch.robot["world"], "bodies": bodies.bodies, "receiver": receiver, "q": q}
    links = forward_kinematics(evaluator().scene.robot, q.double().numpy())
    x = links[np.arange(n), rng.integers(2, 6, n), :3, 3]
    share = rng.uniform(0.6, 0.9, n)  # of the lean where it is met: on the last, slow part of the way
    pair["trial"] = rows

    def free(head):
        inputs = {**batch.tables, **own, **pair, "head": head}
        return judge._launch(batch, kernels.way_to_grasp, n, **inputs)["free"]

    nowhere = heads_at(own, torch.arange(n), torch.zeros(n), hip.double().numpy(), 0.01)
    head = heads_at(own, torch.arange(n), 30.0 * share, x, 0.01)
    made, alone = free(head), free(nowhere)
    sampled = torch.ones(n, dtype=torch.bool)
    wrist = batch.wrists(pair).contiguous()
    for t in np.linspace(0, 2, 400):
        lean, elbow = 0.5 * t * pair["lean"], receiver[:, 1, :3] + 0.5 * t * (pair["elbow"] - receiver[:, 1, :3])
        posture = {"trial": rows, "lean": lean.contiguous(), "elbow": elbow.contiguous(), "wrist": wrist}
        clear, rest = (
            judge._launch(batch, kernels.arm_clears_robot, n, **own, head=of, **posture)["clear"]
            for of in (head, nowhere)
        )
        sampled &= clear | ~rest  # what else of the person meets the robot is not asked: the wrist is not there yet
    assert not (made & ~sampled).any()
    assert (alone & ~sampled).sum() > 20


def test_every_second_grasp_of_an_object_of_revolution_is_turned_to_where_the_hand_turns_least(steps):
    batch, arms, _, _ = steps
    axes = batch.grasps.held_out.axis
    round_ones = torch.nonzero(batch.evaluated & axes[batch.of_trial["object"].long()].any(1)).flatten().tolist()
    assert len(round_ones) >= 2
    angles = np.radians(np.arange(-180, 180, 0.5))
    for i in round_ones:
        known, first = int(batch.known[i]), int(batch.first[i])
        axis = axes[int(batch.of_trial["object"][i])].double().numpy()
        waits = batch.of_trial["T_world_hand"][i, :3, :3].double().numpy()
        R_obj = batch.of_trial["T_world_obj"][i, :3, :3].double().numpy()
        turned = R_obj @ Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
        assert not arms["turn"][i, 0:known:2].any()
        for k in range(1, known, 16):
            R = batch.grasps.owners[3][first + k].double().numpy()
            cosine = np.einsum("ji,njk,ki->n", waits, turned, R)
            off = np.angle(np.exp(1j * (angles[cosine.argmax()] - float(arms["turn"][i, k]))))
            assert abs(off) < np.radians(0.6), (i, k)


def test_no_forearm_goes_through_the_torso():
    """Torsos that stand where the forearms are: the twin's effort, or no posture, as the twin says."""
    trials = load_benchmark("r2h-v1").trials(60)
    inputs, vectors, outwards = waiting(trials)
    body = trials.receiver.clone()
    off = torch.from_numpy(np.random.default_rng(6).uniform(-0.25, 0.25, (len(trials), 3))).float()
    body[:, 3, :3] = 0.5 * (body[:, 1, :3] + body[:, 2, :3]) + off
    moved = replace(trials, receiver=body)
    effort, _ = searched(inputs | {"receiver": body.contiguous()})
    twin = np.array([effort_twin(moved, vectors, outwards, i) for i in range(len(trials))])
    assert ((effort >= 0) == np.isfinite(twin)).all()
    there = effort >= 0
    assert np.abs(effort[there] - twin[there]).max() < 1e-4
    plain, _ = searched(inputs)
    assert (~there).sum() >= 10 and (effort[there] > plain[there] + 1e-4).sum() >= 5


def test_hands_hold_what_they_carry_and_what_a_pull_about_the_gripper_does_not_turn_in_them(scores, steps):
    """Forces and moments in float64, from the poses, and the grips that are stored."""
    batch, arms, passes, _ = steps
    judge._carry(batch, arms, passes)
    trial, k, pair = pairs_of(batch, arms, passes[..., :5].all(2), 300)
    held_out, objects = batch.grasps.held_out, evaluator().scene.objects
    found = passes[trial, k, 5].numpy()
    T_obj, turned = (
        T.double().numpy()
        for T in (pair["T_world_obj"], judge._about_axis(batch.grasps, pair["object"].long(), pair["turn"]))
    )
    T_grasp = T_obj @ turned
    rows = pair["row"].long().numpy()
    grips = usual_grips(held_out, objects, rows, -T_grasp[:, 2, :3])
    elbow, wrist = pair["elbow"].double().numpy(), batch.wrists(pair).double().numpy()
    expected, sure = [], []
    for i, row in enumerate(rows):
        model = objects[int(pair["object"][i])]
        along = elbow[i] - wrist[i]
        along[2] = max(along[2], 0.0)
        pull = along / np.linalg.norm(along) + [0, 0, judge.LIFT]
        pull *= judge.PULL_N / np.linalg.norm(pull)
        weight = np.array([0, 0, float(model.mass) * 9.81])
        center = T_grasp[i, :3, :3] @ grips.center[i] + T_grasp[i, :3, 3]
        com = T_obj[i, :3, :3] @ np.asarray(model.com, float) + T_obj[i, :3, 3]
        tcp = T_obj[i] @ np.append(pair["attached"][i, :3, 3].double().numpy(), 1.0)
        axes = T_grasp[i, :3, :3] @ grips.axes[i]
        grip = min(max(grips.total_n[i], 10 + 5 * np.linalg.norm(weight + pull)), 80.0)
        load = [np.r_[weight, np.cross(com - center, weight)]]
        load.append(load[0] + np.r_[pull, np.cross(tcp[:3] - center, pull)])
        share = max(
            (abs(np.r_[axes.T @ w[:3], axes.T @ w[3:]]) / (0.7 * grip * grips.capacity[i] + 1e-12)).max() for w in load
        )
        down = -axes[2]
        weakest = float(held_out.grip_n[row, int((GRAVITY @ down).argmax())]) <= judge.GRIP_N
        expected.append(weakest and share <= 1.0)
        sure.append(abs(share - 1.0) > 1e-3)
    assert np.mean(sure) > 0.9 and np.array_equal(found[sure], np.array(expected)[sure])
    assert 0.05 < found.mean() < 0.95


# --- what comes out --------------------------------------------------------------------------------------------------


def test_a_row_depends_on_its_own_trial_alone(scores, found):
    rows = torch.tensor([5, 2, 29])
    again = reception(scores[rows], margins=True)
    for name in each(judge.Reception.__dataclass_fields__):
        a, b = getattr(found, name)[rows], getattr(again, name)
        assert torch.equal(torch.nan_to_num(a.float(), nan=-7), torch.nan_to_num(b.float(), nan=-7)), name


def test_hands_are_posed_once_however_often_objects_are_added_and_every_row_stays_what_it_was(
    scores, found, monkeypatch
):
    for module, name in ((held_out, "_loaded"), (judge, "_known")):
        monkeypatch.setattr(module, name, cache(getattr(module, name).__wrapped__))
    own, posed, real = Evaluator(load_benchmark("r2h-v1"), evaluator().config), [], HandModel.pose
    monkeypatch.setattr(HandModel, "pose", lambda self, pose, *a: posed.append(len(pose)) or real(self, pose, *a))
    asked = scores.with_inputs(replace(scores.inputs, evaluator=own))
    objects = scores.inputs.trials.object_index
    order = objects.unique()[[3, 0, 5, 4]]  # before, behind and between those that are there
    for k in each(range(1, 5)):
        rows = torch.isin(objects, order[:k]).nonzero().flatten()
        again = reception(asked[rows], margins=True)
        for name in judge.Reception.__dataclass_fields__:
            a, b = getattr(found, name)[rows], getattr(again, name)
            assert torch.equal(torch.nan_to_num(a.float(), nan=-7), torch.nan_to_num(b.float(), nan=-7)), name
        there = load_held_out(own.scene.objects, own.scene.hands.model, order[:k].tolist())
        assert sum(posed) == len(there.grasps) == 512 * k and there.loaded == set(order[:k].tolist())
        assert max(posed) <= 512
    load_held_out(own.scene.objects, own.scene.hands.model)  # somebody else reads those of all
    reception(asked[(objects == objects.unique()[1]).nonzero().flatten()])
    assert sum(posed) == 512 * 5 < 512 * len(own.scene.objects)


def test_counts_fall_step_by_step_the_easiest_grasp_passes_and_without_lean_fewer_arms_reach(scores, found):
    assert (found.count.diff(dim=1) <= 0).all() and (found.count[:, 0] <= found.known).all()
    assert (found.count[found.received, -1] > 0).all() and (found.known[found.evaluated] == 256).all()
    assert found.received.float().mean() > 0.8
    assert (found.rula[found.received] >= 1).all() and (found.rula[~found.received] == 0).all()

    upright = reception(scores, leans_deg=(0.0,))
    assert (upright.count[:, 0] <= found.count[:, 0]).all() and upright.count[:, 0].sum() < found.count[:, 0].sum()
    assert (upright.angles_deg[upright.received, ANGLES.index("lean")] == 0).all()


def test_rows_that_hold_nothing_are_not_evaluated(scores):
    T = scores.inputs.T_obj_ee.clone()
    T[:4, :3, 3] += 1.0
    empty = evaluator().score(T, scores.inputs.T_world_ee, scores.inputs.trials, stages="pose")
    found = reception(empty)
    assert not found.evaluated[:4].any() and not found.received[:4].any() and (found.count[:4] == 0).all()
    assert found.evaluated[4:].all()


def test_the_oracle_for_reception_hands_over_what_can_be_taken(scores, found):
    trials = scores.inputs.trials
    answer = oracle.predict(trials, evaluator().scene, evaluator=evaluator(), for_="reception")
    again = evaluator().score(answer.T_obj_ee, answer.T_world_ee, trials)
    best = reception(again)
    assert again.success.all() and best.received.sum() >= found.received.sum()
    both = best.received & found.received
    assert best.effort[both].mean() < found.effort[both].mean()


def test_the_chance_of_one_is_that_of_drawing_without_replacement():
    for passing in (0, 1, 4, 9):
        counted = np.mean([min(drawn) < passing for drawn in combinations(range(10), 3)])
        assert chance_of_one(np.array([passing]), np.array([10]), 3)[0] == pytest.approx(counted, abs=1e-12)
    assert chance_of_one(np.array([0, 0]), np.array([0, 5]), 8).tolist() == [0.0, 0.0]
    curve = [chance_of_one(np.array([7]), np.array([256]), k)[0] for k in range(1, 257)]
    assert (np.diff(curve) >= -1e-12).all() and curve[-1] == 1.0


# --- held-out grasps -------------------------------------------------------------------------------------------------


def test_held_out_grasps_are_none_of_those_that_predictors_are_shown():
    objects = load_objects()
    shown, own = load_receiving(), load_held_out(objects).grasps
    for i in each(range(len(objects))):
        a, b = (g.T_obj_hand[g.rows_of(i)].flatten(1) for g in (shown, own))
        assert len(b) == 512 and (torch.cdist(a, b) > 1e-5).all()


def test_stored_grips_are_those_of_the_linear_program_again():
    model = next(o for o in load_objects() if o.name == "hammer")
    own = load_held_out([model])
    rows = [0, 300]
    again = grip_forces(model, own.grasps[torch.tensor(rows)].vertices.numpy(), own.grasps.hand)
    assert np.allclose(again, own.grip_n[rows].numpy(), rtol=1e-3)


def test_rula_scores_postures_as_its_tables_do():
    good = [10, 0, 80, 0, 0, 0, 0]  # upper arm 1, lower arm 1, wrist 1, twist 1: A 1; trunk 1: B 1
    worse = [95, 40, 120, 70, 30, 20, 25]  # upper arm 5, lower arm 2, wrist 4, twist 2: A 7; trunk 3: B 3
    reaching = [60, 0, 40, 0, 10, 0, 0]  # upper arm 3, lower arm 2, wrist 2, twist 1: A 4; B 1
    assert rula(np.array([good, worse, reaching], float)).tolist() == [1, 6, 3]


def test_objects_of_revolution_are_known_by_their_surface():
    found = {o.name: revolution_axis(o) for o in load_objects()}
    axes = {name: line[0] for name, line in found.items() if line is not None}
    assert axes.keys() == {"bowl", "cup", "wineglass", "bottle"}
    assert all(abs(axis[2]) > 0.999 for axis in axes.values())


def test_a_pinch_needs_the_grip_of_coulombs_law():
    """Two fingers from both sides of a ball carry it with friction alone: each presses with m g / (2 mu), by the pyramid."""
    inward = np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0]])
    arm = np.array([[-0.03, 0.01, 0], [0.03, 0.01, 0], [-0.03, -0.01, 0], [0.03, -0.01, 0]])
    wrench = friction_edges(arm, inward, FRICTION)  # those that the forces are solved from
    found = linprog(np.ones(wrench.shape[1]), A_eq=wrench, b_eq=[0, 0, 1, 0, 0, 0], method="highs")
    assert found.status == 0
    assert 1 / FRICTION <= found.fun <= 1 / (FRICTION * np.cos(np.pi / CONE_EDGES)) + 1e-9


def test_the_room_of_the_joints_is_that_of_the_joint_that_has_least():
    """Each joint in turn is the one nearest to the end of its range."""
    lower, n = 0.25, 400
    angles = np.zeros((n, 7), np.float32)
    ranges = {2: (0, kernels.ELBOW_DEG), 3: (-kernels.TURN_DEG, kernels.TURN_DEG)}
    ranges |= {4: (-kernels.EXTENSION_DEG, kernels.FLEXION_DEG), 5: (-kernels.RADIAL_DEG, kernels.ULNAR_DEG)}
    rng = np.random.default_rng(2)
    for k, (low, high) in ranges.items():
        angles[:, k] = rng.uniform(low, high, n)
    rooms = {2: (ranges[2][1] - angles[:, 2]) * lower}
    rooms |= {
        k: np.minimum(angles[:, k] - low, high - angles[:, k]) * 0.1 for k, (low, high) in ranges.items() if k > 2
    }
    expected = np.radians(np.stack([*rooms.values()], 1))
    receiver = np.zeros((1, 5, 4), np.float32)
    receiver[0, 1, :3], receiver[0, 2, :3], receiver[0, 3, 3] = (0.3, 0, 0), (0.3, lower, 0), 1.0
    found = wp.zeros(n, dtype=wp.vec2, device="cpu")
    given = [wp.array(receiver, dtype=wp.vec4), wp.zeros(n, dtype=int), wp.array(angles, dtype=kernels.vec7), found]
    wp.launch(kernels.arm_rooms, n, [0, *given], device="cpu")
    assert np.allclose(found.numpy()[:, 1], expected.min(1), atol=1e-6)
    assert set(expected.argmin(1)) == {0, 1, 2, 3}
