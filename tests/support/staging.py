"""Scenes built on purpose: four plain objects, one open hand, poses in words. World frame, metres."""

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import torch
import trimesh

from r2h_batch import load_benchmark
from r2h_batch.config import EvalConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.scene.hand import load_hand_set
from r2h_batch.scene.objects import ObjectModel, build_object
from r2h_batch.scene.tables import Hands
from r2h_batch.types import Scores, Trials

STICK, TOOL, CUBE, POLE = range(4)
"""20 mm square sticks along z, 0.20 m long; TOOL's upper half is the receiver's; CUBE has 0.10 m sides; POLE is 1 m long."""

HOME_TCP = np.array([0.4206, 0.0, 0.4494])
UP, DOWN, AHEAD, BACK = np.array([0.0, 0, 1]), np.array([0.0, 0, -1]), np.array([1.0, 0, 0]), np.array([-1.0, 0, 0])


@cache
def staged_objects() -> tuple[ObjectModel, ...]:
    def bar(length: float) -> trimesh.Trimesh:
        return trimesh.creation.box((0.02, 0.02, length)).subdivide().subdivide()

    return (
        build_object(bar(0.2), "stick", pieces=False),
        build_object(bar(0.2), "tool", "S1", receiver="z>0.5", pieces=False),
        build_object(trimesh.creation.box((0.1, 0.1, 0.1)), "cube", pieces=False),
        build_object(bar(1.0), "pole", pieces=False),
    )


@cache
def staged_evaluator(config: EvalConfig | None = None) -> Evaluator:
    benchmark = load_benchmark("r2h-v1").with_objects(staged_objects())
    return Evaluator(benchmark if config is None else replace(benchmark, thresholds=config.thresholds), config)


@cache
def open_hand() -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Index of an open right hand; its palm point, palm normal and finger direction in the hand frame."""
    hand_set = load_hand_set()
    index = next(i for i in range(len(hand_set)) if hand_set.posture[i] == "open_flat" and int(hand_set.side[i]) == 0)
    hands = Hands.posed(hand_set)
    joints = hands.joints[index].double().numpy()
    fingers = joints[4] - joints[0]  # wrist to the middle finger's root
    return index, hands.palm_point[index].double().numpy(), hands.palm_normal[index].double().numpy(), fingers


def frame(z: np.ndarray, y: np.ndarray, p: np.ndarray) -> np.ndarray:
    """T with the given z axis, y axis as near as possible to the given one, and origin."""
    z = z / np.linalg.norm(z)
    y = y - (y @ z) * z
    y = y / np.linalg.norm(y)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([np.cross(y, z), y, z], 1), p
    return T


def hand_at(palm: np.ndarray, normal: np.ndarray, fingers: np.ndarray) -> np.ndarray:
    """T_world_hand of the open hand with its palm point, palm normal and finger direction there."""
    _, point, own_normal, own_fingers = open_hand()
    T = frame(normal, fingers, np.zeros(3)) @ np.linalg.inv(frame(own_normal, own_fingers, np.zeros(3)))
    T[:3, 3] = palm - T[:3, :3] @ point
    return T


def hold_across(z: float) -> np.ndarray:
    """T_obj_ee of a stick held from the side (approach along its x, pads along its y), at height z of the stick."""
    return frame(AHEAD, np.array([0.0, 1, 0]), np.array([0.0, 0, z]))


def hold_end(z: float, *, pointing: int = 1) -> np.ndarray:
    """T_obj_ee of a stick along the approach axis; `pointing` 1: its +z points out of the gripper."""
    return frame(pointing * UP, np.array([0.0, 1, 0]), np.array([0.0, 0, z]))


@dataclass(frozen=True)
class Staged:
    """One staged trial. The defaults are a handover that succeeds: a stick held low, upright, in front of an open palm."""

    object_index: int = STICK
    T_obj_ee: np.ndarray = field(default_factory=lambda: hold_across(-0.07))
    T_world_ee: np.ndarray = field(
        default_factory=lambda: frame(AHEAD, np.array([0.0, 1, 0]), np.array([0.5, 0, 0.33]))
    )
    T_world_hand: np.ndarray | None = None
    trial_id: int = 0

    def but(self, **changes) -> "Staged":
        return replace(self, **changes)


def palm_up_ahead() -> np.ndarray:
    """The receiver's open hand 0.12 m behind the point (0.5, 0, 0.40), palm to the robot, fingers up."""
    return hand_at(np.array([0.62, 0, 0.40]), BACK, UP)


def batch_of(rows: list[Staged]) -> tuple[torch.Tensor, torch.Tensor, Trials]:
    """T_obj_ee, T_world_ee, trials of staged rows."""
    hand = open_hand()[0]

    def tensor(poses: list[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(np.stack(poses).astype(np.float32))

    trials = Trials(
        torch.tensor([r.trial_id for r in rows]),
        torch.tensor([r.object_index for r in rows], dtype=torch.int32),
        torch.full((len(rows),), hand, dtype=torch.int32),
        tensor([palm_up_ahead() if r.T_world_hand is None else r.T_world_hand for r in rows]),
    )
    return tensor([r.T_obj_ee for r in rows]), tensor([r.T_world_ee for r in rows]), trials


def judge(*rows: Staged, config: EvalConfig | None = None) -> Scores:
    """Scores of staged rows."""
    return staged_evaluator(config).score(*batch_of(list(rows)))


Y = np.array([0.0, 1, 0])

OUT_OF_THE_WAY = hand_at(np.array([1.5, 1.5, 0.4]), BACK, UP)


GOOD = Staged()


def moved(T: np.ndarray, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """The pose with its origin shifted along the outer frame's axes."""
    out = T.copy()
    out[:3, 3] += (x, y, z)
    return out


def tilted_pole(degrees: float, at: float) -> Staged:
    """A pole held across, leaning by an angle in the plane of approach."""
    a = np.radians(degrees)
    T_obj_ee = frame(np.array([np.cos(a), 0, np.sin(a)]), Y, np.array([0, 0, at]))
    return GOOD.but(object_index=POLE, T_obj_ee=T_obj_ee, T_world_hand=OUT_OF_THE_WAY)


START = {
    "HAND": GOOD.but(T_world_hand=hand_at(HOME_TCP + [0, 0, 0.10], UP, AHEAD)),
    "OBJECT_HAND": GOOD.but(T_obj_ee=hold_end(-0.09), T_world_hand=hand_at(HOME_TCP - [0, 0, 0.14], UP, AHEAD)),
    "OBJECT_TABLE": GOOD.but(object_index=POLE, T_obj_ee=hold_end(-0.47), T_world_hand=OUT_OF_THE_WAY),
    "OBJECT_ROBOT": tilted_pole(40, 0.3),
}
"""TABLE and SELF cannot be met by the robot itself at the start: home is free of both."""


GOAL = {
    "HAND": GOOD.but(
        T_world_ee=frame(AHEAD, Y, np.array([0.65, 0, 0.25])), T_world_hand=hand_at(np.array([0.66, 0, 0.25]), BACK, UP)
    ),
    "TABLE": GOOD.but(T_world_ee=frame(DOWN, Y, np.array([0.4, 0, 0.0])), T_world_hand=OUT_OF_THE_WAY),
    "SELF": GOOD.but(T_world_ee=frame(AHEAD, Y, np.array([0.0, 0, 0.3])), T_world_hand=OUT_OF_THE_WAY),
    "OBJECT_HAND": GOOD.but(
        T_obj_ee=hold_end(-0.09),
        T_world_ee=frame(AHEAD, Y, np.array([0.5, 0, 0.40])),
        T_world_hand=hand_at(np.array([0.62, 0, 0.40]), BACK, UP),
    ),
    "OBJECT_TABLE": GOOD.but(
        T_obj_ee=hold_end(-0.09), T_world_ee=frame(DOWN, Y, np.array([0.4, 0, 0.12])), T_world_hand=OUT_OF_THE_WAY
    ),
    "OBJECT_ROBOT": tilted_pole(-60, -0.3),
}
