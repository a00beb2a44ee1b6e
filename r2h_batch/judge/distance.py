"""How near the robot comes to the receiver: to the hand along a motion or at one posture, and to
arm, torso and head."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.base.launch import new_outputs, over_trials
from r2h_batch.config import CLEARANCE_CAP_M
from r2h_batch.kernels.judge.goal_distance import goal_safe_distance
from r2h_batch.kernels.judge.rows import nearer_rows, posture_lengths
from r2h_batch.scene.person import with_person
from r2h_batch.scene.scene import BodyPoses, Scene

if TYPE_CHECKING:
    from r2h_batch.judge.motion.execute import Executed

# What paths and motions need is imported in the functions for them: a pose's first verdict is there
# 0.2 s earlier.

SAFE_TOLERANCE_M = 2e-5
"""How exactly the smallest distance over time is located."""

TOUCH_M = 1e-6
"""Bodies that meet have at most minus this as their distance."""

CALM_M = 2e-5
"""A motion that stays this near to the lines between its samples is measured as one window."""

WINDOWS_AT_ONCE = 8192
"""Windows of motions that are measured together."""

Measure = Callable[[BodyPoses, Tensor, Tensor, Tensor | None], tuple[Tensor, ...]]
"""(bodies, path, length, rows) -> the smallest signed distance of the robot from other bodies
along each path, NaN where its length is 0, and more about that moment. `rows`: the trials of the
paths, None: all in order."""


def person_distance(
    scene: Scene,
    body_poses: BodyPoses,
    receiver: Float32[Tensor, "b 5 4"],
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    head: Float32[Tensor, "b 2 4"] | None = None,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """Smallest distance of the robot (without the object) from forearm, upper arm, torso and head along
    each path; the robot's body. `head`: as of `with_person`.

    Metres, located to 0.02 mm, exact below 5 cm, a lower bound (5 cm, body -1) above; NaN and -1
    without a path. Where they meet: minus a lower bound of the deepest penetration depth found, as
    a sampled path's margin of Plan is (kernels/judge/overlap.py).
    """
    from r2h_batch.judge.plan import path_clearances

    alone = with_person(scene, body_poses, receiver, hand=False, head=head)
    path, length = path.contiguous(), length.contiguous()
    distance, _, body = path_clearances(
        scene, alone, path, length, tolerance_m=SAFE_TOLERANCE_M, without=math.nan
    )
    return distance, body


def person_distance_at(
    scene: Scene,
    body_poses: BodyPoses,
    receiver: Float32[Tensor, "b 5 4"],
    q: Float32[Tensor, "b 6"],
    active: Bool[Tensor, " b"],
    head: Float32[Tensor, "b 2 4"] | None = None,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """The same at postures; NaN and -1 in rows that are not active."""
    made = over_trials(posture_lengths, len(active), scene.device)(active=active.contiguous())
    return person_distance(scene, body_poses, receiver, q[:, None], made["length"], head)


@dataclass(frozen=True)
class NearestApproach:
    """Where the robot comes nearest to the receiver, of B motions or postures."""

    distance_m: Float32[Tensor, " b"]  # below 0: they overlap; NaN where the robot does not move
    body: Int32[Tensor, " b"]  # of the robot (`Scene.part_names`); -1: farther than 5 cm
    segment: Int32[Tensor, " b"]  # of the path, and the fraction of it: the moment
    fraction: Float32[Tensor, " b"]
    point: Float32[Tensor, "b 3"]  # of the hand, world frame, m
    exact: bool = False  # no slack was taken off: what is farther is at the cap


class HandTables(NamedTuple):
    """Hands as the kernels of distances read them.

    Attributes:
        world: the `World` of r2h_batch.kernels.robot.world with these hands.
        mesh: their `HandMesh`.
    """

    world: Any
    mesh: Any

    @staticmethod
    def of(scene: Scene, body_poses: BodyPoses, own: "HandTables | None" = None) -> "HandTables":
        """`own`, or the scene's: those that `body_poses` counts.

        Raises ValueError for bodies among pieces that a batch brings along. The kernels of Safe read the points of a hand's
        pieces in `World.points`; those of a person or a resting object stand in `World.own_points`.
        """
        found = own or HandTables(scene.world, scene.hand_mesh)
        if body_poses.world is not None or found.world.own_points is not None:
            raise ValueError(
                "the distance from the hand is asked of bodies among a person's or a resting object's pieces; give those that"
                " Scene.body_poses made, and ask person_distance for the person"
            )
        return found


def hand_distance(
    scene: Scene,
    body_poses: BodyPoses,
    executed: "Executed",
    active: Bool[Tensor, " b"],
) -> NearestApproach:
    """The smallest distance of the robot from the hand over each motion.

    The exact mesh of the hand against the primitives of the robot, without the object. Exact below
    5 cm and a lower bound above; in an overlap minus the depth of the deepest point of the hand in
    a primitive, which no translation that parts them can be shorter than. Between two samples the
    arm may be off their line (`over_motion`).
    """
    from r2h_batch.kernels.judge.overlap import hand_overlap
    from r2h_batch.kernels.judge.safe import safe_distance

    def measure(
        bodies: BodyPoses, path: Tensor, length: Tensor, rows: Tensor | None
    ) -> tuple[Tensor, ...]:
        b, moves = len(length), (length > 0) & (active if rows is None else active[rows])
        tables = HandTables.of(scene, bodies)._asdict() | {"bodies": bodies.bodies}
        found = new_outputs(safe_distance, b, scene.device)
        found["body"].fill_(-1)
        found["segment"].fill_(-1)
        distance = found["distance"]
        motion = {"path": path, "length": length}
        inputs = {"cap": CLEARANCE_CAP_M, "tolerance": SAFE_TOLERANCE_M, **tables, **motion}
        kernel = scene.sized(safe_distance)
        over_trials(kernel, b, scene.device, outputs=found, chunk=16, uneven=True)(**inputs)
        meets = torch.nonzero(moves & (distance < 0)).flatten().to(torch.int32)
        # the search for the smallest distance ends where bodies meet: how deep is a search of its
        # own
        inputs = {**tables, "row": meets, **motion}
        over_trials(scene.sized(hand_overlap), len(meets), scene.device, outputs=found, chunk=1)(
            **inputs
        )
        more = (found[k] for k in ("body", "segment", "fraction", "point"))
        return torch.where(moves, distance, torch.nan), *more

    distance, body, segment, fraction, point, begins = over_motion(
        scene, body_poses, executed, measure
    )
    moves = (executed.length > 0) & active
    return NearestApproach(
        distance, torch.where(moves, body, -1), segment + begins, fraction, point
    )


def over_motion(
    scene: Scene,
    body_poses: BodyPoses,
    executed: "Executed",
    measure: Measure,
) -> tuple[Tensor, ...]:
    """How near each motion comes, with the slack between path and motion taken off.

    Returns a tuple: the bound of the signed distance (`bound_with_slack`); what else `measure`
    says; the first segment of the window of the motion on which the bound was measured.

    On a window p of a motion every point of the robot is within slack_p of where the lines between
    samples have it, with the fingers at an opening of the window's own. So

        min over time >= min over windows (smallest distance along the window's lines - slack_p).

    A calm motion is one window, at the trial's opening. What something holds up has windows of WINDOW
    segments: a blow costs the window that it falls into, and fingers that are pushed are judged where
    they are.
    """
    from r2h_batch.kernels.motion.worlds import WINDOW

    slack, opening, length = executed.window_slack_m, executed.window_opening_m, executed.length
    start = torch.zeros_like(length)
    if slack is None or opening is None:  # as planned
        distance, *more = measure(body_poses, executed.path, length, None)
        return (bound_with_slack(distance, executed.slack_m), *more, start)
    calm = executed.slack_m <= CALM_M
    distance, *more = measure(body_poses, executed.path, torch.where(calm, length, 0), None)
    best = [bound_with_slack(distance, executed.slack_m), *more, start]
    width, rough = int(WINDOW), torch.nonzero(~calm & (length > 1)).flatten()
    if not len(rough):
        return tuple(best)
    device = length.device
    windows = (
        torch.arange(slack.shape[1], dtype=torch.int64, device=device) * width
        < length[rough, None] - 1
    )
    at, k = torch.nonzero(windows, as_tuple=True)
    row = rough[at]
    left = (length[row] - k * width).clamp(max=width + 1).to(torch.int32)
    sample = k[:, None] * width + torch.arange(width + 1, dtype=torch.int64, device=device)
    path = executed.path[row[:, None], sample.clamp(max=executed.path.shape[1] - 1)]
    parts: list[tuple[Tensor, ...]] = []
    for some in torch.arange(len(row), dtype=torch.int64, device=device).split(WINDOWS_AT_ONCE):
        moved = scene.reopened(body_poses, row[some], opening[row, k][some])
        parts.append(measure(moved, path[some], left[some], row[some]))
    distance, *more = (torch.cat(x) for x in zip(*parts, strict=True))
    found = [bound_with_slack(distance, slack[row, k]), *more, (k * width).to(torch.int32)]
    table = torch.full(windows.shape, torch.inf, dtype=torch.float32, device=device)
    table[at, k] = found[0].nan_to_num(nan=torch.inf)
    places = torch.zeros(windows.shape, dtype=torch.int64, device=device)
    places[at, k] = torch.arange(len(row), dtype=torch.int64, device=device)
    nearest = places.gather(1, table.argmin(1, keepdim=True)).flatten()
    for old, new in zip(best, found, strict=True):
        old[rough] = new[nearest].to(old.dtype)
    return tuple(best)


def bound_with_slack(
    distance_m: Float32[Tensor, " b"], slack_m: Float32[Tensor, " b"]
) -> Float32[Tensor, " b"]:
    """Signed distance that is safe for bodies whose poses have errors. Apart, they are no nearer
    than distance less slack; where they meet, no less deep than the overlap less slack. Bodies that
    are apart by less than the slack may meet, but not by any known depth: -1e-6 m.

    Args:
        distance_m: (B,) m, below 0: minus the overlap.
        slack_m: (B,) how far they may be off, m.
    """
    deep = (distance_m + slack_m).clamp(max=-TOUCH_M)
    return torch.where(distance_m < 0, deep, (distance_m - slack_m).clamp(min=-TOUCH_M))


def hand_distance_at(
    scene: Scene,
    body_poses: BodyPoses,
    q: Float32[Tensor, "b 6"],
    active: Bool[Tensor, " b"],
    *,
    cap_m: float = CLEARANCE_CAP_M,
    hands: HandTables | None = None,
) -> NearestApproach:
    """The distance of the robot from the hand at postures, measured as in `hand_distance`.

    Args:
        scene: robot, objects and hands.
        body_poses: of B trials.
        q: (B, J) float32, rad.
        active: (B,) rows to measure; the others are NaN.
        cap_m: exact below this, a lower bound above, m.
        hands: those that `body_poses` counts; None: the scene's.
    """
    tables = HandTables.of(scene, body_poses, hands)
    made = over_trials(scene.sized(goal_safe_distance), len(active), scene.device)(
        cap=cap_m,
        world=tables.world,
        mesh=tables.mesh,
        bodies=body_poses.bodies,
        active=active.contiguous(),
        q=q,
    )
    distance, body = made["distance"], made["body"]
    no_time = _no_time(len(active), active.device)
    return NearestApproach(distance, body, *no_time, made["point"], exact=True)


@lru_cache(maxsize=16)
def _no_time(b: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Segment and fraction of postures."""
    segment = torch.zeros(b, dtype=torch.int32, device=device)
    return segment, torch.zeros(b, dtype=torch.float32, device=device)


def nearer_of(
    hand: NearestApproach, person_m: Float32[Tensor, " b"], body: Int32[Tensor, " b"]
) -> NearestApproach:
    """The nearer of the hand and the rest of the person.

    Where the rest is nearer no point is known, and the moment remains that of the hand.

    Args:
        hand: of B motions or postures.
        person_m: (B,) distance of arm, torso and head, m; NaN: not known.
        body: (B,) the robot's body there.
    """
    made = over_trials(nearer_rows, len(body), str(body.device))(
        distance=hand.distance_m.contiguous(),
        body=hand.body.contiguous(),
        point=hand.point.contiguous(),
        person=person_m.contiguous(),
        person_body=body.to(torch.int32),
    )
    found = {"distance_m": made["distance"], "body": made["body"], "point": made["point"]}
    return replace(hand, **found)
