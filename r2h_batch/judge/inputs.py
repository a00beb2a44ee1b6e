"""Checks of the inputs of `Evaluator.score`: one row per candidate, from (B, 4, 4) or (N, K, 4, 4);
everything else is refused by name."""

import warnings
from dataclasses import replace
from functools import cache
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from r2h_batch.base.launch.arguments import TensorLayoutGuard
from r2h_batch.base.validate import describe_value, instance_of, one_of
from r2h_batch.base.validate_tensors import as_numbers, check_range, check_tensor
from r2h_batch.config import EvalConfig
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.predictions import doubts
from r2h_batch.types import Predictions, Trials

MOST_M = 1000.0
"""No number of a receiver is larger; poses beyond are INVALID_INPUT."""
_LEAST = torch.full((5, 4), -MOST_M, dtype=torch.float32, device="cpu")
_LEAST[:2, 3] = _LEAST[4, :3] = 0.0  # radii and half sizes
Stages = Literal["pose", "all"]
"""How far `Evaluator.score` goes: what needs no path, or everything."""


def checked_inputs(
    scene: Scene, T_obj_ee: Any, T_world_ee: Any, trials: Trials, stages: Stages, *,
    second: str = "T_world_ee",
) -> tuple[Tensor, Tensor, Trials]:  # fmt: skip
    """Poses (B, 4, 4) of float32 and B trials; (N, K) candidates become N K rows, each trial K
    times in turn. One grasp of each trial, (N, 4, 4) or (N, 1, 4, 4), goes with all of its K poses.

    `second`: what messages call the other pose. Poses may be tensors, NumPy arrays or nested lists
    (`as_numbers`); tensors keep their gradient.
    Raises ValueError, TypeError from shapes, dtypes and devices alone.
    """
    device = torch.device(scene.device)
    check_stages(stages)
    instance_of(Trials, "benchmark.trials(...), or r2h_batch.Trials")("trials", trials)
    check_tensor("trials.trial_id", trials.trial_id, "a torch tensor (N,) of torch.int64")
    if trials.trial_id.ndim != 1:
        raise ValueError(
            f"trials.trial_id is {describe_value(trials.trial_id)}; it must be torch.int64 (N,)"
        )
    n = len(trials)
    rule = "a torch tensor (B, 4, 4) or (N, K, 4, 4) of float32 or float64"
    T_obj_ee, T_world_ee = (
        as_numbers(name, value, rule, device).float()
        for name, value in (("T_obj_ee", T_obj_ee), (second, T_world_ee))
    )
    if T_world_ee.ndim == 4 and T_obj_ee.shape in ((n, 4, 4), (n, 1, 4, 4)):
        T_obj_ee = T_obj_ee.reshape(n, 1, 4, 4).expand(n, T_world_ee.shape[1], 4, 4)
    many = T_obj_ee.ndim == 4
    k = T_obj_ee.shape[1] if many else 1
    shape, words = (
        ((n, k, 4, 4), f"({n}, K, 4, 4)") if many else ((n, 4, 4), f"({n}, 4, 4) or ({n}, K, 4, 4)")
    )
    hand, of_hand = "trials.T_world_hand", f"a torch tensor ({n}, 4, 4) of torch.float32"
    T_world_hand = check_tensor(hand, trials.T_world_hand, of_hand)
    if T_world_hand.dtype != torch.float32:
        raise TypeError(f"{hand} is {T_world_hand.dtype}; it must be torch.float32: call .float()")
    for name, value, expected in (
        ("T_obj_ee", T_obj_ee, shape),
        (second, T_world_ee, shape),
        (hand, T_world_hand, (n, 4, 4)),
    ):
        if value.shape != expected:
            allowed = words if name == "T_obj_ee" else str(tuple(expected))
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}; with {n} trials it must be {allowed}"
            )
        if value.device.type != device.type:
            raise ValueError(
                f"{name} is on {value.device}, the evaluator on {device}: move one of them"
            )
    # an id is what the planner's random numbers are keyed by: in 32 bits it would be another one
    for name, dtype in (
        ("trial_id", torch.int64),
        ("object_index", torch.int32),
        ("hand_index", torch.int32),
    ):
        index = getattr(trials, name)
        check_tensor(f"trials.{name}", index, f"a torch tensor ({n},) of {dtype}")
        if index.shape != (n,) or index.dtype != dtype or index.device.type != device.type:
            raise ValueError(
                f"trials.{name} is {index.dtype} {tuple(index.shape)} on {index.device}; "
                f"it must be {dtype} ({n},) on {device}"
            )
    if not torch.compiler.is_compiling() and any(x.is_neg() for x in trials._tensors().values()):
        trials = trials._changed(Tensor.resolve_neg)
    if many:
        T_obj_ee, T_world_ee = T_obj_ee.reshape(n * k, 4, 4), T_world_ee.reshape(n * k, 4, 4)
        trials = repeated(trials, k)
    return T_obj_ee, T_world_ee, trials


class KnownInputs:
    """Lets inputs pass that are laid out as those that `checked_inputs` found right and returned as
    they were: in a training loop mostly all."""

    def __init__(self) -> None:
        self._last: tuple[Any, TensorLayoutGuard, list[int]] | None = None

    def checked(
        self, scene: Scene, T_obj_ee: Any, T_world_ee: Any, trials: Trials, stages: Stages
    ) -> tuple[Tensor, Tensor, Trials]:
        """As `checked_inputs`."""
        compiling = torch.compiler.is_compiling()
        tensors: list[Any] = []
        if type(trials) is Trials and not compiling:
            tensors = [T_obj_ee, T_world_ee, *vars(trials).values()]
            tensors = [x for x in tensors if type(x) is Tensor]
            if self._knows(stages, tensors):
                return T_obj_ee, T_world_ee, trials
        found = checked_inputs(scene, T_obj_ee, T_world_ee, trials, stages)
        same = found[0] is T_obj_ee and found[1] is T_world_ee and found[2] is trials
        if same and tensors and not compiling:
            self._last = stages, TensorLayoutGuard(tensors), [_span(x) for x in tensors]
        return found

    def _knows(self, stages: object, tensors: list[Tensor]) -> bool:
        last = self._last
        if (
            last is None
            or not isinstance(stages, str)
            or last[0] != stages
            or len(last[2]) != len(tensors)
        ):
            return False
        # a guard ends the process on a nested tensor
        return (
            all(map(_in_memory, tensors))
            and last[1](tensors)
            and all(map(_holds, tensors, last[2]))
        )


def _in_memory(x: Tensor) -> bool:
    """Whether a tensor has memory of its own: sparse, nested and torch.func's tensors have none."""
    try:
        return x.layout == torch.strided and not x.is_nested and x.data_ptr() != 0
    except RuntimeError:
        return False


def _span(x: Tensor) -> int:
    """Bytes from a tensor's first number to the end of its last one."""
    last = sum((n - 1) * step for n, step in zip(x.shape, x.stride(), strict=True))
    return (last + 1) * x.element_size() if x.numel() else 0


def _holds(x: Tensor, span: int) -> bool:
    """Whether a tensor's memory has so many bytes: it may have been freed or shrunk."""
    return x.storage_offset() * x.itemsize + span <= x.untyped_storage().nbytes()


def check_benchmark(benchmark: Benchmark, trials: Trials) -> None:
    """Raises ValueError for trials that say that they are of another benchmark: their objects and hands are others, or stand
    elsewhere."""
    name, _, digest = trials.benchmark.rpartition("@")
    if digest and digest != benchmark.digest:
        ours, theirs = benchmark.digest[:8], digest[:8]
        raise ValueError(
            f"these trials are of benchmark {name} ({theirs}), and {benchmark.name} ({ours}) is judged here; take trials of"
            " evaluator.benchmark.trials(...), or an Evaluator of the benchmark that drew them"
        )


def check_receiver(config: EvalConfig, trials: Trials) -> None:
    """Raises ValueError where `receiver="body"` and trials have none, or one that is no body."""
    if trials.receiver is not None:
        check_tensor(
            "trials.receiver", trials.receiver, f"None or a torch tensor ({len(trials)}, 5, 4)"
        )
    if trials.receiver is not None and (
        trials.receiver.shape != (len(trials), 5, 4)
        or trials.receiver.dtype != torch.float32
        or trials.receiver.device != trials.T_world_hand.device
    ):
        found = trials.receiver
        raise ValueError(
            f"trials.receiver is {found.dtype} {tuple(found.shape)} on {found.device}; it must be torch.float32"
            f" ({len(trials)}, 5, 4) on {trials.T_world_hand.device}"
        )
    if config.receiver != "body":
        return
    if trials.receiver is None:
        raise ValueError(
            "receiver is 'body', these trials have none; take a benchmark of people, or receiver='hand'"
        )
    found = trials.receiver
    if found.is_cpu and not torch.compiler.is_compiling():  # a malformed receiver never collides
        fine = (found > _LEAST) & (found < MOST_M)
        if not bool(fine.all()):
            row = int(fine.flatten(1).all(1).int().argmin())
            raise ValueError(
                f"trials.receiver of row {row} has NaN, infinity or a number beyond {MOST_M:g} m, or a size that"
                " is not above 0; take a benchmark of people, or receiver='hand'"
            )


def check_asks(benchmark: Benchmark, config: EvalConfig) -> None:
    """Raises ValueError for errors of execution or of the object's pose where Pick is asked for: it takes grasps as they are."""
    for section in ("execution_error", "object_errors"):
        if benchmark.asks and getattr(config, section).any:
            raise ValueError(
                f"{section} changes poses, and {benchmark.name} asks for Pick, which takes grasps as they are; leave the errors"
                " out, or take r2h-v2"
            )


def check_stages(stages: object) -> None:
    """Raises ValueError for a word that names no stages."""
    one_of(*get_args(Stages))("stages", stages)


def warn_of_doubts(T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> None:
    """Says what looks wrong with the poses (`predictions.doubts`): other units, transposed or
    exchanged matrices."""
    for line in doubts(Predictions(trials.trial_id, T_obj_ee, T_world_ee).clone()):
        warnings.warn(line, stacklevel=3)


def warn_of_payload(scene: Scene) -> None:
    """Says which objects are heavier than what the arm carries beside its gripper."""
    robot, heaviest = scene.robot, max(scene.objects, key=lambda o: o.mass)
    if heaviest.mass > robot.carries_kg:
        count = sum(o.mass > robot.carries_kg for o in scene.objects)
        warnings.warn(
            f"{count} of {len(scene.objects)} objects are heavier than the {robot.carries_kg:.2f} kg that {robot.name} carries"
            f" (payload {robot.payload_kg:g} kg, gripper {robot.linkage.mass_kg:g} kg): {heaviest.name} has"
            f" {heaviest.mass:.2f} kg; no verdict says so",
            stacklevel=3,
        )


@cache
def warn_of_no_gradient() -> None:
    """Says once in a process that poses of a full call wait for a gradient in vain."""
    warnings.warn(
        'stages is "all": a path has no gradient, so none leads back to T_obj_ee, T_world_ee; score with stages="pose"',
        stacklevel=3,
    )


def check_indices(scene: Scene, trials: Trials) -> None:
    """Raises ValueError for an object or hand outside the scene; on CUDA looking at them would wait
    for the device.

    There rows with such an index become INVALID_INPUT.
    """
    for name, index, count in (
        ("object_index", trials.object_index, len(scene.objects)),
        ("hand_index", trials.hand_index, len(scene.hands.set)),
    ):
        check_range(f"trials.{name}", index, count, "the scene")


def repeated(trials: Trials, k: int) -> Trials:
    """Each trial k times in turn: the rows of (N, k) candidates."""
    rows = {
        name: x[:, None].expand(-1, k, *x.shape[1:]).reshape(-1, *x.shape[1:])
        for name, x in trials._tensors().items()
    }
    return replace(trials, **rows)
