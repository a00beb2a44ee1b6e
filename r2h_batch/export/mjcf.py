"""A trial as MuJoCo's MjSpec, and as a folder that any MuJoCo opens: what the planner checks as
collision geoms, what one sees as visual geoms, and what the criteria ask about as sites and
numbers.

Everything stands in `T_world_obj` of the posture: the object hangs on wrist_3 as it is attached.
Joint angles 0 .. 2 pi are the robot's own; the model opens at home (joint `ref`), where it stays:
weights are compensated, the servos (actuator group 1) are off until `<option actuatorgroupdisable>`
says otherwise.
"""

import ctypes
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.bodies.objects import ObjectModel
from r2h_batch.bodies.robot import Robot
from r2h_batch.config import ExecConfig, Thresholds, Workplace
from r2h_batch.export.mjcf_parts import (
    MARK,
    MESHES,
    add_gripper_shapes,
    add_marks,
    add_receiver,
    convex,
    mesh_geom,
    visual,
)
from r2h_batch.scene.dynamics import (
    GRIPPER_MASS_KG,
    add_arm,
    add_body,
    add_gripper,
    new_spec,
    quat_wxyz,
)
from r2h_batch.scene.model_parts import COLLISION, COLORS, SEEN_CENTER, VISUAL, add_primitive, look
from r2h_batch.scene.tables import TABLE_FROM_LINK, Hands

Array = NDArray[np.float64]

SERVO_GROUP = 1
"""Of the six position servos: switched off in the file, so that the model stays at home until
someone asks for more."""
CAMERAS = {
    "receiver": (1.75, -0.55, 0.75),
    "side": (0.35, -1.75, 0.65),
    "above": (0.35, -0.01, 2.1),
}
"""Fixed cameras and where they stand (m, world); all look at the middle of the scene."""
DIGITS = 17
"""Of numbers in scene.xml: they read back to the same bits. MuJoCo writes 6 unless told."""


@dataclass(frozen=True)
class TrialBodies:
    """Where one trial's bodies are: `T_obj_ee` as attached (after closing), hand in the world, gap
    between the pads; and what was asked: the handover `T_world_ee`, how far closing moved the
    object along the pads' axis (m), the limits."""

    object: ObjectModel
    object_collision: str  # "hull" or "pieces", as planned with
    hand_index: int
    T_obj_ee: Array
    T_world_hand: Array
    opening_m: float
    T_world_ee: Array
    shift_m: float = 0.0
    width_m: float | None = None  # None: nothing between the pads
    thresholds: Thresholds = field(default_factory=Thresholds)
    workplace: Workplace = field(default_factory=Workplace)
    receiver: Array | None = None  # (5, 4) as in Trials.receiver
    # `EvalConfig.receiver = "body"`: arm and torso are planned around, so they collide here too
    receiver_judged: bool = False


def trial_spec(
    robot: Robot, hands: Hands, trial: TrialBodies, keyframes: Iterable[tuple[str, Array]] = ()
) -> mujoco.MjSpec:
    """The trial, ready to compile; its meshes are in `assets`. Contacts are left between exactly
    the pairs that planning checks (MuJoCo makes none between bodies that both stand still, as base
    and hand do)."""
    spec = new_spec(ExecConfig().step_s)
    spec.modelname, spec.meshdir = "r2h_batch trial", MESHES
    spec.option.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    )  # every pair is named below
    spec.option.ccd_iterations, spec.option.ccd_tolerance = 200, 1e-9
    spec.option.disableactuator = 1 << SERVO_GROUP
    look(spec)
    _add_table(spec, trial.workplace)
    links = _add_arm(spec, robot, trial.workplace.home_q)
    gripper = add_gripper(links[-1], robot, GRIPPER_MASS_KG)
    add_gripper_shapes(spec, gripper, robot, trial.opening_m)
    _add_object(spec, links[-1], robot, trial)
    _add_hand(spec, hands, trial)
    _add_exclusions(spec, robot)
    add_marks(spec, robot, hands, trial, gripper)
    if trial.receiver is not None:
        add_receiver(spec, trial.receiver, collides=trial.receiver_judged)
    for name, at in CAMERAS.items():
        spec.worldbody.add_camera(
            name=name, pos=at, quat=_towards(np.subtract(SEEN_CENTER, at)), fovy=45.0
        )
    for name, q in keyframes:
        spec.add_key(name=name, qpos=np.asarray(q, np.float64), ctrl=np.asarray(q, np.float64))
    return spec


def write_scene(folder: Path, spec: mujoco.MjSpec) -> Path:
    """`scene.xml` and `meshes/` in `folder`: loads in plain MuJoCo from anywhere. Returns the path
    of scene.xml."""
    spec.compile()
    meshes = folder / MESHES
    meshes.mkdir(parents=True, exist_ok=True)
    for old in meshes.iterdir():  # of an earlier export
        if old.is_file() and old.name not in spec.assets:
            old.unlink()
    for name, content in spec.assets.items():
        (meshes / name).write_bytes(content)
    path = folder / "scene.xml"
    with _all_digits():
        path.write_text(spec.to_xml(), encoding="utf-8")
    return path


@contextmanager
def _all_digits() -> Iterator[None]:
    """MuJoCo writes numbers with all their digits in here, where its library lets itself be told
    (mju, private)."""
    library = ctypes.CDLL(
        next(str(f) for f in sorted(Path(mujoco.__file__).parent.glob("libmujoco*")))
    )
    told = getattr(library, "_mjPRIVATE__set_xml_precision", None)
    if told is None:
        yield
        return
    told(DIGITS)
    try:
        yield
    finally:
        told(6)


def _towards(direction: Array) -> Array:
    """The quaternion (w, x, y, z) of a camera that looks along `direction`, its top up: MuJoCo's
    cameras look along -z."""
    back = -direction / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return quat_wxyz(np.stack([right, np.cross(back, right), back], axis=1))


def _add_table(spec: mujoco.MjSpec, place: Workplace) -> None:
    table = spec.worldbody.add_body(name="table")
    for name, group, color in (
        ("table/top", COLLISION, "collision"),
        ("table/top_visual", VISUAL, "table"),
    ):
        seen = {"contype": 0, "conaffinity": 0} if group == VISUAL else {}
        table.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=place.table_half, pos=place.table_center, group=group,
            rgba=[*COLORS[color], 1.0 if group == VISUAL else 0.4], **seen,
        )  # fmt: skip


def _add_arm(spec: mujoco.MjSpec, robot: Robot, home_q: Sequence[float]) -> list[mujoco.MjsBody]:
    """Base to wrist_3 with masses, joints and servos; the bodies stand at home and the joints say
    so (`ref`)."""
    links = add_arm(spec, robot, spec.worldbody)
    for k, body in enumerate(links):
        if k:
            turn = np.array(
                [[np.cos(a := home_q[k - 1]), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]
            )
            body.quat = quat_wxyz(robot.T_parent_joint[k - 1][:3, :3] @ turn)
            body.joints[0].ref = home_q[k - 1]
            body.joints[0].damping = [1.0, 0.0, 0.0]
        for i in np.flatnonzero(robot.arm.link == k):
            add_primitive(
                body,
                robot.arm,
                int(i),
                robot.arm.T_link_prim[i],
                1,
                1,
                f"robot/{robot.arm.names[i]}",
            )
        visual(
            spec, body, f"robot/{robot.links[k]}_visual", robot.links[k], np.eye(4), robot.links[k]
        )
    for servo, k in zip(spec.actuators, range(len(robot.joints)), strict=True):
        servo.group = SERVO_GROUP
        servo.ctrlrange = [robot.lower[k], robot.upper[k]]
    return links


def _add_object(
    spec: mujoco.MjSpec, wrist: mujoco.MjsBody, robot: Robot, trial: TrialBodies
) -> None:
    model = trial.object
    T = robot.T_wrist3_flange @ robot.T_flange_ee @ np.linalg.inv(trial.T_obj_ee)
    body = add_body(
        wrist, "object", T, float(model.mass), model.com, np.asarray(model.inertia, np.float64)
    )
    if trial.object_collision == "hull":
        convex(spec, body, "object/hull", model.hull_vertices)
    else:
        for k, (points, _) in enumerate(model.pieces):
            convex(spec, body, f"object/piece_{k}", points)
    mesh_geom(spec, body, "object/mesh_visual", "object_mesh", model.mesh, "object")
    if model.receiver_face.any():
        region = trimesh.Trimesh(
            model.mesh.vertices, model.faces[model.receiver_face], process=False
        )
        region.remove_unreferenced_vertices()
        mesh_geom(spec, body, "object/region_visual", "object_region", region, "region", group=MARK)


def _add_hand(spec: mujoco.MjSpec, hands: Hands, trial: TrialBodies) -> None:
    k, T = trial.hand_index, trial.T_world_hand
    body = spec.worldbody.add_body(name="hand", pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]))
    for i, name in enumerate(hands.model.piece_names):
        convex(spec, body, f"hand/{name}", hands.piece_points(k, i))
    faces = hands.model.faces_by_side[int(hands.set.side[k])].numpy()
    skin = trimesh.Trimesh(hands.vertices[k].double().numpy(), faces, process=False)
    mesh_geom(spec, body, "hand/mesh_visual", "hand_mesh", skin, "hand")


def _add_exclusions(spec: mujoco.MjSpec, robot: Robot) -> None:
    checked = checked_pairs(robot)
    for a, b in combinations((*robot.links, "object", "hand", "table"), 2):
        if frozenset((a, b)) not in checked:
            spec.add_exclude(bodyname1=a, bodyname2=b)


def checked_pairs(robot: Robot) -> dict[frozenset[str], str]:
    """The pairs of bodies (by name) that planning keeps apart, and what `verdicts.CollidingPair`
    calls them."""
    found = {frozenset((robot.links[a], robot.links[b])): "self" for a, b in robot.self_pairs}
    found |= {frozenset(("object", robot.links[a])): "object_robot" for a in robot.object_pairs}
    found |= {frozenset((link, "hand")): "hand" for link in robot.links}
    found |= {frozenset((link, "table")): "table" for link in robot.links[TABLE_FROM_LINK:]}
    return found | {
        frozenset(("object", "hand")): "object_hand",
        frozenset(("object", "table")): "object_table",
    }
