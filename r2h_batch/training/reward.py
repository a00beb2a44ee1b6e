"""Rewards from scores, for loops that learn or sample: elementwise on the scores' device, no
synchronisation, ties settled.

Where a function takes `k`, rows are K candidates for each of N trials, as `Evaluator.score` returns
them for (N, K) poses. All functions take `scores.by_trial(K)`, too: shapes then begin with (N, K) in
place of (B,).
"""

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from r2h_batch.base.soft import in_metres
from r2h_batch.base.validate import describe_value, instance_of, integer, number
from r2h_batch.base.validate_tensors import check_tensor, check_tensor_arguments
from r2h_batch.config import CLEARANCE_CAP_M
from r2h_batch.types import Outcome, Scores

NOT_JUDGED = -2
NO_FAILURE = -1

_scores = instance_of(Scores, "what Evaluator.score returns")
_limit = number(0, above=True, what=" metres")


def _value(name: str, value: object) -> object:
    words = "a torch tensor (N k,) or (N, k) of floats"
    value = check_tensor(name, value, words)
    if value.ndim not in (1, 2) or not value.is_floating_point():
        raise ValueError(f"{name} is {describe_value(value)}; it must be {words}")
    return value


@check_tensor_arguments(scores=_scores)
def success(scores: Scores) -> Float32[Tensor, "*b"]:
    """1 where the handover succeeds as far as it was judged, else 0.

    Args:
        scores: B rows.
    """
    return scores.success.float()


@check_tensor_arguments(scores=_scores)
def labels(scores: Scores) -> Float32[Tensor, "*b c"]:
    """The answer of each criterion for a network to learn: 1 passed, 0 failed, NaN where it was not evaluated.

    `Scores.passed` is False there (Affordance in S0, rows that were not judged): learned as it is, it would say that every
    trial of S0 fails.

    Args:
        scores: B rows.
    """
    return torch.where(scores.evaluated, scores.passed.float(), torch.nan)


@check_tensor_arguments(scores=_scores, limit_m=_limit)
def margin_vector(scores: Scores, *, limit_m: float = CLEARANCE_CAP_M) -> Float32[Tensor, "*b c"]:
    """Margins in m, clipped to +-`limit_m`, never NaN: columns as CRITERIA. A degree counts as 2 mm.

    A criterion that was not evaluated cannot be what fails: it counts as `limit_m` (Affordance in
    S0), except in rows that were not judged at all, where all count as `-limit_m`.

    Args:
        scores: B rows.
        limit_m: largest absolute value, m, above 0.
    """
    number = in_metres(scores.margin).nan_to_num(nan=0.0)
    margin = torch.where(scores.evaluated, number, limit_m).clamp(-limit_m, limit_m)
    return torch.where(_judged(scores)[..., None], margin, -limit_m)


@check_tensor_arguments(scores=_scores)
def first_failure(scores: Scores) -> Int64[Tensor, "*b"]:
    """Column of the first criterion that fails (index into `Scores.criteria`), -1 for a success, -2 for rows
    that were not judged.

    Args:
        scores: B rows.
    """
    outcome = scores.outcome.long()
    found = outcome - 1
    for column, entry in enumerate(scores.entries):
        code = int(Outcome[entry.name.upper()])
        if code != column + 1:  # the benchmark does not ask for one before it
            found = torch.where(outcome == code, column, found)
    return torch.where(_judged(scores), found, NOT_JUDGED)


@check_tensor_arguments(scores=_scores, limit_m=_limit)
def quality(scores: Scores, *, limit_m: float = CLEARANCE_CAP_M) -> Float32[Tensor, "*b"]:
    """One number to rank by: the smallest clipped margin (m), and `2 limit_m` more for a success.

    Any success ranks above any failure; among equals the one farther from its nearest threshold is
    better.

    Args:
        scores: B rows.
        limit_m: margins are clipped to +- this, m, above 0.
    """
    margin = margin_vector(scores, limit_m=limit_m).amin(-1)
    return margin + 2.0 * limit_m * scores.success.to(margin.dtype)


@check_tensor_arguments(value=_value, k=integer(1))
def rank_of_k(value: Float32[Tensor, "*b"], k: int) -> Int64[Tensor, "n k"]:
    """Rank of each candidate among the k of its trial, 0 for the largest value; ties by candidate
    number, NaN last.

    Args:
        value: (N k,) floats, trial by trial, or (N, k).
        k: candidates of each trial.

    Raises:
        ValueError: k does not divide the number of rows, or is another than that of (N, k).
    """
    order = _best_first(value, k)
    places = torch.arange(k, dtype=torch.int64, device=value.device).expand_as(order)
    return torch.empty_like(order).scatter_(1, order, places)


@check_tensor_arguments(value=_value, k=integer(1))
def best_of_k(value: Float32[Tensor, "*b"], k: int) -> Int64[Tensor, " n"]:
    """Number (0 to k - 1) of each trial's best candidate: the largest value, the first of equals;
    NaN never if avoidable.

    Args:
        value: (N k,) floats, trial by trial, or (N, k).
        k: candidates of each trial.

    Raises:
        ValueError: k does not divide the number of rows, or is another than that of (N, k).
    """
    return _best_first(value, k)[:, 0]


def _best_first(value: Tensor, k: int) -> Tensor:
    if value.ndim == 1 and value.shape[0] % k:
        raise ValueError(
            f"k is {k}; {value.shape[0]} rows can only be split by a divisor of their number"
        )
    if value.ndim == 2 and value.shape[1] != k:
        raise ValueError(
            f"k is {k}, and value is {tuple(value.shape)}: {value.shape[1]} for each trial"
        )
    value = value.reshape(-1)
    table = torch.where(value.isnan(), -torch.inf, value).view(value.shape[0] // k, k)
    # NaN behind -inf: sorted by both, the second one stably
    order = value.isnan().view_as(table).to(torch.int8).argsort(dim=1, stable=True)
    return order.gather(1, table.gather(1, order).argsort(dim=1, descending=True, stable=True))


def _judged(scores: Scores) -> Bool[Tensor, "*b"]:
    return scores.outcome < int(Outcome.INVALID_INPUT)
