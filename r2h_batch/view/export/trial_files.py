"""Inputs of a method, as a folder: `r2h-batch export trials --out FOLDER`.

    trials.npz, hands.npz, objects/NAME.npz    arrays; manifest.json and README.md say what they are

With `--open-formats` also `open/`: the arrays as JSON, the meshes as OBJ, and `frames.json`: robot, table and limits, every fixed
pose as 4x4, metres.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base import se3
from r2h_batch.base.declared import OURS
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.methods.grasps import Candidates
from r2h_batch.scene.hand import HandSet, palm_frame
from r2h_batch.scene.objects import ObjectModel, object_digest
from r2h_batch.scene.robot import ee_pose
from r2h_batch.trials.benchmark import TRIALS, Benchmark, trials_digest
from r2h_batch.trials.load import load_benchmark
from r2h_batch.types import Trials
from r2h_batch.verdicts import SPLITS

Array = NDArray[Any]
Arrays = dict[str, tuple[Array, str]]
"""Name -> array and what it means, with unit and frame."""
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
    benchmark = load_benchmark() if benchmark is None else benchmark
    objects, hand_set = benchmark.objects, benchmark.hand_set
    planned = benchmark.trials(
        trials if benchmark.listed is None else len(benchmark.listed), splits=splits
    )
    chosen = [i for i, o in enumerate(objects) if o.split in splits]
    hands = _hand_arrays(hand_set)
    files = {"trials.npz": _trial_arrays(planned, benchmark, hands), "hands.npz": hands}
    candidates = candidates_of(objects, robot=benchmark.robot)
    for i in chosen:
        files[f"objects/{objects[i].name}.npz"] = _object_arrays(objects[i], candidates[i])
    digest = trials_digest(planned)
    header = _header(benchmark, planned, splits, chosen, digest)
    (folder / "objects").mkdir(parents=True)
    for name, arrays in files.items():
        np.savez_compressed(folder / name, **{k: v for k, (v, _) in arrays.items()})  # type: ignore[arg-type]
    described = {name: _described(files[name]) for name in ("trials.npz", "hands.npz")}
    of_object = files[f"objects/{objects[chosen[0]].name}.npz"]
    described["objects/NAME.npz"] = _described(of_object, rows=False)
    manifest = {**header, "arrays": described}
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n")
    sizes = [] if benchmark.listed is not None else [f"--trials {trials}"]
    sweep = " ".join(["--splits", *(s for s in SPLITS if s in splits), *sizes, *flags])
    (folder / "README.md").write_text(_readme(manifest, sweep))
    if open_formats:
        answer = f"r2h-batch sweep --predictions mine.json {sweep}"
        write_open(folder / "open", benchmark, files, chosen, answer)
    return digest


def _header(
    benchmark: Benchmark, planned: Trials, splits: Sequence[str], chosen: Sequence[int], digest: str
) -> dict[str, Any]:
    """Fields of the manifest before the arrays."""
    shown = ("name", "split", "instruction")
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
        "conventions": {**OURS, "joint_names": list(benchmark.robot.joints)},
        "thresholds": asdict(benchmark.thresholds),
        "workplace": asdict(benchmark.workplace),
        "objects": [
            {"object_index": i, **{k: getattr(benchmark.objects[i], k) for k in shown}}
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


def _trial_arrays(trials: Trials, benchmark: Benchmark, hands: Arrays) -> Arrays:
    objects = [benchmark.objects[i] for i in trials.object_index.tolist()]
    row, T = trials.hand_index.long().numpy(), trials.T_world_hand
    offset_m = benchmark.thresholds.reach_offset_m
    of_hand = {name: torch.from_numpy(np.asarray(array)[row]) for name, (array, _) in hands.items()
               if name in ("joints", "palm_point", "palm_normal")}  # fmt: skip
    joints = se3.apply(T[:, None], of_hand["joints"]).numpy()
    turn = T.clone()
    turn[:, :3, 3] = 0.0
    point, normal = se3.apply(T, of_hand["palm_point"]), se3.apply(turn, of_hand["palm_normal"])
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
        "frame": (
            np.array(OURS["frame"]),
            "of all poses T_world_*; predictions may declare another",
        ),
        "length_unit": (
            np.array(OURS["length_unit"]),
            "of all lengths; predictions may declare another",
        ),
        "benchmark": (np.array(trials.benchmark), "whose trials they are; predictions name it too"),
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
    of_boxes = "boxes of the region (N, 5, 3): centre, half sides, rows of the rotation"
    return {
        **({} if o.receiver_boxes is None else {"receiver_boxes": (o.receiver_boxes, of_boxes)}),
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


FIXED_ROWS = (
    *("points", "normals", "point_part", "point_receiver"),
    *("occupancy", "voxel_origin", "com", "inertia"),
)
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
        f"# Trials of benchmark {manifest['protocol']}",
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
        "    np.savez('mine.npz', trial_id=trials['trial_id'], T_obj_ee=..., T_world_ee=..., method='mine',",
        "             frame='world', length_unit='m')",
        f"    python -m r2h_batch.sweep --predictions mine.npz {sweep}",
        "",
        "All arrays load with `np.load(FILE)`; `None` in a shape depends on the object.",
    ]
    for file, arrays in manifest["arrays"].items():
        head = ("| array | type | shape | meaning |", "| --- | --- | --- | --- |")
        lines += ["", f"## {file}", "", *head]
        for k, a in arrays.items():
            lines.append(f"| {k} | {a['dtype']} | {a['shape']} | {a['meaning']} |")
    return "\n".join(lines) + "\n"


def write_open(
    folder: Path,
    benchmark: Benchmark,
    files: Mapping[str, Arrays],
    chosen: Sequence[int],
    answer: str,
) -> None:
    """Writes trials in formats that any language reads: OBJ and JSON.

    Args:
        folder: a new folder.
        benchmark: of the trials.
        files: the arrays by the names of their .npz files; each becomes a JSON file.
        chosen: numbers of the objects.
        answer: the command that scores a file of answers, for the README.
    """
    for name in ("objects", "hands"):
        (folder / name).mkdir(parents=True)
    for name, arrays in files.items():
        data = {k: v.tolist() for k, (v, _) in arrays.items() if k not in _IN_MESHES}
        _write_json(folder / name.replace(".npz", ".json"), data)
    for o in (benchmark.objects[i] for i in chosen):
        groups = [(name, o.faces[o.face_part == k]) for k, name in enumerate(o.part_names)]
        _write_obj(folder / "objects" / f"{o.name}.obj", "obj", o.vertices, groups)
    hands = {name: array for name, (array, _) in files["hands.npz"].items()}
    for i in set(files["trials.npz"]["hand_index"][0].tolist()):
        faces = hands["faces"][int(hands["side"][i])]
        _write_obj(folder / "hands" / f"{i}.obj", "hand", hands["vertices"][i], [("hand", faces)])
    _write_json(folder / "frames.json", _frames(benchmark))
    (folder / "README.md").write_text(OPEN_README.replace("ANSWER", answer), encoding="utf-8")


_IN_MESHES = ("vertices", "faces", "occupancy")
"""Arrays that open formats hold as meshes."""


def _write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, allow_nan=False) + "\n", encoding="utf-8")


def _write_obj(
    path: Path, frame: str, vertices: Array, groups: Sequence[tuple[str, Array]]
) -> None:
    lines = [f"# metres, frame {frame}; faces counter-clockwise seen from outside"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    for group, faces in groups:
        if len(faces):
            lines += [f"g {group}", *(f"f {a} {b} {c}" for a, b, c in faces + 1)]
    path.write_text("\n".join(lines) + "\n", encoding="ascii", errors="replace")


def _frames(benchmark: Benchmark) -> dict[str, Any]:
    robot = benchmark.robot
    home = benchmark.workplace.home_q
    return {
        "protocol": benchmark.protocol,
        "benchmark_digest": benchmark.digest,
        "robot": robot.name,
        "conventions": {**OURS, "joint_names": list(robot.joints)},
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

Nothing here needs Python. Text is UTF-8, lengths are metres, angles radians, masses kilograms. The JSON files hold the arrays of
the .npz files beside this folder; `../README.md` says what each means, and what the frames are. A hand is MANO's: a flat right
hand points to -x, palm to -y, thumb to +z; a left one is mirrored in x.

| file | what |
|---|---|
| `trials.json`, `hands.json` | trials, one entry of each list a trial; hands by `hand_index` |
| `objects/NAME.json`, `objects/NAME.obj` | an object; its mesh with a group (`g`) for each part |
| `hands/HAND.obj` | the posed mesh of each hand that a trial needs |
| `frames.json` | robot, home, table, thresholds |

Calibration: `frames.json` has `T_flange_ee`, and where `ee` is in the world with the arm at home. Solve forward kinematics of
your own robot model for `home_rad` and compare it with `T_world_ee_at_home` before you trust any pose.

Answer every trial with the grasp `T_obj_ee` and the handover pose `T_world_ee`, as JSON:

    {"method": "mine", "frame": "world", "length_unit": "m", "trial_id": [0, ...],
     "T_obj_ee": [[[4 numbers], ...4], ...], "T_world_ee": [...]}

    ANSWER
"""
