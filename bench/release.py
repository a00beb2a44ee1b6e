"""The authors' CPU evaluator and planner beside ours, on the same trials in one run: `python bench/release.py --release PATH`.

PATH is a folder with their `evaluation.py` and `planning.py` (a checkout's src/r2handoversim), or a checkout. Without it only
the import is measured. Trials come from a sweep of ours, are exported, and read back by both.
"""

import argparse
import contextlib
import importlib
import io
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _report import Report

from r2h_batch.__main__ import main as r2h_batch_main
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.command import main as sweep
from r2h_batch.verdicts import CRITERIA


def quietly(command: Any, *line: object) -> float:
    """Seconds that a command takes; its error if it fails."""
    said, start = io.StringIO(), time.perf_counter()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = command([str(x) for x in line])
    if code:
        raise RuntimeError(f"{line}: exit code {code}\n{said.getvalue()[-2000:]}")
    return time.perf_counter() - start


def rows_of(run: Path) -> dict[str, dict[str, Any]]:
    """The rows of a run of imported trials by their text ids."""
    stored = load_run(run)
    return {stored.labels[r["trial_id"]][0]: r for r in stored.trials(stored.methods[0]).to_pylist()}


def trial_files(folder: Path) -> list[Path]:
    """The trials of an exported folder, without its results."""
    return [f for f in sorted(folder.glob("*.json")) if f.name not in ("results.json", "paper_table.json")]


def release_modules(path: Path) -> tuple[Any, Any]:
    """Their modules `evaluation` and `planning`."""
    inside = [p for p in (path, path / "src" / "r2handoversim") if (p / "evaluation.py").exists()]
    if not inside:
        raise SystemExit(f"{path}: has no evaluation.py; give a checkout of r2handoversim, or its src/r2handoversim")
    package = inside[0].resolve()
    sys.path.insert(0, str(package.parent))
    return importlib.import_module(f"{package.name}.evaluation"), importlib.import_module(f"{package.name}.planning")


def planned_by_them(planning: Any, trial: dict[str, Any]) -> dict[str, Any]:
    """The trial with a plan of theirs; their CPU planner knows no tool, so its target is turned into the flange's."""
    target = np.array(trial["target_T_world_gripper"])
    bare = target @ np.linalg.inv(trial["T_tcp_asset_tool"])
    found = planning.plan_trial(
        {k: v for k, v in trial.items() if k != "planning"} | {"target_T_world_gripper": bare.tolist()}
    )
    return found | {"target_T_world_gripper": target.tolist()}


def beside(report: Report, path: Path, files: Path, folder: Path, judged: int, planned: int) -> None:
    """Both on the same files: flags and trials a second."""
    evaluation, planning = release_modules(path)
    trials = [
        json.loads(f.read_text())
        for f in sorted(files.glob("*.json"))
        if f.name not in ("results.json", "paper_table.json")
    ]
    moving = [t for t in trials if "planning" not in t][:judged]
    mine = folder / "moving"
    mine.mkdir()
    for t in moving:
        (mine / f"{t['id']}.json").write_text(json.dumps(t))
    quietly(sweep, "--trials-from", mine, "--sim", "none", "--set", "width=whole", "--out", folder / "warm")
    seconds = quietly(sweep, "--trials-from", mine, "--sim", "none", "--set", "width=whole", "--out", folder / "judged")
    report.add("release.judge.trials", len(moving))
    report.add("release.judge.ours_trials_per_s", len(moving) / seconds)
    start = time.perf_counter()
    theirs = {t["id"]: evaluation.evaluate(t) for t in moving}
    report.add("release.judge.theirs_trials_per_s", len(moving) / (time.perf_counter() - start))
    agreement(report, "judge", rows_of(folder / "judged"), theirs)
    # planning, from the same home to the same target, with the same table
    chosen = [t for t in trials if t["id"] in {*list(theirs)[:planned]}]
    if not chosen:
        return
    mine = folder / "to_plan"
    mine.mkdir()
    for t in chosen:
        (mine / f"{t['id']}.json").write_text(json.dumps(t))
    line = ("--trials-from", mine, "--set", "replan=true", "width=whole", "--sim", "none", "--out")
    quietly(sweep, *line, folder / "warm2")
    seconds = quietly(sweep, *line, folder / "planned")
    report.add("release.plan.ours_trials_per_s", len(chosen) / seconds)
    start = time.perf_counter()
    paths = {t["id"]: planned_by_them(planning, t) for t in chosen}
    report.add("release.plan.theirs_trials_per_s", len(chosen) / (time.perf_counter() - start))
    own = rows_of(folder / "planned")
    same = sum((paths[i]["planning"]["status"] == "succeeded") == bool(own[i]["passed_plan"]) for i in paths)
    report.add("release.plan.agree", f"{same} of {len(chosen)}")


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


def import_many(report: Report, files: Path, folder: Path, count: int) -> None:
    """The import of `count` trials: copies of the exported ones under other ids."""
    sources = trial_files(files)
    many = folder / "many"
    many.mkdir()
    for k in range(count):
        trial = json.loads(sources[k % len(sources)].read_text())
        (many / f"t{k}.json").write_text(json.dumps(trial | {"id": f"t{k}"}))
    start = time.perf_counter()
    line = ["trials", str(many), "--from", "r2handoversim", "--out", str(folder / "imported")]
    subprocess.run([sys.executable, "-m", "r2h_batch", "import", *line], check=True, stdout=subprocess.DEVNULL)
    report.add("release.import.trials", count)
    report.add("release.import.seconds", time.perf_counter() - start)
    report.add("release.import.memory_mb", resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)
    shutil.rmtree(many)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--release", type=Path, help="folder with evaluation.py and planning.py of the release")
    parser.add_argument("--method", default="contact")
    parser.add_argument("--trials", type=int, default=50, help="of each split, in the loop")
    parser.add_argument("--judged", type=int, default=25, help="motions that both judge")
    parser.add_argument("--planned", type=int, default=3, help="trials that both plan (theirs takes a minute each)")
    parser.add_argument("--imported", type=int, default=1000)
    parser.add_argument("--json")
    args = parser.parse_args()
    report = Report()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        own, files = folder / "own", folder / "files"
        quietly(sweep, "--method", args.method, "--trials", args.trials, "--sim", "none", "--save-paths", "--out", own)
        report.add(
            "release.export.seconds",
            quietly(r2h_batch_main, "export", own, "--to", "r2handoversim", "--trials", args.trials, "--out", files),
        )
        for name, more in (("given", []), ("replanned", ["--set", "replan=true"])):
            quietly(sweep, "--trials-from", files, "--sim", "none", *more, "--out", folder / name)
            stored = load_run(own)
            mine = {r["trial_id"]: r["outcome"] for r in stored.trials(stored.methods[0]).to_pylist()}
            back = {int(i.rsplit("_", 1)[1]): r["outcome"] for i, r in rows_of(folder / name).items()}
            same = sum(mine[i] == outcome for i, outcome in back.items())
            report.add(f"release.loop.{name}", f"{same} of {len(back)} outcomes")
            for i in (i for i, outcome in back.items() if mine[i] != outcome):
                print(f"  {i}: {mine[i]} became {back[i]}")
        import_many(report, files, folder, args.imported)
        if args.release:
            beside(report, args.release, files, folder, args.judged, args.planned)
    report.write(args.json)


if __name__ == "__main__":
    main()
