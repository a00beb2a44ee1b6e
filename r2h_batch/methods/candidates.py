"""The 100 grasp candidates that a method may choose from: stored for the built-in objects, sampled for a user's."""

from collections.abc import Sequence
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.grasp_candidates import Candidates, sample_grasps
from r2h_batch.objects import OBJECT_NAMES, ObjectModel, load_objects

__all__ = ["candidates_of"]


@lru_cache(maxsize=8)
def candidates_of(objects: tuple[ObjectModel, ...]) -> tuple[Candidates, ...]:
    """Candidates of each object, in the objects' order; those that are not stored are sampled once (seconds each).

    `region_m` is not stored: NaN for the built-in objects.
    """
    return tuple(_candidates(o) for o in objects)


def stacked(candidates: Sequence[Candidates]) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """T_obj_ee of all candidates (K, 4, 4), and of each object the first row and the number of rows."""
    count = np.array([len(c) for c in candidates], np.int64)
    return np.concatenate([c.T_obj_ee for c in candidates]), np.cumsum(count) - count, count


@lru_cache(maxsize=64)
def _candidates(model: ObjectModel) -> Candidates:
    stored = _stored()
    if f"{model.name}/T_obj_ee" in stored and _is_built_in(model):
        values = {k: stored[f"{model.name}/{k}"] for k in ("T_obj_ee", "width", "score", "part")}
        return Candidates(**values, region_m=np.full(len(values["width"]), np.nan, np.float32))
    return sample_grasps(model)


def _is_built_in(model: ObjectModel) -> bool:
    """Whether this is the built-in object of its name, and not a user's file that is called the same."""
    if model.name not in OBJECT_NAMES:
        return False
    (own,) = load_objects([model.name])
    return model is own or (np.array_equal(model.vertices, own.vertices) and np.array_equal(model.faces, own.faces))


@lru_cache(maxsize=1)
def _stored() -> dict[str, NDArray[Any]]:
    file = resources.files("r2h_batch.assets.objects") / "grasps.npz"
    if not file.is_file():
        return {}
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
        return {k: data[k] for k in data.files}
