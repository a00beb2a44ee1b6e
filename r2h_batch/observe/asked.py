"""The process of a method that sees: `python -m r2h_batch.observe.asked`, started by `observe.apart`.

It gets observations and nothing else. Modules of the package that could make trials, objects or scenes cannot be imported
here: what a method needs of the package is in `ALLOWED`.
"""

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import fields
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base.errors import AnswerError
from r2h_batch.base.io.child import end_with
from r2h_batch.base.io.read import printable
from r2h_batch.base.user_code import load_function, raised
from r2h_batch.base.validate_tensors import as_numbers
from r2h_batch.observe.messages import receive, send
from r2h_batch.observe.seen import KnownObjects, Observation, unpacked

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
    options, function, seen = asked["options"], None, None
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
            own = isinstance(error, AnswerError)
            words = (str(error) if own else raised(error))[:MOST_LETTERS]
            found = {"error": np.array(words + _of_unknown(error, seen))}
        send(answers, found)
    return 0


def _of_unknown(error: BaseException, seen: Observation | None) -> str:
    """Advice on a method that takes `seen.known` for granted; nothing for other errors."""
    parts = {field.name for field in fields(KnownObjects)}
    of_none = isinstance(error, AttributeError) and error.obj is None and error.name in parts
    if not of_none or seen is None or seen.known is not None:
        return ""
    return "; seen.known is None: the objects' models are not told, give --sees RIG,model=known"


def _arrays(answer: Any, n: int, seconds: float) -> dict[str, NDArray[Any]]:
    """The answer as arrays: `T_world_grasp`, `T_world_ee` (n, 4, 4) float64, `t_method_s` (n,)."""
    if not isinstance(answer, (tuple, list)) or len(answer) != 2:
        size = f" of {len(answer)}" if isinstance(answer, (tuple, list)) else ""
        what = f"its answer is a {type(answer).__name__}{size}"
        raise AnswerError(f"{what}; it must be (T_world_grasp, T_world_ee)")
    found: dict[str, NDArray[Any]] = {"t_method_s": np.full(n, seconds, np.float32)}
    words = f"a tensor ({n}, 4, 4) of torch.float32 or torch.float64"
    for name, value in zip(("T_world_grasp", "T_world_ee"), answer, strict=True):
        try:
            numbers = as_numbers(name, value, words, "cpu")
        except TypeError as error:
            raise AnswerError(printable(error)) from None
        if tuple(numbers.shape) != (n, 4, 4):
            shown = f"{numbers.dtype} {tuple(numbers.shape)}"
            raise AnswerError(f"{name} is {shown}; it must be {words}")
        found[name] = numbers.detach().cpu().double().numpy()
    return found


if __name__ == "__main__":
    sys.exit(main())
