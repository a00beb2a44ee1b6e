"""An object that rests in the world beside hand and person, and worlds that lack some of their bodies: for a robot that is
about to pick the object, or has just done so."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float32, Int64
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.base.launch.arguments import struct_of, struct_with
from r2h_batch.kernels.geometry.shape import BLOCK_POINTS
from r2h_batch.kernels.robot import resting as kernels
from r2h_batch.kernels.robot.world import TrialBodies, World
from r2h_batch.scene.scene import PLACED, BodyPoses, Scene

_OF_PIECES = ("piece_start", "piece_blocks", "piece_round", "piece_center", "piece_radius")
FAR_M = 1e3


def with_resting(
    scene: Scene, body_poses: BodyPoses, T_world_obj: Float32[Tensor, "b 4 4"]
) -> BodyPoses:
    """The same trials with their objects' convex bodies where they rest, as pieces of the hand: what meets them meets the hand.

    Args:
        scene: robot, objects and hands.
        body_poses: of B trials, with person or without.
        T_world_obj: (B, 4, 4) float32, m.
    """
    b, base, objects = len(T_world_obj), body_poses.tables(scene), scene.world
    first, start = objects.hull_first.numpy(), objects.hull_start.numpy()
    hulls, most = int(np.diff(first).max()), int(np.diff(start).max())
    blocks = -(-most // int(BLOCK_POINTS))
    of_hand = int(base.n_pieces)
    sizes = dict.fromkeys(_OF_PIECES, of_hand + hulls)
    sizes["number"] = hulls * blocks * 3 * int(BLOCK_POINTS)
    own = [] if base.own_points is None else [wp.to_torch(base.own_points)]  # of the person
    made = over_trials(kernels.place_resting, b, scene.device, sizes=sizes, chunk=64)(
        before=sum(map(len, own)),
        of_hand=of_hand,
        hulls=hulls,
        blocks=blocks,
        **{name: getattr(base, name) for name in _OF_PIECES},
        point=objects.points,
        hull_first=objects.hull_first,
        hull_start=objects.hull_start,
        hand=vars(body_poses.bodies)["tensors"]["hand"],
        object=body_poses.object_index,
        T_world_obj=T_world_obj.contiguous(),
        R_hand_world=body_poses.R_hand_world,
        p_hand_world=body_poses.p_hand_world,
    )
    tables = {name: made[name].flatten(0, 1) for name in _OF_PIECES}
    tables["own_points"] = torch.cat([*own, made["number"].view(-1, 3)])
    tables |= {name: made[name] for name in ("hand_center", "hand_radius")}
    world: Any = struct_with(base, scene.sized(World), tables)
    world.n_pieces = of_hand + hulls
    names = ("object", "hand", *PLACED)
    owners = dict(zip(names, body_poses.owners[: len(names)], strict=True)) | {"hand": made["row"]}
    bodies = struct_of(
        scene.sized(TrialBodies), {**owners, "object_motion_radius": owners["motion_radius"]}
    )
    return replace(body_poses, bodies=bodies, world=world)


def among(
    scene: Scene, body_poses: BodyPoses, others: BodyPoses, rows: Int64[Tensor, " b"]
) -> BodyPoses:
    """Bodies of B trials among what other ones meet: each among the pieces of its row there, whose tables are not built again.

    Args:
        scene: robot, objects and hands.
        body_poses: of B trials, that index the scene's tables.
        others: with person, with resting objects or without some bodies.
        rows: (B,) rows of `others`, whose hands stand where those of `body_poses` do.
    """
    names = ("object", "hand", *PLACED)
    owners = dict(zip(names, body_poses.owners[: len(names)], strict=True))
    owners |= {"hand": vars(others.bodies)["tensors"]["hand"][rows].contiguous()}
    bodies = struct_of(
        scene.sized(TrialBodies), {**owners, "object_motion_radius": owners["motion_radius"]}
    )
    return replace(body_poses, bodies=bodies, world=others.tables(scene))


def without(
    scene: Scene, body_poses: BodyPoses, *, attached: bool = False, table: bool = False,
    gripper: bool = False, arm: bool = False, person: bool = False, others: bool = False,
) -> BodyPoses:  # fmt: skip
    """The same trials without some of their bodies.

    Args:
        scene: robot, objects and hands.
        body_poses: of B trials.
        attached: without the object in the gripper.
        table: without the table.
        gripper: without the gripper, which then meets nothing.
        arm: the gripper alone, without the links before it.
        person: without hand and person.
        others: without hand, person and pairs of the robot with itself.
    """
    world: Any = scene.sized(World)()
    base = body_poses.tables(scene)
    world.assign(base)  # its arrays are shared
    vars(world)["tensors"] = {"base": base}
    if attached:
        world.hull_first = wp.zeros(base.hull_first.shape[0], dtype=wp.int32, device=scene.device)
    if table:
        world.table_center = wp.vec3(0.0, 0.0, -FAR_M)
    if gripper or arm:
        first = base.link_first.numpy().copy()
        if gripper:
            first[-1] = first[-2]
        if arm:
            first[:-1] = first[-2]
        world.link_first = wp.array(first, dtype=wp.int32, device=scene.device)
    if others or person:
        hands = base.hand_center.shape[0]
        world.n_pieces = 0
        world.hand_center = wp.full(
            hands, wp.vec3(FAR_M, 0.0, 0.0), dtype=wp.vec3, device=scene.device
        )
        world.hand_radius = wp.zeros(hands, dtype=wp.float32, device=scene.device)
    if others or arm:
        world.self_links = wp.zeros(base.self_links.shape[0], dtype=wp.int32, device=scene.device)
    return replace(body_poses, world=world)
