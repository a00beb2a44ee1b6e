"""Convex pieces of any hand in MANO's joint tree, from its skinning weights; their hulls, checked
to hold the skin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Ids = NDArray[np.int32]

DIGITS = ("index", "middle", "pinky", "ring", "thumb")
PALM = ("carpus", "palm_index", "palm_middle", "palm_ring", "palm_pinky")
NAMES = (*PALM, *(f"{d}{k}" for d in DIGITS for k in (1, 2, 3)))
COLUMNS = (1, 4, 10, 7)
"""Roots of index, middle, ring and pinky: the far ends of the palm's columns."""
METACARPAL_BASE_M = (
    np.array([[-26.0, 0.0, 15.0], [-26.0, 1.5, 4.0], [-26.0, 0.5, -8.0], [-32.0, -2.0, -18.0]])
    / 1000
)
CARPUS_M = 0.024
ROOT_M = 0.08588949
"""The project's own hand: where its metacarpals begin (anatomical proportions), how far the carpus
reaches, the mean distance of its finger roots from the wrist. Other hands are divided at the same
places in proportion."""
OUTSIDE_M = 1e-6


def convex_pieces(vertices: F64, faces: Ids, weights: F64, joints: F64) -> list[Ids]:
    """Vertex ids of the twenty pieces `NAMES`: every face lies in one, so their hulls hold the skin
    in any pose.

    Faces go to the bone that moves them most; those of the palm to the carpus or to the nearest
    metacarpal.
    """
    centre = vertices[faces].mean(axis=1)
    segment = weights[faces].mean(axis=1).argmax(axis=1)
    roots = joints[list(COLUMNS)]
    scale = np.linalg.norm(roots - joints[0], axis=1).mean() / ROOT_M
    base = joints[0] + scale * METACARPAL_BASE_M
    away = np.stack([_from_segment(centre, a, b) for a, b in zip(base, roots)], axis=1)
    column = away.argmin(axis=1)
    in_carpus = centre[:, 0] - joints[0, 0] > -scale * CARPUS_M
    label = np.where(segment > 0, segment + 4, np.where(in_carpus, 0, 1 + column))
    pieces = [np.unique(faces[label == k]) for k in range(len(NAMES))]
    # Where carpus, thumb and palm columns meet deep inside, their hulls would leave a hollow: the
    # carpus reaches one row of palm faces further.
    near = np.isin(faces, pieces[0]).any(axis=1) & (label < len(PALM))
    pieces[0] = np.unique(faces[near])
    if empty := [n for n, piece in zip(NAMES, pieces) if len(piece) < 4]:
        raise ValueError(f"no skin follows {empty[0]}: weights must cover MANO's 16 joints")
    return [piece.astype(np.int32) for piece in pieces]


def _from_segment(points: F64, a: F64, b: F64) -> F64:
    along = np.clip(((points - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - along[:, None] * (b - a), axis=1))


def close_holes(vertices: F64, faces: Ids) -> Ids:
    """The faces, and a fan of faces over every hole (MANO's wrist is open: 16 edges, 14 faces); no
    vertex is added.

    Raises where the rim is not a simple loop, or an edge belongs to three faces or is run through
    twice in one direction.
    """
    edge = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    directed, count = np.unique(edge[:, 0] * len(vertices) + edge[:, 1], return_counts=True)
    if (count > 1).any():
        raise ValueError("two faces run along one edge in the same direction: it is no surface")
    open_edges = edge[~np.isin(edge[:, 1] * len(vertices) + edge[:, 0], directed)]
    # against the faces' direction: outward for what closes the hole
    following = {int(a): int(b) for b, a in open_edges}
    if len(following) != len(open_edges) or set(following) != set(following.values()):
        raise ValueError("the hand's mesh is open along something else than simple loops")
    added: list[tuple[int, int, int]] = []
    while following:
        first, second = following.popitem()
        loop = [first]
        while second != first:
            loop.append(second)
            second = following.pop(second)
        added += [(loop[0], loop[i], loop[i + 1]) for i in range(1, len(loop) - 1)]
    return np.concatenate([faces, np.array(added, np.int32).reshape(-1, 3)]).astype(np.int32)


def hulls_of(vertices: F64, pieces: Sequence[Ids], names: Sequence[str]) -> tuple[Ids, Ids]:
    """(M,) ids of the vertices on the hull of every piece of H posed hands (H, V, 3), and where
    each piece's ids start.

    Raises if a vertex of a piece lies outside its hull by more than a micrometre: the pieces would
    not hold the skin.
    """
    from scipy.spatial import ConvexHull, QhullError  # 0.4 s: stored hands have their hulls

    every: list[Ids] = []
    for h, skin in enumerate(vertices):
        for piece, name in zip(pieces, names):
            try:
                hull = ConvexHull(skin[piece])
            except QhullError:
                raise ValueError(f"hand {h}: piece {name} has no volume in this posture") from None
            beyond = float((skin[piece] @ hull.equations[:, :3].T + hull.equations[:, 3]).max())
            if beyond > OUTSIDE_M:
                raise ValueError(
                    f"hand {h}: skin of {name} lies {beyond * 1e6:.1f} um outside its convex piece"
                )
            every.append(np.sort(piece[hull.vertices]).astype(np.int32))
    offsets = np.cumsum([0] + [len(ids) for ids in every]).astype(np.int32)
    return (np.concatenate(every) if every else np.zeros(0, np.int32)), offsets


def tip_vertices(vertices: F64, weights: F64, joints: F64) -> Ids:
    """The farthest skin of each digit's last segment along the bone before it: index, middle,
    pinky, ring, thumb."""
    tips = []
    for last in (3, 6, 9, 12, 15):
        own = np.flatnonzero(weights[:, last] > 0.5)
        if not len(own):
            raise ValueError(f"no skin follows joint {last}: weights must cover MANO's 16 joints")
        tips.append(own[np.argmax(vertices[own] @ (joints[last] - joints[last - 1]))])
    return np.array(tips, np.int32)


def joint_axes(joints: F64, tips: F64, like_axes: F64, like_joints: F64, like_tips: F64) -> F64:
    """(16, 3, 3) flexion, abduction and bone axes: those of another hand, each turned the shortest
    way to its own bone."""
    axes = like_axes.copy()
    for j in range(1, 16):
        end, like_end = tips[(j - 1) // 3], like_tips[(j - 1) // 3]
        if j % 3:
            end, like_end = joints[j + 1], like_joints[j + 1]
        axes[j] = _shortest_turn(like_end - like_joints[j], end - joints[j]) @ like_axes[j]
    return axes


def _shortest_turn(a: F64, b: F64) -> F64:
    """The rotation matrix that takes the direction of a to that of b, less than 180 degrees apart
    (Rodrigues)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    v, c = np.cross(a, b), float(a @ b)
    if c < -0.9:
        raise ValueError("a digit points away from MANO's: another order or frame of joints")
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + K + K @ K / (1 + c)
