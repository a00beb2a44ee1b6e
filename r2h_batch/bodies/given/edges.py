"""Edges that more than two faces share, taken apart: each side of them becomes a surface of its
own, no point moves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

__all__ = ["split_edges", "split_rims"]

ANGLE_DIGITS = 6
"""Faces nearer than 1e-6 rad around an edge are taken for coincident."""


def split_edges(
    mesh: trimesh.Trimesh, tick: Callable[[float], None]
) -> tuple[trimesh.Trimesh, int]:
    """The mesh with every edge of more than two faces taken apart, and the number of such edges;
    faces keep their order.

    Around an edge the faces are paired so that each pair encloses what is solid between them: from
    one that is wound against the edge's direction on, with the next that is wound with it (turning
    about the edge to the right, the solid lies behind the second). A face pair with the same three
    corners goes together first: it encloses nothing. Faces of patches that have a rim of their own
    (fins) are paired last, so that a closed surface stays closed.
    """
    faces = np.asarray(mesh.faces)
    edges, face = mesh.edges, mesh.edges_face
    _, group, count = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    many = np.flatnonzero(count > 2)
    if not len(many):
        return mesh, 0
    order = np.argsort(group, kind="stable")
    first = np.cumsum(count) - count
    two = first[count == 2]
    glued = [np.stack([order[two], order[two + 1]], axis=1)]
    rimmed = _rimmed(glued[0], face, count[group], len(faces))
    for n, g in enumerate(many):
        if n % 256 == 0:
            tick(n / len(many))
        mine = order[first[g] : first[g] + count[g]]
        glued.append(_paired(mesh, edges[mine], face[mine], mine, rimmed[face[mine]]))
    return _reindexed(mesh, np.concatenate(glued), np.unique(edges[count[group] > 2])), len(many)


def split_rims(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with vertices at which rims touch taken apart: every rim is then a loop of its
    own."""
    _, group, count = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    rim = mesh.edges[count[group] == 1]
    touching = np.flatnonzero(np.bincount(rim[:, 0], minlength=len(mesh.vertices)) > 1)
    if not len(touching):
        return mesh
    order = np.argsort(group, kind="stable")
    two = (np.cumsum(count) - count)[count == 2]
    return _reindexed(mesh, np.stack([order[two], order[two + 1]], axis=1), touching)


def _rimmed(
    pairs: NDArray[np.int64], face: NDArray[np.int64], count: NDArray[np.int64], faces: int
) -> NDArray[np.bool_]:
    """(F,) whether the face's patch (faces joined by edges of two) has an edge of one face."""
    join = coo_matrix((np.ones(len(pairs)), (face[pairs[:, 0]], face[pairs[:, 1]])), (faces, faces))
    patch = connected_components(join, directed=False)[1]
    rim = np.zeros(patch.max() + 1, bool)
    rim[patch[face[count == 1]]] = True
    return rim[patch]


def _paired(
    mesh: trimesh.Trimesh,
    edge: NDArray[np.int64],
    face: NDArray[np.int64],
    half: NDArray[np.int64],
    rimmed: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """(n, 2) half edges that stay together; those left over become rims."""
    low, high = edge[0].min(), edge[0].max()
    along = edge[:, 0] == low
    third = mesh.faces[face].sum(axis=1) - low - high
    free = np.ones(len(half), bool)
    found: list[tuple[int, int]] = []

    def take(i: int, j: int) -> None:
        free[[i, j]] = False
        found.append((int(half[i]), int(half[j])))

    for i in np.flatnonzero(along).tolist():  # two faces back to back
        twin = np.flatnonzero(free & ~along & (third == third[i]))
        if free[i] and len(twin):
            take(i, int(twin[0]))
    axis = mesh.vertices[high] - mesh.vertices[low]
    axis = axis / max(float(np.linalg.norm(axis)), 1e-300)
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x /= np.linalg.norm(x)
    spoke = mesh.vertices[third] - mesh.vertices[low]
    turn = np.round(np.arctan2(spoke @ np.cross(axis, x), spoke @ x), ANGLE_DIGITS)
    for pool in (~rimmed, np.ones(len(half), bool)):
        for against, onward in _around(turn, along, free & pool):
            take(against, onward)
    return np.array(found, np.int64).reshape(-1, 2)


def _around(
    turn: NDArray[np.float64], along: NDArray[np.bool_], free: NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """Pairs (against, with) in turn about the edge, nested like brackets; begun where the solid is
    the least deep."""
    mine = np.flatnonzero(free)
    if not along[mine].any() or along[mine].all():
        return []
    mine = mine[
        np.lexsort((~along[mine], turn[mine]))
    ]  # with before against: bodies that touch stay two
    depth = np.cumsum(np.where(along[mine], -1, 1))
    mine = np.roll(mine, -(int(np.argmin(depth)) + 1))
    opened: list[int] = []
    found = []
    for i in mine.tolist():
        if not along[i]:
            opened.append(i)
        elif opened:
            found.append((opened.pop(), i))
    return found


def _reindexed(
    mesh: trimesh.Trimesh, glued: NDArray[np.int64], split: NDArray[np.int64]
) -> trimesh.Trimesh:
    """The mesh in which corners are one vertex where glued half edges join them; vertices off
    `split` stay as they are."""
    corners = 3 * len(mesh.faces)
    # half edge h goes from corner h to the next of its face
    follow = (np.arange(corners) // 3) * 3 + (np.arange(corners) % 3 + 1) % 3
    start, flat = mesh.edges[:, 0], np.asarray(mesh.faces).reshape(-1)
    assert (start == flat).all()
    a, b = glued[:, 0], glued[:, 1]
    same = start[a] == start[b]  # wound alike: not yet turned
    ends = [(a, np.where(same, b, follow[b])), (follow[a], np.where(same, follow[b], b))]
    join = np.concatenate([np.stack(e, axis=1) for e in ends])
    graph = coo_matrix((np.ones(len(join)), (join[:, 0], join[:, 1])), (corners, corners))
    label = connected_components(graph, directed=False)[1]
    apart = np.isin(flat, split)
    key = np.where(apart, len(mesh.vertices) + label, flat)
    _, first, index = np.unique(key, return_index=True, return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[flat[first]], index.reshape(-1, 3), process=False)
