"""The command `export release`: trials of a run as files of the authors' release. Light until there is work."""

from pathlib import Path
from typing import Annotated

import tyro

from r2h_batch.base.command_line import check_range, counted
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import check_output_folder
from r2h_batch.commands.trials import MOST_TRIALS


def release(
    run: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    method: str = "",
    trials: int = 100,
    code: tuple[str, ...] = (),
) -> int:
    """Write trials of a run, and its verdicts, as files of the authors' release.

    The release (r2handoversim, handover.trial.v1) replays and judges the trials. The verdicts are results.json,
    results.csv and paper_table.

    Args:
        run: run folder of a sweep; what it does not store is computed again.
        out: a new or empty folder.
        method: the sweep's word (fc) or the table's name; needed where the run has several.
        trials: the first trials of each split.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.
    """
    check_range("--trials", trials, 1, MOST_TRIALS, "")
    check_output_folder(out, overwrite=None)
    from r2h_batch.runs.files import RunError
    from r2h_batch.runs.store import load_run
    from r2h_batch.scene.robot_file import DEFAULT_ROBOT

    stored = load_run(run)
    if stored.robot != DEFAULT_ROBOT:
        words = f"holds motions of {stored.robot}; r2handoversim has the {DEFAULT_ROBOT} alone"
        raise RunError(f"{printable(run)}: {words}")
    name = stored.complete(method or None)  # before torch is imported
    from r2h_batch.view.export.release import write_release
    from r2h_batch.view.stored import Reader

    written = write_release(Reader(stored, code), name, out, trials=trials)
    left = f"; {counted(written.left_out, 'trials')} that were not judged are left out"
    print(
        f"{counted(written.trials, 'trials')} of {printable(name)} in {out}, results of {written.results}"
        f"{left if written.left_out else ''}"
    )
    return 0
