"""Builds ``handset.npz``: python -m r2h_batch.assets.hand.build_handset, after build_hand. Deterministic, some six CPU minutes.

200 right and 200 left receiving postures. Hand i is drawn from Philox(SEED, i) until it keeps the joint ranges and cuts
nowhere deeper than 2 mm into itself, so hand i does not depend on the others.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.assets.hand.measure import hull_overlap, hull_planes, piece_report, self_cut, separate_pairs
from r2h_batch.scene.arrays import arrays_digest, asset, read_arrays
from r2h_batch.scene.hand import HandModel

HERE = Path(__file__).parent
SEED = 0x52324848  # "R2HH"
PER_SIDE = 200
MAX_CUT_M = 0.002
MEASURE_EVERY = 17  # the share of the set whose hulls are measured against the mesh: prime to the six postures
POSTURES = ("open_flat", "cupped", "grip_cylinder", "pinch", "hook", "relaxed")
FINGERS = ("index", "middle", "pinky", "ring")
# Fraction of a posture's spread that each finger turns towards the thumb's side.
FAN = {"index": 1.0, "middle": 0.2, "ring": -0.6, "pinky": -1.2}
# Anatomical ranges in degrees: flexion, abduction (towards the thumb), twist, as turns about joint_axes.
WRIST_RANGE = ((-20, 20), (-12, 12), (-10, 10))
FINGER_RANGE = (((-20, 90), (-20, 20), (-5, 5)), ((-5, 110), (-1, 1), (-1, 1)), ((-5, 80), (-1, 1), (-1, 1)))
THUMB_RANGE = (((-15, 45), (-25, 30), (-30, 30)), ((-10, 60), (-10, 10), (-5, 5)), ((-15, 80), (-1, 1), (-1, 1)))
JOINT_RANGE_DEG = np.array([WRIST_RANGE, *(FINGER_RANGE * 4), *THUMB_RANGE], dtype=float)  # (16,3,2)

# Degrees, uniform: flexion of MCP, PIP, DIP; spread; thumb root flexion, abduction, twist; thumb flexion 2, 3.
# A finger named in a posture replaces the common ranges of its three joints.
RANGES: dict[str, dict[str, tuple]] = {
    "open_flat": {
        "flex": ((-10, 8), (0, 10), (0, 8)), "spread": (-2, 8),
        "thumb": ((-8, 6), (-8, 12), (-8, 8), (-4, 10), (-8, 10)),
    },
    "cupped": {
        "flex": ((18, 34), (18, 36), (10, 22)), "spread": (-3, 1),
        "thumb": ((0, 14), (-12, 4), (-5, 12), (4, 18), (4, 20)),
    },
    "grip_cylinder": {
        "flex": ((28, 48), (34, 58), (18, 34)), "spread": (-2, 3),
        "thumb": ((2, 22), (-4, 16), (0, 22), (6, 24), (6, 30)),
    },
    "pinch": {
        "flex": ((22, 44), (28, 54), (14, 30)), "spread": (-2, 2),
        "index": ((38, 56), (36, 52), (16, 30)),
        "thumb": ((10, 26), (-10, 8), (8, 26), (8, 26), (6, 30)),
    },
    "hook": {
        "flex": ((-4, 16), (58, 86), (34, 56)), "spread": (-2, 2),
        "thumb": ((-6, 10), (-8, 8), (-6, 8), (0, 16), (0, 20)),
    },
    "relaxed": {
        "flex": ((12, 28), (18, 38), (8, 18)), "spread": (-2, 3),
        "thumb": ((-2, 12), (-12, 4), (-4, 10), (4, 18), (4, 20)),
    },
}  # fmt: skip


def draw_angles(rng: np.random.Generator, posture: str) -> np.ndarray:
    """(16,3) degrees: flexion, abduction, twist of a right hand's joints."""
    ranges, angles = RANGES[posture], np.zeros((16, 3))

    def between(pair: tuple[float, float]) -> float:
        return pair[0] + (pair[1] - pair[0]) * rng.random()

    angles[0] = [between((-15, 15)), between((-8, 8)), between((-6, 6))]
    closure, spread = rng.random(3), between(ranges["spread"])
    for f, name in enumerate(FINGERS):
        for k, pair in enumerate(ranges.get(name, ranges["flex"])):
            # Fingers bend together: two thirds of the range is common, one third each finger's own.
            share = np.clip(0.67 * closure[k] + 0.33 * rng.random(), 0, 1)
            angles[1 + 3 * f + k, 0] = pair[0] + (pair[1] - pair[0]) * share
        angles[1 + 3 * f, 1] = FAN[name] * spread + between((-1.0, 1.0))
    angles[13] = [between(ranges["thumb"][0]), between(ranges["thumb"][1]), between(ranges["thumb"][2])]
    angles[14, 0], angles[15, 0] = between(ranges["thumb"][3]), between(ranges["thumb"][4])
    return angles


def pose_from_angles(angles_deg: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(48,) axis-angle pose of a right hand: twist, then abduction, then flexion about the fixed axes."""
    local = Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()
    return Rotation.from_matrix(axes @ local @ axes.transpose(0, 2, 1)).as_rotvec().reshape(48)


def angles_from_pose(pose: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(16,3) degrees: what :func:`pose_from_angles` was given."""
    turns = Rotation.from_rotvec(pose.reshape(16, 3)).as_matrix()
    return Rotation.from_matrix(axes.transpose(0, 2, 1) @ turns @ axes).as_euler("XYZ", degrees=True)


def mirrored(pose: np.ndarray) -> np.ndarray:
    """The left hand's pose for a right hand's, and back (mirror in x)."""
    return (pose.reshape(16, 3) * [1.0, -1.0, -1.0]).reshape(48)


def piece_hulls(vertices: np.ndarray, pieces: list[np.ndarray]) -> list[np.ndarray]:
    """For every piece the mesh vertices on its convex hull, ascending."""
    return [np.sort(ids[ConvexHull(vertices[ids]).vertices]).astype(np.int32) for ids in pieces]


class Judge:
    """Poses one hand and measures how deep it cuts into itself."""

    def __init__(self, model: HandModel) -> None:
        self.model = model
        self.faces = model.faces.numpy()
        self.pieces = [p.numpy() for p in model.pieces]
        self.pairs = separate_pairs(self.pieces)

    def vertices(self, pose: np.ndarray, shape: np.ndarray, side: int) -> np.ndarray:
        return self.model.pose(
            torch.from_numpy(pose)[None], torch.from_numpy(shape)[None], torch.tensor([side])
        ).vertices[0].double().numpy()  # fmt: skip

    def cuts(self, vertices: np.ndarray) -> tuple[float, float]:
        """(overlap of separate pieces' hulls, cut of the mesh into itself) in metres for a right hand's vertices."""
        overlap = hull_overlap(vertices, piece_hulls(vertices, self.pieces), self.pairs)
        if overlap > MAX_CUT_M:
            return overlap, np.inf
        return overlap, self_cut(vertices, self.faces, [hull_planes(vertices[p]) for p in self.pieces], self.pieces)


def draw_hand(index: int, judge: Judge) -> tuple[np.ndarray, np.ndarray, str, tuple[float, float], int]:
    """Right-hand pose, shape, posture name, cuts and number of draws of hand ``index``."""
    axes = judge.model.joint_axes.double().numpy()
    rng = np.random.Generator(np.random.Philox(key=[SEED, index]))
    posture = POSTURES[index % len(POSTURES)]
    for draws in range(1, 200):
        angles = draw_angles(rng, posture)
        shape = np.clip(0.6 * rng.standard_normal(10), -1.5, 1.5).astype(np.float32)
        if np.any(angles < JOINT_RANGE_DEG[..., 0]) or np.any(angles > JOINT_RANGE_DEG[..., 1]):
            continue
        pose = pose_from_angles(angles, axes).astype(np.float32)
        cuts = judge.cuts(judge.vertices(pose, shape, 0))
        if max(cuts) <= MAX_CUT_M:
            return pose, shape, posture, cuts, draws
    raise RuntimeError(f"hand {index} ({posture}): no posture without self-penetration in 200 draws")


def main() -> None:
    torch.set_num_threads(1)
    judge = Judge(HandModel.from_arrays(read_arrays(asset("hand", "hand.npz"))))  # as it is now on disk
    poses: list[np.ndarray] = []
    shapes: list[np.ndarray] = []
    hulls: list[np.ndarray] = []
    names: list[str] = []
    cuts: list[tuple[float, float]] = []
    draws: list[int] = []
    for i in range(2 * PER_SIDE):
        pose, shape, posture, cut, tried = draw_hand(i, judge)
        side = i // PER_SIDE
        pose = mirrored(pose).astype(np.float32) if side else pose
        hulls += piece_hulls(judge.vertices(pose, shape, side), judge.pieces)
        poses.append(pose)
        shapes.append(shape)
        names.append(posture)
        cuts.append(cut)
        draws.append(tried)
        if i % 50 == 49:
            print(f"{i + 1} hands, {sum(draws)} draws", file=sys.stderr)
    arrays: dict[str, np.ndarray] = {
        "pose": np.array(poses, np.float32),
        "shape": np.array(shapes, np.float32),
        "side": np.repeat([0, 1], PER_SIDE).astype(np.int8),
        "posture": np.array(names, dtype="<U16"),
        "hull_vertex_ids": np.concatenate(hulls).astype(np.int32),
        "hull_offsets": np.cumsum([0] + [len(h) for h in hulls]).astype(np.int32),
    }
    write_npz(HERE / "handset.npz", arrays)
    worst = np.array(cuts)
    faces = judge.model.faces_by_side.numpy()
    piece_names = judge.model.piece_names
    wraps = [
        piece_report(
            judge.vertices(poses[i], shapes[i], i // PER_SIDE), faces[i // PER_SIDE], judge.pieces, piece_names
        )
        for i in range(0, 2 * PER_SIDE, MEASURE_EVERY)
    ]
    report = json.loads((HERE / "report.json").read_text())
    report["handset"] = {
        "hands": len(poses),
        "digest": arrays_digest(arrays),
        "draws": int(sum(draws)),
        "postures": {n: names.count(n) for n in POSTURES},
        "self_cut_max_mm": round(1000 * float(worst[:, 1].max()), 3),
        "separate_pieces_overlap_max_mm": round(1000 * float(worst[:, 0].max()), 3),
        "hands_measured": len(wraps),
        "overshoot_mean_mm": round(float(np.mean([w["overshoot_mean_mm"] for w in wraps])), 3),
        "overshoot_max_mm": max(w["overshoot_max_mm"] for w in wraps),
        "inside_samples": sum(w["inside_samples"] for w in wraps),
        "inside_samples_missed": sum(w["inside_samples_missed"] for w in wraps),
        "hull_vertices_max": int(max(len(h) for h in hulls)),
        "hull_vertices_mean": round(float(np.mean([len(h) for h in hulls])), 1),
    }
    (HERE / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report["handset"]))


if __name__ == "__main__":
    main()
