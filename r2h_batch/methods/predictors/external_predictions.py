"""Predictions of a user's own networks, read from files in place of the built-in error model
(`--predicted-hands`, `--predicted-parts`, `--predicted-contacts`).

A file is an .npz. It has N rows by `trial_id` (N,). Parts and contacts may instead
have K rows by `object` (K,), names (.npz), or by `object_index` (K,). `source` (.npz) is the
network's name for the table. Lengths are in metres.

P points are the object's own cloud (`ObjectModel.points`), or `points` (K, P, 3) in its frame. Of
the latter, each point of the own cloud takes the values of the nearest one.

Hands on the object, frame obj, are one of:
    `receiving_T_obj_hand` (N, 4, 4), `receiving_pose` (N, 48) and `receiving_shape` (N, 10; else 0)
    `receiving_joints` (N, 16 or 21, 3) and `receiving_vertices` (N, V, 3)
Hands in the world have the same with `target_` and `target_T_world_hand`. A file has one of the two
or both. 16 joints are MANO's; 21 are OpenPose's (wrist, thumb to little finger, each from its root
to its tip). The side is the trial's.

Parts are one of:
    `label` (., P) index into the object's `part_names`, with `usage` (., P) whether the receiver
        takes it there (S1)
    `role` (., P) of AffNet's affordances: 0 works, 1 grasp, 2 wrap-grasp

Contacts: `probability` (., P) in [0, 1] that a person touches the point.

A file of hands may declare `frame`, `length_unit`, `angle_unit` and `quaternion_order` (with T of 7 numbers), one of points
`length_unit` (r2h_batch/base/declared.py).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from r2h_batch.base.declared import Declared, taken
from r2h_batch.base.errors import FileError
from r2h_batch.base.io.arrays import Spec, check_arrays, check_poses
from r2h_batch.base.io.read import printable, read_npz
from r2h_batch.scene.hand import HandGeometry, HandModel
from r2h_batch.scene.hand_file import check_postures
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.types import Trials

MANO_OF_OPENPOSE = (0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3)
FARTHEST_M = 10.0
HAND_M = (0.05, 0.5)
"""Smallest and largest side of a hand's bounding box: what lies outside is in other units."""
MOST_POINTS = 100_000

Arrays = dict[str, NDArray[Any]]
ROWS = ("trial_id", "object", "object_index", "points")


@dataclass(frozen=True, eq=False)
class ExternalHands:
    """Predicted hands by trial id (sorted), in metres.

    `arrays` are T (N, 4, 4), pose (N, 48) and shape (N, 10), or joints (N, 16, 3) and vertices
    (N, V, 3).
    """

    source: str
    trial_id: NDArray[np.int64]
    arrays: Mapping[str, NDArray[np.float32]]

    def hands(
        self, trials: Trials, model: HandModel, side: Tensor
    ) -> tuple[HandGeometry, Float32[Tensor, "n 4 4"]]:
        """Posed hands of n trials, and the pose (n, 4, 4) of each; on the CPU."""
        rows = rows_of(self.trial_id, trials.trial_id.cpu().numpy())
        a = {k: torch.from_numpy(v[rows]) for k, v in self.arrays.items()}
        if "pose" in a:
            return model.pose(a["pose"], a["shape"], side.cpu()), a["T"]
        eye = torch.eye(4, dtype=torch.float32, device="cpu").expand(len(rows), 4, 4).contiguous()
        return HandGeometry(a["vertices"], a["joints"]), eye


@dataclass(frozen=True, eq=False)
class ExternalPoints:
    """Values of each point of the objects' clouds.

    `arrays` are (N, P) by trial id (sorted), or (O, P) by object index if `trial_id` is None.
    """

    source: str
    trial_id: NDArray[np.int64] | None
    arrays: Mapping[str, NDArray[Any]]

    def of(self, trials: Trials) -> dict[str, Tensor]:
        """(n, P) of each array for these trials, on the CPU."""
        if self.trial_id is None:
            rows = trials.object_index.cpu().numpy().astype(np.int64)
        else:
            rows = rows_of(self.trial_id, trials.trial_id.cpu().numpy())
        return {k: torch.from_numpy(v[rows]) for k, v in self.arrays.items()}


@dataclass(frozen=True, eq=False)
class Observations:
    """Predictions of networks. The built-in error model replaces each that is None."""

    receiving: ExternalHands | None = None
    target: ExternalHands | None = None
    parts: ExternalPoints | None = None
    contacts: ExternalPoints | None = None

    def sources(self) -> dict[str, str]:
        """Kind -> name of the network."""
        return {k: v.source for k, v in vars(self).items() if v is not None}

    def check_trials(self, trial_id: NDArray[np.int64]) -> None:
        """Raise `FileError` if a planned trial has no prediction.

        Args:
            trial_id: (N,) int64, the planned ones.
        """
        for kind, part in vars(self).items():
            ids = None if part is None else part.trial_id
            if ids is not None and len(missing := np.setdiff1d(trial_id, ids)):
                listed = ", ".join(map(str, missing[:10].tolist()))
                listed += ", ..." if len(missing) > 10 else ""
                raise FileError(
                    f"predicted {kind} of {part.source}: {len(missing)} planned trials are missing: {listed}"
                )

    def check_parts(self, trials: Trials, objects: Sequence[ObjectModel]) -> None:
        """Raise `FileError` if a trial's labels name parts that its object does not have.

        Args:
            trials: the planned ones.
            objects: those that `Trials.object_index` counts.
        """
        if self.parts is None or "label" not in self.parts.arrays:
            return
        count = np.array([len(o.part_names) for o in objects])[trials.object_index.cpu().numpy()]
        for first in range(0, len(trials), _LOOKED_AT):
            some = trials[first : first + _LOOKED_AT]
            high = self.parts.of(some)["label"].amax(1).numpy()
            if (odd := np.flatnonzero(high >= count[first : first + _LOOKED_AT])).size:
                row = int(odd[0])
                name, parts = objects[int(some.object_index[row])].name, int(count[first + row])
                raise FileError(
                    f"predicted parts of {self.parts.source}: label of trial {int(some.trial_id[row])} ({name})"
                    f" goes to {high[row]}; it has {parts} part{'s'[: parts > 1]}, 0 to {parts - 1}"
                )


_LOOKED_AT = 4096
ALIKE = 3.0
"""How many times larger or smaller a cloud may be than its object: a view shows one side."""


def read_observations(
    objects: Sequence[ObjectModel],
    hand: HandModel,
    *,
    hands: str = "",
    parts: str = "",
    contacts: str = "",
) -> Observations:
    """Read and check the files of predictions.

    Args:
        objects: of the benchmark.
        hand: the benchmark's hand model.
        hands: file of hands; empty: none.
        parts: file of parts; empty: none.
        contacts: file of contacts; empty: none.

    Raises:
        FileError: in one line, if a file cannot be used.
    """
    found: dict[str, Any] = {}
    if hands:
        found |= _hands(Path(hands), hand)
    if parts:
        found["parts"] = _parts(Path(parts), objects)
    if contacts:
        found["contacts"] = _contacts(Path(contacts), objects)
    return Observations(**found)


def rows_of(ids: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Place of each wanted id among the sorted ids; ValueError if one is missing."""
    at = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
    if (strange := np.flatnonzero(ids[at] != wanted)).size:
        raise ValueError(f"trial {wanted[strange[0]]} has no prediction")
    return at


def _read(
    path: Path, allowed: Sequence[str], declares: Sequence[str] = ("length_unit",)
) -> tuple[Arrays, str, Declared]:
    """Arrays of known names, the network's name, and which of `declares` the file declares."""
    where = printable(path)
    if path.suffix != ".npz":
        raise FileError(f"{where}: predictions of networks are an .npz file")
    arrays = read_npz(path)
    declared = taken(arrays, where, declares)
    if declared.frame == "hand":
        raise FileError(
            f"{where}: frame is 'hand', which these hands define; allowed are world, base_link, base"
        )
    source = arrays.pop("source", np.array(path.stem))
    name = str(source) if source.shape == () and source.dtype.kind == "U" else ""
    if not name.strip() or len(name) > 60 or not name.isprintable():
        raise FileError(f"{where}: source is not a name; give 1 to 60 printable characters")
    if unknown := sorted(set(arrays) - set(allowed)):
        shown = repr(printable(unknown[0])[:60])
        listed = ", ".join((*allowed, "source", *declares))
        raise FileError(f"{where}: unknown array {shown}; allowed are {listed}")
    return arrays, name, declared


def _need(where: str, arrays: Arrays, name: str, spec: Spec) -> NDArray[Any]:
    """The array of this name, as specified."""
    check_arrays(arrays, {name: spec}, where)
    return arrays[name]


def _trial_ids(where: str, arrays: Arrays) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The ids, sorted, and the order that sorts them."""
    ids = _need(where, arrays, "trial_id", ("iu", ("N",)))
    if not len(ids):
        raise FileError(f"{where}: no rows; give one for each planned trial")
    if ids.min() < 0 or int(ids.max()) > np.iinfo(np.int64).max:
        raise FileError(f"{where}: trial_id goes from {ids.min()} to {ids.max()}; need 0 or more")
    order = np.argsort(ids, kind="stable")
    sorted_ids = ids[order].astype(np.int64)
    if (twice := np.flatnonzero(np.diff(sorted_ids) == 0)).size:
        raise FileError(f"{where}: trial {sorted_ids[twice[0]]} is given more than once")
    return sorted_ids, order


def _hands(path: Path, model: HandModel) -> dict[str, ExternalHands]:
    frames = {"receiving": "T_obj_hand", "target": "T_world_hand"}
    names = [
        f"{k}_{n}" for k, T in frames.items() for n in (T, "pose", "shape", "joints", "vertices")
    ]
    arrays, source, declared = _read(path, ("trial_id", *names), HANDS_DECLARE)
    arrays = {name: _converted(name, value, declared) for name, value in arrays.items()}
    where = printable(path)
    ids, order = _trial_ids(where, arrays)
    found = {}
    for kind, T in frames.items():
        chosen = {
            k.removeprefix(f"{kind}_"): v for k, v in arrays.items() if k.startswith(f"{kind}_")
        }
        if chosen:
            values = _one_hand(f"{where}: {kind} hands", chosen, T, len(ids), model)
            found[kind] = ExternalHands(
                source,
                ids,
                {k: np.ascontiguousarray(v[order], np.float32) for k, v in values.items()},
            )
    if not found:
        raise FileError(f"{where}: holds no hands; allowed are {', '.join(names)}")
    return found


HANDS_DECLARE = ("frame", "length_unit", "angle_unit", "quaternion_order")


def _converted(name: str, value: NDArray[Any], declared: Declared) -> NDArray[Any]:
    """An array of hands in our conventions. Only the target's hands are in the world."""
    if name in ("trial_id",) or value.dtype.kind != "f":
        return value
    kind, _, rest = name.partition("_")
    if rest.startswith("T_"):
        value = declared.poses(name, value)
    elif rest in ("joints", "vertices"):
        value = declared.lengths(value)
    elif rest == "pose":
        return declared.angles(value)
    else:
        return value
    return declared.in_world(value) if kind == "target" else value


def _one_hand(where: str, a: Arrays, frame: str, n: int, model: HandModel) -> Arrays:
    """T, pose, shape; or joints in MANO's order and vertices."""
    posed = "pose" in a or frame in a
    if posed == ("vertices" in a or "joints" in a):
        raise FileError(f"{where}: give either {frame} with pose, or joints with vertices")
    if posed:
        a = {"shape": np.zeros((n, 10), np.float32), **a}
        wanted: dict[str, Spec] = {
            frame: ("f", (n, 4, 4)),
            "pose": ("f", (n, 48)),
            "shape": ("f", (n, 10)),
        }
        check_arrays(a, wanted, where)
        check_poses(f"{where}: {frame}", a[frame])
        T, pose, shape = (a[name] for name in wanted)
        try:
            check_postures(pose, shape)
        except ValueError as error:
            raise FileError(f"{where}: {error}") from None
        return {"T": T, "pose": pose, "shape": shape}
    vertices = _need(where, a, "vertices", ("f", (n, "V", 3)))
    if vertices.shape[1] != len(model.vertices):
        raise FileError(
            f"{where}: a skin of {vertices.shape[1]} vertices; the benchmark's hand has {len(model.vertices)}:"
            " give that hand with --hand-model, or pose and shape instead"
        )
    side = np.ptp(vertices, axis=1).max(1)
    wrong = (side < HAND_M[0]) | (side > HAND_M[1]) | (np.abs(vertices).max((1, 2)) > FARTHEST_M)
    if wrong.any():
        row = int(wrong.argmax())
        raise FileError(
            f"{where}: the hand of row {row} is {side[row]:.3g} m large; lengths are in metres, or declare"
            " length_unit"
        )
    joints = _need(where, a, "joints", ("f", (n, "V", 3)))
    if joints.shape[1] not in (16, 21):
        raise FileError(f"{where}: {joints.shape[1]} joints; need MANO's 16 or OpenPose's 21")
    joints = joints[:, MANO_OF_OPENPOSE] if joints.shape[1] == 21 else joints
    apart = np.abs(joints - vertices.mean(1, keepdims=True)).max((1, 2))
    if apart.max() > HAND_M[1]:
        raise FileError(
            f"{where}: joints of row {int(apart.argmax())} are {apart.max():.3g} m off the skin: another frame?"
        )
    return {"joints": joints, "vertices": vertices}


def _parts(path: Path, objects: Sequence[ObjectModel]) -> ExternalPoints:
    arrays, source, declared = _read(path, (*ROWS, "label", "usage", "role"))
    where = printable(path)
    if "points" in arrays:
        arrays["points"] = declared.lengths(arrays["points"])
    if ("role" in arrays) == ("label" in arrays):
        raise FileError(f"{where}: give either role, or label (with usage)")
    if "label" in arrays and "usage" not in arrays and any(o.split == "S1" for o in objects):
        raise FileError(f"{where}: has label without usage; S1 objects need it (or give role)")
    names = ("role",) if "role" in arrays else ("label", *(("usage",) if "usage" in arrays else ()))
    most = 2 if "role" in arrays else max(len(o.part_names) for o in objects) - 1
    for name in names:
        high = 1 if name == "usage" else most
        value = _need(where, arrays, name, ("iub", ("N", "P")))
        if value.size and not 0 <= int(value.min()) <= int(value.max()) <= high:
            raise FileError(
                f"{where}: {name} goes from {value.min()} to {value.max()}; allowed are 0 to {high}"
            )
    return _by_key(where, arrays, source, names, np.uint8, objects)


def _contacts(path: Path, objects: Sequence[ObjectModel]) -> ExternalPoints:
    arrays, source, declared = _read(path, (*ROWS, "probability"))
    where = printable(path)
    if "points" in arrays:
        arrays["points"] = declared.lengths(arrays["points"])
    value = _need(where, arrays, "probability", ("f", ("N", "P")))
    if value.size and not 0 <= value.min() <= value.max() <= 1:
        raise FileError(
            f"{where}: probability goes from {value.min():.3g} to {value.max():.3g}; need 0 to 1 (a sigmoid?)"
        )
    return _by_key(where, arrays, source, ("probability",), np.float32, objects)


def _by_key(
    where: str,
    arrays: Arrays,
    source: str,
    names: Sequence[str],
    dtype: Any,
    objects: Sequence[ObjectModel],
) -> ExternalPoints:
    """Rows by trial or by object, on the objects' own clouds."""
    own = len(objects[0].points)
    keys = [k for k in ROWS[:3] if k in arrays]
    if len(keys) != 1:
        raise FileError(
            f"{where}: rows go by one of trial_id, object, object_index; found {', '.join(keys) or 'none'}"
        )
    if keys == ["trial_id"]:
        ids, order = _trial_ids(where, arrays)
        if "points" in arrays:
            raise FileError(f"{where}: points go with rows by object, not by trial")
        values = {
            k: _need(where, arrays, k, ("fiub", (len(ids), own)))[order].astype(dtype)
            for k in names
        }
        return ExternalPoints(source, ids, values)
    rows = _object_rows(where, arrays, objects)
    k = len(arrays[keys[0]])
    if "points" not in arrays:
        values = {n: _need(where, arrays, n, ("fiub", (k, own)))[rows].astype(dtype) for n in names}
        return ExternalPoints(source, None, values)
    points = _need(where, arrays, "points", ("f", (k, "P", 3)))
    if not 1 <= points.shape[1] <= MOST_POINTS:
        raise FileError(f"{where}: {points.shape[1]} points an object; need 1 to {MOST_POINTS}")
    for row, o in zip(rows, objects, strict=True):
        low, high = points[row].min(0), points[row].max(0)
        span, own_span = float((high - low).max()), float(np.ptp(o.points, axis=0).max())
        off = float(np.abs((low + high) / 2 - (o.points.min(0) + o.points.max(0)) / 2).max())
        if not own_span / ALIKE <= span <= own_span * ALIKE or off > own_span:
            raise FileError(
                f"{where}: points of {o.name} span {span:.3g} m about a middle {off:.3g} m off, the object spans"
                f" {own_span:.3g} m; they must be on it, in its frame and in metres"
            )
    pairs = zip(rows, objects, strict=True)
    near = np.stack([cKDTree(points[row]).query(o.points)[1] for row, o in pairs])
    values = {n: _need(where, arrays, n, ("fiub", (k, points.shape[1])))[rows] for n in names}
    return ExternalPoints(
        source, None, {n: np.take_along_axis(v, near, 1).astype(dtype) for n, v in values.items()}
    )


def _object_rows(where: str, arrays: Arrays, objects: Sequence[ObjectModel]) -> NDArray[np.int64]:
    """The row of each of the benchmark's objects."""
    if "object" in arrays:
        names = [str(n) for n in _need(where, arrays, "object", ("U", ("N",)))]
        wanted: Sequence[Any] = [o.name for o in objects]
    else:
        names = _need(where, arrays, "object_index", ("iu", ("N",))).tolist()
        wanted = range(len(objects))
    if twice := [n for n, k in Counter(names).items() if k > 1]:
        raise FileError(f"{where}: object {printable(twice[0])} is given more than once")
    if missing := [n for n in wanted if n not in names]:
        raise FileError(
            f"{where}: no row for object {missing[0]}; give one for each of the benchmark's {len(objects)} objects"
        )
    return np.array([names.index(n) for n in wanted], np.int64)
