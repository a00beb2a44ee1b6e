"""Release policies by their names, and a user's class: how it is found, made, asked, and its answers checked."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import torch
from torch import Tensor

from r2h_batch.base.errors import UserError
from r2h_batch.base.io.read import printable
from r2h_batch.base.user_code import UserFunction, chosen, raised
from r2h_batch.closed_loop.transfer.release import POLICIES, Action, Observation, RobotSide
from r2h_batch.runs import provenance

Policy: TypeAlias = Callable[[Observation], Action]

MOST_SHIFT_M, ROUNDING = 0.5, 1e-6
"""How far along each axis the robot may move its hand from the handover pose [choice]; by how much an effort may be above 1."""
SHOWN = 100
"""Letters of a wrong answer that a message shows."""


class ReleaseError(UserError):
    """A release policy that cannot be asked, or whose answer is none: names the policy, what it gave and what is allowed."""


def release_of(spec: str) -> tuple[Any, str]:
    """A policy by its name, or the user's class (`package.module:Class` or `FILE.py:Class`), and a text
    that says what decides its actions.

    Raises:
        ImportError: the module or class does not exist.
        TypeError: it is not a class.
    """
    policy, own = _found(spec)
    if own is None:
        return policy, spec
    return policy, f"{own.spec} {provenance.file_digest(own.files().values())[:16]}"


def maker_of(spec: str) -> Callable[[RobotSide], Policy]:
    """The maker of such a policy, called once for each batch of transfers. Answers of a user's class are checked.

    Args:
        spec: as `release_of` takes it.

    Raises:
        ImportError, TypeError: as `release_of`.
    """
    policy, own = _found(spec)
    maker: Callable[[RobotSide], Policy] = (
        policy if own is None else partial(_Checked, own.spec, policy)
    )
    return maker


def _found(spec: str) -> tuple[Any, UserFunction | None]:
    policy, own = chosen(POLICIES, spec, "Class")
    if own is not None and not isinstance(policy, type):
        raise TypeError(
            f"{spec} is no class; a release policy is made for each batch, Class(robot)"
        )
    return policy, own


class _Checked:
    """A user's policy. What it answers is looked at before anything acts on it."""

    def __init__(self, spec: str, policy: Any, robot: RobotSide) -> None:
        self.name, self.like = f"release policy {printable(spec)}", robot.weight_n
        self.policy: Callable[[Observation], object] = self._asked(policy, robot)
        if not callable(self.policy):
            raise ReleaseError(
                f"{self.name}: an object of it cannot be called; write __call__(self, seen), which returns an Action"
            )

    def __call__(self, seen: Observation) -> Action:
        found = self._asked(self.policy, seen)
        if not isinstance(found, Action):
            raise ReleaseError(
                f"{self.name}: its answer is {_shown(found)}; it must be an Action"
                " (r2h_batch.closed_loop.transfer.release), as Action(open) with a tensor of bool"
            )
        n = len(self.like)
        opens = self._tensor("open", found.open, (n,))
        assert opens is not None
        return Action(
            opens,
            self._tensor("squeeze", found.squeeze, (n,)),
            self._tensor("shift", found.shift, (n, 3)),
            self._tensor("surplus_n", found.surplus_n, (n,)),
        )

    def _asked(self, call: Callable[[Any], Any], argument: object) -> Any:
        try:
            return call(argument)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # SystemExit too: it would end the command without a word
            raise ReleaseError(f"{self.name}: {raised(error)}") from error

    def _tensor(self, field: str, value: object, shape: tuple[int, ...]) -> Tensor | None:
        """A field of the answer, without its gradient, in the simulation's precision."""
        if value is None and field != "open":
            return None
        what, allowed = ("bool", (torch.bool,)) if field == "open" else ("float64", _FLOATS)
        fits = (
            isinstance(value, Tensor)
            and value.dtype in allowed
            and tuple(value.shape) == shape
            and value.device == self.like.device
        )
        if not fits:
            raise ReleaseError(
                f"{self.name}: {field} is {_shown(value)}; it must be a tensor {shape} of {what} on {self.like.device}"
                f"{'' if field == 'open' else ', or None'}: a row for each transfer"
            )
        assert isinstance(value, Tensor)
        value = value.detach()
        if field == "open":
            return value
        # another device would have to wait for the answer
        low, high = _RANGES[field]
        odd = ~((value >= low) & (value <= high))
        if value.device.type == "cpu" and bool(odd.any()):
            number = float(value[odd][0])
            raise ReleaseError(
                f"{self.name}: {field} holds {number:g}; it must hold {_NUMBERS[field]}"
            )
        return value.double()


_FLOATS = (torch.float64, torch.float32)
_NUMBERS = {
    "squeeze": "finite numbers, 0 to 1",
    "shift": f"finite numbers, {-MOST_SHIFT_M:g} to {MOST_SHIFT_M:g} m",
    "surplus_n": "numbers, N; -inf where nothing is known yet",
}
_RANGES = {
    "squeeze": (-ROUNDING, 1.0 + ROUNDING),
    "shift": (-MOST_SHIFT_M, MOST_SHIFT_M),
    "surplus_n": (-math.inf, math.inf),
}


def _shown(value: object) -> str:
    if isinstance(value, Tensor):
        return f"a tensor {tuple(value.shape)} of {str(value.dtype).removeprefix('torch.')} on {value.device}"
    return f"{type(value).__name__} {printable(repr(value))[:SHOWN]}"
