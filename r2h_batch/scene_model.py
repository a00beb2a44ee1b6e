"""The whole scene as one MuJoCo model: what is simulated is what is rendered, and it takes any trial without recompiling."""

import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from r2h_batch.dynamics import (
    FINGER_MASS_KG,
    GRIPPER_MASS_KG,
    Payload,
    add_arm,
    add_body,
    add_gripper,
    add_object,
    add_servo,
    arm_model,
    load,
    new_spec,
    quat_wxyz,
)
from r2h_batch.objects import ObjectModel
from r2h_batch.robot import JOINTS, Kind, Primitives, Robot, drive_from_gap

Array = NDArray[np.float64]

FINGER_ARMATURE = 0.005
FINGER_KP, FINGER_KV = 200.0, 2.0
"""The gripper's motor, at a driver (kg m^2, N m/rad, N m s/rad) [choice]: the 2F-85's gear is self-locking, so it holds its
opening stiffly whatever moves it."""

RIGID = (0.99, 0.999, 1e-4, 0.5, 2.0)
"""Of the loops' constraints: what share of a load they take up."""

FINGER_COM_M, FINGER_GYRATION_M = 0.02, 0.015
"""Of the inner finger beyond its pin; the other parts' centres are half way along them [choice: 70 g in all]."""

COLORS = {
    "base": (0.45, 0.46, 0.48), "shoulder": (0.62, 0.65, 0.68), "upper_arm": (0.72, 0.74, 0.77),
    "forearm": (0.72, 0.74, 0.77), "wrist_1": (0.62, 0.65, 0.68), "wrist_2": (0.62, 0.65, 0.68),
    "wrist_3": (0.45, 0.46, 0.48), "gripper": (0.22, 0.23, 0.25), "pad": (0.10, 0.10, 0.11),
    "hand": (0.87, 0.68, 0.56), "object": (0.16, 0.44, 0.70), "table": (0.80, 0.77, 0.72), "collision": (0.9, 0.3, 0.2),
}  # fmt: skip
VISUAL, COLLISION = 2, 3
"""Geom groups: MuJoCo renders 0 to 2 unless told otherwise."""

KEPT = 2
"""Compiled models that a process holds: 50 MB with 16 hands, 150 MB with all 400."""

MESH_FIELDS = ("geom_dataid", "geom_size", "geom_aabb", "geom_rbound", "geom_pos", "geom_quat")
"""What of a geom depends on its mesh."""

_TYPES = {
    Kind.SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE, Kind.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    Kind.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER, Kind.BOX: mujoco.mjtGeom.mjGEOM_BOX,
}  # fmt: skip
Mesh = tuple[str, Array, Any, bool]
"""Name, vertices, faces (None: their hull's), whether it collides as a convex body."""

_CONVEX, _SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX, mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


@dataclass(frozen=True)
class TrialScene:
    """What one trial puts into the scene."""

    payload: Payload
    object_index: int
    hand_index: int
    T_world_hand: Array
    opening_m: float

    @property
    def drive(self) -> float:
        """Drive angle of the fingers, rad."""
        return float(drive_from_gap(self.opening_m))


@dataclass(frozen=True)
class FingerLevers:
    """How far points of the gripper's moving parts are from the pivots of their bodies, at most, and the pin from its
    driver's (m)."""

    driver: float
    pin_arm: float
    pin: float
    inner_knuckle: float

    @staticmethod
    def of(robot: Robot) -> "FingerLevers":
        """Bounds from the primitives, as if each were a ball."""
        link, far = robot.linkage, {"driver": 0.0, "pin": 0.0, "inner_knuckle": 0.0}
        pivots = {
            "driver": link.driver_pivot_yz, "pin": link.driver_pivot_yz + link.pin_from_driver_yz,
            "inner_knuckle": link.inner_knuckle_pivot_yz,
        }  # fmt: skip
        for i, motion in enumerate(robot.gripper_motion):
            if motion == "fixed":
                continue
            pivot = np.array([0.0, robot.gripper_side[i] * pivots[motion][0], pivots[motion][1]])
            center = robot.gripper.T_link_prim[i][:3, 3]
            far[motion] = max(
                far[motion], float(np.linalg.norm(center - pivot) + np.linalg.norm(robot.gripper.size[i]))
            )
        return FingerLevers(far["driver"], float(np.hypot(*link.pin_from_driver_yz)), far["pin"], far["inner_knuckle"])


class SceneModel:
    """A compiled model and what it takes to put any trial into it: `load`, then `start` and `hold`.

    Joints of the arm come first in qpos, qvel and ctrl. The object is the last body. Without geoms (`arm_only`) there are
    the arm, a rigid gripper and the object's mass.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        shapes: dict[str, Array] | None = None,
        objects: NDArray[np.int64] | None = None,
        hands: dict[int, NDArray[np.int64]] | None = None,
        levers: "FingerLevers | None" = None,
    ) -> None:
        self.model, self.shapes, self.objects, self.hands = model, shapes or {}, objects, hands or {}
        self.full = objects is not None
        self.levers = levers or FingerLevers(0.0, 0.0, 0.0, 0.0)
        self.hand_body = model.body("hand").id if self.full else -1
        bodies = [self.hand_body, model.body("object").id] if self.full else []
        self.varied = (
            np.concatenate([np.flatnonzero(model.geom_bodyid == b) for b in bodies]) if bodies else np.zeros(0, int)
        )
        """geoms whose mesh is the trial's: hand, then object"""

    @staticmethod
    def arm_only(robot: Robot, *, step_s: float, payload_known: bool = True) -> "SceneModel":
        """The arm alone: nothing to touch, nothing to see."""
        return SceneModel(arm_model(robot, step_s=step_s, payload_known=payload_known))

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

    def start(self, trial: TrialScene, q: ArrayLike) -> Array:
        """qpos with the arm at q and the fingers at their opening."""
        qpos = np.zeros(self.model.nq)
        qpos[:JOINTS] = q
        if self.full:
            qpos[JOINTS:] = np.array([1, -1, 1] * 2) * trial.drive
        return qpos

    def sway(self, trial: TrialScene, qpos: Array) -> float:
        """How far any point of the fingers was from where their opening has it, at most, over states (n, nq); m."""
        if not self.full:
            return 0.0
        off = np.abs(qpos[:, JOINTS:].reshape(-1, 2, 3) * [1, -1, 1] - trial.drive)
        driver, pin, knuckle = off[..., 0], np.abs(qpos[:, [6, 9]] + qpos[:, [7, 10]]), off[..., 2]
        at = self.levers
        worst = np.maximum(driver * max(at.driver, at.pin_arm) + pin * at.pin, knuckle * at.inner_knuckle)
        return float(worst.max())

    def hold(self, trial: TrialScene) -> Array:
        """What the actuators beyond the arm's are told, all the time."""
        return np.full(self.model.nu - JOINTS, trial.drive)


_kept: "OrderedDict[tuple[Any, ...], tuple[Any, SceneModel]]" = OrderedDict()
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
) -> SceneModel:
    """`build_scene_model`, or `SceneModel.arm_only`; of this process' last two if one of them does, with more hands if not.

    Which hands a model has makes no difference to any motion.
    """
    if not full:
        return SceneModel.arm_only(robot, step_s=step_s, payload_known=payload_known)
    wanted = set(map(int, hand_indices)) or {0}
    key = (robot.digest, hands.set.digest, tuple(map(id, objects)), step_s, payload_known, object_collision)
    with _keeping:
        _, model = _kept.get(key, (None, None))
        if model is None or not wanted <= model.hands.keys():
            have = set() if model is None else set(model.hands)
            wanted |= (
                have  # and twice as many as before, so that a long sweep compiles a few times and not for each chunk
            )
            wanted |= set([h for h in range(len(hands.set)) if h not in wanted][: max(2 * len(have) - len(wanted), 0)])
            model = build_scene_model(
                robot,
                objects,
                hands,
                wanted,
                step_s=step_s,
                payload_known=payload_known,
                object_collision=object_collision,
            )
            _kept[key] = (tuple(objects), model)  # holds the objects, so that no others get their ids
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
    skins: bool = False,
) -> SceneModel:
    """Arm, gripper with its linkage, object, hand and table, for any of the objects and the listed hands (`scene.Hands`).

    Contacts push between the pairs that planning checks, without the hand: links with each other and with the table, the
    object with the arm. The hand's first touch decides a trial, and the motion after it must not depend on it; object and
    gripper, object and table do not push while the object is attached. `skins`: with the hands' surfaces, else one sees
    their convex pieces.
    """
    spec = new_spec(step_s)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)  # pairs are named by a bit per body
    _look(spec)
    partners = _partners(robot)
    hand_indices = sorted(set(hand_indices))
    meshes, object_rows, hand_rows = _trial_meshes(objects, hands, hand_indices, object_collision, skins)
    for name, vertices, faces, convex in meshes:
        _add_mesh(spec, name, vertices, faces, convex=convex)

    _add_table(spec, partners)
    hand = spec.worldbody.add_body(name="hand", mocap=True)
    for k, mesh in enumerate(hand_rows[hand_indices[0]]):
        seen = not skins or k == len(hands.model.piece_names)
        name = hands.model.piece_names[k] if k < len(hands.model.piece_names) else "skin"
        _add_mesh_geom(hand, f"hand/{name}", meshes[mesh][0], "hand", group=VISUAL if seen else COLLISION)
    links = add_arm(spec, robot, spec.worldbody)
    for k, link in enumerate(links):
        for i in np.flatnonzero(robot.arm.link == k):
            _add_primitive(
                link, robot.arm, int(i), robot.arm.T_link_prim[i], *partners[k], f"robot/{robot.arm.names[i]}"
            )
        _add_visual(spec, link, f"robot/{robot.links[k]}_visual", robot.links[k], np.eye(4), robot.links[k])
    gripper = _add_fingers(spec, links[-1], robot, partners[7])
    body = add_object(gripper, payload_known=payload_known)
    for k, mesh in enumerate(object_rows[0]):
        contact = partners[8] if k else (0, 0)
        name = "object/mesh_visual" if not k else f"object/{object_collision}_{k - 1}"
        _add_mesh_geom(body, name, meshes[mesh][0], "object", *contact, group=COLLISION if k else VISUAL)
    model = spec.compile()
    varied = np.isin(model.geom_bodyid, [model.body("hand").id, model.body("object").id])
    model.geom_sameframe[varied] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)  # as they may be for the first meshes
    # body boxes are compiled for the first object in its placeholder's axes: boxes that hold any object in any axes
    first, count = model.body_bvhadr[-1], model.body_bvhnum[-1]
    model.bvh_aabb[first : first + count] = [0, 0, 0, 2, 2, 2]
    return SceneModel(model, _shapes(meshes, model), np.array(object_rows), hand_rows, FingerLevers.of(robot))


def _trial_meshes(
    objects: Sequence[ObjectModel], hands: Any, hand_indices: list[int], object_collision: str, skins: bool
) -> tuple[list[Mesh], list[list[int]], dict[int, NDArray[np.int64]]]:
    """Meshes of objects and hands; which of them each object's and hand's geoms show.

    An object has its surface first, then its collision bodies; with fewer pieces than others the last is repeated.
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
        if skins:
            faces = hands.model.faces_by_side[int(hands.set.side[h])].numpy()
            row.append(add(f"hand_{h}_skin", hands.vertices[h].numpy(), faces, convex=False))
        hand_rows[h] = np.array(row)
    return meshes, object_rows, hand_rows


def _shapes(meshes: Sequence[Mesh], model: mujoco.MjModel) -> dict[str, Array]:
    """The `MESH_FIELDS` that a geom has with each of the model's first meshes: as compiled, one geom for each."""
    stock = mujoco.MjSpec()
    for name, vertices, faces, convex in meshes:
        _add_mesh(stock, name, vertices, faces, convex=convex)
        stock.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    compiled = stock.compile()
    assert [mesh[0] for mesh in meshes] == [model.mesh(i).name for i in range(len(meshes))]
    return {name: np.array(getattr(compiled, name)) for name in MESH_FIELDS}


def _partners(robot: Robot) -> list[tuple[int, int]]:
    """(contype, conaffinity) of links 0 to 6, gripper, object, table: contacts between exactly the pairs that may push."""
    from r2h_batch.scene import TABLE_FROM_LINK

    conaffinity = [0] * 10
    for a, b in robot.self_pairs:
        conaffinity[b] |= 1 << int(a)
    for a in robot.object_pairs:
        conaffinity[a] |= 1 << 8
    for k in range(TABLE_FROM_LINK, 8):
        conaffinity[k] |= 1 << 9
    return [(1 << k, c) for k, c in enumerate(conaffinity)]


def _add_fingers(
    spec: mujoco.MjSpec, wrist: mujoco.MjsBody, robot: Robot, contact: tuple[int, int]
) -> mujoco.MjsBody:  # fmt: skip
    """The 2F-85: per side a driver, an inner finger at its pin and an inner knuckle, closed to a loop; one motor."""
    link, hinge = robot.linkage, mujoco.mjtJoint.mjJNT_HINGE
    gripper = add_gripper(wrist, robot, GRIPPER_MASS_KG - 2 * sum(FINGER_MASS_KG.values()))
    _add_visual(spec, gripper, "gripper/body_visual", "body", np.eye(4), "gripper")
    stiff = [2.5 * spec.option.timestep, 1.0]
    carriers: dict[tuple[str, int], tuple[mujoco.MjsBody, Array]] = {("fixed", 0): (gripper, np.zeros(3))}
    for side in (-1, 1):
        name = "left" if side < 0 else "right"
        pivot, pin, knuckle = (
            np.array([0.0, side * yz[0], yz[1]])
            for yz in (link.driver_pivot_yz, link.pin_from_driver_yz, link.inner_knuckle_pivot_yz)
        )
        for motion, parent_name, at, masses in (
            ("driver", None, pivot, ("outer_knuckle", "outer_finger")),
            ("pin", "driver", pin, ("inner_finger",)),
            ("inner_knuckle", None, knuckle, ("inner_knuckle",)),
        ):
            parent, origin = carriers[parent_name, side] if parent_name else (gripper, np.zeros(3))
            T = np.eye(4)
            T[:3, 3] = at
            mass = sum(FINGER_MASS_KG[m] for m in masses)
            com = np.array([0.0, 0.0, FINGER_COM_M]) if motion == "pin" else pin / 2
            body = add_body(parent, f"{name}_{motion}", T, mass, com, np.eye(3) * mass * FINGER_GYRATION_M**2)
            body.add_joint(
                name=f"{name}_{motion}",
                type=hinge,
                axis=[side, 0, 0],
                armature=FINGER_ARMATURE if motion == "driver" else 1e-5,
            )
            carriers[motion, side] = (body, origin + at)
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY, name1=f"{name}_inner_knuckle",
            name2=f"{name}_pin", data=[*pin, *[0] * (mujoco.mjNEQDATA - 3)], solref=stiff, solimp=RIGID,
        )  # fmt: skip
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name1="left_driver", name2="right_driver",
        data=[0, 1, *[0] * (mujoco.mjNEQDATA - 2)], solref=stiff, solimp=RIGID,
    )  # fmt: skip
    add_servo(spec, "right_driver", FINGER_KP, FINGER_KV)
    _add_finger_geoms(spec, robot, carriers, contact)
    return gripper


def _add_finger_geoms(
    spec: mujoco.MjSpec,
    robot: Robot,
    carriers: dict[tuple[str, int], tuple[mujoco.MjsBody, Array]],
    contact: tuple[int, int],
) -> None:
    """Primitives and meshes of the gripper's parts, each on the body that carries it (all frames as at drive angle 0)."""
    from r2h_batch.assets.robot.visuals import part_origin

    turned = np.diag([-1.0, -1.0, 1.0, 1.0])  # the left finger is the right one turned about the approach axis
    seen = set()
    for i, part in enumerate(robot.gripper_part):
        side = int(robot.gripper_side[i])
        body, origin = carriers[robot.gripper_motion[i], side]
        T = robot.gripper.T_link_prim[i].copy()
        T[:3, 3] -= origin
        _add_primitive(body, robot.gripper, i, T, *contact, f"gripper/{robot.gripper.names[i]}")
        if side == 0 or (part, side) in seen:
            continue
        seen.add((part, side))
        T = np.eye(4)
        T[:3, 3] = part_origin(part)
        T = (turned if side < 0 else np.eye(4)) @ T
        T[:3, 3] -= origin
        name = f"gripper/{'left' if side < 0 else 'right'}_{part}_visual"
        if part == "pad":  # a box in the model it comes from
            body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=robot.linkage.pad_half_size, pos=T[:3, 3],
                quat=quat_wxyz(T[:3, :3]), contype=0, conaffinity=0, group=VISUAL, rgba=[*COLORS["pad"], 1],
            )  # fmt: skip
        else:
            _add_visual(spec, body, name, part, T, "gripper")


def _add_table(spec: mujoco.MjSpec, partners: list[tuple[int, int]]) -> None:
    from r2h_batch.scene import TABLE_CENTER, TABLE_HALF

    table = spec.worldbody.add_body(name="table")
    table.add_geom(
        name="table/top", type=mujoco.mjtGeom.mjGEOM_BOX, pos=TABLE_CENTER, size=TABLE_HALF, contype=partners[9][0],
        conaffinity=partners[9][1], group=VISUAL, rgba=[*COLORS["table"], 1],
    )  # fmt: skip


def _add_primitive(
    body: mujoco.MjsBody, shapes: Primitives, i: int, T: Array, contype: int, conaffinity: int, name: str
) -> None:  # fmt: skip
    body.add_geom(
        name=name, type=_TYPES[Kind(int(shapes.kind[i]))], size=shapes.size[i], pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]),
        contype=contype, conaffinity=conaffinity, group=COLLISION, rgba=[*COLORS["collision"], 0.4],
    )  # fmt: skip


def _add_visual(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, mesh: str, T: Array, color: str) -> None:
    if spec.mesh(f"robot_{mesh}") is None:
        _add_mesh(spec, f"robot_{mesh}", *_visual_mesh(mesh), convex=False)
    _add_mesh_geom(body, name, f"robot_{mesh}", color, T=T)


def _add_mesh(spec: mujoco.MjSpec, name: str, vertices: Array, faces: Any, *, convex: bool) -> None:
    face = {} if faces is None else {"userface": np.asarray(faces, np.int32).ravel()}
    # convex: or meshes that no geom uses yet would get no hull
    spec.add_mesh(
        name=name, uservert=np.asarray(vertices, np.float64).ravel(), inertia=_CONVEX if convex else _SHELL, **face
    )


def _add_mesh_geom(
    body: mujoco.MjsBody, name: str, mesh: str, color: str, contype: int = 0, conaffinity: int = 0, *,
    group: int = VISUAL, T: Array | None = None,
) -> None:  # fmt: skip
    T = np.eye(4) if T is None else T
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]), contype=contype,
        conaffinity=conaffinity, group=group, rgba=[*COLORS["collision" if group == COLLISION else color], 1],
    )  # fmt: skip


@lru_cache(maxsize=16)
def _visual_mesh(name: str) -> tuple[Array, NDArray[np.int64]]:
    """Vertices and faces of a part of the robot that airo-models shows."""
    from r2h_batch.assets.robot.visuals import visual_triangles

    corners = np.asarray(visual_triangles(name), np.float32).reshape(-1, 3)
    rows = np.ascontiguousarray(corners).view([("", np.float32)] * 3).ravel()
    _, first, index = np.unique(rows, return_index=True, return_inverse=True)
    return corners[first].astype(np.float64), index.reshape(-1, 3)


def _look(spec: mujoco.MjSpec) -> None:
    """Light, background and resolution of what is rendered."""
    light = spec.visual.headlight
    light.ambient, light.diffuse, light.specular = [0.35] * 3, [0.45] * 3, [0.0] * 3
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    spec.visual.quality.shadowsize = 4096
    spec.stat.center, spec.stat.extent = [0.35, 0, 0.3], 1.2
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[1, 1, 1], rgb2=[0.86, 0.89, 0.93], width=64, height=384,
    )  # fmt: skip
    world = spec.worldbody
    world.add_light(pos=[-0.6, -1.2, 2.4], dir=[0.45, 0.5, -1], diffuse=[0.45] * 3)
    world.add_light(pos=[1.4, 1.0, 2.0], dir=[-0.5, -0.4, -1], diffuse=[0.25] * 3, castshadow=False)
