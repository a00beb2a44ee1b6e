"""The default hand and the hand set, against independent float64 twins and the figures of scene.md."""

from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from hand_twins import MIRROR, skinning_twin
from scipy.spatial import ConvexHull

from r2h_batch.assets.hand.build_handset import POSTURES, mirrored, pose_from_angles
from r2h_batch.assets.hand.measure import sample_inside, sample_surface
from r2h_batch.scene.hand import ball_center, load_hand, load_hand_set, palm_frame

SAMPLE = [pytest.param(i, marks=pytest.mark.slow if i % 5 else ()) for i in range(0, 400, 21)]
"""20 hands: both sides, every posture. Four of them, of both sides, are quick."""
HAND, HANDS = load_hand(), load_hand_set()


@cache
def posed():
    return HAND.pose(HANDS.pose, HANDS.shape, HANDS.side)


def mesh_of(vertices, side=0):
    return trimesh.Trimesh(np.asarray(vertices, np.float64), HAND.faces_by_side[side].numpy(), process=False)


def test_the_template_is_one_closed_outward_surface_of_genus_zero_whose_faces_lie_in_pieces():
    for side in (0, 1):
        mesh = mesh_of(HAND.vertices.numpy() * (MIRROR if side else 1), side)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
        assert mesh.euler_number == 2 and mesh.body_count == 1
        assert len(np.unique(mesh.faces)) == len(mesh.vertices)
        assert mesh.area_faces.min() > 1e-6 and np.degrees(mesh.face_angles.min()) > 15
    pieces = [set(p.tolist()) for p in HAND.pieces]
    assert len(pieces) == len(HAND.piece_names) == 20
    assert all(any(piece.issuperset(face) for piece in pieces) for face in HAND.faces.tolist())


def test_skinning_matches_a_matrix_twin_on_both_sides_and_a_row_has_the_same_bits_in_any_batch():
    rng = np.random.default_rng(0)
    pose, shape = rng.normal(0, 0.6, (100, 48)).astype(np.float32), rng.normal(0, 1, (100, 10)).astype(np.float32)
    pose[:6, 3:9] = 0.0  # joints without a turn
    side = (np.arange(100) % 2).astype(np.int8)
    got = HAND.pose(*map(torch.from_numpy, (pose, shape, side)))
    assert got.vertices.dtype == got.joints.dtype == torch.float32
    for i in range(24):
        vertices, joints = skinning_twin(HAND, pose[i], shape[i], int(side[i]))
        assert np.abs(got.vertices[i].numpy() - vertices).max() < 3e-8
        assert np.abs(got.joints[i].numpy() - joints).max() < 3e-8
    for rows in (np.arange(0), np.arange(1), np.arange(33), rng.permutation(100)):
        part = HAND.pose(*(torch.from_numpy(x[rows]) for x in (pose, shape, side)))
        assert torch.equal(part.vertices, got.vertices[rows]) and torch.equal(part.joints, got.joints[rows])


def test_palm_normal_points_out_of_the_palm_on_both_sides():
    curl = np.zeros((16, 3))
    curl[1:13, 0] = 40.0
    bent = pose_from_angles(curl, HAND.joint_axes.double().numpy())
    for side in (0, 1):
        sides = torch.tensor([side])
        rest = HAND.pose(torch.zeros(1, 48), None, sides)
        point, normal = palm_frame(rest.joints, sides)
        assert torch.allclose(normal, torch.tensor([[0.0, -1.0, 0.0]]), atol=0.08)
        # Bending the fingers brings their tips to the side that the normal points to.
        pose = torch.from_numpy(mirrored(bent) if side else bent).float()[None]
        move = HAND.pose(pose, None, sides).vertices[0] - rest.vertices[0]
        assert torch.all(move[HAND.tip_vertices[:4]] @ normal[0] > 0.03)
        # Seen from the palm, the ball's centre is outside the hand and the skin between faces it.
        mesh = mesh_of(rest.vertices[0].numpy(), side)
        _, _, face = mesh.ray.intersects_location(point.numpy(), normal.numpy(), multiple_hits=False)
        assert mesh.face_normals[face[0]] @ normal[0].numpy() > 0.8
    p, n = palm_frame(posed().joints, HANDS.side)
    roots = posed().joints[:, [0, 1, 4, 7, 10]].double().mean(dim=1)
    assert torch.allclose(p.double(), roots, atol=1e-7) and torch.allclose(n.norm(dim=1), torch.ones(400), atol=1e-6)
    assert torch.allclose(ball_center(posed().joints, HANDS.side), p + 0.12 * n, atol=1e-7)
    for i in range(0, 400, 40):
        cross = np.cross(*(posed().joints[i, [1, 7]] - posed().joints[i, 0]).double().numpy())
        want = cross / np.linalg.norm(cross) * (-1 if HANDS.side[i] else 1)
        assert np.abs(n[i].numpy() - want).max() < 1e-6


@pytest.mark.parametrize("i", SAMPLE)
def test_the_pieces_enclose_skin_and_inside_in_every_posture(i):
    vertices = posed().vertices[i].double().numpy()
    faces = HAND.faces_by_side[int(HANDS.side[i])].numpy()
    skin = sample_surface(vertices, faces, 2000, seed=i)
    inside = sample_inside(vertices, faces, 100, seed=i)
    depth = np.full(len(skin) + len(inside), np.inf)
    offsets = HANDS.hull_offsets.tolist()
    for k, piece in enumerate(HAND.pieces):
        stored = HANDS.hull_vertex_ids[offsets[20 * i + k] : offsets[20 * i + k + 1]].numpy()
        assert np.all(np.isin(stored, piece.numpy())) and np.all(np.diff(stored) > 0) and len(stored) <= 64
        planes = ConvexHull(vertices[stored]).equations
        assert (vertices[piece.numpy()] @ planes[:, :3].T + planes[:, 3]).max() < 1e-9
        outside = (np.concatenate([skin, inside]) @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        depth = np.minimum(depth, outside)
    assert depth.max() < 1e-9


def test_the_set_has_both_sides_and_every_posture():
    side = HANDS.side.numpy()
    assert len(HANDS) == 400 and np.all(side[:200] == 0) and np.all(side[200:] == 1)
    assert HANDS.pose.shape == (400, 48) and HANDS.shape.shape == (400, 10)
    for half in (HANDS.posture[:200], HANDS.posture[200:]):
        assert set(half) == set(POSTURES) and min(half.count(n) for n in POSTURES) >= 30
    assert len(np.unique(HANDS.pose.numpy().round(4), axis=0)) == 400
