"""Instances to learn from: new ones, apart from everything that a benchmark tests with, and split by name."""

import hashlib
from collections.abc import Sequence
from fnmatch import fnmatchcase

from r2h_batch.protocols.benchmark import Benchmark
from r2h_batch.protocols.family_objects import PREFIX, family_objects
from r2h_batch.scene.objects import (
    BUILT_IN_NAMES,
    INSTANCE_NAMES,
    ObjectModel,
    category_of,
    checked_objects,
    load_objects,
)

Instances = tuple[ObjectModel, ...]


def training_objects(benchmark: Benchmark, families: str | Sequence[ObjectModel]) -> Instances:
    """The instances that a text names, or objects of the user's, none of which is tested with.

    Args:
        benchmark: its objects, and all that are shipped, are refused, under whatever name.
        families: `cup,hammer x 8 seed 5`, as behind `--objects families:`; or objects.

    Raises:
        FileError: a text that names no families.
        ValueError: an object is one of the benchmark or a shipped one.
    """
    if isinstance(families, str):
        found = family_objects(PREFIX + families.removeprefix(PREFIX))
    else:
        found = checked_objects(families)
    if not found:
        raise ValueError("families names no objects; give at least one")
    tested = {_shape(o): o.name for o in load_objects([*BUILT_IN_NAMES, *INSTANCE_NAMES])}
    tested |= {_shape(o): o.name for o in benchmark.objects}
    for model in found:
        own = model if model.turn is None else model.turn.own
        if (name := tested.get(_shape(own))) is not None:
            raise ValueError(
                f"families has {model.name!r}, which is {name} of the objects that methods are tested with; learn from new"
                ' instances, such as families="* x 8 seed 5"'
            )
    return found


def split(objects: Instances, leave_out: Sequence[str]) -> tuple[Instances, Instances]:
    """The objects that no pattern names, and those that one does.

    Args:
        objects: of distinct names.
        leave_out: categories (`cup`), names of instances (`cup_s1005_03`), or patterns of either (`*_03`).

    Raises:
        ValueError: a pattern names nothing, or nothing is left.
    """

    def named(model: ObjectModel, pattern: str) -> bool:
        return fnmatchcase(model.name, pattern) or fnmatchcase(category_of(model) or "", pattern)

    for pattern in leave_out:
        if not any(named(o, pattern) for o in objects):
            there = ", ".join(dict.fromkeys(category_of(o) or o.name for o in objects))
            raise ValueError(
                f"leave_out has {pattern!r}, which names no instance; there are {there}, and instances such as {objects[0].name}"
            )
    left_out = tuple(o for o in objects if any(named(o, p) for p in leave_out))
    kept = tuple(o for o in objects if o not in left_out)
    if not kept:
        raise ValueError("leave_out names all instances; leave some to learn from")
    return kept, left_out


def _shape(model: ObjectModel) -> str:
    """Digest of a surface, whatever it is called."""
    return hashlib.sha256(model.vertices.tobytes() + model.faces.tobytes()).hexdigest()
