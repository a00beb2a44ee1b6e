"""Parts of an exported trial: meshes as files, the gripper's shapes at an opening, and the marks
that criteria ask about."""

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.bodies.robot import Kind, Robot, drive_from_gap, finger_motion, gripper_primitives_at
from r2h_batch.bodies.robot_visuals import part_origin
from r2h_batch.config import OPEN_GAP_M
from r2h_batch.scene.dynamics import quat_wxyz
from r2h_batch.scene.model_parts import COLLISION, COLORS, VISUAL, add_primitive, visual_mesh
from r2h_batch.scene.tables import Hands

if TYPE_CHECKING:
    from r2h_batch.export.mjcf import TrialBodies

Array = NDArray[np.float64]

MESHES = "meshes"
MARK = 4
"""Group of sites and geoms that are hidden unless asked for: fingers as they hold and as they come,
the ghost at the target."""

_TYPES = {
    Kind.SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE, Kind.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    Kind.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER, Kind.BOX: mujoco.mjtGeom.mjGEOM_BOX,
}  # fmt: skip
_CONVEX, _SHELL = (
    mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
    mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
)
_SEEN: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0.0}
COLORS_OF_MARKS = {
    "region": (0.95, 0.62, 0.10, 1.0), "ball": (0.20, 0.65, 0.35, 0.25), "target": (0.55, 0.20, 0.75, 0.35),
    "palm": (0.20, 0.65, 0.35, 1.0), "fingers": (0.9, 0.3, 0.2, 0.4),
    "receiver": (0.55, 0.62, 0.66, 1.0),
}  # fmt: skip


def mesh_geom(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, mesh: str, shape: trimesh.Trimesh, color: str, *,
    T: Array | None = None, group: int = VISUAL, alpha: float = 1.0,
) -> None:  # fmt: skip
    """A surface that is only seen, at T in the body; its file is made once and shared by geoms that
    name the same mesh."""
    T = np.eye(4) if T is None else T
    _add_mesh(spec, mesh, shape, _SHELL)
    rgb = COLORS_OF_MARKS[color][:3] if color in COLORS_OF_MARKS else COLORS[color]
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]), group=group,
        rgba=[*rgb, alpha], **_SEEN,
    )  # fmt: skip


def visual(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, part: str, T: Array, color: str, **how: Any
) -> None:  # fmt: skip
    """A part of the robot as airo-models shows it."""
    vertices, faces = visual_mesh(part)
    mesh_geom(
        spec,
        body,
        name,
        f"robot_{part}",
        trimesh.Trimesh(vertices, faces, process=False),
        color,
        T=T,
        **how,
    )


def convex(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, points: NDArray[np.float32]
) -> None:
    """A convex body that collides: the hull of the points."""
    mesh = name.replace("/", "_")
    _add_mesh(
        spec,
        mesh,
        trimesh.convex.convex_hull(points.astype(np.float64), qhull_options="Pp Qt"),
        _CONVEX,
    )
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=mesh,
        group=3,
        rgba=[*COLORS["collision"], 0.4],
        mass=0.0,
    )


def _add_mesh(
    spec: mujoco.MjSpec, name: str, shape: trimesh.Trimesh, inertia: mujoco.mjtMeshInertia
) -> None:
    file = f"{name}.obj"
    if file in spec.assets:
        return
    if name.startswith("robot_"):  # the same in every trial, and large
        spec.assets[file] = _robot_file(name.removeprefix("robot_"))
    else:
        spec.assets[file] = _text(shape)
    spec.add_mesh(name=name, file=file, inertia=inertia)


@lru_cache(maxsize=16)
def _robot_file(part: str) -> bytes:
    vertices, faces = visual_mesh(part)
    return _text(trimesh.Trimesh(vertices, faces, process=False))


def _text(shape: trimesh.Trimesh) -> bytes:
    """An .obj file of the bare surface."""
    text: str = trimesh.exchange.obj.export_obj(
        shape,
        include_normals=False,
        include_color=False,
        include_texture=False,
        digits=9,
        header=None,
    )
    return text.encode()


def add_gripper_shapes(spec: mujoco.MjSpec, body: mujoco.MjsBody, robot: Robot, gap: float) -> None:
    """The planner's primitives and the gripper's meshes with the pads `gap` m apart, in the
    gripper's body."""
    poses = _gripper_from_ee(robot) @ gripper_primitives_at(robot, gap)
    for i, name in enumerate(robot.gripper.names):
        add_primitive(body, robot.gripper, i, poses[i], 1, 1, f"gripper/{name}")
    _add_gripper_visuals(spec, body, robot, gap, "gripper/", {})


def _add_gripper_visuals(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    robot: Robot,
    gap: float,
    prefix: str,
    ghost: dict[str, Any],
) -> None:
    color = "target" if ghost else "gripper"
    visual(spec, body, f"{prefix}body_visual", "body", np.eye(4), color, **ghost)
    turned = np.diag(
        [-1.0, -1.0, 1.0, 1.0]
    )  # the left finger is the right one turned about the approach axis
    seen = set()
    for part, motion, side in zip(
        robot.gripper_part, robot.gripper_motion, robot.gripper_side, strict=True
    ):
        if side == 0 or (part, side) in seen:
            continue
        seen.add((part, side))
        origin = np.eye(4)
        origin[:3, 3] = part_origin(part)
        T = (
            finger_motion(robot, motion, int(side), drive_from_gap(gap))
            @ (turned if side < 0 else np.eye(4))
            @ origin
        )
        name = f"{prefix}{'left' if side < 0 else 'right'}_{part}_visual"
        if part == "pad":  # a box in the model it comes from
            rgba = COLORS_OF_MARKS["target"] if ghost else (*COLORS["pad"], 1.0)
            body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=robot.linkage.pad_half_size, pos=T[:3, 3],
                quat=quat_wxyz(T[:3, :3]), group=ghost.get("group", VISUAL), rgba=rgba, **_SEEN,
            )  # fmt: skip
        else:
            visual(spec, body, name, part, T, color, **ghost)


def add_marks(
    spec: mujoco.MjSpec, robot: Robot, hands: Hands, trial: "TrialBodies", gripper: mujoco.MjsBody
) -> None:  # fmt: skip
    """What the criteria ask about: TCP, target with its ghost, palm, ball, fingers as they hold and
    as they come, limits."""
    limits, T_gripper_ee = trial.thresholds, _gripper_from_ee(robot)
    _frame(gripper, "ee", T_gripper_ee)
    held = trial.width_m is not None and trial.width_m <= limits.w_max_m
    squeezed = max(trial.opening_m - limits.pad_squeeze_m * held, 0.0)
    _finger_sites(gripper, robot, "holding", T_gripper_ee @ gripper_primitives_at(robot, squeezed))
    back = np.eye(4)
    back[
        1, 3
    ] = (
        -trial.shift_m
    )  # the object moved along y while the pads closed: where they stood to it before
    _finger_sites(
        gripper, robot, "coming", T_gripper_ee @ back @ gripper_primitives_at(robot, OPEN_GAP_M)
    )
    _add_target(spec, robot, trial)
    k = trial.hand_index
    point, normal = (x[k].double().numpy() for x in (hands.palm_point, hands.palm_normal))
    _frame(spec.body("hand"), "palm", _facing(point, normal))
    T_world_hand = trial.T_world_hand
    center = T_world_hand[:3, :3] @ (point + limits.reach_offset_m * normal) + T_world_hand[:3, 3]
    spec.worldbody.add_site(
        name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=center, size=[limits.reach_radius_m, 0, 0], group=MARK,
        rgba=COLORS_OF_MARKS["ball"],
    )  # fmt: skip
    numbers = {
        "opening_m": trial.opening_m, "grasp_shift_m": trial.shift_m, "width_m": trial.width_m,
        "w_max_m": limits.w_max_m, "reach_radius_m": limits.reach_radius_m, "reach_offset_m": limits.reach_offset_m,
        "safe_margin_m": limits.safe_margin_m, "pad_squeeze_m": limits.pad_squeeze_m,
    }  # fmt: skip
    for name, value in numbers.items():
        if value is not None:
            spec.add_numeric(name=name, data=[float(value)])


def _add_target(spec: mujoco.MjSpec, robot: Robot, trial: "TrialBodies") -> None:
    """The gripper and the object where they were asked to be, as a ghost (group MARK) that touches
    nothing."""
    T = trial.T_world_ee
    body = spec.worldbody.add_body(name="target", pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]))
    _frame(body, "target", np.eye(4))
    ghost: dict[str, Any] = {"group": MARK, "alpha": COLORS_OF_MARKS["target"][3]}
    T_ee_gripper = np.linalg.inv(_gripper_from_ee(robot))
    inner = body.add_body(
        name="target_gripper", pos=T_ee_gripper[:3, 3], quat=quat_wxyz(T_ee_gripper[:3, :3])
    )
    _add_gripper_visuals(spec, inner, robot, trial.opening_m, "target/", ghost)
    T_ee_obj = np.asarray(np.linalg.inv(trial.T_obj_ee), np.float64)
    mesh_geom(
        spec,
        body,
        "target/mesh_visual",
        "object_mesh",
        trial.object.mesh,
        "target",
        T=T_ee_obj,
        **ghost,
    )


def add_receiver(spec: mujoco.MjSpec, receiver: Array, *, collides: bool) -> None:
    """The receiver's arm and torso (`Trials.receiver`, (5, 4)), where the protocol has one.

    Seen; with `collides` also touched by what planning keeps off them (`EvalConfig.receiver =
    "body"`): links and object.
    """
    body = spec.worldbody.add_body(name="receiver")
    color = COLORS_OF_MARKS["receiver"]
    kinds: list[tuple[str, dict[str, Any]]] = [
        ("_visual", {"group": VISUAL, "rgba": color, **_SEEN})
    ]
    if collides:
        kinds.append(("", {"group": COLLISION, "rgba": [*color[:3], 0.4]}))
    shoulder, elbow, wrist = receiver[:3, :3]
    middle, half, x, y = receiver[3, :3], receiver[4, :3], receiver[3, 3], receiver[4, 3]
    turn = np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])
    limbs = (
        ("upper_arm", shoulder, elbow, receiver[0, 3]),
        ("forearm", elbow, wrist, receiver[1, 3]),
    )
    for ending, how in kinds:
        for name, a, b, radius in limbs:
            body.add_geom(
                name=f"receiver/{name}{ending}", type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=[*a, *b], size=[radius, 0, 0], **how,
            )  # fmt: skip
        body.add_geom(
            name=f"receiver/torso{ending}", type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=middle, quat=quat_wxyz(turn), size=half, **how,
        )  # fmt: skip


def _finger_sites(body: mujoco.MjsBody, robot: Robot, prefix: str, poses: Array) -> None:
    """The gripper's primitives as sites: they have type, size and place, and touch nothing."""
    for i, name in enumerate(robot.gripper.names):
        body.add_site(
            name=f"{prefix}/{name}", type=_TYPES[Kind(int(robot.gripper.kind[i]))], size=robot.gripper.size[i],
            pos=poses[i][:3, 3], quat=quat_wxyz(poses[i][:3, :3]), group=MARK, rgba=COLORS_OF_MARKS["fingers"],
        )  # fmt: skip


def _frame(body: mujoco.MjsBody, name: str, T: Array) -> None:
    body.add_site(
        name=name,
        pos=T[:3, 3],
        quat=quat_wxyz(T[:3, :3]),
        size=[0.004, 0, 0],
        group=MARK,
        rgba=COLORS_OF_MARKS["palm"],
    )


def _facing(point: Array, normal: Array) -> Array:
    """A frame at the point whose z is the normal."""
    T = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], normal)
    T[:3, 3] = point
    return np.asarray(T, np.float64)


def _gripper_from_ee(robot: Robot) -> Array:
    """ee in the gripper's frame."""
    return np.asarray(np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee, np.float64)
