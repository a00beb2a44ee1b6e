"""The baselines' answers to a few trials, and twins that choose grasp and roll again by brute force."""

from functools import cache
from types import ModuleType

import numpy as np
import torch
from numpy.typing import NDArray
from problems import default_evaluator as evaluator

from r2h_batch import load_benchmark
from r2h_batch.judge.hand_clearance import gripper_clearance, posed_hand
from r2h_batch.judge.ik import solve_ik
from r2h_batch.methods import contact, fc, handover_va, intent
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.placing import roll_angles
from r2h_batch.methods.predictors import PredictorNoise, TargetHand
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.types import Predictions, Trials

N = 8
NOISE = PredictorNoise()


@cache
def trials() -> Trials:
    return load_benchmark("r2h-v1").trials(N)


def middle(found: Predictions, row: int, i: int | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The centre of the object's bounding box in the world and in the gripper's frame, of row `row` that answers trial i."""
    T_world_ee, T_obj_ee = (getattr(found, k)[row].double().numpy() for k in ("T_world_ee", "T_obj_ee"))
    model = evaluator().scene.objects[int(trials().object_index[row if i is None else i])]
    box = (model.vertices.min(0).astype(np.float64) + model.vertices.max(0)) / 2
    inside = T_obj_ee[:3, :3].T @ (box - T_obj_ee[:3, 3])
    return T_world_ee[:3, :3] @ inside + T_world_ee[:3, 3], inside


def above(target: TargetHand, i: int) -> NDArray[np.float64]:
    """15 cm from the palm's centre along its normal."""
    return (target.palm_point[i].double() + 0.15 * target.palm_normal[i].double()).numpy()


def ends(grid: torch.Tensor) -> torch.Tensor:
    """A contact network: people take objects by the end at +x."""
    return grid[:, 0] * (0.5 + 0.5 * grid[:, 1])


METHODS = {"fc": fc, "handover_va": handover_va, "contact": contact, "intent": intent}


def predict(method: ModuleType, some: Trials, **options) -> Predictions:
    if method is contact:
        options = {"predictor": ends} | options
    return method.predict(some, evaluator().scene, **options)


@cache
def answer(name: str) -> Predictions:
    return predict(METHODS[name], trials())


def candidates(i: int) -> tuple[torch.Tensor, torch.Tensor, NDArray[np.float64]]:
    """T_obj_ee, opening and score of the candidates of trial i's object."""
    table, o = candidate_table(evaluator().scene), int(trials().object_index[i])
    rows = slice(int(table.first[o]), int(table.first[o] + table.count[o]))
    return table.T_obj_ee[rows], table.opening_m[rows], table.score[rows].double().numpy()


def clear_of(vertices: torch.Tensor, T: torch.Tensor, opening: torch.Tensor) -> NDArray[np.bool_]:
    """Whether each gripper T, opening is clear of one hand."""
    hand = posed_hand(evaluator().scene.hands.model, vertices[None], "cpu")
    first, count = torch.zeros(1, dtype=torch.int32), torch.tensor([len(T)], dtype=torch.int32)
    distance = gripper_clearance(
        load_robot(), hand, T.contiguous(), opening.contiguous(), first, count, len(T), cap_m=1e-3
    )
    return (distance[0] > 0).numpy()


def chosen_candidate(i: int, T_obj_ee: torch.Tensor) -> int:
    """Which candidate of its object trial i got."""
    T, _, _ = candidates(i)
    (k,) = torch.nonzero((T_obj_ee == T).all(2).all(1)).flatten().tolist()
    return k


def rolls_from(T_world_ee: torch.Tensor, z: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 8 rotations about z in the order they are tried, from the one whose x is nearest to -X of the world."""
    z = z / np.linalg.norm(z)
    x = np.array([-1.0, 0, 0]) - np.array([-1.0, 0, 0]) @ z * z
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    return np.stack([
        np.stack([np.cos(a) * x + np.sin(a) * y, np.cos(a) * y - np.sin(a) * x, z], 1) for a in roll_angles(8)
    ])  # fmt: skip


def first_passing(T: NDArray[np.float64], opening: torch.Tensor, vertices: torch.Tensor | None) -> int:
    """Index of the first pose that the arm reaches, its gripper clear of the hand; else the first it reaches; else 0."""
    poses = torch.from_numpy(T).float()
    reached = [bool(solve_ik(p[None].contiguous()).reachable) for p in poses]
    clear = [True] * len(T) if vertices is None else clear_of(vertices, poses, opening.expand(len(T))).tolist()
    both = [a and b for a, b in zip(reached, clear, strict=True)]
    return both.index(True) if any(both) else reached.index(True) if any(reached) else 0


def pose(R: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p
    return T
