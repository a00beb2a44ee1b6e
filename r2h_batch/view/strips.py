"""What the methods' handovers of one trial look like: a row for each method, along the motion that
was executed.

The scene is the one that was simulated, rendered by MuJoCo; the row's title says what came of it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2h_batch.command_line import tell
from r2h_batch.evaluate import Evaluator
from r2h_batch.export.pictures import Strip, strips
from r2h_batch.io.write import atomic_path
from r2h_batch.scene.offscreen import RenderError
from r2h_batch.sweep.jobs import load_files, make_jobs, prepare
from r2h_batch.sweep.options import Options, UsageError, check
from r2h_batch.trials.protocol import trials_with_ids
from r2h_batch.types import Outcome, Predictions


def write_strips(
    trial_id: int, methods: Sequence[str], files: Sequence[str], preset: str, frames: int, out: Path
) -> list[str]:
    """Draws the grid and returns a line for each row: the method, and what came of it."""
    evaluator, found = answers(trial_id, methods, files, preset)
    if not found:
        raise UsageError(f"nobody answers trial {trial_id}")
    trial = trials_with_ids(
        torch.tensor([trial_id], dtype=torch.int64, device="cpu"), objects=evaluator.scene.objects
    )
    rows = strips(evaluator, trial, found, frames=frames)
    name = evaluator.scene.objects[int(trial.object_index[0])].name.replace("_", " ")
    draw(rows, f"trial {trial_id}: {name}", out, frames=frames)
    return [f"{row.method}: {row.verdict}" for row in rows]


def answers(
    trial_id: int, methods: Sequence[str], files: Sequence[str], preset: str
) -> tuple[Evaluator, list[Predictions]]:
    """An evaluator, and each method's and file's answer to one trial (those that have one)."""
    plan: Any = {"preset": preset, "trials": max(500, trial_id // 2 + 1), "allow_missing": True}
    options = check(Options(method=tuple(methods), predictions=tuple(files), **plan))
    bench = prepare(options)
    found = []
    place = int(torch.nonzero(bench.ids(0, bench.planned) == trial_id).flatten()[0])
    for job in make_jobs(options, load_files(options), bench):
        row = None if job.rows is None else job.rows[place : place + 1]
        if row is not None and int(row[0]) < 0:
            tell(f"strips: {job.name} has no answer to trial {trial_id}")
            continue
        p = job.predict(
            bench.trials(torch.tensor([trial_id], dtype=torch.int64, device="cpu")), row
        )
        found.append(Predictions(p.trial_id, p.T_obj_ee, p.T_world_ee, method=job.name))
    return bench.evaluator, found


def draw(rows: Sequence[Strip], title: str, out: Path, *, frames: int) -> None:
    """Writes the grid of pictures: methods by times."""
    try:
        import matplotlib
    except ImportError:
        raise RenderError("strips need matplotlib: pip install 'r2h_batch[view]'") from None
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    height, width = rows[0].images.shape[1:3]
    figure = plt.figure(
        figsize=(2.4 * frames, (2.4 * height / width + 0.32) * len(rows) + 0.35), dpi=160
    )
    ratios = [0.35, *[2.4 * height / width + 0.32] * len(rows)]
    parts = figure.subfigures(len(rows) + 1, 1, height_ratios=ratios, squeeze=False)[:, 0]
    parts[0].text(0.5, 0.5, title, ha="center", va="center", fontsize=10)
    for part, row in zip(parts[1:], rows, strict=True):
        color = "#1b6e3c" if row.outcome == Outcome.SUCCESS else "#a3262a"
        part.text(0.005, 0.995, row.method, ha="left", va="top", fontsize=9, weight="bold")
        part.text(0.995, 0.995, row.verdict, ha="right", va="top", fontsize=9, color=color)
        axes = part.subplots(1, frames, gridspec_kw={"wspace": 0.02})
        part.subplots_adjust(
            left=0.005, right=0.995, top=1 - 0.26 / (2.4 * height / width + 0.32), bottom=0.01
        )
        for k, axis in enumerate(np.atleast_1d(axes)):
            axis.set_axis_off()
            if k < len(row.images):
                axis.imshow(row.images[k])
                axis.text(
                    0.03,
                    0.05,
                    f"{row.time_s[k]:.1f} s",
                    transform=axis.transAxes,
                    fontsize=7,
                    color="#333333",
                )
            elif k == 1:
                axis.text(
                    0.0, 0.5, "no motion", transform=axis.transAxes, fontsize=8, color="#777777"
                )
    with atomic_path(out) as temporary:
        figure.savefig(temporary, metadata={"Software": None})
    plt.close(figure)
