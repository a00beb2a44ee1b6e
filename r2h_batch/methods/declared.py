"""`method`: what a function of yours says of itself."""

from collections.abc import Callable
from typing import Any, TypeVar

from r2h_batch.base.registry import READS
from r2h_batch.base.validate import one_of

Function = TypeVar("Function", bound=Callable[..., Any])


def method(*, reads: str) -> Callable[[Function], Function]:
    """Declare what a method reads, for the column *Reads* of every table.

    Without it a sweep goes by what the function is given: `(seen)` reads cameras, one that takes `evaluator` the judge, any
    other one the scene, also one that takes `noise` or `seen`: the scene has the true region.

    Args:
        reads: scene, estimates, cloud, cameras or judge (`base.registry.READS`).

    Raises:
        ValueError: another word.
    """
    word = one_of(*READS)("reads", reads)

    def declare(function: Function) -> Function:
        function.reads = word  # type: ignore[attr-defined]
        return function

    return declare
