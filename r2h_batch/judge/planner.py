"""Runs the planning kernels of a scene for both its stages, the straight lines and the searches."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.config import CLEARANCE_CAP_M, CLEARANCE_TOLERANCE_M
from r2h_batch.kernels.plan.lines import check_postures, path_clearance, straight_lines
from r2h_batch.scene.scene import BodyPoses, Scene


class Planner:
    """Runs planning kernels, which all take the scene's world and the trials' bodies."""

    def __init__(self, scene: Scene, body_poses: BodyPoses) -> None:
        self._tables = {"world": body_poses.tables(scene), "bodies": body_poses.bodies}
        self._device, self._sized = scene.device, scene.sized
        self.joint_weight = scene.robot.joint_weight

    def __call__(
        self, kernel: Any, n: int, *, inputs: dict[str, Any], outputs: dict[str, Any], chunk: int
    ) -> None:
        self._over(kernel, n, chunk, outputs)(**inputs)

    def _over(
        self, kernel: Any, n: int, chunk: int, outputs: dict[str, Any] | None = None
    ) -> Callable[..., Any]:
        """`over_trials` with the world and the bodies."""
        kernel = self._sized(kernel)
        return partial(
            over_trials(kernel, n, self._device, outputs=outputs, chunk=chunk, uneven=True),
            **self._tables,
        )

    def check(self, q: Tensor, active: Tensor, per_trial: int) -> tuple[Tensor, Tensor, Tensor]:
        """Free or not, the pair that collides, the hand clearance up to 6.5 mm; one row per
        posture."""
        made = self._over(check_postures, len(q), 64)(
            per_trial=per_trial, active=active.contiguous(), q=q.contiguous()
        )
        return made["clear"], made["pair"], made["hand_clearance"]

    def clearance(
        self,
        path: Tensor,
        length: Tensor,
        tolerance_m: float = CLEARANCE_TOLERANCE_M,
        without: float = -math.inf,
        cap_m: float = CLEARANCE_CAP_M,
    ) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"], Int32[Tensor, " b"]]:
        """Smallest clearance along each path over all pairs, at most `cap_m` (`without` one: that), its pair and the
        robot's body."""
        made = self._over(path_clearance, len(path), 8)(
            cap=cap_m, tolerance=tolerance_m, without=without, path=path, length=length
        )
        return made["clearance"], made["pair"], made["body"]

    def straight(
        self, start: Tensor, goals: Tensor, n_goals: Tensor, margin: Tensor, edge_mode: int
    ) -> Tensor:
        """Each row's first goal whose straight line from the start is free, or -1."""
        chosen = torch.full_like(n_goals, -1)
        inputs = {"edge_mode": edge_mode, "start": start, "goals": goals, "n_goals": n_goals}
        inputs |= {"goal_margin": margin.view(-1)}
        self(straight_lines, len(n_goals), inputs=inputs, outputs={"chosen": chosen}, chunk=8)
        return chosen
