"""How near the robot comes to the receiver: to the hand along a motion or at one posture, and to
arm and torso."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M
from r2h_batch.judge.frontier.levels import Frontier, uses_frontier
from r2h_batch.judge.frontier.safe import SafeFrontier
from r2h_batch.kernels.judge import safe as safe_kernels
from r2h_batch.kernels.judge.goal import goal_safe_distance
from r2h_batch.kernels.judge.overlap import hand_overlap, path_overlap
from r2h_batch.kernels.plan.codes import WAYPOINTS
from r2h_batch.kernels.plan.lines import path_clearance
from r2h_batch.launch import launch_trials
from r2h_batch.motion.execute import Executed
from r2h_batch.scene.person import with_person
from r2h_batch.scene.scene import BodyPoses, Scene

__all__ = [
    "SAFE_TOLERANCE_M",
    "NearestApproach",
    "hand_distance",
    "hand_distance_at",
    "nearer_of",
    "person_distance",
    "within_slack",
]

SAFE_TOLERANCE_M = 2e-5
"""How exactly the smallest distance over time is located."""

TOUCH_M = 1e-6
"""Bodies that meet have at most minus this as their distance."""

MOVED = 3
"""A motion recorded sample by sample has so many times the room of a path in the frontier's queues."""


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
    without a path. Where they meet: minus a lower bound of the deepest penetration depth found, as
    a sampled path's margin of Plan is (kernels/judge/overlap.py).
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
    if uses_frontier(on["device"]):
        frontier = Frontier(
            **tables, device=on["device"], rows=b if path.shape[1] <= WAYPOINTS else MOVED * b
        )
        distance, pair, body = frontier.clearance(path, length, SAFE_TOLERANCE_M)
        meets = frontier.rows_where((length > 0) & (distance < 0))
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


@dataclass(frozen=True)
class NearestApproach:
    """Where the robot comes nearest to the receiver, of B motions or postures."""

    distance_m: Float32[Tensor, " b"]  # below 0: they overlap; NaN where the robot does not move
    body: Int32[Tensor, " b"]  # of the robot (`Scene.part_names`); -1: farther than 5 cm
    segment: Int32[Tensor, " b"]  # of the path, and the fraction of it: the moment
    fraction: Float32[Tensor, " b"]
    point: Float32[Tensor, "b 3"]  # of the hand, world frame, m


def hand_distance(
    scene: Scene,
    body_poses: BodyPoses,
    executed: Executed,
    active: Bool[Tensor, " b"],
    *,
    threads: int | None = None,
) -> NearestApproach:
    """The smallest distance of the robot from the hand over each motion.

    The exact mesh of the hand against the primitives of the robot, without the object. Exact below
    5 cm and a lower bound above; in an overlap minus the depth of the deepest point of the hand in
    a primitive, which no translation that parts them can be shorter than. Between two samples the
    arm may be off the line by `slack_m` (`within_slack`).
    """
    b, device = len(active), active.device
    distance, fraction = torch.zeros((2, b), dtype=torch.float32, device=device).unbind(0)
    body, segment = torch.full((2, b), -1, dtype=torch.int32, device=device).unbind(0)
    point = torch.zeros((b, 3), dtype=torch.float32, device=device)
    found = {
        "distance": distance,
        "body": body,
        "segment": segment,
        "fraction": fraction,
        "point": point,
    }
    tables = {"world": scene.world, "mesh": scene.hand_mesh, "bodies": body_poses.bodies}
    motion = {"path": executed.path, "length": executed.length}
    moves = (executed.length > 0) & active
    on: dict[str, Any] = {"device": scene.device, "threads": threads}
    if uses_frontier(scene.device):
        frontier = SafeFrontier(scene, body_poses, **motion, tolerance=SAFE_TOLERANCE_M)
        frontier(found)
        meets = frontier.rows_where(moves & (distance < 0))
    else:
        inputs = {"cap": CLEARANCE_CAP_M, "tolerance": SAFE_TOLERANCE_M, **tables, **motion}
        launch_trials(
            safe_kernels.safe_distance, b, inputs=inputs, outputs=found, chunk=16, uneven=True, **on
        )
        meets = torch.nonzero(moves & (distance < 0)).flatten().to(torch.int32)
    # the search for the smallest distance ends where bodies meet: how deep is a search of its own
    inputs = {**tables, "row": meets, **motion}
    launch_trials(hand_overlap, len(meets), inputs=inputs, outputs=found, chunk=1, **on)
    distance = torch.where(moves, within_slack(distance, executed.slack_m), torch.nan)
    return NearestApproach(distance, torch.where(moves, body, -1), segment, fraction, point)


def within_slack(
    distance_m: Float32[Tensor, " b"], slack_m: Float32[Tensor, " b"]
) -> Float32[Tensor, " b"]:
    """What a signed distance says of bodies that may be `slack_m` off their place: apart, they are
    no nearer than this; where they meet, no less deep. Bodies that are apart by less than the slack
    may meet, but not by any known depth: -1e-6 m."""
    deep = (distance_m + slack_m).clamp(max=-TOUCH_M)
    return torch.where(distance_m < 0, deep, (distance_m - slack_m).clamp(min=-TOUCH_M))


def hand_distance_at(
    scene: Scene,
    body_poses: BodyPoses,
    q: Float32[Tensor, "b 6"],
    active: Bool[Tensor, " b"],
    *,
    threads: int | None = None,
) -> NearestApproach:
    """The distance of the robot from the hand at the postures `q` (rad), measured as in
    `hand_distance`."""
    b, device = len(active), active.device
    distance = torch.empty(b, dtype=torch.float32, device=device)
    body = torch.empty(b, dtype=torch.int32, device=device)
    point = torch.empty((b, 3), dtype=torch.float32, device=device)
    launch_trials(
        goal_safe_distance,
        b,
        inputs={
            "cap": CLEARANCE_CAP_M,
            "world": scene.world,
            "mesh": scene.hand_mesh,
            "bodies": body_poses.bodies,
            "active": active.contiguous(),
            "q": q,
        },
        outputs={"distance": distance, "body": body, "point": point},
        device=scene.device,
        threads=threads,
    )
    return NearestApproach(
        distance, body, torch.zeros_like(body), torch.zeros_like(distance), point
    )


def nearer_of(
    hand: NearestApproach, body_m: Float32[Tensor, " b"], part: Int32[Tensor, " b"]
) -> NearestApproach:
    """The nearer of the hand and the receiver's body, which is `body_m` from the robot's `part`.

    Where the body is nearer no point is known, and the moment remains that of the hand.
    """
    nearer = body_m < hand.distance_m
    return NearestApproach(
        torch.minimum(hand.distance_m, body_m),  # NaN where either is NaN
        torch.where(nearer, part, hand.body),
        hand.segment,
        hand.fraction,
        torch.where(nearer[:, None], torch.nan, hand.point),
    )
