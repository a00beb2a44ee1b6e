"""Slow, independent twins in float64: MuJoCo C for clearances, NumPy (convex_twin.py) for convex bodies and exact meshes.

Nothing here uses the project's kernels, scene tables, bounds or levers; only the numbers of robot.json, the posed hand
vertices and the objects' points are shared.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import torch
from convex_twin import bodies, convex_distance, core_of, mesh_distance, penetration_depth, primitive_distance
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from r2h_batch.config import HOME_Q
from r2h_batch.judge.ik import ur_parameters
from r2h_batch.scene.robot import Robot, ShapeKind, ee_pose, gripper_primitives_at
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.scene.scene import BodyPoses, Scene

Array = NDArray[np.float64]

CLASSES = ("hand", "table", "self", "object_hand", "object_table", "object_robot")
"""Names of r2h_batch.types.CollidingPair 1..6, lower case, in that order."""

FAR_M = 10.0


@dataclass(frozen=True)
class Staged:
    """One trial's bodies, float64: which object and hand, how it is held (after closing moved it), where the hand stands."""

    object_index: int
    hand_index: int
    T_obj_ee: Array
    T_world_hand: Array
    opening_m: float


@dataclass(frozen=True)
class Clearances:
    """Smallest distance of each class (m, FAR_M without pairs below the cap) and the geoms that have it."""

    distance: dict[str, float]
    geoms: dict[str, tuple[str, str]]

    @property
    def least(self) -> float:
        return min(self.distance.values())

    @property
    def nearest_class(self) -> str:
        return min(self.distance, key=lambda k: self.distance[k])


def head_of(receiver: Array) -> tuple[Array, Array, float]:
    """Lower and upper end and radius of the head's capsule (`scene.person.heads_of`), m."""
    upper = float(np.linalg.norm(receiver[1, :3] - receiver[0, :3]))
    facing = np.array([receiver[3, 3], receiver[4, 3], 0.0])
    top = receiver[3, :3] + [0.0, 0.0, receiver[4, 2]]
    low = top + (0.032 + 0.079 * upper) * facing + [0.0, 0.0, 0.130 + 0.131 * upper]
    high = top + (0.017 + 0.057 * upper) * facing + [0.0, 0.0, 0.127 + 0.331 * upper]
    return low, high, 0.069 + 0.113 * upper


class MujocoScene:
    """A MuJoCo C model of one trial with the pairs that planning checks.

    A `receiver` (5, 4), as in `Trials.receiver`, stands there with arm, torso and head, and counts as the hand does; `person`
    names their geoms. The head is as large as robot and object keep off it.
    """

    def __init__(
        self, scene: Scene, staged: Staged, *, object_collision: str = "hull", receiver: Array | None = None
    ) -> None:
        self.robot, self.staged = scene.robot, staged
        spec = mujoco.MjSpec()
        spec.option.ccd_iterations = 500
        spec.option.ccd_tolerance = 1e-9
        self.groups: dict[str, list[str]] = {name: [] for name in (*self.robot.links, "hand", "object", "table")}
        wrist = self._add_arm(spec)
        self._add_gripper(wrist)
        T_wrist_obj = self.robot.T_wrist3_flange @ self.robot.T_flange_ee @ np.linalg.inv(staged.T_obj_ee)
        hulls = self.object_hulls(scene, object_collision)
        self._add_hulls(spec, wrist.add_body(name="object", **_pose(T_wrist_obj)), "object", hulls)
        pieces = self.hand_hulls(scene)
        self._add_hulls(spec, spec.worldbody.add_body(name="hand", **_pose(staged.T_world_hand)), "hand", pieces)
        self.head_clearance_m = scene.benchmark.head_clearance_m
        self.person = [] if receiver is None else self._add_person(spec, receiver)
        self.groups["hand"] += self.person
        self.groups["table"].append("table")
        place = scene.config.workplace
        spec.worldbody.add_geom(
            name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=place.table_half, pos=place.table_center, **_PASSIVE
        )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.names = [self.model.geom(i).name for i in range(self.model.ngeom)]
        self.pairs, self.pair_class = self._pairs()

    def object_hulls(self, scene: Scene, object_collision: str) -> list[Any]:
        """Points of each convex body of the object, object frame."""
        model = scene.objects[self.staged.object_index]
        return [model.hull_vertices] if object_collision == "hull" else [v for v, _ in model.pieces]

    def hand_hulls(self, scene: Scene) -> list[Any]:
        """Points of each convex piece of the hand, hand frame."""
        return [scene.hands.piece_points(self.staged.hand_index, k) for k in range(len(scene.hands.model.piece_names))]

    def gripper_places(self) -> Array:
        """T_ee_prim (N, 4, 4) of the gripper's primitives at the trial's opening."""
        return gripper_primitives_at(self.robot, self.staged.opening_m)

    def _add_arm(self, spec: mujoco.MjSpec) -> Any:
        robot, body = self.robot, spec.worldbody
        for k, link in enumerate(robot.links[:-1]):
            if k:
                body = body.add_body(name=link, **_pose(robot.T_parent_joint[k - 1]))
                body.add_joint(name=robot.joints[k - 1], type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
            body.explicitinertial, body.mass, body.inertia = True, 1.0, [1, 1, 1]
            for i in np.flatnonzero(robot.arm.link == k):
                if robot.arm.kind[i] == ShapeKind.HULL:
                    T = robot.arm.T_link_prim[i]
                    corners = robot.arm.corners[i] @ T[:3, :3].T + T[:3, 3]
                    self._add_hull(spec, body, link, robot.arm.names[i], corners)
                    continue
                self._add_primitive(
                    body, link, robot.arm.names[i], int(robot.arm.kind[i]), robot.arm.size[i], robot.arm.T_link_prim[i]
                )
        return body

    def _add_gripper(self, wrist: Any) -> None:
        g = self.robot.gripper
        T = self.robot.T_wrist3_flange @ self.robot.T_flange_ee @ self.gripper_places()
        for i, name in enumerate(g.names):
            self._add_primitive(wrist, "gripper", name, int(g.kind[i]), g.size[i], T[i])

    def _add_primitive(self, body: Any, group: str, name: str, kind: int, size: Array, T: Array) -> None:
        self.groups[group].append(name)
        body.add_geom(name=name, type=_TYPE_OF_KIND[ShapeKind(kind)], size=size, **_pose(T), **_PASSIVE)

    def _add_hulls(self, spec: mujoco.MjSpec, body: Any, group: str, hulls: list[Any]) -> None:
        body.explicitinertial, body.mass, body.inertia = True, 1.0, [1, 1, 1]
        for k, points in enumerate(hulls):
            self._add_hull(spec, body, group, f"{group}_{k}", points)

    def _add_hull(self, spec: mujoco.MjSpec, body: Any, group: str, name: str, points: Any) -> None:
        mesh = spec.add_mesh(name=name, uservert=np.asarray(points, np.float64)[ConvexHull(points).vertices].ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        self.groups[group].append(name)
        body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **_PASSIVE)

    def _add_person(self, spec: Any, receiver: Array) -> list[str]:
        shoulder, elbow, wrist, middle, half = receiver[:, :3]
        x, y = receiver[3, 3], receiver[4, 3]
        for name, a, b, radius in (
            ("forearm", elbow, wrist, receiver[1, 3]),
            ("upper_arm", shoulder, elbow, receiver[0, 3]),
        ):
            capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
            spec.worldbody.add_geom(name=name, type=capsule, fromto=[*a, *b], size=[radius, 0, 0], **_PASSIVE)
        T = np.eye(4)
        T[:3] = np.array([[x, -y, 0.0, middle[0]], [y, x, 0.0, middle[1]], [0.0, 0.0, 1.0, middle[2]]])
        spec.worldbody.add_geom(name="torso", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, **_pose(T), **_PASSIVE)
        low, high, radius = head_of(receiver)
        size = [radius + self.head_clearance_m, 0, 0]
        spec.worldbody.add_geom(name="head", type=capsule, fromto=[*low, *high], size=size, **_PASSIVE)
        return ["forearm", "upper_arm", "torso", "head"]

    def pairs_with_person(self) -> NDArray[np.int64]:
        """(n, 2) geoms: the robot's, and the receiver's arm, torso and head."""
        ids = [self.model.geom(n).id for link in self.robot.links for n in self.groups[link]]
        return np.array([(a, self.model.geom(n).id) for a in ids for n in self.person])

    def person_at(self, q: ArrayLike, *, cap: float = 0.05) -> float:
        """Distance of robot and the receiver's arm, torso and head at a posture, exact below `cap`; negative depths are rough."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        pairs = self.pairs_with_person()
        return self._least(pairs, cap)

    def head_at(self, q: ArrayLike, *, cap: float = 0.05) -> float:
        """The same of the head alone."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        pairs = self.pairs_with_person()
        return self._least(pairs[pairs[:, 1] == self.model.geom("head").id], cap)

    def _least(self, pairs: NDArray[np.int64], cap: float) -> float:
        near = pairs[self._lower_bounds(*pairs.T) < cap]
        return min((mujoco.mj_geomDistance(self.model, self.data, a, b, cap, None) for a, b in near), default=cap)

    def distance_to(self, name: str, x: ArrayLike) -> float:
        """Signed distance of a point of the world to a primitive where it is now."""
        g = self.model.geom(name).id
        local = (np.asarray(x, np.float64) - self.data.geom_xpos[g]) @ self.data.geom_xmat[g].reshape(3, 3)
        return float(primitive_distance(kind_of(self.model, g), self.model.geom_size[g], local))

    def _pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        robot, rows = self.robot, []
        ids = {g: [self.model.geom(n).id for n in names] for g, names in self.groups.items()}
        for link in robot.links:
            rows += [(a, b, 0) for a in ids[link] for b in ids["hand"]]
            if robot.links.index(link) >= robot.table_from:
                rows += [(a, b, 1) for a in ids[link] for b in ids["table"]]
        for i, j in robot.self_pairs:
            rows += [(a, b, 2) for a in ids[robot.links[i]] for b in ids[robot.links[j]]]
        rows += [(a, b, 3) for a in ids["object"] for b in ids["hand"]]
        rows += [(a, b, 4) for a in ids["object"] for b in ids["table"]]
        rows += [(a, b, 5) for a in ids["object"] for i in robot.object_pairs for b in ids[robot.links[i]]]
        table = np.array(rows)
        return table[:, :2], table[:, 2]

    @cached_property
    def reach(self) -> Array:
        """(J,) metres: no point of any body is ever farther than this from the joint's origin (chain length + extents)."""
        m, tail, joints = self.model, 0.0, len(self.robot.joints)
        ends = np.zeros(joints + 1)
        for k in range(joints + 1):
            body = 0 if k == 0 else m.body(self.robot.links[k]).id
            geoms = [i for i in range(m.ngeom) if m.geom_bodyid[i] == body and self.names[i] not in ("table",)]
            ends[k] = max((np.linalg.norm(m.geom_pos[i]) + m.geom_rbound[i] for i in geoms), default=0.0)
        held = m.body("object").id
        geoms = [i for i in range(m.ngeom) if m.geom_bodyid[i] == held]
        ends[-1] = max(
            ends[-1],
            np.linalg.norm(m.body_pos[held]) + max(np.linalg.norm(m.geom_pos[i]) + m.geom_rbound[i] for i in geoms),
        )
        out = np.zeros(joints)
        for j in range(
            joints - 1, -1, -1
        ):  # seen from joint j's origin: its own link, or the next joint's origin and what hangs there
            tail = max(
                ends[j + 1], (np.linalg.norm(self.robot.T_parent_joint[j + 1][:3, 3]) + tail) if j < joints - 1 else 0.0
            )
            out[j] = tail
        return out

    def motion(self, dq: ArrayLike) -> float:
        """No distance changes by more than this (m) when the joints turn by dq: it feels only the joints between."""
        return float(np.abs(np.asarray(dq, np.float64)) @ self.reach)

    def clearances(self, q: ArrayLike, *, cap: float = 0.05) -> Clearances:
        """Smallest distance of each class at posture q, exact below `cap` (else FAR_M); negative depths are rough."""
        m, d = self.model, self.data
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        a, b = self.pairs.T
        lower = self._lower_bounds(a, b)
        distance, geoms = dict.fromkeys(CLASSES, FAR_M), dict.fromkeys(CLASSES, ("", ""))
        for k, name in enumerate(CLASSES):
            mine = np.flatnonzero((self.pair_class == k) & (lower < cap))
            for i in mine[np.argsort(lower[mine])]:
                limit = min(distance[name], cap)
                if lower[i] >= limit:
                    break
                x = mujoco.mj_geomDistance(m, d, a[i], b[i], limit + 0.01, None)
                if x < limit:
                    distance[name], geoms[name] = x, (self.names[a[i]], self.names[b[i]])
        return Clearances(distance, geoms)

    def least(self, q: ArrayLike, *, cap: float = 0.05, margins: dict[str, float] | None = None) -> tuple[float, str]:
        """Smallest clearance less its class's margin at a posture, and the class; `cap` and "" where nothing is below."""
        m, d = self.model, self.data
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        a, b = self.pairs.T
        margin = np.array([(margins or {}).get(k, 0.0) for k in CLASSES])[self.pair_class]
        lower = self._lower_bounds(a, b) - margin
        mine = np.flatnonzero(lower < cap)
        best, name = cap, ""
        for i in mine[np.argsort(lower[mine])]:
            if lower[i] >= best:
                break
            x = mujoco.mj_geomDistance(m, d, a[i], b[i], best + margin[i] + 0.01, None) - margin[i]
            if x < best:
                best, name = x, CLASSES[self.pair_class[i]]
        return best, name

    def _lower_bounds(self, a: NDArray[np.int64], b: NDArray[np.int64]) -> Array:
        """Distance of bounding balls, or of one's ball to the other's exact shape where that is a primitive; never too large."""
        m, d = self.model, self.data
        x = d.geom_xpos[b] - d.geom_xpos[a]
        lower = np.linalg.norm(x, axis=1) - m.geom_rbound[a] - m.geom_rbound[b]
        for one, two, sign in ((a, b, 1.0), (b, a, -1.0)):
            local = np.einsum("nij,ni->nj", d.geom_xmat[one].reshape(-1, 3, 3), sign * x)
            for geom, kind in _KIND_OF_TYPE.items():
                rows = np.flatnonzero((m.geom_type[one] == geom) & (lower < 0.2))
                if len(rows):
                    size = [m.geom_size[one[rows], k] for k in range(3)]
                    exact = primitive_distance(kind, np.stack(size, -1) if kind == ShapeKind.BOX else size, local[rows])
                    lower[rows] = np.maximum(lower[rows], exact - m.geom_rbound[two[rows]])
        return lower - 1e-9

    def least_along(
        self, path: ArrayLike, *, step_rad: float = 1 / 320, cap: float = 0.05, margins: dict[str, float] | None = None
    ) -> tuple[float, str, Array]:
        """Smallest clearance (less the class's margin) over the samples of a polyline (W, 6), its class, its posture.

        FAR_M where nothing is below `cap`; the first overlap found ends the search.
        """
        names: dict[bytes, str] = {}

        def at(q: Array) -> float:
            distance, names[q.tobytes()] = self.least(q, cap=4 * cap, margins=margins)
            return distance

        best, q = self.least_sample(path, step_rad, cap, at)
        return (best, names[q.tobytes()], q) if best < cap else (FAR_M, "", q)

    def safe_along(
        self, scene: Scene, path: ArrayLike, *, step_rad: float = 1 / 320, cap: float = 0.05
    ) -> tuple[float, Array]:
        """Smallest distance of robot and exact hand mesh over a polyline's samples, its posture; `mesh_distance`'s values."""
        triangles = hand_triangles(scene, self.staged)
        return self.least_sample(path, step_rad, cap, lambda q: self.safe_at(triangles, q, cap=2 * cap), enough=0.0)

    def least_sample(
        self,
        path: ArrayLike,
        step_rad: float,
        cap: float,
        distance_at: Callable[[Array], float],
        *,
        enough: float = -1e-12,
    ) -> tuple[float, Array]:
        """The smallest distance over all samples of a polyline, at most `step_rad` (L2) apart, and its posture; `cap` at most.

        The sample that may be the nearest comes next, until none may be nearer than what is known: a distance known at one
        posture bounds that of every other, less `motion` between them. The value is that of looking at all of them; one
        that is at most `enough` (an overlap, where `mesh_distance` says 0) ends the search.
        """
        q = np.array(list(samples(path, step_rad)))
        lower = np.full(len(q), -np.inf)
        best, where = cap, q[0]
        while lower[i := int(np.argmin(lower))] <= best and lower[i] < np.inf:
            x = distance_at(q[i])
            lower = np.maximum(lower, x - np.abs(q - q[i]) @ self.reach)
            lower[i] = np.inf
            if x < best:
                best, where = x, q[i]
                if best <= enough:
                    break
        return best, where

    def safe_at(self, triangles: Array, q: ArrayLike, *, cap: float = 0.05) -> float:
        """`mesh_distance` of arm and gripper to the hand's triangles (world) at a posture."""
        m, d = self.model, self.data
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        low, high = triangles.min((0, 1)), triangles.max((0, 1))
        ids = np.array([m.geom(name).id for link in self.robot.links for name in self.groups[link]])
        apart = np.maximum(np.maximum(low - d.geom_xpos[ids], d.geom_xpos[ids] - high), 0.0)
        lower = np.linalg.norm(apart, axis=1) - m.geom_rbound[ids]
        best = cap
        for i in np.argsort(lower):
            if lower[i] >= best:
                break
            g, T = ids[i], np.eye(4)
            T[:3, :3], T[:3, 3] = d.geom_xmat[g].reshape(3, 3), d.geom_xpos[g]
            if m.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
                first, n = m.mesh_vertadr[m.geom_dataid[g]], m.mesh_vertnum[m.geom_dataid[g]]
                best = min(
                    best, hull_distance(m.mesh_vert[first : first + n] @ T[:3, :3].T + T[:3, 3], triangles, best)
                )
                continue
            kind = _KIND_OF_TYPE[int(m.geom_type[g])]
            best = min(best, mesh_distance(kind, m.geom_size[g], T, triangles, cap=max(best, 0.0)))
        return best


def hull_distance(corners: Array, triangles: Array, cap: float) -> float:
    """Distance of a hull (P, 3) to triangles (F, 3, 3), 0 where they meet; `cap` at most."""
    center = corners.mean(0)
    size = np.linalg.norm(corners - center, axis=1).max()
    near = triangles[
        np.linalg.norm(triangles - center, axis=2).min(1) - size < cap + 0.02
    ]  # faces are smaller than 2 cm
    if not len(near):
        return cap
    place, n = np.tile(np.eye(4), (len(near), 1, 1)), len(near)
    a, b = bodies([ShapeKind.HULL] * n, None, place, [corners] * n), bodies([ShapeKind.HULL] * n, None, place, near)
    return min(cap, max(float(convex_distance(a, b)[1].min()), 0.0))


def open_surface_distance(kind: int, size: Array, T: Array, triangles: Array, cap: float) -> float:
    """Distance of a primitive to triangles, 0 where they meet; `cap` at most. Inside counts nothing: the patch is open."""
    inverse = np.linalg.inv(T)
    local = triangles @ inverse[:3, :3].T + inverse[:3, 3]
    center = local.mean(1)
    lower = primitive_distance(ShapeKind(kind), size, center) - np.linalg.norm(local - center[:, None], axis=2).max(1)
    order, best = np.argsort(lower), cap
    for first in range(
        0, len(order), 16
    ):  # those that may be nearest first, until none may be nearer than what is known
        near = order[first : first + 16]
        near = near[lower[near] < best]
        n = len(near)
        if n == 0:
            break
        eye = np.tile(np.eye(4), (n, 1, 1))
        a, b = bodies([kind] * n, [size] * n, eye), bodies([ShapeKind.HULL] * n, None, eye, local[near])
        best = min(best, float(np.maximum(convex_distance(a, b)[1], 0.0).min()))
    return best


def out_of_reach(T: Array, robot: Robot | None = None) -> float:
    """How far (m) a target T_world_ee is from what a UR reaches: 2 x 40,000 samples of joint 1 and of psi3, hand as asked."""
    lengths = ur_parameters(robot or load_robot(), HOME_Q)
    ur = {k: float(getattr(lengths, k)) for k in ("d1", "a2", "a3", "d4", "d5", "tool")}
    z = T[:3, 2]
    p5 = T[:3, 3] - ur["tool"] * z
    v = z[2] if abs(z[2]) > 1e-9 else 1e-9
    h = np.hypot(z[0], z[1])
    psi = np.linspace(-np.pi, np.pi, 40_000)
    with np.errstate(divide="ignore"):
        theta = np.arccos(np.clip(v / (h + 1e-12) / np.tan(psi), -1, 1))
    q1 = np.arctan2(z[1], z[0]) + np.concatenate([psi, theta, -theta])
    x, y = np.cos(q1) * p5[0] + np.sin(q1) * p5[1], np.cos(q1) * p5[1] - np.sin(q1) * p5[0]
    forward = np.cos(q1) * z[0] + np.sin(q1) * z[1]
    least = np.inf
    for s5 in (np.hypot(forward, v), -np.hypot(forward, v)):
        d = np.hypot(x - ur["d5"] * v / s5, p5[2] - ur["d1"] + ur["d5"] * forward / s5)
        beyond = np.maximum(0, np.maximum(d - ur["a2"] - ur["a3"], abs(ur["a2"] - ur["a3"]) - d))
        least = min(least, np.hypot(y - ur["d4"], beyond).min())
    return least


def kind_of(model: mujoco.MjModel, geom: int) -> int:
    """The project's ShapeKind of a geom that is a primitive."""
    return int(_KIND_OF_TYPE[int(model.geom_type[geom])])


def geom_depth(model: mujoco.MjModel, data: mujoco.MjData, a: int, b: int) -> float:
    """Penetration depth (m) of two geoms where they are, by Qhull; a cylinder's counts as a prism around it, 0.2 % wider."""
    (x, grown), (y, more) = (_core(model, data, g) for g in (a, b))
    return penetration_depth(x, y, grown + more)


def _core(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[Array, float]:
    """Corners (n, 3) of a geom in the world, and the radius of the ball that they are grown by."""
    kind, points = ShapeKind.HULL, None
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        points = model.mesh_vert[first : first + count].astype(np.float64)
        points = points[ConvexHull(points).vertices]
    else:
        kind = ShapeKind(kind_of(model, geom))
    corners, _, grown = core_of(kind, model.geom_size[geom], points, sides=48)
    return corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom], grown


def deepest_along(
    model: mujoco.MjModel, data: mujoco.MjData, pairs: NDArray[np.int64], path: Array, *, step_rad: float = 0.02
) -> float:
    """The largest penetration depth (m) of some pair (n, 2) of geoms along a path (W, 6), searched for about the deepest sample.

    MuJoCo says which pairs and samples are deepest, `geom_depth` how deep. The largest may be missed: at least this deep.
    """
    a, b = pairs.T

    def put(s: float) -> None:
        i = min(int(s), len(path) - 2)
        data.qpos[: path.shape[1]] = path[i] + (s - i) * (path[i + 1] - path[i])
        mujoco.mj_kinematics(model, data)

    met: dict[int, tuple[float, float]] = {}
    steps = [max(int(np.ceil(np.abs(y - x).sum() / step_rad)), 1) for x, y in pairwise(path)]
    for s in (i + k / n for i, n in enumerate(steps) for k in range(n + 1)):
        put(s)
        x = np.linalg.norm(data.geom_xpos[b] - data.geom_xpos[a], axis=1)
        for i in map(int, np.flatnonzero(x < model.geom_rbound[a] + model.geom_rbound[b] + 1e-6)):
            found = mujoco.mj_geomDistance(model, data, a[i], b[i], 0.0, None)
            if found < min(0.0, met.get(i, (0.0, 0.0))[0]):
                met[i] = (found, s)
    deepest = 0.0
    for pair, (_, s) in sorted(met.items(), key=lambda x: x[1])[:3]:

        def depth(s: float, i: int = pair) -> float:
            put(float(np.clip(s, 0, len(path) - 1)))
            return geom_depth(model, data, int(a[i]), int(b[i]))

        here, step = depth(s), 0.5 / max(steps)
        while step > 1e-4:
            sides = [(depth(s + k * step), s + k * step) for k in (-1, 1)]
            if max(sides)[0] > here:
                here, s = max(sides)
            else:
                step /= 4
        deepest = max(deepest, here)
    return deepest


def mujoco_scene(scene: Scene, staged: Staged) -> MujocoScene:
    """The MuJoCo C twin of one trial."""
    return MujocoScene(scene, staged, object_collision=scene.config.plan.object_collision)


def hand_triangles(scene: Scene, staged: Staged) -> Array:
    """Triangles (F, 3, 3) of the exact hand mesh in the world, outward, float64."""
    v = scene.hands.vertices[staged.hand_index].numpy().astype(np.float64)
    faces = scene.hands.model.faces_by_side[int(scene.hands.set.side[staged.hand_index])].numpy()
    return (v @ staged.T_world_hand[:3, :3].T + staged.T_world_hand[:3, 3])[faces]


def samples(path: ArrayLike, step_rad: float) -> Iterator[Array]:
    """Postures along a polyline (W, 6), all waypoints among them, neighbours at most `step_rad` apart (L2), float64."""
    path = np.asarray(path, np.float64)
    yield path[0]
    for a, b in pairwise(path):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / step_rad)))
        for k in range(1, n + 1):
            yield a + (b - a) * (k / n)


def random_stages(scene: Scene, rng: np.random.Generator, n: int) -> tuple[list[Staged], Array]:
    """N trials with hands right and left in turn, near the robot's gripper at the returned postures (n, J).

    All numbers are exact in float32, so that kernels and twins see the same.
    """
    robot = scene.robot
    limits = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    stages, postures = [], np.zeros((n, len(robot.joints)))
    right = np.flatnonzero(scene.hands.set.side.numpy() == 0)
    left = np.flatnonzero(scene.hands.set.side.numpy() == 1)
    for k in range(n):
        while True:
            q = rng.uniform(*limits).astype(np.float32).astype(np.float64)
            p = ee_pose(scene.robot, q)[:3, 3]
            if 0.15 < p[2] < 0.8 and 0.3 < np.hypot(p[0], p[1]) < 0.9:
                break
        hand = int(rng.choice((right, left)[k % 2]))
        away = rng.normal(size=3)
        away *= rng.uniform(0.03, 0.22) / np.linalg.norm(away)
        T = _random_pose(rng, np.zeros(3))
        middle = scene.hands.vertices[hand].numpy().mean(0)
        T[:3, 3] = p + away - T[:3, :3] @ middle
        T_obj_ee = _random_pose(rng, rng.normal(size=3) * 0.03)
        stages.append(
            Staged(
                int(rng.integers(len(scene.objects))),
                hand,
                _single(T_obj_ee),
                _single(T),
                float(np.float32(rng.uniform(0.004, 0.085))),
            )
        )
        postures[k] = q
    return stages, postures


def place(scene: Scene, stages: Sequence[Staged]) -> BodyPoses:
    """The same trials for the kernels."""
    return scene.body_poses(
        torch.tensor([s.object_index for s in stages], dtype=torch.int32),
        torch.tensor([s.hand_index for s in stages], dtype=torch.int32),
        torch.tensor(np.array([s.T_obj_ee for s in stages]), dtype=torch.float32),
        torch.tensor(np.array([s.T_world_hand for s in stages]), dtype=torch.float32),
        torch.tensor([s.opening_m for s in stages], dtype=torch.float32),
    )


def _random_pose(rng: np.random.Generator, p: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), p
    return T


def _single(T: Array) -> Array:
    return T.astype(np.float32).astype(np.float64)


_TYPE_OF_KIND = {
    ShapeKind.SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE, ShapeKind.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    ShapeKind.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER, ShapeKind.BOX: mujoco.mjtGeom.mjGEOM_BOX,
}  # fmt: skip
_KIND_OF_TYPE = {int(t): k for k, t in _TYPE_OF_KIND.items()}
_PASSIVE = {"contype": 0, "conaffinity": 0}


def _pose(T: Array) -> dict[str, Any]:
    T = np.asarray(T, np.float64)
    return {"pos": T[:3, 3], "quat": Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)}
