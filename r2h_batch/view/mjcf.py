"""One trial as a folder that plain MuJoCo opens, and as MuJoCo's MjSpec.

`r2h-batch export scene RUN --trial ID --out FOLDER` writes

    scene.xml, meshes/   robot, gripper, object, hand, table; the ghost at the target, palm, ball,
                         receiver's part, fingers as they hold and as they come; key frames `home`,
                         `target` and, where there is a path, `goal`
    play.py              plays the motion with nothing but mujoco and numpy
    trajectory.csv       time_s and the joints (rad): the planned motion at 100 Hz, all waypoints
    executed.csv         the same of the simulated motion, every sample; only where one was run
    trial.json           poses, verdict, margins, witness, reasons, digests

What the planner checks are collision geoms, what one sees are visual geoms, and what the criteria
measure are sites and numbers. Joint angles 0 .. 2 pi are the robot's own; the model opens at home
(joint `ref`) and stays there: weights are compensated, and the servos (actuator group 1) are off
until `<option actuatorgroupdisable>` says otherwise.
"""

import ctypes
import json
from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import files
from itertools import combinations
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from r2h_batch.config import ExecConfig, Thresholds
from r2h_batch.scene.dynamics import (
    add_arm,
    add_body,
    add_gripper,
    new_spec,
    quat_wxyz,
)
from r2h_batch.scene.hand import load_hand_set
from r2h_batch.scene.model_parts import (
    COLLISION,
    COLORS,
    SEEN_CENTER,
    VISUAL,
    add_primitive,
    add_shown,
    link_color,
    look,
    visual_mesh,
)
from r2h_batch.scene.person import heads_of
from r2h_batch.scene.robot import (
    Robot,
    ShapeKind,
    drive_from_gap,
    finger_motion,
    gripper_primitives_at,
)
from r2h_batch.scene.robot_visuals import part_origin
from r2h_batch.scene.tables import Hands
from r2h_batch.verdicts import EVERY, SEXES
from r2h_batch.view.skin import CLOTHED, chair_of, drawn_hand, skin_of
from r2h_batch.view.stored_trial import StoredTrial

Array = NDArray[np.float64]

RATE_HZ = 100.0  # of trajectory.csv
SERVO_GROUP = 1
"""Actuator group of the six position servos. The file switches it off, so that the model stays at
home until someone asks for more."""
CAMERAS = {
    "receiver": (1.75, -0.55, 0.75),
    "side": (0.35, -1.75, 0.65),
    "above": (0.35, -0.01, 2.1),
}
"""Fixed cameras and where they stand (m, world); all look at the middle of the scene."""
_posed = lru_cache(maxsize=2)(Hands.posed)  # all hands of a set, once
DIGITS = 17
"""Digits of numbers in scene.xml: they read back to the same bits. MuJoCo writes 6 by default."""
MESHES = "meshes"
MARK = 4
"""Group of sites and geoms that are hidden by default: fingers as they hold and as they come, the
ghost at the target."""
MARK_COLORS = {
    "region": (0.95, 0.62, 0.10, 1.0), "ball": (0.20, 0.65, 0.35, 0.25),
    "target": (0.55, 0.20, 0.75, 0.35), "palm": (0.20, 0.65, 0.35, 1.0),
    "fingers": (0.9, 0.3, 0.2, 0.4), "receiver": (0.55, 0.62, 0.66, 1.0),
}  # fmt: skip
_BOX, _MESH = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH
_SPHERE, _CAPSULE = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
_TYPES = {
    ShapeKind.SPHERE: _SPHERE,
    ShapeKind.CAPSULE: _CAPSULE,
    ShapeKind.CYLINDER: _CYLINDER,
    ShapeKind.BOX: _BOX,
}
_CONVEX = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
_SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
_SEEN: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0.0}
_LEFT = np.diag([-1.0, -1.0, 1.0, 1.0])
"""The left finger is the right one turned about the approach axis."""


def export_trial(stored: StoredTrial, out: str | Path) -> Path:
    """Writes one trial as a folder that plain MuJoCo opens; replaces an earlier export there.

    Args:
        stored: the trial.
        out: the folder.

    Returns:
        The folder's path.
    """
    folder, robot = Path(out), stored.robot
    folder.mkdir(parents=True, exist_ok=True)
    write_scene(folder, spec_of(stored))
    play = files("r2h_batch.view").joinpath("play.py").read_text()
    (folder / "play.py").write_text(play, encoding="utf-8")
    _write_csv(folder / "trajectory.csv", robot.joints, *trajectory(stored))
    executed = folder / "executed.csv"
    if stored.executed_q is None:
        executed.unlink(missing_ok=True)  # of an earlier export
    else:
        time_s = stored.header["motion"]["sample_s"] * np.arange(len(stored.executed_q))
        _write_csv(executed, robot.joints, time_s, stored.executed_q)
    text = json.dumps(describe(stored), indent=1, allow_nan=False)
    (folder / "trial.json").write_text(text + "\n")
    return folder


def _write_csv(path: Path, joints: Sequence[str], time_s: Array, q: Array) -> None:
    rows = (",".join(f"{x:.9g}" for x in (t, *row)) for t, row in zip(time_s, q, strict=True))
    path.write_text("\n".join([",".join(("time_s", *joints)), *rows]) + "\n")


def trajectory(stored: StoredTrial) -> tuple[Array, Array]:
    """The planned motion: samples at `RATE_HZ` and every waypoint, in order.

    Returns:
        Times (N,) s and postures (N, joints) rad.
    """
    if not stored.moves:
        return np.zeros(1), stored.q
    ends = _waypoint_times(stored)
    even = np.arange(1, int(np.ceil(ends[-1] * RATE_HZ))) / RATE_HZ
    even = even[np.abs(even[:, None] - ends).min(1) > 1e-6]
    times = np.sort(np.concatenate([ends, even]))
    return times, posture_at(stored, times)


def posture_at(stored: StoredTrial, t: Array) -> Array:
    """Postures (N, joints) rad of the planned motion at times (N,) s."""
    speed, gain = _limits(stored)
    ends, d = _waypoint_times(stored), np.diff(stored.q, axis=0)
    k = np.clip(np.searchsorted(ends, t, side="right") - 1, 0, len(d) - 1)
    whole = (np.abs(d) * stored.robot.joint_weight).max(1)[k]
    total, passed = np.diff(ends)[k], t - ends[k]
    # a trapezoid of speed is symmetric: count from the nearer end
    near = np.minimum(passed, total - passed).clip(0)
    ramp = np.minimum(speed / gain, total / 2)
    s = np.where(near <= ramp, gain * near**2 / 2, gain * ramp**2 / 2 + speed * (near - ramp))
    s = np.where(passed <= total / 2, s, whole - s)
    share = np.divide(s, whole, out=np.zeros_like(s), where=whole > 0).clip(0, 1)
    between = stored.q[k] + share[:, None] * d[k]
    return np.where(passed[:, None] >= total[:, None], stored.q[k + 1], between)


def _waypoint_times(stored: StoredTrial) -> Array:
    """When the planned motion reaches each waypoint, s, in float64."""
    speed, gain = _limits(stored)
    d = (np.abs(np.diff(stored.q, axis=0)) * stored.robot.joint_weight).max(1)
    duration = np.where(d >= speed**2 / gain, d / speed + speed / gain, 2 * np.sqrt(d / gain))
    return np.concatenate([[0.0], np.cumsum(duration)])


def _limits(stored: StoredTrial) -> tuple[float, float]:
    """Speed (rad/s) and acceleration (rad/s^2) of the time law, of the slowest joint."""
    own = stored.header["configuration"]["execute"]
    return own["scale"] * own["max_velocity_rad_s"], own["scale"] * own["max_acceleration_rad_s2"]


def describe(stored: StoredTrial) -> dict[str, Any]:
    """The contents of trial.json. Poses are row-major 4x4 in metres; T_a_b takes coordinates in b
    to a."""
    row, header = stored.row, stored.header
    criteria = [e for e in EVERY if e.margin_column in row]
    as_stored = "trial_id object split side hand_index outcome borderline plan_reason plan_pair"
    as_stored += " width_m opening_m grasp_shift_m t_plan_s t_exec_s q_goal"
    poses = ("T_obj_ee", "T_obj_ee_attached", "T_world_ee", "T_world_hand")
    T_world_obj = stored.T_world_ee @ np.linalg.inv(stored.T_obj_ee_attached)
    return {
        **{name: row[name] for name in as_stored.split()},
        **{name: header[name] for name in ("protocol", "configuration", "digests", "versions")},
        "git_commit": header.get("git_commit"),
        "method": stored.method,
        "passed": {e.name: row[f"passed_{e.name}"] for e in criteria},
        **{
            f"margin_{unit}": {
                e.name: _finite(row[e.margin_column]) for e in criteria if e.unit == unit
            }
            for unit in dict.fromkeys(e.unit for e in criteria)
        },
        "witness": {
            "plan_part": row["witness_plan_part"],
            "safe_part": row["witness_safe_part"],
            "safe_time_s": row["witness_time_s"],
            "safe_point_world_m": row["witness_point_m"],
        },
        "poses": {
            **{name: getattr(stored, name).tolist() for name in poses},
            "T_world_obj_at_goal": T_world_obj.tolist(),
        },
        "q_target": stored.target_q.tolist(),
        "target_clearance_m": _finite(None if stored.asked is None else stored.asked.clearance_m),
        "note": stored.note,
        "waypoints": stored.q.tolist() if stored.moves else [],
        "waypoint_time_s": stored.time_s.tolist() if stored.moves else [],
    }


def _finite(value: float | None) -> float | str | None:
    """JSON has no infinities: a margin without a number is the string "-inf"."""
    return value if value is None or np.isfinite(value) else repr(float(value))


def write_scene(folder: Path, spec: mujoco.MjSpec) -> Path:
    """Writes `scene.xml` and `meshes/`, which load in plain MuJoCo from anywhere; returns the path
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
    # all digits of a number, where MuJoCo has the private switch for it; without it the file has six
    library = next(str(f) for f in sorted(Path(mujoco.__file__).parent.glob("libmujoco*")))
    set_digits = getattr(ctypes.CDLL(library), "_mjPRIVATE__set_xml_precision", lambda _: None)
    set_digits(DIGITS)
    try:
        path.write_text(spec.to_xml(), encoding="utf-8")
    finally:
        set_digits(6)
    return path


def spec_of(stored: StoredTrial) -> mujoco.MjSpec:
    """The trial ready to compile; its meshes are in `assets`.

    Key frames: `home`, `target` (the posture at the target) and, where a path leads there, `goal`.
    Contacts are left between exactly the pairs that planning checks (MuJoCo makes none between
    bodies that both stand still, as base and hand do).
    """
    robot = stored.robot
    hands = _posed(stored.hand_set or load_hand_set())
    limits = Thresholds(**stored.header["configuration"]["thresholds"])
    home, opening_m = np.array(stored.workplace.home_q), float(stored.row["opening_m"])
    spec = new_spec(ExecConfig().step_s)
    spec.modelname, spec.meshdir = "r2h_batch trial", MESHES
    # every pair is named below
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    spec.option.ccd_iterations, spec.option.ccd_tolerance = 200, 1e-9
    spec.option.disableactuator = 1 << SERVO_GROUP
    look(spec)
    _add_table(spec, stored)
    links = _add_arm(spec, robot, stored.workplace.home_q)
    gripper = add_gripper(links[-1], robot, robot.linkage.mass_kg)
    poses = _gripper_from_ee(robot) @ gripper_primitives_at(robot, opening_m)
    for i, name in enumerate(robot.gripper.names):
        add_primitive(spec, gripper, robot.gripper, i, poses[i], 1, 1, f"gripper/{name}")
    _add_gripper_visuals(spec, gripper, robot, opening_m, "gripper/")
    _add_object(spec, links[-1], robot, stored)
    _add_hand(spec, hands, stored)
    checked = checked_pairs(robot)
    for a, b in combinations((*robot.links, "object", "hand", "table"), 2):
        if frozenset((a, b)) not in checked:
            spec.add_exclude(bodyname1=a, bodyname2=b)
    _add_finger_sites(gripper, robot, stored, limits)
    _add_target(spec, robot, stored)
    _add_ball(spec, hands, stored, limits)
    _add_numbers(spec, stored, limits)
    if stored.receiver is not None:
        # with receiver "body" planning goes around arm, torso and head, so they collide here too
        judged = stored.header["configuration"].get("receiver") == "body"
        _add_receiver(spec, stored, stored.receiver, hands, collides=judged)
    for name, at in CAMERAS.items():
        quat = _towards(np.subtract(SEEN_CENTER, at))
        spec.worldbody.add_camera(name=name, pos=at, quat=quat, fovy=45.0)
    keys = {"home": home, **({"goal": stored.q[-1]} if stored.moves else {})}
    for name, q in {**keys, "target": np.asarray(stored.target_q, np.float64)}.items():
        spec.add_key(name=name, qpos=q, ctrl=q)
    return spec


def checked_pairs(robot: Robot) -> dict[frozenset[str], str]:
    """The pairs of bodies (by name) that planning keeps apart, and what `verdicts.CollidingPair`
    calls them."""
    found = {frozenset((robot.links[a], robot.links[b])): "self" for a, b in robot.self_pairs}
    found |= {frozenset(("object", robot.links[a])): "object_robot" for a in robot.object_pairs}
    found |= {frozenset((link, "hand")): "hand" for link in robot.links}
    found |= {frozenset((link, "table")): "table" for link in robot.links[robot.table_from :]}
    found[frozenset(("object", "hand"))] = "object_hand"
    found[frozenset(("object", "table"))] = "object_table"
    return found


def _towards(direction: Array) -> Array:
    """The quaternion (w, x, y, z) of a camera that looks along `direction`, its top up: MuJoCo's
    cameras look along -z."""
    back = -direction / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return quat_wxyz(np.stack([right, np.cross(back, right), back], axis=1))


def _add_table(spec: mujoco.MjSpec, stored: StoredTrial) -> None:
    table, place = spec.worldbody.add_body(name="table"), stored.workplace
    for name, group, rgba, how in (
        ("table/top", COLLISION, (*COLORS["collision"], 0.4), {}),
        ("table/top_visual", VISUAL, (*COLORS["table"], 1.0), {"contype": 0, "conaffinity": 0}),
    ):
        table.add_geom(
            name=name, type=_BOX, size=place.table_half, pos=place.table_center, group=group,
            rgba=rgba, **how,
        )  # fmt: skip


def _add_arm(spec: mujoco.MjSpec, robot: Robot, home_q: Sequence[float]) -> list[mujoco.MjsBody]:
    """Base to the last link with masses, joints and servos; the bodies stand at home and the joints say
    so (`ref`)."""
    links = add_arm(spec, robot, spec.worldbody)
    for k, body in enumerate(links):
        if k:
            c, s = np.cos(home_q[k - 1]), np.sin(home_q[k - 1])
            turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            body.quat = quat_wxyz(robot.T_parent_joint[k - 1][:3, :3] @ turn)
            body.joints[0].ref = home_q[k - 1]
            body.joints[0].damping = [1.0, 0.0, 0.0]
        for i in np.flatnonzero(robot.arm.link == k):
            name = f"robot/{robot.arm.names[i]}"
            T = robot.arm.T_link_prim[i]
            add_primitive(spec, body, robot.arm, int(i), T, 1, 1, name)
            if not robot.visuals:
                color = link_color(robot.links[k])
                add_shown(body, robot.arm, int(i), T, f"{name}_visual", color)
        link = robot.links[k]
        if robot.visuals:
            _add_part(spec, body, f"robot/{link}_visual", robot, link, np.eye(4), link)
    for servo, k in zip(spec.actuators, range(len(robot.joints)), strict=True):
        servo.group, servo.ctrlrange = SERVO_GROUP, [robot.lower[k], robot.upper[k]]
    return links


def _add_object(
    spec: mujoco.MjSpec, wrist: mujoco.MjsBody, robot: Robot, stored: StoredTrial
) -> None:
    model = stored.object_model
    T = robot.T_wrist3_flange @ robot.T_flange_ee @ np.linalg.inv(stored.T_obj_ee_attached)
    if stored.resting is not None:
        T = stored.resting
    inertia = np.asarray(model.inertia, np.float64)
    parent = wrist if stored.resting is None else spec.worldbody
    body = add_body(parent, "object", T, float(model.mass), model.com, inertia)
    if stored.header["configuration"]["plan"]["object_collision"] == "hull":
        _add_convex(spec, body, "object/hull", model.hull_vertices)
    else:
        for k, (points, _) in enumerate(model.pieces):
            _add_convex(spec, body, f"object/piece_{k}", points)
    _add_surface(spec, body, "object/mesh_visual", "object_mesh", model.mesh, "object")
    if model.receiver_face.any():
        faces = model.faces[model.receiver_face]
        region = trimesh.Trimesh(model.mesh.vertices, faces, process=False)
        region.remove_unreferenced_vertices()
        names = ("object/region_visual", "object_region")
        _add_surface(spec, body, *names, region, "region", group=MARK)


def _add_hand(spec: mujoco.MjSpec, hands: Hands, stored: StoredTrial) -> None:
    k, T = stored.row["hand_index"], stored.T_world_hand
    body = spec.worldbody.add_body(name="hand", pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]))
    for i, name in enumerate(hands.model.piece_names):
        _add_convex(spec, body, f"hand/{name}", hands.piece_points(k, i))
    skin, _ = _drawn(hands, stored)
    _add_surface(spec, body, "hand/mesh_visual", "hand_mesh", skin, "hand")


def cuff_of(stored: StoredTrial) -> Array:
    """Where the drawn hand of a person ends (E, 3), in the hand's frame, m: `view.skin.skin_of` begins there."""
    return _drawn(_posed(stored.hand_set or load_hand_set()), stored)[1]


def _drawn(hands: Hands, stored: StoredTrial) -> tuple[trimesh.Trimesh, Array]:
    """A trial's hand as it is drawn, in its frame, and where it ends: a person's begins at the wrist."""
    k = stored.row["hand_index"]
    faces = hands.model.faces_by_side[int(hands.set.side[k])].numpy()
    vertices, end = hands.vertices[k].double().numpy(), np.zeros((0, 3))
    if stored.receiver is not None:
        vertices, faces, end = drawn_hand(vertices, faces, hands.joints[k].double().numpy())
    skin = trimesh.Trimesh(vertices, faces, process=False)
    skin.remove_unreferenced_vertices()
    return skin, end


def _add_finger_sites(
    gripper: mujoco.MjsBody, robot: Robot, stored: StoredTrial, limits: Thresholds
) -> None:
    """The gripper's primitives as sites, which touch nothing: `holding/` as they squeeze the object
    and `coming/` as they come, opened, to it. And the TCP."""
    width_m, opening_m = stored.row["width_m"], float(stored.row["opening_m"])
    T_gripper_ee = _gripper_from_ee(robot)
    _add_frame(gripper, "ee", T_gripper_ee)
    held = width_m is not None and width_m <= limits.w_max_m
    squeezed_m = max(opening_m - limits.pad_squeeze_m * held, 0.0)
    back = np.eye(4)  # the object moved along y while the pads closed: where they were before
    back[1, 3] = -float(stored.row["grasp_shift_m"] or 0.0)
    for prefix, T, gap_m in (
        ("holding", T_gripper_ee, squeezed_m),
        ("coming", T_gripper_ee @ back, robot.open_gap_m),
    ):
        poses = T @ gripper_primitives_at(robot, gap_m)
        for i, name in enumerate(robot.gripper.names):
            gripper.add_site(
                name=f"{prefix}/{name}", type=_TYPES[ShapeKind(int(robot.gripper.kind[i]))],
                size=robot.gripper.size[i], pos=poses[i][:3, 3],
                quat=quat_wxyz(poses[i][:3, :3]), group=MARK, rgba=MARK_COLORS["fingers"],
            )  # fmt: skip


def _add_target(spec: mujoco.MjSpec, robot: Robot, stored: StoredTrial) -> None:
    """The gripper and the object at the target, as a ghost that touches nothing."""
    T = stored.T_world_ee
    body = spec.worldbody.add_body(name="target", pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]))
    _add_frame(body, "target", np.eye(4))
    T = np.asarray(np.linalg.inv(_gripper_from_ee(robot)), np.float64)
    inner = body.add_body(name="target_gripper", pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]))
    ghost: dict[str, Any] = {"group": MARK, "alpha": MARK_COLORS["target"][3]}
    opening_m = float(stored.row["opening_m"])
    _add_gripper_visuals(spec, inner, robot, opening_m, "target/", **ghost)
    T_ee_obj = np.asarray(np.linalg.inv(stored.T_obj_ee_attached), np.float64)
    names, mesh = ("target/mesh_visual", "object_mesh"), stored.object_model.mesh
    _add_surface(spec, body, *names, mesh, "target", T=T_ee_obj, **ghost)


def _add_ball(spec: mujoco.MjSpec, hands: Hands, stored: StoredTrial, limits: Thresholds) -> None:
    """The palm's frame (its z is the normal) and the ball in front of it."""
    k = stored.row["hand_index"]
    point, normal = (x[k].double().numpy() for x in (hands.palm_point, hands.palm_normal))
    facing = np.asarray(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], normal), np.float64)
    facing[:3, 3] = point
    _add_frame(spec.body("hand"), "palm", facing)
    # it moves with the hand
    spec.body("hand").add_site(
        name="ball", type=_SPHERE, pos=point + limits.reach_offset_m * normal, size=[limits.reach_radius_m, 0, 0], group=MARK,
        rgba=MARK_COLORS["ball"],
    )  # fmt: skip


def _add_numbers(spec: mujoco.MjSpec, stored: StoredTrial, limits: Thresholds) -> None:
    """The lengths that the criteria compare, as MuJoCo's custom numbers."""
    row = stored.row
    numbers = {
        "opening_m": row["opening_m"], "grasp_shift_m": row["grasp_shift_m"] or 0.0,
        "width_m": row["width_m"], "w_max_m": limits.w_max_m,
        "reach_radius_m": limits.reach_radius_m, "reach_offset_m": limits.reach_offset_m,
        "safe_margin_m": limits.safe_margin_m, "pad_squeeze_m": limits.pad_squeeze_m,
    }  # fmt: skip
    for name, value in numbers.items():
        if value is not None:
            spec.add_numeric(name=name, data=[float(value)])


def _add_receiver(
    spec: mujoco.MjSpec, stored: StoredTrial, receiver: Array, hands: Hands, *, collides: bool
) -> None:
    """The receiver's skin, which is only seen, and arm, torso (`Trials.receiver`, (5, 4)) and head; with `collides`
    links and object may touch these."""
    body, color = spec.worldbody.add_body(name="receiver"), MARK_COLORS["receiver"]
    k, sex = stored.row["hand_index"], stored.row.get("sex")
    palm = stored.T_world_hand[:3, :3] @ hands.palm_normal[k].double().numpy()
    left = bool(hands.set.side[k])
    who = SEXES.index(sex) if sex in SEXES else None
    T = stored.T_world_hand
    cuff = _drawn(hands, stored)[1] @ T[:3, :3].T + T[:3, 3]
    meshes = receiver_meshes(receiver, left=left, palm=palm, sex=who, cuff=cuff)
    for name, mesh in meshes.items():
        look = "receiver" if name == "clothes" else "hand"
        _add_surface(spec, body, f"receiver/{name}_visual", f"receiver_{name}", mesh, look)
    for i, (middle, half, turn) in enumerate(chair_of(receiver, left=left, sex=who)):
        body.add_geom(
            name=f"receiver/chair_{i}_visual", type=_BOX, pos=middle, quat=quat_wxyz(turn), size=half, group=VISUAL,
            rgba=[*COLORS["table"], 1.0], **_SEEN,
        )  # fmt: skip
    if not collides:
        return
    shoulder, elbow, wrist = receiver[:3, :3]
    middle, half, x, y = receiver[3, :3], receiver[4, :3], receiver[3, 3], receiver[4, 3]
    turn = np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])
    limbs = (("upper_arm", shoulder, elbow), ("forearm", elbow, wrist))
    how: dict[str, Any] = {"group": COLLISION, "rgba": (*color[:3], 0.4)}
    for (limb, a, b), radius in zip(limbs, receiver[:2, 3], strict=True):
        size = [radius + stored.room_m, 0, 0]
        body.add_geom(name=f"receiver/{limb}", type=_CAPSULE, fromto=[*a, *b], size=size, **how)
    quat, box = quat_wxyz(turn), half + stored.room_m
    body.add_geom(name="receiver/torso", type=_BOX, pos=middle, quat=quat, size=box, **how)
    low, high = heads_of(torch.from_numpy(receiver[None]).float())[0].double().numpy()
    size = [low[3] + stored.room_m + stored.head_clearance_m, 0, 0]  # the skin shows the true head
    body.add_geom(
        name="receiver/head", type=_CAPSULE, fromto=[*low[:3], *high[:3]], size=size, **how
    )


def receiver_meshes(
    receiver: Array, *, left: bool, palm: Array, sex: int | None, cuff: Array
) -> dict[str, trimesh.Trimesh]:
    """The receiver's skin as two surfaces in the world: `clothes` (one piece from shoulder to feet) and `skin`; arguments
    as of `skin_of`."""
    parts = skin_of(receiver, left=left, palm=palm, sex=sex, cuff=cuff)
    found = {}
    for name, clothed in (("clothes", True), ("skin", False)):
        own = [part for part in parts if (part in CLOTHED) == clothed]
        vertices, faces = parts[own[0]][0], np.concatenate([parts[part][1] for part in own])
        found[name] = trimesh.Trimesh(vertices, faces, process=False)
        found[name].remove_unreferenced_vertices()
    return found


def _add_gripper_visuals(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, robot: Robot, gap_m: float, prefix: str, **ghost: Any
) -> None:
    """The gripper's meshes, or the bodies of one with jaws, with the pads `gap_m` apart, in the
    gripper's body."""
    color = "target" if ghost else "gripper"
    if robot.linkage.table is not None:
        poses = _gripper_from_ee(robot) @ gripper_primitives_at(robot, gap_m)
        for i, part in enumerate(robot.gripper_part):
            rgb = COLORS["pad" if part == "pad" else "gripper"]
            name = f"{prefix}{robot.gripper.names[i]}_visual"
            rgb = MARK_COLORS["target"][:3] if ghost else rgb
            add_shown(body, robot.gripper, i, poses[i], name, rgb, **ghost)
        return
    _add_part(spec, body, f"{prefix}body_visual", robot, "body", np.eye(4), color, **ghost)
    moving = zip(robot.gripper_part, robot.gripper_motion, robot.gripper_side, strict=True)
    for part, motion, side in dict.fromkeys((p, m, int(s)) for p, m, s in moving if s):
        origin = np.eye(4)
        origin[:3, 3] = part_origin(part)
        T = finger_motion(robot, motion, side, drive_from_gap(robot, gap_m))
        T = T @ (_LEFT if side < 0 else np.eye(4)) @ origin
        name = f"{prefix}{'left' if side < 0 else 'right'}_{part}_visual"
        if part != "pad":
            _add_part(spec, body, name, robot, part, T, color, **ghost)
            continue
        rgba = MARK_COLORS["target"] if ghost else (*COLORS["pad"], 1.0)
        body.add_geom(  # a box in the model it comes from
            name=name, type=_BOX, size=robot.linkage.pad_half_size, pos=T[:3, 3],
            quat=quat_wxyz(T[:3, :3]), group=ghost.get("group", VISUAL), rgba=rgba, **_SEEN,
        )  # fmt: skip


def _add_part(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, robot: Robot, part: str, T: Array,
    color: str, **how: Any,
) -> None:  # fmt: skip
    """A part of the robot as airo-models shows it."""
    shape = trimesh.Trimesh(*visual_mesh(robot.visuals, part), process=False)
    arm = robot.visuals
    _add_surface(spec, body, name, f"robot_{part}", shape, color, T=T, arm=arm, **how)


def _add_surface(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, mesh: str, shape: trimesh.Trimesh, color: str, *,
    T: Array | None = None, group: int = VISUAL, alpha: float = 1.0, arm: str | None = None,
) -> None:  # fmt: skip
    """A surface that is only seen, at T in the body; geoms that name the same mesh share its
    file. `arm`: it is a part of that arm of airo-models."""
    T = np.eye(4) if T is None else T
    _add_mesh(spec, mesh, shape, _SHELL, arm)
    rgb = MARK_COLORS[color][:3] if color in MARK_COLORS else COLORS[color]
    body.add_geom(
        name=name, type=_MESH, meshname=mesh, pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]), group=group,
        rgba=[*rgb, alpha], **_SEEN,
    )  # fmt: skip


def _add_convex(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, points: NDArray[np.float32]
) -> None:
    """A convex body that collides: the hull of the points."""
    mesh, rgba = name.replace("/", "_"), [*COLORS["collision"], 0.4]
    hull = trimesh.convex.convex_hull(points.astype(np.float64), qhull_options="Pp Qt")
    _add_mesh(spec, mesh, hull, _CONVEX)
    body.add_geom(name=name, type=_MESH, meshname=mesh, group=COLLISION, rgba=rgba, mass=0.0)


def _add_mesh(
    spec: mujoco.MjSpec, name: str, shape: trimesh.Trimesh, inertia: mujoco.mjtMeshInertia,
    arm: str | None = None,
) -> None:  # fmt: skip
    file, part = f"{name}.obj", name.removeprefix("robot_")
    if file not in spec.assets:
        spec.assets[file] = _obj_file(shape) if arm is None else _robot_file(arm, part)
        spec.add_mesh(name=name, file=file, inertia=inertia)


@lru_cache(maxsize=16)
def _robot_file(arm: str, part: str) -> bytes:
    """The mesh of a part of the robot: the same in every trial, and large."""
    return _obj_file(trimesh.Trimesh(*visual_mesh(arm, part), process=False))


def _obj_file(shape: trimesh.Trimesh) -> bytes:
    """An .obj file of the bare surface."""
    none = dict.fromkeys(("include_normals", "include_color", "include_texture"), False)
    text: str = trimesh.exchange.obj.export_obj(shape, digits=9, header=None, **none)
    return text.encode()


def _add_frame(body: mujoco.MjsBody, name: str, T: Array) -> None:
    """A site that marks a frame."""
    body.add_site(
        name=name, pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]), size=[0.004, 0, 0], group=MARK,
        rgba=MARK_COLORS["palm"],
    )  # fmt: skip


def _gripper_from_ee(robot: Robot) -> Array:
    """ee in the gripper's frame."""
    return np.asarray(np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee, np.float64)
