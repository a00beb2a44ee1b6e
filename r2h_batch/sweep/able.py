"""What a built-in method cannot answer, known before work starts: objects without grasps, hands
that hold nothing.

Such trials get no pose from that method and count as its failures (`invalid_input`); every other
trial and method goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from r2h_batch.methods.candidates import without_candidates
from r2h_batch.predictors import Observations
from r2h_batch.receiver.receiving import without_receiving
from r2h_batch.scene.scene import Scene
from r2h_batch.sweep.options import UsageError
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import SIDES

__all__ = ["Able", "able_of", "check_grasps"]


@dataclass(frozen=True, eq=False)
class Able:
    """Which (object, side of the receiver's hand) a method can answer."""

    answers: Tensor
    """(O, 2) bool"""
    side: Tensor
    """(H,) of each hand of the set"""
    lines: tuple[str, ...]
    """what it cannot, for people"""

    def only(self, trials: Trials, answer: Callable[[Trials], Predictions]) -> Predictions:
        """The method's answers to the trials that it can answer; NaN poses for the others."""
        rows = self.answers[
            trials.object_index.cpu().long(), self.side[trials.hand_index.cpu().long()]
        ]
        if bool(rows.all()):
            return answer(trials)
        n, home = len(trials), trials.trial_id.device
        T_obj_ee, T_world_ee = (
            torch.full((n, 4, 4), torch.nan, dtype=torch.float32, device=home) for _ in range(2)
        )
        seconds, method = torch.full((n,), torch.nan, dtype=torch.float32, device=home), ""
        rows = rows.to(home)
        if bool(rows.any()):
            given = answer(trials[rows])
            T_obj_ee[rows], T_world_ee[rows] = given.T_obj_ee.to(home), given.T_world_ee.to(home)
            if given.t_method_s is not None:
                seconds[rows] = given.t_method_s.to(home)
            method = given.method
        return Predictions(trials.trial_id, T_obj_ee, T_world_ee, seconds, method)


def check_grasps(scene: Scene, allow_empty: bool) -> None:
    """Raises `UsageError` where an object has no grasp candidate and that is not allowed."""
    empty = [scene.objects[i].name for i in without_candidates(scene)]
    if empty and not allow_empty:
        raise UsageError(
            f"{', '.join(empty)}: no grasp found; the gripper needs a part narrower than 85 mm that it can reach: leave "
            f"{'it' if len(empty) == 1 else 'them'} out, give --grasps, or --allow-empty-candidates to count as failures"
        )
    if len(empty) == len(scene.objects):
        raise UsageError(
            "no object has a grasp candidate: there is nothing for a built-in method to choose from"
        )


def able_of(name: str, sees: Sequence[str], scene: Scene, seen: Observations | None) -> Able:
    """What a built-in method can answer: every object with candidates; those that look at the
    receiver's hold on it (and are not shown a network's) also need one of the hand's side."""
    answers = torch.ones((len(scene.objects), 2), dtype=torch.bool, device="cpu")
    lines = []
    for i in without_candidates(scene):
        answers[i] = False
        lines.append(
            f"{name}: no grasp candidate of {scene.objects[i].name}: its trials count as failures"
        )
    if "receiving" in sees and (seen is None or seen.receiving is None):
        sides = set(scene.hands.set.side.tolist())
        for i, side in without_receiving(scene.objects, scene.hands.model):
            if bool(answers[i, side]) and side in sides:
                lines.append(
                    f"{name}: no {SIDES[side]} hand was found that can hold {scene.objects[i].name}: its trials with "
                    f"{SIDES[side]} hands count as failures"
                )
            answers[i, side] = False
    return Able(answers, scene.hands.set.side.cpu().long(), tuple(lines))
