"""Pick, judged again in float64: MuJoCo C for convex bodies, `convex_twin` for the object's surface, ways sampled every
millimetre.

Shared with the project: trials, meshes, the numbers of the robot's file, how the gripper closes (`close_gripper`, which
judge_twin.py judges), and the ways and the path themselves, which are looked at.

Nothing here certifies: a sample is looked at or not. So a smallest clearance found here is at least the true one, and exceeds
it by no more than bodies move between two samples.
"""

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from convex_twin import mesh_distance
from judge_twin import Fingers, World, deepest_point, rigid
from numpy.typing import NDArray
from oracle import CLASSES, Staged, geom_depth, out_of_reach
from planning_twins import jacobian_ik
from scipy.spatial.transform import Rotation

from r2h_batch.judge.grasp import close_gripper
from r2h_batch.judge.pick import Picked, PickReason
from r2h_batch.judge.straight_way import MOST_OFF_M
from r2h_batch.types import CollidingPair

Array = NDArray[np.float64]

CAP_M = 0.01
TOLERANCE_M = 2e-4
"""Twice what float32 makes unreliable."""
WHERE = {
    PickReason.APPROACH_COLLIDES: ("approach", "entered"),
    PickReason.CLOSING_COLLIDES: ("closing",),
    PickReason.LIFT_COLLIDES: ("lift",),
    PickReason.PATH_COLLIDES: ("way",),
}
"""The stages in which a row fails by meeting something."""
STEP_M = 0.001
PARTS_BETWEEN = 3
"""Postures from one stored waypoint (2.5 mm) to the next."""


class RestingWorld(World):
    """The robot and the resting object's hull, which stands in the hand's place."""

    def hand_hulls(self, scene: Any) -> list[Any]:
        return self.object_hulls(scene, "hull")


class PickTwin:
    """One row.

    Args:
        scene: the scene.
        trials: the one trial.
        T_obj_ee, T_world_obj: grasp and rest.
        found: one row of `Picked`: its ways and path are looked at, not taken for true.
    """

    def __init__(self, scene: Any, trials: Any, T_obj_ee: Any, T_world_obj: Any, found: Picked) -> None:
        closed = close_gripper(scene.grasp_tables, T_obj_ee[None].contiguous(), trials.object_index)
        self.opening, self.shift = float(closed.opening_m), float(closed.shift_m)
        self.stability_m = float(closed.margin_m)
        self.scene, self.robot = scene, scene.robot
        self.T_obj_ee, self.T_world_obj = rigid(T_obj_ee), rigid(T_world_obj)
        self.T_world_ee = self.T_world_obj @ self.T_obj_ee
        self.object, self.hand = int(trials.object_index[0]), int(trials.hand_index[0])
        self.T_hand = rigid(trials.T_world_hand[0])
        self.receiver = None if trials.receiver is None else trials.receiver[0].double().numpy()
        self.found = found
        # a stage with more room than this decides nothing: what is nearer is known
        self.cap_m = min(CAP_M, max(float(found.margin_m[0]), 0.0) + STEP_M + TOLERANCE_M)
        model = scene.objects[self.object]
        self.triangles = model.vertices.astype(np.float64)[model.faces]

    def _world(self, opening: float, T_obj_ee: Array | None = None, kind: type[World] = World) -> World:
        resting = kind is RestingWorld
        T = self.T_world_obj if resting else self.T_hand
        held = self.T_obj_ee if T_obj_ee is None else T_obj_ee
        staged = Staged(self.object, self.hand, held, T, opening)
        return kind(self.scene, staged, receiver=None if resting else self.receiver)

    @cached_property
    def open(self) -> World:
        """Robot with the open gripper, person, table; the object in the gripper is never asked for."""
        return self._world(self.robot.open_gap_m)

    @cached_property
    def resting(self) -> World:
        """The same robot and the resting object."""
        return self._world(self.robot.open_gap_m, kind=RestingWorld)

    @cached_property
    def ways(self) -> tuple[Array, Array]:
        """Postures of the way in (to the grasp) and up (to the grasp), float64."""
        way_in, way_up = (x[0].double().numpy() for x in (self.found.way_in, self.found.way_up))
        return _between(way_in), _between(way_up)

    def followed_m(self) -> float:
        """How far the ee is from the straight ways at most, its rotation times 0.2 m included."""
        far = 0.0
        ends = np.tile(self.T_world_ee, (2, 1, 1))
        ends[0, :3, 3] -= 0.1 * self.T_world_ee[:3, 2]
        ends[1, 2, 3] += 0.1
        for start, way in zip(ends, self.ways, strict=True):
            for s, q in zip(np.linspace(0, 1, len(way)), way, strict=True):
                T = self.open.ee(q)
                p = (1 - s) * start[:3, 3] + s * self.T_world_ee[:3, 3]
                turn = np.linalg.norm(T[:3, :3] - self.T_world_ee[:3, :3]) / np.sqrt(2)
                far = max(far, float(np.linalg.norm(T[:3, 3] - p)) + 0.2 * turn)
        return far

    def beyond_limits(self) -> float:
        """How far a joint of the ways or of the path is beyond its limits (rad, below 0: within)."""
        q = np.concatenate([*self.ways, self.path]) if len(self.path) else np.concatenate(self.ways)
        return float(np.maximum(q - self.robot.upper, self.robot.lower - q).max())

    @cached_property
    def path(self) -> Array:
        """Waypoints from home."""
        return self.found.path[0, : int(self.found.length[0])].double().numpy()

    def approach(self) -> float:
        """Smallest clearance of the robot from all but the object, and of the arm from the object's hull, on the way in."""
        return min(self._least(self.open, self.ways[0]), self._least(self.resting, self.ways[0], ("hand",), of="arm"))

    def gripper_on_the_way_in(self) -> float:
        """Smallest clearance of the open gripper from table and person on the way in: the same in every branch."""
        return self._least(self.open, self.ways[0], ("hand", "table"), of="gripper")

    def gripper_at_the_grasp(self) -> float:
        """Smallest clearance of the open gripper from table and person at the grasp, in a posture of own inverse kinematics."""
        rng = np.random.default_rng(0)
        starts = (rng.uniform(-np.pi, np.pi, len(self.robot.joints)) for _ in range(60))
        found = (jacobian_ik(self.robot, self.T_world_ee, start) for start in starts)
        q = next(q for q in found if q is not None)
        return self._least(self.open, q[None], ("hand", "table"), of="gripper")

    def entered(self) -> float:
        """Smallest clearance of the open gripper from the object's surface on the straight way in; below 0: minus a depth."""
        g, best = self.robot.gripper, self.cap_m
        places = Fingers(self.robot).places(self.robot.open_gap_m)
        # no sample is farther from the one before than a step, so what is far away stays so for a while
        lower = np.zeros(len(g.names))
        for back in np.arange(0.0, 0.1 + 1e-9, STEP_M):
            T = self.T_obj_ee.copy()
            T[:3, 3] -= back * T[:3, 2]
            lower -= STEP_M
            for i in np.flatnonzero(lower < best):
                at, size = T @ places[i], g.size[i]
                lower[i] = mesh_distance(int(g.kind[i]), size, at, self.triangles, cap=best + 0.03)
                if lower[i] <= 0:
                    return -max(deepest_point(int(g.kind[i]), size, at, self.triangles), 1e-9)
                best = min(best, lower[i])
        return best

    def closing(self) -> float:
        """Smallest clearance while the fingers close at the grasp, every millimetre of the gap; what the table lacks of room."""
        q, best = self.ways[0][-1], self.cap_m
        world, fingers = self._world(self.robot.open_gap_m), Fingers(self.robot)
        ids = [world.model.geom(n).id for n in self.robot.gripper.names]
        steps = max(round(1e3 * (self.robot.open_gap_m - self.opening)), 1)
        for gap in np.linspace(self.robot.open_gap_m, self.opening, steps + 1):
            T = self.robot.T_wrist3_flange @ self.robot.T_flange_ee @ fingers.places(float(gap))
            world.model.geom_pos[ids] = T[:, :3, 3]
            world.model.geom_quat[ids] = Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True)
            best = min(best, self._least(world, q[None]))
        room = self.scene.config.thresholds.pad_squeeze_m - self.shift * self.T_world_ee[2, 1]
        return min(best, room) if room < 0 else best

    def lift(self) -> float:
        """Smallest clearance on the way up; the held object and the table are no pair."""
        attached = self.T_obj_ee.copy()
        attached[:3, 3] += self.shift * self.T_obj_ee[:3, 1]
        world = self._world(self.opening, attached)
        return self._least(world, self.ways[1], ("hand", "table", "self", "object_hand", "object_robot"))

    def way(self) -> float:
        """Smallest clearance on the path from home, the resting object's hull among the obstacles."""
        dense = np.concatenate(
            [np.linspace(a, b, max(int(np.abs(b - a).sum() / 0.01), 2)) for a, b in pairwise(self.path)]
        )
        return min(self._least(self.open, dense), self._least(self.resting, dense, ("hand",)))

    def _least(
        self, world: World, postures: Array, classes: Sequence[str] = ("hand", "table", "self"), *, of: str = "robot"
    ) -> float:
        """Smallest clearance over postures, at most `cap_m`; of the first pair that meets, minus its depth.

        `of`: robot, arm (all but the gripper) or gripper.
        """
        gripper = [world.model.geom(n).id for n in world.groups["gripper"]]
        keep = np.isin(world.pair_class, [CLASSES.index(c) for c in classes])
        if of != "robot":
            keep &= np.isin(world.pairs[:, 0], gripper) == (of == "gripper")
        m, d, best = world.model, world.data, self.cap_m
        a, b = world.pairs[keep].T
        for q in postures:
            d.qpos[: len(q)] = q
            mujoco.mj_kinematics(m, d)
            lower = world._lower_bounds(a, b)
            for i in np.argsort(lower):
                if lower[i] >= best:
                    break
                x = mujoco.mj_geomDistance(m, d, a[i], b[i], best + 0.01, None)
                if x < 0:
                    return -max(geom_depth(m, d, int(a[i]), int(b[i])), 1e-9)
                best = min(best, x)
        return best

    def missed(self) -> float:
        """How far the grasp is out of reach (m)."""
        return float(out_of_reach(self.T_world_ee, self.robot))

    def wrong(self) -> str:
        """A claim of the row that this file does not confirm; empty where they agree.

        A verdict nearer to the border than TOLERANCE_M may differ. A smallest clearance is right if no sample is below it by more
        than its own tolerance (0.1 mm or a tenth) and the samples' least exceeds it by no more than a step.
        """
        reason, margin = PickReason(int(self.found.reason[0])), float(self.found.margin_m[0])
        if bool(self.found.picked[0]) != (reason == PickReason.OK) or (margin >= 0) != (reason == PickReason.OK):
            return f"{reason.name} has margin {margin} and picked {bool(self.found.picked[0])}"
        if reason == PickReason.OUT_OF_REACH:
            missed = self.missed()
            return "" if -margin <= missed + TOLERANCE_M else f"out of reach by {-margin}, here {missed}"
        if reason == PickReason.NO_STRAIGHT_WAY:
            return ""
        if reason == PickReason.GRASP_COLLIDES:
            kept = self.gripper_at_the_grasp()
            return "" if margin > -TOLERANCE_M or kept < 0 else f"{reason.name} by {margin}, here {kept}"
        off, beyond = self.followed_m(), self.beyond_limits()
        if off > MOST_OFF_M + TOLERANCE_M / 2 or beyond > 1e-5:
            return f"off the line by {off} m, beyond limits by {beyond} rad"
        if reason == PickReason.OK:
            stages = {k: getattr(self, k)() for k in ("approach", "entered", "closing", "lift", "way")}
            least = min(CAP_M, self.stability_m, *stages.values())
            right = margin - max(1.2 * TOLERANCE_M / 2, 0.12 * margin) <= least <= margin + STEP_M
            return "" if right and least > -TOLERANCE_M else f"margin {margin}, here {least}: {stages}"
        if margin > -TOLERANCE_M or reason not in WHERE:
            return ""
        kept = min(getattr(self, k)() for k in WHERE[reason])
        if kept >= 0:
            return f"{reason.name} by {margin}, here {kept}"
        of_gripper = int(self.found.body[0]) >= len(self.scene.tables.arm_order)
        pair = CollidingPair(int(self.found.pair[0]))
        if reason == PickReason.APPROACH_COLLIDES and of_gripper and pair in (CollidingPair.TABLE, CollidingPair.HAND):
            kept = self.gripper_on_the_way_in()
        return "" if kept < 0 else f"{reason.name}: the gripper keeps {kept}"


def _between(way: Array) -> Array:
    """A way with further postures between its own."""
    parts = [np.linspace(a, b, PARTS_BETWEEN, endpoint=False) for a, b in pairwise(way)]
    return np.concatenate([*parts, way[-1:]])
