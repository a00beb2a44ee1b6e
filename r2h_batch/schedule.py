"""Whose turn it is: which trial stands where in a plan, with which object and which hand. Numbers
alone, no torch.

Trial i of S0 has the id 2 i, of S1 the id 2 i + 1. A plan goes through its splits one after the
other. Objects of a split take turns, and each round of them starts with the other hand, so that an
object meets both.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from r2h_batch import rng
from r2h_batch.verdicts import SPLITS

__all__ = ["PROTOCOL", "PROTOCOLS", "assign_hands", "assign_objects", "trial_ids"]

PROTOCOL = "r2h-v0"
"""The protocol where none is named."""
PROTOCOLS = ("r2h-v0", "r2h-v1")
"""v0: hands alone, their roll free. v1: hands on the arms of people (docs/receivers.md)."""
_HAND = 0  # purpose of the random counters


def trial_ids(plan: Mapping[str, int], first: int, last: int) -> NDArray[np.int64]:
    """Ids of positions first..last-1 of a plan: split -> trials, in its order."""
    parts, start = [np.zeros(0, np.int64)], 0
    for split, n in plan.items():
        turns = np.arange(max(first - start, 0), min(last - start, n), dtype=np.int64)
        parts.append(2 * turns + SPLITS.index(split))
        start += n
    return np.concatenate(parts)


def assign_objects(
    ids: NDArray[np.int64], splits: Sequence[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index of the object and side of the hand (0 right, 1 left) of trials; `splits`: of each
    object."""
    object_index, side = np.zeros_like(ids), np.zeros_like(ids)
    for k, split in enumerate(SPLITS):
        mine = (ids & 1) == k
        members = np.array([i for i, s in enumerate(splits) if s == split], np.int64)
        if mine.any() and not len(members):
            raise ValueError(
                f"no object belongs to split {split}; give at least one, or leave the split out"
            )
        if mine.any():
            rows = slice(None) if mine.all() else mine  # most shards are of one split
            half = ids[rows] >> 1
            turn = half // len(
                members
            )  # and not divmod: numpy divides by one number faster than it takes remainders
            place = half - turn * len(members)
            object_index[rows] = members[place]
            side[rows] = (turn + place) & 1
    return object_index, side


def assign_hands(
    ids: NDArray[np.int64],
    side: NDArray[np.int64],
    sides: NDArray[np.int64],
    protocol: str = PROTOCOL,
) -> NDArray[np.int64]:
    """(N,) hand of each trial: one of its side (N,), all equally likely; of a set with one side
    only (OakInk's) any.

    `sides` (H,): of each hand of the set, 0 right, 1 left.
    """
    (u,) = rng.uniforms(rng.key_of(protocol), ids, 1, purpose=_HAND)
    hand = np.zeros(len(ids), np.int64)
    for s in (0, 1):
        rows, members = np.flatnonzero(side == s), np.flatnonzero(sides == s)
        members = members if len(members) else np.flatnonzero(sides == 1 - s)
        hand[rows] = members[rng.choice(u[rows], len(members))] if len(rows) else 0
    return hand
