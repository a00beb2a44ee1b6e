"""Are exported rows true? Judges them again with other code: MuJoCo C, manifold3d, trimesh, Qhull and float64 NumPy.

python bench/judge_again.py [SET ...] [--trials N] [--json FILE]

`unseen` are meshes of bench/meshes.py, `families` the 96 instances of r2h-v2; nobody tuned a criterion to either.

Of each set N trials a split and method are swept, with details and paths. Rows, poses and paths are read from the run folder.
`tests/support/judge_twin.py` has an own closing law, hulls, kinematics and time law, and says what it shares: trials, posed
hands, meshes, thresholds, and the numbers of the robot's file. Of set `error` the errors too are shared, of preset paper where
the planner's hand stood. It judges opening and shift, the five criteria, flags, outcome, where a path begins and ends and how
long it takes. Sets `reception` and `closed` judge what people do (`people_twin.py`).

A margin that is a distance must be right to 0.1 mm, one that is a bound must be no more than the overlap that is found, one
that is a cap must be no more than the clearance. A verdict is wrong where the other code says the opposite by more than 0.1 mm.

Figures are rows, wrong verdicts, the largest difference of a distance (mm), bounds and caps that do not bound, and facts
(everything that is no margin) that are wrong. What differs is printed one by one: overlaps are searched for, so of one that a
bound exceeds a deeper point may exist.
"""

import argparse
import contextlib
import io
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _report import Report
from _rows import poses_of, rows_of
from _twins import Again, Finding, episode_of, reception_of
from meshes import drawn
from run import Bench

from r2h_batch.closed_loop.env import HandoverEnv
from r2h_batch.closed_loop.episodes import play
from r2h_batch.closed_loop.policies import POLICIES, kind_of_action
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.reception import reception
from r2h_batch.methods.predictors import PredictorNoise
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.results.judge import Judge
from r2h_batch.trials.noise import estimated_hand

TOLERANCE_M = 1e-4
V1 = ["--benchmark", "r2h-v1"]
SETS = {
    "v1": V1,
    "body": [*V1, "--receiver", "body"],
    "paper": ["--preset", "paper", "--benchmark", "r2h-v0"],
    "unseen": V1,
    "families": ["--benchmark", "r2h-v2"],
    "panda": [*V1, "--robot", "panda_hand"],
    "ur10e": [*V1, "--robot", "ur10e_2f85"],
    "release": ["--preset", "release", "--benchmark", "r2h-release"],
    "error": [*V1, "--execution-error", "5mm,1deg"],
    "reception": V1,
    "closed": V1,
}
METHODS = ("fc", "handover-va", "random")
MEASURES = (
    "bench/judge_again.py",
    "tests/support/judge_twin.py",
    "tests/support/people_twin.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/closed_loop",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
)


@dataclass
class Tally:
    """Agreement on one criterion in one set; lengths in mm."""

    rows: int = 0
    wrong: int = 0
    largest: float = 0.0
    beyond: int = 0

    def add(self, found: Finding, where: str) -> None:
        """One statement of a row beside what was found."""
        self.rows += 1
        if found.kind == "fact":
            self.wrong += bool(found.wrong)
            if found.wrong:
                print(f"  {where} {found.name}: says {found.says}, found {found.true}", flush=True)
            return
        margin, kind, true = found.says, found.kind, found.true
        faults = []
        if (margin >= 0) != (true >= 0) and abs(true) > TOLERANCE_M and np.isfinite(margin):
            self.wrong += 1
            faults.append("wrong verdict")
        if kind == "distance":
            self.largest = max(self.largest, 1e3 * abs(margin - true))
            if abs(margin - true) > TOLERANCE_M:
                faults.append("not the distance")
        elif np.isfinite(margin) and (true - margin if kind == "bound" else margin - true) > TOLERANCE_M:
            self.beyond += 1
            faults.append("does not bound")
        if faults:
            says = f"says {1e3 * margin:.3f} mm ({kind}), found {1e3 * true:.3f}"
            print(f"  {where} {found.name}: {says}: {', '.join(faults)}", flush=True)


def again_of(judge: Judge, trials: Any, row: dict[str, Any]) -> Again:
    """The twin of a row, with the poses that the robot carried out and the hand that the planner saw."""
    scene, config = judge.evaluator.scene, judge.evaluator.config
    asked = [torch.tensor(np.array(row[k], np.float32)).view(1, 4, 4) for k in ("T_obj_ee", "T_world_ee")]
    T_obj_ee, T_world_ee = executed_poses(config, scene.objects, asked[0], asked[1], trials)
    seen = None
    if config.plan.hand == "estimated":
        estimate = config.estimate
        noise = PredictorNoise(target_errors=estimate.errors).scaled(estimate.factor)
        at = trials.trial_id, trials.hand_index, trials.T_world_hand
        seen = estimated_hand(scene, *at, seed=estimate.seed, noise=noise)[0]
    return Again(scene, config, trials, row, T_obj_ee[0], T_world_ee[0], seen)


def judged(name: str, judge: Judge, rows: dict[int, dict[str, Any]]) -> Iterator[tuple[int, Iterator[Finding]]]:
    """(trial id, what was found) of a method's rows in a set."""
    ids = torch.tensor(list(rows))
    trials = judge.trials(ids.numpy())
    twins = {i: again_of(judge, trials[torch.tensor([k])], row) for k, (i, row) in enumerate(rows.items())}
    if name not in ("reception", "closed"):
        yield from ((i, twin.findings()) for i, twin in twins.items())
        return
    T_obj_ee, T_world_ee = poses_of([*rows.values()])
    scores = judge.evaluator.score(T_obj_ee, T_world_ee, trials)
    if name == "reception":
        found = reception(scores)
        yield from ((i, reception_of(twin, found, k)) for k, (i, twin) in enumerate(twins.items()))
        return
    policy = POLICIES["servo"]
    kind: Any = kind_of_action(policy)
    env = HandoverEnv(scores, "moves", action=kind)
    play(env, policy)
    yield from ((i, episode_of(twin, env, k)) for k, (i, twin) in enumerate(twins.items()))


def judge_set(name: str, flags: list[str], folder: Path, meshes: Path, trials: int) -> tuple[int, dict[str, Tally]]:
    """Sweeps a set and judges all its rows again; how many, and what became of each criterion, and of facts."""
    own = ["--objects", str(meshes), "--splits", "S0"] if name == "unseen" else []
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        *METHODS,
        "--trials",
        str(trials),
        "--execute.sim",
        "none",
        "--save-paths",
        "--quiet",
    ]
    with contextlib.redirect_stdout(io.StringIO()):
        code = sweep([*line, *flags, *own, "--out", str(folder)])
    if code:
        raise SystemExit(code)
    run = load_run(folder)
    judge = Judge(run)
    rows, tallies = 0, dict[str, Tally]()
    for method in run.methods:
        for which, findings in judged(name, judge, rows_of(run, method)):
            rows += 1
            for finding in findings:
                key = "facts" if finding.kind == "fact" else finding.name
                tallies.setdefault(key, Tally()).add(finding, f"{name} {method.split(' ')[0]} {which}")
    return rows, tallies


def run(args: argparse.Namespace, report: Report) -> None:
    """Prints what differs and the table."""
    with tempfile.TemporaryDirectory() as kept:
        meshes = Path(kept) / "meshes"
        meshes.mkdir()
        for thing, mesh in drawn().items():
            mesh.export(meshes / f"{thing}.obj")
        report.add("judge_again.trials", args.trials)
        for name in args.sets:
            rows, tallies = judge_set(name, SETS[name], Path(kept) / name, meshes, args.trials)
            margins = [t for criterion, t in tallies.items() if criterion != "facts"]
            whole: dict[str, float] = {"rows": rows, "margins": sum(t.rows for t in margins)}
            whole["wrong"] = sum(t.wrong for t in margins)
            whole["bounds_that_do_not"] = sum(t.beyond for t in margins)
            whole["largest_difference_mm"] = round(max((t.largest for t in margins), default=0.0), 4)
            for figure, value in whole.items():
                report.add(f"judge_again.{name}.{figure}", value)
            facts = tallies["facts"]
            report.add(f"judge_again.{name}.facts.rows", facts.rows)
            report.add(f"judge_again.{name}.facts.wrong", facts.wrong)
            report.write(args.json)  # an end before the last set leaves those that are done


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "sets": {"nargs": "*", "default": list(SETS), "help": f"of {', '.join(SETS)}; default: all"},
        "--trials": {"default": 14, "help": "of each split and method"},
    },
    peer="own twins: MuJoCo C, manifold3d, trimesh, Qhull, float64 NumPy",
)

if __name__ == "__main__":
    BENCH.main()
