"""A method that sees: it takes hold of the cloud across a thin place and presents the rest to the palm.

    r2h-batch sweep --method seen=examples/grasp_seen.py:predict --sees cell-v1 --trials 50 --out runs/seen

Of many gripper poses about the cloud it keeps those that have points between the pads, fit the stroke and have no point
inside the gripper. What no camera saw is taken to reach down to the table, so that a thing that lies flat has a thickness.
Where the receiver's region is told (`--sees cell-v1,region=told`), a pose with points of it between the pads comes last.
"""

import numpy as np
import torch

FINGER = np.array([[-0.011, 0.0425, -0.0284], [0.011, 0.0758, 0.0073]])
HOUSING = np.array([[-0.0394, -0.0744, -0.1534], [0.0394, 0.0744, -0.0284]])
"""Boxes (low and high corner, ee frame, m) of the open 2F-85: the finger at +y (the other is its mirror image), and the rest."""
PAD = np.array([0.009, 0.010])
"""Half sizes of what a pad touches, along x and z, m."""
WIDTHS = (0.004, 0.070)
FREE_M = 0.004
"""Kept free about the gripper: noise, and what lies between two points."""
POINTS, SPACING_M = 700, 0.008


def predict(seen, *, seed=0):
    """T_world_grasp, T_world_ee (N, 4, 4)."""
    cloud, mask = seen.cloud(2048)
    wanted = torch.zeros_like(mask) if seen.region is None else seen.cloud_region(2048)
    found = []
    for i in range(len(seen)):
        draw = np.random.default_rng([seed, int(seen.key[i])])  # the same in any batch
        points = without_strays(cloud[i][mask[i]].double().numpy())
        palm, normal = (x[i].double().numpy() for x in (seen.receiver.palm, seen.receiver.normal))
        if len(points) < 20:  # a camera may miss the object
            found.append((np.eye(4), np.eye(4)))
            continue
        T_world_grasp = grasp(points, draw, cloud[i][wanted[i]].double().numpy())
        found.append((T_world_grasp, presented(points, T_world_grasp, palm, normal)))
    grasps, handovers = (torch.from_numpy(np.stack(poses)) for poses in zip(*found, strict=True))
    return grasps, handovers


def without_strays(points):
    """Points with neighbours: flying pixels and what shows through at the rim have few."""
    if len(points) < 20:
        return points
    squares = (points**2).sum(1)
    away = np.sort(squares[:, None] + squares - 2 * points @ points.T, 1)[:, 1:9].mean(1)
    return points[away < 4 * np.median(away) + 1e-6]


def to_the_table(points):
    """The cloud with what stands below it, down to the lowest points."""
    low = max(0.0, points[:, 2].min())
    below = [points]
    for k in range(1, 1 + int(np.ptp(points[:, 2]) / SPACING_M)):
        lower = points[points[:, 2] - k * SPACING_M > low] - (0, 0, k * SPACING_M)
        below.append(lower[:: max(1, len(lower) // 300)])
    return np.concatenate(below)


def grasp(points, draw, region):
    """The best of many poses about the cloud: points between the pads, none of the receiver's region, and none in the gripper."""
    points = draw.permutation(points)[:POINTS]
    solid = to_the_table(points)
    middle = points.mean(0)
    axes = np.linalg.eigh(np.cov((points - middle).T))[1].T  # short to long
    best, top = None, -np.inf
    for z in (*axes, *-axes, (0, 0, -1.0), (0.7, 0, -0.7), (0.7, 0.5, -0.5), (0.7, -0.5, -0.5)):
        z = np.array(z) / np.linalg.norm(z)
        if z[2] > 0.3:  # from below
            continue
        side = np.cross(z, axes[2] if abs(z @ axes[2]) < 0.9 else axes[0])
        side /= np.linalg.norm(side)
        for angle in np.pi * np.arange(4) / 4:
            y = np.cos(angle) * side + np.sin(angle) * np.cross(z, side)
            R = np.stack([np.cross(y, z), y, z], 1)
            local = solid @ R
            for seed in draw.choice(len(points), min(24, len(points)), replace=False):
                at = points[seed] @ R + (0, 0, 0.006)
                centre, width = between_pads(local, at)
                if centre is None or not WIDTHS[0] < width < WIDTHS[1] or not is_free(local - centre):
                    continue
                # thin, and far from the middle: the rest is the receiver's
                value = np.linalg.norm(R @ centre - middle) - 0.5 * width - 0.03 * max(z[2], 0.0)
                if (np.abs(region @ R - centre) < (PAD[0], 0.5 * width + FREE_M, PAD[1])).all(1).any():
                    value -= 1.0
                if value > top:
                    best, top = pose(R, R @ centre), value
    if best is None:  # straight down on the middle, across the short side
        y = axes[1] * (1, 1, 0) + (1e-6, 0, 0)
        y /= np.linalg.norm(y)
        z = np.array([0, 0, -1.0])
        best = pose(np.stack([np.cross(y, z), y, z], 1), middle)
    return best


def between_pads(local, at):
    """Where the gripper's middle must be along y, and the width of what is between the pads there."""
    inside = (np.abs(local[:, [0, 2]] - at[[0, 2]]) < PAD).all(1)
    y = np.sort(local[inside, 1])
    if len(y) < 8:
        return None, 0.0
    k = np.searchsorted(y, at[1])
    cuts = np.flatnonzero(np.diff(y) > 0.012) + 1
    part = y[cuts[cuts <= k].max(initial=0) : cuts[cuts > k].min(initial=len(y))]
    if len(part) < 8:
        return None, 0.0
    return np.array([at[0], 0.5 * (part[0] + part[-1]), at[2]]), part[-1] - part[0]


def is_free(points):
    """Whether no point (ee frame) is in the open gripper."""
    mirrored = points * np.sign(points[:, 1:2]) ** (0, 1, 0)
    boxes = ((mirrored, FINGER), (points, HOUSING))
    return not any(((p > box[0] - FREE_M) & (p < box[1] + FREE_M)).all(1).any() for p, box in boxes)


def presented(points, T_world_grasp, palm, normal):
    """The handover pose: the gripper looks into the palm, and what it holds stays 5 cm in front of it."""
    R, p = T_world_grasp[:3, :3], T_world_grasp[:3, 3]
    ahead = ((points - p) @ R[:, 2]).max()
    z = -normal / np.linalg.norm(normal)
    y = np.cross((-1.0, 0, 0), z)
    y /= np.linalg.norm(y)
    return pose(np.stack([np.cross(y, z), y, z], 1), palm + max(0.12, ahead + 0.05) * normal)


def pose(R, p):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T
