"""Commands that answer the next questions about run folders: only those that take these folders."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from r2h_batch.base.errors import FileError
from r2h_batch.report.compare.stored import BASELINES, baselines_for, stored_rows
from r2h_batch.report.statistics.common import common_trials
from r2h_batch.runs.store import Run, load_run


def next_commands(runs: Sequence[Run], printed: Literal["brief", "table"] = "table") -> str:
    """The commands as text that ends in a newline.

    Args:
        runs: those of a report, each with a complete method.
        printed: what stands above them, the whole table or its short form.
    """
    folders = shlex.join(_short(run.folder) for run in runs)
    lines = []
    if printed == "brief":
        lines.append(("report", " --full", "times, counts and all intervals, with what they mean"))
    if len(runs) == 1:
        lines.append(("why", "", "why trials failed: each reason, and one trial of it"))
    if (words := _compared(runs)) is not None:
        lines.append(("compare", words, "which differences are more than chance"))
    lines.append(("report", " --format html > report.html", "by object, margins, every trial"))
    if len(runs) == 1 and "poses" in runs[0].header["stored"]:
        lines.append(
            ("results reevaluate", " --rows 200", "whether the rows are what the evaluator says")
        )
    text = (f"    r2h-batch {c} {folders}{more}  # {what}" for c, more, what in lines)
    return "Next:\n\n" + "\n".join(text) + "\n"


def _short(folder: Path) -> str:
    """The folder from here, if it lies below the working directory."""
    here, place = Path.cwd(), folder.absolute()
    return str(place.relative_to(here) if place.is_relative_to(here) and place != here else folder)


def _compared(runs: Sequence[Run]) -> str | None:
    """The options that `compare` needs beside the folders; None: it refuses them."""
    if any(run.unfinished for run in runs):
        return None
    if sum(len(run.methods) for run in runs) > 1:
        return "" if judged_alike(runs) else None
    (run,) = runs
    try:
        shipped = load_run(baselines_for(run.header), verify=False)
    except FileError:
        return None
    across = run.robot != shipped.robot
    if shipped.folder == run.folder or not judged_alike([run, shipped], across_robots=across):
        return None
    return f" {BASELINES}{' --across-robots' if across else ''}"


def judged_alike(runs: Sequence[Run], *, across_robots: bool = False) -> bool:
    """Whether the runs were asked the same trials and judged the same; they may differ in how many."""
    try:
        common_trials(runs, proven=stored_rows(), across_robots=across_robots)
    except ValueError:
        return False
    return True
