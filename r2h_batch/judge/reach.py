"""Reach: where an object's solid, or its hull, is nearest to a point."""

from dataclasses import dataclass

from jaxtyping import Float32, Int32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.config import FARTHEST_M
from r2h_batch.kernels.judge import reach as kernels
from r2h_batch.scene.scene import Scene


@dataclass(frozen=True)
class Reached:
    """Where B objects are nearest to a point each."""

    distance_m: Float32[Tensor, " b"]
    """0 inside"""
    nearest: Float32[Tensor, "b 3"]
    """of the object, in its frame, m"""


def reached(
    scene: Scene,
    objects: Int32[Tensor, " b"],
    point: Float32[Tensor, "b 3"],
    *,
    solid: bool = False,
) -> Reached:
    """How far points are from what Reach measures of their objects.

    Args:
        scene: with the objects' surfaces.
        objects: (B,) int32 rows of `Scene.objects`.
        point: (B, 3) float32, object frame, m.
        solid: from the solids, also with `reach="hull"`.
    """
    made = over_trials(kernels.point_to_object, len(point), scene.device, chunk=64)(
        cap=FARTHEST_M,
        surfaces=scene.grasp_tables.surfaces if solid else scene.reach_surfaces,
        mesh=scene.object_mesh_ids if solid else scene.reach_mesh_ids,
        object=objects,
        point=point,
    )
    return Reached(made["distance"], made["nearest"])
