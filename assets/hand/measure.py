"""Measures on posed hands: how far the pieces' hulls stand out of the mesh, how deep the mesh cuts
into itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

SAMPLES = 12_000


def hull_planes(points: np.ndarray) -> np.ndarray:
    """(P,4) outward unit normals n and offsets o with n.x + o <= 0 inside the convex hull."""
    return np.unique(np.round(ConvexHull(points).equations, 12), axis=0)


def winding_number(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) how often the closed mesh winds around every point: 0 outside, 1 inside, 2 where it
    overlaps itself."""
    total = np.zeros(len(points))
    for chunk in np.array_split(np.arange(len(points)), max(1, len(points) // 512)):
        a, b, c = (vertices[faces[:, k]][None] - points[chunk][:, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
        volume = np.einsum("nfc,nfc->nf", a, np.cross(b, c))
        dot = [np.einsum("nfc,nfc->nf", x, y) for x, y in ((a, b), (b, c), (c, a))]
        total[chunk] = np.arctan2(volume, la * lb * lc + dot[0] * lc + dot[1] * la + dot[2] * lb).sum(1) / (2 * np.pi)
    return total


def sample_surface(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int) -> np.ndarray:
    """(count,3) points spread by area over triangles."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    p = vertices[faces]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    pick = np.searchsorted(np.cumsum(area) / area.sum(), rng.random(count))
    u, v = rng.random((2, count, 1))
    root = np.sqrt(u)
    q = p[np.minimum(pick, len(p) - 1)]
    return (1 - root) * q[:, 0] + root * (1 - v) * q[:, 1] + root * v * q[:, 2]


def sample_inside(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int) -> np.ndarray:
    """(count,3) points uniform in the solid."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    found = np.zeros((0, 3))
    while len(found) < count:
        points = low + (high - low) * rng.random((2 * count, 3))
        found = np.concatenate([found, points[winding_number(vertices, faces, points) > 0.5]])
    return found[:count]


def piece_report(vertices: np.ndarray, faces: np.ndarray, pieces: Sequence[np.ndarray], names: Sequence[str]) -> dict:
    """Figures in mm: how far the union of the pieces' hulls stands out of the mesh, per piece and
    over all."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    hulls = [ConvexHull(vertices[ids]) for ids in pieces]
    planes = [hull_planes(vertices[ids]) for ids in pieces]
    all_distance, per_piece = [], {}
    for k, hull in enumerate(hulls):
        points = sample_surface(hull.points, hull.simplices, SAMPLES // len(hulls), seed=k)
        outer = np.ones(len(points), bool)
        for other in range(len(hulls)):
            if other != k:
                outer &= np.any(points @ planes[other][:, :3].T + planes[other][:, 3] > 1e-9, axis=1)
        points = points[outer]  # what the outside world can touch
        _, distance, _ = trimesh.proximity.closest_point(mesh, points)
        distance = np.where(winding_number(vertices, faces, points) > 0.5, 0.0, distance)
        all_distance.append(distance)
        per_piece[names[k]] = {
            "hull_vertices": len(hull.vertices),
            "overshoot_mean_mm": round(1000 * float(distance.mean()), 3) if len(distance) else 0.0,
            "overshoot_max_mm": round(1000 * float(distance.max()), 3) if len(distance) else 0.0,
        }
    distance = np.concatenate(all_distance)
    inside = sample_inside(vertices, faces, SAMPLES // 3, seed=99)
    held = np.zeros(len(inside), bool)
    for plane in planes:
        held |= np.all(inside @ plane[:, :3].T + plane[:, 3] <= 1e-7, axis=1)
    return {
        "vertices": len(vertices),
        "faces": len(faces),
        "pieces_count": len(pieces),
        "hull_vertices_max": max(len(h.vertices) for h in hulls),
        "overshoot_mean_mm": round(1000 * float(distance.mean()), 3),
        "overshoot_p95_mm": round(1000 * float(np.percentile(distance, 95)), 3),
        "overshoot_max_mm": round(1000 * float(distance.max()), 3),
        "inside_samples": len(inside),
        "inside_samples_missed": int(np.sum(~held)),
        "pieces": per_piece,
    }


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,3) outward unit normals, area-weighted."""
    p = vertices[faces]
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], cross)
    return normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]


def distance_to_triangles(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(N,) distance from every point to the nearest of the triangles (T,3,3)."""
    best = np.full(len(points), np.inf)
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]
    for i, p in enumerate(points):
        height = np.einsum("tc,tc->t", p - a, normal)
        foot = p - height[:, None] * normal
        within, edge = np.ones(len(a), bool), np.full(len(a), np.inf)
        for u, v in ((a, b), (b, c), (c, a)):
            line = v - u
            within &= np.einsum("tc,tc->t", np.cross(line, foot - u), normal) >= 0
            t = np.clip(np.einsum("tc,tc->t", p - u, line) / np.einsum("tc,tc->t", line, line), 0, 1)
            edge = np.minimum(edge, np.linalg.norm(u + t[:, None] * line - p, axis=1))
        best[i] = np.where(within, np.abs(height), edge).min()
    return best


def self_cut(
    vertices: np.ndarray,
    faces: np.ndarray,
    planes: Sequence[np.ndarray],
    pieces: Sequence[np.ndarray],
) -> float:
    """How deep (m) the mesh's own vertices lie inside it, creases of bent joints included; 0 when
    it is clean.

    A vertex is inside when the mesh winds around it once even just outside its own skin. Its depth
    is the distance to the nearest face that has no such vertex. Only vertices inside the hull of a
    piece that is not their own can be.
    """
    suspect = np.zeros(len(vertices), bool)
    for k, own in enumerate(pieces):
        inside = np.all(vertices @ planes[k][:, :3].T + planes[k][:, 3] < 0, axis=1)
        inside[own] = False
        suspect |= inside
    ids = np.flatnonzero(suspect)
    if not len(ids):
        return 0.0
    probe = vertices[ids] + 2e-5 * vertex_normals(vertices, faces)[ids]
    buried = ids[winding_number(vertices, faces, probe) > 0.5]
    if not len(buried):
        return 0.0
    open_faces = faces[~np.isin(faces, buried).any(axis=1)]
    return float(distance_to_triangles(vertices[buried], vertices[open_faces]).max())


def separate_pairs(pieces: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Pairs of pieces without a common mesh vertex: those that can collide instead of being joined
    by skin."""
    sets = [set(p.tolist()) for p in pieces]
    return [(a, b) for a in range(len(sets)) for b in range(a) if not sets[a] & sets[b]]


def hull_overlap(vertices: np.ndarray, hulls: Sequence[np.ndarray], pairs: Sequence[tuple[int, int]]) -> float:
    """Largest penetration depth (m) over pairs of convex hulls; hulls[k] holds the vertex ids on
    hull k.

    Depth is the distance from the origin to the boundary of the Minkowski difference: exact up to
    rounding.
    """
    points = [vertices[h] for h in hulls]
    low, high = np.array([p.min(axis=0) for p in points]), np.array([p.max(axis=0) for p in points])
    worst = 0.0
    for a, b in pairs:
        if np.any(low[a] > high[b]) or np.any(low[b] > high[a]):
            continue
        offsets = ConvexHull((points[a][:, None] - points[b][None]).reshape(-1, 3)).equations[:, 3]
        worst = max(worst, float(-offsets.max()))
    return worst
