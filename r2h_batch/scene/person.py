"""The receiver's arm, torso and head (`Trials.receiver`, `heads_of`) as convex pieces beside the hand's: what
planning and Safe see of a person.

A forearm and an upper arm are capsules: the segment between two joints grown by a radius. The torso
is a box that stands upright. The head is a capsule from chin to crown. They differ from trial to trial and cannot
lie in the scene's tables: each batch gets tables of its own in which every row is a hand, the hand's own pieces
first, then these four. Their points stand in a table of their own (`World.own_points`): the scene's points are
ten megabytes, and nothing here copies them. All is written by one kernel over the rows, so a small
call is recorded with it (`base.launch.repeated`).
"""

from dataclasses import replace
from typing import Any

import torch
import warp as wp
from jaxtyping import Float32, Float64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import over_trials
from r2h_batch.base.launch.arguments import struct_of, struct_with
from r2h_batch.kernels.geometry.shape import BLOCK_POINTS
from r2h_batch.kernels.robot import person as kernels
from r2h_batch.kernels.robot.world import TrialBodies, World
from r2h_batch.scene.scene import PLACED, BodyPoses, Scene

PIECES = ("forearm", "upper_arm", "torso", "head")
"""In this order they follow a hand's pieces."""
HEAD_M = {
    "low_ahead": (0.032, 0.079),
    "low_up": (0.130, 0.131),
    "high_ahead": (0.017, 0.057),
    "high_up": (0.127, 0.331),
    "radius": (0.069, 0.113),
}
"""The head's capsule: how far its lower end (in the chin) and its upper end (below the crown) are ahead of the torso's middle and
above its top, and the radius. Each is a length (m), and a share of the distance from shoulder to elbow. Fitted to the skins
of the 2,000 built-in people: the worst point that it leaves out is 6 mm from it in the median, at most 17 mm."""
MADE_OF = "".join(
    line + "\n"
    for line in (
        "forearm: capsule, elbow to wrist, radius of the elbow's row",
        "upper_arm: capsule, shoulder to elbow, radius of the shoulder's row",
        "torso: box about the middle, upright, turned to where it faces",
        f"head: capsule over the torso, {' '.join(f'{k} {a:g} {b:g}' for k, (a, b) in HEAD_M.items())}",
    )
)
"""What a person is made of, for the digests of benchmarks whose person counts. Whoever changes a piece changes this text."""
EYES_UP_M, EYES_UP_SHARE = 0.110, 0.318
EYES_AHEAD_M, EYES_AHEAD_SHARE = 0.046, 0.200
"""The eyes above the acromion, and ahead of the middle of the torso: a length, and a share of the distance from shoulder to
elbow. Lines through the 2,000 built-in people, whose eyes lie within 21 mm of the height (5 mm in the mean square)."""
EYES_ASIDE_M = 0.0295
"""Half the distance of the eyes, mean of the adults."""
_OF_PIECES = ("piece_start", "piece_blocks", "piece_round", "piece_center", "piece_radius")
_HEAD = {k: wp.vec2d(*x) for k, x in HEAD_M.items()}


def heads_of(receiver: Float32[Tensor, "n 5 4"]) -> Float32[Tensor, "n 2 4"]:
    """The heads of receivers, as verdicts, pictures and cameras have them: capsules that face as the torso does.

    Args:
        receiver: (N, 5, 4) `Trials.receiver`.

    Returns:
        (N, 2, 4) lower and upper end, each with the radius; world, m.
    """
    run = over_trials(
        kernels.place_head, len(receiver), str(receiver.device), sizes={"head": 2}, chunk=256
    )
    head: Tensor = run(**_HEAD, receiver=receiver.contiguous())["head"]
    return head


def with_person(
    scene: Scene,
    body_poses: BodyPoses,
    receiver: Float32[Tensor, "b 5 4"],
    *,
    hand: bool,
    head: Float32[Tensor, "b 2 4"] | None = None,
    base: Any = None,
) -> BodyPoses:
    """The same trials with the person's pieces: beside the hand's, or (not `hand`) alone before the
    bare robot.

    Alone means: no hand, no table, no object, no pairs of the robot with itself: what is then
    nearest is robot and person. `head`: of `heads_of`, where the receiver's arm has moved since; None: the receiver's.
    `base`: the `World` beside which the person stands, with the scene's hands; None: the scene's, or that of the bare robot.
    The head is grown by what robot and object keep from it (`Benchmark.head_clearance_m`).
    """
    if base is None:
        base = scene.world if hand else scene.world_of_robot
    of_hand = int(base.n_pieces) if hand else 0
    pieces = of_hand + len(PIECES)
    sizes = dict.fromkeys(_OF_PIECES, pieces) | {"own_points": len(PIECES) * int(BLOCK_POINTS)}
    made = over_trials(kernels.place_person, len(receiver), scene.device, sizes=sizes, chunk=256)(
        of_hand=of_hand,
        room=scene.hand_room_m,
        head_room=scene.benchmark.head_clearance_m,
        **{name: getattr(scene.world, name) for name in _OF_PIECES},
        receiver=receiver.contiguous(),
        head=heads_of(receiver) if head is None else head.contiguous(),
        hand=body_poses.hand_index,
        R_hand_world=body_poses.R_hand_world,
        p_hand_world=body_poses.p_hand_world,
    )
    rows, tables = made["row"], {name: made[name].flatten(0, 1) for name in sizes}
    tables |= {name: made[name] for name in ("hand_center", "hand_radius")}
    world: Any = struct_with(base, scene.sized(World), tables)
    world.n_pieces = pieces
    names = ("object", "hand", *PLACED)
    owners = {**dict(zip(names, body_poses.owners[: len(names)], strict=True)), "hand": rows}
    bodies = struct_of(
        scene.sized(TrialBodies), {**owners, "object_motion_radius": owners["motion_radius"]}
    )
    return replace(body_poses, bodies=bodies, world=world)


def eyes_of(receiver: Float32[Tensor, "n 5 4"]) -> Float64[Tensor, "n 2 3"]:
    """Where the eyes of receivers are: above the torso, ahead of its middle. The head does not turn.

    Args:
        receiver: (N, 5, 4) `Trials.receiver`.

    Returns:
        (N, 2, 3) float64, left and right, world, m.
    """
    shoulder, elbow, _, middle, half = receiver.double().unbind(1)
    upper = (elbow - shoulder)[:, :3]
    arm = se3.dot(upper, upper).sqrt()
    facing = torch.stack([middle[:, 3], half[:, 3], torch.zeros_like(arm)], 1)
    left = torch.stack([-half[:, 3], middle[:, 3], torch.zeros_like(arm)], 1)
    between = middle[:, :3] + (EYES_AHEAD_M + EYES_AHEAD_SHARE * arm)[:, None] * facing
    between[:, 2] += half[:, 2] + EYES_UP_M + EYES_UP_SHARE * arm
    return torch.stack([between + EYES_ASIDE_M * left, between - EYES_ASIDE_M * left], 1)
