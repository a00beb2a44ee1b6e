"""Safe: the exact hand mesh against float64, hands and robots inside one another, margins of overlaps."""

from dataclasses import replace
from functools import cache

import numpy as np
import oracle
import pytest
import torch
import trimesh
from seven import with_boxes, with_hulls

from r2h_batch import load_benchmark
from r2h_batch.judge.distance import SAFE_TOLERANCE_M
from r2h_batch.judge.planner import Planner
from r2h_batch.kernels.judge.safe import safe_distance
from r2h_batch.scene.robot import ee_pose, gripper_primitives_at
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.scene.scene import Scene

CAP_M = 0.05
HOME = np.array([-0.3225, -1.7453, 1.4312, -1.2566, -1.5708, 1.2483])


@cache
def with_hands_scaled(factor):
    """A scene whose hands are `factor` times as large."""
    scene = Scene(load_benchmark("r2h-v1"))
    h = scene.hands
    scene.hands = replace(h, vertices=h.vertices * factor, joints=h.joints * factor, palm_point=h.palm_point * factor)
    return scene


def safe_of(scene, stages, paths):
    """distance, body, segment, fraction, point of every path."""
    n, width = len(paths), max(len(p) for p in paths)
    path = torch.zeros((n, width, 6))
    for k, p in enumerate(paths):
        path[k, : len(p)] = torch.tensor(p, dtype=torch.float32)
    length = torch.tensor([len(p) for p in paths], dtype=torch.int32)
    body, segment = torch.zeros((2, n), dtype=torch.int32).unbind(0)
    found = {"distance": torch.full((n,), -9.0), "body": body, "segment": segment}
    found |= {"fraction": torch.zeros(n), "point": torch.zeros((n, 3))}
    body_poses = oracle.place(scene, stages)
    motion = {"mesh": scene.hand_mesh, "path": path, "length": length}
    asked = {"cap": CAP_M, "tolerance": SAFE_TOLERANCE_M, **motion}
    Planner(scene, body_poses)(safe_distance, n, inputs=asked, outputs=found, chunk=16)
    return [x.numpy() for x in found.values()]


def is_free(scene, stages, q):
    n = len(stages)
    at, rows = torch.tensor(np.array(q), dtype=torch.float32), torch.ones(n, dtype=torch.bool)
    return [x.numpy() for x in Planner(scene, oracle.place(scene, stages)).check(at, rows, 1)]


def stay(q):
    return np.stack([q, q])


@pytest.mark.parametrize("count", [48, pytest.param(240, marks=pytest.mark.slow)])
def test_distances_at_postures_agree_with_the_exact_mesh_and_never_fall_below_the_hulls(scene, count):
    stages, base = oracle.random_stages(scene, np.random.default_rng(1), count)
    found = safe_of(scene, stages, [stay(q) for q in base])[0]
    off, touching = [], 0
    for k, staged in enumerate(stages):
        twin, distance = oracle.mujoco_scene(scene, staged), found[k]
        hull = twin.clearances(base[k], cap=CAP_M).distance["hand"]
        assert distance >= min(hull, CAP_M) - 1e-5 or hull < 0
        if hull > CAP_M:
            continue
        truth = twin.safe_at(oracle.hand_triangles(scene, staged), base[k], cap=CAP_M)
        if truth <= 0:
            assert distance <= -1e-6
            touching += 1
        else:
            off.append(distance - truth)
            assert np.abs(off[-1]) <= 1e-5 or truth >= CAP_M, (k, distance, truth)
    print(f"\n{len(off)} distances, off by at most {np.abs(off).max():.1e} m; {touching} touching")
    assert len(off) >= 12 and touching >= 6


def test_hulls_of_boxes_are_as_far_from_the_hand_along_paths_as_the_boxes():
    boxed = with_boxes(load_robot())
    scenes = Scene(load_benchmark("r2h-v1").on(boxed)), Scene(load_benchmark("r2h-v1").on(with_hulls(boxed)))
    rng = np.random.default_rng(8)
    stages, base = oracle.random_stages(scenes[0], rng, 300)
    paths = [np.stack([q, q + rng.normal(size=6) * 0.2]) for q in base]
    (boxes, body, *_), (hulls, *_) = (safe_of(scene, stages, paths) for scene in scenes)
    apart = (boxes > 0) & (boxes < CAP_M)
    arm = body < len(boxed.arm.kind)
    assert (apart & arm).sum() >= 5 and ((boxes < 0) & arm).sum() >= 5
    assert np.array_equal(boxes > 0, hulls > 0)
    assert np.abs(boxes - hulls)[apart].max() <= 2 * SAFE_TOLERANCE_M + 2e-5


@pytest.mark.parametrize("part", [3, pytest.param(1, marks=pytest.mark.slow)], ids=["third", "all"])
def test_the_smallest_distance_along_paths_is_the_sampled_one_and_its_witness_is_real(scene, part):
    rng = np.random.default_rng(2)
    stages, base = oracle.random_stages(scene, rng, 80)
    paths = []
    for q in base:
        steps = rng.normal(size=(2, 6)) * rng.choice([0.02, 0.1, 0.3])
        paths.append(np.stack([q, q + steps[0], q + steps[0] + steps[1]]).astype(np.float32).astype(np.float64))
    distance, body, segment, fraction, point = safe_of(scene, stages, paths)
    chosen = [
        *np.flatnonzero((distance > 0) & (distance < CAP_M))[: 12 // part],
        *np.flatnonzero(distance < 0)[: 6 // part],
        *np.flatnonzero(distance >= CAP_M)[: 3 // part],
    ]
    off = []
    for k in chosen:
        twin = oracle.mujoco_scene(scene, stages[k])
        truth, _ = twin.safe_along(scene, paths[k], cap=CAP_M, step_rad=1 / 160)
        if truth >= CAP_M:
            assert distance[k] >= np.float32(CAP_M) - 1e-4
            continue
        if truth <= 0:
            assert distance[k] < 1e-4
            continue
        if distance[k] > 0:
            off.append(distance[k] - truth)
            assert -2e-4 <= off[-1] <= 1e-4, (k, distance[k], truth)
        a, b = paths[k][segment[k]], paths[k][segment[k] + 1]
        q = a + fraction[k] * (b - a)
        triangles = oracle.hand_triangles(scene, stages[k])
        there = twin.safe_at(triangles, q, cap=CAP_M)
        assert abs(there - distance[k]) <= 2e-5 or distance[k] < 0
        # the witness is a point of the hand, at that distance from the named part
        nearest = trimesh.triangles.closest_point(triangles, np.tile(point[k], (len(triangles), 1)))
        assert np.linalg.norm(nearest - point[k], axis=1).min() <= 2e-5
        assert abs(twin.distance_to(scene.part_names[body[k]], point[k]) - distance[k]) <= 3e-5 or distance[k] < 0
    print(f"\n{len(off)} paths apart: off by {min(off) * 1e3:.4f} to {max(off) * 1e3:.4f} mm")
    assert len(off) >= 8 // part


def inside_staged(scene, hand, target):
    """A trial whose hand has the middle of its palm at `target` (world)."""
    T = np.eye(4)
    palm = scene.hands.vertices[hand].numpy().astype(np.float64)
    k = scene.hands.model.piece_names.index("palm_middle")
    T[:3, 3] = target - palm[scene.hands.model.pieces[k].numpy()].mean(0)
    return oracle.Staged(0, hand, np.eye(4), T.astype(np.float32).astype(np.float64), np.float32(0.05))


def gripper_body_center(scene, q):
    robot = scene.robot
    k = robot.gripper.names.index("body_0")
    return (ee_pose(robot, q) @ gripper_primitives_at(robot, 0.05)[k])[:3, 3]


@pytest.mark.parametrize("hand", [0, 200], ids=["right", "left"])
@pytest.mark.parametrize("scale", [0.1, 100.0], ids=["hand in the gripper", "robot in the hand"])
def test_one_wholly_inside_the_other_is_a_collision(scale, hand):
    scene = with_hands_scaled(scale)
    target = gripper_body_center(scene, HOME) if scale < 1 else np.array([0.2, 0.0, 0.3])
    staged = inside_staged(scene, hand, target)
    twin = oracle.mujoco_scene(scene, staged)
    assert twin.safe_at(oracle.hand_triangles(scene, staged), HOME) == -1.0  # no surface is met: one holds the other
    clear, pair, _ = is_free(scene, [staged], [HOME])
    assert not clear[0] and pair[0] == 1
    distance, body, *_ = safe_of(scene, [staged], [stay(HOME)])
    assert distance[0] < -0.005 and (scale > 1 or scene.part_names[body[0]] == "body_0")


def test_margins_of_overlaps_grow_with_the_overlap(scene):
    """A hand is pushed into the gripper's flat side: the margin is minus the depth, and falls all the way."""
    start = gripper_body_center(scene, HOME)
    x = ee_pose(scene.robot, HOME)[:3, 0]
    for hand in (37, 200):
        v = scene.hands.vertices[hand].numpy().astype(np.float64)
        along = v @ x
        tip = v[along.argmin()]  # the hand's point that meets the gripper first
        stages, depth = [], np.arange(-0.006, 0.020, 0.001)
        for push in depth:
            T = np.eye(4)
            T[:3, 3] = start + (scene.robot.gripper.size[scene.robot.gripper.names.index("body_0")][0] - push) * x - tip
            stages.append(oracle.Staged(0, hand, np.eye(4), T.astype(np.float32).astype(np.float64), np.float32(0.05)))
        distance, *_ = safe_of(scene, stages, [stay(HOME)] * len(stages))
        assert distance[0] > 0 > distance[-1]
        assert (np.diff(distance) < 1e-5).all(), (hand, distance)
        assert (distance <= 2e-4 - depth).all()  # other parts may be met deeper
