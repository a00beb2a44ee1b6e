"""The trials that a method can answer, and its answers, checked as a predictions file is.

A built-in method has no answer for objects without grasps and for hands that hold nothing. Those
trials get no pose and count as its failures (`invalid_input`).
"""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from r2h_batch.base.errors import AnswerError, EndedError, UsageError
from r2h_batch.base.io.read import printable
from r2h_batch.base.user_code import raised, text_of
from r2h_batch.base.validate_tensors import as_numbers, check_tensor
from r2h_batch.strangers import Ended, stranger
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import MOST_SECONDS, SIDES

NAMED = 3
"""Objects that a line names."""

if TYPE_CHECKING:  # a sweep of a user's method needs no kernels of grasps and holds
    from r2h_batch.methods.predictors import Observations
    from r2h_batch.scene.scene import Scene


def answer_of(
    name: str, trials: Trials, call: Callable[[Trials], Any], *, of: str = ""
) -> Predictions:
    """A method's answer for these trials, in memory of its own, with its amortised wall time where
    it gives none.

    The method gets a copy of the trials: what it writes there does not reach what is judged. `of`: the module that it
    lies in.
    """
    copied, clock = trials.clone(), time.perf_counter
    try:
        with stranger(name, of):
            start = clock()
            answer = call(copied)
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            seconds = (clock() - start) / max(len(trials), 1)
            T_obj_ee, T_world_ee, own, trial_id = _parts(name, answer)
    except (KeyboardInterrupt, AnswerError):
        raise
    except BaseException as error:  # SystemExit too; other methods go on
        if device_trouble(error) is not None:
            raise  # not the method's fault: no other one would fare better
        kind = EndedError if isinstance(error, Ended) else AnswerError
        raise kind(f"method {name}: {raised(error)}") from error
    n, home = len(trials), trials.trial_id.device
    if trial_id is not None:
        ids = _checked(name, "trial_id", trial_id, (n,), (torch.int64,)).to(home)
        if not torch.equal(ids, trials.trial_id):
            order = f"differs from that of the {n} trials; answer them in their order"
            raise AnswerError(f"method {name}: trial_id {order}")
    grasp, handover = (
        _checked(name, key, value, (n, 4, 4)).to(torch.float32)
        for key, value in (("T_obj_ee", T_obj_ee), ("T_world_ee", T_world_ee))
    )
    if own is None:
        t_method_s = torch.full((n,), seconds, dtype=torch.float32, device="cpu")
    else:
        t_method_s = _checked(name, "t_method_s", own, (n,)).to(torch.float32)
        if bool((odd := (t_method_s < 0) | (t_method_s > MOST_SECONDS)).any()):
            found = f"t_method_s is {float(t_method_s[odd][0]):g}"
            allowed = f"0 to {MOST_SECONDS:g} seconds are allowed, NaN where it was not measured"
            raise AnswerError(f"method {name}: {found}; {allowed}")
    return Predictions(trials.trial_id, grasp, handover, t_method_s, name)


def _parts(name: str, answer: Any) -> tuple[Any, Any, Any, Any]:
    """T_obj_ee, T_world_ee, t_method_s and trial_id of an answer, None where it has none. Tensors are plain ones: a kind of the
    method's own may answer anything when the judge asks it."""
    own, trial_id = None, None
    if isinstance(answer, Predictions):
        T_obj_ee, T_world_ee = answer.T_obj_ee, answer.T_world_ee
        own, trial_id = answer.t_method_s, answer.trial_id
    elif isinstance(answer, (tuple, list)) and len(answer) in (2, 3):
        T_obj_ee, T_world_ee, own = (*answer, None)[:3]
    else:
        size = f" of {len(answer)}" if isinstance(answer, (tuple, list)) else ""
        allowed = "r2h_batch.Predictions or (T_obj_ee, T_world_ee[, t_method_s])"
        what = f"its answer is a {type(answer).__name__}{size}; it must be {allowed}"
        raise AnswerError(f"method {name}: {what}")
    return (
        _plain(name, T_obj_ee),
        _plain(name, T_world_ee),
        _plain(name, own),
        _plain(name, trial_id),
    )


def _plain(name: str, value: Any) -> Any:
    if not isinstance(value, Tensor) or type(value) is Tensor:
        return value
    try:
        plain = value.detach().as_subclass(Tensor)
    except Exception:
        plain = value
    if type(plain) is not Tensor:
        what = f"a tensor of its own kind {type(value).__name__}, which becomes no plain one"
        raise AnswerError(f"method {name}: its answer has {what}; give torch.Tensor")
    return plain


def _checked(
    name: str,
    key: str,
    value: Any,
    shape: tuple[int, ...],
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64),
) -> Tensor:
    """A copy of the numbers. Poses that are not finite or not rigid are the evaluator's
    INVALID_INPUT, by row."""
    words = f"a tensor {shape} of {' or '.join(map(str, dtypes))}"
    try:
        floats = torch.float32 in dtypes
        value = as_numbers(key, value, words, "cpu") if floats else check_tensor(key, value, words)
    except TypeError as error:
        raise AnswerError(f"method {name}: {printable(error)}") from None
    if tuple(value.shape) != shape or value.dtype not in dtypes:
        found = f"{value.dtype} {tuple(value.shape)}"
        raise AnswerError(f"method {name}: {key} is {found}; it must be {words}")
    return value.detach().clone()


@dataclass(frozen=True, eq=False)
class MethodCoverage:
    """Which (object, side of the receiver's hand) a method can answer."""

    answers: Tensor  # (O, 2) bool
    side: Tensor  # (H,) int64, of each hand of the set
    lines: tuple[str, ...]  # what it cannot answer, for people

    def answer(self, trials: Trials, call: Callable[[Trials], Predictions]) -> Predictions:
        """The method's answers to the trials that it can answer; NaN poses for the others."""
        side = self.side[trials.hand_index.cpu().long()]
        rows = self.answers[trials.object_index.cpu().long(), side]
        if bool(rows.all()):
            return call(trials)
        n, home = len(trials), trials.trial_id.device
        T_obj_ee, T_world_ee = (
            torch.full((n, 4, 4), torch.nan, dtype=torch.float32, device=home) for _ in range(2)
        )
        seconds, method = torch.full((n,), torch.nan, dtype=torch.float32, device=home), ""
        rows = rows.to(home)
        if bool(rows.any()):
            part = call(trials[rows])
            T_obj_ee[rows], T_world_ee[rows] = part.T_obj_ee.to(home), part.T_world_ee.to(home)
            if part.t_method_s is not None:
                seconds[rows] = part.t_method_s.to(home)
            method = part.method
        return Predictions(trials.trial_id, T_obj_ee, T_world_ee, seconds, method)


def check_grasps(scene: "Scene", allow_empty: bool) -> None:
    """Raises `UsageError` where an object has no grasp candidate and that is not allowed."""
    from r2h_batch.methods.candidates import without_candidates

    empty = [scene.objects[i].name for i in without_candidates(scene)]
    if empty and not allow_empty:
        raise UsageError(
            f"{', '.join(empty)}: no grasp found; the gripper needs a part narrower than 85 mm that it can reach: leave "
            f"{'it' if len(empty) == 1 else 'them'} out, give --grasps, or --allow-empty-candidates to count as failures"
        )
    if len(empty) == len(scene.objects):
        words = "there is nothing for a built-in method to choose from"
        raise UsageError(f"no object has a grasp candidate: {words}")


def coverage_of(
    name: str, sees: Sequence[str], scene: "Scene", seen: "Observations | None"
) -> MethodCoverage:
    """Objects that a built-in method can answer: every object with candidates; those that look at
    the receiver's hold on it (and are not shown a network's) also need one of the hand's side."""
    from r2h_batch.methods.candidates import without_candidates

    answers = torch.ones((len(scene.objects), 2), dtype=torch.bool, device="cpu")
    lines = []
    for i in without_candidates(scene):
        answers[i] = False
        what = f"no grasp candidate of {scene.objects[i].name}"
        lines.append(f"{name}: {what}: its trials count as failures")
    if "receiving" in sees and (seen is None or seen.receiving is None):
        from r2h_batch.trials.holding.receiving import without_receiving  # 0.4 s

        sides = set(scene.hands.set.side.tolist())
        for i, side in without_receiving(scene.objects, scene.hands.model):
            if bool(answers[i, side]) and side in sides:
                what = f"no {SIDES[side]} hand was found that can hold {scene.objects[i].name}"
                lines.append(
                    f"{name}: {what}: its trials with {SIDES[side]} hands count as failures"
                )
            answers[i, side] = False
    return MethodCoverage(answers, scene.hands.set.side.cpu().long(), tuple(lines))


def guessed_contacts(name: str, sees: Sequence[str], scene: "Scene") -> tuple[str, ...]:
    """A line where a method's built-in network of contacts is asked about objects unlike all that it learned from."""
    if "contacts" not in sees:
        return ()
    from r2h_batch.methods.predictors.contacts import never_seen
    from r2h_batch.methods.predictors.unseen import LEFT_OUT

    if not (unlike := never_seen(scene)):
        return ()
    more = f" and {len(unlike) - NAMED} more" if len(unlike) > NAMED else ""
    known = ", ".join(sorted(category for group in LEFT_OUT for category in group))
    return (
        f"{name}: its network of contacts learned from 16 categories ({known}), and {', '.join(unlike[:NAMED])}{more} may be of"
        " none of them: its contacts are a guess there; --predicted-contacts FILE or --predictor FILE gives yours",
    )


_OF_DEVICE = re.compile(
    r"CUDA (error|out of memory|driver)|CUDNN_STATUS|CUBLAS_STATUS|NVIDIA driver|on device '?cuda|Torch not compiled with CUDA"
)
"""torch.AcceleratorError ("CUDA error: ..."), torch.OutOfMemoryError ("CUDA out of memory. ..."),
torch.cuda.init ("Found no NVIDIA driver ...", "The NVIDIA driver on your system is too old ..."),
Warp's RuntimeError ("CUDA error 719 detected on device cuda:0: ...", "Failed to allocate 8 bytes on
device 'cuda:0'")."""


def device_trouble(error: BaseException) -> str | None:
    """The first line of an error that speaks of the GPU; None for every other error."""
    text = text_of(error).strip()
    of_torch = isinstance(error, (torch.OutOfMemoryError, torch.AcceleratorError))
    says_so = isinstance(error, (RuntimeError, AssertionError)) and _OF_DEVICE.search(text)
    if not of_torch and not says_so:
        return None
    return text.partition("\n")[0][:300] or type(error).__name__


def why_no_cuda() -> str:
    """Why torch sees no CUDA device, in its own words: no driver, one that is too old, a build
    without CUDA."""
    try:
        torch.cuda.init()
    except (RuntimeError, AssertionError) as error:
        return str(error).strip().partition("\n")[0].partition(". ")[0][:200]
    return "the driver shows none"
