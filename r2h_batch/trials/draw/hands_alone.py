"""Hands that float, of r2h-v0: anywhere in the reachable set, with any roll about the palm's normal."""

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import rng, se3
from r2h_batch.trials.draw.reachable_set import (
    Room,
    ball_center,
    faces_robot_or_up,
    hand_is_clear,
)
from r2h_batch.trials.draw.rule import POSE, Batch, Placed


def place_hands_alone(batch: Batch) -> Placed:
    """Each hand at the first proposal of its trial that lies in the reachable set."""
    hands, robot, at = batch.hands, batch.given.robot, batch.given.workplace
    offset_m = batch.given.thresholds.reach_offset_m

    def propose(
        rows: NDArray[np.int64], attempt: int | NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], tuple[NDArray[np.float32]]]:
        u = rng.uniforms(batch.key, batch.trial_id[rows], 7, purpose=POSE, attempt=attempt)
        inside, center = ball_center(u[:3], Room.of(robot))
        turned, R = rng.rotation(u[3:])
        kept = np.flatnonzero(inside & turned)
        hand, center, R = batch.hand_index[rows[kept]], center[kept], R[kept]
        normal = se3.rotate(R, hands.palm_normal[hand])
        faces = faces_robot_or_up(center, normal)
        kept, hand, center, R = kept[faces], hand[faces], center[faces], R[faces]
        normal = normal[faces]
        T = np.zeros((len(kept), 4, 4), np.float32)
        T[:, :3, :3] = R
        T[:, :3, 3] = center - offset_m * normal - se3.rotate(R, hands.palm_point[hand])
        T[:, 3, 3] = 1.0
        clear = hand_is_clear(T.astype(np.float64), hand, hands, robot, at)
        fits = np.zeros(len(rows), bool)
        fits[kept[clear]] = True
        return fits, (T[clear],)

    T_world_hand = np.zeros((len(batch.trial_id), 4, 4), np.float32)
    rng.accepted(len(batch.trial_id), propose, T_world_hand)
    return Placed(T_world_hand)
