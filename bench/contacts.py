"""Contacts of gripped objects: docs/results/contacts.md.

`python bench/contacts.py` closes the gripper on the first 40 rows of Handover-VA and of the oracle in r2h-v1, at the step of the
simulation, half and a quarter of it, and asks what it holds, how far settled grasps drift without weight, and whether statics say
the same. It repeats this with smaller and larger patches of torsion. It does the same for the transfers of the oracle's received
rows. It holds MuJoCo-Warp against MuJoCo C on some of them, and measures the cost beside the contacts of MuJoCo's defaults, by
turns. `--render` writes the page again from the JSON. It takes ten minutes of CPU time.
"""

import argparse
import time
from collections import Counter
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table, page_from

PAGE = ROOT / "docs" / "results" / "contacts.md"
STORED = ROOT / "bench" / "results" / "contacts.json"
BASELINES = ROOT / "bench" / "rows" / "v1"
METHODS = ("Handover-VA (oracle labels + noise)", "oracle")
ROWS = 40
"""Rows of each method: all pass Stability."""
FINER = (1, 2, 4)
"""Divisors of the step."""
TORSIONS_MM = (2.5, 5.0, 8.0)
COMPARED = (("load-share", "take"), ("threshold", "take"), ("load-share", "touch"))
ENGINES_ROWS = 12
"""Received rows on which the engines are compared: those of `ENGINES_FIRST`, and the first others."""
ENGINES_FIRST = (18,)
"""Eyeglasses: with impratio 1,000 the engines are 9.5 mm apart."""
SMALL_M = 0.003
MEASURES = (
    "bench/contacts.py",
    "r2h_batch/closed_loop/transfer",
    "r2h_batch/judge/grasp_physics.py",
)
DEFAULTS: dict[str, Any] = {"impratio": 10.0, "solimp": (0.9, 0.95, 0.001, 0.5, 2.0), "steps": 4, "tolerance": 1e-8}
"""Contacts before: MuJoCo's impedance and tolerance, and a time constant of four steps."""

HEAD = """# Contacts: what a closed gripper holds at any step

See whether an outcome belongs to the grasp or to the solver ([definitions](../transfer.md#physically-stable)). `python
bench/contacts.py` measured this on the first {rows} rows of Handover-VA and of the oracle in r2h-v1, all past Stability
(bench/results/contacts.json, commit {commit}).

## Held and lost

`differ`: rows with another result than at the step h = {step:.2f} ms. `drift`: the largest slip of a settled grasp in 1 s without
weight. `undecided`: within {near:g} mm of a limit, or half the step says otherwise.

{held}

## Statics

Rows by what the friction program says of the settled posture, and what the simulation shows (step h).

{statics}

## Torsion

Rows that are held, and rows that statics carry, of both methods, with other radii of the pads' patches.

{torsion}

## Transfers

Outcomes of the oracle's {received} received rows in {cases}. `differ`: outcomes that are not those of the step h.

{transfers}

## Two engines

Slip in the gripper in `take`, over {engines_rows} received rows (among them the eyeglasses of trial 18). MuJoCo-Warp differs from
MuJoCo C by {median:.3f} mm (median) and {largest:.2f} mm (largest). On both engines the contacts are the same.

## Cost

By turns on the same rows, against the contacts before (MuJoCo's impedance and tolerance, impratio 10, four steps). Process time
of one core; load of the machine at the start {load}. A grasp of `results held` is closed, settled and weighed, has its friction
program, and is simulated with half the step too where it moves.

{cost}
"""


def gripped_rows(run: Any, judge: Any) -> tuple[dict[str, Any], Any]:
    """Method -> the first rows of its grasps, and the oracle's received handovers."""
    import torch

    from r2h_batch.closed_loop.transfer.handed import gripped_of, handed_of
    from r2h_batch.judge.reception import reception

    ids, found, received = np.arange(ROWS), {}, None
    for name in METHODS:
        rows = {r["trial_id"]: r for r in run.poses(name).to_pylist() if r["trial_id"] < ROWS}
        poses = (
            torch.tensor(np.array([rows[i][k] for i in ids.tolist()], np.float32)).reshape(-1, 4, 4)
            for k in ("T_obj_ee", "T_world_ee")
        )
        asked, evaluator = judge.trials(ids), judge.evaluator.kinematic
        scores = evaluator.score(*poses, asked, stages="pose")
        found[name] = gripped_of(scores, ids)
        if name == "oracle":
            received = handed_of(reception(scores), ids, asked, evaluator.scene)
    return found, received


def held_at(models: Any, rows: Any) -> dict[str, Any]:
    """Whether rows are held, and how far held ones drift without weight."""
    from r2h_batch.closed_loop.transfer.held import hold

    found = [hold(models, rows[i : i + 1]) for i in range(len(rows))]
    still = [hold(models, rows[i : i + 1], weight=False) for i in range(len(rows))]
    drift = [one.slip_m for one in still if one.lost is None and one.settled]
    return {
        "lost": [str(one.lost or "held") for one in found],
        "slip_m": [one.slip_m for one in found],
        "squeezed_m": [one.squeezed_m for one in found],
        "carries": [bool(one.carries >= 1.0) for one in found],
        "drift_m": max(drift),
    }


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """All figures of the page."""
    from r2h_batch.closed_loop.transfer.cases import Case, Simulator
    from r2h_batch.closed_loop.transfer.held import Holding
    from r2h_batch.closed_loop.transfer.model import STEPS, Setting
    from r2h_batch.closed_loop.transfer.worlds_mujoco import Models
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.reevaluation import Judge

    run = load_run(BASELINES)
    judge = Judge(run)
    scene = judge.evaluator.scene
    robot, objects = scene.robot, tuple(scene.objects)
    rows, received = gripped_rows(run, judge)
    print({k: len(v) for k, v in rows.items()}, "received", len(received), flush=True)

    held: dict[str, Any] = {}
    for name, own in rows.items():
        at = {n: held_at(Models(robot, objects, Setting(steps=n * STEPS)), own) for n in FINER}
        undecided = Holding(Models(robot, objects, Setting()))(own).undecided
        held[name] = {"at": at, "undecided": int(undecided.sum()), "n": len(own)}
        print(name, [(n, Counter(a["lost"]), a["drift_m"]) for n, a in at.items()], int(undecided.sum()), flush=True)
    torsion = {
        mm: {name: held_at(Models(robot, objects, Setting(torsion_m=mm / 1e3)), own) for name, own in rows.items()}
        for mm in TORSIONS_MM
    }

    cases = [Case(r, s, 0) for r, s in COMPARED]
    transfers = {}
    for n in FINER:
        simulator = Simulator(robot, objects, Setting(steps=n * STEPS), 0)
        made = (simulator if n == 1 else simulator.once)(received, cases)
        transfers[n] = [{"outcome": m.transfers.outcome, "undecided": m.transfers.undecided.tolist()} for m in made]
        print("transfers at h /", n, flush=True)
    return {
        "held": held,
        "torsion": torsion,
        "transfers": transfers,
        "trials": received.trial_id.tolist(),
        "engines": engines(robot, objects, received),
        "cost": cost(robot, objects, rows, received),
        **made_by(MEASURES),
    }


def engines(robot: Any, objects: Any, handed: Any) -> dict[str, Any]:
    """How far slips in the gripper are apart between MuJoCo C and MuJoCo-Warp on this CPU."""
    from r2h_batch.closed_loop.transfer.batched import BatchedSimulator
    from r2h_batch.closed_loop.transfer.cases import Case, Simulator
    from r2h_batch.closed_loop.transfer.model import Setting

    first = np.isin(handed.trial_id, ENGINES_FIRST)
    order = np.r_[np.flatnonzero(first), np.flatnonzero(~first)][:ENGINES_ROWS]
    rows, case = handed[order], [Case("load-share", "take", 0)]
    given = robot, objects, Setting(), 0
    (ours,), ((theirs, _),) = Simulator(*given).once(rows, case), BatchedSimulator(*given).worlds(rows, case)
    off = np.abs(ours.transfers.robot_slip_m - theirs.transfers.robot_slip_m)
    found = {"trials": rows.trial_id.tolist(), "median_m": float(np.median(off)), "largest_m": float(off.max())}
    print("engines", found, flush=True)
    return found


def cost(robot: Any, objects: Any, rows: dict[str, Any], handed: Any) -> dict[str, Any]:
    """Core milliseconds of a grasp and of a transfer with both contacts, and the median ratio, by turns."""
    from r2h_batch.closed_loop.transfer.cases import Case, Simulator
    from r2h_batch.closed_loop.transfer.held import Holding
    from r2h_batch.closed_loop.transfer.model import Setting

    both = [Simulator(robot, objects, Setting(), 0) for _ in range(2)]
    for index in set(handed.object_index.tolist()).union(*(set(r.object_index.tolist()) for r in rows.values())):
        for one in both:
            one.models.of(index)
        as_before(both[0].models.of(index))
    cases = [Case(r, s, 0) for r, s in COMPARED]
    grasps, transfers, whole = [], [], []
    for own in rows.values():
        for i in range(0, len(own), 2):
            grasps.append([timed(closed_for_1_s, one.models, own[i : i + 1]) for one in both])
            holding = Holding(both[1].models)
            holding(own[i : i + 1])  # compiles
            whole.append(timed(holding, own[i : i + 1]))
    for i in range(0, len(handed), 2):
        transfers.append([timed(one.once, handed[i : i + 1], cases) / len(cases) for one in both])
    found: dict[str, list[float | None]] = {"grasp of `results held`": [None, float(np.mean(whole)), None, None]}
    for what, pairs in (("closing, then 1 s of weight", np.array(grasps)), ("transfer", np.array(transfers))):
        mean = pairs.mean(0).tolist()
        found[what] = [*mean, float(mean[1] / mean[0]), float(np.median(pairs[:, 1] / pairs[:, 0]))]
        print(what, found[what], flush=True)
    return found


def closed_for_1_s(models: Any, row: Any) -> None:
    """Closes a gripper and lets the weight act for 1 s, whatever happens: as many steps with any contacts."""
    import mujoco

    from r2h_batch.closed_loop.transfer.model import TICK_S
    from r2h_batch.closed_loop.transfer.worlds_mujoco import SETTLE_TICKS

    closed = models.close(row)
    mujoco.mj_step(closed.model, closed.data, (round(1.0 / TICK_S) - SETTLE_TICKS) * models.setting.steps)


def as_before(m: Any) -> None:
    """Gives a compiled model the contacts of MuJoCo's defaults."""
    m.opt.impratio, m.opt.tolerance = DEFAULTS["impratio"], DEFAULTS["tolerance"]
    m.geom_solimp[:] = DEFAULTS["solimp"]
    m.geom_solref[:, 0] = DEFAULTS["steps"] * m.opt.timestep


def timed(call: Any, *arguments: Any) -> float:
    """Process milliseconds of a call."""
    begin = time.process_time()
    call(*arguments)
    return 1e3 * (time.process_time() - begin)


def markdown(data: dict[str, Any]) -> str:
    """The page."""
    from r2h_batch.closed_loop.transfer.held import NEAR_M
    from r2h_batch.closed_loop.transfer.model import STEPS, TICK_S

    def at(n: int) -> str:
        return "h" if n == 1 else f"h/{n}"

    held, statics = [], Counter[tuple[bool, str]]()
    for name, found in data["held"].items():
        one = found["at"]["1"]
        for n in FINER:
            own = found["at"][str(n)]
            counts = Counter(own["lost"])
            differ = sum(a != b for a, b in zip(one["lost"], own["lost"], strict=True))
            cells = [counts[k] for k in ("held", "closing", "weight")]
            doubt = found["undecided"] if n == 1 else ""
            held.append([name, at(n), found["n"], *cells, differ, f"{1e3 * own['drift_m']:.2f} mm", doubt])
        for carries, lost, slip in zip(one["carries"], one["lost"], one["slip_m"], strict=True):
            moved = f"held, slips less than {1e3 * SMALL_M:g} mm" if lost == "held" and slip < SMALL_M else lost
            statics[carries, "held, slips more" if moved == "held" else moved] += 1
    ends = list(dict.fromkeys(end for _, end in sorted(statics)))
    program = [[word, *(statics[c, e] for e in ends)] for word, c in (("carries it", True), ("does not", False))]
    torsion = []
    for mm, found in data["torsion"].items():
        kept = sum(w == "held" for own in found.values() for w in own["lost"])
        torsion.append([f"{float(mm):g} mm", kept, sum(sum(own["carries"]) for own in found.values()), 2 * ROWS])
    transfers = []
    first = data["transfers"]["1"]
    for n in FINER:
        changed = [
            (k, i, a, b, bool(doubt))
            for k, (one, own) in enumerate(zip(first, data["transfers"][str(n)], strict=True))
            for i, (a, b, doubt) in enumerate(zip(one["outcome"], own["outcome"], one["undecided"], strict=True))
            if a != b
        ]
        which = "; ".join(
            f"{', '.join(COMPARED[k])}, trial {data['trials'][i]}: {a} -> {b}{' (undecided)' if doubt else ''}"
            for k, i, a, b, doubt in changed
        )
        doubtful = sum(sum(c["undecided"]) for c in first) if n == 1 else ""
        transfers.append([at(n), len(changed), sum(not c[-1] for c in changed), doubtful, which or "-"])
    cost = [
        [
            what,
            *("-" if x is None else f"{x:.0f} ms" for x in v[:2]),
            *("-" if x is None else f"{x:.2f}" for x in v[2:]),
        ]
        for what, v in data["cost"].items()
    ]
    head = ["Method", "step", "n", "held", "lost in closing", "under the weight", "differ", "drift", "undecided"]
    return HEAD.format(
        rows=ROWS,
        commit=str(data["commit"])[:12],
        step=1e3 * TICK_S / STEPS,
        near=1e3 * NEAR_M,
        held=markdown_table(head, held),
        statics=markdown_table(["friction program", *ends], program),
        torsion=markdown_table(["radius", "held", "statics carry", "of"], torsion),
        received=len(data["trials"]),
        cases=", ".join(f"{r} with {s}" for r, s in COMPARED),
        transfers=markdown_table(["step", "differ", "not marked", "marked undecided", "which (h -> this)"], transfers),
        engines_rows=len(data["engines"]["trials"]),
        median=1e3 * data["engines"]["median_m"],
        largest=1e3 * data["engines"]["largest_m"],
        cost=markdown_table(["", "defaults", "these contacts", "ratio of means", "median ratio"], cost),
        load=data["hardware"]["load_at_start"],
    )


if __name__ == "__main__":
    page_from(argparse.ArgumentParser(description=__doc__), STORED, PAGE, measure, markdown)
