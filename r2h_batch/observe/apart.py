"""A method that sees, in a process of its own (`observe.asked`): it gets observations and holds no scene, trials or truth."""

import json
import os
import subprocess
import sys
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.errors import AnswerError
from r2h_batch.observe.messages import receive, send
from r2h_batch.observe.seen import Observation, packed

MOST_WORDS = 1 << 20
"""Bytes of an answer beside its numbers."""
NUMBERS: Mapping[str, tuple[tuple[int, ...], str]] = {
    "T_world_grasp": ((4, 4), "float64"),
    "T_world_ee": ((4, 4), "float64"),
    "t_method_s": ((), "float32"),
}
"""Content of an answer: name -> shape of a row, type."""


class Apart:
    """A function `predict(seen)` of a user's, asked in a process of its own that starts with the first question.

    Args:
        method: `package.module:function` or `FILE.py:function`, as `--method` names it.
        options: keyword arguments of the function: texts and numbers.
        threads: of torch; None: as many as it takes.
    """

    def __init__(self, method: str, options: Mapping[str, Any], threads: int | None) -> None:
        self.method = method
        self._asked = {"method": method, "options": dict(options), "threads": threads}
        self._process: subprocess.Popen[bytes] | None = None

    def _running(self) -> "subprocess.Popen[bytes]":
        if self._process is None:
            # modules from where this process has them
            places = os.pathsep.join(p or os.getcwd() for p in sys.path)
            process = subprocess.Popen(
                [sys.executable, "-m", "r2h_batch.observe.asked", json.dumps({**self._asked, "parent": os.getpid()})],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": places},
            )  # fmt: skip
            weakref.finalize(self, _end, process)
            self._process = process
        return self._process

    @property
    def process_id(self) -> int | None:
        """The process that answered last; None before the first question."""
        return None if self._process is None else self._process.pid

    def ask(
        self, seen: Observation
    ) -> tuple[Float64[Tensor, "n 4 4"], Float64[Tensor, "n 4 4"], Float32[Tensor, " n"]]:
        """T_world_grasp, T_world_ee (m) and the method's seconds a trial, on the CPU.

        The method gets the trials in the order of `Observation.key`, so that a row's place says nothing of its trial.

        Args:
            seen: of N trials.

        Raises:
            AnswerError: what the method did wrong, in one line.
        """
        process = self._running()
        assert process.stdin is not None and process.stdout is not None
        order = torch.argsort(seen.key.cpu())
        try:
            send(process.stdin, packed(seen[order]))
            answer = receive(process.stdout, len(seen) * 512 + MOST_WORDS)
        except BrokenPipeError:
            answer = None
        except AnswerError as error:
            self._drop(process)
            raise AnswerError(f"its process wrote {error} where its answer belongs") from error
        if answer is None:
            self._process = None
            raise AnswerError(f"its process ended with code {process.wait()}")
        if "error" in answer:
            raise AnswerError(str(answer["error"]))
        if wrong := _wrong(answer, len(seen)):
            self._drop(process)
            raise AnswerError(f"its process wrote {wrong} where its answer belongs")
        back = torch.argsort(order)
        grasp, handover, seconds = (
            torch.from_numpy(answer[k])[back] for k in ("T_world_grasp", "T_world_ee", "t_method_s")
        )
        return grasp, handover, seconds

    def _drop(self, process: "subprocess.Popen[bytes]") -> None:
        """Ends a process whose pipe is of no use any more."""
        self._process = None
        process.kill()
        process.wait()


def _wrong(answer: Mapping[str, NDArray[Any]], n: int) -> str:
    """Difference of an answer from `NUMBERS`; nothing where it is right. The user's code can write into the pipe too."""
    for name, (row, kind) in NUMBERS.items():
        array = answer.get(name, np.empty(0, object))
        if array.shape != (n, *row) or array.dtype != np.dtype(kind):
            return f"{name} as {array.shape} {array.dtype}"
    return ""


def _end(process: "subprocess.Popen[bytes]") -> None:
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
    try:
        process.wait(1.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
