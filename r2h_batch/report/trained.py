"""The objects that methods say they were trained on."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run

KEY = "trained on"
"""Key of a method's source in methods/METHOD.json."""


def trained_on(source: Mapping[str, str]) -> str:
    """The objects that a method says it learned from; empty where it says nothing.

    Args:
        source: of its `Entry`.
    """
    return source.get(KEY, "")


def sentences(run: "Run") -> tuple[str, ...]:
    """A line about each method that says what it learned from.

    Args:
        run: what `load_run` or `join` gives.
    """
    told = ((e.name, trained_on(e.source)) for e in run.entries)
    return tuple(
        f"{name}: says that it was trained on {words}. None of them is tested here."
        for name, words in told
        if words
    )
