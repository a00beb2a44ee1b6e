"""The whole scene as one MuJoCo model: what is simulated is what is rendered, and it takes any
trial without recompiling."""

import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from r2h_batch.config import Workplace
from r2h_batch.scene.dynamics import (
    MassProperties,
    Payload,
    PayloadTables,
    add_arm,
    add_object,
    arm_model,
    load,
    new_spec,
    principal,
    quat_wxyz,
)
from r2h_batch.scene.model_parts import (
    COLLISION,
    COLORS,
    VISUAL,
    FingerLevers,
    Mesh,
    add_fingers,
    add_mesh,
    add_mesh_geom,
    add_primitive,
    add_shown,
    add_visual,
    finger_joints_at,
    link_color,
    look,
)
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot, drive_from_gap

Array = NDArray[np.float64]

KEPT = 2
"""Compiled models that a process holds: 50 MB with 16 hands, 190 MB with all 400."""

MESH_FIELDS = ("geom_dataid", "geom_size", "geom_aabb", "geom_rbound", "geom_pos", "geom_quat")
"""Mesh-dependent geom fields."""


@dataclass(frozen=True)
class TrialScene:
    """Bodies that one trial puts into the scene."""

    payload: Payload
    object_index: int
    hand_index: int
    T_world_hand: Array
    opening_m: float


@dataclass(frozen=True)
class TrialScenes:
    """Bodies that n trials put into the scene; `[i]` is one of them."""

    objects: Sequence[ObjectModel]
    T_gripper_obj: Array  # (n, 4, 4)
    object_index: NDArray[np.int64]  # (n,)
    hand_index: NDArray[np.int64]
    T_world_hand: Array  # (n, 4, 4)
    opening_m: Array  # (n,)

    def __len__(self) -> int:
        return len(self.object_index)

    def __getitem__(self, i: int) -> TrialScene:
        held = Payload.of(self.objects[self.object_index[i]], self.T_gripper_obj[i])
        hand = int(self.hand_index[i])
        return TrialScene(
            held, int(self.object_index[i]), hand, self.T_world_hand[i], float(self.opening_m[i])
        )

    def rows(self, at: NDArray[np.int64]) -> "TrialScenes":
        """Those at places `at`."""
        return TrialScenes(
            self.objects, *(getattr(self, f.name)[at] for f in fields(self) if f.name != "objects")
        )

    @property
    def held(self) -> MassProperties:
        """Mass properties of what they hold."""
        used, place = np.unique(self.object_index, return_inverse=True)
        payloads = [Payload.of(self.objects[o], np.eye(4)) for o in used]
        moments, axes = principal(np.stack([x.inertia for x in payloads]))
        mass, com = np.array([x.mass for x in payloads]), np.stack([x.com for x in payloads])
        return MassProperties(*(x[place] for x in (mass, com, axes, moments)))


class SceneModel:
    """A compiled model and what it takes to put any trial into it: `load`, then `start` and `hold`.

    Joints of the arm come first in qpos, qvel and ctrl. The object is the last body. Without geoms
    (`arm_only`) there are the arm, a rigid gripper and the object's mass.
    """

    def __init__(
        self,
        robot: Robot,
        model: mujoco.MjModel,
        shapes: dict[str, Array] | None = None,
        objects: NDArray[np.int64] | None = None,
        hands: dict[int, NDArray[np.int64]] | None = None,
        levers: "FingerLevers | None" = None,
    ) -> None:
        self.robot, self.model, self.shapes = robot, model, shapes or {}
        self.objects, self.hands = objects, hands or {}
        self.full = objects is not None
        self.levers = levers or FingerLevers(0.0, 0.0, 0.0, 0.0)
        self.hand_body = model.body("hand").id if self.full else -1
        bodies = [self.hand_body, model.body("object").id] if self.full else []
        self.varied = (
            np.concatenate([np.flatnonzero(model.geom_bodyid == b) for b in bodies])
            if bodies
            else np.zeros(0, int)
        )
        """geoms whose mesh is the trial's: hand, then object"""

    @staticmethod
    def arm_only(robot: Robot, *, step_s: float, payload_known: bool = True) -> "SceneModel":
        """The arm alone: nothing to touch, nothing to see."""
        return SceneModel(robot, arm_model(robot, step_s=step_s, payload_known=payload_known))

    def meshes(self, trial: TrialScene) -> NDArray[np.int64]:
        """The mesh of each of the `varied` geoms."""
        assert self.objects is not None
        return np.concatenate([self.hands[trial.hand_index], self.objects[trial.object_index]])

    def load(self, model: mujoco.MjModel, trial: TrialScene, data: mujoco.MjData) -> None:
        """Puts a trial into (a copy of) the model, whatever it held before; `data` is scratch."""
        if self.full:
            mesh = self.meshes(trial)
            for name, rows in self.shapes.items():
                getattr(model, name)[self.varied] = rows[mesh]
            model.body_pos[self.hand_body] = trial.T_world_hand[:3, 3]
            model.body_quat[self.hand_body] = quat_wxyz(trial.T_world_hand[:3, :3])
        load(model, trial.payload, data)

    def loaded(self, trials: TrialScenes) -> dict[str, Array]:
        """Fields that `load` writes for each of n trials: those of the model, as
        `PayloadTables.rows` gives them."""
        return self._payloads.rows(trials.T_gripper_obj, trials.held)

    @cached_property
    def _payloads(self) -> PayloadTables:
        return PayloadTables(self.model)

    def meshes_of(self, trials: TrialScenes) -> NDArray[np.int64]:
        """`meshes` of each of n trials, (n, geoms)."""
        assert self.objects is not None
        hands = np.stack([self.hands[h] for h in trials.hand_index.tolist()])
        return np.concatenate([hands, self.objects[trials.object_index]], 1)

    def start(self, trial: TrialScene | TrialScenes, q: ArrayLike) -> Array:
        """qpos (nq,) or (n, nq) with the arm at q and the fingers at their opening."""
        q = np.asarray(q, np.float64)
        qpos = np.zeros((*q.shape[:-1], self.model.nq))
        n = len(self.robot.joints)
        qpos[..., :n] = q
        if self.full:
            qpos[..., n:] = np.tile(finger_joints_at(self.robot, self._drive(trial)), 2)
        return qpos

    def _drive(self, trial: TrialScene | TrialScenes) -> Array:
        """Drives of the fingers, rad or m: () of a trial, (n,) of many."""
        return drive_from_gap(self.robot, trial.opening_m)

    def sway(self, trial: TrialScene, qpos: Array) -> float:
        """How far any point of the fingers was from where their opening has it, at most, over
        states (n, nq); m."""
        if not self.full:
            return 0.0
        driver, knuckle, pin = self._finger_joints(trial, qpos)
        driver, knuckle = (np.abs(x - self._drive(trial)) for x in (driver, knuckle))
        at = self.levers
        worst = np.maximum(
            driver * max(at.driver, at.pin_arm) + pin * at.pin, knuckle * at.inner_knuckle
        )
        return float(worst.max())

    def fingers(self, trial: TrialScene, qpos: Array) -> Array:
        """The smallest and largest drive of drivers and inner knuckles, and how far an inner
        finger is turned against the gripper, rad: (n, 3) of the states (n, nq). Of fingers that a
        table moves all in m, the last how far points are off at most besides."""
        driver, knuckle, pin = self._finger_joints(trial, qpos)
        drive = np.concatenate([driver, knuckle], 1)
        return np.stack([drive.min(1), drive.max(1), pin.max(1)], 1)

    def _finger_joints(self, trial: TrialScene, qpos: Array) -> tuple[Array, Array, Array]:
        """Drivers, inner knuckles, turn of the inner fingers: (n, 2) each of states (n, nq)."""
        at = qpos[:, len(self.robot.joints) :].reshape(len(qpos), 2, -1)
        if self.levers.weight:
            off = np.abs(at - finger_joints_at(self.robot, self._drive(trial)))
            return at[..., 0], at[..., 0], off @ np.array(self.levers.weight)
        return at[..., 0], at[..., 2], np.abs(at[..., 0] + at[..., 1])

    def hold(self, trial: TrialScene | TrialScenes) -> Array:
        """Constant controls of the actuators beyond the arm's: (nu - 6,) or (n, nu - 6)."""
        drive = self._drive(trial)
        if self.model.nu == len(self.robot.joints):
            return np.zeros((*drive.shape, 0))
        if self.robot.linkage.table is None:
            return drive[..., None]
        one = finger_joints_at(self.robot, drive)
        return np.concatenate([one, one[..., 1:]], -1)


_kept: "OrderedDict[tuple[Any, ...], tuple[Any, SceneModel]]" = OrderedDict()
_arms: dict[tuple[Any, ...], SceneModel] = {}  # a few kB each
_keeping = threading.Lock()


def scene_model(
    robot: Robot,
    objects: Sequence[ObjectModel],
    hands: Any,
    hand_indices: Iterable[int],
    *,
    step_s: float,
    payload_known: bool,
    object_collision: str,
    full: bool,
    workplace: Workplace | None = None,
) -> SceneModel:
    """`build_scene_model`, or `SceneModel.arm_only`; of this process' last two if one of them does,
    with more hands if not.

    Which hands a model has makes no difference to any motion.
    """
    workplace = workplace or Workplace()
    if not full:
        with _keeping:
            arm = (robot.digest, step_s, payload_known)
            if arm not in _arms:
                _arms[arm] = SceneModel.arm_only(robot, step_s=step_s, payload_known=payload_known)
            return _arms[arm]
    wanted, ids = set(map(int, hand_indices)) or {0}, tuple(map(id, objects))
    how: dict[str, Any] = {"step_s": step_s, "payload_known": payload_known}
    how["object_collision"] = object_collision
    key = (robot.digest, hands.set.digest, ids, *how.values(), workplace)
    with _keeping:
        _, model = _kept.get(key, (None, None))
        if model is None or not wanted <= model.hands.keys():
            have = set() if model is None else set(model.hands)
            # and twice as many as before, so that a long sweep compiles a few times and not for
            # each chunk
            wanted |= have
            others = [h for h in range(len(hands.set)) if h not in wanted]
            wanted |= set(others[: max(2 * len(have) - len(wanted), 0)])
            model = build_scene_model(robot, objects, hands, wanted, **how, workplace=workplace)
            # holds the objects, so that no others get their ids
            _kept[key] = (tuple(objects), model)
        _kept.move_to_end(key)
        while len(_kept) > KEPT:
            _kept.popitem(last=False)
        return model


def build_scene_model(
    robot: Robot,
    objects: Sequence[ObjectModel],
    hands: Any,
    hand_indices: Iterable[int],
    *,
    step_s: float,
    payload_known: bool = True,
    object_collision: str = "hull",
    workplace: Workplace | None = None,
) -> SceneModel:
    """Arm, gripper with its linkage, object, hand and table, for any of the objects and the listed
    hands (`world_tables.Hands`).

    Contacts push between the pairs that planning checks, without the hand: links with each other
    and with the table, the object with the arm. The hand's first touch decides a trial, and the
    motion after it must not depend on it; object and gripper, object and table do not push while
    the object is attached.
    """
    spec = new_spec(step_s)
    # pairs are named by a bit per body
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    look(spec)
    partners = _partners(robot)
    hand_indices = sorted(set(hand_indices))
    meshes, object_rows, hand_rows = _trial_meshes(objects, hands, hand_indices, object_collision)
    for name, vertices, faces, convex in meshes:
        add_mesh(spec, name, vertices, faces, convex=convex)

    _add_table(spec, partners, workplace or Workplace())
    hand = spec.worldbody.add_body(name="hand", mocap=True)
    for k, mesh in enumerate(hand_rows[hand_indices[0]]):
        name = f"hand/{hands.model.piece_names[k]}"
        add_mesh_geom(hand, name, meshes[mesh][0], "hand", group=VISUAL)
    links = add_arm(spec, robot, spec.worldbody)
    for k, link in enumerate(links):
        for i in np.flatnonzero(robot.arm.link == k):
            name, T = f"robot/{robot.arm.names[i]}", robot.arm.T_link_prim[i]
            add_primitive(spec, link, robot.arm, int(i), T, *partners[k], name)
            if not robot.visuals:
                color = link_color(robot.links[k])
                add_shown(link, robot.arm, int(i), T, f"{name}_visual", color)
        name = robot.links[k]
        if robot.visuals:
            add_visual(spec, link, f"robot/{name}_visual", robot, name, np.eye(4), name)
    gripper = add_fingers(spec, links[-1], robot, partners[-3])
    body = add_object(gripper, payload_known=payload_known)
    for k, mesh in enumerate(object_rows[0]):
        contact = partners[-2] if k else (0, 0)
        name = "object/mesh_visual" if not k else f"object/{object_collision}_{k - 1}"
        add_mesh_geom(
            body, name, meshes[mesh][0], "object", *contact, group=COLLISION if k else VISUAL
        )
    model = spec.compile()
    varied = np.isin(model.geom_bodyid, [model.body("hand").id, model.body("object").id])
    # as they may be for the first meshes
    model.geom_sameframe[varied] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
    # body boxes are compiled for the first object in its placeholder's axes: boxes that hold any
    # object in any axes
    first, count = model.body_bvhadr[-1], model.body_bvhnum[-1]
    model.bvh_aabb[first : first + count] = [0, 0, 0, 2, 2, 2]
    shapes, levers = _shapes(meshes, model), FingerLevers.of(robot)
    return SceneModel(robot, model, shapes, np.array(object_rows), hand_rows, levers)


def _trial_meshes(
    objects: Sequence[ObjectModel],
    hands: Any,
    hand_indices: list[int],
    object_collision: str,
) -> tuple[list[Mesh], list[list[int]], dict[int, NDArray[np.int64]]]:
    """Meshes of objects and hands; which of them each object's and hand's geoms show.

    An object has its surface first, then its collision bodies; with fewer pieces than others the
    last is repeated.
    """
    meshes: list[Mesh] = []

    def add(name: str, vertices: ArrayLike, faces: Any, *, convex: bool) -> int:
        meshes.append((name, np.asarray(vertices, np.float64), faces, convex))
        return len(meshes) - 1

    object_rows = []
    for n, o in enumerate(objects):
        row = [add(f"object_{n}", o.vertices, o.faces, convex=False)]
        solids = [o.hull_vertices] if object_collision == "hull" else [v for v, _ in o.pieces]
        row += [add(f"object_{n}_{k}", v, None, convex=True) for k, v in enumerate(solids)]
        object_rows.append(row)
    width = max(len(row) for row in object_rows)
    object_rows = [row + row[-1:] * (width - len(row)) for row in object_rows]
    hand_rows = {}
    for h in hand_indices:
        pieces = range(len(hands.model.piece_names))
        row = [add(f"hand_{h}_{k}", hands.piece_points(h, k), None, convex=True) for k in pieces]
        hand_rows[h] = np.array(row)
    return meshes, object_rows, hand_rows


def _shapes(meshes: Sequence[Mesh], model: mujoco.MjModel) -> dict[str, Array]:
    """The `MESH_FIELDS` that a geom has with each of the model's first meshes: as compiled, one
    geom for each."""
    stock = mujoco.MjSpec()
    for name, vertices, faces, convex in meshes:
        add_mesh(stock, name, vertices, faces, convex=convex)
        stock.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    compiled = stock.compile()
    assert [mesh[0] for mesh in meshes] == [model.mesh(i).name for i in range(len(meshes))]
    return {name: np.array(getattr(compiled, name)) for name in MESH_FIELDS}


def _partners(robot: Robot) -> list[tuple[int, int]]:
    """(contype, conaffinity) of the arm's links, gripper, object, table: contacts between exactly
    the pairs that may push."""
    gripper = len(robot.joints) + 1
    conaffinity = [0] * (gripper + 3)
    for a, b in robot.self_pairs:
        conaffinity[b] |= 1 << int(a)
    for a in robot.object_pairs:
        conaffinity[a] |= 1 << gripper + 1
    for k in range(robot.table_from, gripper + 1):
        conaffinity[k] |= 1 << gripper + 2
    return [(1 << k, c) for k, c in enumerate(conaffinity)]


def _add_table(spec: mujoco.MjSpec, partners: list[tuple[int, int]], at: Workplace) -> None:
    table = spec.worldbody.add_body(name="table")
    table.add_geom(
        name="table/top", type=mujoco.mjtGeom.mjGEOM_BOX, pos=at.table_center, size=at.table_half, contype=partners[-1][0],
        conaffinity=partners[-1][1], group=VISUAL, rgba=[*COLORS["table"], 1],
    )  # fmt: skip
