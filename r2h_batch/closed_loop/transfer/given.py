"""The giving as a part of the verdict: whether the person can take what was presented (`judge.reception`), and whether the
simulated person has it in the end. The functions of `results reception` and `results transfer`, of rows that passed all before.
"""

from dataclasses import replace
from functools import lru_cache
from threading import Lock

import numpy as np
import torch
from jaxtyping import Float64, Int64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.closed_loop.transfer.cases import Case, Simulator
from r2h_batch.closed_loop.transfer.handed import handed_of
from r2h_batch.closed_loop.transfer.model import Setting
from r2h_batch.closed_loop.transfer.outcome import HELD_DEG, HELD_M, Outcome
from r2h_batch.closed_loop.transfer.simulate import Transfers
from r2h_batch.judge.reception import ROOM_M, STEPS, Reception, reception
from r2h_batch.judge.scores import judged_later
from r2h_batch.scene.scene import Scene
from r2h_batch.types import GivenScores, MarginKind
from r2h_batch.verdicts import TRANSFER_ENDS, UNITS, ReceiveReason

CASE = Case("load-share", "take", 0)
"""The transfer that Taken is about: the usual policy and person of `results transfer`."""
SEED = 0
"""Seed of the sensor's noise."""
_HAS_IT = (Outcome.TAKEN, Outcome.BADLY_HELD)
_one_at_a_time = Lock()


def given(scores: GivenScores) -> GivenScores:
    """The same verdicts by Received and Taken too, where the benchmark asks for them and all else has passed.

    A row does not depend on the others.

    Args:
        scores: B rows with their inputs.
    """
    inputs = scores.inputs
    assert inputs is not None
    rows = torch.nonzero(scores.success)[:, 0]
    if not len(rows):
        return scores
    found = reception(scores[rows])
    got = found.received
    kind = torch.full_like(rows, int(MarginKind.CAP))
    margin = torch.where(got, ROOM_M, -torch.inf)
    receives = scores.receives.clone()
    receives[rows, 0] = _reasons(found).to(receives.dtype)
    receives[rows, 1] = found.count[:, -1].to(receives.dtype)
    judged = judged_later(scores, "received", rows, got, margin, kind)
    judged = replace(judged, receives=receives)
    if "taken" in scores.criteria:
        own = rows[got]
        trial_id = scores.trial_id[rows].cpu().numpy()
        scene = inputs.evaluator.scene
        handed = handed_of(found, trial_id, inputs.trials[rows], scene)
        with _one_at_a_time:
            (made,) = _simulator(scene)(handed, [CASE]) if len(own) else (None,)
        if made is not None:
            judged = _taken(judged, own, made.transfers)
    return judged.with_inputs(inputs)


def _reasons(found: Reception) -> Int64[Tensor, " n"]:
    """`ReceiveReason` of each row: the step that leaves no grasp, or the way to those that are left."""
    none = found.count == 0
    step = torch.where(none.any(1), 1 + none.to(torch.int8).argmax(1), int(ReceiveReason.WHOLE_WAY))
    step = torch.where(found.known == 0, int(ReceiveReason.NO_GRASP), step)
    return torch.where(found.received, int(ReceiveReason.OK), step)


def _taken(scores: GivenScores, rows: Int64[Tensor, " n"], made: Transfers) -> GivenScores:
    """The verdicts with Taken of the rows whose transfers were simulated."""
    device = rows.device
    end = np.array(made.outcome)
    has_it = np.isin(end, [str(o) for o in _HAS_IT])
    margin = np.where(has_it, _spare_m(made), -np.inf).astype(np.float32)
    kind = np.where(has_it, int(MarginKind.DISTANCE), int(MarginKind.CAP))
    passed, margin_m, kinds = (
        torch.from_numpy(x).to(device) for x in (end == str(Outcome.TAKEN), margin, kind)
    )
    scores = judged_later(scores, "taken", rows, passed, margin_m, kinds)
    ends, numbers = scores.ends.clone(), scores.transfer.clone()
    code = np.array([TRANSFER_ENDS.index(str(o)) for o in made.outcome], np.int32)
    about = np.stack([code, made.undecided.astype(np.int32)], 1)
    ends[rows] = torch.from_numpy(about).to(device)
    said = np.stack([made.slip_m, made.turn_deg, made.pull_n, made.transfer_s], 1)
    numbers[rows] = torch.from_numpy(said.astype(np.float32)).to(device)
    return replace(scores, ends=ends, transfer=numbers)


def _spare_m(made: Transfers) -> Float64[NDArray[np.float64], " n"]:
    """How much slip and turn in the hand lack to their limits, the less of both."""
    turn = UNITS["deg"].worth_m * (HELD_DEG - np.asarray(made.turn_deg))
    return np.minimum(HELD_M - np.asarray(made.slip_m), turn)


@lru_cache(maxsize=2)
def _simulator(scene: Scene) -> Simulator:
    """The simulator of a scene's transfers, in this process."""
    return Simulator(scene.robot, tuple(scene.objects), Setting(), SEED)


if [r.name.lower() for r in ReceiveReason][1 : 1 + len(STEPS)] != list(STEPS):
    raise ValueError(
        "verdicts.ReceiveReason names the steps of judge.reception.STEPS, in their order"
    )
if tuple(str(o) for o in Outcome) != TRANSFER_ENDS:
    raise ValueError("verdicts.TRANSFER_ENDS has the words of closed_loop.transfer.outcome.Outcome")
