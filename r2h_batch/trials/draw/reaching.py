"""Hands of people who reach for the object: the first proposal in the reachable set (ball centre and palm) whose hand
is clear, and whose arm is clear of the table and of the robot at home. Who the people are says `receivers.py`
(drawn sizes) or `people.py` (a table of people)."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import se3
from r2h_batch.config import Workplace
from r2h_batch.trials.draw import receivers, recorded
from r2h_batch.trials.draw.own_torso import off_the_torso
from r2h_batch.trials.draw.people import draw_people, owners
from r2h_batch.trials.draw.reachable_set import (
    Room,
    arm_is_clear,
    faces_robot_or_up,
    hand_is_clear,
    in_set,
)
from r2h_batch.trials.draw.rule import Batch, Placed


def place_reaching(batch: Batch) -> Placed:
    """Hands on the arms of people who stand or sit behind the table's front edge."""
    given = batch.given
    people, edge_m = given.people, _table_edge_m(given.workplace)
    if people is None:
        side = batch.hands.side[batch.hand_index]
        placing = _placing(batch.hand_index, batch)
        return Placed(*receivers.draw_receivers(batch.key, batch.trial_id, side, placing, edge_m))
    return Placed(
        *draw_people(
            batch.key, batch.trial_id, batch.side, batch.hand_index, owners(people, given.hand_set),
            partial(_placing_people, batch=batch), edge_m,
        )
    )  # fmt: skip


def _table_edge_m(at: Workplace) -> float:
    """x of the table's front edge."""
    return round(at.table_center[0] + at.table_half[0], 6)


def _placing(hand_index: NDArray[np.int64], batch: Batch) -> receivers.PlaceHand:
    """Whether a proposal of a trial with these hands (n,) fits, as `receivers.draw_receivers` takes it."""
    hands, robot, at = batch.hands, batch.given.robot, batch.given.workplace
    offset_m = batch.given.thresholds.reach_offset_m

    def place_hand(
        people: receivers.Person, rows: NDArray[np.int64], number: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], receivers.Person]:
        hand, palm, placed = hand_index[rows], people.palm, np.ones(len(rows), bool)
        n, a = hands.palm_normal[hand], hands.along[hand]
        local = np.stack([a, n, np.cross(a, n)], 2)
        world = np.stack([people.hand, people.palm, np.cross(people.hand, people.palm)], 2)
        R = se3.from_frames(world, local)
        # of hands that were recorded with a person the arm is one that can have them
        if hands.in_body is not None:
            in_body = hands.in_body[hand]
            recorded_hand = recorded.recorded_in_world(people.facing, np.nan_to_num(in_body))
            has_arm = np.isfinite(in_body[:, 0, 3:]).any(1)
            with_arm = has_arm & (number < recorded.GIVEN_UP)
            until = recorded.GIVEN_UP * np.where(has_arm, 2, 1)
            known = np.isfinite(in_body[:, 0, 0]) & (number < until)
            R = np.where(known[:, None, None], recorded_hand[:, :, :3], R)
            palm = np.where(known[:, None], se3.rotate(R, n), palm)
            can = recorded.arm_can(people, hands.side[hand], se3.rotate(R, a), palm)
            placed = ~known | with_arm | can
            people = recorded.with_arms(people, recorded_hand[:, :, 3:], with_arm)
        center = (
            people.wrist
            + se3.rotate(R, hands.palm_point[hand] - hands.wrist[hand])
            + offset_m * palm
        )
        kept = np.flatnonzero(placed & in_set(center, Room.of(robot)))
        kept = kept[faces_robot_or_up(center[kept], palm[kept])]
        kept = kept[receivers.clear_of_torso(people.rows(kept))]
        kept = kept[arm_is_clear(people.rows(kept), robot, at)]
        T = np.zeros((len(kept), 4, 4), np.float32)
        T[:, :3, :3], T[:, 3, 3] = R[kept], 1.0
        T[:, :3, 3] = people.wrist[kept] - se3.rotate(R[kept], hands.wrist[hand[kept]])
        clear = hand_is_clear(T.astype(np.float64), hand[kept], hands, robot, at)
        fits = np.zeros(len(rows), bool)
        fits[kept[clear]] = True
        return fits, T[clear], people

    return place_hand


def _placing_people(hand_index: NDArray[np.int64], batch: Batch) -> receivers.PlaceHand:
    """`_placing` of people who do not overlap themselves: the receivers of r2h-v2, not those of r2h-v1, which is frozen."""
    hands, place_hand = batch.hands, _placing(hand_index, batch)
    return off_the_torso(place_hand, hand_index, hands.vertices, hands.center, hands.radius)
