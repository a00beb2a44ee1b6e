"""Which motions of the arm alone are those of the whole scene: the ones in which nothing that could
push came to touch.

The scene's contacts push between links, between gripper or links and the table, and between object
and arm, never at the hand (`scene/model.py`). While no such pair touches, the scene's equations of
motion are the arm's own but for the fingers, which give way within FINGER_GIVE_M. So it is enough
that along the motion as it was simulated, samples and the lines between them, every such pair keeps
more than both its bodies may be off those lines: at the first step at which a contact could push,
the arm would still stand where it stood alone, and there nothing touches.
"""

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.kernels.plan.lines import path_clearance
from r2h_batch.launch import launch_trials
from r2h_batch.scene.scene import BodyPoses, Scene

__all__ = ["FINGER_GIVE_M", "nothing_pushes"]

FINGER_GIVE_M = 1.2e-5
"""A bound on how far the fingers of the whole scene give way in a motion without contacts, and how
far its arm is off the arm alone: twice the most that was seen (`bench/execute.py --ask models`:
execute.models.finger_sway_max_um)."""

NEAR_M = 1e-3
"""Clearance beyond this is not measured: no simulated motion is ever this far off its samples'
lines."""

LOCATED_M = 1e-5
"""How exactly the clearance is located."""


def nothing_pushes(
    scene: Scene,
    body_poses: BodyPoses,
    motion: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    off_m: Float32[Tensor, " b"],
    *,
    threads: int | None = None,
) -> Bool[Tensor, " b"]:
    """Whether no pair whose contacts push can have touched in B recorded motions (rows of length 0:
    False).

    `off_m`: how far any point of robot or object was off the joint lines between the samples, at
    most. Certified: the lines are walked as planned paths are, over all pairs but the hand's
    (object and table, which do not push, are counted).
    """
    b, device = len(length), motion.device
    clearance = torch.full((b,), -torch.inf, dtype=torch.float32, device=device)
    pair = torch.zeros(b, dtype=torch.int32, device=device)
    body = torch.full((b,), -1, dtype=torch.int32, device=device)
    launch_trials(
        path_clearance,
        b,
        inputs={
            "cap": NEAR_M,
            "tolerance": LOCATED_M,
            "world": scene.world_without_hand,
            "bodies": body_poses.bodies,
            "path": motion.contiguous(),
            "length": length.contiguous(),
        },
        outputs={"clearance": clearance, "pair": pair, "body": body},
        device=scene.device,
        threads=threads,
        chunk=1,
        uneven=True,
    )
    return clearance - LOCATED_M > 2.0 * off_m
