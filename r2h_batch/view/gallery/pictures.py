"""Pictures of a run: thumbnails for the report's gallery."""

import base64
import io
import re
from itertools import zip_longest
from pathlib import Path
from urllib.parse import quote

from r2h_batch.base.io.progress import progress
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import Run
from r2h_batch.view.captions import verdict_of
from r2h_batch.view.drawing import Drawing
from r2h_batch.view.page import write_page
from r2h_batch.view.pictures import image_at_end
from r2h_batch.view.stored import Reader
from r2h_batch.view.stored_trial import StoredTrial

SHOWN = OUTCOME_NAMES[:6]
"""Outcomes of which there is something to see: success and the five failures."""
CLOSE = ("stability", "affordance", "safe")
"""Failures between gripper, object and hand: the camera goes near."""
LOOKED_AT = 200_000  # rows of a method that are searched for examples
THUMBNAIL, QUALITY = (336, 252), 82  # pixels; of a JPEG, about 10 kB


def first_of_each_outcome(run: Run, method: str, n: int) -> dict[str, list[int]]:
    """Outcome -> at most `n` trial ids, of different objects where there are some."""
    found: dict[str, dict[str, list[int]]] = {o: {} for o in SHOWN}
    seen = 0
    for table in run.shards("trials", method, ["trial_id", "object", "outcome"]):
        columns = (table[k].to_pylist() for k in ("trial_id", "object", "outcome"))
        for trial, name, outcome in zip(*columns, strict=True):
            if outcome in found and len(found[outcome].setdefault(name, [])) < n:
                found[outcome][name].append(trial)
        seen += len(table)
        if seen >= LOOKED_AT:
            break
    # the first of each object, then the second of each, and so on
    turns = {o: zip_longest(*by.values()) for o, by in found.items() if by}
    return {o: [t for turn in by for t in turn if t is not None][:n] for o, by in turns.items()}


def gallery(
    run: Run, reader: Reader, n: int, pages: Path, base: Path
) -> dict[str, list[dict[str, str]]]:
    """Pictures of at most `n` trials of each outcome, by method.

    Args:
        run: the run, with the methods to show.
        reader: of the same run.
        n: pictures of each method and outcome.
        pages: folder for a page of each trial.
        base: folder that links to the pages start from.

    Returns:
        Method -> trial, outcome, src, alt, caption, href and command of each picture.
    """
    found: dict[str, list[dict[str, str]]] = {method: [] for method in run.methods}
    shown = {method: first_of_each_outcome(run, method, n) for method in run.methods}
    every = [
        (method, outcome, trial)
        for method, of in shown.items()
        for outcome, trials in of.items()
        for trial in trials
    ]
    with progress("report: gallery", len(every), "trials") as told:
        for method, outcome, trial in every:
            slug = re.sub(r"[^A-Za-z0-9._-]+", "_", run.entry(method).slug)
            stored = reader.trial(trial, method)
            page = write_page(stored, pages / f"{slug}-{trial}.html")
            words, name = verdict_of(stored), stored.row["object"].replace("_", " ")
            picture = {
                "trial": str(trial),
                "outcome": outcome,
                "command": f"{run.view_command(method)} {trial}",
                "src": _thumbnail(stored, close=outcome in CLOSE),
                "alt": f"trial {trial} of {method}: {words}",
                "caption": f"{trial} {name}: {words}",
                "href": quote(page.relative_to(base).as_posix()),
            }
            found[method].append(picture)
            told(1)
    return found


def _thumbnail(stored: StoredTrial, *, close: bool) -> str:
    """A trial's end as the address of a small image."""
    from PIL import Image as Pillow

    image, box = image_at_end(Drawing(stored), THUMBNAIL, close=close), io.BytesIO()
    Pillow.fromarray(image).save(box, "JPEG", quality=QUALITY, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(box.getvalue()).decode('ascii')}"
