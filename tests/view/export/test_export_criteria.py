"""Whoever gets an exported folder can judge a trial with other tools: MuJoCo C and trimesh find the stored margins.

Plan and Safe along the motion: test_export.py.
"""

import mujoco
import numpy as np
import oracle
import pytest
import trimesh
from needs import needs

from r2h_batch.config import CLOSED_GAP_M
from r2h_batch.view.mjcf import export_trial
from r2h_batch.view.stored import Reader

TRIALS = ((0, "oracle"), (3, "oracle"), (2, "random"), (1, "random"))
CAP_M = 0.05
CUT_CAP_M = 0.01  # as far as Stability looks at the open gripper's clearance: docs/choices.md


class Folder:
    """An exported trial at one of its key frames, read with nothing of ours."""

    def __init__(self, folder, key):
        self.folder, self.model = folder, mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.key(key).id)
        mujoco.mj_forward(self.model, self.data)

    def number(self, name):
        return float(self.model.numeric(name).data[0])

    def mesh(self, name, body):
        """A mesh file in the frame of a body, brought into the world."""
        mesh = trimesh.load(self.folder / "meshes" / f"{name}.obj", process=False)
        place = self.data.body(body)
        return mesh.apply_transform(frame(place.xmat, place.xpos))

    def sites(self, prefix):
        """(shape, size, T_world_site) of the sites whose names begin so."""
        for i in range(self.model.nsite):
            if self.model.site(i).name.startswith(prefix):
                kind = oracle._KIND_OF_TYPE[int(self.model.site_type[i])]  # support's own table of MuJoCo's types
                yield kind, self.model.site_size[i], frame(self.data.site_xmat[i], self.data.site_xpos[i])


def frame(R, p):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.reshape(R, (3, 3)), p
    return T


def least(shapes, mesh):
    triangles = np.asarray(mesh.triangles)
    return min(oracle.mesh_distance(kind, size, T, triangles, cap=CAP_M) for kind, size, T in shapes)


@pytest.fixture(scope="module")
def folders(run, tmp_path_factory):
    reader, base = Reader(run), tmp_path_factory.mktemp("criteria")
    found = []
    for k, method in TRIALS:
        stored = reader.trial(k, method)
        folder = export_trial(stored, base / f"{k}{method}")
        found.append((stored.row, Folder(folder, "target"), Folder(folder, "home")))
    return found


@needs("rtree")
def test_reach_is_the_balls_distance_to_the_object(folders):
    judged = 0
    for row, at_target, _ in folders:
        if row["plan_reason"] == "ik_unreachable":
            continue  # there the object is not where it was asked for: the ghost is
        ball = at_target.model.site("ball")
        center, radius = at_target.data.site("ball").xpos, ball.size[0]
        mesh = at_target.mesh("object_mesh", "object")
        distance = -float(trimesh.proximity.signed_distance(mesh, [center])[0])  # trimesh: positive inside
        assert radius == at_target.number("reach_radius_m")
        assert abs(radius - max(distance, 0.0) - row["margin_reach_m"]) < 1e-4  # IK's tolerance
        palm = at_target.data.site("palm")
        normal = palm.xmat.reshape(3, 3)[:, 2]
        np.testing.assert_allclose(palm.xpos + at_target.number("reach_offset_m") * normal, center, atol=1e-6)
        judged += 1
    assert judged >= 3


def test_affordance_is_the_holding_fingers_distance_to_the_region(folders):
    judged = 0
    for row, _, home in folders:
        if row["margin_affordance_m"] is None:
            assert not (home.folder / "meshes" / "object_region.obj").exists()
            continue
        distance = least(home.sites("holding/"), home.mesh("object_region", "object"))
        if row["margin_affordance_m"] > 0:
            assert abs(min(distance, CAP_M) - min(row["margin_affordance_m"], CAP_M)) < 2e-5
        else:
            assert distance <= 1e-6
        judged += 1
    assert judged >= 2


def test_stability_is_what_lies_between_the_pads_and_that_the_open_fingers_come_in(folders):
    """The material between the pads by cutting the object's mesh with the planes of the pads' edges."""
    judged = 0
    for row, _, home in folders:
        if row["margin_stability_m"] < 0 or row["width_m"] is None:
            continue
        pads = [home.data.geom(f"gripper/{side}_pad") for side in ("left", "right")]
        half = home.model.geom("gripper/left_pad").size
        R, middle = pads[0].xmat.reshape(3, 3), (pads[0].xpos + pads[1].xpos) / 2
        whole = home.mesh("object_mesh", "object")
        vertices, faces = np.asarray(whole.vertices), np.asarray(whole.faces)
        for axis in (0, 2):
            for sign in (-1, 1):
                edge = middle + sign * half[axis] * R[:, axis]
                vertices, faces, _ = trimesh.intersections.slice_faces_plane(vertices, faces, -sign * R[:, axis], edge)
        y = (vertices[np.unique(faces)] - middle) @ R[:, 1]
        assert np.ptp(y) >= row["width_m"] - 2e-4  # it may hold several runs of material, of which one is gripped
        if np.ptp(y) <= row["width_m"] + 2e-4:
            judged += 1
        open_gripper = least(home.sites("coming/"), home.mesh("object_mesh", "object"))
        fits = min(home.number("w_max_m") - row["width_m"], row["width_m"] - CLOSED_GAP_M)
        margin = min(fits, open_gripper, CUT_CAP_M)
        assert abs(margin - row["margin_stability_m"]) < 2e-5
    assert judged >= 2
