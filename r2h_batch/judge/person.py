"""How near the robot comes to the receiver's arm and torso: reported beside Safe, or part of it
(`EvalConfig.receiver`)."""

from typing import Any

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M, Thresholds
from r2h_batch.judge.metrics import SAFE_TOLERANCE_M, Criterion, Touch
from r2h_batch.judge.wave.waves import Waves, in_waves
from r2h_batch.kernels.judge.overlap import path_overlap
from r2h_batch.kernels.plan.codes import WAYPOINTS
from r2h_batch.kernels.plan.lines import path_clearance
from r2h_batch.launch import launch_trials
from r2h_batch.scene.person import with_person
from r2h_batch.scene.scene import BodyPoses, Scene

__all__ = ["person_distance", "with_body"]

MOVED = 3
"""A motion recorded sample by sample has so many times the room of a path in the waves' queues."""


def person_distance(
    scene: Scene,
    body_poses: BodyPoses,
    receiver: Float32[Tensor, "b 5 4"],
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    *,
    threads: int | None = None,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """Smallest distance of the robot (without the object) from forearm, upper arm and torso along
    each path; the robot's body.

    Metres, located to 0.02 mm, exact below 5 cm, a lower bound (5 cm, body -1) above; NaN and -1
    without a path. Where they meet: minus the way out of the deepest overlap found, as a sampled
    path's margin of Plan is (kernels/judge/overlap.py).
    """
    alone = with_person(scene, body_poses, receiver, hand=False)
    tables = {"world": alone.tables(scene), "bodies": alone.bodies}
    motion = {"path": path.contiguous(), "length": length.contiguous()}
    on: dict[str, Any] = {"device": scene.device, "threads": threads}
    found, meets = _nearest(tables, motion, on)
    launch_trials(
        path_overlap,
        len(meets),
        inputs={"hull_ball": scene.hull_balls, **tables, "row": meets, **motion},
        outputs=found,
        chunk=1,
        **on,
    )
    return found["clearance"], found["body"]


def _nearest(
    tables: dict[str, Any], motion: dict[str, Tensor], on: dict[str, Any]
) -> tuple[dict[str, Tensor], Int32[Tensor, " m"]]:
    """Clearance, pair and body of each path, as far as bodies are apart, and the rows where they
    meet."""
    path, length = motion["path"], motion["length"]
    b, device = len(length), path.device
    if in_waves(on["device"]):
        waves = Waves(
            **tables, device=on["device"], rows=b if path.shape[1] <= WAYPOINTS else MOVED * b
        )
        distance, pair, body = waves.clearance(path, length, SAFE_TOLERANCE_M)
        meets = waves.rows_where((length > 0) & (distance < 0))
        distance = torch.where(length > 0, distance, torch.nan)
        return {
            "clearance": distance,
            "pair": pair,
            "body": torch.where(length > 0, body, -1),
        }, meets
    distance = torch.full((b,), torch.nan, dtype=torch.float32, device=device)
    body = torch.full((b,), -1, dtype=torch.int32, device=device)
    found = {
        "clearance": distance,
        "pair": torch.zeros(b, dtype=torch.int32, device=device),
        "body": body,
    }
    asked = {"cap": CLEARANCE_CAP_M, "tolerance": SAFE_TOLERANCE_M, **tables, **motion}
    launch_trials(path_clearance, b, inputs=asked, outputs=found, chunk=8, **on)
    return found, torch.nonzero((length > 0) & (distance < 0)).flatten().to(torch.int32)


def with_body(
    safe: Criterion,
    touch: Touch,
    distance: Float32[Tensor, " b"],
    body: Int32[Tensor, " b"],
    thresholds: Thresholds,
) -> tuple[Criterion, Touch]:
    """Safe of hand and body: the smaller margin. Where the body is nearer the witness is the
    robot's part alone.

    `distance` as `Scores.body_m`: less what the motion may have been off the lines between its
    samples.
    """
    own = Criterion.of(distance - thresholds.safe_margin_m, safe.evaluated, touching_passes=False)
    nearer: Bool[Tensor, " b"] = own.margin < safe.margin
    margin = torch.where(nearer, own.margin, safe.margin)
    point = torch.where(nearer[:, None], torch.nan, touch.point)
    # the moment stays the hand's nearest: none is known of the body's
    part = torch.where(nearer, body, touch.body)
    found = Criterion(margin, safe.passed & own.passed, safe.evaluated)
    return found, Touch(part, touch.segment, touch.fraction, point)
