"""How many stored grasps could be picked from the table, by method and cause, and what judging that costs: docs/results/pick.md.

`python bench/pick.py` judges the grasps of the shipped rows of r2h-v2 (`r2h_batch.judge.picked`), measures with own code how far
the open gripper reaches below the table's top, and takes the time of both stages beside that of a kinematic trial. `--render`
writes the page again from the JSON.
"""

import argparse
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from _report import ROOT, made_by, markdown_table, page_from

from r2h_batch.verdicts import PickReason

PAGE = ROOT / "docs" / "results" / "pick.md"
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
WHY_VA = """Its grasps come
from above. But with the pads about the middle of a thin thing the fingertips would have to reach into the table.

By category, percent picked:"""

HEAD = """# Picking from the table: results

A trial of r2h-v2 begins with the object in the gripper. `python bench/pick.py` asks of every stored grasp whether the arm could
have got it there ([Pick](../pick.md)). It took {trials} trials of each method (bench/results/pick.json, commit {commit}, load
{load:g} at the start). A sweep of [r2h-v3-draft](../pick.md#the-draft-r2h-v3) asks
your method for it.

Percent of the trials. A grasp that fails counts once, in the stage that fails first. Brackets: 95 %, Wilson.

{stages}

**No built-in method looks at the table.** FC, Contact, Intent and the oracle choose grasps from all sides, and the table
forbids most of them. Handover-VA grasps from above. Own code (NumPy, float64) put the corners of the open gripper where the
grasp is. It measured how far the lowest corner is below the table's top. The way in plays no part here:

{below}

An earlier prototype had 58 to 69 % for FC, Contact, Intent and the oracle, and no grasp of Handover-VA's. {verdict}

{categories}

What the robot meets at the grasp and on the way in, percent of the trials. The pair is the one that decides the margin; where
several meet, it is one of them.

{met}

If a trial must be picked before it is handed over, it succeeds where picking and handover both succeed:

{joint}

## Cost

Process milliseconds of one core a row, on {timed} rows of each method: drawing the moment takes {moment:.1f}, and Pick
{pick:.1f}. A kinematic trial (`--sim none`, all stages) takes {trial:.1f} on the same rows. Pick costs {ratio:.2f} times that
(asked: with the carry at most 2). The ways in and up leave the straight line by at most {off_um:.0f} um in the rows that are
picked (median {off_median_um:.1f} um).

## Checked by other code

Other code judged {checked} of these rows again in float64: {wrong} wrong{words}. {passing} of them pass.
`tests/support/pick_twin.py` takes MuJoCo C for convex bodies, with own fingers and hulls, and NumPy for the object's surface.
It samples ways every millimetre. For these it confirms every stage, and for the others the stage that fails. For a gripper that
meets table or person it also confirms that no other branch helps. A verdict within 0.2 mm of the border may differ. A margin
may be below that of the samples by 0.1 mm or a tenth, and above it by a sample's step.
"""


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


def measured(options: argparse.Namespace) -> Mapping[str, Any]:
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
        **made_by(MEASURES),
    }


def markdown(data: Any) -> str:
    """The page."""
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
    low, high = 100 * min(sided), 100 * max(sided)
    verdict = f"Here they are {low:.0f} to {high:.0f} %, and {100 * above:.0f} % for Handover-VA. {WHY_VA}"
    rows_of = {c: sum(x == c for x in data["category_of_rows"]) for c in data["category_of_rows"]}
    by_category = [
        [c.replace("_", " "), *(share(m["categories"][c], rows_of[c]) for m in methods.values())]
        for c in sorted(rows_of)
    ]
    ms, checked = data["ms"], data["checked"]
    wrong = [f"{short[c['method']]}, trial {c['trial']}: {c['wrong']}" for c in checked if c["wrong"]]
    return HEAD.format(
        trials=next(iter(methods.values()))["n"],
        commit=data["commit"][:12],
        load=data["hardware"]["load_at_start"],
        stages=markdown_table(["", "picked", *CAUSES], stages),
        below=markdown_table(["", "below the table", "by over 1 mm", "by over 10 mm"], below),
        verdict=verdict,
        categories=markdown_table(["", *(short[k] for k in methods)], by_category),
        met=markdown_table(["", *MET.values()], met),
        joint=markdown_table(["", "success", "picked and success", "of the successes"], joint),
        timed=TIMED,
        checked=len(checked),
        wrong=len(wrong),
        words=f" ({'; '.join(wrong)})" if wrong else "",
        passing=sum(c["picked"] for c in checked),
        moment=ms["moment"],
        pick=ms["pick"],
        trial=ms["trial"],
        ratio=ms["pick"] / ms["trial"],
        off_um=1e6 * data["off_m"]["largest"],
        off_median_um=1e6 * data["off_m"]["median"],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    page_from(parser, ROOT / "bench" / "results" / "pick.json", PAGE, measured, markdown)


if __name__ == "__main__":
    main()
