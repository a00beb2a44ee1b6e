"""Objects that nobody needs the shape of: a name and a split, for their place in the order that
trials go by."""

from functools import lru_cache
from typing import Any

import numpy as np

from r2h_batch.bodies.objects import ObjectModel

__all__ = ["is_unbuilt", "unbuilt"]


@lru_cache(maxsize=1024)
def unbuilt(name: str, split: str) -> ObjectModel:
    """An object without a face: it can be counted, not handed over. One for each name and split."""
    shapes = {
        "vertices": ("f4", (0, 3)), "faces": ("i4", (0, 3)), "face_part": ("u1", (0,)), "receiver_face": ("?", (0,)),
        "hull_vertices": ("f4", (0, 3)), "hull_faces": ("i4", (0, 3)), "piece_vertices": ("f4", (0, 3)),
        "piece_faces": ("i4", (0, 3)), "piece_vertex_offsets": ("i4", (1,)), "piece_face_offsets": ("i4", (1,)),
        "points": ("f4", (0, 3)), "normals": ("f4", (0, 3)), "point_part": ("u1", (0,)), "point_face": ("i4", (0,)),
        "voxels": ("u1", (0,)), "voxel_origin": ("f8", (3,)), "com": ("f8", (3,)), "inertia": ("f8", (3, 3)),
    }  # fmt: skip
    arrays: dict[str, Any] = {k: np.zeros(shape, kind) for k, (kind, shape) in shapes.items()}
    for array in arrays.values():
        array.flags.writeable = False
    return ObjectModel(name, split, "", part_names=(), voxel_pitch=0.0, mass=0.0, **arrays)


def is_unbuilt(model: ObjectModel) -> bool:
    """Whether this is only a name and a split."""
    return len(model.faces) == 0
