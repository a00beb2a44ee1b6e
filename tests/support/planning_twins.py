"""Independent judges of the planner: MuJoCo C on dense samples of a motion, and OMPL's RRTConnect on MuJoCo C.

`Checker` works on the scenes of oracle.py with MuJoCo's contacts instead of its distance queries: fast enough to look
at every sample of every path. Contacts miss bodies that overlap deeply; a motion from a free posture meets shallow
overlaps first, so dense samples do not.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou
from oracle import CLASSES, MujocoScene, Staged, mujoco_scene, samples
from scipy.spatial.transform import Rotation

from r2h_batch.config import HOME_Q, ExecConfig
from r2h_batch.scene.robot import Robot, ee_pose
from r2h_batch.scene.scene import Scene

Array = NDArray[np.float64]
HAND_MARGIN_M = 0.004
"""Distances to the hand are seen below this."""


def let_collide(twin: MujocoScene, classes: Sequence[str] = CLASSES) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Makes exactly the pairs of these classes collide, by MuJoCo's bit masks.

    Returns each geom's group (the robot's links, object, hand, table), and the class of each pair of groups (-1: none).
    """
    m = twin.model
    groups = [*twin.robot.links, "object", "hand", "table"]
    group = np.zeros(m.ngeom, int)
    for i, name in enumerate(groups):
        group[[m.geom(g).id for g in twin.groups[name]]] = i
    partners, kinds = np.zeros(len(groups), int), np.full((len(groups), len(groups)), -1)
    for (a, b), kind in zip(twin.pairs, twin.pair_class, strict=True):
        if CLASSES[kind] in classes:
            partners[group[a]] |= 1 << group[b]
            kinds[group[a], group[b]] = kinds[group[b], group[a]] = kind
    m.geom_contype[:], m.geom_conaffinity[:] = 1 << group, partners[group]
    for body in range(m.nbody):
        own = m.geom_bodyid == body
        m.body_contype[body] = np.bitwise_or.reduce(m.geom_contype[own], initial=0)
        m.body_conaffinity[body] = np.bitwise_or.reduce(m.geom_conaffinity[own], initial=0)
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    return group, kinds


class Checker:
    """Contacts of one trial in MuJoCo C, float64, for the pairs that planning checks."""

    def __init__(self, twin: MujocoScene) -> None:
        self.twin, self.model, self.data = twin, twin.model, twin.data
        m = self.model
        self.group, self.kind = let_collide(twin)
        m.geom_margin[self.group == len(twin.robot.links) + 1] = HAND_MARGIN_M
        m.body_margin[:] = HAND_MARGIN_M
        self.held = self._held_pairs()
        self.checks = 0

    def _held_pairs(self) -> set[str]:
        """Names of the kinds of pairs that overlap and cannot move: MuJoCo reports no contacts within one rigid group."""
        m, d, out = self.model, self.data, set()
        mujoco.mj_kinematics(m, d)
        weld = m.body_weldid[m.geom_bodyid]
        for (a, b), kind in zip(self.twin.pairs, self.twin.pair_class, strict=True):
            if weld[a] == weld[b] and mujoco.mj_geomDistance(m, d, a, b, 0.01, None) < 0:
                out.add(CLASSES[kind])
        return out

    def valid(self, q: ArrayLike) -> bool:
        """No pair overlaps at posture q."""
        self.checks += 1
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        n = self.data.ncon
        return not self.held and (n == 0 or not bool((self.data.contact.dist[:n] < 0).any()))

    def hand_clearance(self, q: ArrayLike) -> tuple[bool, float]:
        """No pair overlaps; smallest distance of robot and object to the hand, at most HAND_MARGIN_M."""
        ok = self.valid(q)
        n = self.data.ncon
        if n == 0:
            return ok, HAND_MARGIN_M
        kind = self.kinds()
        near = self.data.contact.dist[:n][(kind == 0) | (kind == 3)]
        return ok, float(min(near.min(initial=HAND_MARGIN_M), HAND_MARGIN_M))

    def kinds(self) -> NDArray[np.int64]:
        """Index into oracle.CLASSES of each contact."""
        g = self.group[self.data.contact.geom[: self.data.ncon]]
        return np.asarray(self.kind[g[:, 0], g[:, 1]])

    def classes(self, q: ArrayLike) -> set[str]:
        """Names of the kinds of pairs that overlap at posture q."""
        self.valid(q)
        n = self.data.ncon
        return self.held | ({CLASSES[k] for k in self.kinds()[self.data.contact.dist[:n] < 0]} if n else set())


@dataclass(frozen=True)
class Rechecked:
    """Result of dense samples of a motion: how many, overlapping ones (first posture), smallest hand distance
    (capped)."""

    samples: int
    penetrating: int
    where: Array | None
    hand_m: float


def recheck(checker: Checker, postures: Array) -> Rechecked:
    """Every posture (N, 6) looked at."""
    bad, where, hand = 0, None, HAND_MARGIN_M
    for q in postures:
        ok, clearance = checker.hand_clearance(q)
        hand = min(hand, clearance)
        if not ok:
            bad += 1
            where = q if where is None else where
    return Rechecked(len(postures), bad, where, hand)


def posture_at(path: Array, times: Array, when: ArrayLike, config: ExecConfig) -> Array:
    """Postures (..., 6) of the timed motion at times (...): an own trapezoid in float64.

    Only the waypoints and the times at which they are reached are taken from the project.
    """
    v, a = config.scale * config.max_velocity_rad_s, config.scale * config.max_acceleration_rad_s2
    when = np.asarray(when, np.float64)
    k = np.clip(np.searchsorted(times, when, side="right") - 1, 0, len(path) - 2)
    delta, total = path[k + 1] - path[k], times[k + 1] - times[k]
    t = np.clip(when - times[k], 0, total)
    whole, ramp, back = np.abs(delta).max(-1), np.minimum(v / a, total / 2), total - t
    cruise = a * ramp * ramp / 2 + a * ramp * (t - ramp)
    s = np.where(t < ramp, a * t * t / 2, np.where(back < ramp, whole - a * back * back / 2, cruise))
    return path[k] + (s / np.maximum(whole, 1e-30))[..., None] * delta


def motion_samples(path: Array, times: Array, config: ExecConfig, step_rad: float = 1 / 320) -> Array:
    """Postures of the timed motion, evenly spaced in time within each segment, neighbours at most `step_rad` apart (L2)."""
    v, at = config.scale * config.max_velocity_rad_s, [times[:1]]
    for k, delta in enumerate(np.diff(path, axis=0)):
        whole = np.abs(delta).max()
        if whole > 0:  # v: the fastest joint's largest step in time
            n = int(np.ceil(v * (times[k + 1] - times[k]) / whole * np.linalg.norm(delta) / step_rad)) + 1
            at.append(np.linspace(times[k], times[k + 1], n + 1)[1:])
    return posture_at(path, times, np.concatenate(at), config)


@dataclass(frozen=True)
class OmplPath:
    """OMPL's answer: waypoints (W, 6) or None, seconds inside solve(), postures checked."""

    path: Array | None
    seconds: float
    checks: int


def ompl_solve(
    checker: Checker,
    goals: Array,
    lower: Array,
    upper: Array,
    *,
    budget_s: float,
    resolution_rad: float = 1 / 64,
    range_rad: float = 1.5,
    home: Sequence[float] = HOME_Q,
) -> OmplPath:
    """RRTConnect from home to any of the goals (G, N), straight joint-space steps checked every `resolution_rad`."""
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    n = len(lower)
    space = ob.RealVectorStateSpace(n)
    bounds = ob.RealVectorBounds(n)
    for j in range(n):
        bounds.setLow(j, float(lower[j]))
        bounds.setHigh(j, float(upper[j]))
    space.setBounds(bounds)
    space.setLongestValidSegmentFraction(resolution_rad / space.getMaximumExtent())
    setup = og.SimpleSetup(space)
    setup.setStateValidityChecker(lambda s: checker.valid([s[j] for j in range(n)]))
    information = setup.getSpaceInformation()

    def state(q: Sequence[float] | np.ndarray) -> ob.State:
        s = space.allocState()
        for j in range(n):
            s[j] = float(q[j])
        return s

    setup.addStartState(state(home))
    goal = ob.GoalStates(information)
    for q in goals:
        goal.addState(state(q))
    setup.setGoal(goal)
    planner = og.RRTConnect(information)
    planner.setRange(range_rad)
    setup.setPlanner(planner)
    setup.setup()
    before = checker.checks
    start = time.perf_counter()
    setup.solve(budget_s)
    seconds = time.perf_counter() - start
    path = None
    if setup.haveExactSolutionPath():
        states = setup.getSolutionPath().getStates()
        path = np.array([[s[j] for j in range(n)] for s in states])
    return OmplPath(path, seconds, checker.checks - before)


def dense(path: Array, step_rad: float = 1 / 320) -> Array:
    """Samples of a polyline (W, 6) at most `step_rad` apart (L2)."""
    return np.stack(list(samples(path, step_rad)))


def staged(problems, row: int) -> Staged:
    """One row of tests/support/problems.py as the oracle takes it."""
    t = problems.batch.trials
    return Staged(
        int(t.object_index[row]),
        int(t.hand_index[row]),
        problems.T_obj_ee_attached[row].double().numpy(),
        t.T_world_hand[row].double().numpy(),
        float(problems.opening_m[row]),
    )


def jacobian_ik(
    robot: Robot, target: Array, start: ArrayLike = HOME_Q, *, within: float = 1e-6, held: ArrayLike = False
) -> Array | None:
    """The joint angles near `start` that reach a pose (4, 4), by damped least squares with a Jacobian of central differences.

    Errors are metres and radians, float64; None where 100 steps do not come within `within`. `held`: joints (J,) that stay.
    """

    def error(to: Array, at: Array) -> Array:
        return np.r_[to[:3, 3] - at[:3, 3], Rotation.from_matrix(to[:3, :3] @ at[:3, :3].T).as_rotvec()]

    q = np.array(start, np.float64)
    for _ in range(100):
        e = error(target, ee_pose(robot, q))
        if np.abs(e).max() < within:
            return q
        J = np.stack([error(ee_pose(robot, q + h), ee_pose(robot, q - h)) / 2e-6 for h in 1e-6 * np.eye(len(q))], 1)
        J = np.where(held, 0.0, J)
        q = np.clip(q + J.T @ np.linalg.solve(J @ J.T + 1e-2 * (e @ e + 1e-9) * np.eye(6), e), robot.lower, robot.upper)
    return None


def checker_of(scene: Scene, problems, row: int) -> Checker:
    """The judge of one row."""
    return Checker(mujoco_scene(scene, staged(problems, row)))
