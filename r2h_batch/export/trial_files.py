"""What a method needs to make predictions, as a folder of .npz files with a manifest: `python -m
r2h_batch.trials`."""

import json
from collections.abc import Sequence
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
from r2h_batch.export.open_files import write_open
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.methods.grasps.candidate_set import Candidates
from r2h_batch.trials.protocol import TRIALS, make_trials, trials_digest
from r2h_batch.types import Trials
from r2h_batch.verdicts import SPLITS

RECEIVER_ROWS = (
    "the receiver, m, world: rows (x, y, z, w) of shoulder (w: the upper arm's radius), elbow (w: the forearm's), wrist, middle"
    " of the torso's box, its half sizes along its facing, sideways and up; w of the last two: x and y of the way it faces"
)
Arrays = dict[str, tuple[NDArray[np.generic], str]]
"""Name -> array and what it means, with unit and frame."""


def write_trials(
    folder: str | Path,
    splits: Sequence[str] = SPLITS,
    trials: int = TRIALS,
    *,
    benchmark: Benchmark | None = None,
    open_formats: bool = False,
    flags: Sequence[str] = (),
) -> str:
    """Write the planned trials of a benchmark (default: the built-in one) with all that a method
    may read; their digest.

    `folder` is new or empty. `open_formats`: the same also as meshes and tables (`open_files.py`).
    `flags`: what a sweep needs to score on this benchmark. A benchmark with trials of its own has
    all of them written.
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
    geometry = model.pose(hands.pose, hands.shape, hands.side)
    point, normal = palm_frame(geometry.joints, hands.side)
    side = "0 right, 1 left"
    return {
        "vertices": (geometry.vertices.numpy(), "posed mesh of every hand, m, hand frame"),
        "faces": (
            model.faces_by_side.numpy().astype(np.int32),
            "triangles of right hands [0] and left hands [1], outwards",
        ),
        "joints": (
            geometry.joints.numpy(),
            "joints in MANO's order (wrist, index, middle, pinky, ring, thumb), m, hand frame",
        ),
        "tip_vertices": (
            model.tip_vertices.numpy().astype(np.int32),
            "vertex at the tip of index, middle, pinky, ring, thumb",
        ),
        "pose": (
            hands.pose.numpy(),
            "MANO-style pose: 16 axis-angle turns, rad; the first is the wrist's",
        ),
        "shape": (hands.shape.numpy(), "MANO-style shape: 10 numbers"),
        "side": (hands.side.numpy(), side),
        "posture": (np.array(hands.posture), "name of the posture"),
        "palm_point": (point.numpy(), "p_h: mean of wrist and four finger roots, m, hand frame"),
        "palm_normal": (normal.numpy(), "n_h: unit vector out of the palm, hand frame"),
    }


def _trial_arrays(trials: Trials, benchmark: Benchmark, hands: Arrays) -> Arrays:
    hand, model = (
        trials.hand_index.long(),
        [benchmark.objects[i] for i in trials.object_index.tolist()],
    )
    offset_m = benchmark.thresholds.reach_offset_m
    local = {
        k: torch.from_numpy(np.asarray(hands[k][0]))[hand]
        for k in ("joints", "palm_point", "palm_normal")
    }
    turn = trials.T_world_hand.clone()
    turn[:, :3, 3] = 0.0
    point, normal = (
        se3.apply(trials.T_world_hand, local["palm_point"]),
        se3.apply(turn, local["palm_normal"]),
    )
    row = hand.numpy()
    return {
        "trial_id": (
            trials.trial_id.numpy(),
            "2 i for trial i of S0, 2 i + 1 of S1; predictions name it",
        ),
        "split": (np.array([o.split for o in model], "<U2"), "S0 free handover, S1 functional"),
        "object_index": (trials.object_index.numpy(), "index of the object, as in manifest.json"),
        "object_name": (np.array([o.name for o in model], "<U"), "its file is objects/NAME.npz"),
        "instruction": (np.array([o.instruction for o in model], "<U"), "what the robot is told"),
        "hand_index": (trials.hand_index.numpy(), "row of hands.npz"),
        "side": (hands["side"][0][row], "0 right, 1 left"),
        "T_world_hand": (
            trials.T_world_hand.numpy(),
            "hand frame (MANO's, origin at the wrist) in the world, m",
        ),
        "pose": (
            hands["pose"][0][row],
            "MANO-style pose in the hand frame: 16 axis-angle turns, rad",
        ),
        "shape": (hands["shape"][0][row], "MANO-style shape: 10 numbers"),
        "joints": (
            se3.apply(trials.T_world_hand[:, None], local["joints"]).numpy(),
            "16 joints in MANO's order, m, world",
        ),
        "palm_point": (point.numpy(), "p_h, m, world"),
        "palm_normal": (normal.numpy(), "n_h, unit vector out of the palm, world"),
        "ball_center": (
            (point + offset_m * normal).numpy(),
            f"c_h = p_h + {offset_m:g} n_h, m, world",
        ),
        **(
            {}
            if trials.receiver is None
            else {"receiver": (trials.receiver.numpy(), RECEIVER_ROWS)}
        ),
    }


def _object_arrays(o: ObjectModel, grasps: Candidates) -> Arrays:
    return {
        "vertices": (o.vertices, "closed mesh, m, obj frame"),
        "faces": (o.faces, "triangles, counter-clockwise seen from outside"),
        "face_part": (o.face_part, "part label of every face: index into part_names"),
        "part_names": (np.array(o.part_names), "names of the parts"),
        "receiver_face": (o.receiver_face, "faces of the receiver's region G_O^H (none for S0)"),
        "points": (o.points, "points on the surface, m, obj frame"),
        "normals": (o.normals, "their outward unit normals, obj frame"),
        "point_part": (o.point_part, "their part labels"),
        "point_receiver": (
            o.receiver_face[o.point_face],
            "whether they lie in the receiver's region",
        ),
        "occupancy": (
            o.occupancy,
            "voxels that the solid fills or its surface crosses; axes x, y, z of obj",
        ),
        "voxel_origin": (o.voxel_origin, "lowest corner of the grid, m, obj frame"),
        "voxel_pitch": (
            np.array(o.voxel_pitch),
            "side of a voxel, m; centre of (i, j, k): origin + (ijk + 0.5) pitch",
        ),
        "mass": (np.array(o.mass), "mass, kg"),
        "com": (o.com, "centre of mass, m, obj frame"),
        "inertia": (o.inertia, "about the centre of mass, kg m^2, axes of obj"),
        "grasp_T_obj_ee": (grasps.T_obj_ee, "grasp candidates, best first: ee in the obj frame, m"),
        "grasp_width": (grasps.width, "material between the pads, m"),
        "grasp_score": (grasps.score, "0 to 1, higher is better"),
        "grasp_part": (grasps.part, "part that is gripped: index into part_names"),
        "instruction": (np.array(o.instruction), "what the robot is told"),
        "split": (np.array(o.split), "S0 or S1"),
    }


def _described(arrays: Arrays, *, rows: bool = True) -> dict[str, dict[str, object]]:
    fixed = (
        "points",
        "normals",
        "point_part",
        "point_receiver",
        "occupancy",
        "voxel_origin",
        "com",
        "inertia",
    )
    return {
        name: {
            "dtype": "str" if value.dtype.kind == "U" else value.dtype.name,
            "shape": list(value.shape)
            if rows or name in fixed
            else [None, *value.shape[1:]][: value.ndim],
            "meaning": meaning,
        }
        for name, (value, meaning) in arrays.items()
    }


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
