"""Bodies of a mesh, and closed surfaces united or made simpler by manifold3d."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from manifold3d import Manifold, Mesh64
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from r2h_batch.scene.mesh_import.limits import Budget


def connected_bodies(
    mesh: trimesh.Trimesh,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """(F,) body of each face, faces that share an edge being one; volume and area of each body."""
    count = len(mesh.faces)
    edge = edge_numbers(mesh)
    ends = mesh.edges_face, count + edge
    nodes = count + len(edge)
    graph = coo_matrix((np.ones(len(edge)), ends), (nodes, nodes))
    body = np.unique(connected_components(graph, False)[1][:count], return_inverse=True)[1]
    t = mesh.triangles - mesh.bounds.mean(axis=0)
    volume = np.einsum("ij,ij->i", t[:, 0], np.cross(t[:, 1], t[:, 2])) / 6
    return (
        body.astype(np.int64),
        np.bincount(body, volume).astype(np.float64),
        np.bincount(body, mesh.area_faces).astype(np.float64),
    )


def edge_numbers(mesh: trimesh.Trimesh) -> NDArray[np.int64]:
    """(3 F,) number of each edge of `mesh.edges`, the same one for both directions, in the order of their corners."""
    low, high = mesh.edges_sorted.T
    # one whole number for both: sorting rows takes five times as long
    _, edge = np.unique(low * np.int64(len(mesh.vertices)) + high, return_inverse=True)
    return edge.reshape(-1).astype(np.int64)


def joined(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """All faces of the meshes, in order."""
    first = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    faces = [np.asarray(m.faces) + n for m, n in zip(meshes, first, strict=False)]
    vertices = np.concatenate([m.vertices for m in meshes])
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


def part_of(mesh: trimesh.Trimesh, faces: NDArray[np.bool_]) -> trimesh.Trimesh:
    """The chosen faces (F,) with their vertices."""
    part = trimesh.Trimesh(mesh.vertices, mesh.faces[faces], process=False)
    part.remove_unreferenced_vertices()
    return part


def united(mesh: trimesh.Trimesh, budget: Budget) -> trimesh.Trimesh | None:
    """Closed bodies that overlap as one surface; None where manifold3d does not take a body.

    Bodies wound inwards are taken away from the others.
    """
    body, volumes, _ = connected_bodies(mesh)
    total, hollow = Manifold(), Manifold()
    for k, volume in enumerate(volumes):
        budget.spend(f"uniting {len(volumes)} bodies", k / len(volumes))
        part = part_of(mesh, body == k)
        if volume < 0:
            part.invert()
        solid = _solid(part)
        if solid.is_empty():
            return None
        if volume > 0:
            total += solid
        else:
            hollow += solid
    return _from_solid(total - hollow)


def simplified(
    mesh: trimesh.Trimesh, tolerance: float, most: int, budget: Budget
) -> tuple[trimesh.Trimesh, float]:
    """A closed mesh with at most `most` faces, and the distance (m) below which it moved.

    The mesh is empty where manifold3d does not take it.
    """
    solid = _solid(mesh)
    if solid.is_empty():
        return trimesh.Trimesh(), 0.0
    small, moved = solid.simplify(tolerance), tolerance
    while small.num_tri() > most:
        budget.spend(f"decimating {len(mesh.faces)} faces", most / small.num_tri())
        tolerance *= 1.5
        moved += tolerance
        small = small.simplify(tolerance)
    return _from_solid(small), moved


def simplified_to(mesh: trimesh.Trimesh, tolerance: float) -> trimesh.Trimesh:
    """A closed mesh with less detail than `tolerance` (m); unchanged where manifold3d does not take
    it."""
    solid = _solid(mesh).simplify(tolerance)
    return mesh if solid.is_empty() else _from_solid(solid)


def _solid(mesh: trimesh.Trimesh) -> Manifold:
    vertices = np.array(mesh.vertices, np.float64, order="C")
    return Manifold(Mesh64(vertices, np.array(mesh.faces, np.uint64, order="C")))


def _from_solid(solid: Manifold) -> trimesh.Trimesh:
    mesh: Any = solid.to_mesh64()
    return trimesh.Trimesh(
        np.asarray(mesh.vert_properties)[:, :3],
        np.asarray(mesh.tri_verts).astype(np.int64),
        process=False,
    )
