"""Makes grasps.npz and grasps_report.json from the object files: ``python -m r2h_batch.assets.objects.build_grasps``.

grasps.npz holds, per object, ``<name>/T_obj_ee`` (100, 4, 4) float32 (ee frame in the object's frame),
``<name>/width`` (m), ``<name>/score`` and ``<name>/part`` (uint8, index into the object's ``part_names``).
"""

import json
import time
from pathlib import Path

import numpy as np

from r2h_batch.bodies.arrays import arrays_digest
from r2h_batch.bodies.objects import ObjectModel, load_objects, object_digest
from r2h_batch.bodies.robot import load_robot
from r2h_batch.methods.grasp_candidates import COUNT, REGION_CLEARANCE_M, Candidates, sample_grasps

HERE = Path(__file__).resolve().parent


def main() -> None:
    """Writes both files and prints a line per object."""
    arrays: dict[str, np.ndarray] = {}
    report: dict[str, object] = {}
    for model in load_objects():
        begin = time.process_time()
        found = sample_grasps(model)
        if len(found) < COUNT:
            raise SystemExit(f"{model.name}: {len(found)} grasps instead of {COUNT}")
        for key in ("T_obj_ee", "width", "score", "part"):
            arrays[f"{model.name}/{key}"] = getattr(found, key)
        report[model.name] = line = _describe(model, found)
        print(f"{model.name:16s} {time.process_time() - begin:5.1f} CPU-s  {json.dumps(line)}", flush=True)
    np.savez_compressed(HERE / "grasps.npz", allow_pickle=False, **arrays)
    summary = {
        "digest": arrays_digest(arrays),
        "robot_digest": load_robot().digest,
        "objects_digest": object_digest(load_objects()),
        "objects": report,
    }
    (HERE / "grasps_report.json").write_text(json.dumps(summary, indent=1) + "\n")


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
