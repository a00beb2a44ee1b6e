"""The object of a trial as images show it: the completed solid, or the known mesh where it is believed to lie."""

import hashlib
import warnings
from collections import OrderedDict
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from r2h_batch.observe.seen import Observation, packed
from r2h_batch.observe.solid import completed, region_of_faces, views_of
from r2h_batch.scene.objects import ObjectModel, build_object

KEPT = 256
"""Solids that stay for the next one who asks: 0.3 MB each."""
_SOLIDS: OrderedDict[str, tuple[ObjectModel, Float64[np.ndarray, "4 4"]] | None] = OrderedDict()


def believed_object(
    seen: Observation, row: int
) -> tuple[ObjectModel, Float64[np.ndarray, "4 4"]] | None:
    """An object and where its frame lies in the world (m); None: too little is seen.

    It has one part, or two where it has a told region and more.

    Args:
        seen: of N trials.
        row: which of them.
    """
    if seen.known is not None:
        known, k = seen.known, int(seen.known.mesh[row])
        T = known.T_world_obj[row].double().cpu().numpy()
        vertices, faces = known.vertices[k].cpu().numpy(), known.faces[k].cpu().numpy()
        told = b""
        if seen.region is not None:
            placed = vertices.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
            told = region_of_faces(views_of(seen, row), placed, faces).tobytes()
        return _known(vertices.tobytes(), faces.tobytes(), told), T
    digest = digest_of(seen, row)
    if digest not in _SOLIDS:
        while len(_SOLIDS) >= KEPT:
            _SOLIDS.popitem(last=False)
        _SOLIDS[digest] = _completed(seen, row)
    return _SOLIDS[digest]


def digest_of(seen: Observation, row: int) -> str:
    """Digest of all that decides the solid of a trial. The key is a part of it: draws of the solid follow from that."""
    shown = packed(seen[row : row + 1])
    own = (v for k, v in shown.items() if k.startswith(("object", "T_", "key", "region")))
    return hashlib.sha256(b"".join(v.tobytes() for v in own)).hexdigest()


def _completed(
    seen: Observation, row: int
) -> tuple[ObjectModel, Float64[np.ndarray, "4 4"]] | None:
    """The completed solid of a trial, and where its frame lies: level, about the middle of its box."""
    solid = completed(seen, row)
    if solid is None:
        return None
    T = np.eye(4)
    T[:3, 3] = 0.5 * (solid.vertices.min(0) + solid.vertices.max(0))
    name = f"seen_{int(seen.key[row]):016x}"
    return _built(name, solid.vertices - T[:3, 3], solid.faces, solid.region), T


@lru_cache(maxsize=256)
def _known(vertices: bytes, faces: bytes, told: bytes) -> ObjectModel:
    """A known mesh: in most trials it has come before, if no region is told."""
    v = np.frombuffer(vertices, np.float32).reshape(-1, 3)
    f = np.frombuffer(faces, np.int32).reshape(-1, 3)
    region = np.frombuffer(told, bool) if told else None
    digest = hashlib.sha256(vertices + faces + told).hexdigest()
    return _built(f"known_{digest[:16]}", v.astype(np.float64), f, region)


def _built(
    name: str,
    vertices: NDArray[np.float64],
    faces: NDArray[Any],
    region: NDArray[np.bool_] | None,
) -> ObjectModel:
    import trimesh

    parts: dict[str, Any] = {}
    if region is not None and region.any() and not region.all():
        parts = {
            "split": "S1", "receiver": region, "face_part": region.astype(np.uint8), "part_names": ("body", "region"),
        }  # fmt: skip
    with warnings.catch_warnings():  # a repair of what was seen is no user's business
        warnings.simplefilter("ignore")
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return build_object(mesh, name=name, pieces=False, **parts)
