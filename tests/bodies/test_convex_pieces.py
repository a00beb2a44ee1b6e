"""Convex pieces of a user's object: few, convex, and nothing of the surface outside."""

import numpy as np
import pytest
import trimesh

from r2h_batch.bodies.mesh_import.pieces import convex_pieces
from tests.support.needs import needs


@needs("manifold3d")
def test_parts_are_joined_where_that_adds_least() -> None:
    from r2h_batch.bodies.mesh_import.cut import merge_hulls

    box = trimesh.creation.box((0.01, 0.01, 0.01)).vertices
    row = [box + [0.01 * i, 0, 0] for i in range(5)]
    corner = [box + [0, 0.01 * i, 0] for i in (1, 2)]
    flat = [np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]) * 0.01]
    found = merge_hulls([*row, *corner, *flat], 2)
    volumes = sorted(trimesh.convex.convex_hull(p).volume for p in found)
    assert np.allclose(volumes, [2e-6, 5e-6])
    assert len(merge_hulls(row, 16)) == 5
    assert len(merge_hulls([*row, *corner], 16, 1e-9)) == 2  # what adds nothing is joined although there are few enough


@needs("manifold3d")
def test_a_triangle_that_sticks_out_is_taken_in_whole_by_the_nearest_piece() -> None:
    from r2h_batch.bodies.mesh_import.cut import inflate_to_cover

    box = trimesh.creation.box((0.02, 0.02, 0.02)).vertices
    far = box + [0.1, 0, 0]
    point = np.array(
        [[0.11 + 0.003, 0, 0], [0.11, 0, 0], [0.09 - 4e-3, 0, 0], [0.01 + 4e-5, 0, 0], [0.01, 0, 0], [0, 0, 0]]
    )
    first, second = inflate_to_cover([box, far], point, np.array([[0, 1, 2], [3, 4, 5]]), 5e-5)
    assert np.allclose(np.sort(first, axis=0), np.sort(box, axis=0))
    assert np.isclose(second[:, 0].max(), 0.113) and np.isclose(second[:, 0].min(), 0.086)
    between = np.array([[0.01, 0, 0], [0.09, 0, 0], [0.05, 0, 0.005]])  # corners in pieces, the middle in none
    first, second = inflate_to_cover([box, far], between, np.array([[0, 1, 2]]), 5e-5)
    assert first[:, 0].max() > 0.089 or second[:, 0].min() < 0.011
    halved = inflate_to_cover([box, far], between, np.array([[0, 1, 2]]), 5e-5, 0.02)
    assert all(np.ptp(p[:, 0]) > 0.05 for p in halved)  # each takes the triangles next to it, those held are left


@needs("manifold3d")
def test_a_ring_and_a_thin_cup_are_cut_though_the_first_cut_gains_nothing() -> None:
    from r2h_batch.bodies.mesh_import.cut import cut_apart, merge_hulls

    ring = trimesh.creation.annulus(0.03, 0.036, 0.03)
    cup = trimesh.boolean.difference(
        [
            trimesh.creation.cylinder(0.035, 0.1),
            trimesh.creation.cylinder(0.0346, 0.1).apply_translation([0, 0, 0.0004]),
        ],
        engine="manifold",
    )
    for solid, most, joined in ((ring, 1.1, 1.3), (cup, 3.5, 5.5)):  # hulls of the whole: 3.3 and 30 times the solid
        found = cut_apart(solid)
        volume = [
            sum(trimesh.convex.convex_hull(p).volume for p in parts) / solid.volume
            for parts in (found, merge_hulls(found, 16))
        ]
        assert len(found) <= 64 and 1 <= volume[0] < most and volume[1] < joined


@needs("manifold3d")
@pytest.mark.parametrize("parts", [2, 3])
def test_pieces_hold_the_surface_and_little_else(parts: int) -> None:
    teeth = [trimesh.creation.box((0.01, 0.02, 0.06)) for _ in range(parts)]
    for i, tooth in enumerate(teeth):
        tooth.apply_translation([0.03 * i - 0.015 * parts + 0.005, 0, 0.02])
    comb = trimesh.boolean.union([trimesh.creation.box((0.03 * parts, 0.02, 0.02)), *teeth], engine="manifold")
    found = convex_pieces(comb, "comb")
    points = np.concatenate([comb.vertices, trimesh.sample.sample_surface(comb, 20000, seed=1)[0]])
    depth = np.full(len(points), np.inf)
    for vertices, faces in found:
        piece = trimesh.Trimesh(vertices.astype(float), faces, process=False)
        offset = np.einsum("ij,ij->i", piece.face_normals, piece.triangles[:, 0])
        depth = np.minimum(depth, (points @ piece.face_normals.T - offset).max(axis=1))
    assert 2 <= len(found) <= 16 and depth.max() < 6e-5
    volume = sum(trimesh.Trimesh(v.astype(float), f, process=False).volume for v, f in found)
    assert comb.volume * 0.999 < volume < 1.1 * comb.volume
