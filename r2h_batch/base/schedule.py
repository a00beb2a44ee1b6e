"""The schedule of trials: which trial stands at which position, with which object and which hand.

Trial i of split S0 has the id 2 i, of S1 the id 2 i + 1. A trial list goes through its splits one
after the other. The objects of a split alternate, and each round of them starts with the other
hand, so that every object meets both. Plain numbers, no torch.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import rng
from r2h_batch.verdicts import SPLITS

SEED = "[0-9a-f]{32}"
"""Form of a benchmark's seed: 128 bits, which nobody guesses."""

_HAND = 0  # purpose of the random counters


def trial_ids(counts: Mapping[str, int], first: int, last: int) -> NDArray[np.int64]:
    """Ids of positions `first` to `last` - 1 of a trial list.

    Args:
        counts: split -> number of trials, in the order of the list.
        first: first position.
        last: position after the last one.
    """
    parts, start = [np.zeros(0, np.int64)], 0
    for split, n in counts.items():
        places = np.arange(max(first - start, 0), min(last - start, n), dtype=np.int64)
        parts.append(2 * places + SPLITS.index(split))
        start += n
    return np.concatenate(parts)


def assign_objects(
    ids: NDArray[np.int64], splits: Sequence[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The object of each trial and the side of its hand.

    Args:
        ids: (N,) trials.
        splits: the split of each object.

    Returns:
        (N,) object indices, and (N,) sides: 0 right, 1 left.

    Raises:
        ValueError: a trial's split has no object.
    """
    object_index, side = np.zeros_like(ids), np.zeros_like(ids)
    for k, split in enumerate(SPLITS):
        of_split = (ids & 1) == k
        members = np.array([i for i, s in enumerate(splits) if s == split], np.int64)
        if not of_split.any():
            continue
        if not len(members):
            how = "give at least one, or leave the split out"
            raise ValueError(f"no object belongs to split {split}; {how}")
        rows = slice(None) if of_split.all() else of_split  # most shards are of one split
        place = ids[rows] >> 1
        turn = place // len(members)  # in numpy division beats modulo, and divmod
        place = place - turn * len(members)
        object_index[rows] = members[place]
        side[rows] = (turn + place) & 1
    return object_index, side


def assign_hands(
    ids: NDArray[np.int64],
    side: NDArray[np.int64],
    sides: NDArray[np.int64],
    rule: str,
) -> NDArray[np.int64]:
    """The hand of each trial: a random one of its side, or of the other where there is none.

    Args:
        ids: (N,) trials.
        side: (N,) sides of their hands: 0 right, 1 left.
        sides: (H,) side of each hand of the set.
        rule: name of the rule that draws the trials; seeds the random numbers.

    Returns:
        (N,) indices into the hand set.
    """
    (u,) = rng.uniforms(rng.key_of(rule), ids, 1, purpose=_HAND)
    hand = np.zeros(len(ids), np.int64)
    for s in (0, 1):
        rows, members = np.flatnonzero(side == s), np.flatnonzero(sides == s)
        members = members if len(members) else np.flatnonzero(sides == 1 - s)
        hand[rows] = members[rng.choice(u[rows], len(members))] if len(rows) else 0
    return hand
