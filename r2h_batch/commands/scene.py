"""The command `export scene`: one stored trial as MJCF. Light until there is work."""

from pathlib import Path
from typing import Annotated

import tyro

from r2h_batch.base.io.write import check_output_file, check_output_folder


def scene(
    run: Annotated[Path, tyro.conf.Positional],
    *,
    trial: str,
    out: Path,
    method: str = "",
    code: tuple[str, ...] = (),
    render: Path | None = None,
    overwrite: bool = False,
) -> int:
    """Write one stored trial as a folder that plain MuJoCo opens.

    Args:
        run: run folder of a sweep; what it does not store is computed again.
        trial: trial id, or your name of the trial (ids.csv of the run).
        out: folder to write, new or empty.
        method: the sweep's word (fc) or the table's name; needed where the run has several.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.
        render: also draw this picture (.png, .jpg): start, middle and goal, or for a failed Plan home and
            target with the colliding pair.
        overwrite: write into a folder that has something in it, and replace the picture.
    """
    check_output_folder(out, overwrite=overwrite)
    if render:
        check_output_file(render, overwrite=overwrite, flag="--render", endings=(".png", ".jpg"))
    from r2h_batch.runs.store import load_run

    opened = load_run(run)
    number = opened.trial_id(trial)
    opened.holding(number, [method] if method else [])  # before torch is imported
    import numpy as np

    from r2h_batch.view.drawing import Drawing
    from r2h_batch.view.mjcf import export_trial
    from r2h_batch.view.pictures import images, save_picture
    from r2h_batch.view.stored import Reader

    stored = Reader(opened, code).trial(number, method or None)
    folder = export_trial(stored, out)
    if render:
        row = [image for image, _ in images(Drawing(stored), (600, 600), 3)]
        save_picture(render, np.concatenate(row, axis=1))
    print(folder)
    return 0
