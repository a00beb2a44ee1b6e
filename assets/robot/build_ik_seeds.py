"""Chooses the IK seeds offline and writes ik_seeds.npy: python assets/robot/build_ik_seeds.py

A pool of random joint angles (joint 1 relative to the azimuth of the wrist centre) is tried, one seed at a time, on
training targets: random joint angles, handover-like poses and targets close to each singularity. Greedy set cover: the
next seed is the one that solves most pairs of branches that fewer than COVER chosen seeds solve, ties by fewest steps.
"""

from pathlib import Path

import numpy as np
import torch

from r2h_batch.judge.ik import solve_ik
from r2h_batch.kernels.ik.step import STATUS_CONVERGED, STATUS_RESCUED
from r2h_batch.scene.robot import ee_pose, load_robot

POOL = 256
TARGETS = 4000
COVER = 3
MOST = 24


def training_targets(rng: np.random.Generator, n: int) -> torch.Tensor:
    """Poses (4 n, 4, 4): any joint angles, straight elbow or wrist, wrist centre over the shoulder, handover-like."""
    q = rng.uniform(-np.pi, np.pi, (3 * n, 6))
    tiny = 10.0 ** rng.uniform(-4, -1, n) * rng.choice([-1, 1], n)
    q[n : 2 * n, 2] = np.where(rng.random(n) < 0.5, tiny, q[n : 2 * n, 2])
    q[n : 2 * n, 4] = np.where(q[n : 2 * n, 2] == tiny, q[n : 2 * n, 4], tiny)
    # q2 that brings the wrist centre over the shoulder, up to `tiny`
    psi = q[2 * n :, 2] + q[2 * n :, 3]
    x = 0.425 + 0.3922 * np.cos(q[2 * n :, 2]) - 0.0997 * np.sin(psi)
    z = -0.3922 * np.sin(q[2 * n :, 2]) - 0.0997 * np.cos(psi)
    q[2 * n :, 1] = np.arctan2(x, -z) + tiny
    R = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    R[:, :, 0] *= np.sign(np.linalg.det(R))[:, None]
    r, azimuth = rng.uniform(0.45, 0.8, n), rng.uniform(-np.pi, np.pi, n)
    handover = np.tile(np.eye(4), (n, 1, 1))
    handover[:, :3, :3] = R
    handover[:, :3, 3] = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(0.1, 0.7, n)], 1)
    return torch.from_numpy(np.concatenate([ee_pose(load_robot(), q), handover]).astype(np.float32))


def choose(pool: np.ndarray, targets: torch.Tensor) -> np.ndarray:
    """The chosen rows of the pool, in order."""
    solved, steps = [], []
    for seed in pool:
        result = solve_ik(targets, seeds=seed[None])
        converged = (result.status == int(STATUS_CONVERGED)).numpy()
        exists = converged | (result.status == int(STATUS_RESCUED)).numpy()
        solved.append(converged[exists])
        steps.append(result.steps.numpy()[exists].mean())
    table = np.array(solved)
    coverable = np.minimum(table.sum(0), COVER)
    covered = np.zeros(table.shape[1], dtype=int)
    chosen: list[int] = []
    while (covered < coverable).any() and len(chosen) < MOST:
        gain = (table & (covered < coverable)).sum(1)
        gain[chosen] = -1
        chosen.append(int(np.lexsort((steps, -gain))[0]))
        covered += table[chosen[-1]]
        print(f"seed {len(chosen)}: alone {table[chosen[-1]].mean():.6f}, steps {steps[chosen[-1]]:.2f}, "
              f"so far {(covered > 0).mean():.6f}, {COVER} times {(covered >= COVER).mean():.6f}")  # fmt: skip
    return pool[chosen]


def main() -> None:
    rng = np.random.default_rng(20250101)
    pool = rng.uniform(-1, 1, (POOL, 6)) * np.array([0.3, np.pi, np.pi, np.pi, np.pi, np.pi])
    seeds = choose(pool, training_targets(rng, TARGETS))
    np.save(Path(__file__).parent / "ik_seeds.npy", np.round(seeds, 4))


if __name__ == "__main__":
    main()
