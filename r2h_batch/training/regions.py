"""Instances with another receiver's region each, so that a network learns what a region is, and not where one usually lies."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import rng
from r2h_batch.scene.objects import ObjectModel, Turn
from r2h_batch.training.instances import Instances

MOST_REGIONS = 16
LEAST, MOST = 0.05, 0.95
"""Shares of the surface that a region may have: a cap, and all but a cap."""
BORDER = 0.25, 0.75
"""Shares of the surface on one side of a plane."""
TRIES = 64
"""Planes that are tried."""

Faces = NDArray[np.bool_]


def with_regions(objects: Sequence[ObjectModel], count: int) -> Instances:
    """The objects, and each again `count` times with a region at random.

    A region is a part, all but a part, or what lies on one side of a plane: a third each, of those that the object has.
    It depends on the object's name alone. An object that has no parts and that no plane divides is there once.

    Args:
        objects: with names of their own.
        count: more of each.
    """
    more = [m for o in objects for k in range(count) if (m := _with_region(o, k)) is not None]
    return (*objects, *more)


def _with_region(model: ObjectModel, number: int) -> ObjectModel | None:
    """The object in S1, with another region; its grasps stay those of the object as it was."""
    draw = np.random.Generator(np.random.Philox(key=rng.key_of(f"region {model.name} {number}")[0]))
    parts = [
        p for k in range(len(model.part_names)) if _takes_some(model, p := model.face_part == k)
    ]
    but_parts = [~p for p in parts]
    plane = next((p for p in _planes(model, draw) if _takes_some(model, p)), None)
    kinds = [kind for kind in (parts, but_parts, [] if plane is None else [plane]) if kind]
    if not kinds:
        return None
    kind = kinds[draw.integers(len(kinds))]
    face = kind[draw.integers(len(kind))]
    face.flags.writeable = False
    name = f"{model.name}_region{number}"
    words = f"hand over the {name.replace('_', ' ')} to human"
    return replace(
        model, name=name, split="S1", receiver_face=face, receiver_boxes=None, instruction=words,
        turn=Turn(model, np.eye(3)),
    )  # fmt: skip


def _takes_some(model: ObjectModel, face: Faces) -> bool:
    """Whether a region leaves something for the gripper, and is something to take."""
    return LEAST <= float(face[model.point_face].mean()) <= MOST


def _planes(model: ObjectModel, draw: np.random.Generator) -> Iterator[Faces]:
    """The faces on one side of planes at random, mostly across the longest axis."""
    middle = model.vertices[model.faces].astype(np.float64).mean(1)
    points = model.points.astype(np.float64)
    _, _, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    for _ in range(TRIES):
        lean = draw.standard_normal(3) * 0.25
        along = axes[min(int(draw.integers(4)), 2) if draw.random() < 0.5 else 0] + lean
        sign = 1.0 if draw.random() < 0.5 else -1.0
        border = np.quantile(points @ along, draw.uniform(*BORDER))
        yield sign * (middle @ along - border) > 0
