"""People who do not overlap themselves: arm and hand of a proposal against the person's own torso.

The torso is a box and arms are capsules, as the judge has them. The forearm's capsule keeps off the box, and the hand's
skin ROOM_M more. An upper arm overlaps the box where it leaves the shoulder, in every posture: it may come no nearer to
the box than the joint of its shoulder does.

Distances are exact and take only +, -, *, / and sqrt, as in receivers.py.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import se3
from r2h_batch.trials.draw.receivers import Person, PlaceHand

Array = NDArray[np.float64]

ROOM_M = 0.005
"""Least distance of the hand's vertices from the own torso, as from the table [choice]."""
_LESS = 1.0 - 1e-9  # a joint may be as near to the box as itself
_AT_ONCE = 256  # hands whose every vertex is looked at, at once


def off_the_torso(
    place_hand: PlaceHand, hand: NDArray[np.int64], vertices: Array, center: Array, radius: Array
) -> PlaceHand:
    """Proposals that `place_hand` takes and whose arm and hand keep off the own torso.

    Args:
        place_hand: as `receivers.draw_receivers` takes it.
        hand: (n,) hands of the trials.
        vertices: (3, H, V) of the hands, in their own frames, m.
        center: (H, 3) of spheres around them, m.
        radius: (H,) of these, m.
    """

    def placed(
        people: Person, rows: NDArray[np.int64], number: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], Person]:
        fits, T, moved = place_hand(people, rows, number)
        kept = np.flatnonzero(fits)
        own, mine = moved.rows(kept), hand[rows[kept]]
        clear = arm_is_clear(own)
        left = np.flatnonzero(clear)
        clear[left] = hand_is_clear(
            own.rows(left), T[left], vertices, center[mine[left]], radius[mine[left]], mine[left]
        )
        still = fits.copy()
        still[kept[~clear]] = False
        return still, T[clear], moved

    return placed


def arm_is_clear(people: Person) -> NDArray[np.bool_]:
    """Whether the capsules of upper arm and forearm keep off the own torso's box.

    Args:
        people: n people.

    Returns:
        (n,) for the forearm: it does not overlap the box. For the upper arm: no part of its axis is nearer to the box,
        or deeper in it, than the shoulder's joint, unless it is its radius away.
    """
    half = people.torso_half
    shoulder, elbow, wrist = (
        in_torso(people, p) for p in (people.shoulder, people.elbow, people.wrist)
    )
    upper, fore = people.radius[:, 0], people.radius[:, 1]
    clear = segment_to_box(elbow, wrist, half) >= fore * fore
    over = np.maximum(np.abs(shoulder) - half, 0.0)
    away = np.sqrt(se3.dot(over, over))
    most = _LESS * np.minimum(away, upper)
    depth = np.minimum((half - np.abs(shoulder)).min(1), half.min(1) * _LESS)
    inside = depth > 0.0
    beside = segment_to_box(shoulder, elbow, half) >= most * most
    leaves = ~crosses_box(shoulder, elbow, half - np.maximum(depth, 0.0)[:, None])
    return np.asarray(clear & leaves & np.where(inside, True, beside))


def hand_is_clear(
    people: Person,
    T_world_hand: NDArray[np.float32],
    vertices: Array,
    center: Array,
    radius: Array,
    hand: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Whether no vertex of the hand is within ROOM_M of the own torso's box.

    Args:
        people: n people.
        T_world_hand: (n, 4, 4) poses of their hands.
        vertices: (3, H, V) of all hands, in their own frames, m.
        center: (n, 3) of a sphere around each person's hand, in the hand's frame, m.
        radius: (n,) of these, m.
        hand: (n,) which hands they have.
    """
    T, half = T_world_hand.astype(np.float64), people.torso_half + ROOM_M
    R, p = T[:, :3, :3], T[:, :3, 3]
    over = np.abs(in_torso(people, se3.rotate(R, center) + p)) - half
    outside = np.maximum(over, 0.0)
    near = np.flatnonzero(se3.dot(outside, outside) < radius * radius)
    clear = np.ones(len(hand), bool)
    for part in np.split(near, range(_AT_ONCE, len(near), _AT_ONCE)):
        own = people.rows(part)
        # the hand's axes and origin in the torso's frame
        axes = [in_torso(own, R[part, :, j] + own.torso) for j in range(3)]
        origin = in_torso(own, p[part])
        x, y, z = vertices[:, hand[part]]
        inside = np.ones(x.shape, bool)
        for k in range(3):
            at = (
                axes[0][:, k, None] * x + axes[1][:, k, None] * y + axes[2][:, k, None] * z
            ) + origin[:, k, None]
            inside &= np.abs(at) < half[part, k, None]
        clear[part] = ~inside.any(1)
    return clear


def in_torso(people: Person, point: Array) -> Array:
    """(n, 3) points of the world in the frames of the boxes: ahead, to the left, up, from the middle, m."""
    d, (fx, fy) = point - people.torso, people.facing.T
    return np.stack([d[:, 0] * fx + d[:, 1] * fy, d[:, 1] * fx - d[:, 0] * fy, d[:, 2]], 1)


def segment_to_box(a: Array, b: Array, half: Array) -> Array:
    """Squared distances (n,) of segments a b (n, 3) from boxes about the origin with these half sizes (n, 3), m^2.

    Along a segment the squared distance is convex and quadratic between the points at which it passes a side's plane:
    the least is the least of these pieces.
    """
    d = b - a
    slope = np.where(d == 0.0, 1.0, d)
    planes = [np.where(d == 0.0, 0.0, (s * half - a) / slope) for s in (-1.0, 1.0)]
    ends = np.concatenate([*planes, np.zeros((len(a), 1)), np.ones((len(a), 1))], 1)
    t = np.sort(np.clip(ends, 0.0, 1.0), axis=1)
    least = np.full(len(a), np.inf)
    for i in range(t.shape[1] - 1):
        low, high = t[:, i], t[:, i + 1]
        middle = a + (0.5 * (low + high))[:, None] * d
        over = np.abs(middle) > half
        gap = np.where(over, a - np.where(middle > 0.0, half, -half), 0.0)
        way = np.where(over, d, 0.0)
        square = se3.dot(way, way)
        lowest = -se3.dot(way, gap) / np.where(square > 0.0, square, 1.0)
        at = a + np.clip(lowest, low, high)[:, None] * d
        out = np.maximum(np.abs(at) - half, 0.0)
        least = np.minimum(least, se3.dot(out, out))
    return least


def crosses_box(a: Array, b: Array, half: Array) -> NDArray[np.bool_]:
    """Whether segments a b (n, 3) pass through the inside of boxes about the origin with these half sizes (n, 3)."""
    d = b - a
    low, high = np.zeros(len(a)), np.ones(len(a))
    beside = np.zeros(len(a), bool)
    for k in range(3):
        slope = np.where(d[:, k] == 0.0, 1.0, d[:, k])
        s, e = (-half[:, k] - a[:, k]) / slope, (half[:, k] - a[:, k]) / slope
        moves = d[:, k] != 0.0
        beside |= ~moves & (np.abs(a[:, k]) >= half[:, k])
        low = np.where(moves, np.maximum(low, np.minimum(s, e)), low)
        high = np.where(moves, np.minimum(high, np.maximum(s, e)), high)
    return np.asarray(~beside & (high - low > 1e-9))
