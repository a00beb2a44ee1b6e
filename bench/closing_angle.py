"""Whether the angle of the contacts says what a closing gripper loses: docs/results/closing_angle.md.

`python bench/closing_angle.py` takes the shipped rows of r2h-v2 that pass Stability, of every method the first `--trials` of each
split. MuJoCo C says which contacts the pads have where the geometry closes them. A contact can stay only if its normal is
within arctan 0.8 of the closing axis. The bench asks how often this line says the same as the settled simulation
(`results held`). `--render` writes the page again from the JSON.
"""

import argparse
from collections import Counter
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table, page_from
from transfer import stored_poses

PAGE = ROOT / "docs" / "results" / "closing_angle.md"
STORED = ROOT / "bench" / "results" / "closing_angle.json"
BASELINES = ROOT / "r2h_batch" / "report" / "compare" / "rows" / "r2h-v2"
MEASURES = (
    "bench/closing_angle.py",
    "r2h_batch/closed_loop/transfer",
    "r2h_batch/judge/grasp_physics.py",
)
RULES = {
    "one contact": "each pad has a contact within the angle",
    "all contacts": "all contacts are within the angle",
    "mean normal": "on each pad the mean normal is within the angle",
    "line": "the line between the middles of the contacts is within the angle of both mean normals",
}
"""Measures that could stand in Stability, by a short name."""

HEAD = """# Closing angle: can one line of geometry say what a closing gripper loses?

Stability passes grasps that the closing fingers push away ([definitions](../transfer.md#physically-stable)). Friction 0.8 holds
a contact whose normal is within {limit:.1f} degrees of the force. `python bench/closing_angle.py --trials {trials}` took
the first {trials} trials of each split of r2h-v2 and all six methods. These are {n} grasps that pass Stability, with {objects}
objects (bench/results/closing_angle.json, commit {commit}; load of the machine at the start {load}). The contacts are MuJoCo C's,
of pads and convex pieces, where the geometry closes the gripper. The settled simulation says what closing loses: {lost} of {n}.

## One line against the simulation

`caught`: of the grasps that closing loses, those that the line refuses. `refused though held`: of the grasps that closing does
not lose. `agree`: of all. A line that refuses nothing agrees in {nothing:.1f} %. Of the grasps that closing loses, {near} are
within 3 mm of the limit.

{rules}

## Other limits

The same for `{best}` with other angles.

{limits}

## By method

{methods}

## Objects

Where `{best}` and the simulation disagree most.

{objects_table}
"""


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """All figures of the page: a row for each grasp."""
    from r2h_batch.closed_loop.transfer.handed import gripped_of
    from r2h_batch.closed_loop.transfer.held import hold
    from r2h_batch.closed_loop.transfer.model import Setting
    from r2h_batch.closed_loop.transfer.worlds_mujoco import Models
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.reevaluation import Judge

    about = made_by(MEASURES)
    run = load_run(BASELINES)
    judge = Judge(run)
    scene, rows = judge.evaluator.scene, []
    models = Models(scene.robot, tuple(scene.objects), Setting())
    for name in run.methods:
        stored = np.sort(run.trials(name, ["trial_id"])["trial_id"].to_numpy())
        ids = np.sort(np.concatenate([stored[stored % 2 == split][: options.trials] for split in (0, 1)]))
        poses = stored_poses(run, name, ids)
        scores = judge.evaluator.kinematic.score(
            poses["T_obj_ee"], poses["T_world_ee"], judge.trials(ids), stages="pose"
        )
        gripped = gripped_of(scores, ids)
        for i in range(len(gripped)):
            row = gripped[i : i + 1]
            one = hold(models, row)
            rows.append(
                {
                    "method": name,
                    "trial": int(row.trial_id[0]),
                    "object": scene.objects[row.object_index[0]].name,
                    "lost": None if one.lost is None else str(one.lost),
                    "near": one.near_limit(),
                    **angles_of(models, row),
                }
            )
        print(name, len(gripped), Counter(r["lost"] for r in rows if r["method"] == name), flush=True)
    return {"trials": options.trials, "grasps": [line_of(r) for r in rows], **about}


FIELDS = ("method", "trial", "object", "lost", "near", *RULES)


def line_of(row: dict[str, Any]) -> str:
    """A grasp as one line of text; angles to a thousandth of a degree."""
    return ";".join(f"{row[k]:.3f}" if isinstance(row[k], float) else str(row[k]) for k in FIELDS)


def row_of(line: str) -> dict[str, Any]:
    """The grasp of `line_of`."""
    words = {k: None if w == "None" else w for k, w in zip(FIELDS, line.split(";"), strict=True)}
    angles = {k: None if (w := words[k]) is None else float(w) for k in RULES}
    return {**words, "near": words["near"] == "True", **angles}


def angles_of(models: Any, row: Any) -> dict[str, float | None]:
    """Degrees that decide each rule, at the posture of the closed gripper; None: a pad touches nothing there."""

    from r2h_batch.closed_loop.transfer.friction import CLOSING_AXIS, PadContacts
    from r2h_batch.closed_loop.transfer.model import Places, start_posture

    m, d = models.ajar(row)
    d.qpos[:] = start_posture(m, models.robot, float(row.opening_m[0]))
    contacts = PadContacts.of(m, d, Places.of(m))
    if len(set(contacts.side.tolist())) < 2:
        return dict.fromkeys(RULES)
    # the left pad, side 0, presses along +y
    axis = np.eye(3)[CLOSING_AXIS] * np.where(contacts.side == 0, 1.0, -1.0)[:, None]
    each = degrees((contacts.normal * axis).sum(1))
    middle = np.array([contacts.at[contacts.side == s].mean(0) for s in (0, 1)])
    normal = np.array([contacts.normal[contacts.side == s].mean(0) for s in (0, 1)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    line = (middle[1] - middle[0]) / np.linalg.norm(middle[1] - middle[0])
    return {
        "one contact": float(max(each[contacts.side == s].min() for s in (0, 1))),
        "all contacts": float(each.max()),
        "mean normal": float(degrees(normal[:, CLOSING_AXIS] * [1.0, -1.0]).max()),
        "line": float(degrees(normal @ line * [1.0, -1.0]).max()),
    }


def degrees(cosine: Any) -> Any:
    """Angles of cosines."""
    return np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))


def counts(rows: list[dict[str, Any]], rule: str, limit: float) -> dict[str, int]:
    """Lost and refused, lost, held and refused, held, and agreeing grasps. A pad that touches nothing is refused."""
    lost = np.array([r["lost"] == "closing" for r in rows], bool)
    refused = np.array([r[rule] is None or r[rule] > limit for r in rows], bool)
    return {
        "caught": int((lost & refused).sum()),
        "lost": int(lost.sum()),
        "wrong": int((~lost & refused).sum()),
        "kept": int((~lost).sum()),
        "agree": int((lost == refused).sum()),
    }


def markdown(data: dict[str, Any]) -> str:
    """The page."""
    from r2h_batch.judge.grasp_physics import FRICTION
    from r2h_batch.report.statistics.aggregate import wilson_interval

    rows, limit = [row_of(line) for line in data["grasps"]], float(np.rad2deg(np.arctan(FRICTION)))

    def rate(count: int, n: int) -> str:
        low, high = wilson_interval(count, n)
        return f"{100 * count / n:.1f} [{100 * float(low):.1f}, {100 * float(high):.1f}]" if n else "-"

    def cells(some: list[dict[str, Any]], rule: str, at: float) -> list[str]:
        c = counts(some, rule, at)
        return [rate(c["caught"], c["lost"]), rate(c["wrong"], c["kept"]), rate(c["agree"], len(some))]

    best = max(RULES, key=lambda rule: counts(rows, rule, limit)["agree"])
    head = ["caught, %", "refused though held, %", "agree, %"]
    methods = [
        [name, len(some), sum(r["lost"] == "closing" for r in some), *cells(some, best, limit)]
        for name in dict.fromkeys(r["method"] for r in rows)
        if (some := [r for r in rows if r["method"] == name])
    ]
    wrong: Counter[str] = Counter()
    for r in rows:
        c = counts([r], best, limit)
        wrong[r["object"].rsplit("_", 1)[0]] += 1 - c["agree"]
    table = []
    for word, _ in wrong.most_common(6):
        some = [r for r in rows if r["object"].rsplit("_", 1)[0] == word]
        c = counts(some, best, limit)
        table.append([word.replace("_", " "), len(some), c["lost"], c["caught"], c["wrong"]])
    return HEAD.format(
        limit=limit,
        trials=data["trials"],
        n=len(rows),
        objects=len({r["object"] for r in rows}),
        lost=sum(r["lost"] == "closing" for r in rows),
        near=sum(r["lost"] == "closing" and r["near"] for r in rows),
        nothing=100 * sum(r["lost"] != "closing" for r in rows) / len(rows),
        commit=str(data["commit"])[:12],
        load=data["hardware"]["load_at_start"],
        best=best,
        rules=markdown_table(
            ["a grasp stays if", *head], [[words, *cells(rows, r, limit)] for r, words in RULES.items()]
        ),
        limits=markdown_table(
            ["limit, degrees", *head], [[f"{at:.1f}", *cells(rows, best, at)] for at in (20, 30, limit, 45, 55, 65)]
        ),
        methods=markdown_table(["Method", "n", "lost in closing", *head], methods),
        objects_table=markdown_table(["objects", "n", "lost", "caught", "refused though held"], table),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=180, help="of each split")
    page_from(parser, STORED, PAGE, measure, markdown)


if __name__ == "__main__":
    main()
