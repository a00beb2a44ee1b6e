"""Training data of the contact network: where the receiving grasps touch each object's cloud."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.launch import init_warp
from r2h_batch.scene.hand import HandModel
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.trials.holding.hand_contact import ObjectSurface
from r2h_batch.trials.holding.receiving import CONTACT_M, load_receiving

__all__ = ["contact_map", "touched_points"]

FULL = 0.95
"""Quantile of a map's touched points that counts as fully touched."""


@lru_cache(maxsize=512)
def touched_points(model: ObjectModel, hand: HandModel | None = None) -> NDArray[np.bool_]:
    """(G, P): whether the skin of each of the object's receiving grasps is within 5 mm of each
    cloud point. The hand is the built-in one for None."""
    init_warp()
    grasps = load_receiving([model], hand)
    faces = grasps.hand.faces_by_side.numpy()
    touched = np.zeros((len(grasps), len(model.points)), bool)
    for i, (skin, side) in enumerate(zip(grasps.vertices.numpy(), grasps.side.tolist(), strict=True)):
        near = ((model.points > skin.min(0) - CONTACT_M) & (model.points < skin.max(0) + CONTACT_M)).all(1)
        if near.any():
            distance, _, _ = ObjectSurface(skin, faces[side]).distance(model.points[near], 2 * CONTACT_M)
            touched[i, near] = distance <= CONTACT_M
    return touched


def contact_map(model: ObjectModel, hand: HandModel | None = None) -> NDArray[np.float32]:
    """(P,) in [0, 1]: how often each cloud point is touched, both hands' grasps together, relative
    to the most touched.

    Relative, as the thermal maps of ContactDB are scaled for each object: with many ways to hold an
    object, no point is touched in 40 % of them, yet people do have a place where they hold it.

    Args:
        model: the object.
        hand: whose grasps; None: the built-in hand's.
    """
    touched = touched_points(model, hand)
    if not touched.any():
        return np.zeros(len(model.points), np.float32)
    often = touched.mean(0)
    full = np.quantile(often[often > 0], FULL)
    return np.minimum(often / full, 1.0).astype(np.float32)
