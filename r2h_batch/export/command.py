"""The commands `scene` (one stored trial as MJCF) and `trials` (what a method may read). Light
until there is work."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from r2h_batch.benchmark.flags import BUILT_IN, BenchmarkFlags
from r2h_batch.command_line import call, check_range, counted, failed, refuse
from r2h_batch.io.write import check_output_file, check_output_folder

MOST_TRIALS = 10**6


def scene(
    *,
    run: Path,
    trial: int,
    out: Path,
    method: str = "",
    benchmark: BenchmarkFlags = BUILT_IN,
    render: Path | None = None,
    overwrite: bool = False,
) -> int:
    """Write one stored trial as MJCF.

    Args:
        run: run folder of a sweep; what it does not store is computed again.
        trial: trial id.
        out: folder to write, new or empty.
        method: the sweep's word (fc) or the table's name; needed where the run has several.
        benchmark: as the sweep had them; none of these where it had the built-in benchmark.
        render: also a picture (.png, .jpg): start, middle and goal; of a failed Plan home and the
            target with what collides.
        overwrite: write into a folder that has something in it, and replace the picture.
    """
    check_output_folder(out, overwrite=overwrite)
    if render:
        check_output_file(render, overwrite=overwrite, flag="--render", endings=(".png", ".jpg"))
    from r2h_batch.benchmark.build import BenchmarkOverrides
    from r2h_batch.export.drawing import Drawing
    from r2h_batch.export.mjcf import export_trial
    from r2h_batch.export.pictures import write_row
    from r2h_batch.export.stored import Reader
    from r2h_batch.scene.offscreen import RenderError

    try:
        stored = Reader(run, BenchmarkOverrides.of(benchmark)).trial(trial, method or None)
        folder = export_trial(stored, out)
        if render:
            write_row(Drawing(stored), render, size=(600, 600))
    except RenderError as error:
        return refuse("scene", error, 1)
    except ValueError as error:  # ExportError, RunError, FileError, ObjectMeshError
        return refuse("scene", error)
    except OSError as error:
        return failed("scene", error, out)
    print(folder)
    return 0


def trials(
    *,
    out: Path,
    protocol: Literal["", "r2h-v0", "r2h-v1"] = "",
    trials: int = 500,
    splits: tuple[Literal["S0", "S1"], ...] = ("S0", "S1"),
    benchmark: BenchmarkFlags = BUILT_IN,
    open_formats: bool = False,
) -> int:
    """Write a protocol's trials and everything that a handover method may read to make predictions.

    Args:
        out: a new or empty folder.
        protocol: r2h-v0 (hands alone) or r2h-v1 (with the receivers' bodies); by default the
            benchmark's.
        trials: of each split, 1 or more.
        splits: S0 free handover, S1 functional.
        benchmark: your own, as in r2h-batch sweep; by default the built-in one.
        open_formats: also as OBJ, PLY, CSV and JSON in OUT/open, for methods in any language.
    """
    check_range("--trials", trials, 1, MOST_TRIALS, ": all are held in memory")
    if not splits:
        return refuse("trials", "--splits names no split; allowed are S0, S1")
    check_output_folder(out, overwrite=None)
    from r2h_batch.benchmark.build import BenchmarkOverrides
    from r2h_batch.export.trial_files import write_trials
    from r2h_batch.verdicts import SPLITS

    try:
        chosen = [s for s in SPLITS if s in splits]
        given = BenchmarkOverrides.of(benchmark, protocol=protocol)
        found = given.read()
        digest = write_trials(
            out, chosen, trials, benchmark=found, open_formats=open_formats, flags=given.flags()
        )
    except (FileExistsError, ValueError) as error:
        return refuse("trials", error)
    except OSError as error:
        return failed("trials", error, out)
    print(
        f"{found.protocol}: {counted(trials, 'trials')} each of {', '.join(chosen)} in {out}, digest {digest}"
    )
    return 0


def scene_main(
    arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.scene"
) -> int:
    """Exit code: 0 written, 1 could not write, 2 refused with one line."""
    return call(scene, sys.argv[1:] if arguments is None else arguments, prog=prog, name="scene")


def trials_main(
    arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.trials"
) -> int:
    """Exit code: 0 written, 1 could not write, 2 refused with one line."""
    return call(trials, sys.argv[1:] if arguments is None else arguments, prog=prog, name="trials")
