"""A built object kept on disk: what names it, and its way into arrays and back."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.cache import ArraySpec, cached, code_digest
from r2h_batch.base.io.read import read_file
from r2h_batch.scene.mesh_import.limits import MOST_BYTES, REPAIRED

CODE = (
    *(
        f"r2h_batch.scene.{name}"
        for name in ("arrays", "grasp_set", "mesh_import", "objects", "solid")
    ),
    *("r2h_batch.kernels.options", "r2h_batch.kernels.geometry.mesh_distance"),
)
VERSIONS = ("coacd", "libigl", "manifold3d", "numpy", "scipy", "trimesh", "warp-lang")
"""Modules and distributions that make objects. Another of them makes every object again."""
SAID = "warnings"

FORM = {
    **dict.fromkeys(("name", "split", "instruction", "repair", SAID), ArraySpec("text")),
    "vertices": ArraySpec("float32", ("vertices", 3)),
    "faces": ArraySpec("int32", ("faces", 3), below="vertices"),
    "face_part": ArraySpec("uint8", ("faces",), below="parts"),
    "part_names": ArraySpec("text", ("parts",)),
    "receiver_face": ArraySpec("bool", ("faces",)),
    "hull_vertices": ArraySpec("float32", ("hull", 3)),
    "hull_faces": ArraySpec("int32", ("hull faces", 3), below="hull"),
    "piece_vertices": ArraySpec("float32", ("piece vertices", 3)),
    "piece_faces": ArraySpec("int32", ("piece faces", 3), below="piece vertices"),
    "piece_vertex_offsets": ArraySpec("int32", ("pieces",)),
    "piece_face_offsets": ArraySpec("int32", ("pieces",)),
    "points": ArraySpec("float32", ("points", 3)),
    "normals": ArraySpec("float32", ("points", 3)),
    "point_part": ArraySpec("uint8", ("points",), below="parts"),
    "point_face": ArraySpec("int32", ("points",), below="faces"),
    "voxels": ArraySpec("uint8", ("voxels",)),
    "voxel_origin": ArraySpec("float64", (3,)),
    "voxel_pitch": ArraySpec("float64"),
    "mass": ArraySpec("float64"),
    "com": ArraySpec("float64", (3,)),
    "inertia": ArraySpec("float64", (3, 3)),
}
"""Stored fields of an `ObjectModel`, with the warnings."""


def key_of(mesh: object, options: Mapping[str, Any]) -> str | None:
    """sha256 (hex) over a mesh file's bytes, the options and the code; None for what is not one
    file: a mesh in memory, a .gltf or .glb that names others."""
    if not isinstance(mesh, (str, Path)):
        return None
    digest = hashlib.sha256(Path(mesh).suffix.lower().encode())
    try:
        data = read_file(mesh, MOST_BYTES)
        if Path(mesh).suffix.lower() in (".gltf", ".glb") and b'"uri"' in data:
            return None
        digest.update(data)
        for name, value in options.items():
            if isinstance(value, (str, Path)) and str(value).endswith(".npy"):
                value = hashlib.sha256(read_file(value, MOST_BYTES)).hexdigest()
            if isinstance(value, np.ndarray):
                value = [
                    value.dtype.str,
                    value.shape,
                    hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest(),
                ]
            digest.update(json.dumps([name, value], default=str).encode())
    except FileError:
        return None  # whoever reads it says what is wrong
    digest.update(code_digest(CODE, VERSIONS).encode())
    return digest.hexdigest()


def kept_with_warnings(
    key: str,
    make: Callable[[], Mapping[str, Any]],
    reads: Callable[[dict[str, NDArray[Any]]], object],
) -> dict[str, NDArray[Any]]:
    """The arrays of a key, and the warnings that making them gave: again each time they are taken
    from disk, but for a repair. That is said where it is made.

    `reads` raises where arrays of the right form are not an object.
    """

    new = False

    def made() -> dict[str, NDArray[Any]]:
        nonlocal new
        new = True
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = {k: np.asarray(v) for k, v in make().items()}
        return {**found, SAID: np.array(json.dumps([str(w.message) for w in caught]))}

    def read(arrays: dict[str, NDArray[Any]]) -> None:
        _texts(arrays.pop(SAID))
        reads(arrays)

    arrays = cached("objects", key, made, FORM, reads=read)
    for text in _texts(arrays.pop(SAID)):
        if new or REPAIRED not in text:
            warnings.warn(text, stacklevel=4)
    return arrays


def _texts(stored: NDArray[Any]) -> Sequence[str]:
    return [str(text) for text in json.loads(str(stored))]
