"""Whether tensors are like those of a call before, asked of all at once: one by one that takes
longer than their addresses.

torch has such a question for its compiler's guards; the name is not public, and without it
everything is looked at each time.
"""

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor


def _guards() -> Any:
    try:
        from torch._C._dynamo.guards import TensorGuards
    except ImportError:  # another torch
        return None
    return TensorGuards


GUARDS = _guards()


def alike(tensors: Sequence[Tensor]) -> Callable[[Sequence[object]], bool]:
    """What tells whether as many others have the same class, data type, device, shape and strides,
    wait for a gradient or not.

    It may say no of tensors that do (in torch's inference mode, say), never yes of others. It keeps
    none of them alive.
    """
    if GUARDS is None or not tensors:
        return _unknown
    places: dict[int, list[int]] = {}
    for i, x in enumerate(tensors):
        places.setdefault(id(x), []).append(i)
    once = [same[0] for same in places.values()]
    check = GUARDS(
        *(tensors[i] for i in once), dynamic_dims_sizes=None, dynamic_dims_strides=None
    ).check
    if len(once) == len(tensors):
        return lambda others: check(*others)
    # a tensor that is given twice is no news to a kernel, but the guards refuse it
    twins = [(same[0], i) for same in places.values() for i in same[1:]]
    return lambda others: (
        all(others[i] is others[j] for i, j in twins) and check(*(others[i] for i in once))
    )


def _unknown(others: Sequence[object]) -> bool:
    return False
