"""Makes receiving.npz and receiving_report.json: ``python -m r2h_batch.assets.receiving.build_receiving``.

receiving.npz holds, per object, ``<name>/side``, ``<name>/T_obj_hand``, ``<name>/pose``, ``<name>/shape``
and ``<name>/part`` as in ``r2h_batch.receiving.ReceivingGrasps``. A CPU minute; the same bytes on the same kind of machine.

Another set gives other trials of VoxNet's training and other rows of FC, Contact and Intent (`make golden`, `make tables`).
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.assets.hand import measure
from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.scene.arrays import arrays_digest, read_arrays
from r2h_batch.scene.hand import load_hand, load_hand_set
from r2h_batch.scene.objects import ObjectModel, load_objects, object_digest, stored_objects
from r2h_batch.trials.holding.hand_contact import ObjectSurface, hand_depth, measure_contact
from r2h_batch.trials.holding.receiving import CONTACT_M, FIELDS, ReceivingGrasps
from r2h_batch.trials.holding.sampler import sample_receiving

HERE = Path(__file__).resolve().parent


def describe(model: ObjectModel, arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Counts and figures in mm of one object's grasps (`FIELDS` as arrays), measured on the exact meshes."""
    none = torch.zeros(len(arrays["side"]), dtype=torch.int32)
    grasps = ReceivingGrasps(
        none, **{k: torch.from_numpy(arrays[k]) for k in FIELDS}, instruction=none, hand=load_hand()
    )
    surface = ObjectSurface(model.vertices, model.faces)
    skin = grasps.vertices.numpy()
    contact = measure_contact(surface, skin)
    points = np.concatenate([model.points, model.vertices])
    thin = np.zeros(len(grasps), np.float32)
    for side in (0, 1):
        mine = arrays["side"] == side
        thin[mine] = hand_depth(points, skin[mine], side)
    cut = [self_cut(skin[i], side) for i, side in enumerate(arrays["side"])]
    touching = (contact.gap <= CONTACT_M).sum(1)
    palm = grasps.joints.numpy()[:, [0, 1, 4, 7, 10]].mean(1)
    apart = np.linalg.norm(palm[:, None] - palm[None], axis=2) + np.eye(len(palm))
    return {
        "right": int((arrays["side"] == 0).sum()),
        "left": int((arrays["side"] == 1).sum()),
        "regions_touching": [int(touching.min()), float(touching.mean().round(2))],
        "thumb_gap_max_mm": _mm(np.abs(contact.gap[:, 4]).max()),
        "hand_in_object_mm": [_mm(contact.depth.mean()), _mm(contact.depth.max())],
        "object_in_hand_mm": [_mm(thin.mean()), _mm(thin.max())],
        "back_in_object_max_mm": _mm(contact.back_depth.max()),
        "hand_in_itself_mm": [_mm(np.mean(cut)), _mm(np.max(cut))],
        "palm_nearest_neighbour_mm": _mm(np.median(apart.min(1))),
        "parts": {name: int((arrays["part"] == i).sum()) for i, name in enumerate(model.part_names)},
    }


def _mm(value: Any) -> float:
    return round(1000 * float(value), 2)


def self_cut(skin: NDArray[np.float32], side: int) -> float:
    """How deep (m) a posed hand cuts into itself."""
    hand = load_hand()
    right = skin.astype(np.float64) * ([-1.0, 1.0, 1.0] if side else [1.0, 1.0, 1.0])
    pieces = [p.numpy() for p in hand.pieces]
    return measure.self_cut(right, hand.faces.numpy(), [measure.hull_planes(right[p]) for p in pieces], pieces)


def made(name: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any], float]:
    """Arrays and figures of one built-in object (NAME, or NAME_S0), and the CPU seconds they took."""
    begin = time.process_time()
    model = stored_objects()[name]
    found = sample_receiving(model)
    return found, describe(model, found), time.process_time() - begin


def main() -> None:
    """Writes both files and prints a line per object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="make these and keep the others; default: all")
    parser.add_argument("--jobs", type=int, default=1, help="objects made at a time; the result is the same")
    args = parser.parse_args()
    names = args.names or list(stored_objects())
    path = HERE / "receiving_report.json"
    arrays: dict[str, NDArray[Any]] = dict(read_arrays(HERE / "receiving.npz")) if args.names else {}
    report: dict[str, object] = json.loads(path.read_text())["objects"] if args.names else {}
    with ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        for name, (found, line, seconds) in zip(names, pool.map(made, names), strict=True):
            arrays |= {f"{name}/{key}": value for key, value in found.items()}
            report[name] = line
            print(f"{name:16s} {seconds:5.1f} CPU-s  {json.dumps(line)}", flush=True)
    write_npz(HERE / "receiving.npz", arrays)
    summary = {
        "digest": arrays_digest(arrays),
        "hand_digest": arrays_digest({"v": load_hand().vertices.numpy(), "w": load_hand().weights.numpy()}),
        "handset_digest": load_hand_set().digest,
        "objects_digest": object_digest(load_objects()),
        "objects": report,
    }
    path.write_text(json.dumps(summary, indent=1) + "\n")


if __name__ == "__main__":
    main()
