"""Builds ``hand.npz`` and ``report.json``: python -m r2h_batch.assets.hand.build_hand. Deterministic, under a minute.

Skin from surface.py, evened by remesh.py; skin weights, shape basis and convex pieces from here.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np

from r2h_batch.assets.hand.measure import piece_report
from r2h_batch.assets.hand.remesh import marching_tetrahedra, remesh
from r2h_batch.assets.hand.surface import (
    AXES,
    DIGITS,
    JOINTS,
    METACARPAL_BASE,
    PARENTS,
    RADII,
    ROOT,
    TIPS,
    cone,
    digit_field,
    skin,
)

HERE = Path(__file__).parent
EDGE_FINGER, EDGE_PALM, EDGE_WRIST = 4.8, 8.2, 12.5
# Half width of the band in which a joint's bend is spread over the skin, mm: root, middle, last joint of a digit.
BLEND = {"finger": (14.0, 9.0, 7.5), "thumb": (16.0, 9.0, 7.0)}
KNUCKLE = 0.5
PALM_PIECES = ("carpus", "palm_index", "palm_middle", "palm_ring", "palm_pinky")


def edge_length(p: np.ndarray) -> np.ndarray:
    """Wanted edge length in mm: short on the digits, long on palm and back, longest on the wrist's stump."""
    field = np.stack([digit_field(p, d) for d in range(5)])
    behind_thumb_mcp = -(p - JOINTS[14]) @ AXES[13, :, 2]
    field[4] = np.maximum(field[4], 0.5 * behind_thumb_mcp)  # the thumb's ball is palm
    distance = field.min(axis=0)
    wrist = np.clip((p[:, 0] + 25.0) / 25.0, 0, 1)
    palm = EDGE_PALM + (EDGE_WRIST - EDGE_PALM) * wrist
    return EDGE_FINGER + (palm - EDGE_FINGER) * np.clip(distance / 8.0, 0, 1)


def build_surface() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V,3) in mm and outward faces of the closed skin."""
    v, f = marching_tetrahedra(skin, np.array([-200.0, -45, -65]), np.array([25.0, 30, 105]), 2.0)
    for scale, rounds in ((0.55, 3), (0.8, 2), (1.0, 8)):

        def size(p: np.ndarray, scale: float = scale) -> np.ndarray:
            return scale * edge_length(p)

        v, f = remesh(skin, size, v, f, rounds)
    order = np.lexsort(np.round(v, 6).T[[1, 2, 0]])
    rank = np.argsort(order)
    return v[order], rank[f]


def smoothstep(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def metacarpal_fields(p: np.ndarray) -> np.ndarray:
    """(V,4) distance to the metacarpal bones of index, middle, ring, pinky."""
    names = ("index", "middle", "ring", "pinky")
    return np.stack([cone(p, np.array(METACARPAL_BASE[n]), np.array(ROOT[n]), 0.1, 0.1) for n in names], axis=1)


def skin_weights(p: np.ndarray) -> np.ndarray:
    """(V,16) weights, rows sum to 1; a vertex follows neighbouring bones only."""
    field = np.stack([digit_field(p, d) for d in range(5)], axis=1)
    fingers = np.exp(-np.maximum(field[:, :4], 0) / 1.5)
    fingers /= fingers.sum(axis=1, keepdims=True)
    palm = metacarpal_fields(p).min(axis=1) - 11.0
    thumb = smoothstep((palm - field[:, 4]) / 22.0 + 0.62)
    belongs = np.concatenate([fingers * (1 - thumb)[:, None], thumb[:, None]], axis=1)
    belongs[belongs < 0.08] = 0.0
    belongs /= belongs.sum(axis=1, keepdims=True)
    weights = np.zeros((len(p), 16))
    for d, name in enumerate(DIGITS):
        reach = np.ones(len(p))
        for k in range(3):
            j = 1 + 3 * d + k
            parent = AXES[j, :, 2] if k == 0 else AXES[j - 1, :, 2]
            normal = parent + AXES[j, :, 2]
            along = (p - JOINTS[j]) @ (normal / np.linalg.norm(normal))
            half = BLEND["thumb" if name == "thumb" else "finger"][k]
            # Wide on the palm's side, where skin folds, and narrow over the knuckle, which keeps its corner.
            height = (p - JOINTS[j]) @ AXES[j, :, 1] / RADII[name][k]
            half = half * (1 - KNUCKLE * np.clip(height, -1, 1))
            beyond = reach * smoothstep(0.5 + 0.5 * along / half)
            weights[:, j - 1 if k else 0] += belongs[:, d] * (reach - beyond)
            reach = beyond
        weights[:, 3 + 3 * d] += belongs[:, d] * reach
    weights[weights < 0.01] = 0.0
    return weights / weights.sum(axis=1, keepdims=True)


def shape_basis(p: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """(V,3,10) and (16,3,10) displacements in mm for one standard deviation, and what each direction means."""
    names = (
        "size", "breadth", "digit_length", "thickness", "digit_girth",
        "palm_length", "thumb_length", "index_to_ring", "little_finger_length", "palm_muscle",
    )  # fmt: skip
    skin_basis, joint_basis = np.zeros((len(p), 3, 10)), np.zeros((16, 3, 10))
    digit_of = np.array([-1] + [d for d in range(5) for _ in range(3)])
    root = np.array([JOINTS[0 if d < 0 else 1 + 3 * d] for d in digit_of])

    def put(i: int, joint_move: np.ndarray, local: np.ndarray) -> None:
        """Direction i: bone j carries its skin along by joint_move[j] and deforms it by local (V,16,3)."""
        joint_basis[:, :, i] = joint_move
        skin_basis[:, :, i] = np.einsum("vj,vjc->vc", weights, joint_move[None] + local)

    def stretch(i: int, rate: np.ndarray) -> None:
        """Direction i: bone j longer by the fraction rate[j] (digits only), everything beyond it pushed outwards."""
        move, local = np.zeros((16, 3)), np.zeros((len(p), 16, 3))
        for j in range(1, 16):
            bone = AXES[j, :, 2]
            if PARENTS[j] > 0:
                move[j] = move[PARENTS[j]] + rate[PARENTS[j]] * (JOINTS[j] - JOINTS[PARENTS[j]])
            along = (p - JOINTS[j]) @ bone
            # Skin behind the joint belongs to the bone before it and must not be pulled back.
            local[:, j] = rate[j] * np.maximum(along, 0)[:, None] * bone
        put(i, move, local)

    def digits(**rate: float) -> np.ndarray:
        return np.array([0.0] + [rate.get(DIGITS[d], 0.0) for d in digit_of[1:]])

    skin_basis[:, :, 0], joint_basis[:, :, 0] = 0.05 * p, 0.05 * JOINTS
    across = np.array([0.0, 0.0, 1.0])
    local = np.zeros((len(p), 16, 3))
    local[:, 0, 2] = 0.045 * p[:, 2]
    put(1, 0.045 * root * across, local)
    stretch(2, digits(index=0.05, middle=0.05, ring=0.05, pinky=0.05, thumb=0.05))
    local = np.zeros((len(p), 16, 3))
    for j in range(16):
        dorsal = AXES[j, :, 1]
        local[:, j] = 0.06 * ((p - JOINTS[j]) @ dorsal)[:, None] * dorsal
    put(3, np.zeros((16, 3)), local)
    local = np.zeros((len(p), 16, 3))
    for j in range(1, 16):
        arm, bone = p - JOINTS[j], AXES[j, :, 2]
        local[:, j] = 0.07 * (arm - (arm @ bone)[:, None] * bone) * (0.0 if j == 13 else 1.0)
    put(4, np.zeros((16, 3)), local)
    local = np.zeros((len(p), 16, 3))
    local[:, 0, 0] = 0.04 * p[:, 0]
    put(5, 0.04 * root * [1.0, 0.0, 0.0], local)
    stretch(6, digits(thumb=0.06))
    stretch(7, digits(index=0.025, ring=-0.025))
    stretch(8, digits(pinky=0.07))
    thenar = np.exp(-np.sum(((p - [-38.0, -20.0, 24.0]) / [24.0, 16.0, 17.0]) ** 2, axis=1))
    hypothenar = np.exp(-np.sum(((p - [-36.0, -17.0, -27.0]) / [26.0, 14.0, 14.0]) ** 2, axis=1))
    skin_basis[:, 1, 9] = -1.6 * thenar - 1.2 * hypothenar
    return skin_basis, joint_basis, names


def convex_pieces(p: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> tuple[list[np.ndarray], list[str]]:
    """Vertex groups whose posed hulls enclose the skin: every face lies in a group."""
    centre = p[faces].mean(axis=1)
    segment = weights[faces].mean(axis=1).argmax(axis=1)
    column = metacarpal_fields(centre).argmin(axis=1)
    label = np.where(segment > 0, segment + 4, np.where(centre[:, 0] > -24.0, 0, 1 + column))
    names = list(PALM_PIECES) + [f"{d}{k}" for d in DIGITS for k in (1, 2, 3)]
    pieces = [np.unique(faces[label == k]) for k in range(20)]
    # Where carpus, thumb and palm columns meet deep inside, their hulls would leave a hollow: the carpus reaches one
    # row of palm faces further.
    near = np.isin(faces, pieces[0]).any(axis=1) & (label < len(PALM_PIECES))
    pieces[0] = np.unique(faces[near])
    return [piece.astype(np.int32) for piece in pieces], names


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """An .npz whose bytes depend on the arrays only: fixed order and time stamps."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, value in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(value), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), buffer.getvalue())


def main() -> None:
    p, faces = build_surface()
    weights = skin_weights(p)
    skin_basis, joint_basis, shape_names = shape_basis(p, weights)
    pieces, piece_names = convex_pieces(p, faces, weights)
    tips = [
        int(np.argmax((p - TIPS[d]) @ AXES[3 + 3 * d, :, 2] - np.linalg.norm(p - TIPS[d], axis=1))) for d in range(5)
    ]
    arrays = {
        "vertices": (p / 1000).astype(np.float32),
        "faces": faces.astype(np.int32),
        "weights": weights.astype(np.float32),
        "joints_rest": (JOINTS / 1000).astype(np.float32),
        "shape_basis": (skin_basis / 1000).astype(np.float32),
        "joint_shape_basis": (joint_basis / 1000).astype(np.float32),
        "shape_names": np.array(shape_names),
        "parents": PARENTS.astype(np.int32),
        "joint_axes": AXES.astype(np.float32),
        "piece_vertices": np.concatenate(pieces),
        "piece_offsets": np.cumsum([0] + [len(q) for q in pieces]).astype(np.int32),
        "piece_names": np.array(piece_names),
        "tip_vertices": np.array(tips, dtype=np.int32),
    }
    write_npz(HERE / "hand.npz", arrays)
    report = piece_report(arrays["vertices"].astype(np.float64), faces, pieces, piece_names)
    (HERE / "report.json").write_text(json.dumps({"template": report}, indent=1) + "\n")
    print(json.dumps({k: v for k, v in report.items() if k != "pieces"}))


if __name__ == "__main__":
    main()
