"""The authors' CPU evaluator and planner beside ours, on the same trials in one run: `python bench/release.py --release PATH`.

PATH is a folder with their `evaluation.py` and `planning.py` (a checkout's src/r2handoversim), or a checkout. Trials come from a
sweep of ours, are exported, and read back by both.
"""

import argparse
import contextlib
import hashlib
import importlib
import io
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _report import Report
from run import Bench
from scipy.spatial.transform import Rotation

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main as r2h_batch_main
from r2h_batch.base import se3
from r2h_batch.data.release import PADS_M, T_world_release, along_z
from r2h_batch.judge.ik import solve_ik
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.command import main as sweep
from r2h_batch.verdicts import CRITERIA
from r2h_batch.view.export.release import TOOL_M

MEASURES = (
    "bench/release.py",
    "r2h_batch/data/release.py",
    "r2h_batch/view/export",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
)
SAMPLES = 3
"""Samples of an executed motion at which flags are compared: their evaluator takes a sixth of a second for each."""


def quietly(command: Any, *line: object) -> float:
    """Seconds of one core that a command takes; its error if it fails."""
    said, start = io.StringIO(), time.process_time()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = command([str(x) for x in line])
    if code:
        raise RuntimeError(f"{line}: exit code {code}\n{said.getvalue()[-2000:]}")
    return time.process_time() - start


def rows_of(run: Path) -> dict[str, dict[str, Any]]:
    """The rows of a run of imported trials by their text ids."""
    stored = load_run(run)
    return {stored.labels[r["trial_id"]][0]: r for r in stored.trials(stored.methods[0]).to_pylist()}


def trial_files(folder: Path) -> list[Path]:
    """The trials of an exported folder, without its results."""
    return [f for f in sorted(folder.glob("*.json")) if f.name not in ("results.json", "paper_table.json")]


def release_modules(path: Path) -> list[Any]:
    """Their modules `evaluation` and `planning`."""
    inside = [p for p in (path, path / "src" / "r2handoversim") if (p / "evaluation.py").exists()]
    if not inside:
        raise SystemExit(f"{path}: has no evaluation.py; give a checkout of r2handoversim, or its src/r2handoversim")
    package = inside[0].resolve()
    sys.path.insert(0, str(package.parent))
    return [importlib.import_module(f"{package.name}.{name}") for name in ("evaluation", "planning")]


def planned_by_them(planning: Any, trial: dict[str, Any]) -> dict[str, Any]:
    """The trial with a plan of theirs; their CPU planner knows no tool, so its target is turned into the flange's."""
    target = np.array(trial["target_T_world_gripper"])
    bare = target @ np.linalg.inv(trial["T_tcp_asset_tool"])
    found = planning.plan_trial(
        {k: v for k, v in trial.items() if k != "planning"} | {"target_T_world_gripper": bare.tolist()}
    )
    return found | {"target_T_world_gripper": target.tolist()}


def thinned(trial: dict[str, Any]) -> dict[str, Any]:
    """The trial with `SAMPLES` of its executed samples, the first and the last among them."""
    q = trial["executed_joints"]
    return trial | {"executed_joints": [q[round(i)] for i in np.linspace(0, len(q) - 1, SAMPLES)]}


def written(folder: Path, trials: list[dict[str, Any]]) -> Path:
    """A new folder with these trials."""
    folder.mkdir()
    for t in trials:
        (folder / f"{t['id']}.json").write_text(json.dumps(t))
    return folder


def beside(report: Report, path: Path, files: Path, folder: Path, args: argparse.Namespace) -> None:
    """Both on the same files: flags, and trials in a second of one core."""
    evaluation, planning = release_modules(path)
    trials = [json.loads(f.read_text()) for f in trial_files(files)]
    flagged = trials[:: max(1, len(trials) // args.flags)]
    line = ("--execute.sim", "none", "--width", "whole")
    quietly(sweep, "--trials-from", written(folder / "flagged", flagged), *line, "--out", folder / "flags")
    theirs = {t["id"]: evaluation.evaluate(thinned(t)) for t in flagged}
    agreement(report, "flags", rows_of(folder / "flags"), theirs)
    # all of their samples
    moving = [t for t in flagged if "planning" not in t]
    mine = written(folder / "moving", moving)
    seconds = quietly(sweep, "--trials-from", mine, *line, "--out", folder / "judged")
    report.add("release.judge.ours_trials_per_core_s", len(moving) / seconds)
    # as many samples as the median has: the costs grow with them
    moving.sort(key=lambda t: len(t["executed_joints"]))
    some = moving[len(moving) // 2 :][: args.judged]
    start = time.process_time()
    found = {t["id"]: evaluation.evaluate(t) for t in some}
    report.add("release.judge.theirs_trials_per_core_s", len(found) / (time.process_time() - start))
    agreement(report, "judge", rows_of(folder / "judged"), found)
    # planning, from the same home to the same target, with the same table; a straight line is what theirs tries first
    chosen = [t for t in moving if len(t["planned_joints"]) == 2][: args.planned]
    out = ("--replan", "--out", folder / "planned")
    quietly(sweep, "--trials-from", mine, *line, *out)
    paths = {t["id"]: planned_by_them(planning, t) for t in chosen}
    own = rows_of(folder / "planned")
    same = sum((paths[i]["planning"]["status"] == "succeeded") == bool(own[i]["passed_plan"]) for i in paths)
    report.add("release.plan.agree", f"{same} of {len(chosen)}")
    inverse_kinematics(report, planning, args.palms)


def palms(seed: int, name: str, count: int) -> Any:
    """(count, 4, 4) palms of an object by the release's rule for seeds, its world: its box, without the reference grasp."""
    key = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little")
    rng = np.random.default_rng(np.random.SeedSequence([seed, key]))
    T = np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        T[k, :3, 3] = rng.uniform([-0.72, -0.45, 0.88], [-0.60, -0.30, 0.98])
        turns = rng.uniform([-25, -25, -150], [25, 25, -50])
        T[k, :3, :3] = Rotation.from_euler("xyz", turns, degrees=True).as_matrix()
    return T


def inverse_kinematics(report: Report, planning: Any, count: int) -> None:
    """Whether either finds joints for the first grasp of each object of r2h-release, 15 cm above palms of theirs."""
    objects = load_benchmark("r2h-release").objects
    targets = []
    for model, known in zip(objects, candidates_of(objects)):
        grasp = known.T_obj_ee[0].astype(float) @ along_z(PADS_M[""])
        for P in palms(27, model.name, count):
            z = -P[:3, 2]
            tool = np.stack([P[:3, 0], np.cross(z, P[:3, 0]), z], 1)
            T_world_object = np.eye(4)
            T_world_object[:3, :3] = tool @ grasp[:3, :3].T
            center = (model.vertices.min(0) + model.vertices.max(0)) / 2
            T_world_object[:3, 3] = P[:3, 3] + 0.15 * P[:3, 2] - T_world_object[:3, :3] @ center
            targets.append(T_world_object @ grasp)
    ours = T_world_release @ np.stack(targets) @ along_z(-PADS_M[""])
    found = solve_ik(se3.orthonormalise(torch.from_numpy(ours).float())).reachable.tolist()
    theirs = [bool(planning.solve_pose(T @ along_z(-TOOL_M))) for T in targets]
    report.add("release.ik.agree", f"{sum(a == b for a, b in zip(found, theirs))} of {len(targets)}")
    report.add("release.ik.only_ours", sum(a and not b for a, b in zip(found, theirs)))
    report.add("release.ik.only_theirs", sum(b and not a for a, b in zip(found, theirs)))


def agreement(report: Report, what: str, own: dict[str, dict[str, Any]], theirs: dict[str, dict[str, Any]]) -> None:
    """How many trials have the same flag, criterion by criterion, and where they differ."""
    for c in CRITERIA:
        asked = [i for i, r in theirs.items() if r["metrics"][c] is not None and own[i][f"passed_{c}"] is not None]
        differ = [i for i in asked if bool(own[i][f"passed_{c}"]) != theirs[i]["metrics"][c]]
        report.add(f"release.{what}.{c}", f"{len(asked) - len(differ)} of {len(asked)}")
        for i in differ:
            print(
                f"  {i}: {c} ours {own[i][f'passed_{c}']} ({own[i][f'margin_{c}_m']}), theirs {theirs[i]['metrics'][c]}"
            )
    first = sum((theirs[i]["first_failure"] or "success") == own[i]["outcome"] for i in theirs)
    report.add(f"release.{what}.first_failure", f"{first} of {len(theirs)}")


def run(args: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        own, files = folder / "own", folder / "files"
        line = (
            "--method",
            args.method,
            "--benchmark",
            args.benchmark,
            "--trials",
            args.trials,
            "--execute.sim",
            "none",
        )
        quietly(sweep, *line, "--save-paths", "--out", own)
        quietly(r2h_batch_main, "export", own, "--to", "r2handoversim", "--trials", args.trials, "--out", files)
        for name, more in (("given", []), ("replanned", ["--replan"])):
            quietly(sweep, "--trials-from", files, "--execute.sim", "none", *more, "--out", folder / name)
            stored = load_run(own)
            mine = {r["trial_id"]: r["outcome"] for r in stored.trials(stored.methods[0]).to_pylist()}
            back = {int(i.rsplit("_", 1)[1]): r["outcome"] for i, r in rows_of(folder / name).items()}
            same = sum(mine[i] == outcome for i, outcome in back.items())
            report.add(f"release.loop.{name}", f"{same} of {len(back)} outcomes")
            for i in (i for i, outcome in back.items() if mine[i] != outcome):
                print(f"  {i}: {mine[i]} became {back[i]}")
        beside(report, args.release, files, folder, args)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "--release": {
            "type": Path,
            "required": True,
            "help": "folder with evaluation.py and planning.py of the release",
        },
        "--method": {"default": "contact"},
        # its first arm box touches a table at the height of the base, as r2h-v1 has it: its planner then finds nothing
        "--benchmark": {"default": "r2h-release"},
        "--trials": {"default": 25, "help": "of each split, in the loop"},
        "--flags": {"default": 25, "help": "trials whose flags are compared, at few samples of Safe"},
        "--judged": {"default": 1, "help": "motions that theirs judges at all samples: half a minute each"},
        "--planned": {"default": 4, "help": "trials that theirs plans"},
        "--palms": {"default": 8, "help": "palms of each object, for inverse kinematics"},
    },
    peer="the authors' program",
)

if __name__ == "__main__":
    BENCH.main()
