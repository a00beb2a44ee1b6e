"""A choice of grasps that are good and unlike each other, an S1 object's partly off the receiver's
region."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.bodies.objects import ObjectModel
from r2h_batch.bodies.robot import Robot
from r2h_batch.methods.grasps.antipodal import pad_height
from r2h_batch.methods.grasps.candidate_set import Candidates

REGION_SHARE = 0.4
"""Share of an S1 object's candidates that keep the fingers off the receiver's region, where so many
exist."""
REGION_CLEARANCE_M = 0.001
POOREST = 0.1  # share of the pool that is left out where it is large enough
TURN_RAD = 0.9


def diverse(model: ObjectModel, every: Candidates, count: int, robot: Robot) -> Candidates:
    """Greedy by score without the pool's poorest, none too like one already taken; that bar falls
    until `count` are found."""
    order = np.argsort(-every.score, kind="stable")
    every = every.rows(order)
    y, z = every.T_obj_ee[:, :3, 1].astype(np.float64), every.T_obj_ee[:, :3, 2].astype(np.float64)
    place = every.T_obj_ee[:, :3, 3] + pad_height(robot, every.width)[:, None] * z
    taken: list[int] = []
    off_region = every.region_m > REGION_CLEARANCE_M
    stages = [(np.ones(len(every), bool), min(count, len(every)))]
    if model.split != "S0":
        stages.insert(0, (off_region, min(int(REGION_SHARE * count), int(off_region.sum()))))
    for allowed, wanted in stages:
        better = (
            allowed & (every.score >= np.quantile(every.score[allowed], POOREST))
            if allowed.any()
            else allowed
        )
        if better.sum() > 2 * wanted:
            allowed = better
        radius = float(np.linalg.norm(np.ptp(model.vertices, axis=0))) / 4
        while len(taken) < wanted:
            free = allowed.copy()
            free[taken] = False
            for i in taken:
                free &= _likeness(place, y, z, i, radius) >= 1
            for i in range(len(every)):
                if len(taken) < wanted and free[i]:
                    taken.append(i)
                    free &= _likeness(place, y, z, i, radius) >= 1
            radius *= 0.75
    return every.rows(np.sort(taken))


def _likeness(
    place: NDArray[Any], y: NDArray[Any], z: NDArray[Any], i: int, radius: float
) -> NDArray[Any]:
    """Distance of all candidates to candidate i: below 1 they are too like. Both turn by 180
    degrees about z alike."""
    turn_z = np.arccos(np.clip(z @ z[i], -1, 1))
    turn_y = np.arccos(np.clip(np.abs(y @ y[i]), 0, 1))
    turn = np.maximum(turn_y, turn_z)
    scale = TURN_RAD * min(1.0, radius / 0.02)
    out = np.linalg.norm(place - place[i], axis=1) / radius + turn / scale
    out[i] = 0
    return np.asarray(out)
