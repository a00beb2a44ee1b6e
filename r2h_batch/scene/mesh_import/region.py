"""Part labels and the receiver's region of an object: as given, carried over to the faces that a
repair left."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable, read_file
from r2h_batch.scene.mesh_import.closed import Closed
from r2h_batch.scene.mesh_import.limits import ObjectMeshError
from r2h_batch.scene.solid import Surface

MAX_REGION_BYTES = 64 << 20
"""Largest file of the receiver's faces: eight bytes for each of millions."""
RIGID, ON_SIDE_M = 1e-6, 1e-6
"""How far a box's rows may be from a rotation; faces of an object may lie on the sides of its boxes."""
PLANE = re.compile(r"\s*([xyz])\s*([<>])\s*([0-9.]+)\s*")
WAYS = "the name of a part, 'AXIS<FRACTION' (axis x, y or z; < or >; fraction of the bounding box from its low side)"

Receiver = str | Path | NDArray[np.generic] | None


def carried(closed: Closed) -> NDArray[np.int64]:
    """(F,) the given face that each face of the closed surface was, or lies nearest to."""
    if closed.same:
        return np.arange(len(closed.mesh.faces))
    return Surface(closed.given).within(closed.mesh.triangles_center, 100.0)[1]


def part_of_faces(
    face_part: NDArray[np.integer] | None, names: Sequence[str], closed: Closed, label: str
) -> NDArray[np.uint8]:
    """(F,) uint8 labels of the closed surface's faces, all 0 where none were given.

    Args:
        face_part: (G,) part of each face of the given mesh, in the order of its file, or None.
        names: of the parts.
        closed: the given mesh and its closed surface.
        label: the object's name in errors.
    """
    if face_part is None:
        return np.zeros(len(closed.mesh.faces), np.uint8)
    given, count = np.asarray(face_part), len(closed.given.faces)
    if given.shape != (count,) or given.dtype.kind not in "iu":
        raise ObjectMeshError(
            f"{label}: {len(given)} part labels for a mesh that has {count} faces; one whole number for each face of the "
            "file is needed, in its order"
        )
    if count and not 0 <= int(given.min()) <= int(given.max()) < min(len(names), 256):
        raise ObjectMeshError(
            f"{label}: part labels go from {given.min()} to {given.max()}; there are {len(names)} part names"
        )
    return given[carried(closed)].astype(np.uint8)


def no_region(label: str) -> ObjectMeshError:
    """The refusal of an S1 object without a region.

    Args:
        label: the object's name in errors.
    """
    return ObjectMeshError(
        f"{label}: an S1 object needs the receiver's region: {WAYS}, or an .npy file of faces"
    )


def receiver_region(
    solid: trimesh.Trimesh,
    receiver: Receiver,
    closed: Closed,
    parts: NDArray[np.uint8],
    names: Sequence[str],
    label: str,
) -> NDArray[np.bool_]:
    """(F,) bool: the faces of the region.

    Args:
        solid: the surface that is judged.
        receiver: names of parts, a file or an array of faces, or boxes; None is refused.
        closed: the given mesh and its closed surface.
        parts: (F,) labels, as `part_of_faces` gives them.
        names: of the parts.
        label: the object's name in errors.
    """
    if receiver is None:
        raise no_region(label)
    words = [w.strip() for w in receiver.split(",")] if isinstance(receiver, str) else []
    if words and all(w in names for w in words):  # parts, such as `handle,guard`
        region = np.isin(parts, [names.index(w) for w in words])
    elif isinstance(receiver, str) and (match := PLANE.fullmatch(receiver)):
        low, high = solid.bounds
        axis, fraction = "xyz".index(match[1]), float(match[3])
        position = (solid.triangles_center[:, axis] - low[axis]) / (high[axis] - low[axis])
        region = position < fraction if match[2] == "<" else position > fraction
    elif (boxes := region_boxes(receiver, names, label)) is not None:
        region = faces_in_boxes(solid.triangles_center, boxes)
    else:
        given = _region_array(receiver, names, label)
        region = _region_of_faces(given, len(closed.given.faces), label)[carried(closed)]
    if not region.any() or region.all():
        raise ObjectMeshError(
            f"{label}: the receiver region {'is empty' if not region.any() else 'is the whole object'}; "
            "the robot needs a part to hold and the receiver a part to take"
        )
    return region


def region_boxes(
    receiver: Receiver, names: Sequence[str], label: str
) -> NDArray[np.float64] | None:
    """The boxes that a region is said by (`ObjectModel.receiver_boxes`); None where something else says it.

    Args:
        receiver: as of `receiver_region`.
        names: of the parts.
        label: the object's name in errors.
    """
    if receiver is None or (isinstance(receiver, (str, Path)) and Path(receiver).suffix != ".npy"):
        return None
    given = _region_array(receiver, names, label)
    if given.dtype.kind != "f":
        return None
    boxes = given.astype(np.float64)
    if boxes.shape[1:] != (5, 3) or not np.isfinite(boxes).all():
        raise ObjectMeshError(
            f"{label}: receiver array is {given.dtype} {given.shape}; boxes are finite numbers (N, 5, 3): centre, half sides, "
            "and three rows of a rotation"
        )
    R = boxes[:, 2:]
    turned = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0.0)
    wrong = (boxes[:, 1] <= 0).any(1) | (turned > RIGID) | (np.linalg.det(R) < 0)
    if wrong.any():
        raise ObjectMeshError(
            f"{label}: box {wrong.argmax()} of the receiver has a half side that is not positive, or rows that are no rotation"
        )
    return boxes


def faces_in_boxes(middle: NDArray[np.float64], boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(F,) which faces have their middle (F, 3) in a box, or on its side."""
    found = np.zeros(len(middle), bool)
    for box in boxes:
        found |= (np.abs((middle - box[0]) @ box[2:]) <= box[1] + ON_SIDE_M).all(1)
    return found


def _region_array(
    receiver: str | Path | NDArray[np.generic], names: Sequence[str], label: str
) -> NDArray[np.generic]:
    if isinstance(receiver, (str, Path)):
        return read_region(receiver, names, label)
    return np.asarray(receiver)


def read_region(path: str | Path, names: Sequence[str], label: str) -> NDArray[np.generic]:
    """The array of an .npy file that says the region's faces."""
    if Path(path).suffix != ".npy" or not Path(path).exists():
        have = f"; its parts are {', '.join(names)}" if len(names) > 1 else ""
        raise ObjectMeshError(
            f"{label}: receiver {printable(path)!r} is neither an existing .npy file nor {WAYS} such as 'z<0.3'{have}"
        )
    try:
        data = io.BytesIO(read_file(path, MAX_REGION_BYTES))
        return np.asarray(np.load(data, allow_pickle=False))
    except FileError as error:
        raise ObjectMeshError(f"{label}: receiver {error}") from None
    except Exception as error:  # numpy's reader parses Python text and raises whatever that meets
        raise ObjectMeshError(
            f"{label}: receiver {printable(path)} is not a plain .npy array ({printable(error)[:200]})"
        ) from error


def _region_of_faces(chosen: NDArray[np.generic], count: int, label: str) -> NDArray[np.bool_]:
    """(F,) bool of the given faces: as it is, or of face indices."""
    region = np.zeros(count, bool)
    if chosen.dtype == bool and chosen.shape == region.shape:
        region |= chosen
    elif (
        chosen.ndim == 1
        and chosen.dtype.kind in "iu"
        and (not len(chosen) or 0 <= chosen.min() <= chosen.max() < count)
    ):
        region[chosen] = True
    else:
        raise ObjectMeshError(
            f"{label}: receiver array is {chosen.dtype} {chosen.shape}; expected bool ({count},) or face indices below "
            f"{count}, of the file's faces"
        )
    return region
