"""Grasps of one object in other people's files, as grasps of our own ee frame.

| file | is | frame |
|---|---|---|
| .h5, .hdf5 | ACRONYM (Eppner et al. 2021): grasps/transforms, those that held in simulation | the Panda's hand |
| .npy, N x 17 | graspnetAPI (Fang et al. 2020): [score, width, height, depth, R (9), t (3), object] | the network's input |
| .npz with points, offsets, scores | GraspNet-1Billion's grasp_label/*_labels.npz | the object's model |
| .yaml | isaac_grasp 1.0 (Isaac Sim; GraspGen's predictions): position, orientation, confidence | GRIPPER's |
| .json | GraspGen's data set (Murali et al. 2025): grasps/transforms, object_in_gripper | GRIPPER's |
| .npy, N x 4 x 4 | poses of a gripper, as any generator can write them | GRIPPER's |
| .npz | our own (`scene.grasp_set`) | ee |

A gripper's frame becomes ours by `T_obj_ee = T_obj_gripper @ T_gripper_ee`, which turns its closing
axis to our y, its approach to our z, and puts our fingertips where its are: our pads' centre is 18.75
mm (half a 2F-85 pad) behind the tips.

| GRIPPER | approach | closing | fingertips | source |
|---|---|---|---|---|
| acronym-panda | +z | x | z 0.11217 m | acronym_tools/acronym.py, create_gripper_marker |
| panda-hand | +z | y | z 0.1122 m | franka_description: fingers at z 0.0584, 0.0538 long, sliding along y |
| graspgen-franka | +z | x | z 0.1122 m | GraspGen, franka_panda.py: the same fingers, sliding along x |
| graspgen-2f-85 | +z | x | pads at half stroke | GraspGen, robotiq_2f_85.yaml: open pads at z 0.1303 m, ours at 0.1308 |
| graspgen-2f-140 | +z | x | pads at z 0.195 m | GraspGen, robotiq_2f_140.yaml: contact points |
| 2f-85-base | +z | y | pads at half stroke | this package's robot: the gripper's base, without coupling |
| ee | +z | y | our own frame | README |
| (GraspNet) | +x | y | x depth | graspnetAPI, plot_gripper_pro_max: fingers end at `depth` along x |
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable, read_json, read_npy, read_npz, read_yaml
from r2h_batch.data.arrays import numbers, rigid
from r2h_batch.data.hdf5 import read_datasets
from r2h_batch.scene.grasp_set import MAX_GRASPS, GraspSet, checked_grasps, read_grasps
from r2h_batch.scene.robot import drive_from_gap, pad_center_z
from r2h_batch.scene.robot_file import DEFAULT_ROBOT, load_robot

F64 = NDArray[np.float64]
PAD_HALF_M = 0.01875
PADS_M = {
    "acronym-panda": ("x", 0.11217 - PAD_HALF_M),
    "panda-hand": ("y", 0.1122 - PAD_HALF_M),
    "graspgen-franka": ("x", 0.1122 - PAD_HALF_M),
    "graspgen-2f-140": ("x", 0.195),
}
"""Closing axis, and the middle of our pads along z."""
OWN = ("2f-85-base", "graspgen-2f-85", "ee")
"""Frames of our own gripper: its grasps stay where they are."""
GRIPPERS = (*PADS_M, *OWN)
TURNED = {
    "acronym-panda": "panda-hand", "graspgen-franka": "panda-hand",
    "panda-hand": "acronym-panda or graspgen-franka", "2f-85": "graspgen-2f-85 or 2f-85-base",
}  # fmt: skip
"""Gripper of a `GraspSet` -> GRIPPER words for the same fingers, closing 90 degrees from its axis."""
YAML = (".yaml", ".yml")
FRAMELESS = (*YAML, ".json")
"""Files that do not say whose frame they are in: FILE:GRIPPER does."""
HDF5 = (".h5", ".hdf5")
GRASP_FILES = (".npz", *HDF5, ".npy")
"""Grasps that need no further word."""
MAX_YAML, DEEPEST, MAX_LISTED = 4 << 20, 8, 10_000

Found = tuple[GraspSet, int]
"""The grasps of a file, and how many others it holds."""


def T_gripper_ee(name: str) -> F64:
    """(4, 4) our ee frame in the frame of a gripper of `GRIPPERS`."""
    T, robot = np.eye(4), load_robot(DEFAULT_ROBOT)
    if name == "ee":
        return T
    half_open = float(pad_center_z(robot, drive_from_gap(robot, robot.open_gap_m / 2)))
    ours = {"2f-85-base": ("y", half_open), "graspgen-2f-85": ("x", half_open)}
    closing, T[2, 3] = {**PADS_M, **ours}[name]
    if closing == "x":
        T[:3, :3] = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # our y is their x
    return T


def _of_gripper(T: F64, gripper: str, where: str, **more: F64) -> GraspSet:
    """Grasps of a gripper of `GRIPPERS` in its own frame."""
    arrays = {"T_obj_ee": T @ T_gripper_ee(gripper), **more}
    return checked_grasps(arrays, where, "2f-85" if gripper in OWN else gripper)


def acronym(path: Path, **_: Any) -> Found:
    """The grasps of ACRONYM that held in simulation. Their frame is that of the object's mesh, with
    object/scale applied."""
    where, kind = printable(path), "gripper/type"
    transforms, quality = "grasps/transforms", "grasps/qualities/flex/object_in_gripper"
    most = {transforms: 16 * MAX_GRASPS, quality: MAX_GRASPS, kind: 1}
    found = read_datasets(path, most, optional=kind)
    T = numbers(found[transforms], (None, 4, 4), f"{where} {transforms}")
    held = numbers(found[quality], (len(T),), f"{where} {quality}")
    word = found[kind] if found[kind].size else np.array("panda")
    if word.dtype.kind != "U" or word.shape:
        raise FileError(f"{where}: {kind} is not a word; ACRONYM's is 'panda'")
    if word != "panda":
        raise FileError(f"{where}: gripper {printable(word)[:40]!r}; ACRONYM's is the panda")
    return _held(T, held, "acronym-panda", where)


def _held(T: F64, held: F64, gripper: str, where: str) -> Found:
    good = held > 0
    if not good.any():
        raise FileError(f"{where}: none of {len(T)} grasps held the object")
    return _of_gripper(T[good], gripper, where, score=held[good]), int((~good).sum())


def graspnet(
    path: Path, *, object_id: int | None = None, T_obj_source: F64 | None = None, **_: Any
) -> Found:
    """graspnetAPI's grasps of one object. `T_obj_source`: the frame that the network saw in the
    object's."""
    if path.suffix.lower() == ".npz":
        return _graspnet_labels(path, T_obj_source)
    where = printable(path)
    rows = numbers(read_npy(path, most=MAX_GRASPS * 17 * 8 + 4096), (None, 17), where)
    if not len(rows):
        raise FileError(f"{where}: holds no grasp (0 x 17)")
    if (odd := rows[:, 16] != np.round(rows[:, 16])).any():
        row = int(odd.argmax())
        raise FileError(f"{where}: object {rows[row, 16]:g} of row {row}; need a whole number")
    ids = sorted({int(i) for i in rows[:, 16]})
    rows_of_object = np.ones(len(rows), bool) if object_id is None else rows[:, 16] == object_id
    if not rows_of_object.any():
        raise FileError(
            f"{where}: no grasp of object {object_id}; there are {', '.join(map(str, ids[:10]))}"
        )
    if object_id is None and len(ids) > 1:
        raise FileError(f"{where}: grasps of {len(ids)} objects; choose one with --object-id")
    rows = rows[rows_of_object]
    R = rows[:, 4:13].reshape(-1, 3, 3)
    T = _graspnet_poses(R, rows[:, 13:16], rows[:, 3], T_obj_source)
    arrays = {"T_obj_ee": T, "width": rows[:, 1], "score": rows[:, 0]}
    return checked_grasps(arrays, where, "graspnet"), int((~rows_of_object).sum())


def _graspnet_poses(R: F64, t: F64, depth: F64, T_obj_source: F64 | None) -> F64:
    """R's columns are approach, closing axis and their normal; t lies `depth` before the tips."""
    approach, closing = R[:, :, 0], R[:, :, 1]
    R = np.stack([np.cross(closing, approach), closing, approach], axis=2)
    T = rigid(R, t + (depth - PAD_HALF_M)[:, None] * approach)
    return T if T_obj_source is None else np.asarray(T_obj_source @ T)


VIEWS, ANGLES, DEPTHS = 300, 12, 4
MAX_LABELS = 4 << 30
LEAST_FRICTION = 0.4
"""Grasps that hold with more friction only are left out, as graspnetAPI does by default."""
BEST = 10_000


class _Labels(NamedTuple):
    """GraspNet-1Billion's label of an object: grasps at P points from 300 views, at 12 angles and 4 depths."""

    points: F64
    """(P, 3)"""
    offsets: NDArray[Any]
    """(P, 300, 12, 4, 3) angle, depth, width"""
    score: NDArray[Any]
    """(P, 300, 12, 4) the least friction that holds, -1: none"""
    free: NDArray[np.bool_]
    """(P, 300, 12, 4) without collision; (1, 1, 1, 1): the file does not say"""


def _graspnet_labels(path: Path, T_obj_source: F64 | None) -> Found:
    """The best grasps of GraspNet-1Billion's label of an object."""
    where = printable(path)
    labels = _read_labels(path)
    best = _best(labels, where)
    arrays = _decoded(labels, best, where, T_obj_source)
    return checked_grasps(arrays, where, "graspnet"), labels.score.size - len(best)


def _read_labels(path: Path) -> _Labels:
    """The label of a file; refuses what is none."""
    where = printable(path)
    names = ("points", "offsets", "scores", "collision")
    found = read_npz(path, only=names, most=MAX_LABELS, most_each=MAX_LABELS)
    for name, kind in (("points", "f"), ("offsets", "f"), ("scores", "f"), ("collision", "b")):
        if name in found and found[name].dtype.kind == kind:
            continue
        if name != "collision":
            raise FileError(f"{where}: has no {name}; it is no label of GraspNet or ours")
    points = numbers(found["points"], (None, 3), f"{where} points")
    grid = (len(points), VIEWS, ANGLES, DEPTHS)
    score, offsets = found["scores"], found["offsets"]
    free = ~found["collision"] if "collision" in found else np.ones((1, 1, 1, 1), bool)
    if score.shape != grid or offsets.shape != (*grid, 3) or free.shape not in (grid, (1,) * 4):
        raise FileError(f"{where}: scores are {score.shape}; need {' x '.join(map(str, grid))}")
    return _Labels(points, offsets, score, free)


def _best(labels: _Labels, where: str) -> NDArray[np.intp]:
    """The `BEST` grasps that hold with the least friction, as indices into the flat score."""
    score = labels.score
    good = np.flatnonzero((score > 0) & (score <= LEAST_FRICTION) & labels.free)
    if not len(good):
        raise FileError(f"{where}: no grasp holds with a friction of {LEAST_FRICTION}")
    return good[np.argsort(score.ravel()[good], kind="stable")[:BEST]]


def _decoded(
    labels: _Labels, rows: NDArray[np.intp], where: str, T_obj_source: F64 | None
) -> dict[str, F64]:
    """The arrays of a `GraspSet` of some of the grasps, by their indices into the flat score."""
    point, view, _, _ = np.unravel_index(rows, labels.score.shape)
    offsets = labels.offsets.reshape(-1, 3)[rows]
    angle, depth, width = numbers(offsets, (None, 3), f"{where} offsets").T
    from scipy.spatial.transform import Rotation  # 0.4 s: benchmarks without such files need none

    R = _views()[view] @ Rotation.from_rotvec(np.outer(angle, [1.0, 0.0, 0.0])).as_matrix()
    T = _graspnet_poses(R, labels.points[point], depth, T_obj_source)
    score = 1.1 - labels.score.ravel()[rows].astype(np.float64)
    return {"T_obj_ee": T, "width": width, "score": score}


def _views() -> F64:
    """(300, 3, 3) rotations whose x approaches from the views of a Fibonacci lattice on the sphere,
    with y level."""
    i = np.arange(VIEWS)
    z = (2 * i + 1) / VIEWS - 1
    turn = 2 * np.pi * i * (np.sqrt(5) - 1) / 2
    x = -np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    y = np.stack([-x[:, 1], x[:, 0], np.zeros(VIEWS)], 1)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=2)


def isaac(path: Path, *, gripper: str, **_: Any) -> Found:
    """The grasps of an isaac_grasp file: (w, xyz) and position are the gripper's frame in the
    object's. Which frame that is stands nowhere a program could rely on."""
    where, found = printable(path), read_yaml(path, most=MAX_YAML, deepest=DEEPEST)
    if found.get("format") != "isaac_grasp" or float(found.get("format_version") or 0) != 1.0:
        raise FileError(f"{where}: format is not isaac_grasp 1.0")
    grasps = found.get("grasps")
    if not isinstance(grasps, dict) or not 1 <= len(grasps) <= MAX_LISTED:
        raise FileError(f"{where}: needs 1 to {MAX_LISTED} named grasps")
    from scipy.spatial.transform import Rotation

    T, score = np.tile(np.eye(4), (len(grasps), 1, 1)), np.zeros(len(grasps))
    for i, (name, grasp) in enumerate(grasps.items()):
        at = f"{where}: {printable(name)[:40]}"
        turn = grasp.get("orientation") if isinstance(grasp, dict) else None
        if not isinstance(grasp, dict) or not isinstance(turn, dict):
            raise FileError(f"{at} has no orientation with w and xyz")
        q = numbers([*_list(turn.get("xyz")), *_list([turn.get("w")])], (4,), f"{at} orientation")
        if abs(np.linalg.norm(q) - 1) > 1e-2:
            raise FileError(f"{at} orientation is not a rotation")
        T[i, :3, :3] = Rotation.from_quat(q).as_matrix()
        T[i, :3, 3] = numbers(grasp.get("position"), (3,), f"{at} position")
        score[i] = float(numbers([grasp.get("confidence", 1.0)], (1,), f"{at} confidence")[0])
    return _of_gripper(T, gripper, where, score=score), 0


def _list(value: object) -> list[object]:
    return value if isinstance(value, list) and len(value) <= 4 else [None]


def graspgen(path: Path, *, gripper: str, **_: Any) -> Found:
    """The grasps of a file of GraspGen's data set that held in simulation."""
    where, found = printable(path), read_json(path)
    grasps = found.get("grasps") if isinstance(found, dict) else None
    if not isinstance(grasps, dict):
        raise FileError(f"{where}: has no grasps with transforms; it is not GraspGen's")
    T = numbers(grasps.get("transforms"), (None, 4, 4), f"{where} transforms")
    held = numbers(grasps.get("object_in_gripper"), (len(T),), f"{where} object_in_gripper")
    return _held(T, held, gripper, where)


def poses(path: Path, *, gripper: str, **_: Any) -> Found:
    """Poses (N, 4, 4) of a gripper, best first."""
    where = printable(path)
    T = numbers(read_npy(path, most=MAX_GRASPS * 128 + 4096), (None, 4, 4), where)
    return _of_gripper(T, gripper, where, score=np.linspace(1.0, 0.0, len(T))), 0


def own(path: Path, **_: Any) -> Found:
    """Our own format."""
    return read_grasps(path), 0


SOURCES: dict[str, Callable[..., Found]] = {
    "acronym": acronym, "graspnet": graspnet, "graspgen": graspgen, "isaac": isaac, "poses": poses, "own": own,
}  # fmt: skip
NEED_GRIPPER = ("graspgen", "isaac", "poses")


def read_file_of(source: str, path: Path, gripper: str | None = None, **more: Any) -> Found:
    """The grasps of a file, and how many others it holds.

    Args:
        source: one of `SOURCES`.
        path: the file.
        gripper: one of `GRIPPERS`, for a source of `NEED_GRIPPER`; others say it themselves.
        more: what one source alone takes: `object_id`, `T_obj_source` of graspnet.

    Raises:
        FileError: one line: the file, the source or the gripper is none of these.
    """
    where = printable(path)
    if source not in SOURCES:
        close = nearest(source, list(SOURCES))
        raise FileError(
            f"{where}: no source is called {printable(source)[:60]!r}{close}; allowed are {', '.join(SOURCES)}"
        )
    if source == "isaac" and path.suffix.lower() == ".json":
        source = "graspgen"
    if source not in NEED_GRIPPER:
        if gripper is not None:
            raise FileError(
                f"{where}: says itself whose grasps it holds; leave {printable(gripper)[:60]} out"
            )
    elif gripper is None:
        allowed = ", ".join(GRIPPERS)
        raise FileError(
            f"{where}: does not say whose frame it is in; say --gripper, or FILE:GRIPPER, one of {allowed}"
        )
    else:
        _check_gripper(gripper, where)
    return SOURCES[source](path, gripper=gripper, **more)


def _check_gripper(gripper: str, where: str) -> None:
    if gripper in GRIPPERS:
        return
    named, allowed = printable(gripper)[:60], ", ".join(GRIPPERS)
    if gripper in TURNED:  # a gripper, whose frame has several places
        raise FileError(
            f"{where}: {named!r} has several frames; say {TURNED[gripper]}; allowed are {allowed}"
        )
    close = nearest(gripper.lower(), GRIPPERS)
    raise FileError(f"{where}: {named!r} is not a gripper{close}; allowed are {allowed}")


def grasps_from(argument: str | Path) -> GraspSet:
    """The grasps of FILE, or of FILE:GRIPPER for a file that does not say whose frame it is in; what
    had to be left out is told on stderr. Raises `FileError`, one line."""
    path, gripper = without_gripper(argument)
    where, ending = printable(path), path.suffix.lower()
    source = {".json": "graspgen", **dict.fromkeys(YAML, "isaac"), **dict.fromkeys(HDF5, "acronym")}
    kind = source.get(ending, "own")
    if ending == ".npy":
        kind = "poses" if gripper else "graspnet"
    elif path.name.endswith("_labels.npz"):
        kind = "graspnet"
    found, left_out = read_file_of(kind, path, gripper or None)
    if left_out:
        LOG.info(
            f"{where}: {len(found)} grasps of the {found.gripper}; {left_out} left out, which did not hold or are worse"
        )
    return found


def without_gripper(argument: str | Path) -> tuple[Path, str]:
    """FILE and GRIPPER of FILE:GRIPPER; the gripper is empty where none is named, a `FileError`
    where it is not a gripper."""
    text, _, gripper = str(argument).rpartition(":")
    if text and gripper in GRIPPERS:
        return Path(text), gripper
    if text.lower().endswith(FRAMELESS):
        _check_gripper(gripper, printable(argument))
    return Path(argument), ""
