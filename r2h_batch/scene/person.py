"""The receiver's arm and torso (`Trials.receiver`) as convex pieces beside the hand's: what
planning and Safe see of a person.

A forearm and an upper arm are capsules: the segment between two joints grown by a radius. The torso
is a box that stands upright. They differ from trial to trial and cannot lie in the scene's tables:
each batch gets tables of its own in which every row is a hand, the hand's own pieces first, then
these three.
"""

from dataclasses import replace
from typing import Any

import torch
import warp as wp
from jaxtyping import Float32, Float64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch.arguments import struct_of
from r2h_batch.kernels.robot.world import TrialBodies, World
from r2h_batch.scene.bounds import BLOCK_POINTS
from r2h_batch.scene.scene import PLACED, BodyPoses, Scene

PIECES = ("forearm", "upper_arm", "torso")
"""In this order they follow a hand's pieces."""
_ROUNDING_M = 1e-6
_VECTORS = ("piece_center", "hand_center", "points")


def piece_corners(
    receiver: Float32[Tensor, "b 5 4"],
) -> tuple[Float64[Tensor, "b 3 8 3"], Float64[Tensor, "b 3"]]:
    """Corners (world, m; a segment's ends several times) of the hulls of `PIECES`, and by how much
    each is grown."""
    rows = receiver.double()
    shoulder, elbow, wrist, middle, half = rows[..., :3].unbind(1)
    facing = torch.stack([rows[:, 3, 3], rows[:, 4, 3], torch.zeros_like(rows[:, 3, 3])], 1)
    aside = torch.stack([-facing[:, 1], facing[:, 0], facing[:, 2]], 1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device=rows.device).expand_as(facing)
    corners = []
    for k in range(8):
        signs = [1.0 if (k >> j) & 1 else -1.0 for j in range(3)]
        steps = [
            s * half[:, j, None] * axis
            for j, (s, axis) in enumerate(zip(signs, (facing, aside, up), strict=True))
        ]
        corners.append(middle + steps[0] + steps[1] + steps[2])
    limbs = [torch.stack([a, b] * 4, 1) for a, b in ((elbow, wrist), (shoulder, elbow))]
    grown = torch.stack([rows[:, 1, 3], rows[:, 0, 3], torch.zeros_like(rows[:, 0, 3])], 1)
    return torch.stack([*limbs, torch.stack(corners, 1)], 1), grown


def with_person(
    scene: Scene, body_poses: BodyPoses, receiver: Float32[Tensor, "b 5 4"], *, hand: bool
) -> BodyPoses:
    """The same trials with the person's pieces: beside the hand's, or (not `hand`) alone before the
    bare robot.

    Alone means: no hand, no table, no object, no pairs of the robot with itself: what is then
    nearest is robot and person.
    """
    b, device = len(body_poses.hand_index), receiver.device
    corners, grown = piece_corners(receiver)
    R, p = (x.double()[:, None, None] for x in (body_poses.R_hand_world, body_poses.p_hand_world))
    # in the hand's frame, where all collision work is done
    local = (se3.rotate(R, corners) + p).float()
    low, high = local.amin(2), local.amax(2)
    center = 0.5 * (low + high)
    off = local - center[:, :, None]
    radius = se3.dot(off, off).sqrt().amax(2) + grown.float() + _ROUNDING_M
    # BLOCKS: 16 x, then 16 y and 16 z
    blocks = torch.cat([local, local], 2).transpose(2, 3).reshape(-1, 3)
    assert 2 * local.shape[2] == BLOCK_POINTS
    first = BLOCK_POINTS * torch.arange(b * len(PIECES), dtype=torch.int32, device=device).view(
        b, -1
    )
    tables: dict[str, Tensor] = {
        "piece_start": first,
        "piece_blocks": torch.ones_like(first),
        "piece_round": grown.float(),
        "piece_center": center,
        "piece_radius": radius,
    }
    world: Any = scene.sized(World)()
    world.assign(scene.world)  # its arrays are shared
    points = blocks
    if hand or scene.robot.arm.corners:  # hulls of the arm have their points there too
        base = wp.to_torch(scene.world.points)
        tables["piece_start"] = first + len(base)
        points = torch.cat([base, blocks])
    if hand:
        of_hands = {name: _of_hands(scene, name, body_poses.hand_index) for name in tables}
        tables = {name: torch.cat([of_hands[name], tables[name]], 1) for name in tables}
    else:
        world.table_from = world.n_robot
        # no pair of links and no hull; torch makes them, so that a captured call may
        none = {"self_links": len(scene.robot.joints) + 3, "hull_first": len(scene.objects) + 1}
        tables |= {k: torch.zeros(n, dtype=torch.int32, device=device) for k, n in none.items()}
    low = (tables["piece_center"] - tables["piece_radius"][..., None]).amin(1)
    high = (tables["piece_center"] + tables["piece_radius"][..., None]).amax(1)
    middle = 0.5 * (low + high)
    off = tables["piece_center"] - middle[:, None]
    tables["hand_radius"] = (se3.dot(off, off).sqrt() + tables["piece_radius"]).amax(
        1
    ) + _ROUNDING_M
    tables["hand_center"], tables["points"] = middle, points
    world.n_pieces = int(tables["piece_start"].shape[1])
    kept = {
        name: (x.reshape(-1, 3) if name in _VECTORS else x.reshape(-1)).contiguous()
        for name, x in tables.items()
    }
    for name, x in kept.items():
        setattr(
            world, name, wp.from_torch(x, dtype=wp.vec3) if name in _VECTORS else wp.from_torch(x)
        )
    rows = torch.arange(b, dtype=torch.int32, device=device)
    names = ("object", "hand", *PLACED)
    owners = {**dict(zip(names, body_poses.owners[: len(names)], strict=True)), "hand": rows}
    bodies = struct_of(
        scene.sized(TrialBodies), {**owners, "object_motion_radius": owners["motion_radius"]}
    )
    return replace(body_poses, bodies=bodies, world=world, more_owners=(rows, *kept.values()))


def _of_hands(scene: Scene, name: str, hand_index: Tensor) -> Tensor:
    """Rows of one of the scene's tables of pieces, (b, n_pieces, ...)."""
    table = wp.to_torch(getattr(scene.world, name))
    return table.unflatten(0, (-1, scene.world.n_pieces))[hand_index.long()]
