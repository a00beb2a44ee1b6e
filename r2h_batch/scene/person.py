"""The receiver's arm and torso (`Trials.receiver`) as convex pieces beside the hand's: what
planning and Safe see of a person.

A forearm and an upper arm are capsules: the segment between two joints grown by a radius. The torso
is a box that stands upright. They differ from trial to trial and cannot lie in the scene's tables:
each batch gets tables of its own in which every row is a hand, the hand's own pieces first, then
these three. Their points stand in a table of their own (`World.own_points`): the scene's points are
ten megabytes, and nothing here copies them. All is written by one kernel over the rows, so a small
call is recorded with it (`base.launch.repeated`).
"""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import over_trials
from r2h_batch.base.launch.arguments import struct_of, struct_with
from r2h_batch.kernels.geometry.shape import BLOCK_POINTS
from r2h_batch.kernels.robot import person as kernels
from r2h_batch.kernels.robot.world import TrialBodies, World
from r2h_batch.scene.scene import PLACED, BodyPoses, Scene

PIECES = ("forearm", "upper_arm", "torso")
"""In this order they follow a hand's pieces."""
EYES_UP_M, EYES_UP_SHARE = 0.110, 0.318
EYES_AHEAD_M, EYES_AHEAD_SHARE = 0.046, 0.200
"""The eyes above the acromion, and ahead of the middle of the torso: a length, and a share of the distance from shoulder to
elbow. Lines through the 2,000 built-in people, whose eyes lie within 21 mm of the height (5 mm in the mean square)."""
EYES_ASIDE_M = 0.0295
"""Half the distance of the eyes, mean of the adults."""
_OF_PIECES = ("piece_start", "piece_blocks", "piece_round", "piece_center", "piece_radius")


def with_person(
    scene: Scene, body_poses: BodyPoses, receiver: Float32[Tensor, "b 5 4"], *, hand: bool
) -> BodyPoses:
    """The same trials with the person's pieces: beside the hand's, or (not `hand`) alone before the
    bare robot.

    Alone means: no hand, no table, no object, no pairs of the robot with itself: what is then
    nearest is robot and person.
    """
    base = scene.world if hand else scene.world_of_robot
    of_hand = int(base.n_pieces) if hand else 0
    pieces = of_hand + len(PIECES)
    sizes = dict.fromkeys(_OF_PIECES, pieces) | {"own_points": len(PIECES) * int(BLOCK_POINTS)}
    made = over_trials(kernels.place_person, len(receiver), scene.device, sizes=sizes, chunk=256)(
        of_hand=of_hand,
        **{name: getattr(scene.world, name) for name in _OF_PIECES},
        receiver=receiver.contiguous(),
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
