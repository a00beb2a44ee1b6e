"""What is known of a scene, kept as long as the scene."""

from collections.abc import Callable
from functools import update_wrapper
from typing import Concatenate, Generic, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

Owner = TypeVar("Owner")
Found = TypeVar("Found")
Rest = ParamSpec("Rest")

MOST = 8
"""Answers of a function about one scene that are kept."""


class KeptWith(Generic[Owner, Rest, Found]):
    """A decorator: answers are kept as long as the function's first argument, and forgotten with it.

    `functools.lru_cache` would keep the scenes of before: a method that sees makes one of each batch of trials, up to 100 MB
    each. An answer must not hold the first argument, or neither would ever go.

    Args:
        function: of a scene, and of other arguments that can be hashed, by place.
    """

    def __init__(self, function: Callable[Concatenate[Owner, Rest], Found]) -> None:
        self._function = function
        self._of: WeakKeyDictionary[Owner, dict[object, Found]] = WeakKeyDictionary()
        update_wrapper(self, function)

    def __call__(self, owner: Owner, *rest: Rest.args, **named: Rest.kwargs) -> Found:
        """The answer, computed once."""
        known = self._of.get(owner)
        if known is None:
            known = self._of.setdefault(owner, {})
        key = (rest, tuple(named.items()))
        if key in known:
            return known[key]
        found = self._function(owner, *rest, **named)
        known[key] = found
        while len(known) > MOST:
            del known[next(iter(known))]
        return found

    def cache_clear(self) -> None:
        """Forget all answers."""
        self._of.clear()
