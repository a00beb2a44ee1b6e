"""How many stored grasps could be picked from the table, by method and cause, and what judging that costs: docs/results/pick.md.

`python bench/pick.py` judges the grasps of the shipped rows of r2h-v2 (`r2h_batch.judge.picked`), measures with own code how far
the open gripper reaches below the table's top, and takes the time of both stages beside that of a kinematic trial.
"""

import argparse
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from _report import ROOT, Report, markdown_table
from run import Bench

from r2h_batch.verdicts import PickReason

RUN = ROOT / "r2h_batch" / "report" / "compare" / "rows" / "r2h-v2"
MEASURES = (
    "bench/pick.py",
    "kernels/robot",
    "kernels/plan",
    "r2h_batch/judge/least.py",
    "r2h_batch/judge/pick.py",
    "r2h_batch/judge/straight_way.py",
    "r2h_batch/observe/moment.py",
    "r2h_batch/scene/resting.py",
)
CAUSES = {
    "reach": (PickReason.OUT_OF_REACH,),
    "grasp": (PickReason.GRASP_COLLIDES,),
    "straight way": (PickReason.NO_STRAIGHT_WAY,),
    "way in": (PickReason.APPROACH_COLLIDES,),
    "pads": (PickReason.NOTHING_BETWEEN_PADS, PickReason.NOT_HELD),
    "closing": (PickReason.CLOSING_COLLIDES,),
    "lift": (PickReason.LIFT_COLLIDES,),
    "path": (
        PickReason.START_IN_COLLISION,
        PickReason.BEFORE_COLLIDES,
        PickReason.NO_PATH_IN_BUDGET,
        PickReason.NOT_EVALUATED,
        PickReason.PATH_COLLIDES,
    ),
}
"""Columns of the table, and the reasons that each counts."""
GOING_IN = (PickReason.GRASP_COLLIDES, PickReason.APPROACH_COLLIDES)
"""Reasons of which the table says what is met."""
MET = {"table": "table", "hand": "person", "self": "itself", "object_robot": "object"}
"""Pairs of the grasp and the way in, and what is met."""
TIMED = 512
CHECKED_FROM, CHECKED = 100, 10
"""Rows of each method that other code judges again: this many from this one on."""


def lowest_m(scene: Any, T_world_ee: np.ndarray) -> np.ndarray:
    """How high the lowest point of the open gripper is above the table's top (m), of grasps (n, 4, 4)."""
    from r2h_batch.scene.robot import ShapeKind, gripper_primitives_at

    robot, place = scene.robot, scene.config.workplace
    top = place.table_center[2] + place.table_half[2]
    g, low = robot.gripper, np.full(len(T_world_ee), np.inf)
    for i, T in enumerate(gripper_primitives_at(robot, robot.open_gap_m)):
        at = T_world_ee @ T
        kind, size, down = ShapeKind(g.kind[i]), g.size[i], at[:, 2, :3]
        if kind == ShapeKind.BOX:
            reach = np.abs(down) @ size
        elif kind == ShapeKind.CYLINDER:
            reach = np.hypot(down[:, 0], down[:, 1]) * size[0] + np.abs(down[:, 2]) * size[1]
        elif kind == ShapeKind.CAPSULE:
            reach = size[0] + np.abs(down[:, 2]) * size[1]
        elif kind == ShapeKind.SPHERE:
            reach = np.full(len(at), size[0])
        else:
            raise ValueError(f"primitive {g.names[i]} is a {kind.name}: this bench knows no corners of it")
        low = np.minimum(low, at[:, 2, 3] - reach - top)
    return low


def measured(_: argparse.Namespace, __: Report) -> Mapping[str, Any]:
    """All figures of the page."""
    from dataclasses import fields

    from _twins import PickTwin

    from r2h_batch.judge.pick import Picked, picked
    from r2h_batch.observe import moments
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.judge import Judge
    from r2h_batch.types import CollidingPair

    listed = [r for of in CAUSES.values() for r in of]
    assert sorted(listed) == sorted(set(PickReason) - {PickReason.OK}), "each reason in one column"
    run = load_run(RUN)
    judge = Judge(run)
    scene = judge.evaluator.scene
    methods: dict[str, Any] = {}
    clocks = np.zeros(3)
    offs: list[float] = []
    checked: list[dict[str, Any]] = []
    for entry in run.entries:
        poses = run.poses(entry.name).to_pylist()
        stored = {r["trial_id"]: r for r in run.trials(entry.name, ["trial_id", "object", "outcome"]).to_pylist()}
        ids = np.array([r["trial_id"] for r in poses])
        won = np.array([stored[i]["outcome"] == "success" for i in ids.tolist()])
        category = np.array([stored[i]["object"].rpartition("_")[0] for i in ids.tolist()])
        trials = judge.trials(ids)
        grasp, handover = (
            torch.tensor([r[k] for r in poses], dtype=torch.float32).reshape(-1, 4, 4)
            for k in ("T_obj_ee", "T_world_ee")
        )
        T_world_obj = moments(scene, trials)
        found = picked(scene, grasp, T_world_obj, trials)
        got, reason = found.picked.numpy(), found.reason.numpy()
        pair = found.pair.numpy()
        way = np.isin(reason, GOING_IN)
        low = lowest_m(scene, found.T_world_ee.double().numpy())
        offs += found.off_m[found.picked].tolist()
        for i in range(CHECKED_FROM, CHECKED_FROM + CHECKED):
            row = Picked(*(getattr(found, f.name)[i : i + 1] for f in fields(Picked)))
            words = PickTwin(scene, trials[i : i + 1], grasp[i], T_world_obj[i], row).wrong()
            checked.append({"method": entry.name, "trial": int(ids[i]), "picked": bool(got[i]), "wrong": words})
        methods[entry.name] = {
            "n": len(got),
            "picked": int(got.sum()),
            "won": int(won.sum()),
            "both": int((got & won).sum()),
            "causes": {k: int(np.isin(reason, of).sum()) for k, of in CAUSES.items()},
            "met": {k: int((way & (pair == CollidingPair[k.upper()])).sum()) for k in MET},
            "below": {f"{depth:g}": int((low < -1e-3 * depth).sum()) for depth in (0, 1, 10)},
            "categories": {c: int(got[category == c].sum()) for c in sorted({*category.tolist()})},
        }
        some = slice(0, TIMED)
        begin = time.process_time()
        T = moments(scene, trials[some])
        middle = time.process_time()
        picked(scene, grasp[some], T, trials[some])
        end = time.process_time()
        judge.evaluator.kinematic.score(grasp[some], handover[some], trials[some])
        clocks += [middle - begin, end - middle, time.process_time() - end]
        print(entry.name, methods[entry.name], clocks, flush=True)
    moment, pick, trial = 1e3 * clocks / (TIMED * len(methods))
    return {
        "methods": methods,
        "ms": {"moment": moment, "pick": pick, "trial": trial},
        "checked": checked,
        "category_of_rows": category.tolist(),
        "off_m": {"largest": max(offs), "median": float(np.median(offs))},
    }


def shown(data: Mapping[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    from r2h_batch.report.statistics.aggregate import wilson_interval
    from r2h_batch.report.text import short_names

    methods = data["methods"]
    short = short_names(list(methods))

    def share(hits: int, of: int) -> str:
        return f"{100 * hits / of:.1f}"

    def rate(hits: int, of: int) -> str:
        low, high = wilson_interval(np.array(hits), of)
        return f"{share(hits, of)} ({100 * float(low):.1f}-{100 * float(high):.1f})"

    stages = [
        [
            short[k],
            rate(m["picked"], m["n"]),
            *(share(m["causes"][c], m["n"]) for c in CAUSES),
        ]
        for k, m in methods.items()
    ]
    below = [[short[k], *(share(x, m["n"]) for x in m["below"].values())] for k, m in methods.items()]
    met = [[short[k], *(share(x, m["n"]) for x in m["met"].values())] for k, m in methods.items()]
    joint = [
        [short[k], share(m["won"], m["n"]), rate(m["both"], m["n"]), rate(m["both"], m["won"])]
        for k, m in methods.items()
    ]
    sided = [
        m["below"]["0"] / m["n"]
        for k, m in methods.items()
        if short[k].split("-")[0] in ("FC", "Contact", "Intent", "oracle")
    ]
    above = next(m["below"]["0"] / m["n"] for k, m in methods.items() if "VA" in short[k])
    rows_of = {c: sum(x == c for x in data["category_of_rows"]) for c in data["category_of_rows"]}
    by_category = [
        [c.replace("_", " "), *(share(m["categories"][c], rows_of[c]) for m in methods.values())]
        for c in sorted(rows_of)
    ]
    ms, checked = data["ms"], data["checked"]
    return {
        "of_each": next(iter(methods.values()))["n"],
        "stages": markdown_table(["", "picked", *CAUSES], stages),
        "below": markdown_table(["", "below the table", "by over 1 mm", "by over 10 mm"], below),
        "sided_least": 100 * min(sided),
        "sided_most": 100 * max(sided),
        "above": 100 * above,
        "categories": markdown_table(["", *(short[k] for k in methods)], by_category),
        "met": markdown_table(["", *MET.values()], met),
        "joint": markdown_table(["", "success", "picked and success", "of the successes"], joint),
        "timed": TIMED,
        "checked": len(checked),
        "wrong": sum(bool(c["wrong"]) for c in checked),
        "passing": sum(c["picked"] for c in checked),
        **{f"{name}_ms": spent for name, spent in ms.items()},
        "ratio": ms["pick"] / ms["trial"],
        "off_um": 1e6 * data["off_m"]["largest"],
        "off_median_um": 1e6 * data["off_m"]["median"],
    }


BENCH = Bench(
    __doc__, measured, MEASURES, peer="own twins in float64 (NumPy, MuJoCo C for convex bodies)", stored="pick"
)

if __name__ == "__main__":
    BENCH.main()
