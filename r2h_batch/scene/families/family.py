"""A family: a generator of one category's solids, its parts and region, and how it rests.

`@family` above a generator makes it one: in a file of this folder, in a package that names it as
`family.CATEGORY` in its entry points (`r2h_batch.plugins`), or in a module of the user's. Light: the
generators' files import manifold3d.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.machinery import PathFinder
from typing import TYPE_CHECKING, Any

import numpy as np

from r2h_batch.base import rng
from r2h_batch.base.errors import UserError, nearest
from r2h_batch.plugins import Registry
from r2h_batch.scene.objects import OBJECT_NAMES
from r2h_batch.scene.vocabulary import S0_ROLES, SHARP, THINGS, VESSELS, Thing, split_roles
from r2h_batch.verdicts import SPLITS

if TYPE_CHECKING:
    from manifold3d import Manifold

    from r2h_batch.scene.families.shapes import Parts

FORM = re.compile("[a-z]+(_[a-z]+)*")
NUMBERS = 64
"""Uniform numbers that one instance may take."""

STEEL, ALUMINIUM, GLASS, CERAMIC, PLASTIC, RUBBER, WOOD, WATER = (
    7800,
    2700,
    2500,
    2300,
    1100,
    1250,
    700,
    1000,
)
"""Densities, kg/m^3."""


TURNS = {
    "upright": (), "over": (("x", 180.0),), "left": (("x", 90.0),), "right": (("x", -90.0),), "face": (("y", 90.0),),
    "back": (("y", -90.0),), "side": (("z", None), ("x", 90.0)), "roll": (("x", None),),
}  # fmt: skip
"""How a thing lies, as turns about fixed axes; None: any angle."""


class FamilyError(UserError):
    """A family or its generator that makes no object: names the family, what was found and what is allowed, in one line."""


class Draw:
    """The numbers of one instance, in a fixed order: `draw("length", 240, 360)`."""

    def __init__(self, category: str, series: int, index: int) -> None:
        self._of = f"family {category}, instance {index} of series {series}"
        key = rng.key_of(f"r2h families {category} {series}")
        self._left = rng.uniforms(key, np.array([index]), NUMBERS, purpose=0)[:, 0].tolist()
        self.parameters: dict[str, float | str] = {}

    def __call__(self, name: str, low: float, high: float) -> float:
        """A number between low and high, to a micrometre, kept under its name."""
        value = round(low + (high - low) * self._next(), 3)
        self.parameters[name] = value
        return value

    def choice(self, name: str, words: Sequence[str]) -> str:
        """One of the words; a word that stands twice is twice as likely."""
        word = words[int(self._next() * len(words))]
        self.parameters[name] = word
        return word

    def _next(self) -> float:
        if not self._left:
            raise FamilyError(f"{self._of}: takes more than {NUMBERS} numbers; draw fewer")
        return self._left.pop(0)


@dataclass(frozen=True)
class Shape:
    """One instance in its category's own frame, millimetres."""

    solid: Manifold
    density: Mapping[str, float]
    """part -> kg/m^3 of its own solid; a hollow part that is modelled as a full one has less"""
    filling: tuple[str, float] | None = None
    """the part that holds water, z up, and the share of its solid that is full"""


@dataclass(frozen=True, eq=False)
class Family:
    """A category: which split it is handed over in, its parts, and what the receiver takes. Equal to itself alone."""

    category: str
    split: str
    parts: tuple[str, ...]
    make: Callable[[Draw, Parts], Shape]
    rests: tuple[str, ...]
    """how such a thing lies: words of `TURNS`; a word that stands twice is twice as likely"""
    receiver: tuple[str, ...] = ()
    """parts that the receiver takes, in S1"""
    take: str = ""
    """those in the sentence that asks for an instance"""
    words: Thing | None = None
    """how people ask for it"""
    roles: Mapping[str, str] | None = None
    """part -> function, grasp or wrap: what people take it by where there is no receiver's region"""
    sharp: tuple[str, ...] = ()
    """parts that a hand should not come to first"""
    vessel: tuple[str, str] | None = None
    """of an open vessel: its lowest part, and the one around its opening"""

    def __reduce__(self) -> tuple[Any, ...]:
        """By its generator's name, which stands for it (`family`): another process imports the same one."""
        module = self.make.__module__
        if module != "__main__" and "." not in module and PathFinder.find_spec(module) is None:
            raise FamilyError(
                f"family {self.category}: a process that is no fork cannot import {module}, from a FILE.py under a name that is"
                " taken; give the file another name"
            )
        return _by_name, (module, self.make.__name__)

    @cached_property
    def instruction(self) -> str:
        """The sentence that asks for an instance."""
        return " ".join(
            (
                "hand over the",
                self.category.replace("_", " "),
                *filter(None, [self.take]),
                "to human",
            )
        )


def _by_name(module: str, name: str) -> Any:
    return getattr(import_module(module), name)


def _no_family(name: str, thing: Any) -> str:
    if not isinstance(thing, Family):
        return f"is {thing!r:.100}; a family is a generator below @family(...)"
    return "" if thing.category == name else f"calls itself {thing.category!r}; give both one name"


FAMILIES: Registry[Family] = Registry(
    "family", modules=("r2h_batch.scene.families",), names=OBJECT_NAMES, wrong=_no_family
)
"""Category -> family, those of the objects of r2h-v1 first, in their order."""

Make = Callable[[Draw, "Parts"], Shape]


def family(
    category: str,
    split: str,
    *,
    parts: tuple[str, ...],
    rests: tuple[str, ...],
    receiver: tuple[str, ...] = (),
    take: str = "",
    words: Thing | None = None,
    roles: Mapping[str, str] | None = None,
    vessel: tuple[str, str] | None = None,
    listed: bool = True,
) -> Callable[[Make], Family]:
    """A decorator: the generator below it is registered as a family, and its name stands for that.

    Args:
        category: small letters and _: `--objects "families:CATEGORY x 5"`.
        split: S0, or S1 with a receiver's region.
        parts: names of all parts that the generator may make.
        rests: as `Family.rests`.
        receiver: parts that the receiver takes; of S1 alone.
        take: those parts in words.
        words: how people ask for it; None: those of the built-in object of this name, else the names of category and parts.
        roles: part -> function, grasp, wrap, or sharp (`Family.roles`, `Family.sharp`); None: those of the built-in object of
            this name.
        vessel: as `Family.vessel`; None: that of the built-in object of this name.
        listed: False: lists and `families:*` leave it out. `families:package.module:NAME` draws it.

    Raises:
        FamilyError: one line: the name, the split and its region, a way to lie or a part that is not there.
    """
    if not FORM.fullmatch(category):
        raise FamilyError(f"family {category!r}: a category is small letters, and _ between them")
    for field, value in (("parts", parts), ("rests", rests), ("receiver", receiver)):
        if not isinstance(value, tuple) or not all(isinstance(word, str) for word in value):
            raise FamilyError(
                f'family {category}: {field} is {value!r}; it must be a tuple of words, as {field}=("{value}",) of one word'
                if isinstance(value, str)
                else f"family {category}: {field} is {value!r:.100}; it must be a tuple of words"
            )
    if split not in SPLITS or (split == "S1") != bool(receiver):
        raise FamilyError(
            f"family {category}: split is {split!r} with receiver {receiver}; S0 has no receiver's parts, S1 has some"
        )
    if unknown := [p for p in (*receiver, *(roles or {}), *(vessel or ())) if p not in parts]:
        raise FamilyError(
            f"family {category}: no part {unknown[0]!r}; parts are {', '.join(parts)}"
        )
    if unknown := [w for w in rests if w not in TURNS] or ([] if rests else [""]):
        hint, known = nearest(str(unknown[0]), list(TURNS)), ", ".join(TURNS)
        raise FamilyError(
            f"family {category}: rests has {unknown[0]!r}{hint}; the words are {known}"
        )
    if (words := words or THINGS.get(category)) is None:
        labels = {part.replace("_", " "): (part,) for part in receiver or parts}
        words = Thing((category.replace("_", " "),), labels, {"use": next(iter(labels))})

    def registered(make: Make) -> Family:
        own, sharp = split_roles(roles)
        if roles is None:
            own, sharp = S0_ROLES.get(category), SHARP.get(category, ())
        opens = VESSELS.get(category) if vessel is None else vessel
        made = Family(category, split, parts, make, rests, receiver, take, words, own, sharp, opens)
        if listed:
            FAMILIES.add(category, made)
        return made

    return registered
