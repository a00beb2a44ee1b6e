"""What nobody wants of a handover, in numbers: how bad a pose is for each aim of bench/adversary.py.

Distances of points in float64, made here: of the judge come only how far the pads close, where that moves the object, and how
near the robot is to the body.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from r2h_batch import Evaluator
from r2h_batch.base import se3
from r2h_batch.judge.grasp import attach
from r2h_batch.scene.person import eyes_of, heads_of
from r2h_batch.scene.robot import Robot, ShapeKind, gripper_primitives_at
from r2h_batch.types import Trials

POINTS = 512
"""Points of an object."""


@dataclass(frozen=True)
class Setting:
    """One trial in float64: who receives, and the object's points in its own frame."""

    P: Tensor
    """(P, 3) the object's points"""
    wanted: Tensor
    """(P,) bool: of the receiver's region; all where there is none"""
    sharp: Tensor
    """(P,) bool"""
    up: Tensor | None
    """(3,) from a vessel's base to its opening"""
    robot: Robot
    palm: Tensor
    normal: Tensor
    ball: Tensor
    eyes: Tensor
    head: Tensor
    """(2, 4) ends and radius"""
    torso: Tensor
    """(4, 3) middle, half sides, and the axes ahead and left"""


@dataclass(frozen=True)
class Held:
    """K poses of one trial: points of object (K, P, 3) and gripper (K, G, 3) in the world, and the robot's gap to the body, m."""

    W: Tensor
    G: Tensor
    T_world_obj: Tensor
    T_world_ee: Tensor
    body_m: Tensor


@dataclass(frozen=True)
class Aim:
    """Something that nobody wants: how bad a pose is (higher is worse), in which unit, from where it is a fault, and for whom."""

    what: str
    unit: str
    fault: float
    bad: Callable[[Setting, Held], Tensor]
    concerns: Callable[[Setting], bool] = lambda _: True


def nearest(points: Tensor, to: Tensor) -> Tensor:
    """(K,) distance of the nearest of (K, P, 3) points to one of (E, 3), m."""
    return torch.cdist(points.flatten(0, 1), to.reshape(-1, 3)).amin(1).view(points.shape[:2]).amin(1)


def in_head(s: Setting, h: Held) -> Tensor:
    """cm that object or gripper are inside of the head; below 0: outside."""
    a, b, r = s.head[0, :3], s.head[1, :3], s.head[0, 3]
    P = torch.cat([h.W, h.G], 1)
    t = (((P - a) @ (b - a)) / ((b - a) @ (b - a))).clamp(0, 1)
    return 100 * (r - (P - a - t[..., None] * (b - a)).norm(dim=2).amin(1))


def first(part: Callable[[Setting, Held], Tensor]) -> Callable[[Setting, Held], Tensor]:
    """cm by which other points are nearer to the palm than what the person wants."""
    return lambda s, h: 100 * (nearest(h.W[:, s.wanted], s.palm) - nearest(part(s, h), s.palm))


def at_chest(s: Setting, h: Held) -> Tensor:
    """cm, negative: the distance of the object to the torso's box."""
    middle, half, ahead, left = s.torso
    local = (h.W - middle) @ torch.stack([ahead, left, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)], 1)
    return -100 * (local.abs() - half).clamp_min(0).norm(dim=2).amin(1)


def turned_away(s: Setting, h: Held) -> Tensor:
    """Degrees between the direction in which the gripper points and that from the TCP to the palm."""
    to_palm = torch.nn.functional.normalize(s.palm - h.T_world_ee[:, :3, 3], dim=1)
    return torch.rad2deg((h.T_world_ee[:, :3, 2] * to_palm).sum(1).clamp(-1, 1).acos())


def tilted(s: Setting, h: Held) -> Tensor:
    """Degrees between a vessel's opening and up."""
    assert s.up is not None
    return torch.rad2deg((h.T_world_obj[:, 2, :3] @ s.up).clamp(-1, 1).acos())


def has_sharp(s: Setting) -> bool:
    """Whether the object has a sharp part."""
    return bool(s.sharp.any())


def has_region(s: Setting) -> bool:
    """Whether the person wants a part of the object, not any of it."""
    return not bool(s.wanted.all())


def is_vessel(s: Setting) -> bool:
    """Whether the object has an opening."""
    return s.up is not None


def behind(s: Setting, h: Held) -> Tensor:
    """cm that the whole object lies behind the plane of the palm."""
    return -100 * ((h.W - s.palm) @ s.normal).amax(1)


AIMS = {  # gripper and blade: half a centimetre beyond what raters still take (bench/rating.py)
    "head": Aim("object or gripper in the head, depth", "cm", 0.0, in_head),
    "eye": Aim("object near an eye, distance", "cm", -5.0, lambda s, h: -100 * nearest(h.W, s.eyes)),
    "blade": Aim("sharp part before the wanted part, by", "cm", 4.0, first(lambda s, h: h.W[:, s.sharp]), has_sharp),
    "away": Aim("wanted part behind the rest of the object, by", "cm", 10.0, first(lambda s, h: h.W), has_region),
    "gripper": Aim("gripper before the wanted part, by", "cm", 8.0, first(lambda s, h: h.G)),
    "upside down": Aim("vessel's opening from up", "deg", 120.0, tilted, is_vessel),
    "behind": Aim("all of the object behind the palm's plane, by", "cm", 0.0, behind),
    "far": Aim("object away from the palm", "cm", 20.0, lambda s, h: 100 * nearest(h.W, s.palm)),
    "arm in the way": Aim("robot near arm, torso or head, distance", "cm", -1.0, lambda s, h: -100 * h.body_m),
    "chest": Aim("object near the chest, distance", "cm", -2.0, at_chest),
    "back": Aim("gripper points away from the palm, by", "deg", 150.0, turned_away),
}  # fmt: skip


def setting(evaluator: Evaluator, trials: Trials, i: int) -> Setting:
    """Trial i."""
    scene, robot = evaluator.scene, evaluator.scene.robot
    model, receiver = scene.objects[int(trials.object_index[i])], trials.receiver[i].double()  # type: ignore[index]
    pick = torch.linspace(0, len(model.points) - 1, POINTS).long()
    palm, normal, ball = (x[i].double() for x in scene.palm(trials.hand_index, trials.T_world_hand))
    x, y = float(receiver[3, 3]), float(receiver[4, 3])
    axes = torch.tensor([[x, y, 0.0], [-y, x, 0.0]], dtype=torch.float64)
    sharp, wanted = (torch.from_numpy(of[model.point_face]) for of in (model.sharp_face, model.receiver_face))
    up = None if model.up is None else torch.tensor(model.up, dtype=torch.float64)
    if model.split == "S0":
        wanted = torch.ones_like(wanted)
    if not wanted[pick].any():  # a small region: its own points too
        pick = torch.cat([pick, torch.nonzero(wanted)[:, 0]])
    return Setting(
        torch.from_numpy(np.array(model.points))[pick].double(), wanted[pick], sharp[pick], up,
        robot, palm, normal, ball, eyes_of(receiver[None].float())[0].double(),
        heads_of(receiver[None].float())[0].double(), torch.cat([receiver[3:5, :3], axes]),
    )  # fmt: skip


def gripper_points(robot: Robot, opening_m: Tensor) -> Tensor:
    """Points of the gripper (K, G, 3) at K gaps of the pads, frame ee: middles of its shapes, and their ends along their axes."""
    T = gripper_primitives_at(robot, opening_m.numpy())
    points = []
    for n, (kind, size) in enumerate(zip(robot.gripper.kind, robot.gripper.size, strict=True)):
        half = {
            ShapeKind.SPHERE: (size[0], size[0], size[0]),
            ShapeKind.CAPSULE: (size[0], size[0], size[1] + size[0]),
            ShapeKind.CYLINDER: (size[0], size[0], size[1]),
        }.get(ShapeKind(int(kind)), tuple(size))
        ends = [sign * x * T[:, n, :3, k] for k, x in enumerate(half) for sign in (-1, 1)]
        points += [T[:, n, :3, 3], *(T[:, n, :3, 3] + end for end in ends)]
    return torch.from_numpy(np.stack(points, 1))


def held(s: Setting, T_obj_ee: Tensor, T_world_ee: Tensor, opening_m: Tensor, shift_m: Tensor, body_m: Tensor) -> Held:
    """K poses, with the pads closed and the object where they have moved it."""
    A, B = attach(T_obj_ee.double(), shift_m.double()), T_world_ee.double()
    T = se3.matmul(B, se3.inverse(A))
    W = se3.apply(T[:, None], s.P[None])
    G = se3.apply(B[:, None], gripper_points(s.robot, opening_m.double()))
    return Held(W, G, T, B, body_m.double())
