"""Instances with another receiver's region each, so that a network learns what a region is, and not where one usually lies."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import rng
from r2h_batch.learning.instances import Instances
from r2h_batch.scene.objects import ObjectModel, Turn

MOST_REGIONS = 16
LEAST, MOST = 0.15, 0.85
"""Shares of the surface that a region may have."""
TRIES = 64


def with_regions(objects: Sequence[ObjectModel], count: int) -> Instances:
    """The objects, and each again `count` times with a region at random.

    A region is a part, all but a part, or what lies on one side of a plane. It depends on the object's name alone.

    Args:
        objects: with names of their own.
        count: more of each.
    """
    more = [_with_region(o, k) for o in objects for k in range(count)]
    return (*objects, *more)


def _with_region(model: ObjectModel, number: int) -> ObjectModel:
    """The object in S1, with another region; its grasps stay those of the object as it was."""
    draw = np.random.Generator(np.random.Philox(key=rng.key_of(f"region {model.name} {number}")[0]))
    share = 0.0
    for _ in range(TRIES):
        face = _drawn(model, draw)
        share = float(face[model.point_face].mean())
        if LEAST <= share <= MOST:
            break
    face.flags.writeable = False
    name = f"{model.name}_region{number}"
    words = f"hand over the {name.replace('_', ' ')} to human"
    return replace(
        model, name=name, split="S1", receiver_face=face, receiver_boxes=None, instruction=words,
        turn=Turn(model, np.eye(3)),
    )  # fmt: skip


def _drawn(model: ObjectModel, draw: np.random.Generator) -> NDArray[np.bool_]:
    """The faces of a region: half of the time by parts, else by a plane."""
    if len(model.part_names) > 1 and draw.random() < 0.5:
        part = model.face_part == draw.integers(len(model.part_names))
        found: NDArray[np.bool_] = part if draw.random() < 0.5 else ~part
        return found
    middle = model.vertices[model.faces].astype(np.float64).mean(1)
    points = model.points.astype(np.float64)
    _, _, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    lean = draw.standard_normal(3) * 0.25
    along = axes[min(int(draw.integers(4)), 2) if draw.random() < 0.5 else 0] + lean
    sign = 1.0 if draw.random() < 0.5 else -1.0
    border = np.quantile(points @ along, draw.uniform(0.25, 0.75))
    one_side: NDArray[np.bool_] = sign * (middle @ along - border) > 0
    return one_side
