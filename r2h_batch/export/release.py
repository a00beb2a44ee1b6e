"""Trials of a run in the form of the authors' release (GitHub robot-future/r2handoversim 0.11.0): one
`handover.trial.v1` file each, which its `demo --trial` replays and its `evaluate` judges.

Frames and tools as in `importers/release.py`, which reads these files back: what the release has no
field for (the hand's posture, the faces of the receiver's region) stands in `provenance.r2h_batch`.
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from r2h_batch.config import ExecConfig
from r2h_batch.export.stored import StoredTrial
from r2h_batch.importers.release import PADS_M, T_world_release, along_z, palm_in_hand
from r2h_batch.io.write import write_text
from r2h_batch.motion.time_law import limits
from r2h_batch.verdicts import SIDES

__all__ = ["release_name", "release_trial", "write_release_trial"]

Array = NDArray[np.float64]

FRAME_S = 1 / 60
CELLS = 4
"""The release fills a hand with this many boxes along each axis of its bounding box, where it has
vertices; objects are filled alike."""
LEAST_HALF_M = 0.002
TOOL_M = 0.051953
"""`T_tcp_asset_tool` along z with which the release's tool is our gripper's finger tips."""
CELLS_OF_OBJECT = 12
"""As many boxes along each axis of an object: its shape decides Reach and Affordance."""
_LAW = ("scale", "max_velocity_rad_s", "max_acceleration_rad_s2")
"""Fields of `ExecConfig` that the time law reads; a run of an older version may lack others."""


def write_release_trial(stored: StoredTrial, name: str, folder: Path) -> Path:
    """The trial as NAME.json in the folder; its path."""
    path = folder / f"{name}.json"
    write_text(path, json.dumps(release_trial(stored, name)))
    return path


def release_trial(stored: StoredTrial, name: str) -> dict[str, Any]:
    """The fields of `handover.trial.v1`, m and rad, in the release's frames.

    Args:
        stored: one trial of a run.
        name: its id.
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
    region = model.receiver_face
    place, moves = stored.workplace, stored.moves
    return {
        "schema_version": "handover.trial.v1",
        "units": "m",
        "id": name,
        "object_id": model.name,
        "variant": stored.method,
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
        "usage_boxes": _region_boxes(model),
        "hand_boxes_world": _cells(skin, CELLS, "hand"),
        "hand_mesh_world": {
            "vertices": skin.tolist(),
            "faces": hand.faces_by_side[side].tolist(),
        },
        "obstacle_boxes_world": [_table(place, to_release)],
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
        "planned_joints": (stored.q if moves else executed).tolist(),
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
        "planning": {"status": "succeeded" if moves else "failed", "planner": "r2h_batch"}
        | ({} if moves else {"reason": row["plan_reason"]}),
        "provenance": {
            "r2h_batch": {
                "trial_id": row["trial_id"],
                "outcome": row["outcome"],
                "pose": stored.hand_set.pose[rows[0]].tolist(),
                "shape": stored.hand_set.shape[rows[0]].tolist(),
                "T_world_hand": stored.T_world_hand.tolist(),
                "receiver_faces": np.flatnonzero(region).tolist(),
            }
        },
    }


def _frames(stored: StoredTrial) -> Array:
    """(K, 6) joint angles every `FRAME_S` s, the last one at the end; home alone without a path."""
    if not stored.moves:
        return stored.q[:1].repeat(2, 0)
    if stored.executed_q is not None:
        q, step = stored.executed_q, stored.header["motion"]["sample_s"]
        own = step * np.arange(len(q))
        t = np.append(np.arange(0.0, own[-1], FRAME_S), own[-1])
        return np.stack([np.interp(t, own, q[:, j]) for j in range(q.shape[1])], 1)
    own = stored.header["configuration"]["execute"]
    v, a = limits(ExecConfig(**{k: own[k] for k in _LAW if k in own}))
    t = np.append(np.arange(0.0, stored.time_s[-1], FRAME_S), stored.time_s[-1])
    k = np.clip(np.searchsorted(stored.time_s, t, side="right") - 1, 0, len(stored.q) - 2)
    d = np.diff(stored.q, axis=0)
    whole = np.abs(d).max(1)[k]
    total = np.diff(stored.time_s)[k]
    # a trapezoid of speed is symmetric: s from the nearer end
    near = np.minimum(t - stored.time_s[k], stored.time_s[k + 1] - t).clip(0)
    ramp = np.minimum(v / a, total / 2)
    s = np.where(near <= ramp, a * near**2 / 2, a * ramp**2 / 2 + a * ramp * (near - ramp))
    s = np.where(t - stored.time_s[k] <= total / 2, s, whole - s)
    share = np.divide(s, whole, out=np.zeros_like(s), where=whole > 0).clip(0, 1)
    return np.asarray(stored.q[k] + share[:, None] * d[k])


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


def _box(center: Array, half: Array, label: str) -> dict[str, Any]:
    return {
        "center": center.tolist(),
        "half_extents": half.tolist(),
        "rotation": np.eye(3).tolist(),
        "label": label,
    }


def _region_boxes(model: Any) -> list[dict[str, Any]]:
    """The bounding box of each connected part of the receiver's region: a patch has no volume."""
    if not model.receiver_face.any():
        return []
    region = trimesh.Trimesh(model.vertices, model.faces[model.receiver_face], process=False)
    groups = trimesh.graph.connected_components(
        region.face_adjacency, nodes=np.arange(len(region.faces)), min_len=1
    )
    boxes = []
    for faces in groups:
        points = region.triangles[faces].reshape(-1, 3)
        half = np.maximum(np.ptp(points, axis=0) / 2, LEAST_HALF_M)
        boxes.append(_box((points.min(0) + points.max(0)) / 2, half, "receiver"))
    return boxes


def _table(place: Any, to_release: Array) -> dict[str, Any]:
    center = trimesh.transform_points([place.table_center], to_release)[0]
    return _box(center, np.array(place.table_half), "table")


def release_name(method: str, trial_id: int) -> str:
    """An id that the release allows: letters, digits, - and _."""
    return f"{re.sub(r'[^A-Za-z0-9_-]+', '_', method)[:60]}_{trial_id}"
