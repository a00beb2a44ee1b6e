"""The same trials in formats that any language reads: OBJ and PLY meshes, CSV and JSON tables,
frames in words and numbers.

open/README.md                      frames, files, how to answer
open/frames.json                    robot, table, limits: every fixed pose as 4x4, metres
open/trials.csv, trials.json        one row a trial
open/objects/NAME.obj               the closed mesh, a group for each part; NAME_region.obj what the
receiver wants (S1) open/objects/NAME_points.csv        the point cloud: position, normal, part,
region open/objects/NAME_grasps.csv        grasp candidates, best first open/objects.json,
hands.json       what is not a mesh: mass, parts, words to say; side, pose, joints
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
from r2h_batch.benchmark import Benchmark
from r2h_batch.bodies.hand import palm_frame
from r2h_batch.bodies.objects import ObjectModel
from r2h_batch.bodies.robot import ee_pose, load_robot
from r2h_batch.io.write import csv_cell
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.methods.grasps.candidate_set import Candidates
from r2h_batch.types import Trials
from r2h_batch.verdicts import SIDES

__all__ = ["write_open"]

Array = NDArray[Any]
MATRIX = tuple(range(16))


def write_open(folder: Path, benchmark: Benchmark, trials: Trials, answer: str) -> None:
    """Write `folder` (new): everything above of these trials. `answer`: the command that scores a
    file of answers."""
    used = sorted(set(trials.object_index.tolist()))
    for name in ("objects", "hands"):
        (folder / name).mkdir(parents=True)
    candidates = candidates_of(benchmark.objects)
    for i in used:
        _write_object(folder / "objects", benchmark.objects[i], candidates[i])
    _write_json(folder / "objects.json", [_about(i, benchmark.objects[i]) for i in used])
    _write_json(
        folder / "hands.json",
        _write_hands(folder / "hands", benchmark, sorted(set(trials.hand_index.tolist()))),
    )
    rows = _trial_rows(benchmark, trials)
    _write_json(folder / "trials.json", rows)
    _write_csv(
        folder / "trials.csv", _columns(rows[0]) if rows else [], (_cells(row) for row in rows)
    )
    _write_json(folder / "frames.json", _frames(benchmark))
    offset = f"{benchmark.thresholds.reach_offset_m:g}"
    (folder / "README.md").write_text(
        README.replace("OFFSET", offset).replace("ANSWER", answer), encoding="utf-8"
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


def _write_hands(folder: Path, benchmark: Benchmark, used: list[int]) -> list[dict[str, Any]]:
    """PLY files of the hands, and what is said of each beside its mesh."""
    hands, model = benchmark.hand_set, benchmark.hand_set.model
    rows = torch.tensor(used, dtype=torch.int64, device="cpu")
    posed = model.pose(hands.pose[rows], hands.shape[rows], hands.side[rows])
    point, normal = palm_frame(posed.joints, hands.side[rows])
    faces = model.faces_by_side.numpy()
    about = []
    for k, i in enumerate(used):
        side = int(hands.side[i])
        _write_ply(folder / f"{i}.ply", posed.vertices[k].numpy(), faces[side])
        about.append({
            "hand_index": i, "mesh": f"hands/{i}.ply", "side": SIDES[side], "posture": hands.posture[i],
            "joints_m": posed.joints[k].tolist(), "palm_point_m": point[k].tolist(), "palm_normal": normal[k].tolist(),
            "tip_vertices": model.tip_vertices.tolist(), "pose_rad": hands.pose[i].tolist(), "shape": hands.shape[i].tolist(),
        })  # fmt: skip
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


def _trial_rows(benchmark: Benchmark, trials: Trials) -> list[dict[str, Any]]:
    hands = benchmark.hand_set
    geometry = hands.model.pose(hands.pose, hands.shape, hands.side)
    point, normal = palm_frame(geometry.joints, hands.side)
    hand, turn = trials.hand_index.long(), trials.T_world_hand.clone()
    turn[:, :3, 3] = 0.0
    p, n = se3.apply(trials.T_world_hand, point[hand]), se3.apply(turn, normal[hand])
    ball = p + benchmark.thresholds.reach_offset_m * n
    rows: list[dict[str, Any]] = []
    for i in range(len(trials)):
        o, h = benchmark.objects[int(trials.object_index[i])], int(hand[i])
        rows.append({
            "trial_id": int(trials.trial_id[i]), "split": o.split, "object_index": int(trials.object_index[i]),
            "object": o.name, "mesh": f"objects/{o.name}.obj", "hand_index": h, "hand_mesh": f"hands/{h}.ply",
            "side": SIDES[int(hands.side[h])], "instruction": o.instruction,
            "T_world_hand": trials.T_world_hand[i].flatten().tolist(), "palm_point": p[i].tolist(),
            "palm_normal": n[i].tolist(), "ball_center": ball[i].tolist(),
        })  # fmt: skip
        if trials.receiver is not None:
            rows[-1]["receiver"] = trials.receiver[i].flatten().tolist()
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
    robot = load_robot()
    home = benchmark.workplace.home_q
    return {
        "protocol": benchmark.protocol,
        "benchmark_digest": benchmark.digest,
        "robot": "Universal Robots UR5e, Robotiq 2F-85",
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


README = """\
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
