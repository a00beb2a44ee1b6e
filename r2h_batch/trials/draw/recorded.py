"""Hands of r2h-v1 that were recorded with a person: they keep their direction to it, and the recorded
arm; where that is unknown, an arm is looked for that can have them.

Only +, -, *, / and sqrt, as in receivers.py.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import se3
from r2h_batch.trials.draw.receivers import (
    PRONATED_DEG,
    SUPINATED_DEG,
    WRIST_ASIDE_DEG,
    WRIST_BENT_DEG,
    Array,
    Person,
    arm_axes,
    sine_cosine,
)

GIVEN_UP = 4000
"""Proposals after which a hand's recorded arm is let go, and after as many its direction: hands that
grasp from above show no palm to robot or sky."""


def recorded_in_world(facing: Array, R_person_hand: Array) -> Array:
    """(n, 3, k) rotations of hands, or vectors, in the world, of bodies that stand upright and face
    (n, 2)."""
    x, y = facing[:, 0, None], facing[:, 1, None]
    ahead, aside, up = R_person_hand[:, 0], R_person_hand[:, 1], R_person_hand[:, 2]
    return np.stack([x * ahead - y * aside, y * ahead + x * aside, up], 1)


def with_arms(people: Person, ways: Array, changed: NDArray[np.bool_]) -> Person:
    """The people, those of `changed` (n,) with elbow and wrist at `ways` (n, 3, 2) from their
    shoulder, m."""
    if not changed.any():
        return people
    moved = {
        name: np.where(changed[:, None], people.shoulder + ways[:, :, k], getattr(people, name))
        for k, name in enumerate(("elbow", "wrist"))
    }
    return replace(people, **moved)


def arm_can(
    people: Person, side: NDArray[np.int64], along: Array, palm: Array
) -> NDArray[np.bool_]:
    """Whether these arms can have hands that point along (n, 3) with this palm normal: wrist and
    forearm within their ranges.

    The wrist: no farther from the forearm's line than bent and aside together; the forearm's turn:
    of the palm about that line.
    """
    forearm, thumb, inwards = arm_axes(
        people.shoulder, people.elbow, people.wrist, np.where(side == 0, -1.0, 1.0)
    )
    (_, (bent, aside)) = sine_cosine(np.array([WRIST_BENT_DEG, WRIST_ASIDE_DEG]))
    straight = se3.dot(forearm, along) >= bent * aside
    c, s = se3.dot(palm, inwards), se3.dot(palm, thumb)
    (s_low, s_high), (c_low, c_high) = sine_cosine(np.array([-PRONATED_DEG, SUPINATED_DEG]))
    return np.asarray(straight & (c_low * s - s_low * c >= 0.0) & (c * s_high - s * c_high >= 0.0))
