"""Repairs that move no face of a mesh: vertices merged and welded, faces turned, slivers dropped,
holes and openings closed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from r2h_batch.bodies.given.edges import split_edges, split_rims
from r2h_batch.bodies.mesh_bodies import bodies_of, body_volumes, check_bodies
from r2h_batch.bodies.mesh_limits import MOST_TURNED_FACES, THINNEST_M, Budget, ObjectMeshError
from r2h_batch.bodies.solid import Surface, signed_distance

__all__ = ["apart", "mended", "merged", "open_faces", "outwards", "without_slivers"]

WELD_M = 1e-5
MOST_WELDS = 64
HOLE_SHARE = 0.25
"""a hole is filled when its rim is no longer than this share of pi times the largest side: a cup's
mouth is no hole"""
MOST_CORNERS = 6
"""an opening of any size is closed when its rim lies in a plane and has at most this many corners:
what a box looks like that misses a face; a round mouth has more"""
FLAT_SHARE = 1e-3
"""how far (share of the rim's largest side) the corners of such a rim may lie off its plane, and
other points off its sides"""
JOIN_SHARE = 0.02
"""two rims no farther apart than this share of the largest side all along are the two sides of a
wall"""
SLIVER_SHARE = 0.02
"""a body of no volume is a sliver when it is smaller than this share of the object, thinner than
can be seen, or lies on another body; any other is a sheet"""
FLAT_M = 1e-5
"""volume over area below which a body encloses nothing"""


def merged(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], done: list[str]
) -> trimesh.Trimesh:
    """Duplicate vertices merged, faces without three corners and repeated faces dropped, loose
    vertices dropped."""
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


def _cleaned(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], done: list[str]
) -> trimesh.Trimesh:
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not whole.all():
        done.append(f"dropped {int((~whole).sum())} degenerate faces")
    faces = faces[whole]
    turn = np.argmin(faces, axis=1)[:, None]
    turned = np.take_along_axis(faces, (turn + np.arange(3)) % 3, axis=1)
    _, first = np.unique(turned, axis=0, return_index=True)
    if len(first) < len(faces):
        done.append(f"dropped {len(faces) - len(first)} repeated faces")
    return _mesh(vertices, faces[np.sort(first)])


def _mesh(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def apart(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """The mesh with edges of more than two faces taken apart."""
    mesh, edges = split_edges(mesh, lambda share: budget.spend("taking edges apart", share))
    if edges:
        done.append(f"took {edges} edges of more than two faces apart")
    return mesh


def without_slivers(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """The mesh without bodies that enclose nothing and are too small, too thin or too near to
    others to be meant."""
    body = bodies_of(mesh)
    volumes = np.array(body_volumes(mesh))
    flat = (
        np.abs(volumes[:, 0]) <= FLAT_M * volumes[:, 1] + FLAT_M**3
    )  # a needle of three points in a line has no area
    rims = np.unique(body[open_faces(mesh)])
    flat[rims] &= volumes[rims, 1] < 1e-12  # an open sheet is one, unless there is nothing of it
    if not flat.any() or flat.all():
        return mesh
    rest = Surface(_mesh(mesh.vertices, mesh.faces[~flat[body]]))
    least = SLIVER_SHARE * float(mesh.extents.max())
    slivers = []
    flats = np.flatnonzero(flat)
    for n, k in enumerate(flats):
        budget.spend("looking for slivers", n / len(flats))
        corners = mesh.triangles[body == k].reshape(-1, 3)
        size = float(np.ptp(corners, axis=0).max())
        width = volumes[k, 1] / max(
            size, 1e-12
        )  # its two sides' area over its length: twice its mean width
        tiny = size < least or width < THINNEST_M
        spread = _spread(corners)
        off = spread[rest.within(spread, THINNEST_M)[1] < 0] if not tiny else spread[:0]
        # on the others, or within them, as the wall between two blocks that were drawn back to back
        if not len(off) or (rest.signed(off)[0] < 0).all():
            slivers.append(k)
    if not slivers:
        return mesh
    dropped = np.isin(body, slivers)
    done.append(f"dropped {len(slivers)} slivers without volume ({int(dropped.sum())} faces)")
    return _mesh(mesh.vertices, mesh.faces[~dropped])


def _spread(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M, 3) points of triangles (3 F, 3): corners, middles of sides, centres: a chord across a
    surface is not on it."""
    t = corners.reshape(-1, 3, 3)
    sides = (t + np.roll(t, -1, axis=1)) / 2
    return np.concatenate([corners, sides.reshape(-1, 3), t.mean(axis=1)])


def mended(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """The mesh after welding, winding repair, and filling of holes and flat openings."""
    if not mesh.is_watertight:
        budget.spend("looking for vertices to weld")
        mesh = _welded(mesh, budget, done)
    check_bodies(mesh, budget.label)
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
    return mesh


def _welded(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """Vertices on rims that are nearly the same made one, where that leaves fewer rims."""
    tree = cKDTree(mesh.vertices)
    near_count = int(
        tree.count_neighbors(tree, WELD_M)
    )  # a heap of vertices in one place has a square of pairs
    if near_count > MOST_WELDS * len(mesh.vertices):
        raise ObjectMeshError(
            f"{budget.label}: {near_count} pairs of vertices are nearer than {WELD_M * 1e3:g} mm; merge them first"
        )
    rim = np.zeros(len(mesh.vertices), bool)
    rim[mesh.faces[open_faces(mesh)]] = (
        True  # others are where they belong: edges taken apart would come together again
    )
    pairs = tree.query_pairs(WELD_M, output_type="ndarray")
    pairs = pairs[rim[pairs].all(axis=1)]
    if not len(pairs):
        return mesh
    count = len(mesh.vertices)
    near = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count))
    _, first, same = np.unique(
        connected_components(near, False)[1], return_index=True, return_inverse=True
    )
    notes: list[str] = []
    welded = _cleaned(mesh.vertices[first], same.reshape(-1)[mesh.faces], notes)
    welded = apart(welded, budget, notes)
    if open_faces(welded).sum() >= open_faces(mesh).sum():
        return mesh
    done += [f"welded {count - len(first)} vertices nearer than {WELD_M * 1e3:g} mm", *notes]
    return welded


def open_faces(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """(F,) whether an edge of the face is not shared by exactly two faces, or by two that disagree
    which way it goes."""
    _, group, count = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    sign = np.bincount(group, np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1, -1))
    out = np.zeros(len(mesh.faces), bool)
    out[mesh.edges_face[((count != 2) | (sign != 0))[group]]] = True
    return out


def outwards(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """Closed bodies, those turned outwards that are inside out; hollows in others stay as they
    are."""
    body = bodies_of(mesh)
    budget.spend("looking for bodies that are inside out")
    inside_out = [k for k, (volume, _) in enumerate(body_volumes(mesh)) if volume < 0]
    if not inside_out or (mesh.volume >= 0 and _cavities(mesh, body, inside_out)):
        return mesh
    faces = mesh.faces.copy()
    chosen = np.isin(body, inside_out)
    faces[chosen] = faces[chosen][:, ::-1]
    done.append(f"turned {len(inside_out)} inside-out bodies outwards")
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def _cavities(mesh: trimesh.Trimesh, body: NDArray[np.int64], inward: list[int]) -> bool:
    """Whether every inward-wound body lies inside an outward one: a hollow, not a mistake."""
    outer = trimesh.Trimesh(mesh.vertices, mesh.faces[~np.isin(body, inward)], process=False)
    if len(outer.faces) == 0:
        return False
    probes = np.array([mesh.triangles_center[np.argmax(body == k)] for k in inward])
    return bool((signed_distance(outer, probes)[0] < 0).all())


def _filled(mesh: trimesh.Trimesh, done: list[str]) -> trimesh.Trimesh:
    """Rims that run side by side joined; small holes closed by a fan around the middle of their
    rim, openings with a flat rim of few corners by a plane."""
    mesh = split_rims(mesh)
    limit = HOLE_SHARE * np.pi * float(mesh.extents.max())
    vertices, faces, middle = (
        [np.asarray(mesh.vertices)],
        [np.asarray(mesh.faces)],
        len(mesh.vertices),
    )
    loops = list(_rims(mesh))
    strips, loops = _joined(mesh, loops)
    holes, openings = 0, 0
    for loop in loops:
        ring = mesh.vertices[loop]
        large = float(np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum()) > limit
        if large and not _few_corners(ring):
            continue
        holes, openings = holes + (not large), openings + large
        if len(ring) == 3:
            faces.append(np.array([loop]))
            continue
        # every side to the middle of the rim; of a rim that is not convex the middle may see a side
        # from behind
        vertices.append(ring.mean(axis=0)[None])
        faces.append(
            np.array([(a, b, middle) for a, b in zip(loop, np.roll(loop, -1), strict=True)])
        )
        middle += 1
    if strips:
        done.append(f"joined {len(strips)} pairs of rims that run side by side")
    if holes:
        done.append(f"filled {holes} holes")
    if openings:
        done.append(
            f"closed {openings} flat openings of at most {MOST_CORNERS} corners, as of a box that misses a face "
            "(a vessel needs walls with two sides)"
        )
    if not (strips or holes or openings):
        return mesh
    return trimesh.Trimesh(
        np.concatenate(vertices), np.concatenate([*faces, *strips]), process=False
    )


def _joined(
    mesh: trimesh.Trimesh, loops: list[list[int]]
) -> tuple[list[NDArray[np.int64]], list[list[int]]]:
    """Strips between the rims that run side by side all along (a lip that was lost), and the rims
    that do not."""
    most = JOIN_SHARE * float(mesh.extents.max())
    bounds = np.array(
        [np.stack([mesh.vertices[n].min(0), mesh.vertices[n].max(0)]) for n in loops]
    ).reshape(-1, 2, 3)
    large = np.ptp(bounds, axis=1).max(axis=1) > 4 * most  # others are holes
    free, strips = np.ones(len(loops), bool), []
    for i in np.flatnonzero(large):
        a = mesh.vertices[loops[i]]
        alike = np.flatnonzero(free & large & (np.abs(bounds - bounds[i]).max(axis=(1, 2)) <= most))
        for j in alike[alike > i]:
            b = mesh.vertices[loops[j]]
            if not free[i] or max(_farthest(a, b, most), _farthest(b, a, most)) > most:
                continue
            strip = _strip(mesh.vertices, loops[i], loops[j], 1.5 * most)
            if strip is not None:
                free[[i, j]] = False
                strips.append(strip)
    return strips, [loop for loop, left in zip(loops, free, strict=True) if left]


def _farthest(points: NDArray[np.float64], ring: NDArray[np.float64], step: float) -> float:
    """How far the points are at most from a closed rim, to a fraction of `step`."""
    follow = np.roll(ring, -1, axis=0)
    count = int(np.ceil(4 * np.linalg.norm(follow - ring, axis=1).max() / step)) + 1
    share = np.linspace(0, 1, min(count, 256), endpoint=False)[:, None, None]
    return float(cKDTree((ring + share * (follow - ring)).reshape(-1, 3)).query(points)[0].max())


def _strip(
    vertices: NDArray[np.float64], loop: list[int], other: list[int], most: float
) -> NDArray[np.int64] | None:
    """(n + m, 3) triangles between two loops that run against each other, the shorter diagonal
    first; None where one of them does not."""
    start = int(np.argmin(np.linalg.norm(vertices[other] - vertices[loop[0]], axis=1)))
    a, b = loop, other[start::-1] + other[:start:-1]
    n, m = len(a), len(b)
    i = j = 0
    out = []
    while i < n or j < m:
        p, q = a[i % n], b[j % m]
        ahead = np.linalg.norm(vertices[a[(i + 1) % n]] - vertices[q]) if i < n else np.inf
        beside = np.linalg.norm(vertices[b[(j + 1) % m]] - vertices[p]) if j < m else np.inf
        side = (
            vertices[a[(i + 1) % n]] - vertices[p]
            if ahead <= beside
            else vertices[b[(j + 1) % m]] - vertices[q]
        )
        if min(ahead, beside) > most + float(np.linalg.norm(side)):
            return None
        if ahead <= beside:
            out.append((p, a[(i + 1) % n], q))
            i += 1
        else:
            out.append((p, b[(j + 1) % m], q))
            j += 1
    return np.array(out, np.int64)


def _rims(mesh: trimesh.Trimesh) -> Iterator[list[int]]:
    """Closed rims that touch no other, as vertices that run against the faces which they bound."""
    edges = mesh.edges
    _, group, count = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    follow: dict[int, list[int]] = {}
    for a, b in edges[count[group.reshape(-1)] == 1]:
        follow.setdefault(int(b), []).append(int(a))
    used: set[int] = set()
    for start in sorted(follow):
        loop = [start]
        while loop[-1] not in used and len(follow.get(loop[-1], ())) == 1:
            used.add(loop[-1])
            loop.append(follow[loop[-1]][0])
        if len(loop) >= 4 and loop[-1] == start:
            yield loop[:-1]


def _few_corners(ring: NDArray[np.float64]) -> bool:
    """Whether a rim lies in a plane and is a convex polygon of at most `MOST_CORNERS` corners."""
    slack = FLAT_SHARE * float(np.ptp(ring, axis=0).max())
    middle = ring.mean(axis=0)
    _, _, axes = np.linalg.svd(ring - middle, full_matrices=False)
    if np.abs((ring - middle) @ axes[2]).max() > slack:
        return False
    flat = (ring - middle) @ axes[:2].T
    corners = [0]
    for k in range(
        1, len(flat) + 1
    ):  # the farthest point that still sees its predecessors as one straight side
        here, last = flat[k % len(flat)], flat[corners[-1]]
        side = here - last
        length = float(np.hypot(*side))
        between = flat[corners[-1] + 1 : k] - last
        off = np.abs(between @ [-side[1], side[0]]) / max(length, 1e-12)
        if len(between) and off.max() > slack:
            corners.append(k - 1)
            if len(corners) > MOST_CORNERS + 1:
                return False
    polygon = flat[corners]
    if len(polygon) > 3 and _between(
        polygon[-1], polygon[0], polygon[1], slack
    ):  # the rim began amid a side
        polygon = polygon[1:]
    if not 3 <= len(polygon) <= MOST_CORNERS:
        return False
    a, b = (
        np.roll(polygon, -1, axis=0) - polygon,
        np.roll(polygon, -2, axis=0) - np.roll(polygon, -1, axis=0),
    )
    turn = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return bool((turn > 0).all() or (turn < 0).all())


def _between(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], slack: float
) -> bool:
    side = c - a
    return bool(abs((b - a) @ [-side[1], side[0]]) <= slack * max(float(np.hypot(*side)), 1e-12))
