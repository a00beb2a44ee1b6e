"""How near the robot comes to the receiver's arm and torso: reported beside Safe, or part of it (`EvalConfig.receiver`)."""

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M, Thresholds
from r2h_batch.judge.metrics import SAFE_TOLERANCE_M, Criterion, Touch
from r2h_batch.kernels.judge.overlap import path_overlap
from r2h_batch.kernels.plan.lines import path_clearance
from r2h_batch.launch import launch_trials
from r2h_batch.scene.person import with_person
from r2h_batch.scene.scene import Placed, Scene

__all__ = ["person_distance", "with_body"]


def person_distance(
    scene: Scene,
    placed: Placed,
    receiver: Float32[Tensor, "b 5 4"],
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    *,
    threads: int | None = None,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """Smallest distance of the robot (without the object) from forearm, upper arm and torso along each path; the robot's body.

    Metres, located to 0.02 mm, exact below 5 cm, a lower bound (5 cm, body -1) above; NaN and -1 without a path. Where they
    meet: minus the way out of the deepest overlap found, as a sampled path's margin of Plan is (kernels/judge/overlap.py).
    """
    b, device = len(length), path.device
    distance = torch.full((b,), torch.nan, dtype=torch.float32, device=device)
    body = torch.full((b,), -1, dtype=torch.int32, device=device)
    pair = torch.zeros(b, dtype=torch.int32, device=device)
    alone = with_person(scene, placed, receiver, hand=False)
    tables = {"world": alone.tables(scene), "bodies": alone.bodies}
    path, length = path.contiguous(), length.contiguous()
    launch_trials(
        path_clearance,
        b,
        inputs={
            "cap": CLEARANCE_CAP_M,
            "tolerance": SAFE_TOLERANCE_M,
            **tables,
            "path": path,
            "length": length,
        },
        outputs={"clearance": distance, "pair": pair, "body": body},
        device=scene.device,
        threads=threads,
        chunk=8,
    )
    meets = torch.nonzero((length > 0) & (distance < 0)).flatten().to(torch.int32)
    launch_trials(
        path_overlap,
        len(meets),
        inputs={"hull_ball": scene.hull_balls, **tables, "row": meets, "path": path, "length": length},
        outputs={"clearance": distance, "pair": pair, "body": body},
        device=scene.device,
        threads=threads,
        chunk=1,
    )
    return distance, body


def with_body(
    safe: Criterion,
    touch: Touch,
    distance: Float32[Tensor, " b"],
    body: Int32[Tensor, " b"],
    thresholds: Thresholds,
) -> tuple[Criterion, Touch]:
    """Safe of hand and body: the smaller margin. Where the body is nearer the witness is the robot's part alone.

    `distance` as `Scores.body_m`: less what the motion may have been off the lines between its samples.
    """
    own = Criterion.of(distance - thresholds.safe_margin_m, safe.evaluated, touching_passes=False)
    nearer: Bool[Tensor, " b"] = own.margin < safe.margin
    margin = torch.where(nearer, own.margin, safe.margin)
    point = torch.where(nearer[:, None], torch.nan, touch.point)
    # the moment stays the hand's nearest: none is known of the body's
    part = torch.where(nearer, body, touch.body)
    found = Criterion(margin, safe.passed & own.passed, safe.evaluated)
    return found, Touch(part, touch.segment, touch.fraction, point)
