"""How methods bear errors of execution, and what weight their grasps carry: docs/results/robustness.{md,png}.

`python bench/robustness.py --out FOLDER` sweeps all methods on the default benchmark, the motion as planned, without errors and
with four (`--set robustness=true`; the same FOLDER goes on). The grasps without errors are then looked at in closed form
(`judge.payload`), and every so manieth of them is closed in a simulator (`judge.grasp_physics`) under 1, 2 and 3 times the
object's weight, at its handover pose, for 1.8 s. `--render` writes the page again from the JSON.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table, page_from, swept
from _rows import keep, rate_of

METHODS = ("fc", "handover-va", "contact", "intent", "oracle", "random")
PAGE = ROOT / "docs" / "results" / "robustness.md"
MEASURES = (
    "bench/robustness.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/prepared.py",
    "r2h_batch/methods",
    "r2h_batch/report/robustness.py",
)
ROWS = "bench/options/robustness"
"""Its rows, a folder a level."""
WEIGHTS = (1, 2, 3)
TURNED_DEG = 10.0
"""An object that turns farther than this in the closed gripper has turned [choice]."""

HEAD = """# Robustness: errors of execution, and weight

Compare methods under [errors of execution](../choices.md#errors-estimates-candidates). `python bench/robustness.py`
measured {trials} trials of each split of {benchmark}, `--sim none` (bench/results/robustness.json; commit {commit}). For
your method run `r2h-batch sweep --method mine.py:predict --set robustness=true --out runs/robust`.

![SR over the execution error](robustness.png)

## Success rates

Percent of all trials, mean of the splits, with 95 % intervals for the mean of all categories of objects. Bars of the picture
are for more trials with these objects. Area: mean SR over the errors from 0 to 20 mm, with its 95 % t interval over
categories.

{rates}

## Weight

Two pads hold the object by friction ({grip:g} N each, coefficient {mu:g}). The lever is the distance of the
centre of mass from the pads' axis. In some grasps that pass Stability the object turns or slips. The table has their percentage
under 1 / 2 / 3 times the object's weight (closed form, `r2h_batch.judge.payload`).

{weight}

The closed form assumes that the whole pad is in contact, so it overestimates grasps of round and narrow objects.
We also simulated {n} grasps in MuJoCo C. There a grasp fails if the object turns by more than {turned:g} degrees or slips by
2 cm.

| fails in | grasps |
| --- | --: |
| the closed form only | {wrong} |
| MuJoCo C only, under 1, 2 and 3 times the weight | {more} |
"""


def grasps_of(folder: Path, method: str, evaluator: Any) -> Any:
    """Scores of the stored poses of a method, without paths."""
    import torch

    from r2h_batch import load_benchmark
    from r2h_batch.runs.store import load_run

    run = load_run(folder)
    rows = [row for table in run.shards("poses", run.named(method)) for row in table.to_pylist()]
    poses = [torch.tensor([row[k] for row in rows]).reshape(-1, 4, 4) for k in ("T_obj_ee", "T_world_ee")]
    trials = load_benchmark().trials_with_ids(torch.tensor([row["trial_id"] for row in rows]))
    return evaluator.score(*poses, trials, stages="pose")


def closed_forms(scores: Any) -> dict[str, Any]:
    """Shares of the held grasps that turn or slip, percent."""
    from r2h_batch.judge.payload import payload

    found = payload(scores)
    held = np.isfinite(found.payload_factor)

    def shares(factor: np.ndarray) -> list[float]:
        return [100 * float((factor[held] < w).mean()) for w in WEIGHTS]

    return {
        "grasps": int(held.sum()),
        "lever_mm": 1000 * float(np.median(found.lever_m[held])),
        "pivot_torque_nm": float(np.median(found.pivot_torque_nm[held])),
        "at_pose": shares(found.payload_factor),
        "on_the_way": shares(found.any_posture_factor),
    }


def in_physics(scores: Any, n: int) -> list[dict[str, Any]]:
    """n held grasps, spread over the trials: their factor, and whether each weight turned or moved them."""
    from r2h_batch.judge.grasp import attach
    from r2h_batch.judge.grasp_physics import close_in_physics
    from r2h_batch.judge.payload import payload

    factor = payload(scores).payload_factor
    held = np.flatnonzero(np.isfinite(factor))
    rows = held[np.linspace(0, len(held) - 1, n).round().astype(int)]
    inputs, scene = scores.inputs, scores.inputs.evaluator.scene
    objects = scene.objects
    attached = attach(inputs.T_obj_ee, scores.grasp_shift_m).double().numpy()[rows]
    down = -inputs.T_world_ee[:, 2, :3].double().numpy()[rows]
    index = inputs.trials.object_index.numpy()[rows]
    found: list[dict[str, Any]] = [
        {"object": objects[i].name, "factor": float(f), "turned_deg": [], "slip_m": []}
        for i, f in zip(index, factor[rows], strict=True)
    ]
    for w in WEIGHTS:
        heavier = [replace(o, mass=w * o.mass, inertia=w * o.inertia) for o in objects]
        closed = close_in_physics(heavier, index, attached, scene.robot, shake=True, shake_m_s2=0.0, down_ee=down)
        for row, turned, slip in zip(found, closed.turned_rad, closed.slip_m, strict=True):
            row["turned_deg"].append(round(float(np.degrees(turned)), 2))
            row["slip_m"].append(round(float(slip), 5))
    return found


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The sweeps, and both views of the grasps."""
    from r2h_batch import Evaluator, load_benchmark
    from r2h_batch.report.robustness import LEVELS, figure, render, robustness
    from r2h_batch.report.table import record, table_of
    from r2h_batch.runs.store import load_run

    out, trials = options.out, options.trials
    swept(
        out,
        "--method",
        *METHODS,
        "--trials",
        trials,
        "--sim",
        "none",
        "--set",
        "robustness=true",
    )
    runs = [load_run(out / level) for level in LEVELS]
    found = robustness(runs)
    rates: dict[str, list[str]] = {}
    for run in runs:
        for row in table_of(run).rows:
            if row.split == "Avg":
                rates.setdefault(row.method.partition(" (")[0], []).append(rate_of(record(row)))
    figure(found).savefig(PAGE.with_suffix(".png"), dpi=110)
    for level in LEVELS:
        keep(out / level, ROOT / ROWS / level)
    evaluator = Evaluator(load_benchmark())
    weight, simulated = {}, {}
    for curve in found.curves:
        name = curve.method.partition(" (")[0]
        scores = grasps_of(out / LEVELS[0], curve.method, evaluator)
        weight[name], simulated[name] = closed_forms(scores), in_physics(scores, options.physics)
    return {
        "trials": trials,
        "benchmark": load_benchmark().name,
        "rates": rates,
        "curves": json.loads(render(found, "json"))["curves"],
        "tables": render(found),
        "payload": weight,
        "physics": simulated,
        **made_by(MEASURES),
    }


def markdown(data: dict[str, Any]) -> str:
    """The page."""
    from r2h_batch.judge.grasp_physics import DROPPED_M, FRICTION
    from r2h_batch.judge.payload import GRIP_N
    from r2h_batch.report.robustness import LEVELS

    def three(values: Sequence[float]) -> str:
        return " / ".join(f"{v:.1f}" for v in values)

    weight = [
        [name, p["grasps"], f"{p['lever_mm']:.0f}", three(p["at_pose"]), three(p["on_the_way"])]
        for name, p in data["payload"].items()
    ]
    every = [row for rows in data["physics"].values() for row in rows]
    factor = np.array([row["factor"] for row in every])
    turned, slip = (np.array([row[k] for row in every]) for k in ("turned_deg", "slip_m"))
    simulated = (turned > TURNED_DEG) | (slip > DROPPED_M)  # (n, weights)
    closed = factor[:, None] < np.array(WEIGHTS)
    levels = [level.replace("mm,", " mm, ").replace("deg", " deg") for level in LEVELS]
    curves = {c["method"].partition(" (")[0]: c for c in data["curves"]}
    rates = [
        [
            m,
            *data["rates"][m],
            "{value:.1f} +-{half:.1f}".format(**c["area"]),
        ]
        for m, c in curves.items()
    ]
    more = (~closed & simulated).sum(0)
    return HEAD.format(
        trials=data["trials"],
        benchmark=data["benchmark"],
        commit=str(data["commit"])[:12],
        rates=markdown_table(["Method", *levels, "area"], rates),
        grip=GRIP_N,
        mu=FRICTION,
        weight=markdown_table(["Method", "grasps", "lever, mm", "at the pose", "in the worst posture"], weight),
        n=len(every),
        wrong=(closed & ~simulated).sum(),
        more=", ".join(map(str, more)),
        turned=TURNED_DEG,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "robustness")
    parser.add_argument("--trials", type=int, default=100, help="of each split")
    parser.add_argument(
        "--physics", type=int, default=24, help="grasps of each method that are closed in the simulator"
    )
    page_from(parser, ROOT / "bench" / "results" / "robustness.json", PAGE, measure, markdown)


if __name__ == "__main__":
    main()
