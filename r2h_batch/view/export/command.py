"""The commands `scene` (one stored trial as MJCF) and `trials` (what a method may read). Light
until there is work."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from r2h_batch.base.command_line import check_range, counted
from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import check_output_file, check_output_folder
from r2h_batch.protocols.choice import DEFAULT, BenchmarkChoice

MOST_TRIALS = 10**6


def scene(
    run: Annotated[Path, tyro.conf.Positional],
    *,
    trial: str,
    out: Path,
    method: str = "",
    benchmark: BenchmarkChoice = DEFAULT,
    render: Path | None = None,
    overwrite: bool = False,
) -> int:
    """Write one stored trial as a folder that plain MuJoCo opens.

    Args:
        run: run folder of a sweep; what it does not store is computed again.
        trial: trial id, or your name of the trial (ids.csv of the run).
        out: folder to write, new or empty.
        method: the sweep's word (fc) or the table's name; needed where the run has several.
        benchmark: where its files are now, if they are not where the sweep found them.
        render: also draw this picture (.png, .jpg): start, middle and goal, or for a failed Plan home and
            target with the colliding pair.
        overwrite: write into a folder that has something in it, and replace the picture.
    """
    check_output_folder(out, overwrite=overwrite)
    if render:
        check_output_file(render, overwrite=overwrite, flag="--render", endings=(".png", ".jpg"))
    import numpy as np

    from r2h_batch.view.drawing import Drawing
    from r2h_batch.view.mjcf import export_trial
    from r2h_batch.view.pictures import images, save_picture
    from r2h_batch.view.stored import Reader

    reader = Reader(run, benchmark)
    stored = reader.trial(reader.run.trial_id(trial), method or None)
    folder = export_trial(stored, out)
    if render:
        row = [image for image, _ in images(Drawing(stored), (600, 600), 3)]
        save_picture(render, np.concatenate(row, axis=1))
    print(folder)
    return 0


def trials(
    *,
    out: Path,
    trials: int = 500,
    splits: tuple[Literal["S0", "S1"], ...] = ("S0", "S1"),
    benchmark: BenchmarkChoice = DEFAULT,
    open_formats: bool = False,
) -> int:
    """Write a benchmark's trials and everything that a handover method may read to make predictions.

    Args:
        out: a new or empty folder.
        trials: trials of each split, 1 or more.
        splits: S0 free handover, S1 functional.
        benchmark: as in r2h-batch sweep; by default the default one.
        open_formats: also write OBJ and JSON into OUT/open, for methods in any language.
    """
    check_range("--trials", trials, 1, MOST_TRIALS, ": all are held in memory")
    if not splits:
        raise UsageError("--splits names no split; allowed are S0, S1")
    check_output_folder(out, overwrite=None)
    from r2h_batch.protocols.edit import edited
    from r2h_batch.verdicts import SPLITS
    from r2h_batch.view.export.trial_files import write_trials

    chosen = [s for s in SPLITS if s in splits]
    found = edited(benchmark)
    digest = write_trials(
        out, chosen, trials, benchmark=found, open_formats=open_formats, flags=benchmark.flags()
    )
    print(
        f"{found.protocol}: {counted(trials, 'trials')} each of {', '.join(chosen)} in {out}, digest {digest}"
    )
    return 0


def export(
    run: Annotated[Path, tyro.conf.Positional],
    *,
    to: Literal["r2handoversim"],
    out: Path,
    method: str = "",
    trials: int = 100,
    benchmark: BenchmarkChoice = DEFAULT,
) -> int:
    """Write trials of a run, and its verdicts, as files of the authors' release.

    The release replays and judges the trials. The verdicts are results.json, results.csv and
    paper_table.

    Args:
        run: run folder of a sweep; what it does not store is computed again.
        to: format: r2handoversim (handover.trial.v1).
        out: a new or empty folder.
        method: the sweep's word (fc) or the table's name; needed where the run has several.
        trials: the first trials of each split.
        benchmark: where its files are now, if they are not where the sweep found them.
    """
    check_range("--trials", trials, 1, MOST_TRIALS, "")
    check_output_folder(out, overwrite=None)
    from r2h_batch.runs.files import RunError
    from r2h_batch.scene.robot import DEFAULT_ROBOT
    from r2h_batch.view.export.release import (
        release_name,
        write_release_results,
        write_release_trial,
    )
    from r2h_batch.view.stored import UNJUDGED, Reader

    reader = Reader(run, benchmark)
    if reader.run.robot != DEFAULT_ROBOT:
        words = f"holds motions of {reader.run.robot}; {to} has the {DEFAULT_ROBOT} alone"
        raise RunError(f"{printable(run)}: {words}")
    name = reader.method(method or None)
    rows = reader.rows(name).to_pylist()
    judged = sorted((r for r in rows if r["outcome"] not in UNJUDGED), key=lambda r: r["trial_id"])
    labels = {i: (text, variant or name) for i, (text, variant) in reader.run.labels.items()}
    names = {
        r["trial_id"]: labels.get(r["trial_id"], (release_name(name, r["trial_id"]), name))
        for r in judged
    }
    ids = [i for s in (0, 1) for i in [i for i in names if i % 2 == s][:trials]]
    out.mkdir(parents=True, exist_ok=True)
    for i in ids:
        write_release_trial(reader.trial(i, name), *names[i], out)
    write_release_results(judged, names, out)
    left = f"; {counted(len(rows) - len(judged), 'trials')} that were not judged are left out"
    print(
        f"{counted(len(ids), 'trials')} of {printable(name)} in {out}, results of {len(judged)}"
        f"{left if len(judged) < len(rows) else ''}"
    )
    return 0
