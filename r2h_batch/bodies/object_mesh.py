"""A user's mesh file made into one closed, outward-wound surface, or a clear error.

Every repair is named in a warning, with what it did to volume and surface. Order: merge duplicate
vertices, drop degenerate and repeated faces, take edges of more than two faces apart, drop slivers,
weld, fix winding, fill holes and flat openings; what is then still open is rebuilt from its
distance field, bodies that are closed stay as they are; unite overlapping bodies, decimate.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.bodies.given.mend import (
    FLAT_M,
    apart,
    mended,
    merged,
    open_faces,
    outwards,
    without_slivers,
)
from r2h_batch.bodies.given.rebuild import MOST_FACES, decimated, joined, rebuilt, united
from r2h_batch.bodies.mesh_bodies import (
    bodies_apart,
    bodies_of,
    body_volumes,
    check_bodies,
    listed,
    thickness,
)
from r2h_batch.bodies.mesh_file import load_mesh_file
from r2h_batch.bodies.mesh_limits import MOST_GIVEN_FACES, THINNEST_M, Budget, ObjectMeshError
from r2h_batch.bodies.solid import Surface, sample_surface

__all__ = ["Closed", "ObjectMeshError", "Repair", "closed_mesh"]

SMALLEST_M, LARGEST_M, FARTHEST_M = 0.01, 2.0, 10.0
CHANGE_SAMPLES = 5000


@dataclass(frozen=True)
class Repair:
    """What was done to a mesh, and what came of it."""

    steps: tuple[str, ...]
    """in words, in order; none: the mesh is as it was given"""
    volume_given_m3: float | None
    """of the given bodies, where they overlap counted twice; None: the given surface is open"""
    volume_m3: float
    moved_m: float
    """the farthest that the new surface is from the given one, or that one outside it, over 5,000
    samples of each"""

    @property
    def text(self) -> str:
        """One line."""
        given, made = self.volume_given_m3, f"{1e6 * self.volume_m3:.4g} cm3"
        change = made
        if given is not None:
            percent = (
                round(100 * (self.volume_m3 / given - 1), 2) + 0.0
                if given > 1e-3 * self.volume_m3
                else None
            )
            share = (
                "" if percent is None else f" ({percent:+.2f} %)"
            )  # + 0.0: no minus before nothing
            change = f"{1e6 * given:.4g} -> {made}{share}"
        return f"{'; '.join(self.steps)}. Volume {change}, surface changed by up to {1e3 * self.moved_m:.2f} mm"


@dataclass(frozen=True)
class Closed:
    """A closed surface in metres, where its faces came from, and what was done."""

    mesh: trimesh.Trimesh
    source: trimesh.Trimesh
    """what was read, or the caller's mesh"""
    given: trimesh.Trimesh
    """as in the file, in metres: every face, in its order"""
    same: bool
    """whether the faces are the given ones, in their order"""
    repair: Repair


def closed_mesh(source: str | Path | trimesh.Trimesh, label: str, scale: float) -> Closed:
    """The closed outward-wound surface; repairs and bodies apart are warned of."""
    if not (np.isfinite(scale) and scale > 0):
        raise ObjectMeshError(
            f"{label}: scale is {scale}; it must be a positive number (0.001 for millimetres)"
        )
    mesh = load_mesh_file(source, label) if isinstance(source, (str, Path)) else source.copy()
    budget = Budget(label)
    source = mesh
    vertices = np.asarray(mesh.vertices, np.float64) * scale
    faces = np.asarray(mesh.faces, np.int64)
    _check(vertices, faces, label)
    done: list[str] = []
    mesh = merged(vertices, faces, done)
    same = len(mesh.faces) == len(faces)
    if not _closed(mesh):
        same = False
        mesh = _whole(mesh, budget, done)
    check_bodies(mesh, label)
    mesh, overlapping = united(mesh, budget, done)
    same &= not overlapping
    if len(mesh.faces) > MOST_FACES:
        same = False
        mesh = decimated(mesh, budget, done)
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        raise ObjectMeshError(
            f"{label}: the mesh is not a closed surface and could not be repaired "
            f"(tried: {'; '.join(done) or 'nothing'}); close it in a modelling tool"
        )
    given = trimesh.Trimesh(vertices, faces, process=False)
    repair = _change(given, mesh, tuple(done), same)
    if done:
        warnings.warn(f"{label}: mesh repaired: {repair.text}", stacklevel=4)
    if far := bodies_apart(mesh, budget):
        warnings.warn(
            f"{label}: {len(far)} bodies apart from each other (largest sides {listed(far)} m) are taken as one "
            "rigid object; delete those that do not belong to it",
            stacklevel=4,
        )
    return Closed(mesh, source, given, same, repair)


def _whole(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """The mesh repaired where faces suffice, and what is still open rebuilt beside what is
    closed."""
    mesh = without_slivers(apart(mesh, budget, done), budget, done)
    if not _closed(mesh):
        mesh = mended(mesh, budget, done)
    budget.spend("counting bodies")
    check_bodies(mesh, budget.label)
    loose = _open_bodies(mesh)
    solid = mesh.faces[~loose]
    if len(solid):
        closed = outwards(trimesh.Trimesh(mesh.vertices, solid, process=False), budget, done)
        solid = closed.faces
    if not loose.any():
        return trimesh.Trimesh(mesh.vertices, solid, process=False)
    rest = trimesh.Trimesh(mesh.vertices, mesh.faces[loose], process=False)
    rest.remove_unreferenced_vertices()
    new = rebuilt(rest, budget, done)
    if not len(solid):
        return new
    kept = trimesh.Trimesh(mesh.vertices, solid, process=False)
    kept.remove_unreferenced_vertices()
    return united(joined([kept, new]), budget, done, sure=True)[0]


def _change(
    given: trimesh.Trimesh, mesh: trimesh.Trimesh, steps: tuple[str, ...], same: bool
) -> Repair:
    """The figures of a repair."""
    rims = np.unique(
        np.sort(merged(given.vertices, given.faces, []).edges_sorted, axis=1),
        axis=0,
        return_counts=True,
    )[1]
    t = given.triangles - given.bounds.mean(axis=0)
    volume = (
        float(np.einsum("ij,ij->i", t[:, 0], np.cross(t[:, 1], t[:, 2])).sum() / 6)
        if (rims > 1).all()
        else None
    )
    if same:
        return Repair(steps, volume, float(mesh.volume), 0.0)

    def samples(of: trimesh.Trimesh) -> NDArray[np.float64]:
        corners = of.vertices[:: len(of.vertices) // CHANGE_SAMPLES + 1]
        return np.concatenate([sample_surface(of, CHANGE_SAMPLES)[0], corners])

    outside = float(
        Surface(mesh).signed(samples(given))[0].max()
    )  # what lies inside now was inside before, or between bodies
    moved = max(outside, float(Surface(given).within(samples(mesh), 10 * LARGEST_M)[0].max()))
    return Repair(steps, volume, float(mesh.volume), moved)


def _closed(mesh: trimesh.Trimesh) -> bool:
    """Closed, consistently wound, and every body encloses something (a double-sided sheet does
    not)."""
    if len(mesh.faces) == 0 or not (
        mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    ):
        return False
    volumes = body_volumes(mesh)
    thin = [thickness(volume, area) < THINNEST_M for volume, area in volumes]
    return all(thin) == any(thin) and all(
        abs(volume) > FLAT_M * area for volume, area in volumes[1:]
    )


def _open_bodies(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """(F,) the faces of bodies that have a rim, enclose nothing, or are closed sheets thinner than
    distances can be trusted beside bodies that are not."""
    body = bodies_of(mesh)
    volumes = body_volumes(mesh)
    thin = [k for k, (volume, area) in enumerate(volumes) if abs(volume) <= FLAT_M * area]
    sheets = [k for k, (volume, area) in enumerate(volumes) if thickness(volume, area) < THINNEST_M]
    chosen = thin if len(sheets) == len(volumes) else sheets
    return np.isin(body, [*np.unique(body[open_faces(mesh)]), *chosen])


def _check(vertices: NDArray[np.float64], faces: NDArray[np.int64], label: str) -> None:
    if len(faces) == 0 or len(vertices) == 0:
        raise ObjectMeshError(
            f"{label}: the mesh is empty ({len(vertices)} vertices, {len(faces)} faces)"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ObjectMeshError(
            f"{label}: a face names vertex {faces.max()}, but there are {len(vertices)} vertices"
        )
    if len(faces) > MOST_GIVEN_FACES:
        raise ObjectMeshError(
            f"{label}: {len(faces)} faces; at most {MOST_GIVEN_FACES} can be read: decimate it first"
        )
    used = vertices[np.unique(faces)]
    bad = ~np.isfinite(used).all(axis=1)
    if bad.any():
        raise ObjectMeshError(
            f"{label}: {int(bad.sum())} vertices are not finite (NaN or inf); export the mesh again"
        )
    low, high = used.min(axis=0), used.max(axis=0)
    side = float((high - low).max())
    if side > LARGEST_M:
        raise ObjectMeshError(
            f"{label}: the largest side is {side:.6g} m, allowed are {SMALLEST_M} to {LARGEST_M} m; "
            "a mesh in millimetres needs a scale of 0.001: `scale: 0.001` in a benchmark file, or in NAME.yaml beside NAME.obj in"
            " a folder for --objects, scale=0.001 in Python; or export it in metres"
        )
    if side < SMALLEST_M:
        raise ObjectMeshError(
            f"{label}: the largest side is {side:.6g} m, allowed are {SMALLEST_M} to {LARGEST_M} m; "
            "lengths are in metres: give a scale (0.01 made centimetres into metres once too often?)"
        )
    if float(np.abs((low + high) / 2).max()) > FARTHEST_M:
        raise ObjectMeshError(
            f"{label}: the object is centred at {((low + high) / 2).round(3).tolist()} m, more than {FARTHEST_M} m "
            "from the origin of its frame; move it to the origin (grasp poses are given in this frame)"
        )
