"""A second judge of stored rows, in float64: MuJoCo C, manifold3d, trimesh, Qhull and NumPy.

Shared with the project are what a row is about (trials, meshes, posed hands, the thresholds) and the numbers of the robot's
file. How fingers close, what they hold, how the object moves between them, hulls, kinematics, times, verdicts and outcomes
are this file's own.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import manifold3d
import mujoco
import numpy as np
import oracle
import trimesh
import ur_analytic_ik
from convex_twin import bodies, convex_distance, core_of, penetration_depth, winding_number
from numpy.typing import NDArray
from oracle import CLASSES, MujocoScene, Staged
from scipy.optimize import brentq, least_squares
from scipy.spatial import ConvexHull

from r2h_batch.config import CLEARANCE_CAP_M, EvalConfig
from r2h_batch.judge.grasp import CUT_CAP_M
from r2h_batch.scene.robot import Robot, ShapeKind
from r2h_batch.scene.scene import Scene
from r2h_batch.verdicts import CRITERIA, PAPER

Array = NDArray[np.float64]
TOLERANCE_M = 1e-4
STEP_RAD = 1 / 160
GRAZE_M = 1e-5
SCAN_M = 5e-4
"""Steps in which the pads are closed."""
LIFT_M = 0.1
END_M, END_RAD, TIME_S = 2e-5, 1e-4, 2e-3


def rigid(T: Any) -> Array:
    """A pose (16 or 4 x 4 numbers) with orthonormal axes, float64: z is kept, y turned to it."""
    T = np.asarray(T, np.float64).reshape(4, 4).copy()
    z = T[:3, 2] / np.linalg.norm(T[:3, 2])
    y = T[:3, 1] - (T[:3, 1] @ z) * z
    y /= np.linalg.norm(y)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], 1)
    return T


def turn_about_x(angle: float, about: complex, shift: complex) -> Array:
    """(4, 4) of a turn about an axis along x through the point y + iz, then a shift."""
    T, at = np.eye(4), about + shift - about * np.exp(1j * angle)
    T[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[1:3, 3] = at.real, at.imag
    return T


class Fingers:
    """Where the gripper's bodies stand, in ee, at a gap between the pads.

    A finger moves in the plane y + iz. The four-bar linkage carries the pin by v (exp(iq) - 1), turns the driver about its
    pivot and the knuckle about its own. The drive q is the one at which the pads' inner faces are the gap apart.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot, self.link = robot, robot.linkage
        self.to_ee = np.linalg.inv(robot.T_flange_ee) @ robot.T_flange_gripper
        self.pads = [i for i, part in enumerate(robot.gripper_part) if part == "pad"]
        self.opened, self.closed = robot.open_gap_m, robot.closed_gap_m

    def places(self, gap: float) -> Array:
        """(N, 4, 4) poses of all bodies in ee."""
        if self.link.table is not None:
            return self._at(lambda i, side: self._by_table(i, side, gap))
        low, high = self.link.drive_lower, self.link.drive_upper
        excess = lambda q: self._gap(self._by_bars(q)) - gap  # noqa: E731
        if excess(low) <= 0 or excess(high) >= 0:
            return self._by_bars(low if excess(low) <= 0 else high)
        return self._by_bars(float(brentq(excess, low, high, xtol=1e-14)))

    def _gap(self, placed: Array) -> float:
        """Distance of the pads' inner faces."""
        y = sorted(placed[i, 1, 3] for i in self.pads)
        half = self.robot.gripper.size[self.pads[0], 1]
        return float(y[1] - y[0] - 2 * half)

    def _at(self, moved: Callable[[int, int], Array]) -> Array:
        bodies = self.robot.gripper.T_link_prim
        return np.array([moved(i, int(side)) @ bodies[i] for i, side in enumerate(self.robot.gripper_side)])

    def _by_bars(self, q: float) -> Array:
        link, motion = self.link, self.robot.gripper_motion
        driver, knuckle = complex(*link.driver_pivot_yz), complex(*link.inner_knuckle_pivot_yz)
        pin = complex(*link.pin_from_driver_yz)

        def moved(i: int, side: int) -> Array:
            if motion[i] == "fixed":
                return self.to_ee
            how = {
                "driver": (q, driver, 0j),
                "inner_knuckle": (q, knuckle, 0j),
                "pin": (0.0, 0j, pin * (np.exp(1j * q) - 1)),
            }[motion[i]]
            T = turn_about_x(*how)
            mirror = np.diag([1.0, side, 1.0, 1.0])
            return self.to_ee @ mirror @ T @ mirror

        return self._at(moved)

    def _by_table(self, i: int, side: int, gap: float) -> Array:
        motion, table = self.robot.gripper_motion[i], self.link.table
        assert table is not None
        if motion == "fixed":
            return self.to_ee
        share = np.clip((gap - self.closed) / (self.opened - self.closed), 0.0, 1.0) * (table.shape[1] - 1)
        k = min(int(share), table.shape[1] - 2)
        y, z, turn = table[int(motion[6:]), k] + (share - k) * np.diff(table[int(motion[6:])], axis=0)[k]
        mirror = np.diag([1.0, side, 1.0, 1.0])
        return mirror @ turn_about_x(turn, 0j, complex(y, z)) @ mirror @ self.to_ee


@dataclass(frozen=True)
class Closed:
    """Result of closing: width (m; None: nothing), gap at which they stop, and how far the middle of it lies off."""

    width: float | None
    opening: float
    shift: float


class Closing:
    """Pads that close on a mesh from the open gap on, until the material between them is as wide as they stand apart."""

    def __init__(self, fingers: Fingers, mesh: trimesh.Trimesh, T_obj_ee: Array, *, whole: bool) -> None:
        self.fingers, self.whole = fingers, whole
        self.points = trimesh.transform_points(mesh.vertices, np.linalg.inv(T_obj_ee))
        self.pad_x, _, self.pad_z = fingers.robot.gripper.size[fingers.pads[0]]
        heights = [
            fingers.places(gap)[fingers.pads[0], 2, 3] for gap in np.linspace(fingers.closed, fingers.opened, 60)
        ]
        room = 2 * np.array([self.pad_x + 1e-3, 1.0, self.pad_z + np.ptp(heights) / 2 + 1e-3])
        swept = manifold3d.Manifold.cube(tuple(room), True).translate((0.0, 0.0, (max(heights) + min(heights)) / 2))
        whole_solid = manifold3d.Manifold(manifold3d.Mesh64(self.points, mesh.faces.astype(np.uint64)))
        self.solid = whole_solid ^ swept  # all that the pads may meet
        sides = self.solid.bounding_box()
        self.most = float(sides[4] - sides[1]) if not self.solid.is_empty() else 0.0

    def material(self, gap: float, grow: float) -> tuple[float, float] | None:
        """From where to where (m, along y) connected material reaches that enters the open gap; None: nowhere."""
        z = self.fingers.places(gap)[self.fingers.pads[0], 2, 3]
        prism = manifold3d.Manifold.cube((2 * (self.pad_x + grow), 2.0, 2 * (self.pad_z + grow)), True)
        pieces = (self.solid ^ prism.translate((0.0, 0.0, z))).decompose()
        runs: list[list[float]] = []
        for low, high in sorted((p.bounding_box()[1], p.bounding_box()[4]) for p in pieces):
            if runs and low <= runs[-1][1]:
                runs[-1][1] = max(runs[-1][1], high)
            else:
                runs.append([low, high])
        inside = [r for r in runs if r[0] < self.fingers.opened / 2 and r[1] > -self.fingers.opened / 2]
        return (inside[0][0], inside[-1][1]) if inside else None

    def closed(self, grow: float = 0.0) -> Closed:
        """Where the pads stop; `grow`: pads larger by so much, which tells where they graze."""
        opened, least = self.fingers.opened, self.fingers.closed

        def filled(gap: float) -> bool:
            held = self.material(gap, grow)
            return held is not None and held[1] - held[0] >= gap

        stop, above = least, opened
        for gap in np.linspace(opened, least, int((opened - least) / SCAN_M) + 2):
            if gap <= self.most + SCAN_M and filled(gap):
                stop = gap
                break
            above = gap
        for _ in range(14 if above > stop and filled(stop) else 0):
            middle = (stop + above) / 2
            stop, above = (middle, above) if filled(middle) else (stop, middle)
        held = self.material(stop, grow)
        if held is None:
            return Closed(None, opened, 0.0)
        width = held[1] - held[0]
        if self.whole:
            width = max(width, float(np.ptp(self.points[:, 1])))
        if width > opened:
            return Closed(width, opened, 0.0)
        return Closed(width, stop, (held[0] + held[1]) / 2)


def deepest_point(kind: int, size: Array, T: Array, triangles: Array) -> float:
    """How deep (m) some point of the triangles lies in a primitive, 0 outside: parting them takes at least that.

    Depth is concave on a triangle and changes by no more than the way: triangles come in the order of what they may have.
    """
    inverse = np.linalg.inv(T)
    local = triangles @ inverse[:3, :3].T + inverse[:3, 3]
    return _deepest(local, lambda x: np.asarray(oracle.primitive_distance(kind, size, x)))


def deepest_in_hull(corners: Array, triangles: Array) -> float:
    """The same of a hull (P, 3)."""
    faces = ConvexHull(corners).equations
    return _deepest(triangles, lambda x: (x @ faces[:, :3].T + faces[:, 3]).max(-1))


def _deepest(triangles: Array, distance: Callable[[Array], Array]) -> float:
    center = triangles.mean(1)
    most = np.linalg.norm(triangles - center[:, None], axis=2).max(1) - distance(center)
    grid = np.array([[a, b, 4 - a - b] for a in range(5) for b in range(5 - a)]) / 4
    best = 0.0
    for face in np.argsort(-most):
        if most[face] <= best + 1e-6:
            break
        weights = grid
        for k in range(1, 14):
            depth = -distance(weights @ triangles[face])
            best = max(best, float(depth.max()))
            weights = np.maximum(weights[depth.argmax()] + 0.6**k * (grid - 1 / 3), 0.0)
            weights /= weights.sum(1, keepdims=True)
    return best


class World(MujocoScene):
    """The bodies of a trial with this file's fingers, and hulls that Qhull makes of the meshes."""

    def __init__(self, scene: Scene, staged: Staged, **more: Any) -> None:
        self.fingers = Fingers(scene.robot)
        super().__init__(scene, staged, **more)

    def gripper_places(self) -> Array:
        return self.fingers.places(self.staged.opening_m)

    def object_hulls(self, scene: Scene, object_collision: str) -> list[Any]:
        model = scene.objects[self.staged.object_index]
        return [model.vertices] if object_collision == "hull" else [v for v, _ in model.pieces]

    def hand_hulls(self, scene: Scene) -> list[Any]:
        skin = scene.hands.vertices[self.staged.hand_index].numpy()
        return [skin[ids.numpy()] for ids in scene.hands.model.pieces]

    def ee(self, q: Array) -> Array:
        """T_world_ee (4, 4): the chain of the robot's file, by MuJoCo."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        wrist, T = self.model.body(self.robot.links[-2]).id, np.eye(4)
        T[:3, :3], T[:3, 3] = self.data.xmat[wrist].reshape(3, 3), self.data.xpos[wrist]
        return np.asarray(T @ self.robot.T_wrist3_flange @ self.robot.T_flange_ee)

    def primitives(self, names: Sequence[str]) -> tuple[list[int], list[Array], Array, list[Array]]:
        """Kinds, sizes and T_world of the primitives among some geoms where they are, and the corners of the hulls."""
        kinds, sizes, places, hulls = [], [], [], []
        m, d = self.model, self.data
        for name in names:
            g, T = m.geom(name).id, np.eye(4)
            T[:3, :3], T[:3, 3] = d.geom_xmat[g].reshape(3, 3), d.geom_xpos[g]
            if m.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
                first, n = m.mesh_vertadr[m.geom_dataid[g]], m.mesh_vertnum[m.geom_dataid[g]]
                hulls.append(m.mesh_vert[first : first + n].astype(np.float64) @ T[:3, :3].T + T[:3, 3])
            else:
                kinds.append(oracle.kind_of(m, g))
                sizes.append(m.geom_size[g].copy())
                places.append(T)
        return kinds, sizes, np.array(places).reshape(-1, 4, 4), hulls


def trapezoid_s(way: float, speed: float, acceleration: float) -> float:
    """Time (s) for a way from rest to rest."""
    if way * acceleration <= speed**2:
        return float(2 * np.sqrt(way / acceleration))
    return way / speed + speed / acceleration


@dataclass(frozen=True)
class Finding:
    """A statement of a row beside what was found; lengths in m. `kind`: distance, bound or cap as rows say, or fact: `wrong`
    where it is not so. `true` below 0: an overlap by at least that."""

    name: str
    says: Any
    true: Any
    kind: str
    wrong: bool = False

    @property
    def holds(self) -> bool:
        """A fact that is so; a distance to 0.1 mm, a bound no larger than the overlap, a cap no larger than the clearance."""
        if self.kind == "fact":
            return not self.wrong
        off = self.says - self.true
        opposite = (
            (self.says >= 0) != (self.true >= 0) and abs(self.true) > TOLERANCE_M and bool(np.isfinite(self.says))
        )
        beyond = {"bound": -off, "cap": off}.get(self.kind, abs(off)) if np.isfinite(self.says) else 0.0
        return not opposite and bool(beyond <= TOLERANCE_M)


class Again:
    """One row of a run, judged by this file: each criterion's method gives a clearance (m), below 0 an overlap by at least so
    much; `findings` sets all of them beside what the row says.

    Args:
        scene: the trial's bodies.
        config: definitions and thresholds, home and table of the robot among them.
        trials: the one trial.
        row: columns of the run's files: trials, details and paths, in one.
        T_obj_ee, T_world_ee: the poses that the robot carries out.
        T_seen_hand: the hand that the planner saw; None: the true one.
        T_world_rest: where the object rests before it is picked; None: the gripper holds it from home on.
    """

    def __init__(
        self, scene: Scene, config: EvalConfig, trials: Any, row: Mapping[str, Any], T_obj_ee: Any, T_world_ee: Any,
        T_seen_hand: Any = None, T_world_rest: Any = None,
    ) -> None:  # fmt: skip
        self.T_rest = None if T_world_rest is None else rigid(T_world_rest)
        self.scene, self.config, self.trials, self.row = scene, config, trials, row
        self.robot, self.fingers = scene.robot, Fingers(scene.robot)
        at = int(trials.object_index[0]), int(trials.hand_index[0])
        self.model = scene.objects[at[0]]
        self.mesh = trimesh.Trimesh(self.model.vertices.astype(np.float64), self.model.faces, process=False)
        self.T_obj_ee, self.T_world_ee = rigid(T_obj_ee), rigid(T_world_ee)
        self.T_hand = rigid(trials.T_world_hand[0])
        self.closed = self._closed()
        self.attached = self.T_obj_ee.copy()
        self.attached[:3, 3] += self.closed.shift * self.T_obj_ee[:3, 1]
        self.receiver = None if trials.receiver is None else trials.receiver[0].double().numpy()
        body = self.receiver if config.receiver == "body" else None
        how = {"object_collision": config.plan.object_collision}
        staged = Staged(*at, self.attached, self.T_hand, self.closed.opening)
        self.true = World(scene, staged, receiver=self.receiver, **how)
        seen = self.T_hand if T_seen_hand is None else rigid(T_seen_hand)
        self.seen = World(scene, Staged(*at, self.attached, seen, self.closed.opening), receiver=body, **how)
        self.q = np.array(row.get("q") or np.zeros((0, len(self.robot.joints))), np.float64)  # (W, J); 0: no path
        self.hand = oracle.hand_triangles(scene, self.true.staged)

    def _closed(self) -> Closed:
        """Where the pads stop: by this file; where they graze material, the row's own if it lies between both answers."""
        closing = Closing(self.fingers, self.mesh, self.T_obj_ee, whole=self.config.width == "whole")
        both = [closing.closed(grow) for grow in (-GRAZE_M, 0.0, GRAZE_M)]
        self.between = both
        widths = [c.width for c in both if c.width is not None]
        if len(widths) < len(both) or self.row["width_m"] is None:
            same = [c for c in both if (c.width is None) == (self.row["width_m"] is None)]
            return same[-1] if same else both[1]
        width, opening, shift = (
            float(np.clip(self.row[name], min(values), max(values)))
            for name, values in (
                ("width_m", widths),
                ("opening_m", [c.opening for c in both]),
                ("grasp_shift_m", [c.shift for c in both]),
            )
        )
        return Closed(width, opening, shift)

    def findings(self, criteria: Sequence[str] = PAPER) -> Iterator[Finding]:
        """Statements of the row beside what is so; of the criteria some alone. Further criteria have no twin."""
        yield from self._grip()
        if len(self.q):
            yield from self._motion()
        passed: dict[str, bool] = {}
        picks = self.T_rest is not None
        for name in (PAPER[0], *(["pick"] if picks else []), *PAPER[1:]):
            if name == "pick":  # pick_twin.py judges it
                passed[name] = self.row["passed_pick"]
                continue
            said = self.row[f"passed_{name}"]
            asked = self._asked(name)
            if asked != (said is not None):
                yield Finding(f"{name} is asked", said is not None, asked, "fact", wrong=True)
            if said is None:
                continue
            passed[name] = said
            if name not in criteria:
                continue
            true, margin = getattr(self, name)(), self.row[f"margin_{name}_m"]
            yield Finding(name, margin, true, self.row[f"margin_kind_{name}"])
            fine = self._passes(name, true)
            yield Finding(f"{name} passes", said, fine, "fact", wrong=said != fine and abs(true) > TOLERANCE_M)
        if (body := self.row["body_m"]) is not None and "safe" in criteria:
            kind = "bound" if body < 0 else "distance" if body < CLEARANCE_CAP_M else "cap"
            yield Finding("body_m", body, self.body_m(), kind)
        first = next((name for name, fine in passed.items() if not fine), "success")
        outcome = "success" if self.row["outcome"] in CRITERIA[len(PAPER) :] else self.row["outcome"]
        yield Finding("outcome", outcome, first, "fact", wrong=outcome != first)

    def _asked(self, name: str) -> bool:
        """Affordance is asked where the object has a region's split, Safe where the arm moves."""
        if name == "affordance":
            return bool(self.row["split"] == "S1")
        if name == "plan" and self.T_rest is not None:  # what is not picked is not carried
            return bool(self.row["passed_pick"])
        return name != "safe" or len(self.q) > 0

    def _passes(self, name: str, clearance: float) -> bool:
        if name == "plan" and len(self.q) and self.config.plan.edge_check == "moveit":
            return True  # sampled paths pass whatever lies between two samples
        return clearance > 0 if name in ("safe", "affordance") else clearance >= 0

    def _grip(self) -> Iterator[Finding]:
        empty = [c.width is None for c in self.between]
        said = self.row["width_m"] is None
        yield Finding("nothing is held", said, empty[1], "fact", wrong=said not in empty)
        for name, mine in (("width_m", self.closed.width), ("opening_m", self.closed.opening)):
            if mine is not None and self.row[name] is not None:
                yield Finding(name, self.row[name], mine, "fact", wrong=abs(self.row[name] - mine) > TOLERANCE_M / 2)
        shift = self.row["grasp_shift_m"]
        wrong = abs(shift - self.closed.shift) > TOLERANCE_M / 2
        yield Finding("grasp_shift_m", shift, self.closed.shift, "fact", wrong=wrong)

    def _motion(self) -> Iterator[Finding]:
        """Where the path begins and ends, whether joints keep their limits, and how long it takes."""
        if self.T_rest is None:
            off = float(np.abs(self.q[0] - np.array(self.config.workplace.home_q)).max())
            yield Finding("start beside home, rad", 0.0, off, "fact", wrong=off > 1e-5)
        else:
            lifted = self.T_rest @ self.T_obj_ee
            lifted[2, 3] += LIFT_M
            T = np.linalg.inv(lifted) @ self.true.ee(self.q[0])
            way, turn = float(np.linalg.norm(T[:3, 3])), float(np.abs(T[:3, :3] - np.eye(3)).max())
            yield Finding("start beside the lifted grasp, m", 0.0, way, "fact", wrong=way > END_M)
            yield Finding("start beside the lifted grasp, rad", 0.0, turn, "fact", wrong=turn > END_RAD)
        T = np.linalg.inv(self.T_world_ee) @ self.true.ee(self.q[-1])
        way, turn = float(np.linalg.norm(T[:3, 3])), float(np.abs(T[:3, :3] - np.eye(3)).max())
        yield Finding("end beside the handover pose, m", 0.0, way, "fact", wrong=way > END_M)
        yield Finding("end beside the handover pose, rad", 0.0, turn, "fact", wrong=turn > END_RAD)
        beyond = float(np.maximum(self.q - self.robot.upper, self.robot.lower - self.q).max())
        yield Finding("beyond limits, rad", 0.0, max(beyond, 0.0), "fact", wrong=beyond > 1e-6)
        law, fastest = self.config.execute, self.robot.max_velocity
        steps = np.abs(np.diff(self.q, axis=0)) * (fastest.min() / fastest)
        speed, acceleration = law.scale * law.max_velocity_rad_s, law.scale * law.max_acceleration_rad_s2
        took = sum(trapezoid_s(float(way), speed, acceleration) for way in steps.max(1))
        said = self.row["t_exec_s"]
        yield Finding("t_exec_s", said, took, "fact", wrong=said is None or abs(said - took) > TIME_S)

    def stability(self) -> float:
        """The least of w_max - w, w - w_min and the open gripper's clearance, at most 1 cm."""
        limits, cut, gripper = self.config.thresholds, CUT_CAP_M, self.robot.gripper
        for kind, size, T_ee_prim in zip(
            gripper.kind, gripper.size, self.fingers.places(self.fingers.opened), strict=True
        ):
            T = self.T_obj_ee @ T_ee_prim
            apart = oracle.mesh_distance(int(kind), size, T, self.mesh.triangles, cap=max(cut, 0.0))
            cut = min(cut, apart if apart > 0 else -deepest_point(int(kind), size, T, self.mesh.triangles))
        if (width := self.closed.width) is None:
            return min(cut, -limits.w_max_m)
        return min(limits.w_max_m - width, width - limits.w_min_m, cut)

    def plan(self) -> float:
        """The path's smallest clearance; without a path what start, goal or target lack."""
        reason, twin = self.row["plan_reason"], self.seen
        if len(self.q):
            least = self._along(twin, lambda q: twin.least(q, cap=4 * CLEARANCE_CAP_M)[0])
            if least >= 0:
                return least
            return -oracle.deepest_along(twin.model, twin.data, twin.pairs, self.q)
        if reason == "ik_unreachable":
            return -oracle.out_of_reach(self.T_world_ee, self.robot)
        if reason == "start_in_collision":
            return self._clearance(np.array(self.config.workplace.home_q))
        if reason in ("ik_in_collision", "no_free_posture_found"):
            most = -np.inf
            for q in self._branches():
                most = max(most, self._clearance(q, most))
            return most
        return -np.inf

    def _branches(self) -> Array:
        """All solutions of ur-analytic-ik; where the planner has one goal, the one whose clearance the row can mean.

        The row does not say which one. Its margin is at most the overlap: of those that overlap so much, the least deep.

        Of another arm those that least squares finds from 40 random postures.
        """
        if self.robot.family != "ur":
            return self._searched()
        arm = getattr(ur_analytic_ik, self.robot.name.split("_")[0])
        turn = np.diag([-1.0, -1.0, 1.0, 1.0])  # its base is world turned by half a turn
        target = turn @ self.T_world_ee @ np.linalg.inv(self.robot.T_flange_ee)
        found = np.array(arm.inverse_kinematics(np.ascontiguousarray(target))).reshape(-1, 6)
        if self.config.plan.goals == "one" and len(found):
            margins, said = np.array([self._clearance(q) for q in found]), self.row["margin_plan_m"]
            apart = np.where(margins <= said + TOLERANCE_M, said - margins, 1.0 + np.abs(margins - said))
            return found[[int(apart.argmin())]]
        return found

    def _searched(self) -> Array:
        """Postures (n, J) within limits that reach the target, from random ones."""
        low, high = np.maximum(self.robot.lower, -np.pi), np.minimum(self.robot.upper, np.pi)

        def off(q: Array) -> Array:
            T = self.true.ee(q)
            return np.r_[T[:3, 3] - self.T_world_ee[:3, 3], 0.3 * (T[:3, :3] - self.T_world_ee[:3, :3]).ravel()]

        starts = np.random.default_rng(int(self.row["trial_id"])).uniform(low, high, (40, len(low)))
        found = [least_squares(off, start, bounds=(low - 1e-9, high + 1e-9)).x for start in starts]
        return np.array([q for q in found if np.abs(off(q)).max() < 1e-6]).reshape(-1, len(low))

    def _clearance(self, q: Array, enough: float = -np.inf) -> float:
        """Smallest clearance of all pairs at a posture; below 0 the depth of the deepest, or of one that is below `enough`."""
        twin = self.seen
        least, _ = twin.least(q, cap=CLEARANCE_CAP_M)
        if least >= 0:
            return least
        (a, b), m, x = twin.pairs.T, twin.model, twin.data.geom_xpos
        most = m.geom_rbound[a] + m.geom_rbound[b] - np.linalg.norm(x[a] - x[b], axis=1)  # parts their balls
        deepest = 0.0
        for i in np.argsort(-most):
            if most[i] <= deepest or -deepest < enough:
                break
            deepest = max(deepest, oracle.geom_depth(m, twin.data, int(a[i]), int(b[i])))
        return -deepest

    def reach(self) -> float:
        """r_h - dist(c_h, solid of the object, or its hull)."""
        return self.reach_at(self.T_world_ee, self.T_hand)

    def reach_at(self, T_world_ee: Array, T_world_hand: Array) -> float:
        """`reach` with gripper and hand there."""
        limits, hands = self.config.thresholds, self.scene.hands
        index = self.true.staged.hand_index
        joints = hands.joints[index].double().numpy()
        normal = np.cross(joints[1] - joints[0], joints[7] - joints[0])
        normal *= (-1.0 if int(hands.set.side[index]) else 1.0) / np.linalg.norm(normal)
        center = joints[[0, 1, 4, 7, 10]].mean(0) + limits.reach_offset_m * normal
        x = self.attached @ np.linalg.inv(T_world_ee) @ T_world_hand @ np.append(center, 1.0)
        mesh = self.mesh
        if self.config.reach == "hull":
            hull = ConvexHull(mesh.vertices)
            mesh = trimesh.Trimesh(mesh.vertices, hull.simplices, process=False)
            inside = bool((hull.equations @ np.append(x[:3], 1.0)).max() <= 0)
        else:
            inside = abs(winding_number(x[:3], mesh.triangles)) > 0.5
        apart = 0.0 if inside else float(trimesh.proximity.closest_point_naive(mesh, x[None, :3])[1][0])
        return limits.reach_radius_m - apart

    @cached_property
    def region(self) -> Array:
        """Triangles (F, 3, 3) of the receiver's region, object frame."""
        return np.asarray(self.mesh.triangles[self.model.receiver_face])

    def affordance(self) -> float:
        """The closed fingers' distance from the receiver's region."""
        limits, robot, best = self.config.thresholds, self.robot, CLEARANCE_CAP_M
        opening, width = self.closed.opening, self.closed.width
        if width is not None and width <= limits.w_max_m:
            opening = max(opening - limits.pad_squeeze_m, 0.0)
        for kind, size, T_ee_prim, motion in zip(
            robot.gripper.kind, robot.gripper.size, self.fingers.places(opening), robot.gripper_motion, strict=True
        ):
            if motion != "fixed" and self.model.receiver_boxes is not None:
                best = min(best, self._from_boxes(int(kind), size, self.attached @ T_ee_prim))
            elif motion != "fixed":
                T = self.attached @ T_ee_prim
                apart = oracle.open_surface_distance(int(kind), size, T, self.region, max(best, 0.0))
                best = min(best, apart if apart > 1e-9 else -deepest_point(int(kind), size, T, self.region))
        return best

    def _from_boxes(self, kind: int, size: Array, T: Array) -> float:
        """Distance of a primitive, object frame, from the boxes that are the receiver's region; below 0 how deep it is in."""
        boxes, cube = self.model.receiver_boxes, np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
        assert boxes is not None
        best, body = np.inf, bodies([kind], [size], T[None])
        for center, half, *R in boxes:
            corners = center + (cube * half) @ np.stack(R).T
            apart = float(convex_distance(body, bodies([ShapeKind.HULL], None, np.eye(4)[None], [corners]))[1][0])
            if apart <= 1e-9:
                core, _, grown = core_of(kind, size, None, sides=48)
                apart = -penetration_depth(core @ T[:3, :3].T + T[:3, 3], corners, grown)
            best = min(best, apart)
        return best

    def safe(self) -> float:
        """The true hand's distance from the robot along the motion; with bodies that of arm and torso too."""
        with_body = self.config.receiver == "body"

        def apart(q: Array) -> float:
            found = self.true.safe_at(self.hand, q, cap=2 * CLEARANCE_CAP_M)
            return min(found, self.true.person_at(q, cap=2 * CLEARANCE_CAP_M)) if with_body else found

        least = self._along(self.true, apart)
        return least if least > 0 else min(-self._hand_depth(), -self._person_depth() if with_body else 0.0)

    def body_m(self) -> float:
        """The robot's distance from the receiver's arm and torso along the motion."""
        least = self._along(self.true, lambda q: self.true.person_at(q, cap=2 * CLEARANCE_CAP_M))
        return least if least > 0 else -self._person_depth()

    def _along(self, twin: MujocoScene, distance: Callable[[Array], float]) -> float:
        """The smallest distance (m, at most 5 cm) over the path: of all samples, then about the nearest one by thirds."""
        least, nearest = twin.least_sample(self.q, STEP_RAD, CLEARANCE_CAP_M, distance, enough=0.0)
        if not 0 < least < CLEARANCE_CAP_M:
            return least
        postures = np.array(list(oracle.samples(self.q, STEP_RAD)))
        i = int(np.abs(postures - nearest).sum(1).argmin())
        for side in (max(i - 1, 0), min(i + 1, len(postures) - 1)):
            low, high = 0.0, 1.0
            for _ in range(14):
                thirds = low + (high - low) * np.array([1, 2]) / 3
                a, b = (distance(nearest + t * (postures[side] - nearest)) for t in thirds)
                low, high = (low, thirds[1]) if a < b else (thirds[0], high)
                least = min(least, a, b)
        return least

    def _person_depth(self) -> float:
        twin = self.true
        return oracle.deepest_along(twin.model, twin.data, twin.pairs_with_person(), self.q)

    def _hand_depth(self) -> float:
        """The deepest point of the hand's surface in a body of the robot along the motion."""
        samples = list(oracle.samples(self.q, STEP_RAD))
        rough = [max(self._depths(q, self.hand.mean(1), rough=True)) for q in samples]
        best = 0.0
        for i in np.argsort(rough)[::-1][:6]:
            best = max(best, *self._depths(samples[i], self.hand, rough=False))
        return best

    def _depths(self, q: Array, surface: Array, *, rough: bool) -> Iterator[float]:
        twin = self.true
        twin.safe_at(self.hand, q, cap=0.0)  # puts the model there
        m, d = twin.model, twin.data
        for name in (name for link in self.robot.links for name in twin.groups[link]):
            g, T = m.geom(name).id, np.eye(4)
            T[:3, :3], T[:3, 3] = d.geom_xmat[g].reshape(3, 3), d.geom_xpos[g]
            local = (surface - T[:3, 3]) @ T[:3, :3]
            if m.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
                first, n = m.mesh_vertadr[m.geom_dataid[g]], m.mesh_vertnum[m.geom_dataid[g]]
                corners = m.mesh_vert[first : first + n].astype(np.float64)
                if rough:
                    faces = ConvexHull(corners).equations
                    yield -float((local @ faces[:, :3].T + faces[:, 3]).max(-1).min())
                else:
                    yield deepest_in_hull(corners, local)
                continue
            kind, size = oracle.kind_of(m, g), m.geom_size[g]
            if rough:
                yield -float(oracle.primitive_distance(kind, size, local).min())
            else:
                yield deepest_point(kind, size, T, surface)


class AgainBelieved(Again):
    """A row whose arm was planned in a world that somebody believed in. Plan is judged along a stored path, without the robot and
    the person: Safe judges those. Without a path the believed world says what is missing, and has no twin here.
    """

    def plan(self) -> float:
        """The path's smallest clearance of all pairs but robot and person; without a path the row's own margin."""
        if not len(self.q):
            return float(self.row["margin_plan_m"])
        twin = copy.copy(self.seen)
        keep = twin.pair_class != CLASSES.index("hand")
        twin.pairs, twin.pair_class = twin.pairs[keep], twin.pair_class[keep]
        least = self._along(twin, lambda q: twin.least(q, cap=4 * CLEARANCE_CAP_M)[0])
        return least if least >= 0 else -oracle.deepest_along(twin.model, twin.data, twin.pairs, self.q)
