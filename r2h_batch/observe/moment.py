"""The moment that cameras see: the robot at home with an open gripper, the person waiting, the object at rest on the table."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32, Float64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.errors import UserError
from r2h_batch.base.io.progress import busy
from r2h_batch.config import Workplace
from r2h_batch.observe.rays import bodies_of
from r2h_batch.observe.rig import CELL_V1
from r2h_batch.observe.seen import LABELS
from r2h_batch.observe.windows import middles, window_corners
from r2h_batch.scene.hand import rotation_from_axis_angle
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.draw.rule import again
from r2h_batch.trials.noise import trial_ids
from r2h_batch.types import Trials

PLACE_X, PLACE_Y = (0.22, 0.40), (0.18, 0.42)
"""Where the middle of the object's box may lie on the UR5e's table: x, and |y| on the side away from the hand, m [choice]."""
TOUCH_M = 0.010
"""Nearer to robot or person counts as touching, m [choice]: points of an object lie 3 mm apart."""
HIDDEN_PX = 150
"""An object with fewer pixels than this in either post of cell-v1 counts as hidden [choice]."""
STRIDE = 4
"""A ray for this many pixels each way counts them."""
RESTING_M = 0.0005
"""Points this near to the lowest one carry the object [choice]."""
_PLACE = 0  # purpose of the random counters

Array = NDArray[np.float64]


@busy("resting places of objects")
def moments(scene: Scene, trials: Trials, *, seed: int = 0) -> Float32[Tensor, "n 4 4"]:
    """Where the objects of trials lie when they are seen.

    An object rests on its stable side (`resting_rotation`), turned about the vertical by a uniform angle, its box's middle
    uniform in `PLACE_X` x `PLACE_Y`, times `region_scale`. Drawn by (seed, trial id), and again while it leaves the table,
    touches the robot or the person, or is hidden from a post of cell-v1. The draw knows no other rig, so all rigs see the same
    moments. A trial that was drawn again (`Benchmark.redraws`) has another one.

    Args:
        scene: robot at home, objects, hands, table.
        trials: N trials.
        seed: of the draw.

    Returns:
        T_world_obj (N, 4, 4) float32, m, on the trials' device.

    Raises:
        UserError: an object finds no place.
    """
    ids = trial_ids(trials.trial_id)
    redraws = scene.benchmark.redraws(ids)
    keys = {k: rng.key_of(again(f"moment {seed}", k)) for k in np.unique(redraws).tolist()}
    rests = _rests(scene.objects, trials)
    hand_y = trials.T_world_hand[:, 1, 3].cpu().numpy()
    found = np.empty((len(ids), 4, 4), np.float64)

    def propose(
        rows: NDArray[np.int64], attempt: int | NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], tuple[Array]]:
        u = np.empty((3, len(rows)))
        for k, key in keys.items():
            of = redraws[rows] == k
            tries = np.broadcast_to(attempt, len(rows))[of]
            u[:, of] = rng.uniforms(key, ids[rows][of], 3, purpose=_PLACE, attempt=tries)
        own = [rests[i] for i in rows]
        T, fits = _placed(own, u, hand_y[rows], scene)
        inside = np.flatnonzero(fits)
        if len(inside):
            part = trials[torch.from_numpy(rows[inside]).to(trials.trial_id.device)]
            fits[inside] = _free_and_seen(scene, part, T[inside])
        return fits, (T[fits],)

    try:
        rng.accepted(len(ids), propose, found)
    except rng.NothingFits as error:
        raise UserError(
            f"{error}: objects need a place on the table that is free and that both posts of cell-v1 see; leave large "
            "objects out, or use a larger table"
        ) from None
    return torch.from_numpy(found).float().to(trials.trial_id.device)


def region_scale(place: Workplace) -> float:
    """Factor of the region where objects are placed: 1 if its middle lies on the table, else how much smaller the table is than
    the UR5e's. Small arms have small tables (`Benchmark.on`)."""
    usual = Workplace()
    front, wide = (w.table_center[0] + w.table_half[0] for w in (place, usual))
    if front >= sum(PLACE_X) / 2:
        return 1.0
    return min(front / wide, place.table_half[1] / usual.table_half[1])


@lru_cache(maxsize=1024)
def resting_rotation(model: ObjectModel) -> Float64[np.ndarray, "3 3"]:
    """R_table_obj, how an object rests: as in its own frame where that is stable, else on its hull's most likely side.

    Stable: the centre of mass lies above the hull of the lowest points. Most likely: the side on which a convex solid lands
    (Goldberg et al. 1999, as `trimesh.poses` computes it). A turned object rests as the one that it came from.
    """
    if (turn := model.who.turn) is not None:
        own: Array = resting_rotation(turn.own) @ turn.R_new_own.T
        return own
    hull = model.hull_vertices.astype(np.float64)
    if _stands(hull, np.asarray(model.com, np.float64)):
        return np.eye(3)
    import trimesh

    solid = trimesh.Trimesh(hull, model.hull_faces, process=False)
    poses, _ = trimesh.poses.compute_stable_poses(solid, center_mass=model.com, sigma=0.0)
    rest: Array = np.asarray(poses[0][:3, :3], np.float64)
    return rest


def _stands(points: Array, com: Array) -> bool:
    """Whether a solid rests on its lowest points."""
    low = points[points[:, 2] < points[:, 2].min() + RESTING_M][:, :2] - com[:2]
    if len(low) < 3:
        return False
    # the centre is inside the hull if no half circle of directions is free of points
    angles = np.sort(np.arctan2(low[:, 1], low[:, 0]))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    return bool(gaps.max() < np.pi)


def _rests(objects: Sequence[ObjectModel], trials: Trials) -> list[Array]:
    """For each trial the vertices of its object's hull as it rests (V, 3), and the turn that does it, stacked (V + 3, 3)."""
    made: dict[int, Array] = {}
    rows = trials.object_index.tolist()
    for i in rows:
        if i not in made:
            R = resting_rotation(objects[i])
            hull = objects[i].hull_vertices.astype(np.float64)
            turned = np.stack(
                [hull[:, 0] * r[0] + hull[:, 1] * r[1] + hull[:, 2] * r[2] for r in R]
            )
            made[i] = np.concatenate([turned.T, R])
    return [made[i] for i in rows]


def _placed(
    rests: Sequence[Array], u: Array, hand_y: Array, scene: Scene
) -> tuple[Array, NDArray[np.bool_]]:
    """T_world_obj (n, 4, 4), and whether it lies on the table."""
    place = scene.config.workplace
    center, half = np.array(place.table_center), np.array(place.table_half)
    zero = np.zeros(len(u[0]))
    yaw = rotation_from_axis_angle(
        torch.from_numpy(np.stack([zero, zero, 2 * np.pi * u[0]], 1))
    ).numpy()
    scale = region_scale(place)
    x = scale * (PLACE_X[0] + (PLACE_X[1] - PLACE_X[0]) * u[1])
    y = scale * (PLACE_Y[0] + (PLACE_Y[1] - PLACE_Y[0]) * u[2]) * np.where(hand_y > 0, -1.0, 1.0)
    T, fits = np.tile(np.eye(4), (len(rests), 1, 1)), np.zeros(len(rests), bool)
    for i, rest in enumerate(rests):
        hull, R = rest[:-3], rest[-3:]
        c, s = yaw[i, 0, 0], yaw[i, 1, 0]
        turned = np.stack([c * hull[:, 0] - s * hull[:, 1], s * hull[:, 0] + c * hull[:, 1]], 1)
        low, high = turned.min(0), turned.max(0)
        shift = np.array([x[i], y[i]]) - 0.5 * (low + high)
        fits[i] = bool(
            (low + shift >= center[:2] - half[:2]).all()
            and (high + shift <= center[:2] + half[:2]).all()
        )
        T[i, 0, :3], T[i, 1, :3] = c * R[0] - s * R[1], s * R[0] + c * R[1]
        T[i, 2, :3] = R[2]
        T[i, :2, 3], T[i, 2, 3] = shift, center[2] + half[2] - hull[:, 2].min()
    return T, fits


def _free_and_seen(scene: Scene, trials: Trials, T: Array) -> NDArray[np.bool_]:
    """Whether objects touch neither robot nor person, and both posts of cell-v1 see enough of them."""
    bodies = bodies_of(scene)
    T_world_obj = torch.from_numpy(T).float().to(trials.trial_id.device)
    rows = trials.object_index.tolist()
    cloud = torch.from_numpy(np.stack([scene.objects[i].points for i in rows])).to(
        T_world_obj.device
    )
    points = se3.apply(T_world_obj[:, None], cloud)
    touched = bodies.near(trials, T_world_obj, points, within_m=TOUCH_M, resting=True).amax(1) > 0
    side = CELL_V1.object_px // STRIDE
    corners = window_corners(CELL_V1, middles(scene, trials, T_world_obj), CELL_V1.object_px)
    _, label, _ = bodies.cast(
        trials, T_world_obj, CELL_V1.T_world_camera.to(T_world_obj.device), corners, focal_px=CELL_V1.focal_px,
        sensor_px=CELL_V1.sensor_px, columns=side, rows=side, stride=STRIDE,
    )  # fmt: skip
    pixels = (label == LABELS.index("object")).sum((2, 3)) * STRIDE**2
    fits: NDArray[np.bool_] = (~touched & (pixels >= HIDDEN_PX).all(1)).cpu().numpy()
    return fits
