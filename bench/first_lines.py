"""How soon each command says something, and how long it is ever silent.

    python bench/first_lines.py --out OUT --json bench/results/first_lines.json

Each command is a process of its own whose output is a pipe, so progress comes as lines. Seconds are on the clock: to the
first line, the longest time without a line, and to the end; then seconds of the processor. Kernels are compiled; the cache
of tables is empty at the start, as on a machine where nobody called the package before. `--only NAME ...` runs these alone,
on runs that OUT holds already.
"""

import argparse
import os
import resource
import select
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

from _report import ROOT, Report, markdown_table

MEASURES = ("bench/first_lines.py", "r2h_batch")
SAID_S = 5.0
"""Longest time without a line that a person takes for work [choice]: what the issue asks."""
COMMANDS = {
    "sweep": "sweep --method contact random --trials 60 --sim none --out {out}/run",
    "sweep, simulated": "sweep --method oracle --trials 10 --out {out}/simulated",
    "sweep, moving hand": "sweep --method oracle --trials 10 --receiver-motion moves --policy servo --out {out}/moving",
    "report": "report {out}/run",
    "report, page": "report {out}/run --format html --out {out}/report.html --overwrite",
    "report, gallery": "report {out}/run --format html --gallery 1 --method contact --out {out}/gallery.html --overwrite",
    "compare": "compare {out}/run baselines",
    "why": "why {out}/run 3 --method contact",
    "view, page": "view {out}/run --trial 3 --method contact --html {out}/trial.html --overwrite",
    "view, film": "view {out}/run --trial 3 --method contact --video {out}/trial.mp4 --fps 5 --overwrite",
    "view, film of a moving hand": "view {out}/moving --trial 3 --receiver-motion moves --policy servo"
    " --video {out}/moving.mp4 --fps 5 --overwrite",
    "results verify": "results verify {out}/run",
    "results reevaluate": "results reevaluate {out}/run --rows 100",
    "results reception, first use": "results reception {out}/simulated",
    "submit": "submit {out}/run --rows 100 --out {out}/run.zip --overwrite",
    "leaderboard": "leaderboard {out}/run.zip --rows 100 --least 0 --out {out}/board.html --overwrite",
    "import robot": "import robot --from airo-models:ur3e.urdf --base base_link --flange tool0 --out {out}/arm",
    "train rank": "train rank --items 1 --steps 20 --rounds 0 --out {out}/trained",
}  # fmt: skip
"""As a person types them, smaller where one would take many minutes."""
PARTS = ("first", "silent", "whole", "cpu")


def watched(words: list[str], env: dict[str, str], log: Path) -> tuple[dict[str, float], int, str]:
    """Seconds of PARTS of a command, its exit code and its first line."""
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    line = [sys.executable, "-m", "r2h_batch", *words]
    found = {"first": 0.0, "silent": 0.0}
    said, text, last = "", b"", begin
    with (
        log.open("wb") as file,
        subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=env, cwd=ROOT) as child,
    ):
        assert child.stdout is not None
        pipe = child.stdout.fileno()
        while True:
            select.select([pipe], [], [])
            some, now = os.read(pipe, 1 << 16), time.perf_counter()
            found["silent"] = max(found["silent"], now - last)
            last = now
            if not some:
                break
            file.write(some)
            text += some
            if not said and b"\n" in text:
                found["first"], said = now - begin, text.split(b"\n")[0].decode(errors="replace")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found["whole"] = time.perf_counter() - begin
    found["cpu"] = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return found, child.returncode, said


def main() -> None:
    """Runs every command and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="runs, pages and films; emptied first, but with --only")
    parser.add_argument("--only", nargs="+", choices=[*COMMANDS], help="names of COMMANDS")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if not options.only:
        shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True, exist_ok=True)
    env = {**os.environ, "R2H_BATCH_CACHE": str(options.out / "cache")}
    env["MUJOCO_GL"] = os.environ.get("MUJOCO_GL", "osmesa")
    result, rows, silent = Report(MEASURES), [], 0
    for name in options.only or COMMANDS:
        shown = COMMANDS[name]
        words = [word.format(out=options.out) for word in shlex.split(shown)]
        for flag in ("arm", "trained"):  # folders that must be new
            shutil.rmtree(options.out / flag, ignore_errors=not (options.out / flag).exists())
        found, code, said = watched(words, env, options.out / f"{name}.log")
        if code:
            sys.exit(f"{name}: exit code {code}; see {options.out / f'{name}.log'}")
        print(f"{name}: {said}", flush=True)
        key = name.replace(", ", ".").replace(" ", "_")
        for part in PARTS:
            result.add(f"first_lines.{key}.{part}_s", found[part])
        silent += found["silent"] > SAID_S
        rows.append([name, f"`{shown.replace('{out}/', '')}`", *(f"{found[part]:.1f}" for part in PARTS)])
    head = ["command", "as typed", "first line, s", "longest silence, s", "whole, s", "of the processor, s"]
    result.add("first_lines.table", markdown_table(head, rows, left=True))
    result.add("first_lines.silent", silent)
    result.add("first_lines.commands", len(rows))
    result.write(options.json)


if __name__ == "__main__":
    main()
