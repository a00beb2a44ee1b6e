"""Slopes of the evaluator's margins: by its gradients, and by finite differences of its own float32 numbers."""

from dataclasses import dataclass

import torch
from problems import Batch, make_batch

from r2h_batch.base import se3, twist
from r2h_batch.evaluate import Evaluator
from r2h_batch.types import Scores

LEVER_M = 0.05
"""Slopes per radian are compared times this: they then are of order 1, like those per metre."""

STEPS = torch.tensor(([1e-4] * 3 + [1e-3] * 3) * 2)
"""Steps of the differences, m and rad."""
SCALE = torch.tensor(([1.0] * 3 + [LEVER_M] * 3) * 2)


@dataclass(frozen=True)
class Slopes:
    """Scores (without gradients), and slopes (B, 5, 12) along the twists of T_obj_ee and T_world_ee, scaled by SCALE."""

    scores: Scores
    gradient: torch.Tensor
    measured: torch.Tensor
    bend: torch.Tensor  # how far slopes to both sides differ: large at kinks
    same_reason: torch.Tensor  # Plan's reason is the same in all of these poses

    def smooth(self, criterion: int) -> torch.Tensor:
        """Rows (B,) whose margin has no kink within the steps of the differences."""
        finite = torch.isfinite(self.measured[:, criterion]).all(1)
        flat = self.bend[:, criterion].amax(1) < 0.02
        return self.scores.evaluated[:, criterion] & finite & flat & self.same_reason

    def error(self, criterion: int) -> torch.Tensor:
        """Largest difference (B,) of any slope."""
        return (self.gradient - self.measured)[:, criterion].abs().amax(1)

    def plateau(self, criterion: int) -> torch.Tensor:
        """Rows (B,) whose margin does not change: capped, or as deep as that number goes (depths are known to 5 um)."""
        least = torch.where(self.scores.margin[:, criterion] < 0, 0.03, 1e-3)
        return self.measured[:, criterion].abs().amax(1) < least


def candidates(evaluator: Evaluator, n: int, *, seed: int = 3) -> Batch:
    """Random and sensible predictions, with grasps that are a few millimetres and degrees off the stored ones."""
    batch = make_batch(evaluator.scene, n, seed=seed)
    g = torch.Generator().manual_seed(seed)
    jitter = torch.randn((n, 6), generator=g) * torch.tensor([0.004] * 3 + [0.15] * 3)
    T_obj_ee = se3.orthonormalise(twist.retract(batch.T_obj_ee, jitter)).contiguous()
    return Batch(batch.trials, T_obj_ee, se3.orthonormalise(batch.T_world_ee).contiguous())


def gradients(evaluator: Evaluator, batch: Batch) -> tuple[Scores, torch.Tensor]:
    """Scores with gradients, and the margins' slopes (B, 5, 12) along twists (m and rad)."""
    poses = batch.T_obj_ee.clone().requires_grad_(), batch.T_world_ee.clone().requires_grad_()
    scores = evaluator.score(*poses, batch.trials, stages="pose")
    rows = []
    for c in range(5):
        chosen = torch.where(scores.evaluated[:, c], scores.margin[:, c], 0.0).sum()
        found = torch.autograd.grad(chosen, poses, retain_graph=True)
        rows.append(torch.cat([twist.tangent(T.detach(), d) for T, d in zip(poses, found, strict=True)], 1))
    return scores, torch.stack(rows, 1)


def measured_slopes(evaluator: Evaluator, batch: Batch) -> Slopes:
    """Both kinds of slopes of all margins; 25 calls of the evaluator."""
    n = len(batch)
    scores = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages="pose")
    _, gradient = gradients(evaluator, batch)
    measured, bend = torch.zeros(n, 5, 12), torch.zeros(n, 5, 12)
    same = torch.ones(n, dtype=torch.bool)
    for j in range(12):
        xi = torch.zeros(12)
        xi[j] = STEPS[j]
        ahead, behind = (
            evaluator.score(
                twist.retract(batch.T_obj_ee, (sign * xi[:6]).expand(n, 6)).contiguous(),
                twist.retract(batch.T_world_ee, (sign * xi[6:]).expand(n, 6)).contiguous(),
                batch.trials,
                stages="pose",
            )
            for sign in (1.0, -1.0)
        )
        scale = SCALE[j] / STEPS[j]
        measured[:, :, j] = (ahead.margin - behind.margin) * (0.5 * scale)
        bend[:, :, j] = (ahead.margin + behind.margin - 2 * scores.margin).abs() * scale
        same &= (ahead.plan_reason == scores.plan_reason) & (behind.plan_reason == scores.plan_reason)
    return Slopes(scores, gradient * SCALE, measured, bend, same)
