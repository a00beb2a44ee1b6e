"""Thumbnails for the report's gallery, each with the page of its trial in three dimensions."""

import base64
import io
import re
from pathlib import Path

import numpy as np

from r2h_batch.command_line import tell
from r2h_batch.export.drawing import Stage
from r2h_batch.export.stored import Reader, StoredTrial
from r2h_batch.gallery.chosen import first_of_each_outcome
from r2h_batch.report.figures import WORDS
from r2h_batch.runs.store import Run
from r2h_batch.view.page import write_page

__all__ = ["gallery", "still", "verdict"]

SIZE = (336, 252)
NEAR = ("stability", "affordance", "safe")
"""Failures that are between gripper, object and hand: seen from near."""

QUALITY = 82
"""Of a thumbnail's JPEG: about 10 kB."""


def gallery(
    run: Run, reader: Reader, n: int, pages: Path, base: Path
) -> dict[str, list[dict[str, str]]]:
    """Method -> pictures of at most `n` trials of each outcome; their pages are written into
    `pages`, linked from `base`."""
    found: dict[str, list[dict[str, str]]] = {}
    shown = {method: first_of_each_outcome(run, method, n) for method in run.methods}
    reader.build_for(
        {m: [k for ids in trials.values() for k in ids] for m, trials in shown.items()}
    )
    for method in run.methods:
        found[method] = []
        for outcome, trials in shown[method].items():
            for trial in trials:
                stored = reader.trial(trial, method)
                slug = re.sub(r"[^A-Za-z0-9._-]+", "_", run.entry(method)["slug"])
                page = write_page(stored, pages / f"{slug}-{trial}.html")
                words = verdict(stored)
                found[method].append(
                    {
                        "src": _data_url(still(stored, SIZE)),
                        "alt": f"trial {trial} of {method}: {words}",
                        "caption": f"{trial} {stored.row['object'].replace('_', ' ')}: {words}",
                        "href": page.relative_to(base).as_posix(),
                    }
                )
            tell(f"report: {method}: {len(trials)} of {WORDS[outcome]}")
    return found


def still(stored: StoredTrial, size: tuple[int, int]) -> np.ndarray:
    """(height, width, 3) where the motion ends; without one, what was asked: the ghost, and what
    collides in red."""
    stage = Stage(stored)
    posture = stage.motion()[1][-1] if stored.moves else stored.target_q
    near = stored.row["outcome"] in NEAR
    return next(
        stage.pictures([posture], width=size[0], height=size[1], asked=not stored.moves, close=near)
    )


def verdict(stored: StoredTrial) -> str:
    """The outcome in words; of a failed Plan why, of another failure by how much."""
    row = stored.row
    outcome = str(row["outcome"])
    if outcome == "success":
        return WORDS[outcome]
    if outcome == "plan":
        pair = f", {row['plan_pair'].replace('_', ' and ')}" if row.get("plan_pair") else ""
        return f"{WORDS[outcome]}: {str(row['plan_reason']).replace('_', ' ')}{pair}"
    margin = row.get(f"margin_{outcome}_m")
    if margin is None or not np.isfinite(margin):
        return WORDS[outcome]
    return f"{WORDS[outcome]}: {1000 * margin:+.{0 if abs(margin) >= 0.01 else 1}f} mm"


def _data_url(image: np.ndarray) -> str:
    from PIL import Image

    box = io.BytesIO()
    Image.fromarray(image).save(box, "JPEG", quality=QUALITY, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(box.getvalue()).decode('ascii')}"
