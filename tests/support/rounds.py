"""Rounds of loops that assert: a loop over nothing asserts nothing."""

from collections.abc import Iterable
from typing import TypeVar

T = TypeVar("T")


def each(items: Iterable[T], at_least: int = 1) -> list[T]:
    """The items of a loop whose body asserts, once it is known that there are some.

    Args:
        items: what the loop goes over; finite.
        at_least: rounds without which the test says nothing.

    Raises:
        AssertionError: there are fewer.
    """
    found = list(items)
    assert len(found) >= at_least, f"the loop has {len(found)} rounds; its test needs {at_least} or more"
    return found
