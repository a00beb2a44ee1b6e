"""What a method answers, checked as a predictions file is: a user's code hands it over, and rows
are scored from it."""

import time
import traceback
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from r2h_batch.io.read import printable
from r2h_batch.sweep.devices import device_trouble
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import MOST_SECONDS

__all__ = ["AnswerError", "answer_of"]

_FLOATS = (torch.float32, torch.float64)


class AnswerError(ValueError):
    """A method's answer that cannot be scored: names the method, the argument, what was found and
    what is allowed."""


def answer_of(name: str, trials: Trials, call: Callable[[Trials], Any]) -> Predictions:
    """A method's answer for these trials, in memory of its own, with its amortised wall time where
    it gives none.

    The method gets a copy of the trials: what it writes there does not reach what is judged.
    """
    mine = trials.clone()
    start = time.perf_counter()
    try:
        given = call(mine)
    except Exception as error:  # a user's code raises what it likes; other methods go on
        if device_trouble(error) is not None:
            raise  # not the method's fault: no other one would fare better
        where = traceback.extract_tb(error.__traceback__)[-1]
        what = f"{type(error).__name__}: {printable(' '.join(str(error).split()))[:300]}"
        raise AnswerError(
            f"method {name}: {what} ({printable(where.filename)}, line {where.lineno})"
        ) from error
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    seconds = (time.perf_counter() - start) / max(len(trials), 1)
    T_obj_ee, T_world_ee, own, trial_id = _parts(name, given)
    n, home = len(trials), trials.trial_id.device
    if trial_id is not None and not (
        isinstance(trial_id, Tensor)
        and trial_id.shape == (n,)
        and torch.equal(trial_id.detach().to(home), trials.trial_id)
    ):
        raise AnswerError(
            f"method {name}: trial_id differs from that of the {n} trials; answer them in their order"
        )
    grasp, handover = (
        _float32(name, key, value, (n, 4, 4))
        for key, value in (("T_obj_ee", T_obj_ee), ("T_world_ee", T_world_ee))
    )
    if own is None:
        t_method_s = torch.full((n,), seconds, dtype=torch.float32, device="cpu")
    else:
        t_method_s = _float32(name, "t_method_s", own, (n,))
        if bool((odd := (t_method_s < 0) | (t_method_s > MOST_SECONDS)).any()):
            raise AnswerError(
                f"method {name}: t_method_s is {float(t_method_s[odd][0]):g}; 0 to {MOST_SECONDS:g} seconds are allowed, "
                "NaN where it was not measured"
            )
    return Predictions(trials.trial_id, grasp, handover, t_method_s, name)


def _parts(name: str, given: Any) -> tuple[Any, Any, Any, Any]:
    """T_obj_ee, T_world_ee, t_method_s or None, trial_id or None."""
    if isinstance(given, Predictions):
        return given.T_obj_ee, given.T_world_ee, given.t_method_s, given.trial_id
    if isinstance(given, (tuple, list)) and len(given) in (2, 3):
        return given[0], given[1], given[2] if len(given) == 3 else None, None
    what = (
        f"{type(given).__name__} of {len(given)}"
        if isinstance(given, (tuple, list))
        else type(given).__name__
    )
    raise AnswerError(
        f"method {name}: its answer is a {what}; it must be r2h_batch.Predictions or (T_obj_ee, T_world_ee[, t_method_s])"
    )


def _float32(name: str, key: str, value: Any, shape: tuple[int, ...]) -> Tensor:
    """The numbers as they are scored. Poses that are not finite or not rigid are the evaluator's
    INVALID_INPUT, by row."""
    if not isinstance(value, Tensor):
        raise AnswerError(
            f"method {name}: {key} is {printable(type(value).__name__)}; it must be a tensor {shape}"
        )
    if tuple(value.shape) != shape or value.dtype not in _FLOATS:
        raise AnswerError(
            f"method {name}: {key} is {value.dtype} {tuple(value.shape)}; it must be torch.float32 or torch.float64 {shape}"
        )
    if value.device.type not in ("cpu", "cuda"):
        raise AnswerError(f"method {name}: {key} is on {value.device}; it must be on cpu or cuda")
    return value.detach().to(torch.float32).clone()
