"""The data sets of hands, as their own tools read them: the motions of hands in files of GRAB, ARCTIC,
H2O, DexYCB and OakInk-Shape.

`DATA_SETS` has an entry for each: where its sequences are, and what reads one. A reader returns the
hands of a sequence; the text above it says what the files hold.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import path_within, printable, read_file, read_json, read_npz, read_yaml
from r2h_batch.data.arrays import files_below, numbers, rigid
from r2h_batch.data.mano import ManoHand
from r2h_batch.data.safe_pickle import read_npy, read_pickle, read_pickle_file
from r2h_batch.data.smplx import Bodies
from r2h_batch.scene.hand import LEFT, RIGHT

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HandMotion:
    """One hand through F frames, metres, in the source's world frame; fingers as full turns about
    the flat hand."""

    source: str
    """which sequence of which data set: enough to find it again"""
    side: int
    """0 right, 1 left"""
    T_world_hand: F64
    """(F, 4, 4) wrist joint, turned as MANO's global orientation"""
    fingers: F64
    """(F, 45)"""
    shape: F64
    """(10,)"""
    rate_hz: float = 0.0
    """0: a single posture or unknown"""
    instruction: str = ""
    object_name: str = ""
    T_world_object: F64 | None = None
    """(F, 4, 4)"""
    facing: F64 | None = None
    """(F, 3) unit vector that the body's chest points along; None: the data do not know the body"""
    up: F64 | None = None
    """(3,) unit vector against gravity; None: unknown"""
    arm: F64 | None = None
    """(F, 3, 3) the body's shoulder, elbow and wrist on this side; None: unknown"""


Reader = Callable[[Path, ManoHand | None, Bodies | None], list[HandMotion]]


@dataclass(frozen=True)
class DataSet:
    """Where the sequences of a data set are, and what reads one."""

    pattern: str
    """of the sequences below the data set's folder"""
    wanted: str
    """regular expression of a sequence's name with the folder it is in: a subject's may be given"""
    read: Reader
    preferred: str = ".*"
    """the same of those to take alone, where there are some"""

    def find(self, folder: Path) -> list[Path]:
        """The sequences below the folder. Raises `FileError` where there is none."""
        found = files_below(folder, f"**/{self.pattern}")
        names = {p: f"{p.resolve().parent.name}/{p.name}" for p in found}
        fits = [p for p in found if re.fullmatch(self.wanted, names[p])]
        if not fits:
            raise FileError(
                f"{printable(folder)}: no {self.pattern} in it is called {self.wanted}; is it the right folder?"
            )
        return [p for p in fits if re.fullmatch(self.preferred, names[p])] or fits


def _motion(
    source: str,
    hand: ManoHand | None,
    side: int,
    columns: Sequence[F64],
    shape: F64,
    *,
    flat: bool,
    components: bool = False,
    **more: Any,
) -> HandMotion:
    """A hand's motion from MANO's parameters as files hold them.

    Args:
        columns: (F, 3) global orientation, (F, 3) translation, and (F, 45) turns about the flat
            hand (`flat`) or the mean hand, or `components`.
        shape: (10,)
        **more: other fields of `HandMotion`.
    """
    turn, transl, postures = columns
    sides = np.full(len(turn), side)
    fingers = postures
    if components or not flat:
        if hand is None:
            what = "principal components" if components else "about the mean hand"
            raise FileError(
                f"{source}: postures are {what}; give MANO's file with --mano-right or --mano-left"
            )
        model = hand.model
        assert model.pose_mean is not None
        if components:
            of = torch.from_numpy(sides)
            full = model.full_pose(torch.from_numpy(postures), of, flat_hand_mean=flat)
            fingers = full.double().numpy()
        else:
            fingers = postures + model.pose_mean.double().numpy()[side]
    place = transl if hand is None else hand.wrist(transl, np.tile(shape, (len(sides), 1)), sides)
    T = rigid(Rotation.from_rotvec(turn).as_matrix(), place)
    return HandMotion(source, side, T, fingers, shape, **more)


def name_of(text: str) -> str:
    """A name that a benchmark file allows."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", text.strip())[:64]
    return name if re.match(r"[A-Za-z0-9_]", name) else f"_{name}"[:64]


# ---- GRAB (Taheri et al. 2020): grab/s*/OBJECT_ACTION_N.npz, 120 Hz, both hands of a whole body.
#
# Full postures about the flat hand (`fullpose`). A hand's shape is a mesh of the subject (`vtemp`,
# relative to the folder above grab/). The object's turn is applied as `vertices @ R + t`, so that
# T_world_object has R transposed. The world's z points up. SMPL-X' chest points along z of its
# root's frame. GRAB's save_grab_vertices.py puts *_verts_*.npz beside the sequences.

GRAB = ("rhand", "lhand", "object", "body", "obj_name", "motion_intent", "framerate")
GENDER = "gender"
GRAB_BYTES = 2 << 30
"""Largest file: it also holds contact labels of every vertex, of which nothing is read."""
FAR_SHAPE_M = 0.005


def _grab(path: Path, hand: ManoHand | None, bodies: Bodies | None) -> list[HandMotion]:
    where = f"grab:{path.parent.name}/{path.stem}"
    found = read_npz(path, objects=read_pickle, only=(*GRAB, GENDER), most=GRAB_BYTES)
    if missing := [k for k in GRAB if k not in found]:
        raise FileError(f"{where}: has no {missing[0]}; it is not a sequence of GRAB")
    name, intent = str(found["obj_name"]), str(found["motion_intent"])
    rate = float(numbers(found["framerate"], (), f"{where} framerate"))
    turn, place = (
        _parameter(found["object"], k, 3, f"{where} object") for k in ("global_orient", "transl")
    )
    T = rigid(Rotation.from_rotvec(turn).inv().as_matrix(), place)
    body = _parameter(found["body"], "global_orient", 3, f"{where} body")
    facing = Rotation.from_rotvec(body).as_matrix()[:, :, 2]
    root, arms = path.resolve().parents[2], None
    if bodies is not None:
        more = (("transl", 3), ("body_pose", 63))
        own = [_parameter(found["body"], k, n, f"{where} body") for k, n in more]
        mesh = str(found["body"].get("vtemp"))
        arms = bodies.arms(str(found.get(GENDER)), root, mesh, (body, *own))
    hands = []
    for key, side in (("rhand", RIGHT), ("lhand", LEFT)):
        columns = [
            _parameter(found[key], k, n, f"{where} {key}")
            for k, n in (("global_orient", 3), ("transl", 3), ("fullpose", 45))
        ]
        if len({len(turn), len(body), *map(len, columns)}) != 1:
            raise FileError(f"{where}: {key}, body and object have different numbers of frames")
        mesh = str(found[key].get("vtemp")) if hand else "meshes of subjects"
        shape = _subject_shape(root, mesh, hand, side if hand else RIGHT)
        hands.append(
            _motion(where, hand, side, columns, shape, flat=True, rate_hz=rate, object_name=name,
                    instruction=f"{intent} the {name}", T_world_object=T, facing=facing, up=np.array([0.0, 0.0, 1.0]),
                    arm=None if arms is None else arms[side])
        )  # fmt: skip
    return hands


def _parameter(found: Any, name: str, width: int, where: str) -> F64:
    parameters = found.get("params") if isinstance(found, Mapping) else None
    if not isinstance(parameters, Mapping) or name not in parameters:
        raise FileError(f"{where}: has no params/{name}")
    return numbers(parameters[name], (None, width), f"{where} {name}")


@lru_cache(maxsize=64)
def _subject_shape(root: Path, mesh: str, hand: ManoHand | None, side: int) -> F64:
    """MANO's shape numbers of a subject's own hand mesh; 0 without MANO or without the mesh."""
    from r2h_batch.scene.mesh_import.file import load_mesh_file

    try:
        if hand is None:
            raise FileError("need MANO's files, --mano-right and --mano-left")
        file = path_within(root, mesh)
        if not file.is_file():
            raise FileError(f"not in {root}")
        shape, off = hand.shape_of(load_mesh_file(file, mesh).vertices, side)
    except ValueError as error:
        LOG.info(f"grab: {printable(mesh)}: {printable(error)}; their hands get the shape 0")
        return np.zeros(10)
    if off > FAR_SHAPE_M:
        LOG.info(f"grab: {printable(mesh)}: MANO's shapes come within {1e3 * off:.1f} mm of it")
    return shape


# ---- ARCTIC (Fan et al. 2023): raw_seqs/sXX/OBJECT_ACTION_N.mano.npy, .object.npy, .smplx.npy, 30 Hz.
#
# Postures about MANO's mean hand. Object rows of [articulation rad, axis-angle, millimetres]. The
# body's facing is that of its SMPL-X root; meta/misc.json beside raw_seqs/ says its gender, its mesh is
# meta/subject_vtemplates/sXX.obj.


def _arctic(path: Path, hand: ManoHand | None, bodies: Bodies | None) -> list[HandMotion]:
    stem = path.name.removesuffix(".mano.npy")
    where = f"arctic:{path.parent.name}/{stem}"
    found = read_npy(path)
    if not isinstance(found, Mapping):
        raise FileError(f"{where}: holds no dictionary; it is not a sequence of ARCTIC")
    rows = numbers(read_npy(path.with_name(f"{stem}.object.npy")), (None, 7), f"{where} object")
    T = rigid(Rotation.from_rotvec(rows[:, 1:4]).as_matrix(), rows[:, 4:] / 1000)
    facing, up, arms = _arctic_body(path.with_name(f"{stem}.smplx.npy"), len(rows), where, bodies)
    name, _, action = stem.partition("_")
    hands = []
    for key, side in (("right", RIGHT), ("left", LEFT)):
        part = found.get(key)
        if not isinstance(part, Mapping):
            raise FileError(f"{where}: has no {key} hand")
        columns = [
            numbers(part.get(k), (None, n), f"{where} {key} {k}")
            for k, n in (("rot", 3), ("trans", 3), ("pose", 45))
        ]
        if len({len(rows), *map(len, columns)}) != 1:
            raise FileError(f"{where}: hand and object have different numbers of frames")
        shape = numbers(part.get("shape"), (10,), f"{where} {key} shape")
        verb = action.partition("_")[0] or "use"
        hands.append(
            _motion(where, hand, side, columns, shape, flat=False, rate_hz=30.0, object_name=name,
                    instruction=f"{verb} the {name}", T_world_object=T, facing=facing, up=up,
                    arm=None if arms is None else arms[side])
        )  # fmt: skip
    return hands


def _arctic_body(
    path: Path, frames: int, where: str, bodies: Bodies | None
) -> tuple[F64 | None, F64 | None, F64 | None]:
    """The chest's direction, the world's axis that the body stands along, and its arms."""
    if not path.is_file():
        return None, None, None
    found = read_npy(path)
    found = found if isinstance(found, Mapping) else {}
    turn = numbers(found.get("global_orient"), (None, 3), f"{where} body")
    if len(turn) != frames:
        raise FileError(f"{where}: body and object have different numbers of frames")
    arms = None
    if bodies is not None:
        meta, subject = path.resolve().parents[2] / "meta", path.parent.name
        own = [
            numbers(found.get(k), (frames, n), f"{where} {k}")
            for k, n in (("transl", 3), ("body_pose", 63))
        ]
        mesh = f"subject_vtemplates/{subject}.obj"
        arms = bodies.arms(_arctic_gender(meta / "misc.json", subject), meta, mesh, (turn, *own))
    R = Rotation.from_rotvec(turn).as_matrix()
    spine = R[:, :, 1].mean(0)
    axis = int(np.abs(spine).argmax())
    return R[:, :, 2], np.sign(spine[axis]) * np.eye(3)[axis], arms


@lru_cache(maxsize=16)
def _arctic_gender(file: Path, subject: str) -> str:
    meta = read_json(file, most=META_BYTES) if file.is_file() else {}
    about = meta.get(subject) if isinstance(meta, Mapping) else None
    return str(about.get(GENDER)) if isinstance(about, Mapping) else "neutral"


# ---- H2O, the two-hands data set (Kwon et al. 2021): SUBJECT/PLACE/NUMBER/cam4/hand_pose_mano/*.txt, 30 Hz.
#
# One text file a frame: per hand 1 (annotated or not) + 3 translation + 48 pose + 10 shape, left then
# right, camera frame, about the flat hand. Beside them obj_pose_rt: 1 + 16, cam_pose: 16, camera to
# world, action_label: 1. Its page writes hand_pose_MANO and obj_pose_RT, its loader small letters. The
# human-human data set that the paper cites under this name has no released format.

H2O_OBJECTS = ("", "book", "espresso", "lotion", "spray", "milk", "cocoa", "chips", "cappuccino")
_THREE = ("lotion", "milk", "chips")
_DONE_WITH: dict[str, tuple[str, ...]] = {
    "grab": H2O_OBJECTS[1:], "place": H2O_OBJECTS[1:], "open": _THREE, "close": _THREE, "pour": ("milk",),
    "take out": ("espresso", "cocoa", "chips", "cappuccino"), "put in": ("espresso", "cocoa", "cappuccino"),
    "apply": ("lotion", "spray"), "read": ("book", "espresso"), "spray": ("spray",), "squeeze": ("lotion",),
}  # fmt: skip
H2O_ACTIONS = ("", *(f"{verb} the {x}" for verb, things in _DONE_WITH.items() for x in things))
H2O_BYTES, H2O_FRAMES = 16 << 10, 20_000


def _h2o(path: Path, hand: ManoHand | None, _: Bodies | None) -> list[HandMotion]:
    """The frames in which a hand is annotated; `path` is the folder of the hands' poses."""
    sequence = path.parent
    where = "h2o:" + "/".join(sequence.parts[-4:])
    by_name = {p.name.lower(): p for p in sequence.iterdir()}
    files = sorted(path.glob("*.txt"))[:H2O_FRAMES]
    if not files or (missing := {"cam_pose", "obj_pose_rt"} - by_name.keys()):
        lacks = f"{path.name}/*.txt" if not files else min(missing)
        raise FileError(f"{printable(sequence)}: holds no {lacks}")
    rows, camera, objects, left_out = [], [], [], []
    for file in files:
        try:
            row = _h2o_numbers(file, 124)
            pose = _h2o_numbers(by_name["cam_pose"] / file.name, 16).reshape(4, 4)
            moved = _h2o_numbers(by_name["obj_pose_rt"] / file.name, 17)
            if np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > 1e-2:
                raise FileError(f"cam_pose/{file.name} is not a rigid pose")
        except FileError as error:
            left_out.append(str(error))
            continue
        rows.append(row)
        camera.append(pose)
        objects.append(moved)
    if left_out:
        many = f"{len(left_out)} of {len(files)} frames left out; the first: {left_out[0]}"
        if not rows:
            raise FileError(f"{where}: {many}")
        LOG.info(f"{where}: {many}")
    T_world_camera, columns, obj = np.stack(camera), np.stack(rows), np.stack(objects)
    T_world_object = T_world_camera @ obj[:, 1:].reshape(-1, 4, 4)
    doing = _h2o_action(by_name.get("action_label"))
    hands = []
    for side, part in ((RIGHT, columns[:, 62:]), (LEFT, columns[:, :62])):
        seen = np.flatnonzero(part[:, 0] == 1)
        if not len(seen):
            continue
        part, to_world = part[seen], T_world_camera[seen]
        kind = int(obj[seen[0], 0])
        name = H2O_OBJECTS[kind] if 0 < kind < len(H2O_OBJECTS) else f"object_{kind}"
        own = part[:, 4:7], part[:, 1:4], part[:, 7:52]
        m = _motion(where, hand, side, own, part[:, 52:].mean(0), flat=True)
        T = to_world @ m.T_world_hand
        T[:, :3, :3] = to_world[:, :3, :3] @ Rotation.from_rotvec(part[:, 4:7]).as_matrix()
        hands.append(
            HandMotion(where, side, T, m.fingers, m.shape, rate_hz=30.0, object_name=name,
                       instruction=doing or f"grab the {name}", T_world_object=T_world_object[seen])
        )  # fmt: skip
    if not hands:
        raise FileError(f"{where}: no frame is annotated")
    return hands


def _h2o_action(labels: Path | None) -> str:
    """The first action, in H2O's words: action_label/*.txt holds 0 until then."""
    for file in sorted(labels.glob("*.txt"))[:H2O_FRAMES] if labels else ():
        number = int(_h2o_numbers(file, 1)[0])
        if 0 < number < len(H2O_ACTIONS):
            return H2O_ACTIONS[number]
    return ""


def _h2o_numbers(path: Path, count: int) -> F64:
    try:
        values = np.array([float(w) for w in read_file(path, H2O_BYTES).decode("ascii").split()])
    except FileError:
        raise
    except (UnicodeDecodeError, ValueError):
        raise FileError(f"{path}: holds something else than numbers") from None
    return numbers(values, (count,), str(path))


# ---- DexYCB (Chao et al. 2021): DATE-subject-XX/TIME/{meta.yml,pose.npz}, calibration/mano_*/mano.yml, 30 Hz.
#
# `pose_m` rows of 3 turn + 45 principal components about MANO's mean hand + 3 translation (all 0: no
# hand), `pose_y` rows of a quaternion (xyzw) and a place for every object, in the master camera's frame.

YCB = (
    "002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle",
    "007_tuna_fish_can", "008_pudding_box", "009_gelatin_box", "010_potted_meat_can", "011_banana",
    "019_pitcher_base", "021_bleach_cleanser", "024_bowl", "025_mug", "035_power_drill", "036_wood_block",
    "037_scissors", "040_large_marker", "051_large_clamp", "052_extra_large_clamp", "061_foam_brick",
)  # fmt: skip


def _dexycb(path: Path, hand: ManoHand | None, _: Bodies | None) -> list[HandMotion]:
    """The hand of one sequence, in the frames where there is one."""
    root, where = path.parents[2], f"dexycb:{path.parent.parent.name}/{path.parent.name}"
    meta = read_yaml(path.parent / "meta.yml")
    sides, calibration = (meta.get(k) for k in ("mano_sides", "mano_calib"))
    grasped, objects = meta.get("ycb_grasp_ind"), meta.get("ycb_ids")
    if (
        sides not in (["right"], ["left"])
        or not isinstance(calibration, list)
        or len(calibration) != 1
    ):
        raise FileError(f"{where}: meta.yml names no single hand with its mano_calib")
    if not isinstance(objects, list) or type(grasped) is not int or not 0 <= grasped < len(objects):
        raise FileError(f"{where}: meta.yml does not say which of ycb_ids is grasped")
    side = RIGHT if sides == ["right"] else LEFT
    betas = read_yaml(path_within(root / "calibration", f"mano_{calibration[0]}/mano.yml"))
    shape = numbers(betas.get("betas"), (10,), f"{where} betas")
    found = read_npz(path)
    hands = numbers(found.get("pose_m"), (None, 1, 51), f"{where} pose_m")[:, 0]
    poses = numbers(found.get("pose_y"), (len(hands), len(objects), 7), f"{where} pose_y")
    seen = np.flatnonzero((hands != 0).any(1))
    if not len(seen):
        raise FileError(f"{where}: no frame has a hand")
    frames, places = hands[seen], poses[seen, grasped]
    if (np.abs(np.linalg.norm(places[:, :4], axis=1) - 1) > 1e-2).any():
        raise FileError(f"{where}: pose_y holds quaternions that are not rotations")
    T = rigid(Rotation.from_quat(places[:, :4]).as_matrix(), places[:, 4:])
    number = objects[grasped]
    known = type(number) is int and 1 <= number <= len(YCB)
    name = YCB[number - 1] if known else name_of(f"ycb_{number}")
    text = f"pick up the {name.partition('_')[2].replace('_', ' ')}"
    columns = frames[:, :3], frames[:, 48:], frames[:, 3:48]
    return [
        _motion(where, hand, side, columns, shape, flat=False, components=True,
                rate_hz=30.0, object_name=name, instruction=text, T_world_object=T)
    ]  # fmt: skip


# ---- OakInk-Shape (Yang et al. 2022): oakink_shape_v2/CATEGORY/OBJECT/TAG[/VIRTUAL]/hand_param.pkl, right hands.
#
# `pose` 16 quaternions (wxyz) or axis-angle turns (48) about the flat hand, `shape` 10, `tsl` the wrist
# joint, all in the object's frame. source.txt beside the tag names STAGE/OBJECT_ACTION_SUBJECTS/TIME.
# Action 0004 is a handover, its subjects giver_receiver; a source with `_alt` is the receiver's hand:
# the only data set here that has hands which receive. metaV2/*object_id.json: {ID: {"name": NAME}}.

SOURCE = re.compile(r"(.+)/(.{6})_(.{4})_([_0-9]+)/([\-0-9]+)")
RECEIVER = "_alt"
ACTIONS = {"0001": "use", "0002": "hold", "0003": "lift up", "0004": "hand over"}
HANDOVER = "0004"
META = {
    "object_id.json": "OakInkObjectsV2",
    "virtual_object_id.json": "OakInkVirtualObjectsV2",
    "virtual_obj_id.json": "OakInkVirtualObjectsV2",
}
META_BYTES = 16 << 20


def oakink_objects(meta: Path) -> dict[str, tuple[str, Path]]:
    """ID -> name and folder of meshes of the objects that a file of metaV2 lists; an entry without a
    name, or with one that leads out of its folder, is told and left out."""
    found: dict[str, tuple[str, Path]] = {}
    listed = read_json(meta, most=META_BYTES)
    if meta.name not in META or not isinstance(listed, dict):
        allowed = " or ".join(META)
        raise FileError(f"{printable(meta)}: needs objects by their ID in {allowed}")
    for oid, entry in listed.items():
        name = entry.get("name") if isinstance(entry, dict) else None
        try:
            if not isinstance(name, str):
                raise FileError(f"{printable(oid)[:40]} has no name")
            found[oid] = name, path_within(meta.parent.parent / META[meta.name], name)
        except FileError as error:
            LOG.info(f"{printable(meta)}: {error}; left out")
    return found


@lru_cache(maxsize=4)
def _oakink_names(shape: Path) -> dict[str, str]:
    metas = [p for p in sorted((shape / "metaV2").glob("*.json")) if p.name in META]
    return {oid: name for meta in metas for oid, (name, _) in oakink_objects(meta).items()}


def oakink_receivers(found: list[Path], folder: Path) -> list[Path]:
    """Those of OakInk's grasps that are a receiver's hand."""
    receivers = [p for p in found if _receives(p)]
    if not receivers:
        none = f"{len(found)} grasps, none a receiver's (action {HANDOVER}, {RECEIVER})"
        raise FileError(f"{printable(folder)}: {none}; --frame first takes all")
    return receivers


def _receives(path: Path) -> bool:
    try:
        text, match = _oakink_source(path)
    except FileError:
        return True  # named and counted when it is read
    return match[3] == HANDOVER and RECEIVER in text


def _oakink(path: Path, *_: ManoHand | Bodies | None) -> list[HandMotion]:
    """The one hand of a grasp."""
    text, match = _oakink_source(path)
    action = ACTIONS.get(match[3], "hold")
    tree = next((p for p in path.parents if p.name == "oakink_shape_v2"), None)
    category = path.relative_to(tree).parts[0] if tree else "object"
    own = path.parent.name  # the virtual object's ID, or the grasp's tag below the object's
    oid = own if (path.parent.parent / "source.txt").is_file() else match[2]
    names = _oakink_names(tree.parent.resolve()) if tree else {}
    where = f"oakink:{text}"
    found = read_pickle_file(path)
    if not isinstance(found, Mapping):
        raise FileError(f"{printable(path)}: holds no dictionary; it is not a grasp of OakInk")
    turns = found.get("pose")
    if isinstance(turns, np.ndarray) and turns.size == 48:
        R = Rotation.from_rotvec(numbers(turns.reshape(16, 3), (16, 3), f"{where} pose"))
    else:
        turns = numbers(turns, (16, 4), f"{where} (48 turns or quaternions) pose")
        if (np.abs(np.linalg.norm(turns, axis=1) - 1) > 1e-2).any():
            raise FileError(f"{where}: pose holds quaternions that are not rotations")
        R = Rotation.from_quat(turns, scalar_first=True)
    T = rigid(R[:1].as_matrix(), numbers(found.get("tsl"), (3,), f"{where} tsl")[None])
    shape = numbers(found.get("shape"), (10,), f"{where} shape")
    verb = "receive" if match[3] == HANDOVER and RECEIVER in text else action
    return [
        HandMotion(where, RIGHT, T, R[1:].as_rotvec().reshape(1, 45), shape, instruction=f"{verb} the {category}",
                   object_name=name_of(names.get(oid, oid)), T_world_object=np.eye(4)[None])
    ]  # fmt: skip


def _oakink_source(path: Path) -> tuple[str, re.Match[str]]:
    # a virtual object's grasp is one deeper
    sources = [p / "source.txt" for p in (path.parent, path.parent.parent)]
    file = next((p for p in sources if p.is_file()), sources[0])
    text = read_file(file, 4096).decode("utf-8", "replace").strip()
    match = SOURCE.search(text)
    if match is None:
        raise FileError(
            f"{printable(file)}: says {printable(text[:80])!r}; need STAGE/OBJECT_ACTION_SUBJECTS/TIME"
        )
    return text, match


DATA_SETS = {
    "grab": DataSet("*_*.npz", r"s\d+/(?!.*_verts_).*", _grab),
    "arctic": DataSet("*.mano.npy", r"s\d+/.*", _arctic),
    "h2o": DataSet("hand_pose_[mM][aA][nN][oO]", ".*", _h2o, "cam4/.*"),
    "dexycb": DataSet("pose.npz", ".*", _dexycb),
    "oakink": DataSet("hand_param.pkl", ".*", _oakink),
}
