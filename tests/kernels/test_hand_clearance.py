"""Gripper against a hand: the kernel agrees with a float64 twin on the same primitives and pieces."""

from functools import cache

import numpy as np
import torch
from convex_twin import bodies, convex_distance
from scipy.spatial.transform import Rotation

from r2h_batch.base.launch import init_warp
from r2h_batch.judge.grasp import gripper_poses
from r2h_batch.judge.hand_clearance import gripper_clearance, posed_hand
from r2h_batch.scene.hand import load_hand, load_hand_set
from r2h_batch.scene.robot import ShapeKind
from r2h_batch.scene.robot_file import load_robot

CAP = 0.004


@cache
def stage() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Vertices of 6 hands, 24 gripper poses about each (from deep inside to clear), openings."""
    init_warp()
    hands = load_hand_set()
    rows = torch.tensor([0, 77, 150, 210, 300, 399])
    vertices = load_hand().pose(hands.pose[rows], hands.shape[rows], hands.side[rows]).vertices
    rng = np.random.default_rng(4)
    T = np.zeros((6, 24, 4, 4), np.float32)
    T[..., 3, 3] = 1
    T[..., :3, :3] = Rotation.random(144, rng).as_matrix().reshape(6, 24, 3, 3)
    for i in range(6):
        touched = vertices[i].numpy()[rng.integers(0, vertices.shape[1], 24)]
        T[i, :, :3, 3] = touched - np.einsum("kij,kj->ki", T[i, :, :3, :3], rng.uniform(-0.06, 0.06, (24, 3)))
    return vertices, torch.from_numpy(T), torch.from_numpy(rng.uniform(0.002, 0.085, (6, 24)).astype(np.float32))


def run(rows: list[int]) -> torch.Tensor:
    vertices, T, opening = stage()
    hand = posed_hand(load_hand(), vertices[rows], "cpu")
    first, count = torch.arange(len(rows)) * 24, torch.full((len(rows),), 24)
    grasps = T[rows].reshape(-1, 4, 4), opening[rows].reshape(-1)
    return gripper_clearance(load_robot(), hand, *grasps, first, count, 24, cap_m=CAP)


def twin(i: int, k: int) -> float:
    """Least distance of all primitives to all pieces, capped, 0 where any two meet."""
    vertices, T, opening = stage()
    model, robot = load_hand(), load_robot()
    R, p = (x[0].double().numpy() for x in gripper_poses(load_robot(), opening[i, k].reshape(1)))
    T_hand_ee = T[i, k].double().numpy()
    G, P = len(p), len(model.pieces)
    prims = np.tile(np.eye(4), (G, 1, 1))
    prims[:, :3, :3], prims[:, :3, 3] = T_hand_ee[:3, :3] @ R, p @ T_hand_ee[:3, :3].T + T_hand_ee[:3, 3]
    pieces = [vertices[i, ids.long()].double().numpy() for ids in model.pieces]
    a = bodies(np.repeat(robot.gripper.kind, P), np.repeat(robot.gripper.size, P, axis=0), np.repeat(prims, P, axis=0))
    most = max(map(len, pieces))
    padded = [np.concatenate([q, np.repeat(q[:1], most - len(q), axis=0)]) for q in pieces]
    b = bodies([ShapeKind.BOX + 1] * G * P, None, np.tile(np.eye(4), (G * P, 1, 1)), padded * G)
    low, high = convex_distance(a, b)
    assert (high - low)[low > 1e-6].max(initial=0) < 1e-6
    return float(np.clip(low.min(), 0, CAP))


def test_clearance_agrees_with_the_twin_and_knows_which_grippers_meet_the_hand():
    found = run(list(range(6))).numpy()
    pairs = [(i, k) for i in range(6) for k in range(0, 24, 4)]
    expected = np.array([twin(i, k) for i, k in pairs])
    got = np.array([found[i, k] for i, k in pairs])
    assert np.abs(got - expected).max() < 5e-5
    clear = (expected > 1e-5).mean()
    assert 0.2 < clear < 0.9 and ((expected > 1e-5) & (expected < CAP)).sum() >= 2


def test_rows_do_not_depend_on_the_batch_and_missing_candidates_count_as_touching():
    whole = run([0, 1, 2, 3, 4, 5])
    assert torch.equal(run([5, 2]), whole[[5, 2]])
    vertices, T, opening = stage()
    hand, few = posed_hand(load_hand(), vertices[:2], "cpu"), (torch.tensor([0, 3]), torch.tensor([24, 5]))
    some = gripper_clearance(load_robot(), hand, T[0], opening[0], *few, 24, cap_m=CAP)
    assert torch.equal(some[0], whole[0]) and (some[1, 5:] == 0).all()
