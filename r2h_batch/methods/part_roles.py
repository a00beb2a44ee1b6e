"""What the parts of an object are for, as AffNet's labels say it: what to take (grasp), what works
(cut, pound, ...), what to wrap a hand around. Handover-VA tells these three apart and no more."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from r2h_batch.benchmark.words import S0_ROLES
from r2h_batch.bodies.objects import ObjectModel

__all__ = ["FUNCTION", "GRASP", "WRAP", "roles_of"]

FUNCTION, GRASP, WRAP = 0, 1, 2

CODES = {"function": FUNCTION, "grasp": GRASP, "wrap": WRAP}
"""As a benchmark file says them."""


@lru_cache(maxsize=8)
def roles_of(objects: tuple[ObjectModel, ...]) -> NDArray[np.uint8]:
    """(O, parts) role of each part: what the benchmark says; else parts of S1 that lie in the
    receiver's region are GRASP, all others FUNCTION."""
    table = np.full((len(objects), max(len(o.part_names) for o in objects)), FUNCTION, np.uint8)
    for row, model in zip(table, objects, strict=True):
        known = S0_ROLES.get(model.name, {}) if model.split == "S0" else {}
        said = model.roles or {}
        for k, name in enumerate(model.part_names):
            faces = model.face_part == k
            taken = model.split == "S1" and faces.any() and model.receiver_face[faces].mean() > 0.5
            row[k] = (
                CODES[said[name]]
                if name in said
                else GRASP
                if taken
                else CODES[known.get(name, "function")]
            )
    return table
