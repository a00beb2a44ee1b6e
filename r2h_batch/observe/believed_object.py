"""The object of a trial as images show it: the completed solid, or the known mesh where it is believed to lie."""

import gc
import hashlib
import itertools
import warnings
from collections import OrderedDict
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from r2h_batch.observe.seen import Observation, packed
from r2h_batch.observe.solid import completed, region_of_faces, views_of
from r2h_batch.scene.objects import ObjectModel, build_object

KEPT_SOLIDS = 1024
"""Solids, and hands and contacts on them, that stay for the next method of a sweep of 500 trials a split: 1.1 CPU seconds and
0.3 MB each."""
SOLIDS: OrderedDict[str, tuple[ObjectModel, NDArray[np.float64]] | None] = OrderedDict()

GARBAGE_AFTER = 16
"""Solids that are built before garbage is looked for. Each leaves 15 MB of meshes that refer to each other in circles, and Python
itself looks for those too seldom: 900 MB in 80 trials. So it is 240 MB at most, for 1.5 % of a solid's 0.7 CPU seconds."""
_BUILT = itertools.count(1)


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
        return known_mesh(vertices.tobytes(), faces.tobytes(), told), T
    one = seen[row : row + 1]
    if one.region is not None and not one.region.any():  # as where none is told
        one = replace(one, region=None)
    # the key too: it is of all images, and draws of the solid follow from it
    own = (v for k, v in packed(one).items() if k.startswith(("object", "T_", "key", "region")))
    digest = hashlib.sha256(b"".join(v.tobytes() for v in own)).hexdigest()
    if digest not in SOLIDS:
        while len(SOLIDS) >= KEPT_SOLIDS:
            SOLIDS.popitem(last=False)
        SOLIDS[digest] = _completed(one)
    return SOLIDS[digest]


def _completed(seen: Observation) -> tuple[ObjectModel, Float64[np.ndarray, "4 4"]] | None:
    """The completed solid of one trial, and where its frame lies: level, about the middle of its box."""
    solid = completed(seen, 0)
    if solid is None:
        return None
    T = np.eye(4)
    T[:3, 3] = 0.5 * (solid.vertices.min(0) + solid.vertices.max(0))
    name = f"seen_{int(seen.key[0]):016x}"
    return _built(name, solid.vertices - T[:3, 3], solid.faces, solid.region), T


@lru_cache(maxsize=256)
def known_mesh(vertices: bytes, faces: bytes, told: bytes) -> ObjectModel:
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
        try:
            mesh = trimesh.Trimesh(vertices, faces, process=False)
            return build_object(mesh, name=name, pieces=False, **parts)
        finally:
            if next(_BUILT) % GARBAGE_AFTER == 0:
                gc.collect()
