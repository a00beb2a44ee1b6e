"""The receiver's view at the handover: how much of the part that the person wants the eyes see."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.errors import UsageError
from r2h_batch.base.launch import over_trials
from r2h_batch.kernels.observe import eyes as kernels
from r2h_batch.observe.rays import balls_of, bodies_of, mesh_on
from r2h_batch.observe.robot_mesh import part_poses, parts_of
from r2h_batch.observe.seen import LABELS
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

UP_M, UP_SHARE = 0.110, 0.318
AHEAD_M, AHEAD_SHARE = 0.046, 0.200
"""The eyes above the acromion, and ahead of the middle of the torso: a length, and a share of the distance from shoulder to
elbow. Lines through the 2,000 built-in people, whose eyes lie within 21 mm of the height (5 mm in the mean square)."""
ASIDE_M = 0.0295
"""Half the distance of the eyes, mean of the adults."""
POINTS = 512
"""Points that stand for a region."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """The receiver's view on the regions of N trials. Rows are NaN where the object has no region.

    Attributes:
        seen: share of the region's area that at least one eye sees.
        hidden_by: share that each of `LABELS` hides; `object`: the object itself, whoever else does too.
    """

    seen: Float32[Tensor, " n"]
    hidden_by: Float32[Tensor, "n l"]


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
    between = middle[:, :3] + (AHEAD_M + AHEAD_SHARE * arm)[:, None] * facing
    between[:, 2] += half[:, 2] + UP_M + UP_SHARE * arm
    return torch.stack([between + ASIDE_M * left, between - ASIDE_M * left], 1)


def hidden_points(
    scene: Scene,
    trials: Trials,
    T_world_obj: Float32[Tensor, "n 4 4"],
    q: Float32[Tensor, "n j"],
    opening_m: Float32[Tensor, " n"],
) -> UInt8[Tensor, "n k"]:
    """The body (of `LABELS`) that hides each of the region's `POINTS` from both eyes; 0: an eye sees it.

    Args:
        scene: robot, objects with regions, hands, table.
        trials: N trials whose receivers have bodies.
        T_world_obj: (N, 4, 4) float32, where the objects are, m.
        q: (N, joints) float32, the arm's posture, rad.
        opening_m: (N,) float32, gap between the pads, m.
    """
    assert trials.receiver is not None
    tables = _tables(scene)
    T_world_part = part_poses(
        scene.robot, q.cpu().double().numpy(), opening_m.cpu().double().numpy()
    )
    n, device = len(trials), T_world_obj.device
    made = over_trials(
        kernels.hidden, n, scene.device, sizes={"label": POINTS}, width=POINTS, chunk=1
    )(
        parts=len(tables.meshes),
        part_mesh=tables.part_mesh,
        part_ball=tables.part_ball,
        T_world_part=torch.from_numpy(T_world_part).float().to(device).contiguous(),
        eye=eyes_of(trials.receiver).float().contiguous(),
        point=tables.point,
        normal=tables.normal,
        **bodies_of(scene).placed(trials, T_world_obj),
    )  # fmt: skip
    found: Tensor = made["label"]
    return found


def view(
    scene: Scene,
    trials: Trials,
    T_world_obj: Float32[Tensor, "n 4 4"],
    q: Float32[Tensor, "n j"],
    opening_m: Float32[Tensor, " n"],
) -> View:
    """How much of the objects' regions the receivers see while the gripper holds them out.

    Object, robot, the waiting hand, the arm and the table hide what lies behind them. The torso does not: it is a box as high
    as the shoulders, and who looks down bends the head. A trial has the same bits in any batch.

    Args:
        scene: robot, objects with regions, hands, table.
        trials: N trials whose receivers have bodies.
        T_world_obj: (N, 4, 4) float32, where the objects are, m.
        q: (N, joints) float32, the arm's posture, rad.
        opening_m: (N,) float32, gap between the pads, m.

    Raises:
        UsageError: the trials' receivers have no bodies (r2h-v0).

    Source: after the visibility of Wang et al. 2024, arXiv 2404.01402 (the share of human contact points).
    """
    if trials.receiver is None:
        raise UsageError(
            "these trials have receivers without a body; use those of a benchmark with people"
        )
    label = hidden_points(scene, trials, T_world_obj, q, opening_m).long()
    shares = torch.stack([(label == k).sum(1) / POINTS for k in range(len(LABELS))], 1).float()
    shares[~_tables(scene).has_region[trials.object_index.long()]] = torch.nan
    seen = shares[:, 0].clone()
    shares[:, 0] *= 0  # NaN stays
    return View(seen, shares)


@dataclass(frozen=True)
class _Tables:
    """The robot's parts and the regions' points on a device."""

    meshes: tuple[wp.Mesh, ...]
    part_mesh: wp.array
    part_ball: wp.array
    point: Float32[Tensor, "o k 3"]
    normal: Float32[Tensor, "o k 3"]
    has_region: Bool[Tensor, " o"]


@lru_cache(maxsize=2)
def _tables(scene: Scene) -> _Tables:
    parts = parts_of(scene.robot)
    meshes = tuple(mesh_on(scene.device, v, f) for v, f in parts)
    points = [region_points(o) for o in scene.objects]
    point, normal = (
        torch.from_numpy(np.stack(x)).float().to(scene.device) for x in zip(*points, strict=True)
    )
    has = torch.tensor(
        [bool(o.receiver_face.any()) for o in scene.objects], dtype=torch.bool, device=scene.device
    )
    ids: Any = wp.array([m.id for m in meshes], dtype=wp.uint64, device=scene.device)
    return _Tables(meshes, ids, balls_of([v for v, _ in parts], scene.device), point, normal, has)


def region_points(
    model: ObjectModel,
) -> tuple[Float64[np.ndarray, "k 3"], Float64[np.ndarray, "k 3"]]:
    """`POINTS` points of an object's region, evenly over its area, and the surface's normals there; object frame, m. All 0
    without a region.

    Args:
        model: an object.
    """
    corners = model.vertices.astype(np.float64)[model.faces[model.receiver_face]]
    if not len(corners):
        return np.zeros((POINTS, 3)), np.zeros((POINTS, 3))
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.sqrt((cross * cross).sum(1))
    order = np.arange(POINTS)
    u = rng.uniforms(rng.key_of("region's points"), order, 3, purpose=0)
    # one in each of as many equal shares of the area
    upto = np.cumsum(area)
    face = np.minimum(np.searchsorted(upto, (order + u[0]) / POINTS * upto[-1]), len(area) - 1)
    root = np.sqrt(u[1])
    share = np.stack([1 - root, root * (1 - u[2]), root * u[2]], 1)
    return (corners[face] * share[..., None]).sum(1), cross[face] / area[face, None]
