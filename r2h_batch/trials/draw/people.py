"""Trials whose receivers are people of a table (`data/people.py`): body and hand of one person.

The hands of a set are put in the order of their size, and so are the people. Hand k of n of its side belongs to the
n-th part of the people that has its place in this order. A trial draws a hand, then one of its people, then a
posture. If no posture fits, the next counter draws hand and person again, and the trial counts it.

Only +, -, *, / and sqrt, as in receivers.py.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import rng
from r2h_batch.data.people import People, hand_lengths
from r2h_batch.scene.hand import HandSet
from r2h_batch.trials.draw.receivers import SEATED, Person, PlaceHand, first_fitting, reach
from r2h_batch.trials.draw.wheelchair import POPLITEAL_M, off_the_lap
from r2h_batch.types import PERSON

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

PROPOSALS = 4096
"""Postures that a person tries before another one is drawn [choice]."""
REDRAWN = 200
"""People that a trial tries before the table of people is given up."""
_PERSON, _HAND = 3, 4  # purposes of the random counters; receivers.py and `schedule` have 0 to 2


class Owners:
    """The people to whom the hands of a set belong."""

    def __init__(self, people: People, hand_set: HandSet) -> None:
        self.people, self.side = people, hand_set.side.numpy().astype(np.int64)
        self.hand_length = hand_lengths(hand_set.model, hand_set.shape.numpy())
        self.place, self.count = (
            np.zeros(len(self.side), np.int64),
            np.ones(len(self.side), np.int64),
        )
        for side in (0, 1):
            members = np.flatnonzero(self.side == side)
            order = members[np.argsort(self.hand_length[members], kind="stable")]
            self.place[order], self.count[members] = np.arange(len(members)), max(1, len(members))

    def person(self, hand: Rows, u: Array) -> Rows:
        """(n,) people of these hands, by uniform numbers u (n,)."""
        n, count, place = len(self.people), self.count[hand], self.place[hand]
        low = place * n // count
        high = np.maximum((place + 1) * n // count, low + 1)
        return np.asarray(self.people.by_hand[low + rng.choice(u, high - low)])

    def members(self, side: int) -> Rows:
        """The hands of a side; those of the other where there is none."""
        own = np.flatnonzero(self.side == side)
        return own if len(own) else np.flatnonzero(self.side == 1 - side)


@lru_cache(maxsize=2)
def owners(people: People, hand_set: HandSet) -> Owners:
    """The same for every shard of a sweep."""
    return Owners(people, hand_set)


def draw_people(
    key: tuple[int, int],
    ids: Rows,
    side: Rows,
    hand_index: Rows,
    found: Owners,
    placing: Callable[[Rows], PlaceHand],
    table_edge_m: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], Rows, NDArray[np.float32]]:
    """People of a table in postures that fit.

    Args:
        key: of the random counters.
        ids: (n,) trials.
        side: (n,) of the hands that the schedule wants: 0 right, 1 left.
        hand_index: (n,) hands with which the trials begin.
        found: the people, and which hands are whose.
        placing: for hands (n,): whether a proposal fits, as `draw_receivers` takes it.
        table_edge_m: the table's front edge.

    Returns:
        T_world_hand (n, 4, 4), receivers (n, 5, 4), hand indices (n,), and who they are, (n, 6) by the names of
        `types.PERSON`.

    Raises:
        rng.NothingFits: none of the people that a trial drew has a posture that fits.
    """
    T_world_hand = np.zeros((len(ids), 4, 4), np.float32)
    receiver = np.zeros((len(ids), 5, 4), np.float32)
    person = np.zeros((len(ids), len(PERSON)), np.float32)
    hands, todo = hand_index.copy(), np.arange(len(ids))
    for redrawn in range(REDRAWN):
        if not len(todo):
            return T_world_hand, receiver, hands, person
        mine = ids[todo]
        if redrawn:
            (u,) = rng.uniforms(key, mine, 1, purpose=_HAND, attempt=redrawn)
            for s in (0, 1):
                rows, members = np.flatnonzero(side[todo] == s), found.members(s)
                hands[todo[rows]] = members[rng.choice(u[rows], len(members))]
        u = rng.uniforms(key, mine, 2, purpose=_PERSON, attempt=redrawn)
        who = found.person(hands[todo], u[0])
        seated = (u[1] < SEATED) | found.people.wheelchair
        T, bodies, left, _ = _fitted(
            key, mine, who, seated, hands[todo], found, placing, table_edge_m, redrawn
        )
        fits = np.setdiff1d(np.arange(len(todo)), left)
        done = todo[fits]
        T_world_hand[done], receiver[done] = T[fits], bodies[fits]
        columns = {
            "age_years": found.people.age[who],
            "female": found.people.sex[who],
            "stature_m": found.people.lengths["stature"][who],
            "hand_length_m": found.hand_length[hands[todo]],
            "seated": seated,
            "redrawn": np.full(len(todo), redrawn),
        }
        person[done] = np.stack([columns[name] for name in PERSON], 1)[fits]
        todo = todo[left]
    raise rng.NothingFits(
        f"trial {ids[todo[0]]}: none of {REDRAWN} people of {found.people.name} has a posture that fits"
    )


def _fitted(
    key: tuple[int, int],
    ids: Rows,
    who: Rows,
    seated: NDArray[np.bool_],
    hand: Rows,
    found: Owners,
    placing: Callable[[Rows], PlaceHand],
    table_edge_m: float,
    redrawn: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32], Rows, int]:
    """`first_fitting` of these people, who stand or sit."""
    side = found.side[hand]

    def reaching(rows: Rows, v: Array) -> Person:
        size = {name: value[who[rows]] for name, value in found.people.lengths.items()}
        if found.people.wheelchair:
            size["popliteal_height"] = np.full(len(rows), POPLITEAL_M)
        return reach(seated[rows], size, v, side[rows], table_edge_m)

    place_hand = placing(hand)
    if found.people.wheelchair:
        stature, chest = (found.people.lengths[k][who] for k in ("stature", "chest_depth"))
        place_hand = off_the_lap(place_hand, stature, chest, found.hand_length[hand])
    before = redrawn * PROPOSALS
    return first_fitting(key, ids, reaching, place_hand, before=before, most=PROPOSALS)
