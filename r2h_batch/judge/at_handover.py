"""What a criterion may ask about the moment of the handover: where things are in the world, and how far a point is from them.

`metrics.Evidence` has all of it as its own. The distances are those of Presented (`kernels.judge.presented`).
"""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import over_trials
from r2h_batch.base.validate import one_of
from r2h_batch.base.validate_tensors import check_tensor
from r2h_batch.config import FARTHEST_M
from r2h_batch.judge.attach import AttachedBatch
from r2h_batch.kernels.judge import presented as kernels
from r2h_batch.scene.scene import Scene

Role = Literal["object", "wanted", "sharp"]
ROLES = ("object", "wanted", "sharp")
"""Parts of an object: all of it; the receiver's region in S1, all of it in S0; its sharp parts."""
MEASURED = {
    "gripper": kernels.OF_GRIPPER,
    "object": kernels.OF_OBJECT,
    "wanted": kernels.OF_WANTED,
    "sharp": kernels.OF_SHARP,
}


class Palm(NamedTuple):
    """The receiver's palms in the world, (B, 3) each."""

    point: Tensor
    """p_h, m"""
    normal: Tensor
    """n_h, out of the palm"""
    ball: Tensor
    """c_h, the middle of the ball that the object has to meet, m"""


def T_world_obj(held: AttachedBatch) -> Float32[Tensor, "b 4 4"]:
    """Where the objects are once the pads have closed, m; the identity in rows that are not judged."""
    return se3.matmul(held.T_world_ee, se3.inverse(held.attached))


def points(
    scene: Scene, held: AttachedBatch, role: Role
) -> tuple[Float32[Tensor, "b p 3"], Bool[Tensor, "b p"]]:
    """Points on the surface of each object, and which of them are of a part.

    Args:
        scene: the objects.
        held: B trials.
        role: of `ROLES`.

    Returns:
        (B, P, 3) in the world, m, and (B, P) which of them count: none where an object has no such part.
    """
    one_of(*ROLES)("role", role)
    local, of_part = scene.surface_points
    rows = held.objects.long()
    return se3.apply(T_world_obj(held)[:, None], local[rows]), of_part[role][rows]


def checked_points(point: object, n: int) -> Float32[Tensor, "b 3"]:
    """A point for each of n trials, as float32.

    Args:
        point: what the caller gave.
        n: number of trials.

    Raises:
        TypeError, ValueError: it is no tensor of real numbers, or has another shape: kernels would read other memory.
    """
    words = f"a torch tensor ({n}, 3), a point for each row"
    found = check_tensor("point", point, words)
    if found.shape != (n, 3) or not found.is_floating_point():
        raise ValueError(f"point is {found.dtype} {tuple(found.shape)}; it must be {words}")
    return found.float()


def distance(
    scene: Scene, held: AttachedBatch, point: Float32[Tensor, "b 3"], to: str
) -> Float32[Tensor, " b"]:
    """How far points are from gripper or object.

    Args:
        scene: with surfaces, regions and sharp parts.
        held: B trials.
        point: (B, 3) float32 in the world, m.
        to: of `MEASURED`.

    Returns:
        (B,) m: 0 inside of gripper or object, inf where the object has no such part, NaN in rows that are not judged and of
        points that are NaN.
    """
    regions, sharp, bodies = scene.regions, scene.sharp, held.body_poses
    made = over_trials(kernels.distance_of, len(point), scene.device, chunk=64)(
        cap=FARTHEST_M,
        part=int(MEASURED[to]),
        surfaces=scene.grasp_tables.surfaces,
        mesh=scene.object_mesh_ids,
        regions=regions.surfaces,
        region_offset=regions.offset,
        region_mesh=regions.mesh_ids,
        sharp=sharp.surfaces,
        sharp_mesh=sharp.mesh_ids,
        gripper=scene.grasp_tables.gripper,
        active=held.active,
        object=held.objects,
        attached=held.attached,
        T_world_ee=held.T_world_ee,
        R_wrist_grip=bodies.R_wrist_grip,
        p_wrist_grip=bodies.p_wrist_grip,
        R_wrist_obj=bodies.R_wrist_obj,
        p_wrist_obj=bodies.p_wrist_obj,
        point=point.contiguous(),
    )
    # no bound of the search leaves out NaN: it would be as far as the search looks
    found: Tensor = torch.where(point.isnan().any(1), torch.nan, made["distance"])
    return found


def head_distance(
    head: Float32[Tensor, "b 2 4"], point: Float32[Tensor, "b 3"]
) -> Float32[Tensor, " b"]:
    """How far points are from heads, m; negative inside.

    Args:
        head: (B, 2, 4) of `scene.person.heads_of`.
        point: (B, 3) in the world, m.
    """
    low, high, radius = head[:, 0, :3], head[:, 1, :3], head[:, 0, 3]
    along = high - low
    share = (((point - low) * along).sum(1) / (along * along).sum(1)).clamp(0, 1)
    return (point - low - share[:, None] * along).norm(dim=1) - radius
