"""Roles of an object's parts for Handover-VA, after AffNet's labels: parts to grasp, parts to wrap a
hand around, and parts that work (cut, pound, ...)."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.vocabulary import S0_ROLES

FUNCTION, GRASP, WRAP = 0, 1, 2

CODES = {"function": FUNCTION, "grasp": GRASP, "wrap": WRAP}
"""Words of a benchmark file."""


@lru_cache(maxsize=8)
def roles_of(objects: tuple[ObjectModel, ...]) -> NDArray[np.uint8]:
    """(O, parts) uint8 role of each part. If the benchmark file has none, a part of an S1 object is
    GRASP if most of it lies in the receiver's region; all others are FUNCTION."""
    table = np.full((len(objects), max(len(o.part_names) for o in objects)), FUNCTION, np.uint8)
    for row, model in zip(table, objects, strict=True):
        known = S0_ROLES.get(model.name, {}) if model.split == "S0" else {}
        specified = model.roles or {}
        for k, name in enumerate(model.part_names):
            faces = model.face_part == k
            taken = model.split == "S1" and faces.any() and model.receiver_face[faces].mean() > 0.5
            default = GRASP if taken else CODES[known.get(name, "function")]
            row[k] = CODES[specified[name]] if name in specified else default
    return table
