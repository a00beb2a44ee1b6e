"""The connected bodies of a mesh: which they are, whether they are bodies at all, and which hang
together."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from r2h_batch.bodies.mesh_limits import MOST_BODIES, THINNEST_M, Budget, ObjectMeshError
from r2h_batch.bodies.solid import signed_distance

__all__ = ["bodies_apart", "bodies_of", "body_volumes", "check_bodies", "listed", "thickness"]


def bodies_of(mesh: trimesh.Trimesh) -> NDArray[np.int64]:
    """(F,) the connected body of each face."""
    return np.asarray(
        trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    )


def body_volumes(mesh: trimesh.Trimesh) -> list[tuple[float, float]]:
    """(signed volume, area) of every body."""
    body = bodies_of(mesh)
    t = mesh.triangles - mesh.bounds.mean(axis=0)
    part = np.einsum("ij,ij->i", t[:, 0], np.cross(t[:, 1], t[:, 2])) / 6
    return list(
        zip(
            np.bincount(body, part).tolist(),
            np.bincount(body, mesh.area_faces).tolist(),
            strict=True,
        )
    )


def check_bodies(mesh: trimesh.Trimesh, label: str) -> None:
    """Refuse a cloud of triangles, and objects of nothing but closed sheets thinner than distances
    can be trusted."""
    volumes = body_volumes(mesh)
    if len(volumes) > MOST_BODIES:
        raise ObjectMeshError(
            f"{label}: {len(mesh.faces)} faces in {len(volumes)} bodies that do not touch; at most {MOST_BODIES} are "
            "allowed: join them into one surface in a modelling tool"
        )
    thin = [(thickness(v, a), a) for v, a in volumes if thickness(v, a) < THINNEST_M]
    if len(thin) < len(volumes) or not (mesh.is_watertight and mesh.is_winding_consistent):
        return  # beside others they are rebuilt as plates
    for thick, area in thin:
        if thick > 2e-5:
            raise ObjectMeshError(
                f"{label}: a closed sheet of {area / 2:.2g} m^2 is {thick * 1e3:.2g} mm thick on average; at least "
                f"{THINNEST_M * 1e3:g} mm are needed: give it its thickness in a modelling tool"
            )


def thickness(volume: float, area: float) -> float:
    """Mean thickness (m) of a closed sheet."""
    return 2 * abs(volume) / area if area > 0 else 0.0


def bodies_apart(mesh: trimesh.Trimesh, budget: Budget) -> list[float]:
    """Largest sides (m) of the bodies that touch no other, the largest first; [] where all hang
    together."""
    body = bodies_of(mesh)
    solids = [
        trimesh.Trimesh(mesh.vertices, mesh.faces[body == k], process=False)
        for k, (volume, _) in enumerate(body_volumes(mesh))
        if volume > 0  # the others are cavities
    ]
    if len(solids) < 2:
        return []
    for solid in solids:
        solid.remove_unreferenced_vertices()
    bounds = np.array([s.bounds for s in solids])
    close = (bounds[:, None, 0] <= bounds[None, :, 1] + THINNEST_M).all(axis=2)
    pairs = [(i, j) for i, j in np.argwhere(close & close.T) if i != j]
    touching = np.eye(len(solids), dtype=bool)
    for n, (i, j) in enumerate(pairs):
        budget.spend("measuring the gaps between its bodies", n / len(pairs))
        if not touching[i, j]:
            distance, _ = signed_distance(
                solids[i], np.concatenate([solids[j].vertices, solids[j].triangles_center])
            )
            touching[i, j] = touching[j, i] = distance.min() < THINNEST_M
    count, group = connected_components(touching, False)
    if count < 2:
        return []
    sides = [
        (bounds[group == g, 1].max(axis=0) - bounds[group == g, 0].min(axis=0)).max()
        for g in range(count)
    ]
    return sorted(map(float, sides), reverse=True)


def listed(sides: list[float], most: int = 5) -> str:
    return ", ".join(f"{s:.3g}" for s in sides[:most]) + (", ..." if len(sides) > most else "")
