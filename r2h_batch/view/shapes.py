"""What is drawn, as surfaces: the geoms of a compiled trial in the frames of their bodies."""

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]

COARSE_M = 0.002
"""The robot's meshes are drawn with their vertices on a grid this wide: a fifth of the faces,
nothing one sees."""
COARSE_FROM = 4000
"""Faces; smaller meshes are drawn as they are."""


@dataclass(frozen=True)
class Shape:
    """A surface in a body's frame: vertices (V, 3) in m, faces (F, 3); where it stands in the body;
    its colour, 0 to 1."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    pos: Array
    quat_wxyz: Array
    rgba: NDArray[np.float32]


def shape_of(model: mujoco.MjModel, geom: int) -> Shape:
    """A geom of the model, as its body carries it."""
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        k = int(model.geom_dataid[geom])
        v, f = int(model.mesh_vertadr[k]), int(model.mesh_faceadr[k])
        vertices = model.mesh_vert[v : v + model.mesh_vertnum[k]]
        faces = model.mesh_face[f : f + model.mesh_facenum[k]]
        if len(faces) > COARSE_FROM and model.mesh(k).name.startswith("robot_"):
            vertices, faces = _coarse_robot(model.mesh(k).name, vertices.tobytes(), faces.tobytes())
    else:
        made = _primitive(kind, tuple(map(float, size)))
        vertices, faces = np.asarray(made.vertices), np.asarray(made.faces)
    return Shape(
        np.asarray(vertices, np.float32), np.asarray(faces, np.uint32), model.geom_pos[geom].copy(),
        model.geom_quat[geom].copy(), model.geom_rgba[geom].copy(),
    )  # fmt: skip


def _primitive(kind: mujoco.mjtGeom, size: tuple[float, ...]) -> trimesh.Trimesh:
    """MuJoCo's sizes: half sides of a box, radius and half length along z."""
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * np.array(size))
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=32)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        made = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[16, 16])
        made.apply_translation(
            [0, 0, -float(made.bounds.mean(0)[2])]
        )  # its middle, whatever this version calls its origin
        return made
    raise ValueError(f"{kind.name} is not a shape of an exported trial")


@lru_cache(maxsize=16)
def _coarse_robot(_: str, vertices: bytes, faces: bytes) -> tuple[Array, NDArray[np.int64]]:
    v = np.frombuffer(vertices, np.float32).reshape(-1, 3).astype(np.float64)
    return coarse(v, np.frombuffer(faces, np.int32).reshape(-1, 3).astype(np.int64))


def coarse(
    vertices: Array, faces: NDArray[np.int64], cell_m: float = COARSE_M
) -> tuple[Array, NDArray[np.int64]]:
    """The surface with all vertices of a grid's cell joined at their mean; triangles that fall
    together are left out.

    No point moves farther than the cell's diagonal.
    """
    cells = np.floor(vertices / cell_m).astype(np.int64)
    _, inverse, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    joined = np.zeros((len(count), 3))
    np.add.at(joined, inverse, vertices)
    joined /= count[:, None]
    f = inverse[faces]
    f = f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 0] != f[:, 2])]
    turned = np.take_along_axis(
        f, (np.arange(3) + f.argmin(1)[:, None]) % 3, axis=1
    )  # same triangle, same row
    return joined, np.unique(turned, axis=0)
