"""Slopes of the evaluator's margins along twists: by its gradients, and by differences of its own numbers, asked one by one."""

import torch
from problems import Batch, make_batch

from r2h_batch.base import se3, twist
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.calls.gradients import STEEPEST, STEP_M, STEP_RAD
from r2h_batch.types import Scores

STEPS = torch.tensor(([STEP_M] * 3 + [STEP_RAD] * 3) * 2)
"""Half of each difference, m and rad."""


def candidates(evaluator: Evaluator, n: int, *, seed: int = 3) -> Batch:
    """Random and sensible predictions, with grasps that are a few millimetres and degrees off the stored ones."""
    batch = make_batch(evaluator.scene, n, seed=seed)
    g = torch.Generator().manual_seed(seed)
    jitter = torch.randn((n, 6), generator=g) * torch.tensor([0.004] * 3 + [0.15] * 3)
    T_obj_ee = se3.orthonormalise(twist.retract(batch.T_obj_ee, jitter)).contiguous()
    return Batch(batch.trials, T_obj_ee, se3.orthonormalise(batch.T_world_ee).contiguous())


def gradients(evaluator: Evaluator, batch: Batch) -> tuple[Scores, torch.Tensor]:
    """Scores with gradients, and the margins' slopes (B, C, 12) along twists (m and rad)."""
    poses = batch.T_obj_ee.clone().requires_grad_(), batch.T_world_ee.clone().requires_grad_()
    scores = evaluator.score(*poses, batch.trials, stages="pose")
    rows = []
    for c in range(scores.margin.shape[1]):
        chosen = torch.where(scores.evaluated[:, c], scores.margin[:, c], 0.0).sum()
        found = torch.autograd.grad(chosen, poses, retain_graph=True)
        rows.append(torch.cat([twist.tangent(T.detach(), d) for T, d in zip(poses, found, strict=True)], 1))
    return scores, torch.stack(rows, 1)


def measured_slopes(evaluator: Evaluator, batch: Batch) -> torch.Tensor:
    """Differences of the margins (B, C, 12) along twists, per m and rad, within what a gradient says at most."""
    n, found = len(batch), []
    for j in range(12):
        sides = []
        for sign in (1.0, -1.0):
            xi = torch.zeros(12)
            xi[j] = sign * STEPS[j]
            poses = (
                twist.retract(T, part.expand(n, 6)).contiguous()
                for T, part in zip((batch.T_obj_ee, batch.T_world_ee), xi.split(6), strict=True)
            )
            scores = evaluator.score(*poses, batch.trials, stages="pose")
            sides.append(torch.where(scores.evaluated, scores.margin, 0.0).double())
        change = (sides[0] - sides[1]) / (2 * float(STEPS[j]))
        found.append(torch.where(change.isfinite(), change.clamp(-STEEPEST, STEEPEST), 0.0))
    return torch.stack(found, -1)
