"""A family: a generator of one category's solids, its parts and region, and how it rests."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from manifold3d import Manifold

from r2h_batch.base import rng
from r2h_batch.scene.families.shapes import Parts

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


class Draw:
    """The numbers of one instance, in a fixed order: `draw("length", 240, 360)`."""

    def __init__(self, category: str, series: int, index: int) -> None:
        key = rng.key_of(f"r2h families {category} {series}")
        self._left = rng.uniforms(key, np.array([index]), NUMBERS, purpose=0)[:, 0].tolist()
        self.parameters: dict[str, float | str] = {}

    def __call__(self, name: str, low: float, high: float) -> float:
        """A number between low and high, to a micrometre, kept under its name."""
        value = round(low + (high - low) * self._left.pop(0), 3)
        self.parameters[name] = value
        return value

    def choice(self, name: str, words: Sequence[str]) -> str:
        """One of the words; a word that stands twice is twice as likely."""
        word = words[int(self._left.pop(0) * len(words))]
        self.parameters[name] = word
        return word


@dataclass(frozen=True)
class Shape:
    """One instance in its category's own frame, millimetres."""

    solid: Manifold
    density: Mapping[str, float]
    """part -> kg/m^3 of its own solid; a hollow part that is modelled as a full one has less"""
    filling: tuple[str, float] | None = None
    """the part that holds water, z up, and the share of its solid that is full"""


@dataclass(frozen=True)
class Family:
    """A category: which split it is handed over in, its parts, and what the receiver takes."""

    category: str
    split: str
    parts: tuple[str, ...]
    make: Callable[[Draw, Parts], Shape]
    rests: tuple[str, ...]
    """how such a thing lies: words of `draw.TURNS`; a word that stands twice is twice as likely"""
    receiver: tuple[str, ...] = ()
    take: str = ""

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
