"""Instances to learn from: new ones, apart from everything that a benchmark tests with, and split by name."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TypeVar

from r2h_batch.config import EvalConfig
from r2h_batch.scene.objects import (
    BUILT_IN_NAMES,
    INSTANCE_NAMES,
    ObjectModel,
    checked_objects,
    load_objects,
)
from r2h_batch.training.drawing import Drawing
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.family_objects import Planned, family_objects, planned_objects

Instances = tuple[ObjectModel, ...]


@dataclass(frozen=True)
class Source:
    """Where instances come from: what a text names, drawn group by group; or objects of the user's, one group.

    Attributes:
        benchmark: its objects, and all that are shipped, are refused, under whatever name.
        groups: of the instances, those that are learned from together: their places in `drawing`.
        drawing: draws them.
        own: objects of the user's, in place of both.
        regions: how many more times each instance is there, each time with a region at random.
    """

    benchmark: Benchmark
    groups: tuple[tuple[int, ...], ...]
    drawing: Drawing | None
    own: Instances
    regions: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the instances, without those with other regions."""
        if self.drawing is None:
            return tuple(o.name for o in self.own)
        return tuple(self.drawing.planned[k].name for group in self.groups for k in group)

    def group(self, number: int) -> Instances:
        """The objects of a group, in their order, without those with other regions.

        Args:
            number: counts groups.

        Raises:
            ValueError: an object is one of the benchmark or a shipped one.
        """
        found = self.own if self.drawing is None else self.drawing.objects(self.groups[number])
        refuse_tested(self.benchmark, found)
        return found


def sources(
    benchmark: Benchmark,
    families: str | Sequence[ObjectModel],
    leave_out: Sequence[str],
    *,
    regions: int,
    renewed: bool,
    workers: int | None,
) -> tuple[Source, Source | None]:
    """The instances that are learned from, and those that `leave_out` names.

    Args:
        benchmark: whose robot takes them; its objects are refused.
        families: `cup,hammer x 8 seed 5`, as behind `--objects families:`; or objects.
        leave_out: categories (`cup`), names of instances (`cup_s1005_03`), or patterns of either (`*_03`).
        regions: how many more times each is there, each time with a region at random.
        renewed: whether a group has one instance of each category; else all are one group.
        workers: processes that draw; None: as `Drawing`.

    Raises:
        FileError: a text that names no families.
        ValueError: a pattern names nothing, nothing is left, or groups of objects that nobody draws are asked for.
    """
    if not isinstance(families, str):
        if renewed:
            raise ValueError(
                "renew draws instances of families one after the other; give families as a text, or leave renew out"
            )
        kept, left_out = split(training_objects(benchmark, families), leave_out)
        made = [Source(benchmark, ((),), None, own, regions) for own in (kept, left_out) if own]
        return made[0], made[1] if left_out else None
    planned = planned_objects(families, "families")
    if renewed:
        planned = tuple(sorted(planned, key=lambda p: p.index))
    kept_ones, others = split(planned, leave_out)
    evaluator = EvalConfig()
    drawing = Drawing((*kept_ones, *others), benchmark.robot, evaluator.candidates, workers)
    found: list[Source | None] = []
    place = {one: k for k, one in enumerate(drawing.planned)}
    for some in (kept_ones, others):
        by_group = [[place[p] for p in some]]
        if renewed:
            indices = dict.fromkeys(p.index for p in some)
            by_group = [[place[p] for p in some if p.index == i] for i in indices]
        groups = tuple(tuple(g) for g in by_group)
        found.append(Source(benchmark, groups, drawing, (), regions) if some else None)
    assert found[0] is not None
    return found[0], found[1]


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
        found = family_objects(families, "families")
    else:
        found = checked_objects(families)
    if not found:
        raise ValueError("families names no objects; give at least one")
    refuse_tested(benchmark, found)
    return found


def refuse_tested(benchmark: Benchmark, found: Instances) -> None:
    """Nothing where none of the objects is tested with.

    Args:
        benchmark: its objects, and all that are shipped, are tested with.
        found: objects to learn from.

    Raises:
        ValueError: one of them is tested with.
    """
    tested = {_shape(o): o.name for o in load_objects([*BUILT_IN_NAMES, *INSTANCE_NAMES])}
    tested |= {_shape(o): o.name for o in benchmark.objects}
    for model in found:
        if (name := tested.get(_shape(model.who.own))) is not None:
            raise ValueError(
                f"families has {model.name!r}, which is {name} of the objects that methods are tested with; learn from new"
                ' instances, such as families="* x 8 seed 5"'
            )


Named = TypeVar("Named", ObjectModel, Planned)


def split(
    objects: Sequence[Named], leave_out: Sequence[str]
) -> tuple[tuple[Named, ...], tuple[Named, ...]]:
    """The objects that no pattern names, and those that one does.

    Args:
        objects: of distinct names; or planned ones.
        leave_out: categories (`cup`), names of instances (`cup_s1005_03`), or patterns of either (`*_03`).

    Raises:
        ValueError: a pattern names nothing, or nothing is left.
    """

    def category(one: Named) -> str | None:
        return one.family.category if isinstance(one, Planned) else one.who.category

    def named(one: Named, pattern: str) -> bool:
        return fnmatchcase(one.name, pattern) or fnmatchcase(category(one) or "", pattern)

    for pattern in leave_out:
        if not any(named(o, pattern) for o in objects):
            there = ", ".join(dict.fromkeys(category(o) or o.name for o in objects))
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
