"""Grasps of an object from its surface alone: tried on this gripper, or as a generator would
propose them."""

import hashlib
import warnings

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from r2h_batch.bodies.objects import ObjectModel
from r2h_batch.bodies.robot import Robot
from r2h_batch.launch import init_warp
from r2h_batch.launch.threads import one_torch_thread
from r2h_batch.methods.box_grasps import three_boxes
from r2h_batch.methods.grasps.antipodal import pad_height, proposals
from r2h_batch.methods.grasps.candidate_set import (
    Candidates,
    NoGraspError,
    carrier,
    joined,
)
from r2h_batch.methods.grasps.diverse import REGION_CLEARANCE_M, diverse
from r2h_batch.methods.grasps.grade import REACH_M, device_mesh, graded, pad_contact, scored
from r2h_batch.scene.grasp_tables import grasp_tables

COUNT = 100
ROUNDS = 8
ENOUGH = 1200
GENERATED_CONTACT = 0.1

F32 = NDArray[np.float32]


def sample_grasps(
    model: ObjectModel, robot: Robot | None = None, *, count: int = COUNT, enough: int = ENOUGH
) -> Candidates:
    """Up to `count` grasps of an object: the same object and name, the same grasps. Raises if it
    has none.

    They are for the robot's gripper, None: for the 2F-85.

    They are chosen of the first `enough` that are found (a round more or less), or of what 8 rounds
    find.

    Each closes on 3 mm less than the open gap within the friction cone, is centred between the pads to 0.5 mm,
    keeps the open gripper 1 mm off the object, and closed touches it with the pads (1 mm for the
    shapes' overshoot). At least 40 % of an S1 object's keep 1 mm from the receiver's region, if
    that many were found.
    """
    robot = carrier(robot)
    tables = grasp_tables([model], robot)
    mesh = device_mesh(model)
    key = int.from_bytes(hashlib.sha256(model.name.encode()).digest()[:8], "little")
    pool: list[Candidates] = []
    with threadpool_limits(1, user_api="blas"), one_torch_thread("cpu"):
        for turn in range(ROUNDS):
            rng = np.random.Generator(np.random.Philox(key=np.array([key, turn], np.uint64)))
            proposed = proposals(model, mesh, rng, robot)[0]
            pool.append(graded(model, tables, mesh, proposed, robot)[0])
            found, off_region = (
                sum(map(len, pool)),
                sum(int((c.region_m > REGION_CLEARANCE_M).sum()) for c in pool),
            )
            if found >= enough and (
                model.split == "S0" or off_region >= enough // 4 or found >= 3 * enough
            ):
                break
    every = joined(pool)
    if len(every) == 0:
        stroke = f"{1e3 * robot.open_gap_m:.0f} mm"
        raise NoGraspError(
            f"{model.name}: no grasp found; the gripper needs a part narrower than {stroke} that it can reach"
        )
    chosen = diverse(model, every, count, robot)
    free = int((chosen.region_m > REGION_CLEARANCE_M).sum())
    if model.split != "S0" and free < 0.25 * len(chosen):
        warnings.warn(
            f"{model.name}: {free} of {len(chosen)} grasps keep {1e3 * REGION_CLEARANCE_M:.0f} mm from the receiver's region; "
            "is the region too large, or the rest of the object too wide for the gripper?",
            stacklevel=2,
        )
    return chosen


def generate_grasps(
    model: ObjectModel, robot: Robot | None = None, *, count: int = COUNT
) -> Candidates:
    """Up to `count` grasps as a generator proposes them, not tried on this evaluator's gripper;
    reproducible. Raises if none.

    Antipodal pairs within the friction cone and 3 mm less than the open gap apart, with a tenth of each pad on the
    surface there; the open gripper, as three boxes, holds no point of the object's cloud outside
    the gap (as ten Pas et al. 2017 ask of a hand). `width` is the pair's distance: what else lies
    between the pads, whether they close on it centred, and what the true gripper cuts into is not
    asked. `region_m`: 1 where no cloud point of the receiver's region is touched by the pads, else
    -1.
    """
    init_warp()
    robot = carrier(robot)
    mesh = device_mesh(model)
    key = int.from_bytes(hashlib.sha256(model.name.encode()).digest()[:8], "little")
    pool: list[Candidates] = []
    with threadpool_limits(1, user_api="blas"), one_torch_thread("cpu"):
        for turn in range(ROUNDS):
            rng = np.random.Generator(np.random.Philox(key=np.array([key, turn], np.uint64)))
            T, width = proposals(model, mesh, rng, robot)
            contact, alignment, part = pad_contact(model, mesh, T, width, width, robot)
            score, square = scored(model, T, width, contact, alignment, robot)
            rows = np.flatnonzero(square & (contact >= GENERATED_CONTACT))
            rows = rows[_boxes_clear(model, T[rows], robot)]
            region = np.where(_on_region(model, T[rows], width[rows], robot), -1.0, 1.0).astype(
                np.float32
            )
            pool.append(
                Candidates(T[rows], width[rows], score[rows], part[rows].astype(np.uint8), region)
            )
            if sum(map(len, pool)) >= ENOUGH:
                break
    every = joined(pool)
    if len(every) == 0:
        raise NoGraspError(
            f"{model.name}: no antipodal pair that the gripper of {robot.name} fits about was found"
        )
    return diverse(model, every, count, robot)


def _boxes_clear(model: ObjectModel, T: F32, robot: Robot) -> NDArray[np.bool_]:
    """Whether no point of the object's cloud lies in the open gripper as three boxes: two fingers,
    and the rest."""
    finger_low, finger_high, rest_low, rest_high = (
        x.astype(np.float32) for x in three_boxes(robot)
    )
    clear = np.ones(len(T), bool)
    for first in range(0, len(T), 256):
        x, y, z = _in_gripper(model, T[first : first + 256])
        on_finger, in_rest = np.ones((2, *x.shape), bool)
        for axis, (mirrored, value) in enumerate(((x, x), (np.abs(y), y), (z, z))):
            on_finger &= (mirrored > finger_low[axis]) & (mirrored < finger_high[axis])
            in_rest &= (value > rest_low[axis]) & (value < rest_high[axis])
        clear[first : first + 256] = ~(on_finger | in_rest).any(1)
    return clear


def _on_region(model: ObjectModel, T: F32, width: F32, robot: Robot) -> NDArray[np.bool_]:
    """Whether pads `width` apart touch a cloud point of the receiver's region."""
    link = robot.linkage
    pad_z = pad_height(robot, width).astype(np.float32)
    region = model.receiver_face[model.point_face]
    touches = np.zeros(len(T), bool)
    for first in range(0, len(T), 256):
        rows = slice(first, first + 256)
        x, y, z = _in_gripper(model, T[rows])
        near = (np.abs(x) <= link.pad_half_size[0]) & (
            np.abs(z - pad_z[rows, None]) <= link.pad_half_size[2]
        )
        touches[rows] = (
            near & (np.abs(np.abs(y) - 0.5 * width[rows, None]) <= REACH_M) & region
        ).any(1)
    return touches


def _in_gripper(model: ObjectModel, T: F32) -> tuple[F32, F32, F32]:
    """Coordinates (n, P) of the object's cloud in the ee frames of n grasps."""
    p = model.points[None].astype(np.float32) - T[:, None, :3, 3]
    axes = [
        p[..., 0] * T[:, 0, k, None] + p[..., 1] * T[:, 1, k, None] + p[..., 2] * T[:, 2, k, None]
        for k in range(3)
    ]
    return axes[0], axes[1], axes[2]
