"""Makes grasps.npz, grasps_as_generated.npz and their reports from the object files:
``python -m r2h_batch.assets.objects.build_grasps``.

Both hold, per object, ``<name>/T_obj_ee`` (100, 4, 4) float32 (ee frame in the object's frame), ``<name>/width`` (m),
``<name>/score`` and ``<name>/part`` (uint8, index into the object's ``part_names``). The first are grasps that the evaluator's
own gripper can hold, the second what a generator proposes.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from r2h_batch import load_benchmark
from r2h_batch.config import CLEARANCE_CAP_M, Thresholds
from r2h_batch.judge.grasp import close_gripper, region_distance, squeezed
from r2h_batch.methods.candidates import STORED
from r2h_batch.methods.grasps import COUNT, REGION_CLEARANCE_M, Candidates, generate_grasps, sample_grasps
from r2h_batch.scene.arrays import arrays_digest, read_arrays
from r2h_batch.scene.objects import ObjectModel, load_objects, object_digest, stored_objects
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.scene.scene import Scene

HERE = Path(__file__).resolve().parent


def main() -> None:
    """Writes the files (--only filtered or as-generated: one of them) and prints a line per object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="make these (NAME, or NAME_S0) and keep the others; default: all")
    parser.add_argument("--only", choices=list(STORED))
    given = parser.parse_args()
    every = stored_objects()
    for kind, file in STORED.items():
        if given.only not in (None, kind):
            continue
        path = HERE / f"{Path(file).stem}_report.json"
        arrays: dict[str, np.ndarray] = dict(read_arrays(HERE / file)) if given.names else {}
        report: dict[str, object] = json.loads(path.read_text())["objects"] if given.names else {}
        for name in given.names or every:
            model = every[name]
            begin = time.process_time()
            found = sample_grasps(model) if kind == "filtered" else generate_grasps(model)
            if len(found) < COUNT:
                raise SystemExit(f"{name}: {len(found)} grasps instead of {COUNT}")
            for key in ("T_obj_ee", "width", "score", "part"):
                arrays[f"{name}/{key}"] = getattr(found, key)
            report[name] = line = _describe(model, found) | (_judged(model, found) if kind != "filtered" else {})
            print(f"{name:16s} {time.process_time() - begin:5.1f} CPU-s  {json.dumps(line)}", flush=True)
        np.savez_compressed(HERE / file, allow_pickle=False, **arrays)
        summary = {
            "digest": arrays_digest(arrays),
            "robot_digest": load_robot().digest,
            "objects_digest": object_digest(load_objects()),
            "objects": report,
        }
        path.write_text(json.dumps(summary, indent=1) + "\n")


def _judged(model: ObjectModel, found: Candidates) -> dict[str, object]:
    """How many pass Stability, and Affordance, when this evaluator asks."""
    scene, limits = Scene(load_benchmark("r2h-v1").with_objects([model])), Thresholds()
    T, index = torch.from_numpy(found.T_obj_ee), torch.zeros(len(found), dtype=torch.int32)
    held = close_gripper(scene.grasp_tables, T, index, w_max=limits.w_max_m, w_min=limits.w_min_m)
    region_m, _ = region_distance(scene.grasp_tables, T, index, squeezed(held, limits), cap_m=CLEARANCE_CAP_M)
    return {
        "pass_stability": int((held.margin_m >= 0).sum()),
        "pass_affordance": None if model.split == "S0" else int((region_m > 0).sum()),
    }


def _describe(model: ObjectModel, found: Candidates) -> dict[str, object]:
    place = found.T_obj_ee[:, :3, 3].astype(np.float64)
    nearest = np.linalg.norm(place[:, None] - place[None], axis=2) + np.eye(len(place))
    return {
        "count": len(found),
        "pass_affordance": None if model.split == "S0" else int((found.region_m > 0).sum()),
        "keep_1mm_from_region": None if model.split == "S0" else int((found.region_m > REGION_CLEARANCE_M).sum()),
        "width_mm": [round(1e3 * float(f(found.width)), 1) for f in (np.min, np.median, np.max)],
        "score": [round(float(f(found.score)), 3) for f in (np.min, np.median, np.max)],
        "spread_mm": [round(1e3 * float(s), 1) for s in place.std(axis=0)],
        "nearest_neighbour_mm": round(1e3 * float(np.median(nearest.min(axis=1))), 1),
        "parts": {name: int((found.part == i).sum()) for i, name in enumerate(model.part_names)},
    }


if __name__ == "__main__":
    main()
