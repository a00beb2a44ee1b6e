"""Trials of a run in the form of the authors' release (GitHub robot-future/r2handoversim 0.11.0): one
`handover.trial.v1` file each, which its `demo --trial` replays and its `evaluate` judges.

Frames and tools as in `data/release.py`, which reads these files back: what the release has no
field for (the hand's posture, the faces of the receiver's region) stands in `provenance.r2h_batch`.
"""

import csv
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from r2h_batch.base.io.write import atomic_path, csv_cell, write_json, write_text
from r2h_batch.data.release import PADS_M, T_world_release, along_z, palm_in_hand
from r2h_batch.runs.store import UNJUDGED
from r2h_batch.verdicts import EVERY, PAPER, SIDES, SPLITS
from r2h_batch.view.export.region_boxes import region_as_boxes
from r2h_batch.view.mjcf import posture_at
from r2h_batch.view.stored import Reader
from r2h_batch.view.stored_trial import StoredTrial

Array = NDArray[np.float64]

FRAME_S = 1 / 60
CELLS = 4
"""The release fills a hand with this many boxes along each axis of its bounding box, where it has
vertices; objects are filled alike."""
LEAST_HALF_M = 0.002
TOOL_M = 0.051953
"""`T_tcp_asset_tool` along z with which the release's tool is our gripper's finger tips."""
NOT_TURNED: Array = np.eye(3)
CELLS_OF_OBJECT = 12
"""As many boxes along each axis of an object: its shape decides Reach and Affordance."""


class Written(NamedTuple):
    """What `write_release` wrote of a method."""

    trials: int
    """trials with a file"""
    results: int
    """trials with a verdict"""
    left_out: int
    """trials that nobody judged"""


def write_release(reader: Reader, method: str, folder: Path, *, trials: int) -> Written:
    """A method's first judged trials of each split as files in the folder, and the verdicts of all judged ones.

    Args:
        reader: of the run.
        method: its name in the run.
        folder: where they go.
        trials: at most so many of each split.
    """
    rows = reader.rows(method).to_pylist()
    judged = sorted((r for r in rows if r["outcome"] not in UNJUDGED), key=lambda r: r["trial_id"])
    names = release_names([r["trial_id"] for r in judged], method, reader.run.labels)
    ids = [i for s in (0, 1) for i in [i for i in names if i % 2 == s][:trials]]
    folder.mkdir(parents=True, exist_ok=True)
    for i in ids:
        write_release_trial(reader.trial(i, method), *names[i], folder)
    write_release_results(judged, names, folder)
    return Written(len(ids), len(judged), len(rows) - len(judged))


def write_release_trial(stored: StoredTrial, name: str, variant: str, folder: Path) -> Path:
    """The trial as NAME.json in the folder; its path."""
    path = folder / f"{name}.json"
    write_text(path, json.dumps(release_trial(stored, name, variant)))
    return path


def release_trial(stored: StoredTrial, name: str, variant: str) -> dict[str, Any]:
    """The fields of `handover.trial.v1`, m and rad, in the release's frames.

    Args:
        stored: one trial of a run.
        name: its id.
        variant: the method behind it.
    """
    model, row = stored.object_model, stored.row
    limits_of = stored.header["configuration"]["thresholds"]
    to_release: Array = np.linalg.inv(T_world_release).astype(np.float64)
    tips = along_z(PADS_M[""])
    side = int(stored.hand_set.side[row["hand_index"]])
    hand = stored.hand_set.model
    rows = torch.tensor([row["hand_index"]], dtype=torch.int64, device="cpu")
    geometry = stored.hand_set.geometry
    skin = geometry.vertices[rows[0]].double().numpy()
    T_release_hand = to_release @ stored.T_world_hand
    T_release_palm = T_release_hand @ palm_in_hand(geometry.joints[rows], side)
    skin = trimesh.transform_points(skin, T_release_hand)
    executed = _frames(stored)
    place, moves = stored.workplace, stored.moves
    planned = stored.planned_q
    if planned is None:
        planned = stored.q if moves else executed
    table = trimesh.transform_points([place.table_center], to_release)[0]
    failed = {"status": "failed", "planner": "r2h_batch"}
    own: dict[str, Any] = {}
    if stored.hand_set.skin is None:  # what the release has no field for
        own = {
            "pose": stored.hand_set.pose[rows[0]].tolist(),
            "shape": stored.hand_set.shape[rows[0]].tolist(),
            "T_world_hand": stored.T_world_hand.tolist(),
            "T_world_palm": T_release_palm.tolist(),
        }
        if model.receiver_boxes is None:
            own["receiver_faces"] = np.flatnonzero(model.receiver_face).tolist()
    return {
        "schema_version": "handover.trial.v1",
        "units": "m",
        "id": name,
        "object_id": model.name,
        "variant": variant,
        "split": model.split,
        "T_object_gripper": (stored.T_obj_ee @ tips).tolist(),
        "target_T_world_gripper": (to_release @ stored.T_world_ee @ tips).tolist(),
        "T_tcp_asset_tool": along_z(TOOL_M).tolist(),
        "object_boxes": _cells(_surface(model), CELLS_OF_OBJECT, "object"),
        "object_mesh_object": {
            "vertices": model.vertices.tolist(),
            "faces": model.faces.tolist(),
            "colors": np.full((len(model.vertices), 3), 0.7).tolist(),
            "source_path": f"r2h_batch:{model.name}",
            "source_sha256": "",
        },
        "usage_boxes": [
            _box(center, half, "receiver", np.stack(R))
            for center, half, *R in region_as_boxes(model).round(9)
        ],
        "hand_boxes_world": _cells(skin, CELLS, "hand"),
        "hand_mesh_world": {
            "vertices": skin.tolist(),
            "faces": hand.faces_by_side[side].tolist(),
        },
        "obstacle_boxes_world": [_box(table, np.array(place.table_half), "table")],
        "palm_position_world": T_release_palm[:3, 3].tolist(),
        "palm_normal_world": T_release_palm[:3, 2].tolist(),
        "reach_offset_m": limits_of["reach_offset_m"],
        "reach_radius_m": limits_of["reach_radius_m"],
        "max_opening_m": min(limits_of["w_max_m"], 0.085),
        "gripper_opening_m": row["opening_m"],
        "gripper_opening_source": "r2h_batch: gap of the closed pads",
        "stability_width_m": float(np.ptp(model.vertices @ stored.T_obj_ee[:3, 1])),
        "stability_width_rule": "whole object along the closing axis",
        "dt_s": FRAME_S,
        "planned_joints": planned.tolist(),
        "executed_joints": executed.tolist(),
        "receiver": {
            "id": f"hand_{int(rows[0])}",
            "template_id": stored.hand_set.posture[int(rows[0])],
            "side": SIDES[side],
            "seed": 0,
            "sample_index": row["trial_id"],
            "T_world_hand": T_release_palm.tolist(),
            "static_world": True,
            "source": "r2h_batch",
        },
        # a record of a success would have the release check the edges again, on boxes
        **({} if moves else {"planning": failed | {"reason": row["plan_reason"]}}),
        "provenance": {
            "r2h_batch": {"trial_id": row["trial_id"], "outcome": row["outcome"], **own}
        },
    }


def _frames(stored: StoredTrial) -> Array:
    """(K, 6) joint angles every `FRAME_S` s, the last one at the end; home alone without a path."""
    if not stored.moves:
        return stored.q[:1].repeat(2, 0)
    own, q = stored.time_s, stored.q
    if stored.executed_q is not None:
        q = stored.executed_q
        own = stored.header["motion"]["sample_s"] * np.arange(len(q))
    t = np.append(np.arange(0.0, own[-1], FRAME_S), own[-1])
    if stored.executed_q is None and not stored.given:
        return posture_at(stored, t)
    return np.stack([np.interp(t, own, joint) for joint in q.T], 1)


def _surface(model: Any) -> Array:
    """Points so dense on the surface that no cell which it crosses stays empty."""
    size = np.ptp(model.vertices, axis=0).max() / CELLS_OF_OBJECT / 4
    vertices, _ = trimesh.remesh.subdivide_to_size(model.vertices, model.faces, size)
    return np.asarray(vertices, np.float64)


def _cells(points: Array, n: int, label: str) -> list[dict[str, Any]]:
    """Boxes that hold all points: those cells of an n x n x n grid of their bounding box which have
    any, shrunk to what they hold."""
    low = points.min(0)
    size = np.maximum(np.ptp(points, axis=0), 1e-9) / n
    cell = np.minimum((points - low) // size, n - 1).astype(int)
    _, at = np.unique(cell, axis=0, return_inverse=True)
    boxes = []
    for k in range(at.max() + 1):
        inside = points[at.reshape(-1) == k]
        half = np.maximum(np.ptp(inside, axis=0) / 2, LEAST_HALF_M)
        boxes.append(_box((inside.min(0) + inside.max(0)) / 2, half, label))
    return boxes


def _box(center: Array, half: Array, label: str, R: Array = NOT_TURNED) -> dict[str, Any]:
    sides = {"center": center.tolist(), "half_extents": half.tolist()}
    return {**sides, "rotation": R.tolist(), "label": label}


def release_name(method: str, trial_id: int) -> str:
    """An id that the release allows: letters, digits, - and _."""
    return f"{re.sub(r'[^A-Za-z0-9_-]+', '_', method)[:60]}_{trial_id}"


_ID = re.compile(r"[A-Za-z0-9_-]{1,200}")
"""Form of a trial's id in the release; files are called after it."""
_OTHER_FILES = ("results", "paper_table")


def release_names(
    ids: Sequence[int], method: str, labels: Mapping[int, tuple[str, str]]
) -> dict[int, tuple[str, str]]:
    """Trial id -> its id in the release's files, and the method behind it.

    The text of the trials' owner stays, where it is an id of the release, no other trial's and no other file's. Else a new
    id is made: a run folder is a stranger's, and its texts may lead out of the folder.

    Args:
        ids: of the trials.
        method: name in the run.
        labels: trial id -> its owner's text, and the method behind it, as `Run.labels`.
    """
    times = Counter(text.casefold() for text, _ in labels.values()) + Counter(_OTHER_FILES)
    names = {}
    for i in ids:
        text, variant = labels.get(i, ("", ""))
        own = _ID.fullmatch(text) and times[text.casefold()] == 1
        names[i] = (text if own else release_name(method, i), variant or method)
    if len({text.casefold() for text, _ in names.values()}) < len(
        names
    ):  # an owner's text is a made one
        return {i: (release_name(method, i), variant) for i, (_, variant) in names.items()}
    return names


_FLAGS = {c: f"passed_{c}" for c in PAPER}
_SUCCESS = {"success", *(entry.name for entry in EVERY)} - {*PAPER}
"""Outcomes of rows that may pass the paper's criteria."""
_TIMES = ("planning_time_s", "execution_time_s", "total_time_s")
_CSV = (
    *("trial_id", "object_id", "variant", "split", "success", "first_failure", *PAPER),
    *("reference_outcome", "right_pad_distance_m", "left_pad_distance_m"),
    *("trajectory_duration_s", *_TIMES),
)
_TABLE = (
    *("variant", "split", "objects", "trials", "SR", "Tplan", "Texec", "Ttot"),
    *("Fplan", "Freach", "Fsafe", "Fstab", "Fafford"),
)
_TIMES_OF = dict(zip(("Tplan", "Texec", "Ttot"), _TIMES))
_FAILURES = {
    "Fplan": "plan", "Freach": "reach", "Fsafe": "safe", "Fstab": "stability", "Fafford": "affordance"
}  # fmt: skip


def write_release_results(
    rows: Sequence[Mapping[str, Any]], names: Mapping[int, tuple[str, str]], folder: Path
) -> None:
    """results.json, results.csv, paper_table.json and paper_table.csv in the release's schema: verdicts by the paper's criteria.

    Args:
        rows: judged rows of a run's trials.
        names: trial id -> its id in the release's files, and the method behind it.
        folder: where they go.
    """
    found = [_result(row, *names[row["trial_id"]]) for row in rows]
    write_json(folder / "results.json", found)
    flat = [{**r, **r["metrics"]} for r in found]
    _write_csv(folder / "results.csv", _CSV, flat)
    table = _paper_table(found)
    write_json(folder / "paper_table.json", table)
    _write_csv(folder / "paper_table.csv", _TABLE, table)


def _result(row: Mapping[str, Any], name: str, variant: str) -> dict[str, Any]:
    metrics = {c: row[k] for c, k in _FLAGS.items()}
    if metrics["safe"] is None:  # the arm stays at home, which the release calls safe
        metrics["safe"] = True
    plan_s, exec_s = row["t_plan_s"], row["t_exec_s"]
    total_s = None if plan_s is None or exec_s is None else plan_s + exec_s
    return {
        "trial_id": name,
        "object_id": row["object"],
        "split": row["split"],
        "variant": variant,
        "metrics": metrics,
        "success": row["outcome"] in _SUCCESS and False not in metrics.values(),
        "first_failure": next((c for c, passed in metrics.items() if passed is False), None),
        "width_m": row["width_m"],
        "contact_frames": [],
        "trajectory_duration_s": exec_s,
        "planning_time_s": plan_s,
        "execution_time_s": exec_s,
        "total_time_s": total_s,
        "scope": "r2h_batch: certified along the motion; no frames are counted",
    }


def _paper_table(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Percent and seconds by variant and split: objects count equal within a split, splits equal in
    Avg, where S0's Affordance is 0. A mean time is null where one trial has none."""
    table = []
    for variant in dict.fromkeys(r["variant"] for r in results):
        rows = []
        for split in SPLITS:
            if own := [r for r in results if (r["variant"], r["split"]) == (variant, split)]:
                rows.append(_table_row(variant, split, own))
        if len(rows) == len(SPLITS):
            both = {k: [row[k] for row in rows] for k in _TABLE[4:]}
            both["Fafford"][0] = 0.0
            count = {k: sum(row[k] for row in rows) for k in ("objects", "trials")}
            means = {k: None if None in v else sum(v) / len(v) for k, v in both.items()}
            rows.append({"variant": variant, "split": "Avg", **count, **means})
        table += rows
    return table


def _table_row(variant: str, split: str, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    objects = sorted({r["object_id"] for r in results})

    def mean(values: Sequence[Any]) -> float | None:
        if None in values:
            return None
        pairs = [(float(v), r["object_id"]) for v, r in zip(values, results)]
        return float(np.mean([np.mean([v for v, o in pairs if o == name]) for name in objects]))

    times = {k: mean([r[name] for r in results]) for k, name in _TIMES_OF.items()}
    failures = {
        k: mean([100.0 * (r["first_failure"] == c) for r in results]) for k, c in _FAILURES.items()
    }
    if split == "S0":
        failures["Fafford"] = None
    rate = mean([100.0 * r["success"] for r in results])
    sizes = {"objects": len(objects), "trials": len(results)}
    return {"variant": variant, "split": split, **sizes, "SR": rate, **times, **failures}


def _write_csv(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows([csv_cell(row.get(c)) for c in columns] for row in rows)
