"""The process of a method that sees: `python -m r2h_batch.observe.asked`, started by `observe.apart`.

It gets observations and nothing else. Modules of the package that could make trials, objects or scenes cannot be imported
here: what a method needs of the package is in `ALLOWED`.
"""

import json
import os
import sys
import time
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base.errors import UserError
from r2h_batch.base.io.child import end_with
from r2h_batch.base.user_code import load_function, raised
from r2h_batch.observe.messages import receive, send
from r2h_batch.observe.seen import unpacked

ALLOWED = ("r2h_batch.base", "r2h_batch.observe.seen")
"""Modules of the package that a method that sees may import, with all that lies in them."""
PACKAGE = "r2h_batch"
MOST_LETTERS = 10_000
"""Length of the words about an error."""


class Forbidden(MetaPathFinder):
    """Refuses every module of the package that is not in `ALLOWED`."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """None: others may find it."""
        inside = fullname.partition(".")[0] == PACKAGE
        if inside and not any(f"{fullname}.".startswith(f"{name}.") for name in ALLOWED):
            raise ImportError(
                f"{fullname}: a method that sees cannot have it; it may import {', '.join(ALLOWED)}"
            )
        return None


def main() -> int:
    """Answer observations until the parent closes the pipe."""
    asked = json.loads(sys.argv[1])
    end_with(asked["parent"])
    # the pipe is the answers' alone: what the method prints goes to stderr
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    questions = os.fdopen(os.dup(0), "rb")
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    if asked["threads"]:
        torch.set_num_threads(asked["threads"])
    sys.meta_path.insert(0, Forbidden())
    options, function = asked["options"], None
    while (message := receive(questions, sys.maxsize)) is not None:
        try:
            if function is None:
                function = load_function(asked["method"]).function
            seen = unpacked(message)
            start = time.perf_counter()
            answer = function(seen, **options)
            seconds = (time.perf_counter() - start) / max(len(seen), 1)
            found = _arrays(answer, len(seen), seconds)
        except BaseException as error:  # SystemExit too: the parent says it in one line
            own = isinstance(error, _WrongAnswerError)
            found = {"error": np.array((str(error) if own else raised(error))[:MOST_LETTERS])}
        send(answers, found)
    return 0


class _WrongAnswerError(UserError):
    """An answer that is no pair of poses."""


def _arrays(answer: Any, n: int, seconds: float) -> dict[str, NDArray[Any]]:
    """The answer as arrays: `T_world_grasp`, `T_world_ee` (n, 4, 4) float64, `t_method_s` (n,)."""
    if not isinstance(answer, (tuple, list)) or len(answer) != 2:
        size = f" of {len(answer)}" if isinstance(answer, (tuple, list)) else ""
        what = f"its answer is a {type(answer).__name__}{size}"
        raise _WrongAnswerError(f"{what}; it must be (T_world_grasp, T_world_ee)")
    found: dict[str, NDArray[Any]] = {"t_method_s": np.full(n, seconds, np.float32)}
    for name, value in zip(("T_world_grasp", "T_world_ee"), answer, strict=True):
        own = value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value
        try:
            array = np.asarray(own, np.float64)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != (n, 4, 4):
            shown = f"{type(value).__name__} {tuple(getattr(value, 'shape', ()))}"
            raise _WrongAnswerError(f"{name} is a {shown}; it must be numbers ({n}, 4, 4)")
        found[name] = array
    return found


if __name__ == "__main__":
    sys.exit(main())
