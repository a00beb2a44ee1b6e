"""Contact-Handover when depth cameras show its network the object.

`python bench/views.py --out FOLDER` sweeps the method on the default benchmark, motion as planned, with the whole solid and
with cameras (the same FOLDER goes on). `--render` prints the table of the JSON.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table, swept

from r2h_batch import load_benchmark

STORED = ROOT / "bench" / "results" / "views.json"
VIEWS = {
    "the whole solid": "",
    "4 cameras, no noise": "cameras=4,depth_noise=0",
    "4 cameras": "cameras=4",
    "2 cameras": "cameras=2",
    "1 camera": "cameras=1",
    "1 camera, 10 % of the pixels lost": "cameras=1,depth_lost=0.1",
    "2 cameras, off by 5 mm and 1 deg": "cameras=2,camera_m=0.005,camera_deg=1",
    "2 cameras, off by 20 mm and 3 deg": "cameras=2,camera_m=0.02,camera_deg=3",
}
COLUMNS = {"sr": "SR", "f_plan": "F_plan", "f_afford": "F_afford, S1", "presented": "Presented, S1"}


def maps(spec: dict[str, float], scene: Any, trials: Any) -> np.ndarray:
    """(N, P) probabilities that the network gives with these cameras."""
    from r2h_batch.methods.predictors import DepthView, predict_contacts

    view = DepthView(
        int(spec.get("cameras", 0)),
        spec.get("depth_noise", 1.0),
        spec.get("depth_lost", 0.0),
        spec.get("camera_m", 0.0),
        spec.get("camera_deg", 0.0),
    )
    return predict_contacts(trials, scene, view=view).cpu().numpy()


def area_under_curve(probability: np.ndarray, touched: np.ndarray) -> float:
    """Chance that a touched point ranks above another, ties half."""
    from scipy.stats import rankdata

    n = int(touched.sum())
    ranks = rankdata(probability)[touched].sum()
    return float((ranks - n * (n + 1) / 2) / (n * (len(touched) - n)))


def measure(out: Path, trials: int) -> dict[str, Any]:
    """Rates and maps of every view."""
    from r2h_batch import Evaluator
    from r2h_batch.assets.receiving.contact_maps import contact_map
    from r2h_batch.methods.predictors.contacts import CONTACT_THRESHOLD
    from r2h_batch.report.table import record, table_of
    from r2h_batch.runs.store import load_run

    evaluator = Evaluator(load_benchmark())
    made = load_benchmark().trials(2 * trials)
    truth = [contact_map(o) >= CONTACT_THRESHOLD for o in evaluator.scene.objects]
    rows, whole = {}, None
    for number, (name, options) in enumerate(VIEWS.items()):
        folder = out / str(number)
        method = f"contact,{options}" if options else "contact"
        swept(folder, "--method", method, "--trials", trials, "--sim", "none", "--quiet")
        of = {row.split: record(row) for row in table_of(load_run(folder)).rows}
        found = {k: of["S1" if "S1" in heading else "Avg"][k] for k, heading in COLUMNS.items()}
        spec = {k: float(v) for k, _, v in (word.partition("=") for word in options.split(",") if word)}
        start = time.process_time()
        probability = maps(spec, evaluator.scene, made)
        touched = probability >= CONTACT_THRESHOLD
        whole = touched if whole is None else whole
        objects = made.object_index.tolist()
        areas = [area_under_curve(p, truth[o]) for p, o in zip(probability, objects, strict=True) if truth[o].any()]
        rows[name] = found | {
            "iou": float(((touched & whole).sum(1) / (touched | whole).sum(1)).mean()),
            "touched": float(touched.mean()),
            "auc": float(np.mean(areas)),
            "map_cpu_s": time.process_time() - start,
        }
    return {"trials": trials, "views": rows, **made_by()}


def table(data: dict[str, Any]) -> str:
    """Rates and maps of each view, as Markdown: percent; overlap of the touched points with those of the whole solid, their
    share, and how well the probabilities rank the points that people touch."""
    lines = [
        [name, *(f"{row[k]:.1f}" for k in COLUMNS), *(f"{row[k]:.2f}" for k in ("iou", "touched", "auc"))]
        for name, row in data["views"].items()
    ]
    return markdown_table(["The network sees", *COLUMNS.values(), "IoU", "touched", "AUC"], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "views")
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--render", action="store_true")
    options = parser.parse_args()
    if not options.render:
        STORED.write_text(json.dumps(measure(options.out, options.trials), indent=1) + "\n")
    print(table(json.loads(STORED.read_text())))


if __name__ == "__main__":
    main()
