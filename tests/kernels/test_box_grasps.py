"""Handover-VA's own grasps against a NumPy twin that tries every seed, azimuth and depth one after the other."""

import math
from functools import cache

import numpy as np
import torch

from r2h_batch import load_benchmark
from r2h_batch.methods.box_grasps import box_grasps, depth_steps, three_boxes
from r2h_batch.methods.part_roles import FUNCTION, GRASP, WRAP, roles_of
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.scene.scene import Scene

NAMES = ("cup", "hammer", "pliers", "eyeglasses", "bottle")
STEP, DEPTHS, VOXEL, CROP = 0.05 * math.pi, depth_steps(-0.005, 0.05, 0.0025), 0.02, 0.10


@cache
def scene() -> Scene:
    return Scene(load_benchmark("r2h-v1").with_objects(load_objects(NAMES)))


def roles(rows: list[int]) -> torch.Tensor:
    """The parts' roles, with a tenth of the points mislabelled (differently in every row)."""
    table = roles_of(scene().objects)
    out = np.stack([table[i][scene().objects[i].point_part] for i in rows])
    for k, row in enumerate(out):
        wrong = np.random.default_rng(k).random(len(row)) < 0.1
        row[wrong] = np.where(row[wrong] == GRASP, FUNCTION, GRASP)
    return torch.from_numpy(out)


def run(rows: list[int], role: torch.Tensor):
    return box_grasps(
        scene(), torch.tensor(rows, dtype=torch.int32), role,
        voxel_m=VOXEL, azimuth_step=STEP, depths_m=DEPTHS, crop_m=CROP,
    )  # fmt: skip


def in_boxes(q: np.ndarray) -> np.ndarray:
    """Which points (..., 3) in a grasp's frame lie in a finger or in the rest."""
    finger_low, finger_high, low, high = (c.astype(np.float32) for c in three_boxes(load_robot()))
    mirrored = q * np.array([1, -1, 1], np.float32)
    boxes = [(q, finger_low, finger_high), (mirrored, finger_low, finger_high), (q, low, high)]
    return np.any([((p >= a) & (p <= b)).all(-1) for p, a, b in boxes], axis=0)


def room(seeds: np.ndarray, own: int, y: np.ndarray, depth: float) -> float:
    """Distance from the nearer finger's centre to the nearest other seed, at most CROP."""
    finger_low, finger_high, _, _ = three_boxes(load_robot())
    middle = (finger_low + finger_high) / 2
    others = np.delete(seeds, own, axis=0)
    centers = [seeds[own] + s * middle[1] * y - [0, 0, middle[2] + depth] for s in (1, -1)]
    return min([CROP, *(np.linalg.norm(others - c, axis=1).min(initial=CROP) for c in centers)])


def twin(points: np.ndarray, seeds: np.ndarray, own: int) -> tuple[float, int, int]:
    """Score, azimuth and depth of one seed."""
    local = points[(np.abs(points - seeds[own]) < CROP).all(1)]
    frames = []
    for a in range(20):
        c, s = np.float32(math.cos(a * STEP)), np.float32(math.sin(a * STEP))
        R = np.array([[-s, c, 0], [c, s, 0], [0, 0, -1]], np.float32)  # rows: x, y, z of the gripper
        q = (local - seeds[own]) @ R.T
        if not in_boxes(q).any():
            frames.append((room(seeds, own, R[1], 0.0), -a, q, R))
    if not frames:
        return -1.0, 0, 0
    _, a, q, R = max(frames, key=lambda f: f[:2])
    free = 0
    while free < len(DEPTHS) and not in_boxes(q - np.array([0, 0, DEPTHS[free]], np.float32)).any():
        free += 1
    if free == 0:
        return -1.0, 0, 0
    return sum(room(seeds, own, R[1], d) for d in DEPTHS[:free]), -a, free // 2


def test_scores_azimuths_and_depths_are_those_of_the_twin():
    rows = [0, 1, 2, 3, 4, 1]
    role = roles(rows)
    found = run(rows, role)
    compared = agree = feasible = 0
    for k, i in enumerate(rows):
        points = scene().objects[i].points
        used = np.flatnonzero(found.used[k].numpy())
        seeds = found.seed[k, used].numpy()
        for j in range(0, len(used), 3):
            score, turn, depth = twin(points, seeds, j)
            T = found.T_obj_ee[k, used[j]].numpy()
            same = abs(float(found.score[k, used[j]]) - score) < 1e-5
            if score > 0:
                R = np.array([-math.sin(turn * STEP), math.cos(turn * STEP), 0])
                same &= np.abs(T[:3, 0] - R).max() < 1e-6
                same &= np.abs(T[:3, 3] - (seeds[j] - [0, 0, DEPTHS[depth]])).max() < 1e-6
                feasible += 1
            compared, agree = compared + 1, agree + same
    assert compared > 80 and feasible > 20
    assert agree >= compared - 1  # a point within rounding of a face


def test_roles_take_s1_handles_from_the_receivers_region_and_s0_handles_from_part_names():
    names = ("hammer", "bottle", "cup", "game_controller", "wineglass")
    objects = load_objects(names)
    table = roles_of(objects)
    said = [{n: int(r) for n, r in zip(o.part_names, row)} for o, row in zip(objects, table, strict=True)]
    assert said[0] == {"grip": GRASP, "shaft": FUNCTION, "head": FUNCTION, "face": FUNCTION, "claw": FUNCTION}
    assert said[1]["base"] == GRASP and said[1]["neck"] == FUNCTION
    assert set(said[2].values()) == {WRAP}
    assert said[3]["grip"] == GRASP and said[3]["body"] == FUNCTION and said[4]["stem"] == GRASP
