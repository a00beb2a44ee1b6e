"""Parts of the scene's MuJoCo model: the gripper with its linkage, shapes and meshes, what things
look like."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.scene.dynamics import (
    FINGER_MASS_KG,
    add_body,
    add_gripper,
    add_servo,
    quat_wxyz,
)
from r2h_batch.scene.robot import Linkage, Primitives, Robot, ShapeKind, table_at
from r2h_batch.scene.robot_visuals import part_origin, visual_triangles

Array = NDArray[np.float64]

FINGER_ARMATURE = 0.005
FINGER_KP, FINGER_KV = 200.0, 2.0
"""The gripper's motor, at a driver (kg m^2, N m/rad, N m s/rad) [choice]: the 2F-85's gear is
self-locking, so it holds its opening stiffly whatever moves it."""

JAW_ARMATURE_KG, JAW_KP, JAW_KV = 1.5, 60_000.0, 600.0
"""A motor that slides a jaw (kg, N/m, N s/m) [choice]: what the 2F-85's is at its pads, 57 mm from the
driver's axis."""

LOOP_IMPEDANCE = (0.99, 0.999, 1e-4, 0.5, 2.0)
"""MuJoCo's solimp (d0, d_width, width, midpoint, power) of the constraints that close the linkage's
loops: nearly rigid."""

FINGER_COM_M, FINGER_GYRATION_M = 0.02, 0.015
"""Centre of mass and radius of gyration of the inner finger beyond its pin; the other parts'
centres are half way along them [choice: 70 g in all]."""

COLORS = {
    "base": (0.45, 0.46, 0.48), "shoulder": (0.62, 0.65, 0.68), "upper_arm": (0.72, 0.74, 0.77),
    "forearm": (0.72, 0.74, 0.77), "wrist_1": (0.62, 0.65, 0.68), "wrist_2": (0.62, 0.65, 0.68),
    "wrist_3": (0.45, 0.46, 0.48), "gripper": (0.22, 0.23, 0.25), "pad": (0.10, 0.10, 0.11),
    "hand": (0.87, 0.68, 0.56), "object": (0.16, 0.44, 0.70), "table": (0.80, 0.77, 0.72), "collision": (0.9, 0.3, 0.2),
}  # fmt: skip
VISUAL, COLLISION = 2, 3
"""Geom groups: MuJoCo renders 0 to 2 unless told otherwise."""

_TYPES = {
    ShapeKind.SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE, ShapeKind.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    ShapeKind.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER, ShapeKind.BOX: mujoco.mjtGeom.mjGEOM_BOX,
}  # fmt: skip
Mesh = tuple[str, Array, Any, bool]
"""Name, vertices, faces (None: their hull's), whether it collides as a convex body."""

_CONVEX = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
_SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def link_color(link: str) -> tuple[float, float, float]:
    """Visual geometry of a link of an arm."""
    return COLORS.get(link, COLORS["upper_arm"])


@dataclass(frozen=True)
class FingerLevers:
    """How far points of the gripper's moving parts are from the pivots of their bodies, at most,
    and the pin from its driver's (m)."""

    driver: float
    pin_arm: float
    pin: float
    inner_knuckle: float
    weight: tuple[float, ...] = ()
    """of each joint of a finger that a table moves, as `Fingers` of the kernels has it"""

    @staticmethod
    def of(robot: Robot) -> "FingerLevers":
        """Bounds from the primitives, as if each were a ball."""
        if robot.linkage.table is not None:
            return FingerLevers(1.0, 0.0, 1.0, 1.0, _joint_weights(robot))
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
            size = np.linalg.norm(center - pivot) + np.linalg.norm(robot.gripper.size[i])
            far[motion] = max(far[motion], float(size))
        pin_arm = float(np.hypot(*link.pin_from_driver_yz))
        return FingerLevers(far["driver"], pin_arm, far["pin"], far["inner_knuckle"])

    def sway(self, drive: Array, fingers: Array) -> Array:
        """How far any point of the fingers is from where drive angle `drive` (...) has it, at most,
        for `SceneModel.fingers` (..., 3); m."""
        low, high, pin = np.moveaxis(fingers, -1, 0)
        off = np.maximum(high - drive, drive - low)
        finger = off * max(self.driver, self.pin_arm) + pin * self.pin
        return np.maximum(finger, off * self.inner_knuckle)


@dataclass(frozen=True)
class FingerFrames:
    """Where one finger's joints stand at drive angle 0, gripper frame, m; the other finger's are
    mirrored in y.

    All joints turn about x: the driver and the inner knuckle about pivots of the palm, the inner
    finger about its pin. A table's driver slides along y, and the pivots are the gripper's origin.
    """

    axis: Array  # (3,) of all joints: positive closes
    driver: Array  # (3,) pivot in the gripper
    pin: Array  # (3,) of the inner finger, from the driver's pivot
    inner_knuckle: Array  # (3,) pivot in the gripper
    pad: Array  # (3,) centre of the pad, from the pin

    @staticmethod
    def of(robot: Robot, side: int) -> "FingerFrames":
        """`side`: +1 for the finger at +y (right), -1 for the one at -y (left)."""
        link = robot.linkage
        at = (
            link.driver_pivot_yz, link.pin_from_driver_yz, link.inner_knuckle_pivot_yz,
            link.pad_from_pin_yz,
        )  # fmt: skip
        axis = [side, 0.0, 0.0] if link.table is None else [0.0, -side, 0.0]
        return FingerFrames(np.array(axis), *(np.array([0.0, side * yz[0], yz[1]]) for yz in at))


def tie(spec: mujoco.MjSpec, one: str, other: str, powers: Sequence[float], **solver: Any) -> None:
    """Joint `one` follows a polynomial of joint `other`, coefficients from power 0 to at most 4;
    `solver`: solref, solimp."""
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name1=one, name2=other,
        data=[*powers, *[0] * (mujoco.mjNEQDATA - len(powers))], **solver,
    )  # fmt: skip


def _joint_weights(robot: Robot) -> tuple[float, ...]:
    link, ee_z = robot.linkage, _ee_height(robot)
    assert link.table is not None
    slope = np.abs(np.diff(link.table, axis=1)).max(1) * (link.table.shape[1] - 1)
    slope /= link.drive_upper - link.drive_lower
    rates, weights = 0.0, []
    for k, column in _table_joints(link):
        lever = 1.0
        if column == 2:
            on = [i for i, m in enumerate(robot.gripper_motion) if m == f"table_{k}"]
            centers = robot.gripper.T_link_prim[on][:, :3, 3] - [0.0, 0.0, ee_z]
            sizes = np.linalg.norm(robot.gripper.size[on], axis=1)
            lever = float((np.linalg.norm(centers, axis=1) + sizes).max())
        weights.append(lever)
        rates += lever * slope[k, column]
    return (rates, *weights)


def _table_joints(link: Linkage) -> list[tuple[int, int]]:
    """Row and column of the table of each joint of a finger beyond its driver, which moves the pad
    along y."""
    assert link.table is not None
    found = np.argwhere(np.abs(link.table).max(1) > 1e-9).tolist()
    return [(k, column) for k, column in found if (k, column) != (0, 0)]


def _ee_height(robot: Robot) -> float:
    return float((np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee)[2, 3])


def finger_joints_at(robot: Robot, drive: Array) -> Array:
    """Where the joints of one finger stand at drives (...): (..., joints), the driver first."""
    if robot.linkage.table is None:
        return np.asarray(drive)[..., None] * np.array([1, -1, 1])
    at = table_at(robot.linkage, drive)
    others = [at[k, ..., column] for k, column in _table_joints(robot.linkage)]
    return np.stack([np.asarray(drive, np.float64), *others], -1)


def add_fingers(
    spec: mujoco.MjSpec, wrist: mujoco.MjsBody, robot: Robot, contact: tuple[int, int]
) -> mujoco.MjsBody:  # fmt: skip
    """The 2F-85: per side a driver, an inner finger at its pin and an inner knuckle, closed to a
    loop; one motor. Or fingers that a table moves, every part held at its place."""
    link = robot.linkage
    one = sum(FINGER_MASS_KG.values()) if link.table is None else link.jaw_mass_kg
    gripper = add_gripper(wrist, robot, link.mass_kg - 2 * one)
    stiff = [2.5 * spec.option.timestep, 1.0]
    carriers: dict[tuple[str, int], tuple[mujoco.MjsBody, Array]] = {
        ("fixed", 0): (gripper, np.zeros(3))
    }
    for side in (-1, 1):
        name = "left" if side < 0 else "right"
        frames = FingerFrames.of(robot, side)
        if link.table is not None:
            carriers |= _add_table_finger(gripper, robot, side, frames)
            continue
        for motion, parent_name, at, masses in (
            ("driver", None, frames.driver, ("outer_knuckle", "outer_finger")),
            ("pin", "driver", frames.pin, ("inner_finger",)),
            ("inner_knuckle", None, frames.inner_knuckle, ("inner_knuckle",)),
        ):
            parent, origin = carriers[parent_name, side] if parent_name else (gripper, np.zeros(3))
            T = np.eye(4)
            T[:3, 3] = at
            mass = sum(FINGER_MASS_KG[m] for m in masses)
            com = np.array([0.0, 0.0, FINGER_COM_M]) if motion == "pin" else frames.pin / 2
            inertia, joint = np.eye(3) * mass * FINGER_GYRATION_M**2, f"{name}_{motion}"
            body = add_body(parent, joint, T, mass, com, inertia)
            hinge, armature = mujoco.mjtJoint.mjJNT_HINGE, 1e-5
            if motion == "driver":
                armature = FINGER_ARMATURE
            body.add_joint(name=joint, type=hinge, axis=frames.axis, armature=armature)
            carriers[motion, side] = (body, origin + at)
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY, name1=f"{name}_inner_knuckle",
            name2=f"{name}_pin", data=[*frames.pin, *[0] * (mujoco.mjNEQDATA - 3)], solref=stiff, solimp=LOOP_IMPEDANCE,
        )  # fmt: skip
    tie(spec, "left_driver", "right_driver", (0, 1), solref=stiff, solimp=LOOP_IMPEDANCE)
    if link.table is None:
        add_servo(spec, "right_driver", FINGER_KP, FINGER_KV)
    else:
        add_servo(spec, "right_driver", JAW_KP, JAW_KV)
        weights = _joint_weights(robot)[1:]
        for name in ("left", "right"):
            for (k, column), lever in zip(_table_joints(link), weights, strict=True):
                add_servo(spec, f"{name}_{k}_{'yzx'[column]}", JAW_KP * lever**2, JAW_KV * lever**2)
    _add_finger_geoms(spec, robot, carriers, contact)
    return gripper


def _add_table_finger(
    gripper: mujoco.MjsBody, robot: Robot, side: int, frames: FingerFrames
) -> dict[tuple[str, int], tuple[mujoco.MjsBody, Array]]:
    """A body for each row of the table; its joints are what the row changes, at ee's height."""
    link, name, ee_z = robot.linkage, "left" if side < 0 else "right", _ee_height(robot)
    assert link.table is not None
    joints = list(zip(_table_joints(link), _joint_weights(robot)[1:], strict=True))
    mass, found = link.jaw_mass_kg / len(link.table), {}
    for row in range(len(link.table)):
        # the driver is half the gap, and the pad's shape need not stand where the pads meet
        shift = link.table[0, 0, 0] + link.drive_upper if row == 0 else 0.0
        T = np.eye(4)
        T[:3, 3] = 0.0, side * shift, ee_z
        com, inertia = frames.pad - T[:3, 3], np.eye(3) * mass * FINGER_GYRATION_M**2
        body = add_body(gripper, f"{name}_jaw_{row}", T, mass, com, inertia)
        if row == 0:
            body.add_joint(
                name=f"{name}_driver", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=frames.axis,
                armature=JAW_ARMATURE_KG,
            )  # fmt: skip
        for (k, column), lever in joints:
            if k == row:
                body.add_joint(
                    name=f"{name}_{k}_{'yzx'[column]}",
                    type=mujoco.mjtJoint.mjJNT_HINGE if column == 2 else mujoco.mjtJoint.mjJNT_SLIDE,
                    axis=[[0, side, 0], [0, 0, 1], [side, 0, 0]][column],
                    armature=JAW_ARMATURE_KG * lever**2,
                )  # fmt: skip
        found[f"table_{row}", side] = (body, T[:3, 3] - [0.0, side * shift, 0.0])
    return found


def _add_finger_geoms(
    spec: mujoco.MjSpec,
    robot: Robot,
    carriers: dict[tuple[str, int], tuple[mujoco.MjsBody, Array]],
    contact: tuple[int, int],
) -> None:
    """Primitives and meshes of the gripper's parts, each on the body that carries it (all frames as
    at drive angle 0)."""
    # the left finger is the right one turned about the approach axis
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    shown = set()
    jaws = robot.linkage.table is not None
    if not jaws:
        body = carriers["fixed", 0][0]
        add_visual(spec, body, "gripper/body_visual", robot, "body", np.eye(4), "gripper")
    for i, part in enumerate(robot.gripper_part):
        side = int(robot.gripper_side[i])
        body, origin = carriers[robot.gripper_motion[i], side]
        T = robot.gripper.T_link_prim[i].copy()
        T[:3, 3] -= origin
        add_primitive(
            spec, body, robot.gripper, i, T, *contact, f"gripper/{robot.gripper.names[i]}"
        )
        if jaws:
            name = f"gripper/{robot.gripper.names[i]}_visual"
            add_shown(
                body, robot.gripper, i, T, name, COLORS["pad" if part == "pad" else "gripper"]
            )
        if jaws or side == 0 or (part, side) in shown:
            continue
        shown.add((part, side))
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
            add_visual(spec, body, name, robot, part, T, "gripper")


def add_primitive(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, shapes: Primitives, i: int, T: Array, contype: int, conaffinity: int, name: str
) -> None:  # fmt: skip
    """One of the planner's bodies, at T in the body."""
    if shapes.kind[i] == ShapeKind.HULL:
        add_mesh(spec, name, shapes.corners[i], None, convex=True)
        add_mesh_geom(body, name, name, "collision", contype, conaffinity, group=COLLISION, T=T)
        return
    body.add_geom(
        name=name, type=_TYPES[ShapeKind(int(shapes.kind[i]))], size=shapes.size[i], pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]),
        contype=contype, conaffinity=conaffinity, group=COLLISION, rgba=[*COLORS["collision"], 0.4],
    )  # fmt: skip


def add_shown(
    body: mujoco.MjsBody, shapes: Primitives, i: int, T: Array, name: str, rgb: Sequence[float],
    group: int = VISUAL, alpha: float = 1.0,
) -> None:  # fmt: skip
    """One of the planner's bodies as what is seen, where there is no mesh to show; a hull shares the
    mesh of the body that collides, `name` without `_visual`."""
    kind = ShapeKind(int(shapes.kind[i]))
    shape: dict[str, Any] = {"type": _TYPES.get(kind), "size": shapes.size[i]}
    if kind == ShapeKind.HULL:
        mesh = name.removesuffix("_visual")
        shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh}
    body.add_geom(
        name=name, pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]), contype=0, conaffinity=0, group=group,
        rgba=[*rgb, alpha], **shape,
    )  # fmt: skip


def add_visual(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    robot: Robot,
    mesh: str,
    T: Array,
    color: str,
) -> None:
    """A part of the robot as airo-models shows it."""
    if spec.mesh(f"robot_{mesh}") is None:
        add_mesh(spec, f"robot_{mesh}", *visual_mesh(robot.visuals, mesh), convex=False)
    add_mesh_geom(body, name, f"robot_{mesh}", color, T=T)


def add_mesh(spec: mujoco.MjSpec, name: str, vertices: Array, faces: Any, *, convex: bool) -> None:
    """A mesh that geoms can show; `convex`: and collide as."""
    face = {} if faces is None else {"userface": np.asarray(faces, np.int32).ravel()}
    # convex: or meshes that no geom uses yet would get no hull
    points, inertia = np.asarray(vertices, np.float64).ravel(), _CONVEX if convex else _SHELL
    spec.add_mesh(name=name, uservert=points, inertia=inertia, **face)


def add_mesh_geom(
    body: mujoco.MjsBody, name: str, mesh: str, color: str, contype: int = 0, conaffinity: int = 0, *,
    group: int = VISUAL, T: Array | None = None,
) -> None:  # fmt: skip
    """A mesh at T in the body; with contact types 0 it is only seen."""
    T = np.eye(4) if T is None else T
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]), contype=contype,
        conaffinity=conaffinity, group=group, rgba=[*COLORS["collision" if group == COLLISION else color], 1],
    )  # fmt: skip


@lru_cache(maxsize=16)
def visual_mesh(arm: str, name: str) -> tuple[Array, NDArray[np.int64]]:
    """Vertices and faces of a part of the robot that airo-models shows."""
    corners = np.asarray(visual_triangles(name, arm), np.float32).reshape(-1, 3)
    rows = np.ascontiguousarray(corners).view([("", np.float32)] * 3).ravel()
    _, first, index = np.unique(rows, return_index=True, return_inverse=True)
    return corners[first].astype(np.float64), index.reshape(-1, 3)


@dataclass(frozen=True)
class Light:
    """One of the scene's lamps: where it hangs (m, world), where it shines, how bright, whether
    things throw shadows."""

    pos: tuple[float, float, float]
    dir: tuple[float, float, float]
    diffuse: float
    shadow: bool


AMBIENT, DIFFUSE = 0.35, 0.45
"""Light of the headlight, which has no highlights."""
LIGHTS = (
    Light((-0.6, -1.2, 2.4), (0.45, 0.5, -1), 0.45, True),
    Light((1.4, 1.0, 2.0), (-0.5, -0.4, -1), 0.25, False),
)
SKY = ((1, 1, 1), (0.86, 0.89, 0.93))
"""Above and at the horizon."""
SKY_PIXELS = (64, 384)
PICTURE_PIXELS, SHADOW_PIXELS = (1920, 1080), 4096
SEEN_CENTER, SEEN_EXTENT_M = (0.35, 0, 0.3), 1.2


def look(spec: mujoco.MjSpec) -> None:
    """Light, background and resolution of what is rendered; view/mjcf.py writes the same."""
    light = spec.visual.headlight
    light.ambient, light.diffuse, light.specular = [AMBIENT] * 3, [DIFFUSE] * 3, [0.0] * 3
    spec.visual.global_.offwidth, spec.visual.global_.offheight = PICTURE_PIXELS
    spec.visual.quality.shadowsize = SHADOW_PIXELS
    spec.stat.center, spec.stat.extent = SEEN_CENTER, SEEN_EXTENT_M
    _add_sky(spec, mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, *SKY, *SKY_PIXELS)
    for lamp in LIGHTS:
        spec.worldbody.add_light(
            pos=lamp.pos, dir=lamp.dir, diffuse=[lamp.diffuse] * 3, castshadow=lamp.shadow
        )


def look_on_white(
    spec: mujoco.MjSpec, size: int, *, highlights: float, lamp: float, lamp_highlights: float
) -> None:
    """One thing on white under one lamp from the side, for square pictures that are drawn twice as
    large as `size`."""
    light = spec.visual.headlight
    light.ambient, light.diffuse, light.specular = [AMBIENT] * 3, [DIFFUSE] * 3, [highlights] * 3
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 2 * size
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 20
    spec.visual.quality.offsamples = 0
    side = spec.worldbody.add_light(
        pos=[0.5, -0.8, 1.5],
        dir=[-0.4, 0.55, -1],
        diffuse=[lamp] * 3,
        specular=[lamp_highlights] * 3,
    )
    side.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    _add_sky(spec, mujoco.mjtBuiltin.mjBUILTIN_FLAT, (1, 1, 1), (1, 1, 1), 8, 8)


def _add_sky(
    spec: mujoco.MjSpec, kind: mujoco.mjtBuiltin, top: Any, horizon: Any, width: int, height: int
) -> None:
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=kind, rgb1=top, rgb2=horizon,
        width=width, height=height,
    )  # fmt: skip
