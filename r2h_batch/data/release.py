"""Trials of the authors' release (GitHub robot-future/r2handoversim 0.11.0): `handover.trial.v1` files
as a benchmark with predictions and motions of ours.

Their frames: the robot's base stands at (0, 0, 0.75) m and the arm reaches to -x, hence `T_world_release`.
Their grasp frame lies between the finger tips (+Y closes, +Z approaches), ours between the pads, which
is `PADS_M` behind. Their hand frame lies in the palm (origin p_h, +Z along n_h, +X to the fingers).

    object_mesh_object, else object_boxes       the object; source_sha256 is the digest of source_path
    usage_boxes                                 the receiver's region as volumes
    T_object_gripper, executed_joints, target   grasp and handover pose of our TCP
    receiver, else palm point and normal        the palm, which decides Reach
    hand_mesh_world, else hand_boxes_world      the hand for Plan and Safe
    obstacle_boxes_world                        the table: the axis-parallel box with the largest top;
                                                the others, at most 20, are pieces of the hand's mesh;
                                                a file that names no obstacle has none
    planned_joints, executed_joints             home and the motion, of our gripper alone; why another
                                                one is left out: about.json
    id, variant                                 trials.csv, and ids.csv of a run
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import os
import re
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from r2h_batch.base import se3
from r2h_batch.base.declared import ours
from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import path_within, printable, read_file, read_json
from r2h_batch.base.io.write import csv_cell, write_npz, write_text
from r2h_batch.data.release_files import (
    MAX_BYTES,
    RIGID,
    Boxes,
    Own,
    TrialFile,
    box_faces,
    experiment_trials,
    paired_trials,
    transform_points,
    validated,
)
from r2h_batch.runs.store import IMPORTED
from r2h_batch.scene.hand import MAX_SKIN_PIECES, palm_frame
from r2h_batch.scene.mesh_import.region import faces_in_boxes
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.robot_file import DEFAULT_ROBOT, load_robot
from r2h_batch.verdicts import SIDES, SPLITS

Array = NDArray[np.float64]

T_world_release: Array = np.array(
    [[-1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, 1.0, -0.75], [0, 0, 0, 1.0]]
)
PADS_M = {"asset_mesh_pad": 0.016, "": 0.01875}
"""From the finger tips back to the middle of the pads, by the grasp's `width_policy`: the release's score
point for widths measured on its gripper's mesh, else the pads of our gripper."""
HOME_Q = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
"""The posture at the start of trials without planned joints."""
TCP_M = 0.12
"""The release's tool stands so far out of the flange; `T_tcp_asset_tool` corrects it for a gripper."""
FLAT_M = 1e-4
"""Faces of a hand that lie so near one plane make no convex piece of their own."""
LEAST_M = 1e-3
"""An object has a side of this length at least."""
END_M, END_ENTRY = 0.005, 0.01
"""How far a motion may end from the handover pose: the release's own test of Plan."""
ABOUT = "about.json"
MOST_TRIALS = 100_000
MOST_OBSTACLES = 20
"""Beside the table: each is a convex piece of the hand's mesh, which has `MAX_SKIN_PIECES`."""

NO_BOXES = Boxes(np.zeros((0, 4, 4)), np.zeros((0, 3)))
"""Obstacles of trials that name none: the release's evaluator asks a stored plan nothing about a table."""
NO_TABLE = Boxes(
    np.array([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -9.0], [0, 0, 0, 1]]]),
    np.full((1, 3), 0.001),
)
"""Stands for the table of trials without obstacles: nothing reaches it."""


@dataclass(frozen=True, eq=False)
class ReleaseTrial:
    """A trial in our frames, m and rad."""

    id: str
    object_id: str
    variant: str
    split: str
    mesh: trimesh.Trimesh
    boxes: bool  # whether the mesh stands for boxes, with which the release's evaluator judges
    region: NDArray[
        Any
    ]  # of the receiver: boxes (n, 5, 3), else bool (F,) of the faces that our exporter named
    T_obj_ee: Array
    T_world_ee: Array
    T_world_palm: Array
    side: int  # 0 right, 1 left
    own: Own | None  # the hand in our model, where our exporter wrote the trial
    hand_mesh: (
        tuple[NDArray[np.float32], NDArray[np.int32]] | None
    )  # vertices in the palm's frame, and faces
    hand_boxes: Array  # (n, 8, 3) corners in the palm's frame
    obstacles: Array  # (m, 8, 3) of the boxes beside the table, the same
    place: dict[str, Any]  # thresholds, table and home, as a benchmark file says them
    q: Array | None  # (K, 6) the executed motion; None: there is none for our gripper
    left_out: (
        str  # why the executed motion of the file is not `q`; "" if it is, or if there is none
    )
    planned_q: Array  # (P, 6) the plan, where there is a motion
    dt_s: float


def read_trials(path: Path) -> tuple[list[ReleaseTrial], int]:
    """The trials of a file or of all .json files of a folder, by name: `handover.trial.v1`, or
    selections with their scenes, or an experiment. And how many selections chose no grasp.

    Raises:
        FileError: one line that names the file and the field.
    """
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    found: list[ReleaseTrial] = []
    meshes: dict[bytes, trimesh.Trimesh] = {}
    scenes: list[tuple[Any, str]] = []
    selections: list[tuple[Any, str]] = []
    experiments: list[tuple[Any, Path]] = []

    def take(file: TrialFile, where: str) -> None:
        _check_source(file, path if path.is_dir() else path.parent, where)
        trial = _converted(file, where)
        # one copy in memory of an object that many trials have
        mesh = meshes.setdefault(_shape(trial.mesh), trial.mesh)
        found.append(replace(trial, mesh=mesh))
        if len(found) > MOST_TRIALS:
            raise FileError(f"{printable(path)}: more than {MOST_TRIALS} trials")

    for file in files:
        data = read_json(file, most=MAX_BYTES)
        rows = data if isinstance(data, list) else [data]
        for k, row in enumerate(rows):
            where = f"{printable(file)}" + (f"[{k}]" if isinstance(data, list) else "")
            kind = row.get("schema_version") if isinstance(row, dict) else None
            if kind == "handover.scene.v1":
                scenes.append((row, where))
            elif kind == "handover.selection.v1":
                selections.append((row, where))
            elif kind == "handover.experiment.v1":
                experiments.append((row, file))
            elif kind == "handover.trial.v1" or not path.is_dir():
                take(validated(row, where, TrialFile), where)
    none = 0
    made = [experiment_trials(*e) for e in experiments]
    # an experiment says which of the scenes and selections beside it belong together
    made += [] if experiments else [paired_trials(scenes, selections)]
    for trials, without in made:
        none += without
        for trial in trials:
            take(trial, f"{printable(path)}: {trial.id}")
    if not found:
        raise FileError(
            f"{printable(path)}: has no handover.trial.v1 and no selection with a scene"
        )
    if twice := sorted(i for i, k in Counter(t.id for t in found).items() if k > 1):
        raise FileError(f"{printable(path)}: two trials have the id {twice[0]!r}")
    return found, none


def _check_source(file: TrialFile, folder: Path, where: str) -> None:
    """The digest of the object's mesh file, where that file lies in the folder of the trials."""
    mesh = file.object_mesh_object
    if mesh is None or not mesh.source_sha256:
        return
    try:
        source = path_within(folder, mesh.source_path)
    except FileError:  # a path of the machine that wrote the trial
        return
    if not source.is_file():
        return
    found = hashlib.sha256(read_file(source, MAX_BYTES)).hexdigest()
    if found != mesh.source_sha256:
        raise FileError(
            f"{where}: object_mesh_object.source_sha256 is {mesh.source_sha256[:12]}...; "
            f"{printable(source)} has {found[:12]}..."
        )


def _converted(file: TrialFile, where: str) -> ReleaseTrial:
    if file.method_geometry_invalidated:
        raise FileError(f"{where}: method_geometry_invalidated is true: not this object's grasp")
    try:
        mesh, region = _object(file, where)
        place, others = _place(file)
        if len(others) > MOST_OBSTACLES:
            raise FileError(
                f"{where}: obstacle_boxes_world has {len(others)} boxes beside the table; at most "
                f"{MOST_OBSTACLES} are allowed"
            )
        side, T_world_palm = _palm(file, where)
        surface = _hand_surface(file, T_world_palm, side, where)
        obstacles = _corners(others, T_world_palm, side)
    except FileError as error:
        message = str(error)
        raise FileError(message if message.startswith(where) else f"{where}: {message}") from None
    back = _back(file)
    T_world_ee = _tool_pose(file) @ back
    own = file.own
    if own is not None and (
        len(others)  # pieces of a mesh, and a posture has none
        or np.abs(T_world_palm - own.T_world_palm).max() > RIGID
    ):
        own = None
    q, left_out, planned_q = _motion(file, T_world_ee)
    return ReleaseTrial(
        file.id, file.object_id, file.variant, file.split, mesh, file.object_mesh_object is None, region,
        file.T_object_gripper @ back, T_world_ee, T_world_release @ T_world_palm, side,
        own, *surface, obstacles, place,
        q, left_out, planned_q, file.dt_s,
    )  # fmt: skip


def along_z(z: float) -> Array:
    """The pose that is z metres along z, without a turn."""
    T = np.eye(4)
    T[2, 3] = z
    return T


def _tool_pose(file: TrialFile) -> Array:
    """Where the tool ends, our world frame: at the last executed sample, as the release judges Reach;
    at the target of a trial without a trace, or without a path."""
    if not len(file.executed_joints) or file.planning.status == "failed":
        return T_world_release @ file.target_T_world_gripper
    robot = load_robot(DEFAULT_ROBOT)
    T_world_flange = ee_pose(robot, file.executed_joints[-1]) @ np.linalg.inv(robot.T_flange_ee)
    return np.asarray(T_world_flange @ along_z(TCP_M) @ file.T_tcp_asset_tool)


def _object(file: TrialFile, where: str) -> tuple[trimesh.Trimesh, NDArray[Any]]:
    """The mesh, or the boxes side by side, and the receiver's region: the usage boxes as volumes, in S0 none."""
    if file.object_mesh_object is not None:
        vertices, faces = file.object_mesh_object.vertices, file.object_mesh_object.faces
        if faces.max() >= len(vertices):
            raise FileError(
                f"{where}: object_mesh_object.faces names vertex {faces.max()}; there are {len(vertices)}"
            )
        mesh = trimesh.Trimesh(vertices, faces, process=False)
    else:
        boxes = file.object_boxes
        mesh = trimesh.Trimesh(boxes.corners().reshape(-1, 3), box_faces(len(boxes)), process=False)
    if np.ptp(mesh.vertices, axis=0).max() < LEAST_M:
        raise FileError(f"{where}: object_mesh_object is smaller than {LEAST_M * 1e3:g} mm")
    if file.split == "S0":
        return mesh, np.zeros(len(mesh.faces), bool)
    if file.own is not None and file.own.receiver_faces is not None:
        region = np.zeros(len(mesh.faces), bool)
        if not 0 <= file.own.receiver_faces.max(initial=-1) < len(region):
            raise FileError(f"{where}: provenance.r2h_batch.receiver_faces names no face")
        region[file.own.receiver_faces] = True
        return mesh, region
    T, half = file.usage_boxes.T, file.usage_boxes.half
    if not len(T):
        raise FileError(f"{where}: usage_boxes is empty; a trial of S1 needs one or more")
    volumes = np.concatenate([T[:, None, :3, 3], half[:, None], T[:, :3, :3]], 1)
    if not faces_in_boxes(mesh.triangles_center, volumes).any():
        raise FileError(f"{where}: usage_boxes hold no face of the object")
    return mesh, volumes


def _place(file: TrialFile) -> tuple[dict[str, Any], Boxes]:
    """Thresholds, table and home as a benchmark file says them; and the obstacles beside the table.

    The table is the box along the world's axes that has the largest top.
    """
    boxes = NO_BOXES if file.obstacle_boxes_world is None else file.obstacle_boxes_world
    turn = np.abs(boxes.T[:, :3, :3])
    upright = np.abs(turn - np.round(turn)).max((1, 2), initial=0) <= RIGID
    half = np.einsum("nij,nj->ni", np.round(turn), boxes.half)
    table, half_of_table, others = NO_TABLE.T[0], NO_TABLE.half[0], np.ones(len(boxes), bool)
    if upright.any():
        largest = int(np.where(upright, half[:, 0] * half[:, 1], -1.0).argmax())
        table, half_of_table = boxes.T[largest], half[largest]
        others[largest] = False
    middle = (T_world_release @ table)[:3, 3]
    home = file.planned_joints[0] if len(file.planned_joints) else HOME_Q
    limits = {
        "reach_offset_m": file.reach_offset_m,
        "reach_radius_m": file.reach_radius_m,
        "w_max_m": file.max_opening_m,
    }
    place = {
        "thresholds": limits,
        "table": {"center": np.round(middle, 9).tolist(), "half": half_of_table.tolist()},
        "home": [round(float(x), 6) for x in home],  # float32 and float64 say one home
    }
    return place, Boxes(boxes.T[others], boxes.half[others])


def _palm(file: TrialFile, where: str) -> tuple[int, Array]:
    """Side and T_world_palm of the release's world.

    A trial without a receiver names palm point and normal only: the fingers then point along the
    horizontal across the normal, or along x where the normal is vertical.
    """
    if file.receiver is not None:
        return SIDES.index(file.receiver.side), file.receiver.T_world_hand
    normal = np.array(file.palm_normal_world)
    size = np.linalg.norm(normal)
    if size < 1e-9:
        raise FileError(f"{where}: palm_normal_world is zero")
    z = normal / size
    x = np.cross([0.0, 0.0, 1.0], z)
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], 1), file.palm_position_world
    return 0, T


def _hand_surface(
    file: TrialFile, T_world_palm: Array, side: int, where: str
) -> tuple[tuple[NDArray[np.float32], NDArray[np.int32]] | None, Array]:
    """The hand's mesh, if there is one, and the corners of its boxes, in the palm's frame."""
    boxes = _corners(file.hand_boxes_world, T_world_palm, side)
    if file.hand_mesh_world is None:
        return None, boxes
    vertices, faces = file.hand_mesh_world.vertices, file.hand_mesh_world.faces
    if faces.max() >= len(vertices):
        raise FileError(
            f"{where}: hand_mesh_world.faces names vertex {faces.max()}; there are {len(vertices)}"
        )
    skin = transform_points(np.linalg.inv(T_world_palm), vertices).astype(np.float32)
    return (skin, (faces[:, ::-1] if side else faces).astype(np.int32)), boxes


def _corners(boxes: Boxes, T_world_palm: Array, side: int) -> Array:
    """(n, 8, 3) corners in the palm's frame, in the order in which `box_faces` is a hand's of this side."""
    corners = boxes.moved(np.linalg.inv(T_world_palm)).corners()
    # faces of left hands count backwards: the sides at -x and +x change places
    return np.roll(corners, 4, 1) if side else corners


def palm_in_hand(joints: torch.Tensor, side: int) -> Array:
    """T_hand_palm of a hand with these joints (1, 16, 3): origin p_h, z = n_h, x along wrist to middle
    finger's root."""
    sides = torch.tensor([side], dtype=torch.int8, device="cpu")
    joints = joints.double()
    point, normal = (x[0].numpy() for x in palm_frame(joints, sides))
    along = (joints[0, 4] - joints[0, 0]).numpy()
    x = along - (along @ normal) * normal
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(normal, x), normal], 1), point
    return T


def _motion(file: TrialFile, T_world_ee: Array) -> tuple[Array | None, str, Array]:
    """The executed joints (else the planned ones), why they are left out, and the planned joints (else
    the executed ones).

    No executed joints where our gripper cannot follow them: they are of another tool (the
    release's box gripper is 52 mm shorter) and end elsewhere, or planning failed.
    """
    executed = file.executed_joints if len(file.executed_joints) else file.planned_joints
    planned = file.planned_joints if len(file.planned_joints) else file.executed_joints
    if not len(executed):
        return None, "", planned
    if file.planning.status == "failed":
        return None, "its planning failed", planned
    if min(len(executed), len(planned)) < 2:
        return None, "it has one sample", planned
    target = T_world_release @ file.target_T_world_gripper @ _back(file)
    for name, q, T in (("it", executed[-1], T_world_ee), ("its plan", planned[-1], target)):
        end = ee_pose(load_robot(DEFAULT_ROBOT), q)
        away = float(np.linalg.norm(end[:3, 3] - T[:3, 3]))
        turned = np.abs(end - T)[:3, :3].max() > END_ENTRY
        if away > END_M or turned:
            where = f"{1e3 * away:.0f} mm from the tool's pose" + (", turned" if turned else "")
            return (
                None,
                f"{name} ends with our gripper {where}: it is another tool's motion",
                planned,
            )
    return executed, "", planned


def _back(file: TrialFile) -> Array:
    """From the release's grasp frame to ours, along z."""
    return along_z(-PADS_M.get(file.grasp_contract.width_policy, PADS_M[""]))


def write(out: Path, trials: Sequence[ReleaseTrial]) -> dict[str, Any]:
    """benchmark.yaml with meshes and trials.npz, predictions.npz, motions.npz, trials.csv, about.json in
    `out`.

    Returns:
        counts: trials, objects, motions; hands: postures, meshes or boxes; left_out: id -> why its
        executed motion is none of ours.

    Raises:
        FileError: the trials differ in table, home or thresholds, which a benchmark has once.
    """
    place = trials[0].place
    for t in trials:
        if t.place != place:
            differing = [k for k, v in place.items() if t.place[k] != v]
            raise FileError(
                f"{t.id} has another {differing[0]} than {trials[0].id}; a benchmark has one: import "
                "them into folders of their own"
            )
    (out / "meshes").mkdir(parents=True, exist_ok=True)
    names = _write_objects(out, trials)
    entries = sorted(set(names.values()))
    ordered = [t for split in SPLITS for t in trials if t.split == split]
    count = [sum(t.split == split for t in trials) for split in SPLITS]
    ids = [2 * k + s for s, n in enumerate(count) for k in range(n)]
    form, hands = _hands(ordered)
    texts = {
        "id": np.array([t.id for t in ordered]),
        "variant": np.array([t.variant for t in ordered]),
    }
    objects = np.array([names[_key(t)] for t in ordered])
    told = ours("frame", "length_unit")
    write_npz(out / "trials.npz", {"object": objects, **hands, **texts, **told})
    answers = {
        "method": np.array("r2handoversim"),
        "trial_id": np.array(ids, np.int64),
        "T_obj_ee": _poses([t.T_obj_ee for t in ordered]),
        "T_world_ee": _poses([t.T_world_ee for t in ordered]),
        **told,
    }
    write_npz(out / "predictions.npz", answers)
    moving = sum(t.q is not None for t in ordered)
    if moving:
        write_npz(out / "motions.npz", {**answers, **_motions(ordered)})
    with (out / "trials.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["trial_id", "id", "object_id", "variant", "split"])
        for i, t in zip(ids, ordered, strict=True):
            rows.writerow([i, *map(csv_cell, (t.id, t.object_id, t.variant, t.split))])
    limits = "".join(f"  {k}: {v!r}\n" for k, v in place["thresholds"].items())
    write_text(
        out / "benchmark.yaml",
        "trials: trials.npz\n"
        f"thresholds:\n{limits}"
        f"table: {{center: {place['table']['center']}, half: {place['table']['half']}}}\n"
        f"home: {place['home']}\nobjects:\n" + "".join(_entry(out, name) for name in entries),
    )
    left_out = {t.id: t.left_out for t in ordered if t.left_out}
    about = {"boxes": all(t.boxes for t in ordered), "motions_left_out": left_out}
    write_text(out / ABOUT, json.dumps(about, indent=1) + "\n")
    return {
        "trials": len(ordered),
        "objects": len(entries),
        "motions": moving,
        "hands": form,
        "left_out": left_out,
    }


def _hands(trials: Sequence[ReleaseTrial]) -> tuple[str, dict[str, Any]]:
    """Geometry of the receivers, and its columns in a trials file: postures of our model where our
    exporter wrote every trial, else meshes of one topology, else boxes."""
    side = np.array([t.side for t in trials], np.int8)
    owned = [t.own for t in trials if t.own is not None]
    if len(owned) == len(trials):
        return "postures", {
            "T_world_hand": np.array([own.T_world_hand for own in owned]),
            "pose": np.array([own.pose for own in owned], np.float32),
            "shape": np.array([own.shape for own in owned], np.float32),
            "side": side,
        }
    meshes = [t.hand_mesh for t in trials if t.hand_mesh is not None]
    shapes = set()
    for vertices, faces in meshes:  # each face from its lowest vertex on
        at = (faces.argmin(1)[:, None] + np.arange(3)) % 3
        rows = np.ascontiguousarray(np.take_along_axis(faces, at, 1).astype(np.int64))
        shapes.add((len(vertices), np.sort(rows.view("i8,i8,i8"), axis=0).tobytes()))
    obstacles = max(len(t.obstacles) for t in trials)
    most = MAX_SKIN_PIECES - obstacles
    if len(meshes) == len(trials) and len(shapes) == 1:
        form, skins, faces = "meshes", np.stack([v for v, _ in meshes]), meshes[0][1]
        piece = _pieces(skins[0], faces, most)
    else:
        form, n = "boxes", max(len(t.hand_boxes) for t in trials)
        skins = np.stack([_repeated(t.hand_boxes, n) for t in trials])
        faces = box_faces(n)
        piece = np.repeat(np.arange(n) * min(n, most) // n, len(faces) // n)
    if obstacles:
        boxes = [t.obstacles if len(t.obstacles) else t.hand_boxes for t in trials]
        own_faces = box_faces(obstacles)
        own_piece = np.repeat(np.arange(obstacles), len(own_faces) // obstacles)
        faces = np.concatenate([faces, own_faces + skins.shape[1]])
        piece = np.concatenate([piece, own_piece + piece.max() + 1])
        skins = np.concatenate([skins, np.stack([_repeated(b, obstacles) for b in boxes])], 1)
    rounded = np.concatenate([side[:, None], skins.reshape(len(skins), -1).round(6)], 1)
    _, first, hand = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return form, {
        "T_world_hand": np.stack([t.T_world_palm for t in trials]),
        "hand": hand.reshape(-1),
        "skin": skins[first],
        "skin_side": side[first],
        "T_hand_palm": np.tile(np.eye(4), (len(first), 1, 1)),
        "skin_faces": faces,
        "skin_piece": piece,
    }


def _repeated(boxes: Array, n: int) -> Array:
    """(8 n, 3) corners of n boxes: of fewer the last one stands several times."""
    return boxes[np.minimum(np.arange(n), len(boxes) - 1)].reshape(-1, 3)


def _pieces(vertices: NDArray[Any], faces: NDArray[Any], most: int) -> NDArray[np.int64]:
    """The piece of each face: cells of the finest grid that fills at most `most` of them. Flat
    cells join the nearest one that has a volume."""
    centre = vertices[faces].mean(1)
    low, size = centre.min(0), np.ptp(centre, axis=0).max() / 2
    cell = np.zeros(len(faces), np.int64)
    while True:
        grid = ((centre - low) / size).astype(int)
        _, finer = np.unique(grid, axis=0, return_inverse=True)
        if finer.max() >= most or size < LEAST_M:
            break
        cell, size = finer.reshape(-1), size * 0.95
    middle = np.stack([centre[cell == k].mean(0) for k in range(cell.max() + 1)])
    solid = np.zeros(len(middle), bool)
    for k in range(len(middle)):  # extent across the plane that fits a cell's corners best
        points = vertices[faces[cell == k]].reshape(-1, 3)
        points = points - points.mean(0)
        flat = points @ np.linalg.svd(points, full_matrices=False)[2][2]
        solid[k] = np.ptp(flat) > FLAT_M
    if not solid.any():
        return np.zeros(len(faces), np.int64)
    apart = np.linalg.norm(middle[:, None] - middle[None, solid], axis=2)
    joined = np.flatnonzero(solid)[apart.argmin(1)][cell]
    return np.asarray(np.unique(joined, return_inverse=True)[1].reshape(-1))


def _key(t: ReleaseTrial) -> tuple[str, str, bytes, bytes]:
    return t.object_id, t.split, _shape(t.mesh), t.region.tobytes()


def _shape(mesh: trimesh.Trimesh) -> bytes:
    return hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).digest()


def _write_objects(
    out: Path, trials: Sequence[ReleaseTrial]
) -> dict[tuple[str, str, bytes, bytes], str]:
    """A mesh for each object of one shape, split and region; the name of each."""
    names: dict[tuple[str, str, bytes, bytes], str] = {}
    for t in trials:
        if (key := _key(t)) in names:
            continue
        plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", t.object_id)[:50].lstrip(".-") or "object"
        name, k = plain, 1
        while name in names.values():
            k += 1
            name = f"{plain}_{k}"
        names[key] = name
        ply = trimesh.exchange.ply.export_ply(t.mesh, include_attributes=False)
        (out / "meshes" / f"{name}.ply").write_bytes(ply)
        if t.split == "S1":
            np.save(out / "meshes" / f"{name}_receiver.npy", t.region)
    return names


def _entry(out: Path, name: str) -> str:
    held = (out / "meshes" / f"{name}_receiver.npy").exists()
    lines = [f"- file: meshes/{name}.ply", f"  name: {json.dumps(name)}"]
    lines.append(f"  split: {'S1' if held else 'S0'}")
    lines += [f"  receiver: meshes/{name}_receiver.npy"] if held else []
    return "\n".join(lines) + "\n"


def _poses(T: Sequence[Array]) -> NDArray[np.float32]:
    stacked = torch.from_numpy(np.stack(T)).float()
    return se3.orthonormalise(stacked).numpy()


def _motions(trials: Sequence[ReleaseTrial]) -> dict[str, Any]:
    """The samples of all motions one after another; a trial without one has the length 0."""
    none = np.zeros((0, 6))
    traces = [none if t.q is None else t.q for t in trials]
    plans = [none if t.q is None else t.planned_q for t in trials]
    own = all(np.array_equal(q, plan) for q, plan in zip(traces, plans))
    planned = {
        "planned_q": np.concatenate(plans).astype(np.float32),
        "planned_length": np.array([len(q) for q in plans], np.int32),
    }
    return ({} if own else planned) | {
        **ours("angle_unit", "time_unit"),
        "joint_names": np.array(load_robot(DEFAULT_ROBOT).joints),
        "q": np.concatenate(traces).astype(np.float32),
        "time_s": np.concatenate([t.dt_s * np.arange(len(q)) for t, q in zip(trials, traces)]),
        "length": np.array([len(q) for q in traces], np.int32),
    }


def imported(path: Path, out: Path) -> Path:
    """The folder in `out` that holds what `write` makes of a file or folder of trials; written once,
    and named after the files' content."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        digest.update(read_file(file, MAX_BYTES))
    folder = out / f"{IMPORTED}{digest.hexdigest()[:12]}"
    if not folder.exists():
        trials, _ = read_trials(path)
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out, prefix=".import-") as made:
            write(Path(made) / folder.name, trials)
            with contextlib.suppress(OSError):  # another part of the sweep was faster
                os.rename(Path(made) / folder.name, folder)
    return folder


@dataclass(frozen=True)
class Imported:
    """Facts of a folder of imported trials that decide how they are judged.

    Attributes:
        boxes: whether all objects are boxes in the files: the release judges them one by one.
        left_out: id -> why the executed motion of its file is not judged.
    """

    boxes: bool
    left_out: dict[str, str]


def about(folder: Path) -> Imported:
    """`about.json` of a folder that `write` made."""
    data = read_json(folder / ABOUT, most=MAX_BYTES)
    return Imported(
        bool(data["boxes"]), {str(k): str(v) for k, v in data["motions_left_out"].items()}
    )
