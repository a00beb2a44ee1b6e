"""Received as a part of the verdict: whether the person can take what was presented (`judge.reception`), of rows that passed
all before.
"""

from dataclasses import replace

import torch
from jaxtyping import Int64
from torch import Tensor

from r2h_batch.judge.reception import STEPS, Reception, reception
from r2h_batch.judge.scores import judged_later
from r2h_batch.types import GivenScores
from r2h_batch.verdicts import ReceiveReason


def given(scores: GivenScores) -> GivenScores:
    """The same verdicts by Received too, where all else has passed.

    A row does not depend on the others.

    Args:
        scores: B rows with their inputs.
    """
    inputs = scores.inputs
    assert inputs is not None
    rows = torch.nonzero(scores.success)[:, 0]
    if not len(rows):
        return scores
    found = reception(scores[rows], margins=True)
    receives = scores.receives.clone()
    receives[rows, 0] = _reasons(found).to(receives.dtype)
    receives[rows, 1] = found.count[:, -1].to(receives.dtype)
    receives[rows, 2] = found.room.to(receives.dtype)
    judged = judged_later(
        scores, "received", rows, found.received, found.margin_m, found.margin_kind.long()
    )
    return replace(judged, receives=receives).with_inputs(inputs)


def _reasons(found: Reception) -> Int64[Tensor, " n"]:
    """`ReceiveReason` of each row: the step that leaves no grasp, or the way to those that are left."""
    none = found.count == 0
    step = torch.where(none.any(1), 1 + none.to(torch.int8).argmax(1), int(ReceiveReason.WHOLE_WAY))
    step = torch.where(found.known == 0, int(ReceiveReason.NO_GRASP), step)
    return torch.where(found.received, int(ReceiveReason.OK), step)


if [r.name.lower() for r in ReceiveReason][1 : 1 + len(STEPS)] != list(STEPS):
    raise ValueError(
        "verdicts.ReceiveReason names the steps of judge.reception.STEPS, in their order"
    )
