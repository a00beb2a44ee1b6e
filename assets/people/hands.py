"""A hand in MANO's joint tree cut from Anny's bodies at the wrist, its fingers straightened, and the components of its
shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.assets.people.bodies import Bodies, Model
from r2h_batch.scene import hand_pieces
from r2h_batch.scene.hand import HandModel
from r2h_batch.scene.hand_file import PARENTS

F64 = NDArray[np.float64]

FINGERS = (2, 3, 5, 4, 1)
"""Anny's numbers of index, middle, little, ring finger and thumb, in MANO's order."""
JOINTS = ("wrist.R", *(f"finger{f}-{k}.R" for f in FINGERS for k in (1, 2, 3)))
CUT_M, AROUND_M = 0.030, 0.12
"""How far behind the wrist the hand is cut, and the size of the region in which the forearm's skin is looked at."""
COMPONENTS = 10
LEAST_WEIGHT = 0.01


@dataclass(frozen=True)
class Cut:
    """Where the hand lies in Anny's mesh. `used`: its vertices; `faces` count these; `weights` (v, 16)."""

    joints: NDArray[np.int64]
    used: NDArray[np.int64]
    faces: NDArray[np.int32]
    weights: F64


def hand_frame(joints: F64) -> F64:
    """(3, 3) rows: the hand's axes from joints (16, 3) of a right hand. The fingers point along -x, the palm along -y."""
    wrist, index, middle, little = joints[0], joints[1], joints[4], joints[7]
    out = np.cross(index - wrist, little - wrist)
    out /= np.linalg.norm(out)
    x = wrist - middle
    x -= (x @ out) * out
    x /= np.linalg.norm(x)
    return np.stack([x, -out, np.cross(x, -out)])


def cut(model: Model, body: Bodies) -> Cut:
    """Cuts the right hand off the first body: what hand bones move, and the forearm's skin up to CUT_M behind the wrist."""
    at = np.array([model.bones.index(name) for name in JOINTS])
    of_hand = [
        i for i, n in enumerate(model.bones) if n.endswith(".R") and n.startswith(("wrist", "finger", "metacarpal"))
    ]
    own, arm = model.weights[:, of_hand].sum(1), model.weights[:, model.bones.index("lowerarm02.R")]
    heads = body.heads[0, at]
    local = (body.vertices[0] - heads[0]) @ hand_frame(heads).T
    near = (local[:, 0] < CUT_M) & (np.linalg.norm(local, axis=1) < AROUND_M)
    kept = (own > 0.5) | ((own + arm > 0.6) & near)
    faces = model.faces[kept[model.faces].all(1)]
    mesh = trimesh.Trimesh(local, faces, process=False)
    parts = trimesh.graph.connected_components(mesh.face_adjacency, min_len=10)
    faces = without_ears(faces[np.sort(max(parts, key=len))])
    used, numbered = np.unique(faces, return_inverse=True)
    weights = np.zeros((len(used), len(JOINTS)))
    for j, bone in enumerate(model.bones):
        weights[:, JOINTS.index(bone) if bone in JOINTS else 0] += model.weights[used, j]
    weights[weights < LEAST_WEIGHT] = 0.0
    weights /= weights.sum(1, keepdims=True)
    return Cut(at, used, numbered.reshape(-1, 3).astype(np.int32), weights)


def without_ears(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """The faces without those that hang on one edge at the rim of the cut."""
    while True:
        edge = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
        _, at, count = np.unique(edge, axis=0, return_inverse=True, return_counts=True)
        ear = (count[at.reshape(-1)].reshape(-1, 3) == 1).sum(1) > 1
        if not ear.any():
            return faces
        faces = faces[~ear]


def straightened(piece: Cut, vertices: F64, heads: F64, like: HandModel) -> tuple[F64, F64]:
    """Skin (v, 3) and joints (16, 3) of one body's hand in the hand's frame: its four fingers straight and in the
    palm's plane, its thumb turned about its root as the thumb of `like` points. So joint angles mean the same on both
    hands."""
    joints = heads[piece.joints]
    R = hand_frame(joints)
    skin, joints = (vertices[piece.used] - joints[0]) @ R.T, (joints - joints[0]) @ R.T
    tips = hand_pieces.tip_vertices(skin, piece.weights, joints)
    turns = np.tile(np.eye(4), (len(JOINTS), 1, 1))
    for finger in range(4):
        first = 1 + 3 * finger
        along = skin[tips[finger]] - joints[first]
        along[1] = 0.0  # the fan stays, the bend goes
        for j in range(first, first + 3):
            bone = (joints[j + 1] if j < first + 2 else skin[tips[finger]]) - joints[j]
            turn = shortest_turn(bone, along)
            before = turns[PARENTS[j]] if PARENTS[j] > 0 else np.eye(4)
            at = (before @ np.append(joints[j], 1.0))[:3]
            turns[j, :3, :3], turns[j, :3, 3] = turn, at - turn @ joints[j]
    root, tip = 13, like.vertices[like.tip_vertices[4]]
    thumb = shortest_turn(skin[tips[4]] - joints[root], (tip - like.joints_rest[root]).double().numpy())
    for j in range(root, root + 3):
        turns[j, :3, :3], turns[j, :3, 3] = thumb, joints[root] - thumb @ joints[root]
    moved = np.einsum("vj,jab,vb->va", piece.weights, turns, np.c_[skin, np.ones(len(skin))])[:, :3]
    placed = [(turns[PARENTS[j]] @ np.append(p, 1.0))[:3] if PARENTS[j] > 0 else p for j, p in enumerate(joints)]
    return moved, np.array(placed)


def shortest_turn(a: F64, b: F64) -> F64:
    """The rotation that takes the direction of a to that of b (Rodrigues)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    v, c = np.cross(a, b), float(a @ b)
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1 + c))


@dataclass(frozen=True)
class Hands:
    """The hands of n people. `skin` (n, v, 3), `joints` (n, 16, 3)."""

    skin: F64
    joints: F64

    def length(self, piece: Cut) -> F64:
        """(n,) from the wrist's joint to the tip of the middle finger, along the hand, m."""
        tip = hand_pieces.tip_vertices(self.skin[0], piece.weights, self.joints[0])[1]
        return np.asarray(-self.skin[:, tip, 0])


def hands_of(piece: Cut, bodies: Bodies, like: HandModel) -> Hands:
    """The straightened right hands of bodies."""
    both = [straightened(piece, v, b, like) for v, b in zip(bodies.vertices, bodies.heads, strict=True)]
    return Hands(np.array([b[0] for b in both]), np.array([b[1] for b in both]))


def arrays(
    piece: Cut, hands: Hands, mean: NDArray[np.bool_], like: HandModel
) -> tuple[dict[str, NDArray[Any]], F64, dict[str, float]]:
    """The hand model as `hand.npz` holds it, the shape numbers (n, 10) of the hands, and how well they give them back.

    Args:
        piece: where the hand lies.
        hands: of all people.
        mean: (n,) the people whose mean hand has the shape 0.
        like: the hand whose axes of flexion and abduction are turned to these bones.
    """
    n, v = hands.skin.shape[:2]
    every = np.concatenate([hands.skin, hands.joints], 1)
    middle = every[mean].mean(0)
    X = (every - middle).reshape(n, -1)
    _, s, Vt = np.linalg.svd(X, full_matrices=False)
    sd = s[:COMPONENTS] / np.sqrt(n)
    sign = np.sign(Vt[:COMPONENTS].reshape(COMPONENTS, -1, 3)[:, v + 6, 0])  # the first makes the hand longer
    basis = Vt[:COMPONENTS] * (-sign * sd)[:, None]
    shape = np.asarray((X @ Vt[:COMPONENTS].T) / (-sign * sd), np.float32).astype(np.float64)
    off = np.linalg.norm((X - shape @ basis).reshape(n, -1, 3), axis=2)
    moves = basis.reshape(COMPONENTS, v + len(JOINTS), 3)
    skin, joints = middle[:v], middle[v:]
    faces = hand_pieces.close_holes(skin, piece.faces)
    pieces = hand_pieces.convex_pieces(skin, faces, piece.weights, joints)
    tips = hand_pieces.tip_vertices(skin, piece.weights, joints)
    like_tips = like.vertices.double().numpy()[like.tip_vertices.numpy()]
    axes = hand_pieces.joint_axes(
        joints, skin[tips], like.joint_axes.double().numpy(), like.joints_rest.double().numpy(), like_tips
    )
    made: dict[str, NDArray[Any]] = {
        "vertices": np.asarray(skin, np.float32),
        "faces": faces,
        "weights": np.asarray(piece.weights, np.float32),
        "joints_rest": np.asarray(joints, np.float32),
        "shape_basis": np.asarray(moves[:, :v].transpose(1, 2, 0), np.float32),
        "joint_shape_basis": np.asarray(moves[:, v:].transpose(1, 2, 0), np.float32),
        "parents": np.array(PARENTS, np.int32),
        "joint_axes": np.asarray(axes, np.float32),
        "piece_vertices": np.concatenate(pieces).astype(np.int32),
        "piece_offsets": np.cumsum([0, *map(len, pieces)]).astype(np.int32),
        "piece_names": np.array(hand_pieces.NAMES),
        "tip_vertices": tips.astype(np.int32),
        "shape_names": np.array([f"anny_{k}" for k in range(COMPONENTS)]),
    }
    figures = {
        "residual_mean_mm": round(1000 * float(off.mean()), 3),
        "residual_max_mm": round(1000 * float(off.max()), 3),
        "first_component_share": round(float(s[0] ** 2 / (s**2).sum()), 4),
        "largest_shape_number": round(float(np.abs(shape).max()), 2),
    }
    return made, shape, figures
