"""Start of a transfer: an object in the closed gripper, and the receiving grasp that reception chose.

All of it stands in the frame of the gripper at the handover pose, so that one model serves every pose.
"""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from numpy.typing import NDArray

from r2h_batch.base import se3
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.grasp import attach
from r2h_batch.judge.reception import Reception
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.holding.capacity import usual_grips
from r2h_batch.trials.holding.held_out import G, load_held_out
from r2h_batch.types import CRITERIA, ScoreInputs, Scores, Trials
from r2h_batch.verdicts import PERSON

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Gripped:
    """N objects in closed grippers, float64, frame gripper (at the handover pose), m.

    Attributes:
        trial_id: (N,) numbers of the trials.
        object_index: (N,) which objects.
        T_gripper_obj: (N, 4, 4) where the object is.
        opening_m: (N,) gap of the squeezed fingers.
        down: (N, 3) unit vector of gravity.
    """

    trial_id: Int64[NDArray[np.int64], " n"]
    object_index: Int64[NDArray[np.int64], " n"]
    T_gripper_obj: Float64[Array, "n 4 4"]
    opening_m: Float64[Array, " n"]
    down: Float64[Array, "n 3"]

    def __len__(self) -> int:
        return len(self.trial_id)

    def __getitem__(self, rows: slice | Bool[NDArray[np.bool_], " n"] | NDArray[np.int64]) -> Self:
        """The selected rows."""
        return type(self)(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class Handed(Gripped):
    """N handovers that were received, float64, frame gripper (at the handover pose), m.

    Attributes:
        T_gripper_slip: (N, 4, 4) the grasp's frame: centre of the contacts, axes that capacities count by.
        capacity: (N, 6) force (N) and moment (N m) along these axes that a newton of grip withstands.
        total_n: (N,) sum of the normal forces of a usual grip, N; 0: friction cannot carry the object.
        pull: (N, 3) unit vector along which the person pulls.
        point: (N, 3) a point where the hand touches.
        press: (N, 3) unit vector into the object there.
        weight_n: (N,) weight of the object, N.
        R_world_gripper: (N, 3, 3) orientation of the gripper.
        closing_m: (N,) how far the closing gripper has moved the object to where it is.
        age: (N,) of the receivers, years; NaN: the benchmark does not say.
    """

    T_gripper_slip: Float64[Array, "n 4 4"]
    capacity: Float64[Array, "n 6"]
    total_n: Float64[Array, " n"]
    pull: Float64[Array, "n 3"]
    point: Float64[Array, "n 3"]
    press: Float64[Array, "n 3"]
    weight_n: Float64[Array, " n"]
    R_world_gripper: Float64[Array, "n 3 3"]
    closing_m: Float64[Array, " n"]
    age: Float64[Array, " n"]


def gripped_of(scores: Scores, trial_id: NDArray[np.int64]) -> Gripped:
    """The rows whose grasp passes Stability.

    Args:
        scores: B rows with their inputs.
        trial_id: (B,) numbers of the trials.
    """
    inputs = scores.inputs
    assert isinstance(inputs, ScoreInputs)
    rows = scores.passed[:, CRITERIA.index("stability")]
    evaluator, trials = inputs.evaluator, inputs.trials
    executed = executed_poses(
        evaluator.config, evaluator.scene.objects, inputs.T_obj_ee, inputs.T_world_ee, trials
    )
    device = rows.device
    T_obj_ee, T_world_ee = (se3.orthonormalise(T.to(device)[rows]) for T in executed)
    T_obj_ee = attach(T_obj_ee, scores.grasp_shift_m[rows])
    squeezed = scores.opening_m[rows] - evaluator.config.thresholds.pad_squeeze_m
    T_ee_gripper = _T_ee_gripper(evaluator.scene.robot)
    T_obj_gripper, T_world_gripper = (
        T.cpu().double().numpy() @ T_ee_gripper for T in (T_obj_ee, T_world_ee)
    )
    kept = rows.cpu().numpy()
    return Gripped(
        trial_id[kept].astype(np.int64),
        trials.object_index.cpu().numpy()[kept].astype(np.int64),
        np.asarray(np.linalg.inv(T_obj_gripper), np.float64),
        squeezed.clamp(min=0.0).cpu().double().numpy(),
        -T_world_gripper[:, 2, :3],
    )


def handed_of(
    found: Reception, trial_id: NDArray[np.int64], trials: Trials, scene: Scene
) -> Handed:
    """The rows of a reception in which the object is received.

    Args:
        found: B rows.
        trial_id: (B,) numbers of the trials.
        trials: these B trials.
        scene: the robot, objects and hands of the reception.
    """
    rows = torch.nonzero(found.received.cpu())[:, 0]
    numpy = {
        k: getattr(found, k).cpu()[rows].double().numpy()
        for k in ("T_world_hand", "T_obj_ee", "T_world_obj", "opening_m", "pull", "closing_m")
    }
    object_index = trials.object_index.cpu().numpy()
    index = object_index[rows.numpy()].astype(np.int64)
    age = np.full(len(rows), np.nan)
    if trials.person is not None:
        age = trials.person[:, PERSON.index("age_years")].cpu()[rows].double().numpy()
    held_out = load_held_out(scene.objects, scene.hands.model, np.unique(object_index))
    grasp = held_out.first[torch.from_numpy(index)] + found.grasp.cpu()[rows].long()
    T_world_obj = numpy["T_world_obj"]
    # objects of revolution may be turned about their axes: the grasp goes with the hand
    T_obj_hand = held_out.grasps.T_obj_hand[grasp].double().numpy()
    T_world_grasped = numpy["T_world_hand"] @ np.linalg.inv(T_obj_hand)
    down = -T_world_grasped[:, 2, :3]
    grips = usual_grips(held_out, scene.objects, grasp.numpy(), down)
    T_world_slip = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_slip[:, :3, :3] = T_world_grasped[:, :3, :3] @ grips.axes
    T_world_slip[:, :3, 3] = _apply(T_world_grasped, grips.center)
    T_world_gripper = T_world_obj @ numpy["T_obj_ee"] @ _T_ee_gripper(scene.robot)
    T_gripper_world = np.linalg.inv(T_world_gripper)
    R = T_gripper_world[:, :3, :3]  # of float32 poses: orthonormal to 1e-6
    normal = _turn(T_world_grasped[:, :3, :3], grips.normal)
    mass = np.array([float(o.mass) for o in scene.objects])[index]
    return Handed(
        trial_id[rows.numpy()].astype(np.int64),
        index,
        T_gripper_world @ T_world_obj,
        numpy["opening_m"],
        -R[:, :, 2],
        T_gripper_world @ T_world_slip,
        grips.capacity,
        grips.total_n,
        _turn(R, numpy["pull"]),
        _apply(T_gripper_world @ T_world_grasped, grips.point),
        _turn(R, -normal),
        mass * G,
        T_world_gripper[:, :3, :3],
        numpy["closing_m"],
        age,
    )


def _T_ee_gripper(robot: Robot) -> Float64[Array, "4 4"]:
    return np.asarray(np.linalg.inv(robot.T_flange_ee) @ robot.T_flange_gripper)


def _apply(T: Array, p: Array) -> Array:
    return _turn(T[:, :3, :3], p) + T[:, :3, 3]


def _turn(R: Array, v: Array) -> Array:
    return np.asarray(np.einsum("nij,nj->ni", R, v))
