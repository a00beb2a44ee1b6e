"""Margins that can be differentiated: the evaluator's own numbers forward, first-order changes at
the witnesses backward.

Where margins have kinks: docs/gradients.md. A witness attains a margin, and its motion gives the change
to first order (Danskin):

    Stability, width      the two outermost points of material between the pads; on a wall of the pads'
                          prism, where that wall cuts the surface. Of T_obj_ee; the opening is the
                          fixed point of width and pad height
    Stability, clearance  the object's point nearest to, or deepest in, a primitive of the open gripper
    Reach                 the object's point nearest to c_h. Of both poses, and how closing shifts the object
    Affordance            nearest points of finger and receiver's region. Of T_obj_ee, shift and opening
    Plan, goal            the nearest pair at the goal and its separating direction. Object and gripper
                          move with the ee frame, arm links with the inverse Jacobian of the branch, or
                          the pseudo-inverse
    Plan, unreachable     the residual in closed form: wrist centre out of reach, or too near to the
                          base's axis. Arms without a closed form: what the nearest posture misses
    Plan, start           the nearest pair at home. Of T_obj_ee
    Safe                  nearest points of the hand's mesh and a robot primitive at the goal; as Plan
    Pick, grasp           nearest points of the open gripper, table and person. Of T_obj_ee
    Pick, unreachable     as Plan, of the grasp where the object rests
    any other criterion   torch follows the poses through its function in judge/metrics.py
"""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import cpu_threads, over_trials
from r2h_batch.base.launch.threads import on_threads, one_torch_thread
from r2h_batch.base.soft import with_gradient
from r2h_batch.config import EvalConfig
from r2h_batch.judge import metrics
from r2h_batch.judge.attach import ROWS_CHUNK, AttachedBatch
from r2h_batch.judge.distance import NearestApproach
from r2h_batch.judge.goal import Goal
from r2h_batch.kernels.witness.change import poses_gradient
from r2h_batch.scene.scene import Scene
from r2h_batch.training import first_order, witnesses
from r2h_batch.types import CRITERIA, Scores

FOLLOWED = tuple(name for name in CRITERIA if name not in first_order.WITNESSED)
"""Criteria without witnesses: torch follows the poses through their functions."""


def changes(
    scene: Scene,
    config: EvalConfig,
    found: dict[str, Tensor],
    held: AttachedBatch,
    goal: Goal,
    pick: Float32[Tensor, "b 4 4"] | None = None,
) -> first_order.Changes:
    """How the margins of B poses change around them; kernels alone.

    Args:
        scene: robot, objects and hands.
        config: limits.
        found: fields of `Scores` of the poses.
        held: B trials.
        goal: their goals.
        pick: (B, 4, 4) of Pick's margin, by T_obj_ee (`pick_change`); None: the benchmark does not ask for it.
    """
    decided_by = witnesses.find(scene, config, found, held, goal)
    made = first_order.changes_at(scene, found, held, goal, decided_by)
    if pick is None:
        return made
    margin = torch.zeros((*found["margin"].shape, 2, 4, 4), dtype=torch.float32, device=pick.device)
    margin[:, : len(CRITERIA)] = made.margin
    margin[:, len(CRITERIA), 0] = pick
    return replace(made, margin=margin)


def differentiable(
    scene: Scene,
    config: EvalConfig,
    scores: Scores,
    poses: tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b 4 4"]],
    change: first_order.Changes,
    held: AttachedBatch,
    goal: Goal,
    nearest: NearestApproach,
) -> Scores:
    """`scores` of stages="pose", bit for bit, with margins that lead back to the two poses; rows
    that are no poses do not.

    Args:
        scene: robot, objects and hands.
        config: limits.
        scores: of B poses.
        poses: T_obj_ee and T_world_ee as they were given, with their history.
        change: `changes`.
        held: B trials.
        goal: their goals.
        nearest: where the robot comes nearest to the receiver.
    """
    first_order_only = [FirstOrderOnly.apply(T) for T in poses]
    moved: Tensor = _Moved.apply(*first_order_only, change.margin, scores.evaluated, scene.device)
    if FOLLOWED:
        slip_m = scores.slip_m.double() if config.stability == "physics" else None
        active = held.active[:, None, None]
        T_obj_ee, T_world_ee = (
            torch.where(active, T, clean)
            for T, clean in zip(first_order_only, (held.T_obj_ee, held.T_world_ee), strict=True)
        )
        # closing shifts the object along the ee's y
        shift = (change.shift * (T_obj_ee - T_obj_ee.detach())).sum((1, 2)) + held.grasp.shift_m
        R, p = T_obj_ee[:, :3, :3], T_obj_ee[:, :3, 3]
        attached = se3.from_rotation(R, p + R[:, :, 1] * shift[:, None])
        evidence = metrics.Evidence(
            scene,
            config,
            replace(held, T_obj_ee=T_obj_ee, T_world_ee=T_world_ee, attached=attached),
            goal.free,
            held.active,
            goal.clearance_m,
            goal.reason,
            nearest,
            slip_m,
        )
        zero = torch.zeros_like(scores.margin[:, 0])
        followed = [metrics.margin_of(k, evidence) if k in FOLLOWED else zero for k in CRITERIA]
        followed += [zero] * (scores.margin.shape[1] - len(CRITERIA))
        moved = moved + torch.where(scores.evaluated, torch.stack(followed, 1), 0.0)
    return replace(scores, margin=with_gradient(scores.margin, moved))


class _Moved(torch.autograd.Function):
    """Zeros (B, C) that change with two poses as margins do."""

    @staticmethod
    def forward(
        ctx: Any,
        T_obj_ee: Tensor,
        T_world_ee: Tensor,
        change: Float32[Tensor, "b c 2 4 4"],
        evaluated: Bool[Tensor, "b c"],
        device: str,
    ) -> Tensor:
        ctx.save_for_backward(change, evaluated)
        ctx.device, ctx.dtypes = device, (T_obj_ee.dtype, T_world_ee.dtype)
        ctx.threads = (
            cpu_threads()
        )  # `backward` is called outside of the evaluator, on a thread of torch's choice
        return torch.zeros_like(evaluated, dtype=change.dtype)

    @staticmethod
    def backward(ctx: Any, *gradient: Tensor) -> tuple[Tensor | None, ...]:
        change, evaluated = ctx.saved_tensors
        with one_torch_thread(ctx.device), on_threads(ctx.threads):
            made = over_trials(poses_gradient, len(change), ctx.device, chunk=ROWS_CHUNK)(
                gradient=gradient[0].detach().contiguous(), change=change, evaluated=evaluated
            )
        dtypes = ctx.dtypes
        return made["T_obj_ee"].to(dtypes[0]), made["T_world_ee"].to(dtypes[1]), None, None, None


class FirstOrderOnly(torch.autograd.Function):
    """The same poses, with a gradient that cannot be differentiated again.

    `changes` is right to first order only: of its own second derivatives one would learn nothing
    about the margins. (`once_differentiable` would let them pass where the incoming gradient is a
    constant.)
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
