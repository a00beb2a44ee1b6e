"""Receiver hands: MANO's joint tree and parameters on the project's own mesh, posed in batches.

The hand frame is MANO's: the wrist joint at the origin; a flat right hand points along -x with its
palm towards -y and its thumb towards +z. A left hand is the mirror image x -> -x, its pose the
mirrored turns (x, -y, -z).

Every row is computed by element-wise float64 arithmetic (+, -, *, /, sqrt, floor: no reduction, no
matrix product, no libm), so a row has the same bits in any batch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch.threads import one_torch_thread
from r2h_batch.config import BALL_OFFSET_M
from r2h_batch.scene.arrays import arrays_digest, asset, read_arrays
from r2h_batch.scene.hand_file import check_postures, read_hand, read_hand_set

JOINTS = 16
POSE_SIZE = 48
SHAPE_SIZE = 10
RIGHT, LEFT = 0, 1

FINGER_ROOTS = (1, 4, 7, 10)
_CHUNK = 32
"""Hands posed at a time: their tables stay in a core's cache, and 400 hands take 0.6 of the time of 256 at a time."""


@dataclass(frozen=True)
class HandGeometry:
    """Posed hands in the hand frame, metres, float32."""

    vertices: Float32[Tensor, "B V 3"]
    joints: Float32[Tensor, "B 16 3"]


@dataclass(frozen=True, eq=False)
class HandModel:
    """A skinned hand: the right template and what moves it. V vertices, F faces, NP convex pieces;
    metres."""

    vertices: Float32[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    weights: Float32[Tensor, "V 16"]
    joints_rest: Float32[Tensor, "16 3"]
    shape_basis: Float32[Tensor, "V 3 10"]
    joint_shape_basis: Float32[Tensor, "16 3 10"]
    parents: tuple[int, ...]
    joint_axes: Float32[Tensor, "16 3 3"]
    """columns: flexion, abduction and bone axis of every joint in the rest pose, right hand"""
    piece_vertices: Int[Tensor, " M"]
    """vertex ids of all pieces; piece k has ``piece_vertices[piece_offsets[k]:piece_offsets[k +
    1]]``"""
    piece_offsets: Int[Tensor, " NP1"]
    piece_names: tuple[str, ...]
    tip_vertices: Int[Tensor, " 5"]
    """fingertips of index, middle, pinky, ring, thumb"""
    shape_names: tuple[str, ...] = ()
    pose_basis: Float32[Tensor, "V 3 135"] | None = None
    """displacement for each entry of R - 1 of joints 1 to 15, row by row (MANO's pose blend
    shapes)"""
    pose_mean: Float32[Tensor, "2 45"] | None = None
    """the mean posture of right and left hands, joints 1 to 15, that data without a flat mean are
    relative to"""
    pose_components: Float32[Tensor, "2 45 45"] | None = None
    """principal components of right and left hands' postures, one a row"""
    left: HandModel | None = None
    """a left hand of its own, mirrored to a right one; None: the right hand's mirror image"""

    def __repr__(self) -> str:  # one line: a dataclass would print its tensors
        own = "a left hand of its own" if self.left is not None else "left hands mirrored"
        return f"HandModel({len(self.vertices):,} vertices, {len(self.faces):,} faces; {own})"

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> HandModel:
        """The model from arrays named as in ``hand.npz``; those of a left hand of its own start
        with ``left_``."""

        left = {k.removeprefix("left_"): v for k, v in arrays.items() if k.startswith("left_")}
        rights = {k: v for k, v in arrays.items() if not k.startswith("left_")}
        values: dict[str, Any] = {}
        for name in {f.name for f in fields(cls)} & rights.keys():
            if name.endswith("_names"):
                values[name] = tuple(str(n) for n in rights[name])
            else:
                values[name] = torch.from_numpy(np.array(rights[name], order="C"))
        values["parents"] = tuple(int(p) for p in rights["parents"])
        return cls(**values, left=cls.from_arrays({**rights, **left}) if left else None)

    @cached_property
    def faces_by_side(self) -> Int[Tensor, "2 F 3"]:
        """Faces of a right and of a left hand; both wind counter-clockwise seen from outside."""
        return torch.stack([self.faces, self.faces.flip(1)])

    @property
    def pieces(self) -> tuple[Int[Tensor, " M_k"], ...]:
        """Vertex ids of every convex piece: the hull of these vertices, in any pose, holds the
        piece's faces."""
        offsets = self.piece_offsets.tolist()
        return tuple(self.piece_vertices[a:b] for a, b in pairwise(offsets))

    @cached_property
    def digest(self) -> str:
        """sha256 over what moves and covers the hand: two models with one digest give the same
        meshes and pieces."""
        names = [
            "vertices",
            "faces",
            "weights",
            "joints_rest",
            "shape_basis",
            "joint_shape_basis",
            "pose_basis",
        ]
        values = {k: getattr(self, k) for k in (*names, "piece_vertices", "piece_offsets")}
        arrays = {k: v.numpy() for k, v in values.items() if v is not None}
        left = {} if self.left is None else {"left": np.array(self.left.digest)}
        return arrays_digest({**arrays, **left})

    def full_pose(
        self, coefficients: Float[Tensor, "B n"], side: Int[Tensor, " B"], *, flat_hand_mean: bool
    ) -> Float32[Tensor, "B 45"]:
        """Axis-angle turns of joints 1 to 15 from principal components (n < 45, or MANO's 45) of
        each hand's side.

        `flat_hand_mean`: whether 0 is the flat hand (OakInk, GRAB) or the model's mean posture
        (smplx's default).
        """
        if self.pose_components is None or self.pose_mean is None:
            raise ValueError("this hand has no principal components: give full poses, or MANO")
        rows = side.long()
        basis = self.pose_components.double()[rows, : coefficients.shape[1]]  # (B, n, 45)
        full = (coefficients.double()[:, :, None] * basis).sum(1)
        return (full if flat_hand_mean else full + self.pose_mean.double()[rows]).float()

    def pose(
        self,
        pose: Float[Tensor, "B 48"],
        shape: Float[Tensor, "B 10"] | None = None,
        side: Int[Tensor, " B"] | None = None,
    ) -> HandGeometry:
        """Linear blend skinning: posed meshes and joints in the hand frame; side 0 is right
        (default), 1 left.

        ``pose`` holds 16 axis-angle turns in MANO's joint order, the first about the wrist;
        ``shape`` defaults to 0.
        """
        rows = pose.shape[0]
        shape = pose.new_zeros((rows, SHAPE_SIZE)) if shape is None else shape
        side = torch.zeros(rows, dtype=torch.int8, device=pose.device) if side is None else side
        for name, value, width in (("pose", pose, POSE_SIZE), ("shape", shape, SHAPE_SIZE)):
            if value.shape != (rows, width) or not value.is_floating_point():
                raise ValueError(
                    f"{name} has shape {tuple(value.shape)} and type {value.dtype}; need ({rows}, {width}) floats"
                )
        if side.shape != (rows,):
            raise ValueError(
                f"side has shape {tuple(side.shape)}; need ({rows},), 0 for right and 1 for left hands"
            )
        empty = partial(torch.empty, dtype=torch.float32, device=pose.device)
        vertices, joints = empty((rows, *self.vertices.shape)), empty((rows, JOINTS, 3))
        with one_torch_thread(pose.device):  # idle threads would spin: as much CPU time again
            for start in range(0, rows, _CHUNK):
                part = slice(start, start + _CHUNK)
                vertices[part], joints[part] = self._pose_sides(
                    pose[part].double(), shape[part].double(), side[part] == LEFT
                )
        return HandGeometry(vertices, joints)

    def _pose_sides(self, pose: Tensor, shape: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
        if self.left is None:
            return self._pose_rows(pose, shape, left)
        empty = partial(torch.empty, dtype=torch.float32, device=pose.device)
        vertices, joints = empty((len(pose), *self.vertices.shape)), empty((len(pose), JOINTS, 3))
        for model, rows in ((self, ~left), (self.left, left)):
            vertices[rows], joints[rows] = model._pose_rows(pose[rows], shape[rows], left[rows])
        return vertices, joints

    def _pose_rows(self, pose: Tensor, shape: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
        device = pose.device
        mirror = torch.where(left[:, None], -1.0, 1.0).double()  # (B,1)
        turns = pose.reshape(-1, JOINTS, 3)
        turns = torch.stack([turns[..., 0], turns[..., 1] * mirror, turns[..., 2] * mirror], dim=-1)
        rotation = rotation_from_axis_angle(turns)
        rest = self.joints_rest.to(device).double() + torch.zeros_like(turns)
        skin = self.vertices.to(device).double() + torch.zeros(
            (len(pose), 1, 1), dtype=torch.float64, device=device
        )
        for i in range(SHAPE_SIZE):
            amount = shape[:, i, None, None]
            rest = rest + amount * self.joint_shape_basis[..., i].to(device).double()
            skin += amount * self.shape_basis[..., i].to(device).double()
        if self.pose_basis is not None:
            eye = torch.eye(3, dtype=torch.float64, device=device)
            feature = (rotation[:, 1:] - eye).flatten(1)  # (B, 135)
            for i in range(feature.shape[1]):
                moves = self.pose_basis[..., i].to(device).double()
                skin += feature[:, i, None, None] * moves
        world_rotation, world_joint = [rotation[:, 0]], [rest[:, 0]]
        for j in range(1, JOINTS):
            p = self.parents[j]
            world_rotation.append(se3.matmul(world_rotation[p], rotation[:, j]))
            bone = rest[:, j] - rest[:, p]
            world_joint.append(se3.rotate(world_rotation[p], bone) + world_joint[p])
        shift = [world_joint[j] - se3.rotate(world_rotation[j], rest[:, j]) for j in range(JOINTS)]
        turned = torch.stack(world_rotation, 1).flatten(2)
        matrix = torch.cat([turned, torch.stack(shift, 1)], dim=2)
        # in place: twice as fast as with new memory for each sum; `matrix[:, bones]` takes six times as long
        (bones, *other_bones), (weight, *weights) = (a.to(device).T for a in self._influences)
        blended = matrix.index_select(1, bones).mul_(weight[:, None])
        for bones, weight in zip(other_bones, weights, strict=True):
            blended += matrix.index_select(1, bones).mul_(weight[:, None])
        posed = se3.rotate(blended[..., :9].unflatten(-1, (3, 3)), skin) + blended[..., 9:]
        joints = torch.stack(world_joint, dim=1)
        flip = torch.stack([mirror, torch.ones_like(mirror), torch.ones_like(mirror)], dim=2)
        return (posed * flip).float(), (joints * flip).float()

    @cached_property
    def _influences(self) -> tuple[Tensor, Tensor]:
        """Bone ids and float64 weights of the most bones that any vertex follows, (V,K) each,
        heaviest first."""
        most = int((self.weights > 0).sum(dim=1).max())
        weights, bones = torch.sort(self.weights.double(), dim=1, descending=True, stable=True)
        weights = weights[:, :most]
        total = weights[:, 0].clone()
        for k in range(1, most):
            total = total + weights[:, k]
        return bones[:, :most], weights / total[:, None]


def rotation_from_axis_angle(turns: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices (float64) of axis-angle vectors; exact at 0, the same bits in any batch and
    on any device.

    A Taylor quaternion of a sixteenth of the turn, doubled three times: libm's sine differs between
    vector lanes.
    """
    x, y, z = turns.double().unbind(-1)
    angle = torch.sqrt(x * x + y * y + z * z)
    whole = 2 * math.pi * torch.floor(angle / (2 * math.pi))
    scale = torch.where(angle > 0, (angle - whole) / torch.where(angle > 0, angle, 1.0), 1.0) / 16
    x, y, z = x * scale, y * scale, z * scale
    h2 = x * x + y * y + z * z  # square of the small quaternion's angle, at most (pi/8)^2
    sinc, cosine = torch.ones_like(h2), torch.ones_like(h2)
    for n in (14, 12, 10, 8, 6, 4, 2):
        cosine = 1.0 - h2 / (n * (n - 1)) * cosine
        sinc = 1.0 - h2 / (n * (n + 1)) * sinc
    w, x, y, z = cosine, x * sinc, y * sinc, z * sinc
    for _ in range(3):
        w, x, y, z = w * w - (x * x + y * y + z * z), 2 * w * x, 2 * w * y, 2 * w * z
    norm = torch.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(r, dim=-1) for r in rows], dim=-2)


def palm_frame(
    joints: Float[Tensor, "B 16 3"], side: Int[Tensor, " B"]
) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B 3"]]:
    """Palm point ``p_h`` and the unit normal ``n_h`` out of the palm, in the frame of ``joints``
    (docs/choices.md)."""
    wrist = joints[:, 0]
    total = wrist
    for j in FINGER_ROOTS:
        total = total + joints[:, j]
    a, b = joints[:, 1] - wrist, joints[:, 7] - wrist
    cross = se3.cross(a, b)
    norm = se3.dot(cross, cross).sqrt()
    sign = torch.where(side == LEFT, -1.0, 1.0).to(cross)
    return total / (1 + len(FINGER_ROOTS)), cross * (sign / norm)[:, None]


def ball_center(joints: Float[Tensor, "B 16 3"], side: Int[Tensor, " B"]) -> Float[Tensor, "B 3"]:
    """Centre ``c_h = p_h + 0.12 n_h`` of the ball that an object must meet to be within reach."""
    point, normal = palm_frame(joints, side)
    return point + BALL_OFFSET_M * normal


@dataclass(frozen=True, eq=False)
class HandSet:
    """The receiving postures of the protocol: H hands, right ones first."""

    pose: Float32[Tensor, "H 48"]
    """MANO's pose: 16 axis-angle turns, rad; the first is the wrist's"""
    shape: Float32[Tensor, "H 10"]
    """MANO's shape"""
    side: Int[Tensor, " H"]
    """0 right, 1 left"""
    posture: tuple[str, ...]
    """name of each posture"""
    hull_vertex_ids: Int[Tensor, " M"]
    """mesh vertices on the hull of every posed piece, hand by hand, piece by piece"""
    hull_offsets: Int[Tensor, " HNP1"]
    """piece k of hand h has ids ``hull_offsets[h * NP + k]`` up to the next offset"""
    digest: str
    """sha256 of the postures"""
    model: HandModel
    """the hand that takes these postures"""
    in_body: Float64[Tensor, "H 3 K"] | None = None
    """how each was turned in the frame of its body (x where the chest faces, z up), and where arms
    are known (H, 3, 5) elbow and wrist from the shoulder, m; NaN where unknown; None: unknown for
    all"""
    skin: HandGeometry | None = None
    """measured meshes and joints; None: the model takes the postures"""

    def __len__(self) -> int:
        return len(self.posture)

    def __repr__(self) -> str:  # one line: a dataclass would print its tensors
        left = int(self.side.sum())
        return f"HandSet({len(self)} hands: {len(self) - left} right, {left} left; digest {self.digest[:12]})"

    @cached_property
    def geometry(self) -> HandGeometry:
        """The meshes and joints of all H hands in their own frames, posed once for everything that
        reads them (400 hands take 0.4 CPU seconds)."""
        return self.skin or self.model.pose(self.pose, self.shape, self.side)


def load_hand(path: str | Path | None = None) -> HandModel:
    """The default hand (one object, however many others are loaded), or one stored in the format of
    ``hand.npz``."""
    return _default_hand() if path is None else HandModel.from_arrays(read_hand(path))


@lru_cache(maxsize=1)
def _default_hand() -> HandModel:
    return HandModel.from_arrays(read_arrays(asset("hand", "hand.npz")))


def load_hand_set(path: str | Path | None = None, model: HandModel | None = None) -> HandSet:
    """The 400 receiving postures, or those of a file, on a hand (default: :func:`load_hand`).

    ``digest`` is sha256 over the arrays' bytes and, for another than the default hand, over the
    hand.
    """
    hand = load_hand() if model is None else model
    usual = path is None and hand is load_hand()
    return _default_hand_set() if usual else _other_hand_set(path, hand)


@lru_cache(maxsize=4)
def neutral_hand_set(model: HandModel | None = None) -> HandSet:
    """A right and a left hand in the rest posture, without shape: the receivers of r2h-release."""
    zeros = np.zeros((2, POSE_SIZE), np.float32)
    hand = load_hand() if model is None else model
    return make_hand_set(hand, zeros, zeros[:, :SHAPE_SIZE], np.array([0, 1]), ["neutral"] * 2)


@lru_cache(maxsize=4)
def _other_hand_set(path: str | Path | None, hand: HandModel) -> HandSet:
    a = read_arrays(asset("hand", "handset.npz")) if path is None else read_hand_set(path)
    posture = a["posture"].tolist()
    return make_hand_set(hand, a["pose"], a["shape"], a["side"], posture, a.get("in_body"))


@lru_cache(maxsize=1)
def _default_hand_set() -> HandSet:
    a = read_arrays(asset("hand", "handset.npz"))
    tensors: dict[str, Any] = {k: torch.from_numpy(v) for k, v in a.items() if k != "posture"}
    posture = tuple(str(n) for n in a["posture"])
    return HandSet(**tensors, posture=posture, digest=arrays_digest(a), model=load_hand())


def make_hand_set(
    model: HandModel,
    pose: np.ndarray,
    shape: np.ndarray,
    side: np.ndarray,
    posture: Sequence[str],
    in_body: np.ndarray | None = None,
    hulls: tuple[np.ndarray, np.ndarray] | None = None,
) -> HandSet:
    """Postures (H, 48), shapes (H, 10) and sides (H,) on a hand, right ones first; every piece's
    hull is built and checked, unless what `hulls_of` found of them is stored: `hulls`."""
    check_postures(pose, shape)
    if in_body is not None and np.isnan(in_body[:, :, 3:]).all():
        in_body = in_body[:, :, :3]
    order = np.argsort(side, kind="stable")
    arrays: dict[str, np.ndarray] = {
        "pose": np.asarray(pose, np.float32)[order],
        "shape": np.asarray(shape, np.float32)[order],
        "side": np.asarray(side, np.int8)[order],
        "posture": np.array(
            [str(posture[i]) for i in order], dtype=f"<U{max(16, *map(len, posture))}"
        ),
    }
    pose_, shape_, side_ = (torch.from_numpy(arrays[k]) for k in ("pose", "shape", "side"))
    ids, offsets = hulls or posed_hulls(model, pose_, shape_, side_)
    hand = {} if model is load_hand() else {"hand": np.array(model.digest)}
    return HandSet(
        pose=pose_,
        shape=shape_,
        side=side_,
        posture=tuple(arrays["posture"].tolist()),
        hull_vertex_ids=torch.from_numpy(ids),
        hull_offsets=torch.from_numpy(offsets),
        digest=arrays_digest({**arrays, "hull_vertex_ids": ids, "hull_offsets": offsets, **hand}),
        model=model,
        in_body=None
        if in_body is None or not np.isfinite(in_body).any()
        else torch.from_numpy(in_body[order]),
    )


def posed_hulls(
    model: HandModel, pose: Tensor, shape: Tensor, side: Tensor
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """`hulls_of` of these hands."""
    from r2h_batch.scene.hand_pieces import hulls_of

    vertices = model.pose(pose, shape, side).vertices.double().numpy()
    return hulls_of(vertices, [p.numpy() for p in model.pieces], model.piece_names)


MAX_SKIN_PIECES = 40
"""Convex pieces of a hand: with the table and the arm they fit a word of 64 bits
(kernels/plan/codes.py)."""
PALM_JOINTS_M = {0: (-0.06, 0.0), 1: (0.02, -0.02), 4: (0.02, 0.0), 7: (0.02, 0.02), 10: (0.0, 0.0)}
"""x and y of joints whose `palm_frame` is the frame that they stand in, for a right hand."""


def make_skin_set(
    vertices: np.ndarray,
    T_hand_palm: np.ndarray,
    faces: np.ndarray,
    face_piece: np.ndarray,
    side: np.ndarray,
) -> HandSet:
    """Hands that are meshes and have no posture: scanned, of another model, or made of boxes.

    Palm point and normal are those of `T_hand_palm`; Plan keeps clear of the hulls of the pieces,
    Safe measures to the faces. Methods that look at postures cannot see such hands.

    Args:
        vertices: (H, V, 3) in the hand frame, m.
        T_hand_palm: (H, 4, 4) origin in the palm, z out of it, x to the fingers.
        faces: (F, 3) of a right hand, counter-clockwise seen from outside; of a left hand they
            count the other way round.
        face_piece: (F,) the convex piece of each face, from 0.
        side: (H,) 0 right, 1 left, in this order.

    Raises:
        ValueError: a piece has no volume, or sides are out of order.
    """
    from r2h_batch.scene.hand_pieces import hulls_of

    if (np.diff(side.astype(int)) < 0).any():
        raise ValueError("right hands come before left ones")
    count, like = len(vertices), load_hand()
    pieces = [np.unique(faces[face_piece == k]) for k in range(int(face_piece.max()) + 1)]
    names = tuple(f"skin_{k}" for k in range(len(pieces)))
    ids, offsets = hulls_of(vertices.astype(np.float64), pieces, names)
    local = np.zeros((count, JOINTS, 3))
    for j, (x, y) in PALM_JOINTS_M.items():
        local[:, j] = np.stack(
            [np.full(count, x), y * np.where(side == LEFT, -1.0, 1.0), 0 * side], 1
        )
    T = T_hand_palm.astype(np.float64)
    joints = np.einsum("hij,hkj->hki", T[:, :3, :3], local) + T[:, None, :3, 3]
    one_bone = np.zeros((vertices.shape[1], JOINTS), np.float32)
    one_bone[:, 0] = 1.0
    arrays = {
        "vertices": vertices[0].astype(np.float32),
        "faces": faces.astype(np.int32),
        "weights": one_bone,
        "joints_rest": joints[0].astype(np.float32),
        "shape_basis": np.zeros((vertices.shape[1], 3, SHAPE_SIZE), np.float32),
        "joint_shape_basis": np.zeros((JOINTS, 3, SHAPE_SIZE), np.float32),
        "parents": np.array(like.parents),
        "joint_axes": like.joint_axes.numpy(),
        "piece_vertices": np.concatenate(pieces).astype(np.int32),
        "piece_offsets": np.cumsum([0, *map(len, pieces)]).astype(np.int32),
        "piece_names": np.array(names),
        "tip_vertices": np.zeros(5, np.int32),
        "shape_names": np.array([], np.str_),
    }
    skin = HandGeometry(
        torch.from_numpy(vertices.astype(np.float32)), torch.from_numpy(joints.astype(np.float32))
    )
    found = {"skin": skin.vertices.numpy(), "joints": skin.joints.numpy(), "side": side}
    return HandSet(
        pose=torch.zeros((count, POSE_SIZE), dtype=torch.float32, device="cpu"),
        shape=torch.zeros((count, SHAPE_SIZE), dtype=torch.float32, device="cpu"),
        side=torch.from_numpy(side.astype(np.int8)),
        posture=("skin",) * count,
        hull_vertex_ids=torch.from_numpy(ids),
        hull_offsets=torch.from_numpy(offsets),
        digest=arrays_digest({**found, "faces": arrays["faces"], "hull_vertex_ids": ids}),
        model=HandModel.from_arrays(arrays),
        skin=skin,
    )
