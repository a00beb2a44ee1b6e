"""People in wheelchairs: how high they sit, and their lap, which forearm and hand keep off.

Seat, lap and width are those of the ADA Standards for Accessible Design (1991), A4.2.4 and Fig. A3, typical of a large adult
man. The knees fit under r2h-v1's table, whose underside is 5 mm higher than the lap.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from r2h_batch.trials.draw.receivers import (
    POINTS,
    SHOES_M,
    TABLE_HEIGHT_M,
    Person,
    PlaceHand,
    limbs,
)

Array = NDArray[np.float64]

SEAT_M, LAP_M = 0.485, 0.685
"""Above the floor: 19 and 27 inches."""
HALF_WIDTH_M = 0.2275
"""Half of the width over both footrests, 18 inches."""
KNEES = 0.356
"""Buttock-knee length over stature: between the medians of men (.351) and women (.361) in ANSUR II."""
POPLITEAL_M = SEAT_M - SHOES_M
"""Popliteal height of a person in shoes who sits so high on a chair."""


def off_the_lap(
    place_hand: PlaceHand, stature: Array, chest_depth: Array, hand: Array
) -> PlaceHand:
    """Proposals that `place_hand` takes and whose forearm and hand keep off the lap.

    Args:
        place_hand: as `receivers.draw_receivers` takes it.
        stature: (n,) of the trials' people, m.
        chest_depth: (n,) m.
        hand: (n,) lengths of their hands, m.
    """
    ahead = KNEES * stature - 0.5 * chest_depth

    def placed(
        people: Person, rows: NDArray[np.int64], number: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], Person]:
        fits, T, moved = place_hand(people, rows, number)
        kept = np.flatnonzero(fits)
        clear = clear_of_lap(moved.rows(kept), ahead[rows[kept]], hand[rows[kept]])
        still = fits.copy()
        still[kept[~clear]] = False
        return still, T[clear], moved

    return placed


def clear_of_lap(people: Person, ahead: Array, hand: Array) -> NDArray[np.bool_]:
    """Whether no point of forearm and hand, as thick as the forearm, is in or below the lap.

    Args:
        people: n people.
        ahead: (n,) from the torso's middle to the knees, m.
        hand: (n,) length of the hand from the wrist, m.
    """
    (_, _), (points, thick) = limbs(people)
    share = np.arange(1, POINTS, dtype=np.float64)[None, :, None] / (POINTS - 1)
    fingers = people.wrist[:, None] + share * (hand[:, None] * people.hand)[:, None]
    off = np.concatenate([points, fingers], 1) - people.torso[:, None]
    x = off[..., 0] * people.facing[:, None, 0] + off[..., 1] * people.facing[:, None, 1]
    y = off[..., 1] * people.facing[:, None, 0] - off[..., 0] * people.facing[:, None, 1]
    above = off[..., 2] + people.torso[:, None, 2] - (LAP_M - TABLE_HEIGHT_M)
    r = thick[:, None]
    inside = (x > 0.0) & (x < ahead[:, None] + r) & (np.abs(y) < HALF_WIDTH_M + r) & (above < r)
    return np.asarray(~inside.any(1))
