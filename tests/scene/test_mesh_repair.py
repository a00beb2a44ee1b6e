"""Repairs do no harm: what is closed stays as it is, to the micrometre, whatever is wrong beside it."""

import warnings

import numpy as np
import pytest
import torch
import trimesh
from convex_twin import winding_number
from grasp_cases import model_of
from scipy.spatial.transform import Rotation

from r2h_batch.config import OPEN_GAP_M
from r2h_batch.judge.grasp import gripper_poses, open_is_clear, region_distance
from r2h_batch.scene.grasp_tables import grasp_tables
from r2h_batch.scene.mesh_import.closed import closed_mesh
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.scene.solid import signed_distance

MUG = trimesh.creation.revolve(
    np.array([(0, -0.045), (0.04, -0.045), (0.04, 0.045), (0.037, 0.045), (0.037, -0.042), (0, -0.042)]), sections=48
)
"""Wall and floor of 3 mm, turned from a profile; closed."""
N = len(MUG.vertices)


def closed(mesh):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = closed_mesh(mesh, "object", 1.0)
    assert found.mesh.is_watertight and found.mesh.is_winding_consistent and found.mesh.volume > 0
    return found, " | ".join(str(w.message) for w in caught)


def closed_with(faces, *vertices):
    """The mug with more vertices, numbered from N, and more faces."""
    corners = np.vstack([MUG.vertices, np.reshape(vertices, (-1, 3))])
    return closed(trimesh.Trimesh(corners, np.vstack([MUG.faces, faces]), process=False))


def test_slivers_on_a_closed_mug_are_dropped_and_it_stays_what_it_is():
    """Two triangles with two sides each, glued to edges of the mug, which four faces then share."""
    (a, b), (c, d) = MUG.edges[100], MUG.edges[500]
    both = [[a, b, N], [b, a, N], [c, d, N + 1], [d, c, N + 1]]
    found, said = closed_with(both, MUG.vertices[[a, c]] + [[0, 0, 4e-4], [3e-4, 0, 0]])
    assert "dropped 2 slivers without volume (4 faces)" in said
    assert "rebuilt" not in said and found.repair.moved_m < 1e-3
    assert found.repair.volume_m3 == pytest.approx(MUG.volume, rel=1e-9)
    assert f"Volume {1e6 * MUG.volume:.4g} -> {1e6 * MUG.volume:.4g} cm3 (" in said and "0.00 %)" in said
    assert np.abs(signed_distance(MUG, found.mesh.vertices)[0]).max() < 1e-7
    # needles: two faces without area on an edge of the mug
    along = MUG.vertices[MUG.edges[:, 1]] - MUG.vertices[MUG.edges[:, 0]]
    upright = MUG.edges[np.abs(along[:, 2]) > 0.08]
    for a, b in upright[[1, 19]]:  # rounding gives some a volume, and others none
        found, said = closed_with([[a, b, N], [b, a, N]], 0.75 * MUG.vertices[a] + 0.25 * MUG.vertices[b])
        assert "dropped 1 slivers without volume (2 faces)" in said and "rebuilt" not in said
        assert found.mesh.volume == pytest.approx(MUG.volume, rel=1e-9) and found.repair.moved_m < 1e-3


def test_a_flap_that_lies_on_the_surface_is_a_sliver_and_a_flag_on_it_becomes_a_plate():
    flap = [[N, N + 1, N + 2], [N + 1, N, N + 2]]
    found, said = closed_with(flap, MUG.triangles[3] + 2e-5 * MUG.face_normals[3])
    assert "dropped 1 slivers" in said and found.mesh.volume == pytest.approx(MUG.volume, rel=1e-9)
    top = np.flatnonzero(MUG.vertices[:, 2] > 0.0449)
    a, b, c = top[[0, len(top) // 3, 2 * len(top) // 3]]
    found, said = closed_with([[a, b, c], [b, a, c]])  # a lid between three points of the rim does not lie on it
    assert "slivers" not in said and "made that thick" in said
    found, said = closed_with(flap, [[0.039, 0, 0], [0.09, 0, 0], [0.09, 0, 0.03]])
    assert "made that thick" in said and "united 2 overlapping bodies" in said
    assert found.mesh.bounds[1, 0] == pytest.approx(0.09, abs=1e-3)
    away = found.mesh.vertices[np.abs(found.mesh.vertices[:, 1]) > 0.005]
    assert np.abs(signed_distance(MUG, away)[0]).max() < 1e-6, "the mug itself is as it was"


def test_a_body_with_a_rim_is_rebuilt_and_the_closed_one_beside_it_is_not():
    block = trimesh.creation.box((0.06, 0.04, 0.03))
    dome = trimesh.creation.icosphere(subdivisions=3, radius=0.03).apply_translation((0.06, 0, 0))
    half = trimesh.Trimesh(dome.vertices, dome.faces[dome.triangles_center[:, 0] < 0.062], process=False)
    found, said = closed(trimesh.util.concatenate([block, half]))
    assert "rebuilt by winding number" in said and "open sheets made" in said
    assert float(said.split("changed by up to ")[1].split(" mm")[0]) < 0.3
    for corner in block.vertices[block.vertices[:, 0] < 0]:
        assert np.abs(found.mesh.vertices - corner).max(axis=1).min() == 0.0
    hollow = abs(winding_number(np.array([0.06, 0, 0]), found.mesh.triangles)) < 1e-6
    assert hollow, "half a ball drawn as a sheet is hollow"


def test_a_box_that_misses_a_face_becomes_a_solid_and_one_with_a_bent_rim_does_not():
    box = trimesh.creation.box((0.05, 0.03, 0.025)).subdivide()
    opened = trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] < 0.9], process=False)
    found, said = closed(opened)
    assert "closed 1 flat openings" in said and "a vessel needs walls" in said
    assert found.mesh.volume == pytest.approx(box.volume, rel=1e-9)
    opened.vertices[np.argmax(opened.vertices @ [1.0, 1.0, 1.0])] += [0.004, 0, 0.004]
    assert "closed 1 flat" not in closed(opened)[1]


@pytest.mark.parametrize("uneven", [False, True])
def test_two_walls_without_a_lip_become_one_solid_wall(uneven):
    """A cup whose inside and outside were drawn apart, 1 mm from each other at the rim.

    Rims that run side by side are joined exactly. An inner wall that ends 2.5 mm below leaves a gap that is too wide.
    """
    profile = [(0, -0.05), (0.03, -0.05), (0.035, 0.05), (0.034, 0.05), (0.034, 0.0475), (0.029, -0.049), (0, -0.049)]
    turned = trimesh.creation.revolve(np.array(profile), sections=40)
    middles, level = turned.triangles_center, np.abs(turned.face_normals[:, 2]) > 0.99
    lip = level & (middles[:, 2] > 0.049)
    if uneven:
        lip |= (np.linalg.norm(middles[:, :2], axis=1) < 0.0342) & (middles[:, 2] > 0.0476)
    found, said = closed(trimesh.Trimesh(turned.vertices, turned.faces[~lip], process=False))
    assert lip.sum() == (160 if uneven else 80)
    assert ("rebuilt by winding number" if uneven else "joined 1 pairs of rims") in said
    assert found.mesh.volume == pytest.approx(turned.volume, rel=0.02 if uneven else 1e-6)


def test_a_gripper_beside_an_opening_is_clear_once_it_is_closed_though_a_ray_through_it_says_buried() -> None:
    """An open surface has no inside: a ray from a finger beside it that leaves through the opening counts as buried."""
    box = trimesh.creation.box((0.04, 0.05, 0.12)).subdivide()
    opened = trimesh.Trimesh(box.vertices, box.faces[box.triangles_center[:, 2] < 0.0599], process=False)  # no lid
    opened.apply_transform(trimesh.transformations.euler_matrix(0.7, 0.5, 0.0))  # rays begin in the bounding box alone
    repaired, said = closed(opened)
    assert "closed 1 flat openings" in said
    rng, n = np.random.default_rng(2), 3000
    T = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
    T[:, :3, :3] = Rotation.from_quat(rng.normal(size=(n, 4))).as_matrix()
    T[:, :3, 3] = rng.uniform(-0.08, 0.08, (n, 3))
    poses, none, clear, shell = torch.from_numpy(T), torch.zeros(n, dtype=torch.int32), [], []
    for mesh in (repaired.mesh, repaired.given):
        tables = grasp_tables([model_of(mesh, lambda m: np.ones(len(m.faces), bool))], load_robot())
        clear.append(open_is_clear(tables, poses, none, clearance_m=0.001).numpy())
        shell.append(region_distance(tables, poses, none, torch.full((n,), OPEN_GAP_M))[0].numpy())
    only_after = clear[0] & ~clear[1]
    assert only_after.sum() > 10 and (shell[1][only_after] > 0.0009).all()  # fingers that touch neither
    place = gripper_poses(load_robot(), torch.full((int(only_after.sum()),), OPEN_GAP_M))[1].numpy()
    middles = np.einsum("nij,ngj->ngi", T[only_after][:, :3, :3], place) + T[only_after][:, None, :3, 3]
    for mesh in (repaired.mesh, repaired.given):  # and are in neither, by solid angles in float64
        assert max(winding_number(x, mesh.triangles) for x in middles.reshape(-1, 3).astype(float)) < 0.5
