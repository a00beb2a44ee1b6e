"""Convex pieces of a user's object: few, convex, and nothing of the surface outside."""

import numpy as np
import trimesh
from needs import needs

from r2h_batch.scene.mesh_import.pieces import convex_pieces


@needs("manifold3d")
def test_a_ring_and_a_thin_cup_are_cut_though_the_first_cut_gains_nothing() -> None:
    from r2h_batch.scene.mesh_import.cut import cut_apart, merge_hulls

    ring = trimesh.creation.annulus(0.03, 0.036, 0.03)
    inside = trimesh.creation.cylinder(0.0346, 0.1).apply_translation([0, 0, 0.0004])
    cup = trimesh.boolean.difference([trimesh.creation.cylinder(0.035, 0.1), inside], engine="manifold")
    for solid, most, joined in ((ring, 1.1, 1.3), (cup, 3.5, 5.5)):  # hulls of the whole: 3.3 and 30 times the solid
        found = cut_apart(solid)
        volumes = [sum(trimesh.convex.convex_hull(p).volume for p in x) for x in (found, merge_hulls(found, 16))]
        assert len(found) <= 64 and solid.volume <= volumes[0] < most * solid.volume
        assert volumes[1] < joined * solid.volume


@needs("manifold3d")
def test_pieces_hold_the_surface_and_little_else() -> None:
    teeth = [trimesh.creation.box((0.01, 0.02, 0.06)).apply_translation([x, 0, 0.02]) for x in (-0.04, -0.01, 0.02)]
    comb = trimesh.boolean.union([trimesh.creation.box((0.09, 0.02, 0.02)), *teeth], engine="manifold")
    found = convex_pieces(comb, "comb")
    points = np.concatenate([comb.vertices, trimesh.sample.sample_surface(comb, 20000, seed=1)[0]])
    depth, volume = np.full(len(points), np.inf), 0.0
    for vertices, faces in found:
        piece = trimesh.Trimesh(vertices.astype(float), faces, process=False)
        offset = np.einsum("ij,ij->i", piece.face_normals, piece.triangles[:, 0])
        depth = np.minimum(depth, (points @ piece.face_normals.T - offset).max(axis=1))
        volume += piece.volume
    assert 2 <= len(found) <= 16 and depth.max() < 6e-5
    assert comb.volume * 0.999 < volume < 1.1 * comb.volume
