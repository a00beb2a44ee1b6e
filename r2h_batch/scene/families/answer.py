"""A generator's answer: asked for, and looked at before anything is made of it. Messages name family and instance."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import trimesh
from manifold3d import Manifold

from r2h_batch.base.io.read import printable
from r2h_batch.base.user_code import raised
from r2h_batch.scene.families.family import Draw, Family, FamilyError, Shape
from r2h_batch.scene.families.shapes import Parts
from r2h_batch.strangers import stranger

SMALLEST_MM, LARGEST_MM = 10.0, 2000.0
"""Largest side of an instance; as of a mesh file's."""
MOST_DENSITY = 25_000.0
"""kg/m^3; no metal is denser."""


def shape_of(family: Family, name: str, draw: Draw, parts: Parts) -> Shape:
    """The shape that a family's generator makes of the numbers.

    Args:
        family: whose generator.
        name: of the instance, in messages.
        draw: its numbers.
        parts: which surfaces belong to which part; the generator fills it.

    Raises:
        FamilyError: one line: the generator raised something, or a field of its answer is wrong.
    """
    where = f"family {family.category}, instance {name}"
    try:
        with stranger(where, family.make.__module__):
            shape: object = family.make(draw, parts)
    except (KeyboardInterrupt, FamilyError):
        raise
    except BaseException as error:  # SystemExit too: it would end the command without a word
        raise FamilyError(f"{where}: its generator: {raised(error)}") from error
    if not isinstance(shape, Shape):
        raise FamilyError(
            f"{where}: its generator answers {_shown(shape)}; it must be Shape(solid, density)"
        )
    if (
        wrong := _wrong_solid(shape.solid)
        or _wrong_parts(family, shape, parts)
        or _wrong_density(shape, parts)
    ):
        raise FamilyError(f"{where}: {wrong}")
    return shape


def check_surface(family: Family, name: str, mesh: trimesh.Trimesh) -> None:
    """Raise `FamilyError` unless the surface of an instance is closed and one body.

    Args:
        family: whose instance.
        name: of the instance.
        mesh: its surface.
    """
    wrong = ""
    if not mesh.is_watertight or not mesh.is_winding_consistent:
        wrong = "its mesh is not watertight: parts that touch along an edge or at a corner must overlap or lie apart"
    elif mesh.body_count != 1:
        wrong = f"its mesh is {mesh.body_count} bodies that do not touch; an instance is one rigid body, so let its parts overlap"
    if wrong:
        raise FamilyError(f"family {family.category}, instance {name}: {wrong}")


def _wrong_solid(solid: object) -> str:
    if not isinstance(solid, Manifold):
        return f"Shape.solid is {_shown(solid)}; it must be a manifold3d.Manifold"
    if solid.is_empty():
        status = str(solid.status()).rpartition(".")[2]
        return (
            "nothing is left of its solid; do the holes take all of it away?"
            if status == "NoError"
            else f"its solid is no closed surface (manifold3d: {status}); each edge needs two faces that look outwards"
        )
    low, high = np.split(np.array(solid.bounding_box()), 2)
    if not SMALLEST_MM <= (largest := float((high - low).max())) <= LARGEST_MM:
        return (
            f"the largest side of its solid is {largest:.3g} mm; sizes are millimetres, and"
            f" {SMALLEST_MM:g} to {LARGEST_MM:g} are allowed (0.1 m is 100)"
        )
    if solid.volume() <= 0:
        return f"its solid has a volume of {solid.volume():.3g} mm^3; it must be more than 0: is it turned inside out?"
    return ""


def _wrong_parts(family: Family, shape: Shape, parts: Parts) -> str:
    names = [*parts.names.values(), *(p for source, _, _, new in parts.cuts for p in (source, new))]
    if unknown := [n for n in names if n not in family.parts]:
        return f"its generator names a part {printable(unknown[0])!r}; parts are {', '.join(family.parts)}"
    if set(shape.solid.to_mesh64().run_original_id) - set(parts.names):
        return (
            "some of its surface belongs to no part; pass each solid through part(NAME, solid), and what is taken away"
            " through part.hole(NAME, solid)"
        )
    if shape.filling is None:
        return ""
    if not isinstance(shape.filling, tuple) or len(shape.filling) != 2:
        return f"Shape.filling is {_shown(shape.filling)}; it must be (part, share)"
    part, share = shape.filling
    if part not in (solids := [n for n, _ in parts.solids]):
        return f"Shape.filling names a part {printable(part)!r}; parts with a solid are {', '.join(dict.fromkeys(solids))}"
    return (
        ""
        if _within(share, 1.0)
        else f"Shape.filling has a share of {printable(share)}; more than 0 and at most 1 is allowed"
    )


def _wrong_density(shape: Shape, parts: Parts) -> str:
    needed = list(dict.fromkeys(name for name, _ in parts.solids))
    if not isinstance(shape.density, Mapping):
        return f"Shape.density is {_shown(shape.density)}; it must be a dict: part -> kg/m^3"
    for name in needed:
        if name not in shape.density:
            return f"Shape.density has no part {name!r}; parts with a solid are {', '.join(needed)}: give each its kg/m^3"
        if not _within(value := shape.density[name], MOST_DENSITY):
            return f"Shape.density of {name} is {printable(value)}; more than 0 and at most {MOST_DENSITY:g} kg/m^3 is allowed"
    return ""


def _within(value: object, most: float) -> bool:
    """Whether a value is a number above 0 and at most `most`."""
    number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    return number and math.isfinite(value) and 0 < value <= most  # type: ignore[arg-type,operator]


def _shown(value: object) -> str:
    return f"{type(value).__name__} {printable(repr(value))[:100]}"
