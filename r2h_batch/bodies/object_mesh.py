"""A user's mesh file made into one closed, outward-wound surface, or a clear error.

Every repair is named in a warning. Order: merge duplicate vertices, drop degenerate and repeated faces, fix winding,
fill holes, unite overlapping bodies, rebuild the surface from its distance field, decimate.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from r2h_batch.bodies.mesh_bodies import bodies_apart, bodies_of, body_volumes, check_bodies, listed
from r2h_batch.bodies.mesh_file import load_mesh_file
from r2h_batch.bodies.mesh_limits import (
    MOST_GIVEN_FACES,
    MOST_TURNED_FACES,
    Budget,
    ObjectMeshError,
)
from r2h_batch.bodies.solid import level_set_solid, signed_distance, winding_number

__all__ = ["ObjectMeshError", "closed_mesh"]

SMALLEST_M, LARGEST_M, FARTHEST_M = 0.01, 2.0, 10.0
MOST_FACES = 20_000
REBUILD_FACES = 10_000
REBUILD_POINTS = 600_000
WELD_M = 1e-5
MOST_WELDS = 64
HOLE_SHARE = 0.25
"""a hole is filled when its rim is no longer than this share of pi times the largest side: a cup's mouth is no hole"""


def closed_mesh(source: str | Path | trimesh.Trimesh, label: str, scale: float) -> tuple[trimesh.Trimesh, bool]:
    """The closed outward-wound surface in metres, and whether its faces differ from the ones given."""
    if not (np.isfinite(scale) and scale > 0):
        raise ObjectMeshError(f"{label}: scale is {scale}; it must be a positive number (0.001 for millimetres)")
    mesh = load_mesh_file(source, label) if isinstance(source, (str, Path)) else source.copy()
    budget = Budget(label)
    vertices = np.asarray(mesh.vertices, np.float64) * scale
    faces = np.asarray(mesh.faces, np.int64)
    _check(vertices, faces, label)
    done: list[str] = []
    mesh = _merged(vertices, faces, done)
    changed = len(mesh.faces) != len(faces)
    if not _closed(mesh):
        changed = True
        mesh = _mended(mesh, budget, done)
    budget.spend("counting bodies")
    check_bodies(mesh, label)
    if not _closed(mesh):
        mesh = _rebuilt(mesh, budget, done)
    else:
        mesh, united = _united(mesh, budget, done)
        changed |= united
    if len(mesh.faces) > MOST_FACES:
        changed = True
        mesh = _decimated(mesh, budget, done)
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        raise ObjectMeshError(
            f"{label}: the mesh is not a closed surface and could not be repaired "
            f"(tried: {'; '.join(done) or 'nothing'}); close it in a modelling tool"
        )
    if done:
        warnings.warn(f"{label}: mesh repaired: {'; '.join(done)}", stacklevel=4)
    if apart := bodies_apart(mesh, budget):
        warnings.warn(
            f"{label}: {len(apart)} bodies apart from each other (largest sides {listed(apart)} m) are taken as one "
            "rigid object; delete those that do not belong to it",
            stacklevel=4,
        )
    return mesh, changed


def _check(vertices: NDArray[np.float64], faces: NDArray[np.int64], label: str) -> None:
    if len(faces) == 0 or len(vertices) == 0:
        raise ObjectMeshError(f"{label}: the mesh is empty ({len(vertices)} vertices, {len(faces)} faces)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ObjectMeshError(f"{label}: a face names vertex {faces.max()}, but there are {len(vertices)} vertices")
    if len(faces) > MOST_GIVEN_FACES:
        raise ObjectMeshError(f"{label}: {len(faces)} faces; at most {MOST_GIVEN_FACES} can be read: decimate it first")
    used = vertices[np.unique(faces)]
    bad = ~np.isfinite(used).all(axis=1)
    if bad.any():
        raise ObjectMeshError(f"{label}: {int(bad.sum())} vertices are not finite (NaN or inf); export the mesh again")
    low, high = used.min(axis=0), used.max(axis=0)
    side = float((high - low).max())
    if side > LARGEST_M:
        raise ObjectMeshError(
            f"{label}: the largest side is {side:.6g} m, allowed are {SMALLEST_M} to {LARGEST_M} m; "
            "a mesh in millimetres needs scale=0.001 (or export it in metres)"
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


def _merged(vertices: NDArray[np.float64], faces: NDArray[np.int64], done: list[str]) -> trimesh.Trimesh:
    """Duplicate vertices merged, faces without three corners and repeated faces dropped, loose vertices dropped."""
    used = np.unique(faces)
    _, first, same = np.unique(vertices[used], axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # keeps the file's order of vertices
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    if len(first) < len(used):
        done.append(f"merged {len(used) - len(first)} duplicate vertices")
    lookup = np.zeros(len(vertices), np.int64)
    lookup[used] = rank[same.reshape(-1)]
    return _cleaned(vertices[used[first[order]]], lookup[faces], done)


def _cleaned(vertices: NDArray[np.float64], faces: NDArray[np.int64], done: list[str]) -> trimesh.Trimesh:
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not whole.all():
        done.append(f"dropped {int((~whole).sum())} degenerate faces")
    faces = faces[whole]
    turn = np.argmin(faces, axis=1)[:, None]
    turned = np.take_along_axis(faces, (turn + np.arange(3)) % 3, axis=1)
    _, first = np.unique(turned, axis=0, return_index=True)
    if len(first) < len(faces):
        done.append(f"dropped {len(faces) - len(first)} repeated faces")
    mesh = trimesh.Trimesh(vertices, faces[np.sort(first)], process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def _closed(mesh: trimesh.Trimesh) -> bool:
    """Closed, consistently wound, and every body encloses something (a double-sided sheet does not)."""
    if len(mesh.faces) == 0 or not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        return False
    return all(abs(volume) > 1e-5 * area for volume, area in body_volumes(mesh)[1:])


def _mended(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """The mesh after welding, filling of small holes and winding repair."""
    if not mesh.is_watertight:
        budget.spend("looking for vertices to weld")
        tree = cKDTree(mesh.vertices)
        near_count = int(tree.count_neighbors(tree, WELD_M))  # a heap of vertices in one place has a square of pairs
        if near_count > MOST_WELDS * len(mesh.vertices):
            raise ObjectMeshError(
                f"{budget.label}: {near_count} pairs of vertices are nearer than {WELD_M * 1e3:g} mm; merge them first"
            )
        pairs = tree.query_pairs(WELD_M, output_type="ndarray")
        if len(pairs):
            count = len(mesh.vertices)
            near = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count))
            _, first, same = np.unique(connected_components(near, False)[1], return_index=True, return_inverse=True)
            notes: list[str] = []
            welded = _cleaned(mesh.vertices[first], same.reshape(-1)[mesh.faces], notes)
            if _open_edges(welded) < _open_edges(mesh):
                done += [f"welded {count - len(first)} vertices nearer than {WELD_M * 1e3:g} mm", *notes]
                mesh = welded
    budget.spend("turning faces")
    if not mesh.is_winding_consistent:
        if len(mesh.faces) > MOST_TURNED_FACES:
            raise ObjectMeshError(
                f"{budget.label}: {len(mesh.faces)} faces that do not agree which side is outside; at most "
                f"{MOST_TURNED_FACES} can be turned: orient the surface, or decimate it first"
            )
        before = mesh.faces.copy()
        trimesh.repair.fix_winding(mesh)
        turned = int((before != mesh.faces).any(axis=1).sum())
        if turned and mesh.is_winding_consistent:
            done.append(f"turned {turned} faces to agree with their neighbours")
    budget.spend("filling holes")
    if not mesh.is_watertight:
        mesh = _filled(mesh, done)
    if mesh.is_watertight and mesh.is_winding_consistent:
        body = bodies_of(mesh)
        budget.spend("looking for bodies that are inside out")
        inside_out = [k for k, (volume, _) in enumerate(body_volumes(mesh)) if volume < 0]
        if mesh.volume < 0 or (inside_out and not _cavities(mesh, body, inside_out)):
            faces = mesh.faces.copy()
            chosen = np.isin(body, inside_out)
            faces[chosen] = faces[chosen][:, ::-1]
            done.append(f"turned {len(inside_out)} inside-out bodies outwards")
            mesh = trimesh.Trimesh(mesh.vertices, faces, process=False)
    return mesh


def _open_edges(mesh: trimesh.Trimesh) -> int:
    _, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    return int((count != 2).sum())


def _cavities(mesh: trimesh.Trimesh, body: NDArray[np.int64], inward: list[int]) -> bool:
    """Whether every inward-wound body lies inside an outward one: a hollow, not a mistake."""
    outer = trimesh.Trimesh(mesh.vertices, mesh.faces[~np.isin(body, inward)], process=False)
    if len(outer.faces) == 0:
        return False
    probes = np.array([mesh.triangles_center[np.argmax(body == k)] for k in inward])
    return bool((signed_distance(outer, probes)[0] < 0).all())


def _filled(mesh: trimesh.Trimesh, done: list[str]) -> trimesh.Trimesh:
    """Small holes closed by a fan around the middle of their rim."""
    edges = mesh.edges
    _, group, count = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    rim = edges[count[group.reshape(-1)] == 1]
    follow: dict[int, list[int]] = {}
    for a, b in rim:
        follow.setdefault(int(b), []).append(int(a))  # the fan runs against the faces it joins
    limit = HOLE_SHARE * np.pi * float(mesh.extents.max())
    vertices, faces, holes, middle = [np.asarray(mesh.vertices)], [np.asarray(mesh.faces)], 0, len(mesh.vertices)
    used: set[int] = set()
    for start in sorted(follow):
        loop = [start]
        while loop[-1] not in used and len(follow.get(loop[-1], ())) == 1:
            used.add(loop[-1])
            loop.append(follow[loop[-1]][0])
        if len(loop) < 4 or loop[-1] != start:
            continue
        ring = mesh.vertices[loop[:-1]]
        if float(np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum()) > limit:
            continue
        holes += 1
        if len(ring) == 3:
            faces.append(np.array([loop[:3]]))
            continue
        vertices.append(ring.mean(axis=0)[None])
        faces.append(np.array([(a, b, middle) for a, b in itertools.pairwise(loop)]))
        middle += 1
    if holes == 0:
        return mesh
    done.append(f"filled {holes} holes")
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)


def _united(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> tuple[trimesh.Trimesh, bool]:
    """Bodies that run into one another made into one surface, so that the inside is counted once."""
    body = bodies_of(mesh)
    if body.max() == 0 or int(winding_number(mesh, 64).max()) <= 1:
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
            return _rebuilt(mesh, budget, done), True
        if volume > 0:
            total += solid
        else:
            hollow += solid
    done.append(f"united {int(body.max()) + 1} overlapping bodies")
    return _from_solid(total - hollow), True


def _rebuilt(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """A closed surface around what has winding number above 0.5, if that stays near the given surface everywhere;
    else open sheets become plates, closed bodies stay solid: a cup drawn as one sheet stays hollow."""
    _manifold3d(budget.label, "close its surface")
    low, high = mesh.bounds
    edge = max(float((high - low).max()) / 160, (float((high - low).prod()) * 2 / REBUILD_POINTS) ** (1 / 3))
    plate = 0.65 * edge
    sheets, solids = _open_bodies(mesh)
    tick = partial(budget.spend, f"rebuilding the surface of {len(mesh.faces)} faces")

    def full(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return -signed_distance(mesh, p, tick)[0]

    def with_plates(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.maximum(solid(p), plate - np.abs(signed_distance(sheets, p, tick)[0]))

    def all_thicker(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.maximum(solid(p), plate - np.abs(signed_distance(mesh, p, tick)[0]))

    def closed_only(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return -signed_distance(solids, p, tick)[0] if len(solids.faces) else np.full(len(p), -np.inf)

    how = ""
    new, lost, gained = _contoured(mesh, full, edge, tick)
    solid = full if gained <= 2 * edge else closed_only
    if (lost > edge or solid is closed_only) and len(sheets.faces):
        new, lost, gained = _contoured(mesh, with_plates, edge, tick)
        how = f", open sheets made {2e3 * plate:.2f} mm thick"
    if lost > edge:
        new, lost, gained = _contoured(mesh, all_thicker, edge, tick)
        how = f", every surface grown by {1e3 * plate:.2f} mm to keep thin parts"
    if new is None:
        raise ObjectMeshError(f"{budget.label}: the surface encloses nothing; give a mesh of a solid")
    done.append(
        f"surface rebuilt from its distance field at {edge * 1e3:.2f} mm{how}, "
        f"largest deviation {max(lost, gained) * 1e3:.2f} mm"
    )
    return new


def _contoured(
    mesh: trimesh.Trimesh,
    inside: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    edge: float,
    tick: Callable[[float], None],
) -> tuple[trimesh.Trimesh | None, float, float]:
    """The surface where the field is zero, how far the given one sticks out of it, and how far it is from that one."""
    low, high = mesh.bounds
    solid = level_set_solid(inside, [*(low - 3 * edge), *(high + 3 * edge)], edge)
    if solid.is_empty():
        return None, np.inf, 0.0
    new = _from_solid(_simplified(solid, 0.02 * edge, REBUILD_FACES, tick)[0])
    rng = np.random.Generator(np.random.Philox(key=7))
    face = rng.choice(len(mesh.faces), 20_000, p=mesh.area_faces / mesh.area)
    samples = np.einsum("ij,ijk->ik", rng.dirichlet((1, 1, 1), len(face)), mesh.triangles[face])
    lost = float(signed_distance(new, samples, tick)[0].max())
    gained = float(np.abs(signed_distance(mesh, np.concatenate([new.vertices, new.triangles_center]), tick)[0]).max())
    return new, max(lost, 0.0), gained


def _open_bodies(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """The bodies that have a rim, are not manifold, or enclose nothing; and the others."""
    body = bodies_of(mesh)
    _, group, count = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    loose = np.unique(body[mesh.edges_face[count[group.reshape(-1)] != 2]])
    flat = [k for k, (volume, area) in enumerate(body_volumes(mesh)) if abs(volume) < 1e-5 * area]
    is_open = np.isin(body, [*loose, *flat])
    return (
        trimesh.Trimesh(mesh.vertices, mesh.faces[is_open], process=False),
        trimesh.Trimesh(mesh.vertices, mesh.faces[~is_open], process=False),
    )


def _simplified(solid: Any, tolerance: float, most: int, tick: Callable[[float], None]) -> tuple[Any, float]:
    """At most ``most`` faces, and the distance (m) below which its surface moved."""
    moved = tolerance
    small = solid.simplify(tolerance)
    while small.num_tri() > most:
        tick(most / small.num_tri())
        tolerance *= 1.5
        moved += tolerance
        small = small.simplify(tolerance)
    return small, moved


def _decimated(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    manifold = _manifold3d(budget.label, f"decimate its {len(mesh.faces)} faces to {MOST_FACES}")
    solid = _solid(manifold, mesh.vertices, mesh.faces)
    if solid.is_empty():
        return _rebuilt(mesh, budget, done)
    tick = partial(budget.spend, f"decimating {len(mesh.faces)} faces")
    small, moved = _simplified(solid, 2e-5 * float(mesh.extents.max()), REBUILD_FACES, tick)
    done.append(
        f"decimated {len(mesh.faces)} faces to {small.num_tri()}, surface moved by less than {moved * 1e3:.3f} mm"
    )
    return _from_solid(small)


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
        manifold.Mesh64(np.ascontiguousarray(vertices[used], np.float64), local.reshape(-1, 3).astype(np.uint64))
    )


def _from_solid(solid: Any) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int64), process=False
    )
