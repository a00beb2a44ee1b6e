"""MANO's hand model from the files its owner has: MANO_RIGHT.pkl and MANO_LEFT.pkl, or the same
arrays as .npz.

Romero, Tzionas, Black: Embodied Hands (2017). MANO's licence forbids to pass its files on, and what
is made of them: nothing of MANO is in this package, and a hand.npz made here stays with the person who
made it.

The hand frame is MANO's with the wrist joint at the origin, whatever the shape: where MANO's own
parameters say `transl`, the wrist stands at `transl + J_0(shape)` (`ManoHand.wrist`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import read_npz
from r2h_batch.data.arrays import numbers
from r2h_batch.data.safe_pickle import read_pickle_file
from r2h_batch.scene import hand_pieces
from r2h_batch.scene.hand import LEFT, RIGHT, HandModel, load_hand
from r2h_batch.scene.hand_file import check_lengths, read_hand

F64 = NDArray[np.float64]

PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
TIPS_778 = (320, 443, 671, 554, 744)
"""index, middle, pinky, ring, thumb of MANO's own mesh (smplx, vertex_ids.py)"""
SHAPES, MAX_VERTICES = 10, 20_000
ALIKE_M = 0.005
MIRROR = np.array([-1.0, 1.0, 1.0])
AXIAL = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class ManoHand:
    """A hand model and what turns MANO's own parameters into its frame: J_0 and its change with
    shape, right and left."""

    model: HandModel
    wrist_rest: F64
    """(2, 3) m"""
    wrist_shape: F64
    """(2, 3, 10) m"""

    def wrist(self, transl: F64, shape: F64, side: NDArray[np.integer[Any]]) -> F64:
        """(n, 3) where the wrist joint stands for MANO's `transl` (n, 3) and `shape` (n, 10)."""
        return np.asarray(
            transl + self.wrist_rest[side] + np.einsum("nci,ni->nc", self.wrist_shape[side], shape)
        )

    def shape_of(self, vertices: F64, side: int) -> tuple[F64, float]:
        """The shape (10,) whose hand at rest is nearest to these vertices (V, 3) in MANO's own
        coordinates, and how far a vertex of it is from them, m."""
        if vertices.shape != tuple(self.model.vertices.shape):
            have, need = len(vertices), len(self.model.vertices)
            raise FileError(f"a hand of {need} vertices; the mesh has {have}")
        own = self.model.left if side == LEFT and self.model.left is not None else self.model
        sign = MIRROR if side == LEFT else np.ones(3)
        rest = own.vertices.double().numpy() * sign + self.wrist_rest[side]
        basis = own.shape_basis.double().numpy() * sign[:, None] + self.wrist_shape[side]
        shape = np.linalg.lstsq(basis.reshape(-1, 10), (vertices - rest).ravel(), rcond=None)[0]
        return shape, float(np.linalg.norm(rest + basis @ shape - vertices, axis=1).max())


def load_mano(
    right: str | Path | None = None,
    left: str | Path | None = None,
    *,
    negate_left_shape: bool = False,
) -> ManoHand:
    """The hand of these files; with one of them the other side is its mirror image.

    `negate_left_shape`: the left file's `shapedirs[:, 0]` change sign. MANO 1.2's left hand has
    them as of the right one; some data sets were fitted with that repaired (as smplx's users do),
    others were not: do what the data did.
    """
    arrays = hand_arrays(right, left, negate_left_shape=negate_left_shape)
    sides = [arrays["wrist_rest"], arrays["wrist_shape"]]
    return ManoHand(HandModel.from_arrays(arrays), *(np.asarray(s, np.float64) for s in sides))


def hand_arrays(
    right: str | Path | None = None,
    left: str | Path | None = None,
    *,
    negate_left_shape: bool = False,
) -> dict[str, NDArray[Any]]:
    """Arrays in the format of `hand.npz`, which `scene.hand.load_hand(path)` reads, with
    `wrist_rest`, `wrist_shape`."""
    if right is None and left is None:
        raise FileError("no hand model: give MANO_RIGHT.pkl, MANO_LEFT.pkl or both")
    raw = {
        s: _checked(_read(Path(p)), str(p), s)
        for s, p in ((RIGHT, right), (LEFT, left))
        if p is not None
    }
    if negate_left_shape and LEFT in raw:
        raw[LEFT] = replace(raw[LEFT], shape_basis=raw[LEFT].shape_basis * MIRROR[:, None])
    first = RIGHT if RIGHT in raw else LEFT
    try:
        arrays = _side_arrays(raw[first], raw[first].faces)
        if len(raw) == 2:
            _check_alike(raw[RIGHT], raw[LEFT], str(left))
            other = _side_arrays(raw[LEFT], raw[RIGHT].faces)
            arrays |= {f"left_{k}": v for k, v in other.items() if v.dtype == np.float32}
        arrays |= _both_sides(raw.get(RIGHT), raw.get(LEFT))
        check_lengths(arrays)
    except ValueError as error:
        raise FileError(f"{right or left}: {error}") from None
    return arrays


def hand_from(path: Path) -> HandModel:
    """The hand of a `hand.npz`, or of one of MANO's own pickles: a left one where its name says so,
    mirrored for the other side. Raises `FileError`, one line."""
    if path.suffix.lower() not in (".pkl", ".pickle"):
        return HandModel.from_arrays(read_hand(path))
    left = "left" in path.stem.lower()
    return load_mano(left=path).model if left else load_mano(right=path).model


@dataclass(frozen=True, eq=False)
class _Raw:
    """One file's arrays, float64, a left hand mirrored to a right one; `mean`, `components` as they
    are."""

    vertices: F64
    faces: NDArray[np.int32]
    shape_basis: F64
    pose_basis: F64
    regressor: F64
    weights: F64
    mean: F64
    components: F64


def _read(path: Path) -> Mapping[str, Any]:
    found = read_npz(path) if path.suffix == ".npz" else read_pickle_file(path)
    if not isinstance(found, dict):
        raise FileError(f"{path}: holds a {type(found).__name__}; a MANO file holds a dictionary")
    return found


def _checked(found: Mapping[str, Any], where: str, side: int) -> _Raw:
    v = _numbers(found, "v_template", (None, 3), where)
    count = len(v)
    if not 100 <= count <= MAX_VERTICES:
        raise FileError(f"{where}: v_template has {count} vertices; need 100 to {MAX_VERTICES}")
    faces = _numbers(found, "f", (None, 3), where)
    if (faces != np.round(faces)).any() or faces.min() < 0 or faces.max() >= count:
        raise FileError(f"{where}: f names other vertices than the {count} there are")
    tree = np.asarray(_numbers(found, "kintree_table", (2, 16), where)[0]).astype(np.int64)
    if tuple(tree[1:]) != PARENTS[1:]:
        raise FileError(f"{where}: kintree_table is not MANO's (parents {PARENTS})")
    if found.get("bs_type", "lrotmin") != "lrotmin" or found.get("bs_style", "lbs") != "lbs":
        raise FileError(f"{where}: bs_type and bs_style must be lrotmin and lbs, as in MANO")
    weights = _numbers(found, "weights", (count, 16), where)
    if weights.min() < -1e-9 or np.abs(weights.sum(1) - 1).max() > 1e-3:
        raise FileError(f"{where}: weights must be 0 or more and sum to 1 for every vertex")
    shape = _numbers(found, "shapedirs", (count, 3, None), where)
    if shape.shape[2] < SHAPES:
        raise FileError(f"{where}: shapedirs has {shape.shape[2]} directions; need {SHAPES}")
    pose = _numbers(found, "posedirs", (count, 3, 135), where)
    regressor = _numbers(found, "J_regressor", (16, count), where)
    points_left = float((regressor @ v)[[1, 4, 7, 10], 0].mean() - (regressor @ v)[0, 0]) > 0
    if points_left != (side == LEFT):
        names = ("right", "left")
        raise FileError(f"{where}: is a {names[points_left]} hand (its fingers point along {'+' if points_left else '-'}x)"
                            f"; it was given as the {names[side]} one")  # fmt: skip
    shape = shape[:, :, :SHAPES]
    if side == LEFT:
        axial = (AXIAL[:, None] * AXIAL).ravel()  # what mirroring does to the entries of R - 1
        v, faces = v * MIRROR, faces[:, ::-1]
        shape, pose = shape * MIRROR[:, None], pose * MIRROR[:, None] * np.tile(axial, 15)
    return _Raw(
        v, faces.astype(np.int32), shape, pose, regressor, np.maximum(weights, 0.0),
        _numbers(found, "hands_mean", (45,), where), _numbers(found, "hands_components", (45, 45), where),
    )  # fmt: skip


def _numbers(found: Mapping[str, Any], name: str, shape: tuple[int | None, ...], where: str) -> F64:
    if found.get(name) is None:
        raise FileError(f"{where}: has no {name}; it is not a MANO file")
    return numbers(found[name], shape, f"{where}: {name}", most=1e10)


def _check_alike(right: _Raw, left: _Raw, where: str) -> None:
    if right.vertices.shape != left.vertices.shape:
        raise FileError(
            f"{where}: {len(left.vertices)} vertices; the right one has {len(right.vertices)}"
        )
    apart = np.abs((right.vertices - right.regressor[0] @ right.vertices)
                   - (left.vertices - left.regressor[0] @ left.vertices)).max()  # fmt: skip
    if apart > ALIKE_M:
        raise FileError(
            f"{where}: its mirror image is up to {1000 * apart:.1f} mm from the right hand; the two are not a pair"
        )


def _side_arrays(raw: _Raw, faces: NDArray[np.int32]) -> dict[str, NDArray[Any]]:
    """One side as a right hand with its wrist joint at the origin for every shape."""
    joints = raw.regressor @ raw.vertices
    joint_shape = np.einsum("jv,vci->jci", raw.regressor, raw.shape_basis)
    vertices, closed = raw.vertices - joints[0], hand_pieces.close_holes(raw.vertices, faces)
    rest = joints - joints[0]
    corner = vertices[closed]
    if np.einsum("fc,fc->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() <= 0:
        raise ValueError("its faces wind clockwise seen from outside")
    pieces = hand_pieces.convex_pieces(vertices, closed, raw.weights, rest)
    if len(vertices) == 778:
        tips = np.array(TIPS_778, np.int32)
    else:
        tips = hand_pieces.tip_vertices(vertices, raw.weights, rest)
    like = load_hand()
    like_vertices, like_joints = like.vertices.double().numpy(), like.joints_rest.double().numpy()
    axes = hand_pieces.joint_axes(
        rest,
        vertices[tips],
        like.joint_axes.double().numpy(),
        like_joints,
        like_vertices[like.tip_vertices.numpy()],
    )
    arrays: dict[str, NDArray[Any]] = {
        "vertices": vertices, "weights": raw.weights, "joints_rest": rest, "joint_axes": axes,
        "shape_basis": raw.shape_basis - joint_shape[0], "joint_shape_basis": joint_shape - joint_shape[0],
        "pose_basis": raw.pose_basis,
    }  # fmt: skip
    return {k: np.ascontiguousarray(v, np.float32) for k, v in arrays.items()} | {
        "faces": closed,
        "parents": np.array(PARENTS, np.int32),
        "piece_vertices": np.concatenate(pieces),
        "piece_offsets": np.cumsum([0] + [len(p) for p in pieces]).astype(np.int32),
        "piece_names": np.array(hand_pieces.NAMES),
        "tip_vertices": tips,
        "shape_names": np.array([f"mano_{i}" for i in range(SHAPES)]),
    }


def _both_sides(right: _Raw | None, left: _Raw | None) -> dict[str, NDArray[Any]]:
    """Mean, components and wrist of right and left hands; a missing one is the other's mirror
    image."""

    def wrist(raw: _Raw, mirror: bool) -> tuple[F64, F64]:
        sign = MIRROR if mirror else np.ones(3)
        rest, moves = (
            raw.regressor[0] @ raw.vertices,
            np.einsum("v,vci->ci", raw.regressor[0], raw.shape_basis),
        )
        return rest * sign, moves * sign[:, None]

    def postures(raw: _Raw, mirror: bool) -> tuple[F64, F64]:
        sign = np.tile(AXIAL if mirror else np.ones(3), 15)
        return raw.mean * sign, raw.components * sign

    either = right or left
    assert either is not None
    by_side = [right or either, left or either]
    # raw arrays are mirrored to right hands
    wrists = [wrist(by_side[s], s == LEFT) for s in (RIGHT, LEFT)]
    means = [postures(by_side[s], (s == LEFT) != (by_side[s] is left)) for s in (RIGHT, LEFT)]
    names = ("wrist_rest", "wrist_shape", "pose_mean", "pose_components")
    columns = (*zip(*wrists, strict=True), *zip(*means, strict=True))
    return {k: np.stack(v).astype(np.float32) for k, v in zip(names, columns, strict=True)}
