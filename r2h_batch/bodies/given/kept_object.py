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

from r2h_batch.bodies.mesh_limits import MOST_BYTES
from r2h_batch.files import FileError, read_file
from r2h_batch.files.kept import Column, code_of, kept

__all__ = ["kept_with_warnings", "key_of"]

CODE = (
    "r2h_batch.bodies",
    "r2h_batch.bodies.given",
    "r2h_batch.kernels.geometry",
    "r2h_batch.kernels.receiver",
)
VERSIONS = ("coacd", "manifold3d", "numpy", "scipy", "trimesh", "warp-lang")
"""What objects are made by."""
SAID = "warnings"

FORM = {
    "name": Column("text"),
    "split": Column("text"),
    "instruction": Column("text"),
    "vertices": Column("float32", ("vertices", 3)),
    "faces": Column("int32", ("faces", 3), below="vertices"),
    "face_part": Column("uint8", ("faces",), below="parts"),
    "part_names": Column("text", ("parts",)),
    "receiver_face": Column("bool", ("faces",)),
    "hull_vertices": Column("float32", ("hull", 3)),
    "hull_faces": Column("int32", ("hull faces", 3), below="hull"),
    "piece_vertices": Column("float32", ("piece vertices", 3)),
    "piece_faces": Column("int32", ("piece faces", 3), below="piece vertices"),
    "piece_vertex_offsets": Column("int32", ("pieces",)),
    "piece_face_offsets": Column("int32", ("pieces",)),
    "points": Column("float32", ("points", 3)),
    "normals": Column("float32", ("points", 3)),
    "point_part": Column("uint8", ("points",), below="parts"),
    "point_face": Column("int32", ("points",), below="faces"),
    "voxels": Column("uint8", ("voxels",)),
    "voxel_origin": Column("float64", (3,)),
    "voxel_pitch": Column("float64"),
    "mass": Column("float64"),
    "com": Column("float64", (3,)),
    "inertia": Column("float64", (3, 3)),
    "repair": Column("text"),
    SAID: Column("text"),
}
"""What is kept of an `ObjectModel`, with the warnings."""


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
    digest.update(code_of(CODE, VERSIONS).encode())
    return digest.hexdigest()


def kept_with_warnings(
    key: str,
    make: Callable[[], Mapping[str, Any]],
    reads: Callable[[dict[str, NDArray[Any]]], object],
) -> dict[str, NDArray[Any]]:
    """The arrays of a key, and the warnings that making them gave: again each time they are taken
    from disk.

    `reads` raises where arrays are no object, whatever their form.
    """

    def made() -> dict[str, NDArray[Any]]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = {k: np.asarray(v) for k, v in make().items()}
        return {**found, SAID: np.array(json.dumps([str(w.message) for w in caught]))}

    def read(arrays: dict[str, NDArray[Any]]) -> None:
        _texts(arrays.pop(SAID))
        reads(arrays)

    arrays = kept("objects", key, made, FORM, reads=read)
    for text in _texts(arrays.pop(SAID)):
        warnings.warn(text, stacklevel=4)
    return arrays


def _texts(said: NDArray[Any]) -> Sequence[str]:
    return [str(text) for text in json.loads(str(said))]
