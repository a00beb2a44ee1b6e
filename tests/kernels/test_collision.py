"""Postures, edges and clearances of the planner against MuJoCo C in float64, with attached objects and both hands."""

from collections import Counter
from dataclasses import replace

import numpy as np
import oracle
import pytest
import torch
from convex_twin import bodies, point_to_segment
from rounds import each
from seven import seven_joints, with_hulls

from r2h_batch import load_benchmark
from r2h_batch.base.launch import launch_trials
from r2h_batch.config import EvalConfig, PlanConfig
from r2h_batch.judge.plan import CLEARANCE_TOLERANCE_M
from r2h_batch.judge.planner import Planner
from r2h_batch.kernels.plan.codes import CERTIFY
from r2h_batch.kernels.plan.lines import path_clearance, straight_lines
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot import ShapeKind, ee_pose, forward_kinematics, gripper_primitives_at, lever_bound_for_sphere
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.scene.scene import Scene
from r2h_batch.types import CollidingPair

BAND_M = 1e-4
"""Inside it float32 may decide either way."""

CAP_M = 0.05


def postures_near(rng, base, n):
    """Half about a posture that is near the hand, half anywhere."""
    spread = rng.choice([0.03, 0.15, 0.5], (n, 1))
    q = base + rng.normal(size=(n, len(base))) * spread
    q[n // 2 :] = rng.uniform(-np.pi, np.pi, (n - n // 2, len(base)))
    return q.astype(np.float32).astype(np.float64)


def check(scene, body_poses, q):
    per_trial = q.shape[1]
    flat = torch.tensor(q.reshape(-1, q.shape[2]), dtype=torch.float32)
    out = Planner(scene, body_poses).check(flat, torch.ones(len(flat), dtype=torch.bool), per_trial)
    return [x.numpy().reshape(q.shape[:2]) for x in out]


def compare_postures(scene, trials, per_trial, seed):
    rng = np.random.default_rng(seed)
    stages, base = oracle.random_stages(scene, rng, trials)
    q = np.stack([postures_near(rng, b, per_trial) for b in base])
    clear, pair, hand_room = check(scene, oracle.place(scene, stages), q)
    wrong, borderline, alone, free, near = [], 0, Counter(), 0, 0
    for k, staged in enumerate(stages):
        twin = oracle.mujoco_scene(scene, staged)
        for i in range(per_trial):
            found = twin.clearances(q[k, i], cap=0.008)
            met = [c for c in oracle.CLASSES if found.distance[c] < 0]
            if abs(found.least) < BAND_M:
                borderline += 1
                continue
            if bool(clear[k, i]) != (found.least > 0):
                wrong.append((k, i, found))
                continue
            if not met:
                free += 1
                room = min(found.distance["hand"], found.distance["object_hand"], 0.0065)
                near += room < 0.0065
                if not -2e-5 <= room - hand_room[k, i] <= 2e-5:
                    wrong.append((k, i, "hand room", room, hand_room[k, i]))
            else:
                if len(met) == 1:
                    alone[met[0]] += 1
                named = oracle.CLASSES[pair[k, i] - 1]
                if found.distance[named] >= BAND_M:
                    wrong.append((k, i, "pair", named, found))
    print(f"\n{trials * per_trial} postures: {free} free ({near} with the hand within 6.5 mm), {borderline} borderline, "
          f"one class alone: {dict(alone)}, disagreements: {len(wrong)}")  # fmt: skip
    return wrong, alone, borderline


@pytest.mark.parametrize(
    ("trials", "per_trial", "least", "seed"), [(20, 200, 5, 1), pytest.param(400, 250, 100, 2, marks=pytest.mark.slow)]
)
def test_verdicts_on_postures_agree_with_mujoco_c(scene, trials, per_trial, least, seed):
    wrong, alone, borderline = compare_postures(scene, trials, per_trial, seed=seed)
    assert not wrong, wrong[:3]
    assert set(alone) == set(oracle.CLASSES) and min(alone.values()) >= least
    assert borderline < 0.01 * trials * per_trial


@pytest.mark.parametrize(
    "robot",
    [
        load_robot("ur3e_2f85"),
        pytest.param(load_robot("ur10e_2f85"), marks=pytest.mark.slow),
        load_robot("panda_hand"),
        pytest.param(seven_joints(), marks=pytest.mark.slow),
        with_hulls(load_robot()),
    ],
    ids=lambda r: r.name,
)
def test_verdicts_on_postures_of_other_arms_agree_with_mujoco_c(robot):
    wrong, alone, _ = compare_postures(Scene(load_benchmark("r2h-v1").on(robot)), 6, 150, seed=4)
    assert not wrong, wrong[:3]
    assert min(alone[c] for c in ("hand", "table", "self", "object_hand")) >= 2


def test_verdicts_agree_with_convex_pieces_of_objects_too():
    config = replace(EvalConfig(), plan=PlanConfig(object_collision="pieces"))
    wrong, _, _ = compare_postures(
        Scene(load_benchmark("r2h-v1").with_objects(load_objects(["cup", "hammer"])), config=config), 6, 100, seed=3
    )
    assert not wrong, wrong[:3]


def free_edges(scene, rng, trials, hand_margin):
    """Staged trials, their edges (start, end) that straight_lines calls free, and the number of those it does not."""
    stages, base = oracle.random_stages(scene, rng, trials)
    q = np.stack([postures_near(rng, b, 60) for b in base])
    placed8 = oracle.place(scene, [s for s in stages for _ in range(8)])
    clear, _, room = check(scene, oracle.place(scene, stages), q)
    result = []
    for k in range(trials):
        good = np.flatnonzero(clear[k] & (room[k] > hand_margin + 1e-4))
        if len(good) < 9:
            continue
        ends = q[k, good[1:9]]
        start = torch.tensor(q[k, good[:1]], dtype=torch.float32).repeat(8 * trials, 1)
        goals = torch.zeros((8 * trials, 8, 6), dtype=torch.float32)
        goals[8 * k : 8 * k + 8, 0] = torch.tensor(ends, dtype=torch.float32)
        count = torch.ones(8 * trials, dtype=torch.int32)
        margin = torch.full((8 * trials * 8,), hand_margin, dtype=torch.float32)
        chosen = torch.full((8 * trials,), -1, dtype=torch.int32)
        inputs = {
            "edge_mode": int(CERTIFY),
            "world": scene.world,
            "bodies": placed8.bodies,
            "start": start,
            "goals": goals.view(-1, 6),
        }
        inputs |= {"n_goals": count, "goal_margin": margin}
        launch_trials(straight_lines, 8, inputs=inputs, outputs={"chosen": chosen}, first=8 * k, device="cpu")
        kept = ends[chosen[8 * k : 8 * k + 8].numpy() == 0]
        result.append((stages[k], [np.stack([q[k, good[0]], e]) for e in kept], 8 - len(kept)))
    return result


def recheck_edges(scene, rng, trials, hand_margin):
    """Samples every edge certified free in MuJoCo C at 1/320 rad; how many were certified and refused."""
    margins = {"hand": hand_margin, "object_hand": hand_margin}
    certified, refused, least = 0, 0, 1.0
    for staged, edges, no in free_edges(scene, rng, trials, hand_margin):
        twin = oracle.mujoco_scene(scene, staged)
        refused += no
        for edge in edges:
            certified += 1
            slack, name, q = twin.least_along(edge, margins=margins, cap=0.02)
            least = min(least, slack)
            assert slack > -1e-6, (staged, name, q.tolist())
    print(f"\n{certified} edges certified free ({refused} refused), least beyond the margin {least * 1e3:.3f} mm")
    return certified, refused


@pytest.mark.parametrize("hand_margin", [0.0, 0.003])
@pytest.mark.parametrize(
    ("trials", "seed", "least"), [(8, 4, 7), pytest.param(400, 14, 1000, marks=pytest.mark.slow)], ids=["8", "400"]
)
def test_edges_certified_free_never_penetrate_when_sampled_densely(scene, hand_margin, trials, seed, least):
    certified, refused = recheck_edges(scene, np.random.default_rng(seed), trials, hand_margin)
    assert certified >= least and refused >= 5


def test_an_edge_from_beside_the_table_into_its_side_is_not_free(scene):
    """Short edges between postures that reach below the table's top in front of it: against postures close together."""
    rng = np.random.default_rng(0)
    stages, _ = oracle.random_stages(scene, rng, 1)
    stages[0].T_world_hand[2, 3] += 3.0  # no hand is near

    def free(q):
        clear, pair, _ = check(scene, oracle.place(scene, stages), q.reshape(1, -1, 6))
        return clear.reshape(q.shape[:-1]), pair.reshape(q.shape[:-1])

    q = rng.uniform([-0.7, -1.2, 0.2, -3, -3, -3], [0.7, 0.4, 2.2, 3, 3, 3], (20_000, 6)).astype(np.float32)
    height = ee_pose(scene.robot, q)[:, 2, 3]
    q = q[(height > -0.25) & (height < -0.01)]
    a = np.repeat(q[free(q)[0]], 4, 0)
    b = a + rng.normal(size=a.shape).astype(np.float32) * np.float32(0.15)
    a, b = (x[free(b)[0]] for x in (a, b))
    n, s = len(a), np.linspace(0, 1, 65)[:, None]
    clear, pair = free(a[:, None] * (1 - s) + b[:, None] * s)
    goals = torch.zeros((n, 8, 6))
    goals[:, 0] = torch.from_numpy(b)
    count, margin = torch.ones(n, dtype=torch.int32), torch.zeros(8 * n)
    planner = Planner(scene, oracle.place(scene, stages * n))
    certified = planner.straight(torch.from_numpy(a), goals.flatten(0, 1), count, margin, int(CERTIFY)).numpy() == 0
    assert not (certified & ~clear.all(1)).any(), "a part of the arm goes through the table"
    into = ((pair == int(CollidingPair.TABLE)) | (pair == int(CollidingPair.OBJECT_TABLE))) & ~clear
    assert into.any(1).sum() > 20 and certified.sum() > 0.99 * clear.all(1).sum()


def clearance_of(scene, body_poses, paths):
    n = len(paths)
    width = max(len(p) for p in paths)
    path = torch.zeros((n, width, 6))
    for k, p in enumerate(paths):
        path[k, : len(p)] = torch.tensor(p, dtype=torch.float32)
    length = torch.tensor([len(p) for p in paths], dtype=torch.int32)
    least, (pair, body) = torch.full((n,), -9.0), torch.full((2, n), -1, dtype=torch.int32).unbind(0)
    inputs = {"cap": CAP_M, "tolerance": CLEARANCE_TOLERANCE_M, "without": -9.0, "path": path, "length": length}
    outputs = {"clearance": least, "pair": pair, "body": body}
    Planner(scene, body_poses)(path_clearance, n, inputs=inputs, outputs=outputs, chunk=8)
    return least.numpy(), pair.numpy(), body.numpy()


def test_path_clearance_is_the_smallest_sampled_one(scene):
    rng = np.random.default_rng(5)
    stages, base = oracle.random_stages(scene, rng, 200)
    paths = []
    for b in base:
        steps = rng.normal(size=(2, 6)) * rng.choice([0.02, 0.1, 0.3])
        paths.append(np.stack([b, b + steps[0], b + steps[0] + steps[1]]).astype(np.float32).astype(np.float64))
    least, pair, body = clearance_of(scene, oracle.place(scene, stages), paths)
    kinds = ((least > 0) & (least < CAP_M), 20), (least <= 0, 8), (least == CAP_M, 2)
    chosen = [k for rows, count in kinds for k in np.flatnonzero(rows)[:count]]
    off, pairs = [], Counter()
    for k in chosen:
        truth, name, _ = oracle.mujoco_scene(scene, stages[k]).least_along(paths[k], cap=CAP_M, step_rad=1 / 160)
        if truth > CAP_M:
            assert least[k] >= np.float32(CAP_M) - 2 * BAND_M
        elif truth < BAND_M:
            assert least[k] < 2 * BAND_M
        else:
            off.append(least[k] - truth)
            pairs[name] += 1
            assert -2e-4 <= off[-1] <= 1e-4, (k, least[k], truth, name)
            assert 0 <= body[k] <= len(scene.part_names) - 1 and 1 <= pair[k] <= 6
    print(f"\n{len(off)} paths, nearest {dict(pairs)}: off by {min(off) * 1e3:.3f} to {max(off) * 1e3:.3f} mm")
    assert len(off) >= 15 and len(pairs) >= 3


def test_the_clearance_of_a_posture_that_is_held_is_exact(scene):
    """No motion and no tolerance: pairs that are nearly as near as the nearest do not pass for nearer."""
    stages, base = oracle.random_stages(scene, np.random.default_rng(7), 150)
    least, _, _ = clearance_of(scene, oracle.place(scene, stages), [np.stack([q, q]) for q in base])
    rows = np.flatnonzero((least > BAND_M) & (least < CAP_M - BAND_M))[:25]
    truth = [oracle.mujoco_scene(scene, stages[k]).clearances(base[k], cap=CAP_M).least for k in rows]
    assert len(rows) == 25
    np.testing.assert_allclose(least[rows], truth, atol=2e-5)


def test_object_motion_radii_bound_every_point_and_match_the_robots_own_bound(scene):
    rng = np.random.default_rng(6)
    stages, _ = oracle.random_stages(scene, rng, 12)
    body_poses = oracle.place(scene, stages)
    motion_radius = body_poses.object_motion_radius.numpy()
    world = scene.world
    first, c0, c1, radius = (getattr(world, n).numpy() for n in ("hull_first", "hull_c0", "hull_c1", "hull_radius"))
    q = rng.uniform(-np.pi, np.pi, (150, 6))
    T_world_link = forward_kinematics(scene.robot, q)
    for k, staged in each(enumerate(stages)):
        T_wrist_obj = scene.robot.T_wrist3_flange @ scene.robot.T_flange_ee @ np.linalg.inv(staged.T_obj_ee)
        expected = np.zeros(6)
        for h in range(first[staged.object_index], first[staged.object_index + 1]):
            for c in (c0[h], c1[h]):
                center = T_wrist_obj[:3, :3] @ c + T_wrist_obj[:3, 3]
                expected = np.maximum(expected, lever_bound_for_sphere(scene.robot, 6, center, float(radius[h])))
        assert np.abs(motion_radius[k] - expected).max() <= 1e-5
        points = scene.objects[staged.object_index].hull_vertices @ T_wrist_obj[:3, :3].T + T_wrist_obj[:3, 3]
        world_points = np.einsum("qij,nj->qni", T_world_link[:, 6, :3, :3], points) + T_world_link[:, 6, None, :3, 3]
        for j in range(6):
            x = world_points - T_world_link[:, j + 1, None, :3, 3]
            axis = T_world_link[:, j + 1, None, :3, 2]
            away = np.linalg.norm(x - (x * axis).sum(-1, keepdims=True) * axis, axis=-1)
            assert away.max() <= motion_radius[k, j], (k, j)


def boundary_points(kind, size, rng, n=400):
    """Points of a primitive's surface that reach farthest in random directions, its frame."""
    d = rng.normal(size=(n, 3))
    one = bodies([kind] * n, [size] * n, np.tile(np.eye(4), (n, 1, 1)))
    return one.support(d) + one.ball[:, None] * d / np.linalg.norm(d, axis=1)[:, None]


def test_bounding_capsules_and_motion_radii_hold_their_bodies_at_every_opening(scene):
    rng = np.random.default_rng(7)
    w, robot = scene.world, scene.robot
    kind, size, link = w.kind.numpy(), w.size.numpy().astype(np.float64), w.body_link.numpy()
    axis, cap, motion_radius = w.cap_axis.numpy(), w.cap_radius.numpy(), w.motion_radius.numpy()
    c0, c1, radius, link_motion_radius = (
        getattr(w, n).numpy() for n in ("link_c0", "link_c1", "link_radius", "link_motion_radius")
    )
    T_wrist_ee = robot.T_wrist3_flange @ robot.T_flange_ee
    q = rng.uniform(-np.pi, np.pi, (60, 6))
    T_world_link = forward_kinematics(robot, q)
    body_R, body_p = w.body_R.numpy(), w.body_p.numpy()
    for b in each(range(w.n_robot)):
        x = boundary_points(kind[b], size[b], rng, 150)
        assert point_to_segment(x, -axis[b], axis[b]).max() <= cap[b] + 1e-7
        assert abs(w.radius.numpy()[b] - (size[b, 0] if kind[b] <= ShapeKind.CAPSULE else 0.0)) < 1e-9
        if b < w.n_arm:
            poses = [np.block([[body_R[b], body_p[b][:, None]], [np.zeros((1, 3)), 1.0]])]
        else:
            openings = np.concatenate([[0.0015, 0.086], rng.uniform(0.0015, 0.086, 6)])
            poses = T_wrist_ee @ gripper_primitives_at(robot, openings)[:, b - w.n_arm]
        carrier = min(link[b], 6)
        for T in poses:
            y = x @ T[:3, :3].T + T[:3, 3]
            assert point_to_segment(y, c0[link[b]], c1[link[b]]).max() <= radius[link[b]] + 1e-7, (b, link[b])
            z = np.einsum("qij,nj->qni", T_world_link[:, carrier, :3, :3], y) + T_world_link[:, carrier, None, :3, 3]
            for j in range(carrier):
                r = z - T_world_link[:, j + 1, None, :3, 3]
                a = T_world_link[:, j + 1, None, :3, 2]
                away = np.linalg.norm(r - (r * a).sum(-1, keepdims=True) * a, axis=-1).max()
                assert away - 1e-7 <= motion_radius[b, j] <= link_motion_radius[link[b], j], (b, j)


def test_bounding_capsules_and_balls_of_hulls_pieces_and_hands_hold_their_points(scene):
    w = scene.world
    points = w.points.numpy()
    start, c0, c1, radius = (getattr(w, n).numpy() for n in ("hull_start", "hull_c0", "hull_c1", "hull_radius"))
    for h in range(len(radius)):
        own = points[start[h] : start[h + 1]].astype(np.float64)
        assert point_to_segment(own, c0[h], c1[h]).max() <= radius[h] + 1e-7
    start, center, ball = w.piece_start.numpy(), w.piece_center.numpy(), w.piece_radius.numpy()
    start = np.append(start, start[-1] + 16 * w.piece_blocks.numpy()[-1])
    assert np.array_equal(np.diff(start), 16 * w.piece_blocks.numpy()) and not w.piece_round.numpy().any()
    piece = np.repeat(np.arange(len(center)), np.diff(start))
    # 16 points a block, their x, y and z one after the other
    inside = points[: start[-1]].reshape(-1, 3, 16).transpose(0, 2, 1).reshape(-1, 3)
    assert (np.linalg.norm(inside - center[piece], axis=1) <= ball[piece] + 1e-7).all()
    hand = piece // w.n_pieces
    assert (np.linalg.norm(inside - w.hand_center.numpy()[hand], axis=1) <= w.hand_radius.numpy()[hand] + 1e-7).all()
    hulls, ids = scene.hands.set.hull_offsets.numpy(), scene.hands.set.hull_vertex_ids.numpy()
    vertices = scene.hands.vertices.numpy()
    for i in (0, 7, len(center) - 1):
        own = vertices[i // w.n_pieces, ids[hulls[i] : hulls[i + 1]]]
        assert np.array_equal(np.unique(inside[start[i] : start[i + 1]], axis=0), np.unique(own, axis=0))
