"""The built-in objects against the facts they must have, recomputed here."""

import mujoco
import numpy as np
import pytest
import trimesh
from needs import needs

from r2h_batch.scene import objects
from r2h_batch.scene.objects import BUILT_IN_NAMES, build_object, load_objects, object_digest

TABLE = {  # scene.md: box in metres, mass in kg
    "game_controller": (0.155, 0.100, 0.055, 0.25), "bowl": (0.161, 0.160, 0.055, 0.147),
    "headphones": (0.190, 0.170, 0.075, 0.25), "eyeglasses": (0.140, 0.145, 0.045, 0.03),
    "cup": (0.100, 0.080, 0.080, 0.04), "wineglass": (0.172, 0.071, 0.071, 0.15),
    "hammer": (0.330, 0.126, 0.032, 0.665), "pliers": (0.180, 0.055, 0.012, 0.2),
    "knife": (0.155, 0.035, 0.018, 0.08), "toothbrush": (0.165, 0.023, 0.012, 0.018),
    "screwdriver": (0.216, 0.034, 0.033, 0.097), "scissors": (0.198, 0.088, 0.015, 0.082),
    "power_drill": (0.186, 0.184, 0.057, 0.895), "binoculars": (0.142, 0.109, 0.048, 0.35),
    "bottle": (0.250, 0.075, 0.075, 0.6), "trigger_sprayer": (0.290, 0.100, 0.075, 0.55),
    "can": (0.110, 0.075, 0.075, 0.455), "dispenser": (0.182, 0.084, 0.074, 0.33),
}  # fmt: skip
every_object = pytest.mark.parametrize("name", BUILT_IN_NAMES)


def one(name):
    return load_objects([name])[0]


def planes(mesh):
    return mesh.face_normals, np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles[:, 0])


def test_the_sixteen_objects_come_in_benchmark_order_with_their_splits():
    models = load_objects()
    assert tuple(m.name for m in models) == objects.OBJECT_NAMES and list(TABLE) == list(BUILT_IN_NAMES)
    assert [m.split for m in models] == ["S0"] * len(objects.S0_NAMES) + ["S1"] * len(objects.S1_NAMES)
    with pytest.raises(ValueError, match="unknown object 'spoon'"):
        load_objects(["spoon"])
    with pytest.raises(ValueError, match=r"unknown object 'cupp', did you mean cup\?") as refused:
        load_objects(["cupp"])
    assert "hammer" not in str(refused.value), "all names beside the nearest one"


@every_object
def test_each_object_is_one_closed_outward_body_of_the_tables_size_and_mass_in_its_hull(name):
    model = one(name)
    mesh = model.mesh
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0 and mesh.body_count == 1
    assert np.abs(np.sort(mesh.extents) / np.sort(TABLE[name][:3]) - 1).max() <= 0.10
    assert model.mass == pytest.approx(TABLE[name][3])
    assert np.abs(mesh.bounds.mean(axis=0)).max() < 1e-7
    assert len(np.unique(model.vertices, axis=0)) == len(model.vertices)
    hull = trimesh.Trimesh(model.hull_vertices.astype(float), model.hull_faces, process=False)
    assert hull.is_watertight and hull.is_winding_consistent
    normal, offset = planes(hull)
    assert (hull.vertices @ normal.T - offset).max() < 1e-7, "not convex"
    assert (model.vertices @ normal.T - offset).max() < 1e-7, "a vertex of the mesh is outside"
    own = {x.tobytes() for x in model.vertices}
    assert all(x.tobytes() in own for x in model.hull_vertices), "a vertex is not one of the mesh"


def test_the_hull_of_a_fine_mesh_keeps_all_its_vertices():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    model = build_object(ball, pieces=False)
    found, own = ({x.tobytes() for x in v.astype(np.float32)} for v in (model.hull_vertices, ball.vertices))
    assert len(own) == 2562 and found == own


@every_object
def test_convex_pieces_are_few_convex_and_cover_the_mesh(name):
    model = one(name)
    assert 2 <= len(model.pieces) <= 16
    depth = np.full(len(model.points), np.inf)
    volume = 0.0
    for vertices, faces in model.pieces:
        piece = trimesh.Trimesh(vertices.astype(float), faces, process=False)
        normal, offset = planes(piece)
        assert piece.is_watertight and (piece.vertices @ normal.T - offset).max() < 1e-7
        depth = np.minimum(depth, (model.points @ normal.T - offset).max(axis=1))
        volume += piece.volume
    assert depth.max() < 1e-4, "the pieces leave more than 0.1 mm of the surface outside"
    hull = trimesh.Trimesh(model.hull_vertices.astype(float), model.hull_faces, process=False)
    assert model.mesh.volume < 1.001 * volume
    assert volume < max(0.6 * hull.volume, 1.25 * model.mesh.volume)


@every_object
def test_mass_center_and_inertia_agree_with_mujocos(name):
    model, spec = one(name), mujoco.MjSpec()
    mesh = spec.add_mesh(name="m")
    mesh.uservert, mesh.userface = model.vertices.ravel(), model.faces.ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT
    body = spec.worldbody.add_body(name="b")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m", mass=model.mass)
    b = spec.compile().body("b")
    assert b.ipos == pytest.approx(model.com, abs=2e-6)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, b.iquat)
    rotation = rotation.reshape(3, 3)
    reference = rotation @ np.diag(b.inertia) @ rotation.T
    assert np.abs(model.inertia - reference).max() < 1e-4 * np.trace(reference)


@needs("coacd")
def test_the_build_script_makes_the_committed_arrays_again():
    from r2h_batch.assets.objects.build_objects import SPECS, build

    assert set(SPECS) == set(BUILT_IN_NAMES)
    assert object_digest(build(SPECS["screwdriver"])) == object_digest(one("screwdriver"))
