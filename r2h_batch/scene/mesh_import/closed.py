"""A user's mesh as one closed, outward-wound surface, or one line that says why not.

Bodies that are closed stay as they are, to the last bit. Small holes are filled by faces. All other
bodies become solids by generalised winding number (`winding_solid`). Bodies that overlap are
united. A warning names every step, with the change of volume and how far the surface moved.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from r2h_batch.scene.mesh_import.file import load_mesh_file
from r2h_batch.scene.mesh_import.limits import (
    MOST_BODIES,
    MOST_GIVEN_FACES,
    REPAIRED,
    THINNEST_M,
    Budget,
    ObjectMeshError,
)
from r2h_batch.scene.mesh_import.manifold import (
    connected_bodies,
    edge_numbers,
    joined,
    part_of,
    simplified,
    united,
)
from r2h_batch.scene.mesh_import.winding_solid import MOST_FACES, winding_solid
from r2h_batch.scene.solid import Surface, sample_surface, signed_distance, winding_number

SMALLEST_M, LARGEST_M, FARTHEST_M = 0.01, 2.0, 10.0
CHANGE_SAMPLES = 5000
SLIVER_SHARE = 0.02
"""Faces that enclose nothing are slivers where they are smaller than this share of the object, or
narrower than `THINNEST_M`; other ones are sheets."""
HOLE_SHARE = 0.25
"""A rim of up to this share of pi times the largest side bounds a hole, which faces fill."""
MOST_CORNERS, FLAT_SHARE = 6, 1e-3
"""A flat rim of any size with at most so many corners, to this share of its size, is filled too: a
box that misses a face. A round mouth has more corners."""
JOIN_SHARE = 0.02
"""Two rims that are nowhere farther apart than this share of the largest side are the edges of one
wall, whose lip is missing; a strip of faces joins them."""
WELD_M, MOST_WELDS = 1e-5, 64
"""Vertices of open bodies nearer than this become one; most pairs of a vertex."""
FLAT_M = 1e-5
"""Volume over area below which a body encloses nothing."""


@dataclass(frozen=True)
class Repair:
    """Repairs of a mesh, and their effect."""

    steps: tuple[str, ...]
    """in words, in order; none: the mesh is as it was given"""
    volume_given_m3: float | None
    """of the given bodies, overlaps counted twice; None: the given surface is open"""
    volume_m3: float
    moved_m: float
    """the largest distance of the new surface from the given one, or of that one from the solid,
    over 5,000 samples of each"""

    @property
    def text(self) -> str:
        """One line."""
        given, made = self.volume_given_m3, f"{1e6 * self.volume_m3:.4g} cm3"
        change = made
        if given is not None:
            share = ""
            if given > 1e-3 * self.volume_m3:
                percent = round(100 * (self.volume_m3 / given - 1), 2) + 0.0  # no minus before 0
                share = f" ({percent:+.2f} %)"
            change = f"{1e6 * given:.4g} -> {made}{share}"
        return (
            f"{'; '.join(self.steps)}. Volume {change}, "
            f"surface changed by up to {1e3 * self.moved_m:.2f} mm"
        )


@dataclass(frozen=True)
class Closed:
    """A closed surface in metres, where its faces came from, and what was done."""

    mesh: trimesh.Trimesh
    source: trimesh.Trimesh
    """the mesh as it was read, or the caller's"""
    given: trimesh.Trimesh
    """every face of the file, in its order, m"""
    same: bool
    """whether the faces are the given ones, in their order"""
    repair: Repair


UNITS = (("metres", 1.0), ("millimetres", 0.001), ("centimetres", 0.01), ("inches", 0.0254))
USUAL_M = (0.03, 0.6)
"""Largest sides of things that are handed over: a factor is named where it gives one."""


def _units(side: float, scale: float) -> str:
    """What to do about a mesh whose largest side is so many of its own units; no factor where none gives a usual size."""
    fits = [(words, f) for words, f in UNITS if f != scale and USUAL_M[0] <= side * f <= USUAL_M[1]]
    if not fits:
        return "lengths are in metres, and in no usual unit (mm, cm, inch) is it 3 to 60 cm: look at the file"
    each = " or ".join(f"{f:g} (in {words} it is {100 * side * f:.3g} cm)" for words, f in fits)
    first = fits[0][1]
    return (
        f"give a scale of {each}: `scale: {first:g}` in a benchmark file, or in NAME.yaml beside NAME.obj in a folder for"
        f" --objects, scale={first:g} in Python; or export it in metres"
    )


def closed_mesh(source: str | Path | trimesh.Trimesh, label: str, scale: float) -> Closed:
    """The closed outward-wound surface of a mesh.

    Args:
        source: A mesh file, or a mesh.
        label: The name in warnings and errors.
        scale: Multiplies the coordinates; metres afterwards.

    Returns:
        The surface, the given one, and what was done. Steps and separate bodies give warnings.

    Raises:
        ObjectMeshError: The mesh cannot become an object, in one line.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise ObjectMeshError(f"{label}: scale is {scale}; need a positive number (0.001: from mm)")
    read = load_mesh_file(source, label) if isinstance(source, (str, Path)) else source.copy()
    budget = Budget(label)
    vertices = np.asarray(read.vertices, np.float64) * scale
    faces = np.asarray(read.faces, np.int64)
    check_mesh(vertices, faces, label, scale)
    done: list[str] = []
    mesh = _merged(vertices, faces, done)
    same = len(mesh.faces) == len(faces)
    if open_edges(mesh).any():
        mesh = _welded(mesh, label, done)
    if not len(mesh.faces):
        raise ObjectMeshError(
            f"{label}: none of its {len(faces)} faces has three corners apart; export the mesh again"
        )
    if (bodies := len(connected_bodies(mesh)[1])) > MOST_BODIES:
        raise ObjectMeshError(
            f"{label}: {len(mesh.faces)} faces in {bodies} bodies that do not touch; at most {MOST_BODIES} are "
            "allowed: join them into one surface in a modelling tool"
        )
    if not _well_formed(mesh, label):
        same = False
        mesh = _solid(mesh, budget, done)
    elif len(connected_bodies(mesh)[1]) > 1 and winding_number(mesh, 64).max() > 1:
        same = False
        mesh = _united(mesh, budget, done)
    if len(mesh.faces) > MOST_FACES:
        same = False
        mesh = _decimated(mesh, budget, done)
    if not (len(mesh.faces) and not open_edges(mesh).any() and mesh.volume > 0):
        raise ObjectMeshError(
            f"{label}: the mesh is not a closed surface and could not be repaired "
            f"(tried: {'; '.join(done) or 'nothing'}); close it in a modelling tool"
        )
    given = trimesh.Trimesh(vertices, faces, process=False)
    repair = _change(given, mesh, tuple(done), same)
    if done:
        warnings.warn(f"{label}: {REPAIRED}{repair.text}", stacklevel=4)
    if far := _separate_bodies(mesh, budget):
        sides = ", ".join(f"{s:.3g}" for s in far[:5]) + (", ..." if len(far) > 5 else "")
        warnings.warn(
            f"{label}: {len(far)} bodies apart from each other (largest sides {sides} m) are taken as one "
            "rigid object; delete those that do not belong to it",
            stacklevel=4,
        )
    return Closed(mesh, read, given, same, repair)


def open_edges(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """(F,) whether an edge of the face is passed more often in one direction than in the other.

    A surface without such edges is closed: its winding number is a whole number everywhere. More
    than two faces may meet at an edge.
    """
    edge = edge_numbers(mesh)
    passed = np.bincount(edge, np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1, -1))
    out = np.zeros(len(mesh.faces), bool)
    out[mesh.edges_face[passed[edge] != 0]] = True
    return out


def _merged(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], done: list[str]
) -> trimesh.Trimesh:
    """The mesh with equal vertices merged; faces without three corners, repeated faces and loose
    vertices are dropped."""
    used = np.unique(faces)
    _, first, same = np.unique(vertices[used], axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # the file's order of vertices
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
    _, once = np.unique(turned, axis=0, return_index=True)
    if len(once) < len(faces):
        done.append(f"dropped {len(faces) - len(once)} repeated faces")
    mesh = trimesh.Trimesh(vertices, faces[np.sort(once)], process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def _welded(mesh: trimesh.Trimesh, label: str, done: list[str]) -> trimesh.Trimesh:
    """The mesh with vertices on rims that are nearly the same made one, where that leaves fewer
    rims.

    Needed where the sides of a solid were tessellated one by one: a block whose six sides are 1 um
    apart keeps 5 % of its volume without it.
    """
    opened = open_edges(mesh)
    rim = np.unique(mesh.faces[opened])
    tree = cKDTree(mesh.vertices[rim])
    near = int(tree.count_neighbors(tree, WELD_M))  # a heap in one place has a square of pairs
    if near > MOST_WELDS * len(rim):
        raise ObjectMeshError(
            f"{label}: {near} pairs of vertices are nearer than {WELD_M * 1e3:g} mm; merge them first"
        )
    same = np.arange(len(mesh.vertices))
    for together in trimesh.grouping.clusters(mesh.vertices[rim], WELD_M):
        same[rim[together]] = rim[together].min()
    notes: list[str] = []
    welded = _cleaned(mesh.vertices, same[mesh.faces], notes)
    if open_edges(welded).sum() >= opened.sum():
        return mesh
    count = int((same < np.arange(len(same))).sum())
    done += [f"welded {count} vertices nearer than {WELD_M * 1e3:g} mm", *notes]
    return welded


def _well_formed(mesh: trimesh.Trimesh, label: str) -> bool:
    """Whether the mesh is closed and wound outwards, and no faces enclose nothing.

    Closed sheets thinner than distances can be trusted are refused where there is nothing else.
    """
    if not len(mesh.faces) or open_edges(mesh).any():
        return False
    _, volumes, areas = connected_bodies(mesh)
    if volumes.sum() <= 0:
        return False
    thin = 2 * np.abs(volumes) < THINNEST_M * areas
    if thin.all() and (volumes > FLAT_M * areas).any():
        thick, area = max(zip(2 * np.abs(volumes) / areas, areas, strict=True))
        raise ObjectMeshError(
            f"{label}: a closed sheet of {area / 2:.2g} m^2 is {thick * 1e3:.2g} mm thick on average; at least "
            f"{THINNEST_M * 1e3:g} mm are needed: give it its thickness in a modelling tool"
        )
    return not (thin.any() or _cancelling(mesh).any() or (volumes[1:] < 0).any())


def _cancelling(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """(F,) whether another face has the same corners the other way round: two such enclose
    nothing."""
    corners = np.sort(mesh.faces, axis=1)
    _, group, count = np.unique(corners, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(count[group.reshape(-1)] > 1)


def _solid(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """The mesh without slivers; closed bodies as they are, solids in place of the others."""
    budget.spend("turning faces")
    mesh = _oriented(mesh, done)
    mesh, sheet = _without_slivers(mesh, _cancelling(mesh), budget, done)
    rest = part_of(mesh, ~sheet)
    loose = _open_bodies(rest)
    size = float(mesh.extents.max())
    closed, opened = part_of(rest, ~loose), _filled(part_of(rest, loose), size, budget, done)
    loose = _open_bodies(opened)
    closed = joined([closed, part_of(opened, ~loose)])
    opened = joined([part_of(opened, loose), part_of(mesh, sheet)])
    parts = [_outwards(closed, done)] if len(closed.faces) else []
    if len(opened.faces):
        parts.append(winding_solid(opened, budget, done))
    whole = joined(parts)
    bodies_left = len(connected_bodies(whole)[1])
    if bodies_left > 1 and (len(parts) > 1 or winding_number(whole, 64).max() > 1):
        return _united(whole, budget, done)
    return whole


def _open_bodies(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """(F,) the faces of bodies that are not closed, or are thinner than `THINNEST_M` in the mean."""
    if not len(mesh.faces):
        return np.zeros(0, bool)
    body, volumes, areas = connected_bodies(mesh)
    thin = 2 * np.abs(volumes) < THINNEST_M * areas
    return np.isin(body, [*np.unique(body[open_edges(mesh)]), *np.flatnonzero(thin)])


def _oriented(mesh: trimesh.Trimesh, done: list[str]) -> trimesh.Trimesh:
    """The mesh with neighbouring faces wound alike."""
    if not _disagree(mesh):
        return mesh
    faces, turned = _wound_alike(mesh)
    if turned.any():
        done.append(f"turned {int(turned.sum())} faces to agree with their neighbours")
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def _disagree(mesh: trimesh.Trimesh) -> bool:
    """Whether the two faces of some edge are wound against each other."""
    edge = edge_numbers(mesh)
    count = np.bincount(edge)
    passed = np.bincount(edge, np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1, -1))
    return bool(((count == 2) & (passed != 0)).any())


def _wound_alike(mesh: trimesh.Trimesh) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The faces (F, 3) wound alike, each patch as most of its area was, and which (F,) of them are turned."""
    import igl

    before = np.ascontiguousarray(mesh.faces, np.int64)
    after, patch = igl.bfs_orient(before)
    turned = (after != before).any(axis=1)
    area = mesh.area_faces
    most = 2 * np.bincount(patch, area * turned) > np.bincount(patch, area)
    faces = np.where(most[patch][:, None], after[:, ::-1], after)
    turned ^= most[patch]
    faces[~turned] = before[~turned]
    return faces, turned


def _without_slivers(
    mesh: trimesh.Trimesh, sheet: NDArray[np.bool_], budget: Budget, done: list[str]
) -> tuple[trimesh.Trimesh, NDArray[np.bool_]]:
    """The mesh and its double-sided faces (F,), without those that are small, narrow, or within
    or on other bodies, and without thin closed bodies that are."""
    group = np.full(len(mesh.faces), -1)
    if sheet.any():
        group[sheet] = connected_bodies(part_of(mesh, sheet))[0]
    rest = np.flatnonzero(~sheet)
    if len(rest):
        other = part_of(mesh, ~sheet)
        body, volumes, areas = connected_bodies(other)
        opened = np.unique(body[open_edges(other)])
        thin = 2 * np.abs(volumes) < THINNEST_M * areas
        thin[opened] &= areas[opened] < 1e-12
        flat = thin[body]
        group[rest[flat]] = body[flat] + group.max() + 1
    if (group < 0).all() or (group >= 0).all():
        return mesh, sheet
    solid = Surface(part_of(mesh, group < 0))
    least = SLIVER_SHARE * float(mesh.extents.max())
    drop = np.zeros(len(mesh.faces), bool)
    kinds = np.unique(group[group >= 0])
    for n, k in enumerate(kinds):
        budget.spend("looking for slivers", n / len(kinds))
        members = group == k
        t = mesh.triangles[members]
        size = float(np.ptp(t.reshape(-1, 3), axis=0).max())
        narrow = float(mesh.area_faces[members].sum()) < THINNEST_M * size
        middles = (t + np.roll(t, -1, axis=1)) / 2
        points = np.concatenate([t.reshape(-1, 3), middles.reshape(-1, 3), t.mean(axis=1)])
        if size < least or narrow or (solid.signed(points)[0] < THINNEST_M).all():
            drop |= members
    if not drop.any():
        return mesh, sheet
    count = len(np.unique(group[drop]))
    done.append(f"dropped {count} slivers without volume ({int(drop.sum())} faces)")
    return part_of(mesh, ~drop), sheet[~drop]


def _filled(mesh: trimesh.Trimesh, size: float, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    """The mesh with rims that run side by side joined, and holes and flat openings of few corners
    closed by a fan around the middle of their rim; `size` is the object's largest side, m.

    Measured on 19 meshes of Sweet Home 3D and those of `tests/scene/test_mesh_faults.py`, against
    the winding solid alone. Holes: it lies 0.05 to 9.3 mm away on ten of the 19. Rims side by side:
    a plastic cup is 0.6 mm away and a sixth larger. Flat openings: a block becomes a hollow shell.
    """
    if not len(mesh.faces):
        return mesh
    import igl

    longest = HOLE_SHARE * np.pi * size
    # Rims that touch get vertices of their own.
    split, origin = igl.split_nonmanifold(np.ascontiguousarray(mesh.faces, np.int64))
    mesh = trimesh.Trimesh(mesh.vertices[origin], split, process=False)
    vertices, faces = [np.asarray(mesh.vertices)], [np.asarray(mesh.faces)]
    middle, holes, openings = len(mesh.vertices), 0, 0
    strips, rims = _lips(mesh, JOIN_SHARE * size, budget)
    if strips:
        done.append(f"joined {len(strips)} pairs of rims that run side by side")
    for n, rim in enumerate(rims):
        budget.spend("filling holes", n / len(rims))
        ring = mesh.vertices[rim]
        large = np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum() > longest
        if large and not _is_polygon(ring):
            continue
        holes, openings = holes + (not large), openings + large
        if len(rim) == 3:
            faces.append(rim[None])
            continue
        vertices.append(ring.mean(axis=0)[None])
        faces.append(np.stack([rim, np.roll(rim, -1), np.full(len(rim), middle)], axis=1))
        middle += 1
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


def _lips(
    mesh: trimesh.Trimesh, gap: float, budget: Budget
) -> tuple[list[NDArray[np.int64]], list[NDArray[np.int64]]]:
    """Strips of faces (N, 3) between rims that are nowhere farther apart than `gap` (m), and the
    other rims."""
    import igl

    loops = igl.boundary_loop_all(np.ascontiguousarray(mesh.faces, np.int64))
    rims = [
        np.roll(loop[::-1], int(np.argmin(loop)) + 1) for loop in loops
    ]  # the least corner first
    rims, strips = sorted(rims, key=lambda rim: int(rim[0])), []
    boxes = np.array([_box(mesh.vertices[rim]) for rim in rims]).reshape(-1, 6)
    free = np.ones(len(rims), bool)
    large = (boxes[:, 3:] - boxes[:, :3]).max(axis=1) > 4 * gap  # smaller rims bound holes
    for i in np.flatnonzero(large):
        budget.spend("comparing rims that may be two edges of one wall", i / len(rims))
        similar = free & large & (np.abs(boxes - boxes[i]).max(axis=1) <= gap)
        for j in i + 1 + np.flatnonzero(similar[i + 1 :]):
            strip = _strip(mesh.vertices, rims[i], rims[j], gap) if free[i] else None
            if strip is not None:
                strips.append(strip)
                free[[i, j]] = False
    return strips, [rims[k] for k in np.flatnonzero(free)]


def _box(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


def _strip(
    vertices: NDArray[np.float64], rim: NDArray[np.int64], other: NDArray[np.int64], gap: float
) -> NDArray[np.int64] | None:
    """(N, 3) faces between two rims that run against each other; None where they are farther apart
    than `gap` somewhere.

    Both rims are walked once around together, and the shorter diagonal becomes the next side.
    """
    import igl

    for one, two in ((rim, other), (other, rim)):
        sides = np.stack([two, np.roll(two, -1), two], axis=1)
        if igl.point_mesh_squared_distance(vertices[one], vertices, sides)[0].max() > gap**2:
            return None
    first = int(np.linalg.norm(vertices[other] - vertices[rim[0]], axis=1).argmin())
    a, b = rim, np.roll(other[::-1], first + 1)
    a, b = np.append(a, a[0]), np.append(b, b[0])
    p, q, faces = 0, 0, []
    while p + 1 < len(a) or q + 1 < len(b):
        to_a = np.linalg.norm(vertices[a[p + 1]] - vertices[b[q]]) if p + 1 < len(a) else np.inf
        to_b = np.linalg.norm(vertices[b[q + 1]] - vertices[a[p]]) if q + 1 < len(b) else np.inf
        next_a = to_a <= to_b
        start, end = (a[p], a[p + 1]) if next_a else (b[q], b[q + 1])
        if min(to_a, to_b) > gap + np.linalg.norm(vertices[end] - vertices[start]):
            return None
        faces.append((a[p], a[p + 1], b[q]) if next_a else (a[p], b[q + 1], b[q]))
        p, q = (p + 1, q) if next_a else (p, q + 1)
    return np.array(faces, np.int64)


def _is_polygon(ring: NDArray[np.float64]) -> bool:
    """Whether a rim (N, 3) lies in a plane, has few corners, and sees its middle from inside."""
    import igl

    slack = FLAT_SHARE * float(np.ptp(ring, axis=0).max())
    spoke = ring - ring.mean(axis=0)
    normal = np.linalg.svd(spoke, full_matrices=False)[2][2]
    turn = np.cross(spoke, np.roll(spoke, -1, axis=0)) @ normal
    if np.abs(spoke @ normal).max() > slack or not ((turn > 0).all() or (turn < 0).all()):
        return False
    # The point farthest from the middle is a corner, and so is the one farthest from that.
    ring = np.roll(ring, -int(np.linalg.norm(spoke, axis=1).argmax()), axis=0)
    half = int(np.linalg.norm(ring - ring[0], axis=1).argmax())
    sides = ring[: half + 1], np.concatenate([ring[half:], ring[:1]])
    corners = [len(igl.ramer_douglas_peucker(np.ascontiguousarray(s), slack)[0]) - 1 for s in sides]
    return sum(corners) <= MOST_CORNERS


def _outwards(mesh: trimesh.Trimesh, done: list[str]) -> trimesh.Trimesh:
    """Closed bodies, those turned outwards that are inside out; hollows in others stay."""
    body, volumes, _ = connected_bodies(mesh)
    inward = np.flatnonzero(volumes < 0)
    if len(inward) and len(inward) < len(volumes):
        outer = part_of(mesh, ~np.isin(body, inward))
        probes = np.array([mesh.triangles_center[np.argmax(body == k)] for k in inward])
        inward = inward[signed_distance(outer, probes)[0] >= 0]
    if not len(inward):
        return mesh
    chosen = np.isin(body, inward)
    faces = np.where(chosen[:, None], mesh.faces[:, ::-1], mesh.faces)
    done.append(f"turned {len(inward)} inside-out bodies outwards")
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def _united(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    found = united(mesh, budget)
    if found is None:
        return winding_solid(mesh, budget, done)
    done.append(f"united {len(connected_bodies(mesh)[1])} overlapping bodies")
    return found


def _decimated(mesh: trimesh.Trimesh, budget: Budget, done: list[str]) -> trimesh.Trimesh:
    small, moved = simplified(mesh, 2e-5 * float(mesh.extents.max()), MOST_FACES, budget)
    if not len(small.faces):
        return winding_solid(mesh, budget, done)
    done.append(
        f"decimated {len(mesh.faces)} faces to {len(small.faces)}, surface moved by less than {moved * 1e3:.3f} mm"
    )
    return small


def _change(
    given: trimesh.Trimesh, mesh: trimesh.Trimesh, steps: tuple[str, ...], same: bool
) -> Repair:
    """The figures of a repair."""
    plain = _merged(given.vertices, given.faces, [])
    volume = None if open_edges(plain).any() else float(connected_bodies(plain)[1].sum())
    if same:
        return Repair(steps, volume, float(mesh.volume), 0.0)

    def samples(of: trimesh.Trimesh) -> NDArray[np.float64]:
        used = of.vertices[np.unique(of.faces)]
        corners = used[:: len(used) // CHANGE_SAMPLES + 1]
        return np.concatenate([sample_surface(of, CHANGE_SAMPLES)[0], corners])

    # What lies inside now was inside before, or between bodies.
    outside = float(Surface(mesh).signed(samples(given))[0].max())
    moved = max(outside, float(Surface(given).within(samples(mesh), 10 * LARGEST_M)[0].max()))
    return Repair(steps, volume, float(mesh.volume), moved)


def _separate_bodies(mesh: trimesh.Trimesh, budget: Budget) -> list[float]:
    """Largest sides (m) of the bodies that touch no other, the largest first; [] where all hang
    together."""
    body, volumes, _ = connected_bodies(mesh)
    solids = [part_of(mesh, body == k) for k in np.flatnonzero(volumes > 0)]  # others are cavities
    if len(solids) < 2:
        return []
    bounds = np.array([s.bounds for s in solids])
    close = (bounds[:, None, 0] <= bounds[None, :, 1] + THINNEST_M).all(axis=2)
    pairs = [(i, j) for i, j in np.argwhere(close & close.T) if i != j]
    touching = np.eye(len(solids), dtype=bool)
    for n, (i, j) in enumerate(pairs):
        budget.spend("measuring the gaps between its bodies", n / len(pairs))
        if not touching[i, j]:
            points = np.concatenate([solids[j].vertices, solids[j].triangles_center])
            gap = signed_distance(solids[i], points)[0].min()
            touching[i, j] = touching[j, i] = gap < THINNEST_M
    count, group = connected_components(touching, False)
    if count < 2:
        return []
    sides = [np.ptp(bounds[group == g].reshape(-1, 3), axis=0).max() for g in range(count)]
    return sorted(map(float, sides), reverse=True)


def check_mesh(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], label: str, scale: float = 1.0
) -> None:
    """Raise `ObjectMeshError` for a mesh that is empty, not finite, or of no object's size, which came of its file's numbers
    times `scale`."""
    if len(faces) == 0 or len(vertices) == 0:
        raise ObjectMeshError(
            f"{label}: the mesh is empty ({len(vertices)} vertices, {len(faces)} faces)"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ObjectMeshError(
            f"{label}: a face names vertex {faces.max()}, there are {len(vertices)}"
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
    if not SMALLEST_M <= side <= LARGEST_M:
        raise ObjectMeshError(
            f"{label}: the largest side is {side:.6g} m, allowed are {SMALLEST_M} to {LARGEST_M} m; {_units(side / scale, scale)}"
        )
    if float(np.abs((low + high) / 2).max()) > FARTHEST_M:
        raise ObjectMeshError(
            f"{label}: the object is centred at {((low + high) / 2).round(3).tolist()} m, more than {FARTHEST_M} m "
            "from the origin of its frame; move it to the origin (grasp poses are given in this frame)"
        )
