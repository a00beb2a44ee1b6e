"""A scoring call of fixed size that is repeated: fixed memory in and out; on CUDA one graph,
without a word from the host."""

from collections.abc import Callable
from dataclasses import fields, replace

import torch
from torch import Tensor

from r2h_batch.base.validate import instance_of, integer
from r2h_batch.base.validate_tensors import check_tensor
from r2h_batch.config import EvalConfig
from r2h_batch.judge.inputs import Stages, check_stages
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.types import Scores, Trials

_WARM_UP = 3
"""Calls before a graph is captured: they load kernels and tables, and fill torch's caches."""


def check_capture(
    benchmark: Benchmark, config: EvalConfig, device: torch.device, stages: Stages
) -> None:
    """Raises ValueError for what CUDA cannot capture, since it waits for the host: Pick, planning, physics,
    numbers drawn there."""
    check_stages(stages)
    if device.type != "cuda":
        return
    if "pick" in benchmark.asks:
        raise ValueError(
            f"{benchmark.name} asks for Pick, which waits for the device and cannot be captured; call"
            " score(..., stages='pose'), or capture on a CPU"
        )
    for section in ("execution_error", "object_errors"):
        if getattr(config, section).any:
            raise ValueError(
                f"{section} is drawn on the host and cannot be captured; perturb the poses with"
                " judge.execution_error.executed_poses before the call"
            )
    if config.ik.solver != "fused":
        raise ValueError(
            "ik.solver='pytorch-kinematics' waits for the device and cannot be captured; use 'fused'"
        )
    if config.plan.hand == "estimated":
        raise ValueError(
            "plan.hand='estimated' is drawn on the host and cannot be captured; use 'true'"
        )
    if stages != "pose" or config.stability == "physics":
        raise ValueError(
            f"stages is {stages!r}, stability {config.stability!r}: planning and physics wait for the "
            "device and cannot be captured; capture stages='pose' with stability='geometric'"
        )


class Captured:
    """`captured(T_obj_ee, T_world_ee, trials)` equals `evaluator.score(...)`, bit for bit.

    The arguments are copied into `T_obj_ee`, `T_world_ee`, `trials`, which live as long as this
    object; what is left out stays as it was, so a generator may as well write there itself. The
    result is always the same `scores`, overwritten by the next call: clone what has to stay. On
    CUDA a call is a copy and one graph launch on the current stream; on a CPU it is the ordinary
    call, its result copied into `scores`.
    """

    def __init__(
        self, score: Callable[[Tensor, Tensor, Trials], Scores], device: torch.device, b: int, *,
        bodies: bool,
    ) -> None:  # fmt: skip
        """`score`: what is repeated, of poses (b, 4, 4) and b trials; on CUDA it may not wait for
        the device. `bodies`: the trials' receivers have a body."""
        b = integer(1, what=" of rows")("b", b)
        self._score = score
        self.T_obj_ee = torch.eye(4, dtype=torch.float32, device=device).repeat(b, 1, 1)
        self.T_world_ee = self.T_obj_ee.clone()
        zero = torch.zeros(b, dtype=torch.int32, device=device)
        body = torch.ones(b, 5, 4, dtype=torch.float32, device=device) if bodies else None
        self.trials = Trials(zero.long(), zero, zero.clone(), self.T_obj_ee.clone(), body)
        self._graph: torch.cuda.CUDAGraph | None = None
        if device.type == "cuda":
            aside = torch.cuda.Stream(device)
            aside.wait_stream(torch.cuda.current_stream(device))
            with torch.cuda.stream(aside):
                for _ in range(_WARM_UP):
                    self._run()
            torch.cuda.current_stream(device).wait_stream(aside)
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self.scores = self._run()
        else:
            self.scores = replace(self._run()).clone()  # without the inputs of this call

    def __call__(
        self,
        T_obj_ee: Tensor | None = None,
        T_world_ee: Tensor | None = None,
        trials: Trials | None = None,
    ) -> Scores:
        """`scores` of the b rows; poses (b, 4, 4) float32."""
        with torch.no_grad():
            for name, kept, new_value in (
                ("T_obj_ee", self.T_obj_ee, T_obj_ee),
                ("T_world_ee", self.T_world_ee, T_world_ee),
            ):
                if new_value is not None:
                    _copy(name, kept, new_value)
            if trials is not None:
                instance_of(Trials)("trials", trials)
                for f in fields(Trials):
                    # who the receiver is decides nothing
                    if (kept := getattr(self.trials, f.name)) is not None:
                        _copy(f"trials.{f.name}", kept, getattr(trials, f.name))
            if self._graph is not None:
                self._graph.replay()
            else:
                new = self._run()
                for f in fields(new):
                    getattr(self.scores, f.name).copy_(getattr(new, f.name))
        return self.scores

    def _run(self) -> Scores:
        return self._score(self.T_obj_ee, self.T_world_ee, self.trials)


def _copy(name: str, kept: Tensor, value: Tensor) -> None:
    check_tensor(name, value, f"a torch tensor {tuple(kept.shape)} of {kept.dtype}")
    if value.shape != kept.shape or value.dtype != kept.dtype or value.device != kept.device:
        raise ValueError(
            f"{name} is {value.dtype} {tuple(value.shape)} on {value.device}; "
            f"this call was captured for {kept.dtype} {tuple(kept.shape)} on {kept.device}"
        )
    kept.copy_(value)
