"""Margins that can be differentiated: the evaluator's own numbers forward, its own differences backward.

The backward pass nudges each pose along the six twists of the ee frame, forward and back, and asks the evaluator for the
margins again: 12 rows for a row and a pose that asks. So every criterion has a gradient on every benchmark, one of another
package too. The steps are as large as those of a search: a margin is a minimum over many bodies, and its slope at a point says
little about the way out.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from r2h_batch.base import se3, twist
from r2h_batch.base.launch.threads import one_torch_thread
from r2h_batch.types import Scores, Trials
from r2h_batch.verdicts import UNITS

STEP_M, STEP_RAD = 3e-3, 3e-2
"""Half the length of a difference [choice]: a step of gradient ascent is about as long (docs/training_loop.md)."""

STEEPEST = 1.5
"""Margins change by no more for a metre, or for a radian [choice]: no body of the gripper is much faster than the ee. Where a
search finds another posture, margins jump."""

ROWS = 4096
"""Rows whose neighbours are judged together: bounds the memory, whatever the batch."""

Judge = Callable[[Tensor, Tensor, Trials], Scores]
"""The pose stage of B rows, without gradients."""


def asks_gradients(*poses: Tensor) -> bool:
    """Whether margins need gradients with respect to these poses."""
    return torch.is_grad_enabled() and any(T.requires_grad for T in poses)


def differentiable(
    judge: Judge, scores: Scores, poses: tuple[Tensor, Tensor], trials: Trials
) -> Scores:
    """`scores` of stages="pose", bit for bit, with margins that lead back to the two poses.

    Args:
        judge: what made them.
        scores: of B rows.
        poses: (B, 4, 4) T_obj_ee and T_world_ee as they were given, with their history, m.
        trials: B trials.
    """
    first_order_only = (FirstOrderOnly.apply(T) for T in poses)
    margin: Tensor = _ByDifferences.apply(
        *first_order_only, scores.margin, scores.evaluated, judge, trials
    )
    return replace(scores, margin=margin)


def by_differences(
    judge: Judge,
    poses: tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b 4 4"]],
    trials: Trials,
    gradient: Float32[Tensor, "b c"],
    asks: tuple[bool, bool] = (True, True),
) -> tuple[Tensor | None, Tensor | None]:
    """Gradient with respect to the entries (B, 4, 4) of the poses. Rows that nobody asks for are not judged, and have zeros.

    Args:
        judge: the pose stage.
        poses: T_obj_ee and T_world_ee, m.
        trials: B trials.
        gradient: with respect to the margins; 0 for those that were not evaluated.
        asks: which of the two poses wants one; None for the other.
    """
    wanted = [k for k in range(2) if asks[k]]
    made = {k: torch.zeros_like(poses[k]) for k in wanted}
    with one_torch_thread(poses[0].device):
        both = torch.stack([T.detach().float() for T in poses], 1)
        for rows in torch.nonzero(gradient.any(1)).flatten().split(ROWS):
            slopes = _slopes(judge, both[rows], trials[rows], gradient[rows], wanted)
            found = _of_entries(both[rows][:, wanted], slopes)
            for i, k in enumerate(wanted):
                made[k][rows, :3] = found[:, i].to(made[k].dtype)
    return made.get(0), made.get(1)


def _slopes(
    judge: Judge,
    both: Float32[Tensor, "n 2 4 4"],
    trials: Trials,
    gradient: Float32[Tensor, "n c"],
    wanted: list[int],
) -> Float32[Tensor, "n w 6"]:
    """How what is differentiated changes along each twist of each wanted pose, per m and per rad."""
    n, device, asking = len(both), both.device, len(wanted)
    half = torch.tensor([STEP_M] * 3 + [STEP_RAD] * 3, dtype=torch.float32, device=device)
    ways = torch.stack([half.diag(), -half.diag()])
    unmoved = torch.eye(4, dtype=torch.float32, device=device).expand(2, 6, 4, 4)
    nudges = twist.retract(unmoved, ways).expand(n, 2, 6, 4, 4)
    # (n, wanted, 2 ways, 6 twists, 2 poses, 4, 4): one of the two poses is nudged
    nudged = both[:, None, None, None].repeat(1, asking, 2, 6, 1, 1, 1)
    for i, k in enumerate(wanted):
        nudged[:, i, :, :, k] = se3.matmul(nudged[:, i, :, :, k], nudges)
    asked = nudged.view(n * asking * 12, 2, 4, 4)
    of_rows = torch.arange(n, dtype=torch.int64, device=device).repeat_interleave(asking * 12)
    scores = judge(asked[:, 0].contiguous(), asked[:, 1].contiguous(), trials[of_rows])
    margin = torch.where(scores.evaluated, scores.margin, 0.0)
    margin = margin.view(n, asking, 2, 6, gradient.shape[1])
    change = (margin[:, :, 0] - margin[:, :, 1]).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    total = torch.zeros((n, asking, 6), dtype=torch.float32, device=device)
    for c in range(change.shape[-1]):  # in a fixed order: the same bits at any batch size
        worth_m = UNITS[scores.entries[c].unit].worth_m
        most = 2 * half * STEEPEST / worth_m
        slope = torch.minimum(torch.maximum(change[..., c], -most), most)
        total = total + slope * gradient[:, c, None, None]
    return total / (2 * half)


def _of_entries(
    poses: Float32[Tensor, "n w 4 4"], slopes: Float32[Tensor, "n w 6"]
) -> Float32[Tensor, "n w 3 4"]:
    """The gradient with respect to the poses' upper three rows whose part along twists is `slopes`: R v
    for the place, R [w] / 2 for the rotation."""
    v, w = slopes[..., :3], slopes[..., 3:]
    axes = torch.eye(3, dtype=torch.float32, device=poses.device)
    turn = torch.stack([se3.cross(0.5 * w, axis.expand_as(w)) for axis in axes], -1)
    return se3.matmul(poses[..., :3, :3], torch.cat([turn, v[..., None]], -1))


class _ByDifferences(torch.autograd.Function):
    """The margins, bit for bit."""

    @staticmethod
    def forward(
        ctx: Any,
        T_obj_ee: Float[Tensor, "b 4 4"],
        T_world_ee: Float[Tensor, "b 4 4"],
        margin: Float32[Tensor, "b c"],
        evaluated: Bool[Tensor, "b c"],
        judge: Judge,
        trials: Trials,
    ) -> Tensor:
        # copies: an optimizer's step in place may come before the way back
        ctx.asked = judge, (T_obj_ee.clone(), T_world_ee.clone()), trials, evaluated
        return margin.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradient: Tensor) -> tuple[Tensor | None, ...]:
        judge, poses, trials, evaluated = ctx.asked
        of_margins = torch.where(evaluated, gradient[0], 0.0)
        asks = ctx.needs_input_grad[0], ctx.needs_input_grad[1]
        return *by_differences(judge, poses, trials, of_margins, asks), None, None, None, None


class FirstOrderOnly(torch.autograd.Function):
    """The same poses, with a gradient that cannot be differentiated again.

    Differences are no function of the poses that torch knows. (`once_differentiable` lets second derivatives pass, as zeros,
    where the incoming gradient is a constant.)
    """

    @staticmethod
    def forward(ctx: Any, T: Tensor) -> Tensor:
        ctx.save_for_backward(T)
        return T.view_as(T)

    @staticmethod
    def backward(ctx: Any, *gradient: Tensor) -> Tensor:
        if not torch.is_grad_enabled():
            return gradient[0]
        refusing: Tensor = _Refusing.apply(gradient[0], *ctx.saved_tensors)
        return refusing


class _Refusing(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gradient: Tensor, T: Tensor) -> Tensor:
        return gradient.clone()

    @staticmethod
    def backward(ctx: Any, *gradient: Tensor) -> tuple[Tensor, Tensor]:
        raise RuntimeError(
            "margins have first derivatives only: score without create_graph, or by finite differences"
        )
