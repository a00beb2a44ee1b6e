"""Instances of families kept on disk: an instance is drawn once, 0.7 s of a core, and read from then on."""

from __future__ import annotations

import hashlib
from functools import cache

from r2h_batch.base.io.cache import code_digest, is_cached
from r2h_batch.scene.families.draw import draw_instance, model_of, with_family
from r2h_batch.scene.families.family import Family
from r2h_batch.scene.mesh_import import cache as built
from r2h_batch.scene.objects import ObjectModel, kept_object

CODE = ("r2h_batch.scene.families", "r2h_batch.base.rng", *built.CODE)
VERSIONS = built.VERSIONS
"""Modules and distributions that make instances. Another of them draws every one again."""


def kept_instance(
    family: Family, series: int, index: int, *, standing: bool = False
) -> ObjectModel:
    """The object of an instance (`draw_instance`), from disk where it was drawn before.

    A family that another package or a user's file registers is drawn each time: nobody knows which code it depends on.
    """

    def drawn() -> ObjectModel:
        return model_of(draw_instance(family, series, index, standing=standing))

    if not is_kept(family):
        return drawn()
    return with_family(kept_object(_key(family, series, index, standing), drawn), family)


def is_kept(family: Family) -> bool:
    """Whether instances of a family are kept at all: of those that come with the package."""
    return family.make.__module__.startswith(f"{__package__}.")


def was_drawn(family: Family, series: int, index: int, *, standing: bool = False) -> bool:
    """Whether an instance is on disk already."""
    return is_kept(family) and is_cached("objects", _key(family, series, index, standing))


def _key(family: Family, series: int, index: int, standing: bool) -> str:
    named = f"instance {family.category} {series} {index} {standing} {_code()}"
    return hashlib.sha256(named.encode()).hexdigest()


@cache
def _code() -> str:
    return code_digest(CODE, VERSIONS)
