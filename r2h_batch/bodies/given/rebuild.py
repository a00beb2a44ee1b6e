"""What no face can be added to: a closed surface made anew from a distance field, and closed ones
made smaller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from r2h_batch.bodies.given.edges import split_edges
from r2h_batch.bodies.given.lattice import Lattice
from r2h_batch.bodies.mesh_bodies import bodies_of, body_volumes
from r2h_batch.bodies.mesh_limits import Budget, ObjectMeshError
from r2h_batch.bodies.solid import Surface, signed_distance, winding_number

__all__ = ["decimated", "joined", "rebuilt", "simplified_to", "united"]

MOST_FACES = 20_000
REBUILD_FACES = 10_000
REBUILD_POINTS = 600_000
FINEST_M = 2.5e-4
"""Plates of a finer grid would be thinner than distances can be trusted."""
PLATE = 0.65
"""Half a plate's thickness in grid pitches: less would leave holes between the nodes."""
APART = 0.02
"""Open bodies farther apart than this share of the largest side are rebuilt apart, each on a grid
of its own."""

SPECK_CELLS = 4

Tick = Callable[[float], None]


def rebuilt(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """Closed surfaces around open ones: around what has winding number above 0.5, if that stays
    near the given surface everywhere; else open sheets become plates (a cup drawn as one sheet
    stays hollow)."""
    _manifold3d(budget.label, "close its surface")
    return joined([_rebuilt_group(part, budget, done) for part in _groups(mesh)])


def joined(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """All faces of the meshes, in order."""
    first = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    faces = [np.asarray(m.faces) + n for m, n in zip(meshes, first, strict=False)]
    return trimesh.Trimesh(
        np.concatenate([m.vertices for m in meshes]), np.concatenate(faces), process=False
    )


def _rebuilt_group(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    low, high = mesh.bounds
    sides = np.maximum(high - low, FINEST_M)
    pitch = max(
        float(sides.max()) / 160, (float(sides.prod()) * 2 / REBUILD_POINTS) ** (1 / 3), FINEST_M
    )
    plate = PLATE * pitch
    tick = partial(budget.spend, f"rebuilding the surface of {len(mesh.faces)} faces")
    lattice, surface = Lattice(mesh.bounds, pitch), Surface(mesh)
    distance, opening = lattice.distance(surface, tick)
    how, new, lost, gained, out = "", None, np.inf, opening, 0.0
    if opening <= 2 * pitch:
        new, lost, gained, out = _contoured(mesh, surface, lattice, -distance, tick)
    if lost > pitch or gained > 2 * pitch:
        field = plate - np.abs(distance)
        if gained <= 2 * pitch:
            field = np.maximum(field, -distance)
        new, lost, gained, out = _contoured(mesh, surface, lattice, field, tick)
        how = f", open sheets made {2e3 * (plate + out):.2f} mm thick"
    if out:
        how += f", {out * 1e3:.2f} mm farther out than given, where manifold3d does not fail"
    if new is None:
        raise ObjectMeshError(
            f"{budget.label}: the surface encloses nothing that can be rebuilt; give a mesh of a solid"
        )
    done.append(
        f"surface rebuilt from its distance field at {pitch * 1e3:.2f} mm{how}, "
        f"largest deviation {max(lost, gained) * 1e3:.2f} mm"
    )
    return new


def _contoured(
    mesh: trimesh.Trimesh,
    surface: Surface,
    lattice: Lattice,
    field: NDArray[np.float64],
    tick: Tick,
) -> tuple[trimesh.Trimesh | None, float, float, float]:
    """The surface where the field is zero, how far the given one sticks out of it, how far it is
    from that one, and by how much `Lattice.solid` had to move it out."""
    if not (field > 0).any():
        return None, np.inf, 0.0, 0.0
    found, out = lattice.solid(field)
    if found is None:
        return None, np.inf, 0.0, 0.0
    solid, _ = _simplified(found, 0.02 * lattice.pitch, REBUILD_FACES, tick)
    new = _without_specks(_from_solid(solid), lattice.pitch)
    rng = np.random.Generator(np.random.Philox(key=7))
    face = rng.choice(len(mesh.faces), 20_000, p=mesh.area_faces / mesh.area)
    samples = np.einsum("ij,ijk->ik", rng.dirichlet((1, 1, 1), len(face)), mesh.triangles[face])
    lost = float(signed_distance(new, samples, tick)[0].max())
    gained = float(
        surface.within(np.concatenate([new.vertices, new.triangles_center]), surface.size, tick)[
            0
        ].max()
    )
    return new, max(lost, 0.0), gained, out


def _without_specks(mesh: trimesh.Trimesh, pitch: float) -> trimesh.Trimesh:
    """The surface without bodies and voids of a few grid cells: what is left of places where the
    field barely passes zero."""
    speck = [
        k
        for k, (volume, _) in enumerate(body_volumes(mesh))
        if abs(volume) < SPECK_CELLS * pitch**3
    ]
    left = ~np.isin(bodies_of(mesh), speck)
    return _part(mesh, left) if left.any() else mesh


def _groups(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """The mesh's bodies, those together whose bounding boxes are near each other."""
    body = bodies_of(mesh)
    t = mesh.triangles
    low, high = (np.empty((body.max() + 1, 3)) for _ in range(2))
    low[:], high[:] = np.inf, -np.inf
    np.minimum.at(low, body, t.min(axis=1))
    np.maximum.at(high, body, t.max(axis=1))
    gap = APART * float(mesh.extents.max())
    close = (low[:, None] <= high[None] + gap).all(axis=2)
    group = connected_components(close & close.T, directed=False)[1][body]
    return [_part(mesh, group == g) for g in range(group.max() + 1)]


def _part(mesh: trimesh.Trimesh, faces: NDArray[np.bool_]) -> trimesh.Trimesh:
    part = trimesh.Trimesh(mesh.vertices, mesh.faces[faces], process=False)
    part.remove_unreferenced_vertices()
    return part


def united(
    mesh: trimesh.Trimesh, budget: Budget, done: list[str], *, sure: bool = False
) -> tuple[trimesh.Trimesh, bool]:
    """Bodies that run into one another made into one surface, so that the inside is counted once,
    and whether there were any; `sure`: they are known to overlap, by less than 64 lines in each
    direction may see."""
    body = bodies_of(mesh)
    if body.max() == 0 or not (sure or int(winding_number(mesh, 64).max()) > 1):
        return mesh, False
    manifold = _manifold3d(budget.label, "unite its overlapping bodies")
    total = manifold.Manifold()
    hollow = manifold.Manifold()
    volumes = body_volumes(mesh)
    for k, (volume, _) in enumerate(volumes):
        budget.spend(f"uniting {len(volumes)} bodies", k / len(volumes))
        faces = mesh.faces[body == k]
        solid = _solid(manifold, mesh.vertices, faces if volume > 0 else faces[:, ::-1])
        if solid.is_empty():
            return rebuilt(mesh, budget, done), True
        if volume > 0:
            total += solid
        else:
            hollow += solid
    done.append(f"united {int(body.max()) + 1} overlapping bodies")
    return _from_solid(total - hollow), True


def decimated(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """The closed mesh with at most `MOST_FACES` faces."""
    manifold = _manifold3d(budget.label, f"decimate its {len(mesh.faces)} faces to {MOST_FACES}")
    solid = _solid(manifold, mesh.vertices, mesh.faces)
    if solid.is_empty():
        return rebuilt(mesh, budget, done)
    tick = partial(budget.spend, f"decimating {len(mesh.faces)} faces")
    small, moved = _simplified(solid, 2e-5 * float(mesh.extents.max()), MOST_FACES, tick)
    done.append(
        f"decimated {len(mesh.faces)} faces to {small.num_tri()}, surface moved by less than {moved * 1e3:.3f} mm"
    )
    return _from_solid(small)


def simplified_to(mesh: trimesh.Trimesh, tolerance: float) -> trimesh.Trimesh:
    """A closed mesh with less detail than `tolerance` (m); as it is where manifold3d is missing or
    does not take it."""
    try:
        solid = _solid(
            _manifold3d("", ""), np.asarray(mesh.vertices), np.asarray(mesh.faces)
        ).simplify(tolerance)
    except ObjectMeshError:
        return mesh
    return mesh if solid.is_empty() else _from_solid(solid)


def _simplified(solid: Any, tolerance: float, most: int, tick: Tick) -> tuple[Any, float]:
    """At most ``most`` faces, and the distance (m) below which its surface moved."""
    moved = tolerance
    small = solid.simplify(tolerance)
    while small.num_tri() > most:
        tick(most / small.num_tri())
        tolerance *= 1.5
        moved += tolerance
        small = small.simplify(tolerance)
    return small, moved


def _manifold3d(label: str, purpose: str) -> Any:
    try:
        import manifold3d
    except ImportError as error:
        raise ObjectMeshError(
            f"{label}: manifold3d is needed to {purpose}; `pip install r2h_batch[build]`, or repair the mesh first"
        ) from error
    return manifold3d


def _solid(manifold: Any, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Any:
    used, local = np.unique(faces, return_inverse=True)
    return manifold.Manifold(
        manifold.Mesh64(
            np.ascontiguousarray(vertices[used], np.float64), local.reshape(-1, 3).astype(np.uint64)
        )
    )


def _from_solid(solid: Any) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    made = trimesh.Trimesh(
        np.asarray(mesh.vert_properties)[:, :3],
        np.asarray(mesh.tri_verts).astype(np.int64),
        process=False,
    )
    return split_edges(made, lambda share: None)[0]  # a manifold may pass through one edge twice
