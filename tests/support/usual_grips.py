"""How persons hold objects with held-out grasps, row by row: what `capacity.Withstood` has, turned into the objects' frames."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from r2h_batch.scene.objects import ObjectModel
from r2h_batch.trials.holding.capacity import Withstood
from r2h_batch.trials.holding.held_out import GRAVITY, HeldOut


class Grips(NamedTuple):
    """Of N persons, float64, frame obj: where force and moment act (m), the axes (columns) that capacities count by, the sum of
    the normal forces (N), and what the grip withstands along the axes for each newton of it."""

    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    total_n: NDArray[np.float64]
    capacity: NDArray[np.float64]


def usual_grips(held_out: HeldOut, objects: Sequence[ObjectModel], grasp: NDArray[Any], down: NDArray[Any]) -> Grips:
    """The grips of these rows of grasps; `down` (N, 3) is gravity's direction, frame obj, of which the nearest of `GRAVITY`
    counts."""
    every = Withstood.of(objects, held_out.grasps.hand, held_out.loaded)
    R = every.axes[held_out.grasps.object_index.numpy()[grasp]]
    gravity = np.einsum("nij,ni,gj->ng", R, down, GRAVITY).argmax(1)
    center = np.einsum("nij,nj->ni", R, every.center[grasp].astype(np.float64))
    return Grips(center, R, every.total_n[grasp, gravity].astype(float), every.capacity[grasp, gravity].astype(float))
