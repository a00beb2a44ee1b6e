"""Legs of picking before a stored motion where a trial begins on the table, and the leg in which a pick fails.

A run folder stores no posture of picking. They are computed again, as Pick was judged.
"""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.ik import solve_ik
from r2h_batch.judge.pick import Picked
from r2h_batch.observe.known import known_moments
from r2h_batch.sweep.rows import TrialNames
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import CollidingPair, PickReason
from r2h_batch.view.postures import Nearest, Postures, postures_at
from r2h_batch.view.stored_trial import StoredTrial

Array = NDArray[np.float64]

SHOWN = 5
"""Postures of a straight way of 10 cm that are drawn one after the other [choice]."""
ALONG = (PickReason.APPROACH_COLLIDES, PickReason.LIFT_COLLIDES)
"""A motion shows where these fail; a posture shows the others."""
HELD = (PickReason.CLOSING_COLLIDES, PickReason.LIFT_COLLIDES)
"""The gripper has closed when these fail."""


def with_legs(
    stored: StoredTrial, evaluator: Evaluator, trial: Trials, answer: Predictions
) -> StoredTrial:
    """A trial that begins on the table, with the legs of picking before its motion. Where Pick fails, the leg that fails.

    Args:
        stored: one trial whose benchmark asks for Pick.
        evaluator: judges the answer.
        trial: the trial.
        answer: its prediction.
    """
    scene = evaluator.scene
    T_world_obj = known_moments(scene).of(trial)
    found = evaluator.picks(answer.T_obj_ee, answer.T_world_ee, trial)
    T_world_grasp = found.T_world_ee[0].double().cpu().numpy()
    resting = replace(
        stored,
        row=stored.row | {"opening_m": scene.robot.open_gap_m, "grasp_shift_m": 0.0},
        T_obj_ee_attached=stored.T_obj_ee,
        T_world_ee=T_world_grasp,
        resting=T_world_obj[0].double().cpu().numpy(),
        executed_q=None,
        planned_q=None,
        asked=None,
    )
    way_in, way_up = (_shown(x[0].double().cpu().numpy()) for x in (found.way_in, found.way_up))
    if not bool(found.picked[0]):
        return _failed(resting, stored, found, (way_in, way_up), evaluator, trial, answer)
    path = found.path[0, : int(found.length[0])].double().cpu().numpy()
    passes = {"outcome": "success", "t_exec_s": None}  # of these legs: what fails comes later
    return replace(
        stored,
        before=(
            replace(
                resting, row=resting.row | passes, q=np.concatenate([path, way_in[1:]]), goes_on=True
            ),
            replace(
                stored, row=stored.row | passes, q=way_up[::-1], T_world_ee=T_world_grasp,
                executed_q=None, planned_q=None, asked=None, goes_on=True,
            ),
        ),
    )  # fmt: skip


def _shown(way: Array) -> Array:
    """Some postures of a straight way: the drawn arm rests at each."""
    return way[np.linspace(0, len(way) - 1, SHOWN).round().astype(int)]


def _failed(
    resting: StoredTrial, stored: StoredTrial, found: Picked, ways: tuple[Array, Array],
    evaluator: Evaluator, trial: Trials, answer: Predictions,
) -> StoredTrial:  # fmt: skip
    """The leg in which a pick fails: the way that collides, or the posture that does."""
    reason, scene = PickReason(int(found.reason[0])), evaluator.scene
    way_in, way_up = ways
    leg = resting
    if reason in HELD:
        leg = replace(resting, row=stored.row, T_obj_ee_attached=stored.T_obj_ee_attached)
    if reason is PickReason.PATH_COLLIDES:
        return replace(leg, q=found.path[0, : int(found.length[0])].double().cpu().numpy())
    if reason in ALONG and np.isfinite(way_in).all():
        if reason is PickReason.APPROACH_COLLIDES:
            return replace(leg, q=way_in)
        return replace(leg, q=way_up[::-1], resting=None)
    home = np.array(leg.workplace.home_q)
    if reason is PickReason.OUT_OF_REACH:
        there = replace(answer, T_world_ee=found.T_world_ee)
        return replace(leg, q=home[None], asked=postures_at(evaluator, trial, there))
    if reason is PickReason.START_IN_COLLISION:
        q = home
    elif reason in (PickReason.BEFORE_COLLIDES, PickReason.NO_PATH_IN_BUDGET):
        q = way_in[0]
    else:
        ik = solve_ik(found.T_world_ee, robot=scene.robot, home=evaluator.config.workplace.home_q)
        q = ik.q[0, int(ik.valid[0].to(torch.int8).argmax())].double().cpu().numpy()
    pair, body = CollidingPair(int(found.pair[0])), int(found.body[0])
    nearest = None
    if pair is not CollidingPair.NONE:
        part = TrialNames.of(scene).parts[body] if body >= 0 else ""
        nearest = Nearest(pair.name.lower(), part, "")
    asked = Postures(q, float(found.margin_m[0]), nearest, {})
    return replace(leg, q=home[None], asked=asked)
