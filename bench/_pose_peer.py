"""The pose stage as one writes it without this project: one candidate at a time, MuJoCo C, trimesh and FCL, closed-form IK.

Independent of r2h_batch's kernels: it reads robot, hand and object geometry only. Verdicts, not margins to the micrometre:
the width is found by slicing the mesh twice, cuts and distances by FCL on triangle meshes of the primitives.
"""

from typing import Any

import mujoco
import numpy as np
import trimesh
import ur_analytic_ik
from _twins import Checker, MujocoScene, Staged
from numpy.typing import NDArray
from trimesh.intersections import slice_faces_plane

from r2h_batch.bodies.robot import Kind, drive_from_gap, gripper_primitives_at, load_robot, pad_center_z
from r2h_batch.config import HOME_Q
from r2h_batch.scene.scene import Scene

Array = NDArray[np.float64]
OPEN_GAP_M, PAD_HALF_X, PAD_HALF_Z = 0.085, 0.011, 0.01875
CAP_M = 0.05


def primitive_mesh(kind: int, size: Array) -> trimesh.Trimesh:
    """A primitive as triangles, as FCL takes them."""
    if kind == Kind.BOX:
        return trimesh.creation.box(2 * size)
    if kind == Kind.CAPSULE:
        mesh = trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=(12, 12))
        mesh.apply_translation(-mesh.bounds.mean(0))
        return mesh
    if kind == Kind.CYLINDER:
        return trimesh.creation.cylinder(size[0], 2 * size[1], sections=24)
    return trimesh.creation.icosphere(2, size[0])


class PosePeer:
    """Judges candidates one by one. What stays the same over candidates (meshes, their search trees) is made once."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.robot = scene, load_robot()
        g = self.robot.gripper
        self.gripper = [primitive_mesh(int(k), s) for k, s in zip(g.kind, g.size, strict=True)]
        self.moving = [m != "fixed" for m in self.robot.gripper_motion]
        self.objects = [trimesh.Trimesh(o.vertices, o.faces, process=False) for o in scene.objects]
        self.regions = [
            trimesh.Trimesh(o.vertices, o.faces[o.receiver_face], process=False) if o.receiver_face.any() else None
            for o in scene.objects
        ]
        self.hands: dict[int, Any] = {}
        self.shapes: dict[tuple, trimesh.Trimesh] = {}
        self.open_fingers = self.fingers(OPEN_GAP_M, False)
        self.z_ee_gripper = float((np.linalg.inv(self.robot.T_flange_ee) @ self.robot.T_flange_gripper)[2, 3])

    def width(self, o: int, T_obj_ee: Array) -> tuple[float, float, float]:
        """Width of what lies between the pads, opening, shift: the mesh sliced at the pads' height, twice."""
        found = self._slab(o, T_obj_ee, OPEN_GAP_M) or self._slab(o, T_obj_ee, 0.0)  # the tip may be met late
        if found is not None:  # once more at the height that the pads have then
            found = self._slab(o, T_obj_ee, min(found[1] - found[0], OPEN_GAP_M)) or found
        if found is None:
            return np.nan, OPEN_GAP_M, 0.0
        width = found[1] - found[0]
        return (width, width, sum(found) / 2) if width <= OPEN_GAP_M else (width, OPEN_GAP_M, 0.0)

    def _slab(self, o: int, T_obj_ee: Array, gap: float) -> tuple[float, float] | None:
        """Range of y of the pieces that reach between open pads, in a slice of the mesh at the pads' height for a gap."""
        z = float(pad_center_z(load_robot(), drive_from_gap(load_robot(), gap))) + self.z_ee_gripper
        vertices = trimesh.transform_points(self.objects[o].vertices, np.linalg.inv(T_obj_ee))
        faces = self.objects[o].faces
        for axis, at, half in ((0, 0.0, PAD_HALF_X), (2, z, PAD_HALF_Z)):
            for sign in (1.0, -1.0):
                normal, origin = np.zeros(3), np.zeros(3)
                normal[axis], origin[axis] = sign, at - sign * half
                vertices, faces, _ = slice_faces_plane(vertices, faces, normal, origin)
                if not len(faces):
                    return None
        across = vertices[faces][:, :, 1]
        runs: list[list[float]] = []
        for low, high in sorted(zip(across.min(1), across.max(1), strict=True)):
            if runs and (low <= runs[-1][1] + 1e-6 or self._inside(o, T_obj_ee, (low + runs[-1][1]) / 2, z)):
                runs[-1][1] = max(runs[-1][1], high)
            else:
                runs.append([low, high])
        between = [r for r in runs if r[1] > -OPEN_GAP_M / 2 and r[0] < OPEN_GAP_M / 2]
        return (between[0][0], between[-1][1]) if between else None

    def _inside(self, o: int, T_obj_ee: Array, y: float, z: float) -> bool:
        return bool(self.objects[o].contains(trimesh.transform_points([[0.0, y, z]], T_obj_ee))[0])

    def fingers(self, gap: float, only_moving: bool) -> trimesh.collision.CollisionManager:
        """The gripper's primitives in the ee frame, for FCL."""
        manager, T = trimesh.collision.CollisionManager(), gripper_primitives_at(self.robot, gap)
        for i, mesh in enumerate(self.gripper):
            if self.moving[i] or not only_moving:
                manager.add_object(str(i), mesh, T[i])
        return manager

    def build(self, o: int, hand: int, T_obj_ee: Array, T_world_hand: Array) -> Any:
        """The MuJoCo model of one candidate: what a loop that edits one model would not need. Not to be timed."""
        _, gap, shift = self.width(o, T_obj_ee)
        attached = T_obj_ee.copy()
        attached[:3, 3] += attached[:3, 1] * shift
        return Checker(MujocoScene(self.scene, Staged(o, hand, attached, T_world_hand, gap)))

    def judge(
        self, checker: Any, o: int, hand: int, T_obj_ee: Array, T_world_ee: Array, T_world_hand: Array, ball: Array
    ) -> list[bool | None]:
        """Stability, Plan (a free branch), Reach, Affordance, Safe; None where not evaluated."""
        width, gap, shift = self.width(o, T_obj_ee)
        cut = self.open_fingers.in_collision_single(self.objects[o], np.linalg.inv(T_obj_ee))
        stable = bool(width <= OPEN_GAP_M) and not cut
        attached = T_obj_ee.copy()
        attached[:3, 3] += attached[:3, 1] * shift

        region, kept = self.regions[o], None
        if region is not None:
            near = self.fingers(max(gap - 1e-3, 0.0), True)
            kept = near.min_distance_single(region, np.linalg.inv(attached)) > 0

        T_world_obj = T_world_ee @ np.linalg.inv(attached)
        x = np.linalg.inv(T_world_obj) @ np.r_[ball, 1.0]
        _, distance, _ = trimesh.proximity.closest_point(self.objects[o], x[None, :3])
        reached = bool(distance[0] <= 0.1) or bool(self.objects[o].contains(x[None, :3])[0])

        robot = self.robot
        z, y = T_world_ee[:3, 2] / np.linalg.norm(T_world_ee[:3, 2]), T_world_ee[:3, 1]
        y = y - (y @ z) * z
        y = y / np.linalg.norm(y)
        T_world_ee = T_world_ee.copy()
        T_world_ee[:3, :3] = np.stack([np.cross(y, z), y, z], 1)  # the solver refuses axes that are not exact
        target = T_world_ee @ np.linalg.inv(robot.T_flange_ee)
        target = np.diag([-1.0, -1.0, 1.0, 1.0]) @ target  # base_link is the controller's base turned by pi
        branches = np.array(ur_analytic_ik.ur5e.inverse_kinematics(np.ascontiguousarray(target))).reshape(-1, 6)
        home = np.array(HOME_Q)
        branches = branches - 2 * np.pi * np.round((branches - home) / (2 * np.pi))
        free, posture = False, None
        if checker.valid(home):
            for q in branches[np.argsort(((branches - home) ** 2).sum(1))]:
                if checker.valid(q):
                    free, posture = True, q
                    break
        elif len(branches):
            posture = branches[0]
        if posture is None and len(branches):
            posture = branches[0]

        safe = None
        if posture is not None:
            checker.twin.least(posture, cap=CAP_M)  # the clearance that Plan's margin is
            safe = self._hand_distance(checker, hand, posture, T_world_hand) > 0
        return [stable, free, reached, kept, safe]

    def _hand_distance(self, checker: Any, hand: int, q: Array, T_world_hand: Array) -> float:
        """FCL's distance of the exact hand mesh to arm and gripper at a posture (0: they meet)."""
        data, model, twin = checker.data, checker.model, checker.twin
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        if hand not in self.hands:
            hands, manager = self.scene.hands, trimesh.collision.CollisionManager()
            faces = hands.model.faces_by_side[int(hands.set.side[hand])].numpy()
            mesh = trimesh.Trimesh(hands.vertices[hand].numpy(), faces, process=False)
            manager.add_object("hand", mesh)
            self.hands[hand] = mesh, manager
        mesh, manager = self.hands[hand]
        manager.set_transform("hand", T_world_hand)
        best = CAP_M
        center = T_world_hand[:3, :3] @ mesh.bounds.mean(0) + T_world_hand[:3, 3]
        radius = np.linalg.norm(mesh.extents) / 2
        kinds = {mujoco.mjtGeom.mjGEOM_BOX: Kind.BOX, mujoco.mjtGeom.mjGEOM_CAPSULE: Kind.CAPSULE}
        for link in self.robot.links:
            for name in twin.groups[link]:
                i = model.geom(name).id
                if np.linalg.norm(data.geom_xpos[i] - center) - radius - model.geom_rbound[i] >= best:
                    continue
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = data.geom_xmat[i].reshape(3, 3), data.geom_xpos[i]
                kind = kinds.get(mujoco.mjtGeom(int(model.geom_type[i])), Kind.CYLINDER)
                key = (kind, *model.geom_size[i])
                if key not in self.shapes:
                    self.shapes[key] = primitive_mesh(kind, model.geom_size[i])
                best = min(best, manager.min_distance_single(self.shapes[key], T))
        return best
