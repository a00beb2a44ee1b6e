"""Convex pieces of a user's object: few, convex, and nothing of the surface outside."""

import numpy as np
import pytest
import trimesh

from r2h_batch.scene.mesh_import.pieces import convex_pieces


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


def test_the_plane_that_is_taken_is_the_best_of_all() -> None:
    """Planes that cannot be better are left out; what is found is, bit for bit, what trying each of them finds."""
    from manifold3d import Manifold, Mesh64

    from r2h_batch.scene.families.draw import draw_instance
    from r2h_batch.scene.mesh_import import cut

    box = trimesh.creation.box((0.09, 0.02, 0.02))
    teeth = [trimesh.creation.box((0.01, 0.02, 0.06)).apply_translation([x, 0, 0.02]) for x in (-0.04, -0.01, 0.02)]
    symmetric = trimesh.creation.icosphere(3, 0.04).difference(trimesh.creation.box((0.03, 0.03, 0.2)))
    solids = [trimesh.boolean.union([box, *teeth], engine="manifold"), symmetric]
    solids += [draw_instance(name, 77, k).mesh for name, k in (("pliers", 0), ("cup", 1), ("scissors", 2))]
    tried = made = 0

    class Counted(Manifold):
        @staticmethod
        def hull_points(points):
            nonlocal made
            made += 1
            return Manifold.hull_points(points)

    def halves(solid):
        """Both sides of the best of all planes, or of the one across the middle of the length; as bodies."""
        nonlocal tried
        mesh = solid.to_mesh64()
        p, f = np.asarray(mesh.vert_properties, np.float64)[:, :3], np.asarray(mesh.tri_verts, np.int64)
        corner = p[f]
        area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        middle = corner.mean(axis=1)
        middle = middle - np.average(middle, axis=0, weights=area + 1e-30)
        axes = np.concatenate([np.linalg.eigh((middle * area[:, None]).T @ middle)[1].T, np.eye(3)])
        edges = np.concatenate([f[:, k] for k in ([0, 1], [1, 2], [2, 0])])
        edges = edges[edges[:, 0] < edges[:, 1]]
        planes, length, longest = [], cut.SHORTEST_M, None
        for n in axes:
            along = p @ n
            low, extent = along.min(), np.ptp(along)
            if extent > 1.001 * length:
                length, longest = extent, (n, low + extent / 2)
            for share in cut.AT if extent > cut.SHORTEST_M / 2 else ():
                s = along - (low + share * extent)
                a, b = s[edges[:, 0]], s[edges[:, 1]]
                over = (a > 0) != (b > 0)
                t = (a[over] / (a[over] - b[over]))[:, None]
                rim = p[edges[over, 0]] * (1 - t) + p[edges[over, 1]] * t
                tried += 2
                left = sum(Manifold.hull_points(np.concatenate([p[x], rim])).volume() for x in (s > 0, s <= 0))
                planes.append((left, len(planes), n, low + share * extent))
        if longest is None:
            return []
        left, _, *best = min(planes, key=lambda x: x[:2])
        hull = solid.hull().volume()
        n, at = best if hull - left > cut.WORTH * max(0.0, hull - solid.volume()) else longest
        return [body for side in solid.split_by_plane(n, float(at)) for body in side.decompose()]

    for solid in solids:
        whole = Manifold(Mesh64(np.array(solid.vertices, np.float64), np.array(solid.faces, np.uint64)))
        parts, done = list(whole.decompose()), []
        enough = cut.FULL * sum(x.volume() for x in parts)

        def excess(x):
            return max(0.0, x.hull().volume() - x.volume())

        while parts and len(parts) + len(done) < cut.MOST_PARTS and sum(map(excess, [*parts, *done])) > enough:
            part = parts.pop(max(range(len(parts)), key=lambda k: excess(parts[k])))
            found = halves(part)
            parts, done = (parts + found, done) if len(found) > 1 else (parts, [*done, part])
        expected = [np.asarray(x.to_mesh64().vert_properties, np.float64)[:, :3] for x in (*parts, *done)]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cut, "Manifold", Counted)
            found = cut.cut_apart(solid)
        assert len(found) == len(expected) > 3
        assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
    assert made < 0.65 * tried
