"""Counter-based random numbers: Philox4x32-10 (Salmon et al. 2011) in NumPy, and uniform draws
built on it.

A draw is a function of (key, id, attempt, purpose) and nothing else. Only +, -, *, /, sqrt and
comparisons follow, no libm and no reductions: the same bits on every machine and in every batch.
"""

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_ATTEMPTS = 100_000
LOOK_AFTER, HOPELESS = 200, 30_000
"""Attempts without an accepted row after which proposals are examined, and how many; where none
fits, no more are tried."""


class NothingFits(RuntimeError):
    """The conditions of a draw leave no place, or hardly any."""


"""An acceptance rate this low is an empty set, and not bad luck."""

_MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
_WEYL = (0x9E3779B9, 0xBB67AE85)
_LOW, _HALF = np.uint64(0xFFFFFFFF), np.uint64(32)


def key_of(name: str) -> tuple[int, int]:
    """A key of two 32-bit words: the first eight bytes of the name's sha256.

    Args:
        name: of a protocol or purpose; any text.
    """
    word = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    return word & 0xFFFFFFFF, word >> 32


def philox4x32(counter: NDArray[np.uint64], key: tuple[int, int]) -> NDArray[np.uint64]:
    """Ten rounds of Philox on counters: 4 random 32-bit words (held in uint64) per counter, same shape.

    Args:
        counter: (4, ...) 32-bit words, held in uint64.
        key: two 32-bit words, such as `key_of(NAME)`.
    """
    c0, c1, c2, c3 = counter
    for i in range(10):
        k0, k1 = (np.uint64((k + i * w) & 0xFFFFFFFF) for k, w in zip(key, _WEYL, strict=True))
        p0, p1 = _MULTIPLIERS[0] * c0, _MULTIPLIERS[1] * c2
        c0, c1, c2, c3 = (p1 >> _HALF) ^ c1 ^ k0, p1 & _LOW, (p0 >> _HALF) ^ c3 ^ k1, p0 & _LOW
    return np.stack([c0, c1, c2, c3])


def uniforms(
    key: tuple[int, int],
    ids: NDArray[np.int64],
    count: int,
    *,
    purpose: int,
    attempt: int | NDArray[np.int64] = 0,
) -> Array:
    """Numbers in (0, 1), the midpoints of 2^32 cells.

    Args:
        key: of `key_of`.
        ids: (n,) first 64 bits of the counter.
        count: numbers of each id.
        purpose: separates the draws of one id.
        attempt: one number, or (n,).

    Returns:
        (count, n) float64.
    """
    n, blocks = len(ids), -(-count // 4)
    words = ids.astype(np.uint64)
    counter = np.empty((4, blocks, n), np.uint64)
    counter[0], counter[1] = words & _LOW, words >> _HALF
    counter[2] = np.asarray(attempt, np.uint64)
    counter[3] = (np.uint64(purpose << 16) + np.arange(blocks, dtype=np.uint64))[:, None]
    random = philox4x32(counter, key).transpose(1, 0, 2).reshape(4 * blocks, n)[:count]
    return (random.astype(np.float64) + 0.5) * 2.0**-32


def choice(u: Array, count: int | NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices 0 to count - 1, equally likely.

    Args:
        u: uniform numbers in (0, 1).
        count: one number, or one for each of u.
    """
    return (u * count).astype(np.int64)


def rotation(u: Array) -> tuple[NDArray[np.bool_], Array]:
    """Rotations uniform on SO(3), where accepted (62 %): Marsaglia (1972).

    Args:
        u: (4, n) uniform numbers.

    Returns:
        (n,) whether accepted, and (n, 3, 3).
    """
    a, b, c, d = 2.0 * u - 1.0
    s, t = a * a + b * b, c * c + d * d
    inside = (s < 1.0) & (t < 1.0)
    scale = np.sqrt(np.where(inside, 1.0 - s, 0.0) / t)
    w, x, y, z = a, b, c * scale, d * scale
    R = np.empty((len(a), 3, 3))
    R[:, 0, 0], R[:, 0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z)
    R[:, 0, 2] = 2 * (x * z + w * y)
    R[:, 1, 0], R[:, 1, 1] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z)
    R[:, 1, 2] = 2 * (y * z - w * x)
    R[:, 2, 0], R[:, 2, 1] = 2 * (x * z - w * y), 2 * (y * z + w * x)
    R[:, 2, 2] = 1 - 2 * (x * x + y * y)
    return inside, R


def accepted(
    n: int,
    propose: Callable[[NDArray[np.int64], Any], tuple[NDArray[np.bool_], Any]],
    *outputs: NDArray[Any],
) -> None:
    """Rejection sampling of n rows at once: fills `outputs` with each row's first accepted proposal.

    Args:
        n: number of rows.
        propose: `propose(rows, attempt)` returns which of these rows it accepts and, for the accepted ones, a tuple
            of values; `attempt` is one number or one for each row.
        outputs: (n, ...) arrays, one for each value.

    Raises:
        NothingFits: a row accepts none of its proposals.
    """
    todo = np.arange(n)
    for attempt in range(MAX_ATTEMPTS):
        if not len(todo):
            return
        fits, values = propose(todo, attempt)
        for output, value in zip(outputs, values, strict=True):
            output[todo[fits]] = value
        todo = todo[~fits]
        if len(todo) == n and attempt == LOOK_AFTER:
            # many attempts at once: of a share of 1e-3 that fits, one is among so many but for one
            # case in 10^13
            turns = max(1, HOPELESS // n)
            if not propose(np.tile(todo, turns), np.repeat(np.arange(turns), n))[0].any():
                break
    raise NothingFits(f"{len(todo)} of {n} rows found no acceptable draw in {attempt + 1} attempts")
