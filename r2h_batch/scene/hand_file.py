"""Arrays that a user's hand.npz and hand set must hold, checked before use."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.arrays import Spec, check_arrays, not_rigid
from r2h_batch.base.io.read import printable, read_npz

HAND: dict[str, Spec] = {
    "vertices": ("f", ("V", 3)), "faces": ("iu", ("F", 3)), "weights": ("f", ("V", 16)),
    "joints_rest": ("f", (16, 3)), "shape_basis": ("f", ("V", 3, 10)),
    "joint_shape_basis": ("f", (16, 3, 10)), "parents": ("iu", (16,)), "joint_axes": ("f", (16, 3, 3)),
    "piece_vertices": ("iu", ("M",)), "piece_offsets": ("iu", ("P+1",)), "piece_names": ("U", ("P",)),
    "tip_vertices": ("iu", (5,)), "shape_names": ("U", ("S",)),
}  # fmt: skip
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
MAX_VERTICES, MAX_HANDS = 20_000, 100_000
OPTIONAL: dict[str, Spec] = {
    "pose_basis": ("f", ("V", 3, 135)),
    "pose_mean": ("f", (2, 45)),
    "pose_components": ("f", (2, 45, 45)),
}
SET: dict[str, Spec] = {
    "pose": ("f", ("H", 48)), "shape": ("f", ("H", 10)), "side": ("iu", ("H",)), "posture": ("U", ("H",)),
}  # fmt: skip

BODY: dict[str, Spec] = {
    "facing": ("f", ("H", 3)),
    "up": ("f", ("H", 3)),
    "T_world_hand": ("f", ("H", 4, 4)),
}
"""Fields of a hand set on a hand's body and place when it was recorded, in one world."""
ARM: dict[str, Spec] = {"arm": ("f", ("H", 3, 3))}
"""Its shoulder, elbow and wrist there."""
LONGEST_M = 1.0
"""Longest upper arm or forearm."""

MOST_TURN_RAD = 2 * math.pi
MOST_SHAPE = 100.0


def check_postures(pose: NDArray[Any], shape: NDArray[Any]) -> None:
    """ValueError that names the hand and the joint where an axis-angle turn of (H, 48) is more than
    a whole turn, or one of (H, 10) shape numbers is no hand's: degrees, mostly."""
    turn = np.linalg.norm(np.asarray(pose, np.float64).reshape(len(pose), -1, 3), axis=2)
    if turn.size and not turn.max() <= MOST_TURN_RAD:
        hand, joint = np.unravel_index(int(np.argmax(~(turn <= MOST_TURN_RAD))), turn.shape)
        raise ValueError(
            f"pose of hand {hand} turns joint {joint} by {turn[hand, joint]:.4g} rad; a turn is an axis times radians,"
            f" at most {MOST_TURN_RAD:.4g}. If these are degrees, multiply them by pi / 180"
        )
    size = np.abs(np.asarray(shape, np.float64))
    if size.size and not size.max() <= MOST_SHAPE:
        odd = int(np.argmax(~(size <= MOST_SHAPE).all(1)))
        raise ValueError(
            f"shape of hand {odd} goes up to {size[odd].max():.4g}; at most {MOST_SHAPE:g} is allowed"
        )


SMALLEST_M, LARGEST_M, MOST_BEND_M = 0.05, 1.0, 0.1
"""Limits of a hand's largest side, and of a vertex's shift by one unit of a blend shape; beyond
them lengths are not in metres."""


def check_lengths(arrays: Mapping[str, Any]) -> None:
    """ValueError where the arrays of a hand model are of no hand's size: in other units than metres
    and radians, mostly."""
    for name in ("vertices", "left_vertices", "joints_rest", "left_joints_rest"):
        if name not in arrays:
            continue
        side = float(np.ptp(np.asarray(arrays[name], np.float64), axis=0).max())
        if not SMALLEST_M <= side <= LARGEST_M:
            raise ValueError(
                f"{name} span {side:.4g} m; a hand's span {SMALLEST_M} to {LARGEST_M} m. Lengths are in metres: from millimetres"
                " multiply by 0.001"
            )
    for name in ("shape_basis", "joint_shape_basis", "pose_basis"):
        for key in (name, f"left_{name}"):
            most = float(np.abs(arrays[key]).max(initial=0.0)) if key in arrays else 0.0
            if most > MOST_BEND_M:
                raise ValueError(
                    f"{key} moves a vertex by {most:.4g} m; at most {MOST_BEND_M} is allowed. It must be of the vertices' unit"
                )
    if "pose_mean" in arrays:
        check_postures(np.asarray(arrays["pose_mean"]), np.zeros((1, 10)))


def read_hand(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of a hand model as `HandModel.from_arrays` takes them. Raises `FileError`, one
    line."""
    where, arrays = printable(path), read_npz(Path(path))
    left = {f"left_{k}": v for k, v in {**HAND, **OPTIONAL}.items()}
    given = {k: v for k, v in {**OPTIONAL, **left}.items() if k in arrays}
    sizes = check_arrays(arrays, {**HAND, **given}, where)
    if sizes["V"] > MAX_VERTICES:
        raise FileError(f"{where}: {sizes['V']} vertices; a hand may have {MAX_VERTICES}")
    if tuple(arrays["parents"].tolist()) != PARENTS:
        raise FileError(f"{where}: parents are not MANO's, {PARENTS}")
    offsets = arrays["piece_offsets"].astype(np.int64)
    if (
        len(offsets) != sizes["P"] + 1
        or offsets[0] != 0
        or offsets[-1] != sizes["M"]
        or (np.diff(offsets) < 4).any()
    ):
        raise FileError(f"{where}: piece_offsets do not make {sizes['P']} pieces of 4 or more")
    for name in ("faces", "piece_vertices", "tip_vertices"):
        if arrays[name].min(initial=0) < 0 or arrays[name].max(initial=0) >= sizes["V"]:
            raise FileError(f"{where}: {name} names other vertices than the {sizes['V']} there are")
    weights = [arrays[k] for k in ("weights", "left_weights") if k in arrays]
    if any(w.min() < 0 or np.abs(w.sum(1) - 1).max() > 1e-3 for w in weights):
        raise FileError(f"{where}: weights must be 0 or more and sum to 1 for every vertex")
    try:
        check_lengths(arrays)
    except ValueError as error:
        raise FileError(f"{where}: {error}") from None
    return {k: v for k, v in arrays.items() if k in HAND or k in given}


HELD_S = 0.25
"""A hand that carries the object for this long has contact with it; `import hands` leaves others
out."""


@dataclass(frozen=True)
class HandChoice:
    """Which hands of a set are taken; None: all."""

    side: Literal["right", "left"] | None = None
    count: int | None = None
    """number of hands a side, at even steps through the file"""
    object: tuple[str, ...] | None = None
    """names of objects that they were recorded with"""
    contact: bool | None = None
    """whether they carry the object"""
    mover: bool | None = None
    """whether they carry it longest of the hands of their sequence"""

    def rows(self, arrays: Mapping[str, Any], where: str) -> NDArray[np.int64]:
        """The rows of these hands in a file's arrays. Raises `FileError`, one line."""
        side, fits = arrays["side"], np.ones(len(arrays["side"]), bool)
        known: dict[str, NDArray[Any]] = {}
        for field, name, kind in (
            ("object", "object", "U"), ("contact", "held_s", "f"), ("mover", "mover", "b")
        ):  # fmt: skip
            if getattr(self, field) is None:
                continue
            values = arrays.get(name)
            if values is None or (values.dtype.kind, values.shape) != (kind, side.shape):
                raise FileError(f"{where}: does not know {field} (no {name}); leave it out")
            known[field] = values
        if self.object is not None:
            if missing := set(self.object) - set(known["object"].tolist()):
                there = ", ".join(map(printable, sorted(set(known["object"].tolist()))[:20]))
                raise FileError(
                    f"{where}: no hand with the object {min(missing)!r}; there are {there}"
                )
            fits &= np.isin(known["object"], self.object)
        if self.contact is not None:
            held = known["contact"]
            fits &= held >= HELD_S if self.contact else held < HELD_S
        if self.mover is not None:
            fits &= known["mover"] == self.mover
        taken = []
        for number, name in enumerate(("right", "left")):
            rows = np.flatnonzero(fits & (side == number))
            if self.side not in (None, name):
                continue
            if self.count is not None and self.side is None and not len(rows):
                continue
            if self.count is not None and len(rows) < self.count:
                raise FileError(
                    f"{where}: {len(rows)} {name} hands fit; count asks for {self.count}: ask for fewer, or import more"
                )
            n = len(rows) if self.count is None else self.count
            taken.append(rows[np.arange(n) * len(rows) // max(n, 1)])
        chosen = np.concatenate(taken) if taken else np.zeros(0, np.int64)
        if not len(chosen):
            raise FileError(f"{where}: none of {len(side)} hands fit {printable(self)}")
        return chosen


def read_hand_set(path: str | Path, choice: HandChoice = HandChoice()) -> dict[str, np.ndarray]:
    """Arrays of the chosen hands: pose (H, 48), shape (H, 10), side (H,), posture (H,) of a hand
    set, and in_body (H, 3, 5) float64: how hand and arm stood to the body (`HandSet.in_body`), NaN
    where the file does not know. Raises `FileError`, one line."""
    where, arrays = printable(path), read_npz(Path(path))
    sizes = check_arrays(arrays, SET, where)
    if not 1 <= sizes["H"] <= MAX_HANDS:
        raise FileError(f"{where}: {sizes['H']} hands; a set may have 1 to {MAX_HANDS}")
    if not np.isin(arrays["side"], (0, 1)).all():
        raise FileError(f"{where}: side must be 0 (right) or 1 (left)")
    try:
        check_postures(arrays["pose"], arrays["shape"])
    except ValueError as error:
        raise FileError(f"{where}: {error}") from None
    turned, rows = in_body(arrays, sizes["H"], where), choice.rows(arrays, where)
    return {k: v[rows] for k, v in {**{k: arrays[k] for k in SET}, "in_body": turned}.items()}


def in_body(arrays: Mapping[str, Any], count: int, where: str) -> np.ndarray:
    """Rotations (H, 3, 3) from body to hand, and as columns 3 and 4 elbow and wrist from the shoulder:
    the body stands as `up` says and looks where `facing` does, level."""
    out = np.full((count, 3, 5), np.nan)
    if not all(name in arrays for name in BODY):
        return out
    there = BODY | (ARM if "arm" in arrays else {})
    specs: dict[str, Spec] = {k: (kind, (count, *shape[1:])) for k, (kind, shape) in there.items()}
    check_arrays(arrays, specs, where, gaps=specs)
    facing, up, T = (arrays[name].astype(np.float64) for name in BODY)
    known = np.isfinite(facing).all(1) & np.isfinite(up).all(1) & np.isfinite(T).all((1, 2))
    facing, up, T = facing[known], up[known], T[known]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = up / np.sqrt((up * up).sum(1, keepdims=True))
        x = facing - (facing * z).sum(1, keepdims=True) * z
        x = x / np.sqrt((x * x).sum(1, keepdims=True))
        body = np.stack([x, np.cross(z, x), z], 2)
    bad = not_rigid(T) | ~np.isfinite(body).all((1, 2))
    if bad.any():
        i = int(np.flatnonzero(known)[bad.argmax()])
        raise FileError(
            f"{where}: T_world_hand, facing and up of hand {i} must be a rotation and two different directions"
        )
    out[known, :, :3] = body.transpose(0, 2, 1) @ T[:, :3, :3]
    if "arm" in arrays:
        arm = arrays["arm"].astype(np.float64)
        length = np.linalg.norm(np.diff(arm, axis=1), axis=2)
        if (bad := ((length <= 0) | (length > LONGEST_M)).any(1)).any():
            odd = int(bad.argmax())
            raise FileError(
                f"{where}: arm of hand {odd} has limbs of {length[odd].round(3).tolist()} m; up to {LONGEST_M} m are allowed"
            )
        ways = (arm[known, 1:] - arm[known, :1]).transpose(0, 2, 1)
        out[known, :, 3:] = body.transpose(0, 2, 1) @ ways
    return out
