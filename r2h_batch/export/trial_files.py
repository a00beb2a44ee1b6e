"""What a method needs to make predictions, as a folder: `r2h-batch trials --out FOLDER`.

    trials.npz, hands.npz, objects/NAME.npz    arrays; manifest.json and README.md say what they are

With `--open-formats` also the same in formats that any language reads:

    open/README.md                      frames, files, how to answer
    open/frames.json                    robot, table, limits: every fixed pose as 4x4, metres
    open/trials.csv, trials.json        one row a trial
    open/objects/NAME.obj               the closed mesh, a group for each part; NAME_region.obj the
                                        part that the receiver wants (S1)
    open/objects/NAME_points.csv        the point cloud: position, normal, part, region
    open/objects/NAME_grasps.csv        grasp candidates, best first
    open/objects.json, hands.json       what is not a mesh: mass, parts, instruction; pose, joints
    open/hands/HAND.ply                 each hand that a trial needs, hand frame (ASCII)
"""

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch import se3
from r2h_batch.benchmark import Benchmark, built_in
from r2h_batch.bodies.hand import HandSet, palm_frame
from r2h_batch.bodies.objects import ObjectModel, object_digest
from r2h_batch.bodies.robot import ee_pose
from r2h_batch.io.write import csv_cell
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.methods.grasps.candidate_set import Candidates
from r2h_batch.trials.protocol import TRIALS, make_trials, trials_digest
from r2h_batch.types import Trials
from r2h_batch.verdicts import SIDES, SPLITS

__all__ = ["write_open", "write_trials"]

Array = NDArray[Any]
Arrays = dict[str, tuple[Array, str]]
"""Name -> array and what it means, with unit and frame."""
MATRIX = tuple(range(16))
RECEIVER_ROWS = (
    "the receiver, m, world: rows (x, y, z, w) of shoulder (w: the upper arm's radius), elbow (w: the"
    " forearm's), wrist, middle of the torso's box, its half sizes along its facing, sideways and up;"
    " w of the last two: x and y of the way it faces"
)

SIDE = "0 right, 1 left"
SHAPE = "MANO-style shape: 10 numbers"
POSE = "MANO-style pose: 16 axis-angle turns, rad"


def write_trials(
    folder: str | Path,
    splits: Sequence[str] = SPLITS,
    trials: int = TRIALS,
    *,
    benchmark: Benchmark | None = None,
    open_formats: bool = False,
    flags: Sequence[str] = (),
) -> str:
    """Writes the trials of a benchmark with all that a method may read.

    Args:
        folder: a new or empty folder.
        splits: S0, S1 or both.
        trials: of each split; a benchmark with trials of its own has all of them written.
        benchmark: the built-in one unless given.
        open_formats: also meshes and tables in folder/open.
        flags: what a sweep needs to score on this benchmark, for the README.

    Returns:
        The digest of the trials.

    Raises:
        FileExistsError: the folder is not empty.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} is not an empty folder; give a new one")
    benchmark = built_in() if benchmark is None else benchmark
    objects, hand_set = benchmark.objects, benchmark.hand_set
    planned = make_trials(
        splits, trials if benchmark.listed is None else len(benchmark.listed), benchmark=benchmark
    )
    chosen = [i for i, o in enumerate(objects) if o.split in splits]
    hands = _hand_arrays(hand_set)
    files = {"trials.npz": _trial_arrays(planned, benchmark, hands), "hands.npz": hands}
    candidates = candidates_of(objects)
    for i in chosen:
        files[f"objects/{objects[i].name}.npz"] = _object_arrays(objects[i], candidates[i])
    digest = trials_digest(planned, objects=objects)
    header = _header(benchmark, planned, splits, chosen, digest)
    (folder / "objects").mkdir(parents=True)
    for name, arrays in files.items():
        np.savez_compressed(folder / name, **{k: v for k, (v, _) in arrays.items()})  # type: ignore[arg-type]
    described = {
        name: _described(arrays)
        for name, arrays in files.items()
        if not name.startswith("objects/")
    }
    described["objects/NAME.npz"] = _described(
        next(a for n, a in files.items() if n.startswith("objects/")), rows=False
    )
    manifest = {**header, "arrays": described}
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n")
    sizes = [] if benchmark.listed is not None else [f"--trials {trials}"]
    sweep = " ".join(["--splits", *(s for s in SPLITS if s in splits), *sizes, *flags])
    (folder / "README.md").write_text(_readme(manifest, sweep))
    if open_formats:
        write_open(
            folder / "open", benchmark, planned, f"r2h-batch sweep --predictions mine.csv {sweep}"
        )
    return digest


def _header(
    benchmark: Benchmark, planned: Trials, splits: Sequence[str], chosen: Sequence[int], digest: str
) -> dict[str, Any]:
    """What the manifest says before the arrays."""
    return {
        "format": 1,
        "protocol": benchmark.protocol,
        "trials": {
            s: int((planned.trial_id % 2 == SPLITS.index(s)).sum()) for s in SPLITS if s in splits
        },
        "digests": {
            "trials": digest,
            "benchmark": benchmark.digest,
            "objects": object_digest(benchmark.objects),
            "hand_set": benchmark.hand_set.digest,
        },
        "thresholds": asdict(benchmark.thresholds),
        "workplace": asdict(benchmark.workplace),
        "objects": [
            {
                "object_index": i,
                "name": benchmark.objects[i].name,
                "split": benchmark.objects[i].split,
                "instruction": benchmark.objects[i].instruction,
            }
            for i in chosen
        ],
    }


def _hand_arrays(hands: HandSet) -> Arrays:
    model = hands.model
    posed = hands.geometry
    point, normal = palm_frame(posed.joints, hands.side)
    faces, tips = (x.numpy().astype(np.int32) for x in (model.faces_by_side, model.tip_vertices))
    joints = "joints in MANO's order (wrist, index, middle, pinky, ring, thumb), m, hand frame"
    return {
        "vertices": (posed.vertices.numpy(), "posed mesh of every hand, m, hand frame"),
        "faces": (faces, "triangles of right hands [0] and left hands [1], outwards"),
        "joints": (posed.joints.numpy(), joints),
        "tip_vertices": (tips, "vertex at the tip of index, middle, pinky, ring, thumb"),
        "pose": (hands.pose.numpy(), f"{POSE}; the first is the wrist's"),
        "shape": (hands.shape.numpy(), SHAPE),
        "side": (hands.side.numpy(), SIDE),
        "posture": (np.array(hands.posture), "name of the posture"),
        "palm_point": (point.numpy(), "p_h: mean of wrist and four finger roots, m, hand frame"),
        "palm_normal": (normal.numpy(), "n_h: unit vector out of the palm, hand frame"),
    }


def _in_world(T_world_hand: torch.Tensor, point: Any, normal: Any) -> tuple[Any, Any]:
    """Palm points and normals (B, 3) of hands at T_world_hand (B, 4, 4)."""
    turn = T_world_hand.clone()
    turn[:, :3, 3] = 0.0
    return se3.apply(T_world_hand, point), se3.apply(turn, normal)


def _trial_arrays(trials: Trials, benchmark: Benchmark, hands: Arrays) -> Arrays:
    objects = [benchmark.objects[i] for i in trials.object_index.tolist()]
    row, T = trials.hand_index.long().numpy(), trials.T_world_hand
    offset_m = benchmark.thresholds.reach_offset_m
    of_hand = {name: torch.from_numpy(np.asarray(array)[row]) for name, (array, _) in hands.items()
               if name in ("joints", "palm_point", "palm_normal")}  # fmt: skip
    joints = se3.apply(T[:, None], of_hand["joints"]).numpy()
    point, normal = _in_world(T, of_hand["palm_point"], of_hand["palm_normal"])
    center = (point + offset_m * normal).numpy()
    words = {
        "split": ([o.split for o in objects], "S0 free handover, S1 functional"),
        "object_name": ([o.name for o in objects], "its file is objects/NAME.npz"),
        "instruction": ([o.instruction for o in objects], "what the robot is told"),
    }
    text: Arrays = {k: (np.array(v, "<U"), meaning) for k, (v, meaning) in words.items()}
    ids = "2 i for trial i of S0, 2 i + 1 of S1; predictions name it"
    index = "index of the object, as in manifest.json"
    found: Arrays = {
        "trial_id": (trials.trial_id.numpy(), ids),
        "split": text["split"],
        "object_index": (trials.object_index.numpy(), index),
        "object_name": text["object_name"],
        "instruction": text["instruction"],
        "hand_index": (trials.hand_index.numpy(), "row of hands.npz"),
        "side": (hands["side"][0][row], SIDE),
        "T_world_hand": (T.numpy(), "hand frame (MANO's, origin at the wrist) in the world, m"),
        "pose": (hands["pose"][0][row], f"{POSE}, in the hand frame"),
        "shape": (hands["shape"][0][row], SHAPE),
        "joints": (joints, "16 joints in MANO's order, m, world"),
        "palm_point": (point.numpy(), "p_h, m, world"),
        "palm_normal": (normal.numpy(), "n_h, unit vector out of the palm, world"),
        "ball_center": (center, f"c_h = p_h + {offset_m:g} n_h, m, world"),
    }
    if trials.receiver is not None:
        found["receiver"] = (trials.receiver.numpy(), RECEIVER_ROWS)
    return found


def _object_arrays(o: ObjectModel, grasps: Candidates) -> Arrays:
    cells = "voxels that the solid fills or its surface crosses; axes x, y, z of obj"
    pitch = "side of a voxel, m; centre of (i, j, k): origin + (ijk + 0.5) pitch"
    poses = "grasp candidates, best first: ee in the obj frame, m"
    at_points = o.receiver_face[o.point_face]
    return {
        "vertices": (o.vertices, "closed mesh, m, obj frame"),
        "faces": (o.faces, "triangles, counter-clockwise seen from outside"),
        "face_part": (o.face_part, "part label of every face: index into part_names"),
        "part_names": (np.array(o.part_names), "names of the parts"),
        "receiver_face": (o.receiver_face, "faces of the receiver's region G_O^H (none for S0)"),
        "points": (o.points, "points on the surface, m, obj frame"),
        "normals": (o.normals, "their outward unit normals, obj frame"),
        "point_part": (o.point_part, "their part labels"),
        "point_receiver": (at_points, "whether they lie in the receiver's region"),
        "occupancy": (o.occupancy, cells),
        "voxel_origin": (o.voxel_origin, "lowest corner of the grid, m, obj frame"),
        "voxel_pitch": (np.array(o.voxel_pitch), pitch),
        "mass": (np.array(o.mass), "mass, kg"),
        "com": (o.com, "centre of mass, m, obj frame"),
        "inertia": (o.inertia, "about the centre of mass, kg m^2, axes of obj"),
        "grasp_T_obj_ee": (grasps.T_obj_ee, poses),
        "grasp_width": (grasps.width, "material between the pads, m"),
        "grasp_score": (grasps.score, "0 to 1, higher is better"),
        "grasp_part": (grasps.part, "part that is gripped: index into part_names"),
        "instruction": (np.array(o.instruction), "what the robot is told"),
        "split": (np.array(o.split), "S0 or S1"),
    }


FIXED_ROWS = [
    "points",
    "normals",
    "point_part",
    "point_receiver",
    "occupancy",
    "voxel_origin",
    "com",
    "inertia",
]
"""Arrays of an object whose number of rows does not depend on the object."""


def _described(arrays: Arrays, *, rows: bool = True) -> dict[str, dict[str, object]]:
    """Type, shape and meaning of arrays; with `rows` false None stands for what depends on the
    object."""
    found: dict[str, dict[str, object]] = {}
    for name, (value, meaning) in arrays.items():
        known = rows or name in FIXED_ROWS or not value.ndim
        shape = list(value.shape) if known else [None, *value.shape[1:]]
        dtype = "str" if value.dtype.kind == "U" else value.dtype.name
        found[name] = {"dtype": dtype, "shape": shape, "meaning": meaning}
    return found


def _readme(manifest: dict, sweep: str) -> str:
    counts = ", ".join(f"{n} of {s}" for s, n in manifest["trials"].items())
    lines = [
        f"# Trials of protocol {manifest['protocol']}",
        "",
        f"{counts}. Digest `{manifest['digests']['trials']}`.",
        "",
        "Lengths in metres, angles in radians. `T_a_b` takes coordinates in b to a: `p_a = T_a_b @ p_b`.",
        "`world`: the UR5e's base, z up, x towards the receiver, table top at z = 0. `ee`: between the finger pads at",
        "half stroke, z out of the gripper, y the closing axis. `obj`: the object file's frame. `hand`: MANO's, origin",
        "at the wrist joint; a hand's mesh in the world is `T_world_hand @ hands['vertices'][hand_index]`.",
        "",
        "A method answers every trial with the grasp `T_obj_ee` and the handover pose `T_world_ee`:",
        "",
        "    np.savez('mine.npz', trial_id=trials['trial_id'], T_obj_ee=..., T_world_ee=..., method='mine')",
        f"    python -m r2h_batch.sweep --predictions mine.npz {sweep}",
        "",
        "All arrays load with `np.load(FILE)`; `None` in a shape depends on the object.",
    ]
    for file, arrays in manifest["arrays"].items():
        lines += [
            "",
            f"## {file}",
            "",
            "| array | type | shape | meaning |",
            "| --- | --- | --- | --- |",
        ]
        lines += [
            f"| {k} | {a['dtype']} | {a['shape']} | {a['meaning']} |" for k, a in arrays.items()
        ]
    return "\n".join(lines) + "\n"


def write_open(folder: Path, benchmark: Benchmark, trials: Trials, answer: str) -> None:
    """Writes trials in formats that any language reads.

    Args:
        folder: a new folder.
        benchmark: of the trials.
        trials: what is written, with the objects and hands that they need.
        answer: the command that scores a file of answers, for the README.
    """
    used = sorted(set(trials.object_index.tolist()))
    for name in ("objects", "hands"):
        (folder / name).mkdir(parents=True)
    candidates = candidates_of(benchmark.objects)
    for i in used:
        _write_object(folder / "objects", benchmark.objects[i], candidates[i])
    _write_json(folder / "objects.json", [_about(i, benchmark.objects[i]) for i in used])
    hands = _hand_arrays(benchmark.hand_set)
    used_hands = sorted(set(trials.hand_index.tolist()))
    _write_json(folder / "hands.json", _write_hands(folder / "hands", benchmark, hands, used_hands))
    rows = _trial_rows(benchmark, trials, hands)
    _write_json(folder / "trials.json", rows)
    _write_csv(
        folder / "trials.csv", _columns(rows[0]) if rows else [], (_cells(row) for row in rows)
    )
    _write_json(folder / "frames.json", _frames(benchmark))
    offset = f"{benchmark.thresholds.reach_offset_m:g}"
    (folder / "README.md").write_text(
        OPEN_README.replace("OFFSET", offset).replace("ANSWER", answer), encoding="utf-8"
    )


def _write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _write_csv(path: Path, names: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(names)
        out.writerows([csv_cell(_number(x)) for x in row] for row in rows)


def _number(x: Any) -> Any:
    """Float32 in nine digits reads back as it was; float64 as Python writes it."""
    return (
        f"{x:.9g}"
        if isinstance(x, np.float32)
        else repr(float(x))
        if isinstance(x, np.float64)
        else x
    )


def _write_object(folder: Path, o: ObjectModel, grasps: Candidates) -> None:
    groups = [(name, o.faces[o.face_part == k]) for k, name in enumerate(o.part_names)]
    _write_obj(folder / f"{o.name}.obj", o.name, o.vertices, groups)
    if o.receiver_face.any():
        _write_obj(
            folder / f"{o.name}_region.obj",
            o.name,
            o.vertices,
            [("region", o.faces[o.receiver_face])],
        )
    region = o.receiver_face[o.point_face]
    _write_csv(
        folder / f"{o.name}_points.csv", ["x", "y", "z", "nx", "ny", "nz", "part", "region"],
        ([*p, *n, o.part_names[k], int(r)] for p, n, k, r in zip(o.points, o.normals, o.point_part, region, strict=True)),
    )  # fmt: skip
    flat = grasps.T_obj_ee.reshape(-1, 16)
    _write_csv(
        folder / f"{o.name}_grasps.csv", [*(f"T_obj_ee_{i}" for i in MATRIX), "width_m", "score", "part"],
        ([*T, w, s, o.part_names[k]] for T, w, s, k in zip(flat, grasps.width, grasps.score, grasps.part, strict=True)),
    )  # fmt: skip


def _write_obj(path: Path, name: str, vertices: Array, groups: Sequence[tuple[str, Array]]) -> None:
    lines = [f"# {name}: metres, frame obj; faces counter-clockwise seen from outside"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    for group, faces in groups:
        if len(faces):
            lines += [f"g {group}", *(f"f {a} {b} {c}" for a, b, c in faces + 1)]
    path.write_text("\n".join(lines) + "\n", encoding="ascii", errors="replace")


def _about(index: int, o: ObjectModel) -> dict[str, Any]:
    region = f"objects/{o.name}_region.obj" if o.receiver_face.any() else None
    return {
        "object_index": index, "name": o.name, "split": o.split, "instruction": o.instruction,
        "mesh": f"objects/{o.name}.obj", "region": region, "points": f"objects/{o.name}_points.csv",
        "grasps": f"objects/{o.name}_grasps.csv", "parts": list(o.part_names), "mass_kg": o.mass, "com_m": o.com.tolist(),
        "inertia_kg_m2": o.inertia.tolist(),
    }  # fmt: skip


def _write_hands(
    folder: Path, benchmark: Benchmark, hands: Arrays, used: list[int]
) -> list[dict[str, Any]]:
    """PLY files of the hands, and what is said of each beside its mesh."""
    of, about = {name: array for name, (array, _) in hands.items()}, []
    lists = {"joints_m": "joints", "palm_point_m": "palm_point", "palm_normal": "palm_normal"}
    for i in used:
        side = int(of["side"][i])
        _write_ply(folder / f"{i}.ply", of["vertices"][i], of["faces"][side])
        words = {"hand_index": i, "mesh": f"hands/{i}.ply", "side": SIDES[side]}
        words["posture"] = benchmark.hand_set.posture[i]
        words |= {name: of[key][i].tolist() for name, key in lists.items()}
        words["tip_vertices"] = of["tip_vertices"].tolist()
        about.append(words | {"pose_rad": of["pose"][i].tolist(), "shape": of["shape"][i].tolist()})
    return about


def _write_ply(path: Path, vertices: Array, faces: Array) -> None:
    head = (
        "ply\nformat ascii 1.0\ncomment metres, hand frame; faces counter-clockwise seen from outside\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points = "\n".join(f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices)
    triangles = "\n".join(f"3 {a} {b} {c}" for a, b, c in faces)
    path.write_text(f"{head}{points}\n{triangles}\n", encoding="ascii")


def _trial_rows(benchmark: Benchmark, trials: Trials, hands: Arrays) -> list[dict[str, Any]]:
    """The rows of trials.csv and trials.json, from the arrays of trials.npz."""
    of = {name: array for name, (array, _) in _trial_arrays(trials, benchmark, hands).items()}
    rows: list[dict[str, Any]] = []
    for i, (name, hand) in enumerate(zip(of["object_name"].tolist(), of["hand_index"].tolist())):
        words = {k: of[k][i].item() for k in ("trial_id", "split", "object_index")}
        words |= {"object": name, "mesh": f"objects/{name}.obj"}
        words |= {
            "hand_index": hand,
            "hand_mesh": f"hands/{hand}.ply",
            "side": SIDES[of["side"][i]],
        }
        words["instruction"] = of["instruction"][i].item()
        lists = ("T_world_hand", "palm_point", "palm_normal", "ball_center", "receiver")
        rows.append(words | {k: of[k][i].flatten().tolist() for k in lists if k in of})
    return rows


def _columns(row: dict[str, Any]) -> list[str]:
    names: list[str] = []
    for name, value in row.items():
        places = len(value) if isinstance(value, list) else 0
        names += [f"{name}_{'xyz'[k] if places == 3 else k}" for k in range(places)] or [name]
    return names


def _cells(row: dict[str, Any]) -> list[Any]:
    return [
        np.float32(x) if isinstance(v, list) else x
        for v in row.values()
        for x in (v if isinstance(v, list) else [v])
    ]


def _frames(benchmark: Benchmark) -> dict[str, Any]:
    robot = benchmark.robot
    home = benchmark.workplace.home_q
    return {
        "protocol": benchmark.protocol,
        "benchmark_digest": benchmark.digest,
        "robot": robot.name,
        "joints": list(robot.joints),
        "home_rad": list(home),
        "T_world_ee_at_home": np.asarray(ee_pose(robot, home)).tolist(),
        "T_flange_ee": np.asarray(robot.T_flange_ee).tolist(),
        "T_flange_gripper": np.asarray(robot.T_flange_gripper).tolist(),
        "table_m": {
            "center": list(benchmark.workplace.table_center),
            "half": list(benchmark.workplace.table_half),
        },
        "thresholds": asdict(benchmark.thresholds),
    }


OPEN_README = """\
# Trials in open formats

Nothing here needs Python. Text is UTF-8, lengths are metres, angles radians, masses kilograms.

## Frames

All frames are right-handed. `T_a_b` is 4x4 and takes coordinates in b to a: p_a = T_a_b p_b. In CSV its sixteen numbers stand
row by row (`_0` to `_3` the first row, `_3`, `_7`, `_11` the translation, the last four 0 0 0 1); in JSON as one list of sixteen.

| frame | origin | axes |
|---|---|---|
| `world` | the UR5e's base, on the table's top | z up, x towards the receiver |
| `flange` | the UR5e's tool flange | z out of the flange |
| `ee` | between the finger pads at half stroke | z out of the gripper, y the closing axis |
| `obj` | as in the object's mesh | as in the object's mesh |
| `hand` | the wrist joint | MANO's: a flat right hand points to -x, palm to -y, thumb to +z; a left one mirrored in x |

Calibration: `frames.json` has `T_flange_ee`, and where `ee` is in the world with the arm at home: solve forward kinematics of
your own robot model for `home_rad` and compare it with `T_world_ee_at_home` before you trust any pose.

The palm normal is a unit vector out of the palm; `ball_center` is OFFSET m along it from the palm point: what the object has to
come near to. `receiver` (protocol r2h-v1) is a person in five rows of x, y, z, w: shoulder (w: the upper arm's radius), elbow
(w: the forearm's), wrist, the middle of the torso's box, its half sizes along its facing, sideways and up (w of both: x, y of
its facing).

## Files

| file | what |
|---|---|
| `trials.csv`, `trials.json` | one row a trial: object, hand, where the hand stands |
| `objects.json`, `objects/NAME.obj` | meshes in `obj`, a group (`g`) for each part |
| `objects/NAME_region.obj` | the faces that the receiver wants to take (S1) |
| `objects/NAME_points.csv`, `NAME_grasps.csv` | the point cloud; grasp candidates, best first |
| `hands.json`, `hands/HAND.ply` | posed hands in `hand` (ASCII); joints: wrist, index, middle, pinky, ring, thumb |
| `frames.json` | robot, home, table, thresholds |

## Answers

For every trial the grasp `T_obj_ee` and the handover pose `T_world_ee`. CSV, columns in any order:

    trial_id,T_obj_ee_0,...,T_obj_ee_15,T_world_ee_0,...,T_world_ee_15,t_method_s

`t_method_s`, the seconds that your method took, may be left out. Or JSON:

    {"method": "mine", "predictions": [{"trial_id": 0, "T_obj_ee": [16 numbers], "T_world_ee": [16 numbers]}, ...]}

    ANSWER
"""
