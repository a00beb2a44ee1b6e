"""The frozen receiving grasps against trimesh and solid angles in float64, and the sampler's promises."""

import json
from importlib import resources

import numpy as np
import pytest
import torch
import trimesh
from golden import GOLDEN, made_with
from hand_twins import skinning_twin
from rounds import each
from scipy.spatial import cKDTree

from r2h_batch.assets.hand.measure import hull_planes, sample_surface, winding_number
from r2h_batch.base import se3
from r2h_batch.base.launch import init_warp
from r2h_batch.data.people import people_hand
from r2h_batch.scene.arrays import arrays_digest
from r2h_batch.scene.hand import load_hand
from r2h_batch.scene.objects import build_object, load_objects, object_digest
from r2h_batch.trials.holding import held_out, receiving
from r2h_batch.trials.holding.hand_closing import DEEPEST_M, distance_field, field_distance
from r2h_batch.trials.holding.hand_contact import (
    REGIONS,
    THUMB,
    ObjectSurface,
    hand_depth,
    measure_contact,
    palmar_region,
)
from r2h_batch.trials.holding.instructions import intents_of
from r2h_batch.trials.holding.receiving import CONTACT_M, PENETRATION_M, load_receiving, receiving_digest
from r2h_batch.trials.holding.sampler import sample_receiving

OBJECTS = load_objects()
TOLERANCE_M = 1e-4


@pytest.fixture(scope="module")
def grasps():
    return load_receiving()


UNOPPOSED = [98]
"""One hold of the bowl: thumb and fingers are nearest to the same side of its wall."""


def stored() -> dict[str, np.ndarray]:
    path = resources.files("r2h_batch.assets.receiving") / "receiving.npz"
    with path.open("rb") as stream, np.load(stream) as data:
        return dict(data)


def report() -> dict:
    return json.loads((resources.files("r2h_batch.assets.receiving") / "receiving_report.json").read_text())


def depth_and_gaps(grasps, row: int) -> tuple[float, float, float, np.ndarray, np.ndarray]:
    """Skin in object, back in object, object in skin (m); per region distance and the object's normal there.

    By the skinning twin, closest points of trimesh and solid angles; only what is near the other surface is measured.
    """
    hand, model = grasps.hand, OBJECTS[int(grasps.object_index[row])]
    solid, side = model.mesh, int(grasps.side[row])
    skin, _ = skinning_twin(hand, grasps.pose[row].numpy(), grasps.shape[row].numpy(), side)
    T = grasps.T_obj_hand[row].double().numpy()
    skin = skin @ T[:3, :3].T + T[:3, 3]
    assert np.abs(skin - grasps.vertices[row].numpy()).max() < 1e-6
    cloud = sample_surface(solid.vertices, solid.faces, 20_000, seed=1)
    near = np.flatnonzero(cKDTree(cloud).query(skin)[0] < 0.008)
    _, distance, face = trimesh.proximity.closest_point(solid, skin[near])
    signed = np.full(len(skin), 1.0)
    inside = winding_number(solid.vertices, solid.faces, skin[near]) > 0.5
    signed[near] = np.where(inside, -distance, distance)
    normal = np.zeros((len(skin), 3))
    normal[near] = solid.face_normals[face]
    region = palmar_region(hand)
    closest = [np.flatnonzero(region == r)[signed[region == r].argmin()] for r in range(len(REGIONS))]
    body = trimesh.Trimesh(skin, hand.faces_by_side[side].numpy(), process=False)
    points = np.concatenate([model.points, model.vertices, cloud[:4000]])
    points = points[((points > skin.min(0)) & (points < skin.max(0))).all(1)]
    within = np.zeros(len(points), bool)  # the pieces' hulls enclose the skin
    for piece in hand.pieces:
        plane = hull_planes(skin[piece.numpy()])
        within |= (points @ plane[:, :3].T + plane[:, 3] < 1e-6).all(1)
    points = points[within]
    held = points[winding_number(body.vertices, body.faces, points) > 0.5]
    thin = trimesh.proximity.closest_point(body, held)[1].max() if len(held) else 0.0
    back = float(max(0.0, -signed[region < 0].min()))
    return float(max(0.0, -signed.min())), back, float(thin), signed[closest], normal[closest]


def check(grasps, row: int) -> bool:
    """Asserts depth and contacts of a grasp; whether a finger opposes the thumb, by the surface's normals where they touch."""
    depth, back, thin, gap, normal = depth_and_gaps(grasps, row)
    where = f"grasp {row} of {OBJECTS[int(grasps.object_index[row])].name}"
    assert depth < PENETRATION_M + TOLERANCE_M, where
    assert back < 0.001 + TOLERANCE_M, where
    assert thin < PENETRATION_M + TOLERANCE_M, where
    touching = gap <= CONTACT_M + TOLERANCE_M
    assert touching[THUMB] and touching.sum() >= 3, where
    return any(touching[f] and normal[f] @ normal[THUMB] < 0 for f in range(THUMB))


def test_a_sample_of_the_frozen_grasps_touches_and_does_not_cut(grasps) -> None:
    for index in (1, 6):  # a thin wall, a handle
        rows = grasps.rows_of(index, index % 2)
        assert check(grasps, int(rows[(7 * index) % len(rows)]))


def test_grasps_of_the_peoples_hand_are_shipped_touch_and_do_not_cut(monkeypatch) -> None:
    def asked(*args: object, **kwargs: object) -> None:
        raise AssertionError("sampled")

    monkeypatch.setattr(receiving, "sample_receiving", asked)
    found = load_receiving(hand=people_hand())
    assert len(found) == 2 * receiving.PER_SIDE * len(OBJECTS) and not torch.equal(found.pose, load_receiving().pose)
    opposed = [check(found, int(found.rows_of(index, side)[5])) for index, side in ((0, 0), (4, 1), (8, 0), (12, 1))]
    assert all(opposed)


@pytest.mark.whole(part="trials")
def test_held_out_grasps_of_the_peoples_hand_are_shipped_touch_and_are_other_grasps(monkeypatch) -> None:
    def asked(*args: object, **kwargs: object) -> None:
        raise AssertionError("sampled")

    monkeypatch.setattr(held_out, "sample_receiving", asked)
    found = held_out.load_held_out(OBJECTS, people_hand()).grasps
    assert len(found) == 2 * held_out.PER_SIDE * len(OBJECTS)
    opposed = [check(found, int(found.rows_of(index, side)[100])) for index, side in ((1, 0), (5, 1), (9, 0), (13, 1))]
    assert all(opposed)
    shown = {row.tobytes() for row in load_receiving(hand=people_hand()).pose.numpy()}
    assert not shown & {row.tobytes() for row in found.pose.numpy()}


@pytest.mark.slow
def test_every_frozen_grasp_touches_and_does_not_cut(grasps) -> None:
    unopposed = [row for row in range(len(grasps)) if not check(grasps, row)]
    assert unopposed == UNOPPOSED


def test_grasps_lie_on_the_receivers_region_and_on_every_part_that_instructions_name(grasps) -> None:
    init_warp()
    for index, model in enumerate(OBJECTS):
        for intent in each(intents_of(model)):
            for side in (0, 1):
                rows = grasps.rows_of(index, side)
                held = torch.isin(grasps.part[rows], torch.tensor(intent.labels, dtype=torch.uint8))
                assert int(held.sum()) >= 3, f"{model.name}: {intent.part}, side {side}"
        rows = grasps.rows_of(index)[::8]
        if model.split == "S1":
            contact = measure_contact(ObjectSurface(model.vertices, model.faces), grasps.vertices[rows].numpy())
            touching = contact.gap <= CONTACT_M
            on = model.receiver_face[np.maximum(contact.face, 0)] & touching
            assert (on.sum(1) >= 0.5 * touching.sum(1)).all(), model.name


def test_the_files_are_the_ones_reported_and_fit_hand_and_objects(grasps) -> None:
    known = report()
    assert arrays_digest(stored()) == known["digest"]
    assert known["objects_digest"] == object_digest(OBJECTS)
    hand = load_hand()
    assert known["hand_digest"] == arrays_digest({"v": hand.vertices.numpy(), "w": hand.weights.numpy()})
    assert receiving_digest(grasps) == receiving_digest()
    assert receiving_digest(grasps[:-1]) != receiving_digest()


def test_the_builder_makes_the_stored_grasps_of_an_object() -> None:
    """The set is what today's sampler makes: bit for bit where golden was written, else to rounding."""
    found = sample_receiving(OBJECTS[4])
    own = {key: stored()[f"{OBJECTS[4].name}/{key}"] for key in found}
    if json.loads(GOLDEN.read_text())["made_with"] == made_with():
        assert all(np.array_equal(found[key], own[key]) for key in found)
    else:
        assert all(found[key].shape == own[key].shape for key in found)


def test_grasps_of_a_users_object_hold_by_the_exact_meshes() -> None:
    capsule = trimesh.creation.capsule(height=0.2, radius=0.012)
    stick = build_object(capsule, "stick", "S1", receiver="z<0.4", pieces=False)
    found = sample_receiving(stick, per_side=3)
    assert (found["side"] == np.repeat([0, 1], 3)).all()
    pose, shape, side, T = (torch.from_numpy(found[k]) for k in ("pose", "shape", "side", "T_obj_hand"))
    skin = se3.apply(T[:, None], load_hand().pose(pose, shape, side).vertices).numpy()
    contact = measure_contact(ObjectSurface(stick.vertices, stick.faces), skin)
    touching = contact.gap <= CONTACT_M
    assert (contact.depth < PENETRATION_M).all() and touching[:, THUMB].all() and (touching.sum(1) >= 3).all()
    points = np.concatenate([stick.points, stick.vertices])
    for of in (0, 1):
        assert (hand_depth(points, skin[found["side"] == of], of) < PENETRATION_M).all()


def test_walls_thinner_than_the_fields_nodes_are_apart_stop_fingers() -> None:
    cup = trimesh.creation.annulus(0.0335, 0.034, 0.1)  # fingers closed through this one: no hold of 4,800 proposals
    model = build_object(cup, "sleeve", pieces=False)
    surface = ObjectSurface(model.vertices, model.faces)
    assert np.abs(surface.thickness(0.02) - 5e-4).max() < 1e-5
    turn = np.arange(100)
    middle = np.stack([0.03375 * np.cos(turn), 0.03375 * np.sin(turn), np.linspace(-0.045, 0.045, 100)])
    seen = field_distance(distance_field(surface), middle.T.astype(np.float32))
    assert seen.max() < -DEEPEST_M
    assert len(sample_receiving(model, per_side=3)["side"]) == 6
