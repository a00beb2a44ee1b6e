"""Shapes and bounds of robot, hands, objects and table: what the collision kernels read."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float32, Float64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch.instances import of_joints
from r2h_batch.config import Workplace
from r2h_batch.kernels.geometry.shape import BLOCKS
from r2h_batch.kernels.plan.codes import MAX_ARM_BODIES, MAX_OBSTACLES
from r2h_batch.kernels.robot.world import World
from r2h_batch.scene import bounds
from r2h_batch.scene.bounds import BLOCK_POINTS
from r2h_batch.scene.hand import HandModel, HandSet, palm_frame
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot, ShapeKind, corners_of

MIDDLE_ROOT = 4
"""MANO's joint where the middle finger begins."""

HANDS_AT_ONCE = 8
"""Hands whose faces are bounded at a time: their arrays stay in a core's cache, which takes a quarter of the time."""


@dataclass(frozen=True)
class Hands:
    """The receiver hands of a scene, posed: H hands, right and left, in their own (wrist) frames,
    metres."""

    model: HandModel
    """the hand that takes the postures: MANO's joints and parameters"""
    set: HandSet
    """the postures themselves"""
    vertices: Float32[Tensor, "h v 3"]
    """meshes of the posed hands, m"""
    joints: Float32[Tensor, "h 16 3"]
    """joints in MANO's order (wrist, index, middle, pinky, ring, thumb), m"""
    palm_point: Float32[Tensor, "h 3"]
    """p_h, the middle of the palm, m"""
    palm_normal: Float32[Tensor, "h 3"]
    """n_h, the unit vector out of the palm"""

    def __repr__(self) -> str:  # one line: a dataclass would print its tensors
        return f"Hands({self.set!r} on {self.vertices.device})"

    @staticmethod
    @lru_cache(maxsize=2)
    def posed(hand_set: HandSet) -> "Hands":
        """All hands of a set, posed once for every scene that has them."""
        geometry = hand_set.geometry
        return Hands(
            hand_set.model,
            hand_set,
            geometry.vertices,
            geometry.joints,
            *palm_frame(geometry.joints, hand_set.side),
        )

    @cached_property
    def directions(self) -> Float64[Tensor, "h 3 3"]:
        """Columns: along each hand (wrist to the middle finger's root, in the palm's plane), out of
        its palm, to its thumb.

        Hand frame. Left hands' are a mirrored (improper) frame: what is said in these directions
        holds for both.
        """
        joints, out = self.joints.double(), self.palm_normal.double()
        along = joints[:, MIDDLE_ROOT] - joints[:, 0]
        along = along - se3.dot(along, out)[:, None] * out
        along = along / se3.dot(along, along).sqrt()[:, None]
        out = out / se3.dot(out, out).sqrt()[:, None]
        side = 1.0 - 2.0 * self.set.side.double()  # right 1, left -1
        return torch.stack([along, out, side[:, None] * se3.cross(along, out)], 2)

    @cached_property
    def by_coordinate(self) -> NDArray[np.float32]:
        """The vertices as (3, H, V): NumPy works on contiguous coordinates ten times as fast."""
        return np.ascontiguousarray(self.vertices.numpy().transpose(2, 0, 1))

    @cached_property
    def points(self) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Hull points of all pieces of all hands, and where each piece starts."""
        v = self.vertices.numpy()
        offsets = self.set.hull_offsets.numpy()
        hand = np.repeat(np.arange(len(v)), np.diff(offsets[:: len(self.model.piece_names)]))
        return v[hand, self.set.hull_vertex_ids.numpy()], offsets.astype(np.int32)

    @cached_property
    def blocks(self) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """The same points in blocks (kernels/geometry/shape.py, BLOCKS), and where each piece
        starts."""
        blocks, start = bounds.point_blocks(*self.points)
        return blocks, start.astype(np.int32)

    @cached_property
    def faces(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
        """The skin's faces (F, 3) grouped by the piece that encloses them, where each piece starts,
        and a ball (centre, radius) around each face of each hand (H, F, 4)."""
        faces, v = self.model.faces.numpy(), self.by_coordinate
        owner = np.full(len(faces), -1)
        for k, piece in reversed(list(enumerate(self.model.pieces))):
            owner[np.isin(faces, piece.numpy()).all(1)] = k
        if (owner < 0).any():
            raise ValueError(
                f"{(owner < 0).sum()} faces of the hand lie in no convex piece: make the hand model again"
            )
        order = np.argsort(owner, kind="stable")
        faces = faces[order].astype(np.int32)
        ball = np.empty((v.shape[1], len(faces), 4), np.float32)
        for start in range(0, v.shape[1], HANDS_AT_ONCE):
            part = slice(start, start + HANDS_AT_ONCE)
            corners = [np.take(v[:, part], faces[:, k], axis=2) for k in range(3)]  # (3, h, F) each
            center = (reduce(np.minimum, corners) + reduce(np.maximum, corners)) / 2
            away = [x * x + y * y + z * z for x, y, z in (c - center for c in corners)]
            ball[part, :, :3] = center.transpose(1, 2, 0)
            ball[part, :, 3] = np.sqrt(reduce(np.maximum, away)) + 1e-6
        first = np.searchsorted(owner[order], np.arange(len(self.model.pieces) + 1))
        return faces, first.astype(np.int32), ball

    def piece_points(self, hand: int, piece: int) -> NDArray[np.float32]:
        """Hull points of one convex piece of one hand, hand frame.

        Args:
            hand: row of the hand set.
            piece: place among `model.piece_names`.
        """
        offsets = self.set.hull_offsets
        at = hand * len(self.model.piece_names) + piece
        return self.vertices[
            hand, self.set.hull_vertex_ids[int(offsets[at]) : int(offsets[at + 1])].long()
        ].numpy()


def _length(vectors: NDArray[Any]) -> NDArray[Any]:
    """Lengths of vectors (..., 3), in half the time of `np.linalg.norm`."""
    x, y, z = (vectors[..., k] for k in range(3))
    return np.asarray(np.sqrt(x * x + y * y + z * z))


@lru_cache(maxsize=512)
def _of_hull(what: Callable[[NDArray[np.float64]], Any], points: bytes) -> Any:
    """A table of a hull (its float32 points): objects are the same in every scene. A scene of the built-in objects asks for 288:
    with fewer kept, none is found again.
    """
    return what(np.frombuffer(points, np.float32).reshape(-1, 3).astype(np.float64))


class WorldTables:
    """Host tables of a scene. `object_collision`: hull or pieces, as in `PlanConfig`. `hand_room_m`: hands are grown by this."""

    def __init__(
        self,
        robot: Robot,
        hands: Hands,
        objects: Sequence[ObjectModel],
        object_collision: str,
        workplace: Workplace | None = None,
        hand_room_m: float = 0.0,
    ) -> None:
        self.robot, self.hands, self.objects = robot, hands, objects
        self.hand_room_m = hand_room_m
        self.object_collision = object_collision
        self.workplace = workplace or Workplace()

    @cached_property
    def arm_order(self) -> NDArray[np.int64]:
        """The arm's primitives by link: the order of the kernels' bodies."""
        return np.argsort(self.robot.arm.link, kind="stable")

    @property
    def motion_radii(self) -> NDArray[np.float64]:
        """(n_robot, 6) bounds in m on the distance of each robot body's points from each joint's
        axis."""
        return np.asarray(self._fill_robot()["motion_radius"][0], np.float64)

    def world(self, device: str) -> Any:
        """The `World` of r2h_batch.kernels.robot.world."""
        w = of_joints(World, len(self.robot.joints))()
        for fill in (self._fill_robot, self._fill_hands, self._fill_objects):
            for name, (value, dtype) in fill().items():
                if isinstance(value, int):
                    setattr(w, name, value)
                else:
                    array = np.ascontiguousarray(
                        value, dtype=np.int32 if dtype is wp.int32 else np.float32
                    )
                    setattr(w, name, wp.array(array, dtype=dtype, device=device))
        points = np.concatenate(
            [self.hands.blocks[0], self._object_points[0], *self._object_cells, *self._arm_blocks]
        )
        w.points = wp.array(points, dtype=wp.vec3, device=device)
        w.table_center = wp.vec3(*self.workplace.table_center)
        w.table_half = wp.vec3(*self.workplace.table_half)
        return w

    def _fill_robot(self) -> dict:
        robot, order, joints = self.robot, self.arm_order, len(self.robot.joints)
        kind = np.concatenate([robot.arm.kind[order], robot.gripper.kind])
        size = np.concatenate([robot.arm.size[order], robot.gripper.size])
        link = np.concatenate(
            [robot.arm.link[order], np.full(len(robot.gripper.names), joints + 1)]
        )
        n_arm, n_robot = len(order), len(kind)
        pieces = len(self.hands.model.piece_names)
        if n_robot > 62 or n_arm > MAX_ARM_BODIES or pieces + 1 + n_arm > MAX_OBSTACLES:
            raise ValueError(
                f"{n_robot} robot primitives, {n_arm} of them the arm's, {pieces} hand pieces: the kernels hold fewer"
            )
        caps = [
            *(bounds.capsule_of_shape(robot.arm, int(i)) for i in order),
            *(bounds.capsule_of_shape(robot.gripper, i) for i in range(n_robot - n_arm)),
        ]
        levers = bounds.robot_levers(robot)[np.concatenate([order, np.arange(n_arm, n_robot)])]
        ends, radii = bounds.gripper_balls(robot)
        before = sum(map(len, [self.hands.blocks[0], self._object_points[0], *self._object_cells]))
        rows = np.array([*map(len, self._arm_blocks), *[0] * (n_robot - n_arm)])
        link_caps, link_motion_radius = [], []
        for k in range(joints + 2):
            if k <= joints:
                bodies = np.flatnonzero(link[:n_arm] == k)
                T = robot.arm.T_link_prim[order[bodies]]
                axes = np.stack([T[i, :3, :3] @ caps[b][0] for i, b in enumerate(bodies)])
                centers = np.concatenate([T[:, :3, 3] - axes, T[:, :3, 3] + axes])
                radius = np.tile([caps[b][1] for b in bodies], 2)
            else:
                bodies = np.arange(n_arm, n_robot)
                centers, radius = ends.reshape(-1, 3), np.repeat(radii, ends.shape[1])
            link_caps.append(bounds.capsule_of_balls(centers, radius))
            link_motion_radius.append(levers[bodies].max(0))
        partners = np.zeros(joints + 3, np.int32)
        for a, b in robot.self_pairs:
            partners[max(a, b)] |= 1 << int(min(a, b))
        for a in robot.object_pairs:
            partners[-1] |= 1 << int(a)
        return {
            "joint_R": (robot.T_parent_joint[:, :3, :3], wp.mat33),
            "joint_p": (robot.T_parent_joint[:, :3, 3], wp.vec3),
            "lower": (robot.lower, wp.float32),
            "upper": (robot.upper, wp.float32),
            "n_arm": (int(n_arm), wp.int32),
            "n_robot": (int(n_robot), wp.int32),
            "body_link": (link, wp.int32),
            "kind": (np.where(kind == ShapeKind.HULL, BLOCKS, kind), wp.int32),
            "body_start": (before + np.cumsum(rows) - rows, wp.int32),
            "body_blocks": (rows // BLOCK_POINTS, wp.int32),
            "size": (size, wp.vec3),
            "radius": (np.where(kind <= ShapeKind.CAPSULE, size[:, 0], 0.0), wp.float32),
            "cap_radius": ([c[1] for c in caps], wp.float32),
            "cap_axis": ([c[0] for c in caps], wp.vec3),
            "body_R": (robot.arm.T_link_prim[order][:, :3, :3], wp.mat33),
            "body_p": (robot.arm.T_link_prim[order][:, :3, 3], wp.vec3),
            "motion_radius": (levers, wp.float32),
            "link_first": (np.searchsorted(link, np.arange(joints + 3)), wp.int32),
            "link_c0": ([c[0] for c in link_caps], wp.vec3),
            "link_c1": ([c[1] for c in link_caps], wp.vec3),
            "link_radius": ([c[2] for c in link_caps], wp.float32),
            "link_motion_radius": (link_motion_radius, wp.float32),
            "self_links": (partners, wp.int32),
            "table_from": (int(np.searchsorted(link, robot.table_from)), wp.int32),
        }

    @cached_property
    def _arm_blocks(self) -> list[NDArray[np.floating]]:
        """Corners in blocks of the arm's bodies, in the kernels' order; none but of hulls."""
        corners = corners_of(self.robot.arm)
        return [
            bounds.point_blocks(corners[i], [0, len(corners[i])])[0].astype(np.float32)
            for i in self.arm_order
        ]

    def _fill_hands(self) -> dict:
        room = self.hand_room_m
        points, start = self.hands.points
        low, high = (f.reduceat(points, start[:-1], axis=0) for f in (np.minimum, np.maximum))
        center = (low + high) / 2
        piece = np.repeat(np.arange(len(center)), np.diff(start))
        radius = np.maximum.reduceat(_length(points - center[piece]), start[:-1])
        v = self.hands.by_coordinate
        hand_center = (v.min(2) + v.max(2)) / 2
        hand_radius = _length((v - hand_center[:, :, None]).transpose(1, 2, 0)).max(1)
        return {
            "n_pieces": (len(self.hands.model.piece_names), wp.int32),
            "piece_start": (self.hands.blocks[1][:-1], wp.int32),
            "piece_blocks": (np.diff(self.hands.blocks[1]) // BLOCK_POINTS, wp.int32),
            "piece_round": (np.full(len(center), room), wp.float32),
            "piece_center": (center, wp.vec3),
            "piece_radius": (radius + 1e-6 + room, wp.float32),
            "hand_center": (hand_center.T, wp.vec3),
            "hand_radius": (hand_radius + 1e-6 + room, wp.float32),
        }

    @cached_property
    def _object_points(self) -> tuple[NDArray[np.float32], list[int], list[int]]:
        """Hull points of all objects' collision bodies, first hull of each object, first point of
        each hull."""
        bodies = [
            [o.hull_vertices] if self.object_collision == "hull" else [v for v, _ in o.pieces]
            for o in self.objects
        ]
        hulls = [np.asarray(h, np.float32) for body in bodies for h in body]
        first = np.cumsum([0] + [len(b) for b in bodies])
        return (
            np.concatenate(hulls),
            first.tolist(),
            np.cumsum([0] + [len(h) for h in hulls]).tolist(),
        )

    @cached_property
    def _object_cells(self) -> list[NDArray[np.float32]]:
        """The same hulls with their points sorted by direction (kernels/geometry/shape.py,
        CELLS)."""
        points, _, start = self._object_points
        return [
            _of_hull(bounds.support_cells, points[a:b].tobytes()).astype(np.float32)
            for a, b in pairwise(start)
        ]

    def _fill_objects(self) -> dict:
        points, first, start = self._object_points
        caps = [
            _of_hull(bounds.capsule_of_points, points[a:b].tobytes()) for a, b in pairwise(start)
        ]
        shift = len(self.hands.blocks[0])
        return {
            "hull_first": (first, wp.int32),
            "hull_start": (np.array(start) + shift, wp.int32),
            "hull_cells": (
                np.cumsum([0] + [len(c) for c in self._object_cells])[:-1] + shift + len(points),
                wp.int32,
            ),
            "hull_c0": ([c[0] for c in caps], wp.vec3),
            "hull_c1": ([c[1] for c in caps], wp.vec3),
            "hull_radius": ([c[2] for c in caps], wp.float32),
        }

    @property
    def hull_balls(self) -> NDArray[np.float32]:
        """For each object hull the centre (object frame) and the radius of the largest ball inside
        it."""
        points, _, start = self._object_points
        balls = [_of_hull(bounds.ball_inside, points[a:b].tobytes()) for a, b in pairwise(start)]
        return np.stack(balls).astype(np.float32)
