"""Pictures of a run: thumbnails for the report's gallery, and the paper's figures 2, 4 and 5."""

import base64
import io
import re
import textwrap
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from r2h_batch.base.io.progress import progress
from r2h_batch.base.io.write import atomic_path
from r2h_batch.report.figures import style
from r2h_batch.report.text import short_names
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import Run
from r2h_batch.view.captions import verdict_of
from r2h_batch.view.drawing import Drawing, view_of
from r2h_batch.view.page import write_page
from r2h_batch.view.pictures import Image, image_at_end, images, painter
from r2h_batch.view.stored import Reader, StoredTrial

SHOWN = OUTCOME_NAMES[:6]
"""Outcomes of which there is something to see: success and the five failures."""
JUDGED = ("region", "ball", "palm")
"""Marks of a success, drawn at its end."""
CLOSE = ("stability", "affordance", "safe")
"""Failures between gripper, object and hand: the camera goes near."""
LOOKED_AT = 200_000  # rows of a method that are searched for examples
THUMBNAIL, QUALITY = (336, 252), 82  # pixels; of a JPEG, about 10 kB
SIZE, DPI = (480, 400), 200  # of a figure's pictures
MOMENTS = 5  # pictures of a method over time

Panel = tuple[Image | None, str]


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


def shared_trial(run: Run, methods: Sequence[str]) -> int:
    """The first trial in which as many methods as possible move and their outcomes differ."""
    ids, outcomes, count = None, [], None
    for method in methods:
        table = next(iter(run.shards("trials", method, ["trial_id", "outcome", "t_exec_s"])))
        own = table["trial_id"].to_numpy()
        ids = own if ids is None else ids
        if not np.array_equal(ids, own):
            raise ValueError(f"{run.folder}: {method!r} has other trial ids than {methods[0]!r}")
        moves = table["t_exec_s"].is_valid().to_numpy(zero_copy_only=False).astype(int)
        count = moves if count is None else count + moves
        outcomes.append(np.array(table["outcome"].to_pylist(), object))
    if ids is None or count is None or not len(ids):
        raise ValueError(f"{run.folder}: no trial is stored")
    differ = np.array([len(set(words)) > 1 for words in zip(*outcomes, strict=True)])
    return int(ids[np.argmax(2 * count + differ)])


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


def protocol(run: Run, reader: Reader, method: str, trial: int | None) -> tuple[Any, str]:
    """Six moments of one success, and which trial it is: start, target, approach, arrival, near."""
    if trial is None:
        found = first_of_each_outcome(run, method, 1).get(OUTCOME_NAMES[0])
        if not found:
            words = "has no success to show; choose another --method, or a --trial"
            raise ValueError(f"{method!r} {words}")
        trial = found[0]
    drawing = Drawing(reader.trial(trial, method))
    stored, aspect = drawing.stored, SIZE[0] / SIZE[1]
    if not stored.moves:
        words = f"does not move ({verdict_of(stored)}); choose another --trial"
        raise ValueError(f"trial {trial} of {method!r} {words}")
    home = stored.start
    moments = drawing.moments(4)[1:]
    with painter(drawing, SIZE, view_of([drawing], aspect)) as paint:
        panels: list[Panel] = [(paint(home), "start"), (paint(home, "target"), "target")]
        for (t, q, _), words in zip(moments, ("approach, ", "", "handover, "), strict=True):
            groups = JUDGED if words.startswith("handover") else ()
            panels.append((paint(q, *groups), f"{words}{t:.1f} s"))
    with painter(drawing, SIZE, view_of([drawing], aspect, close=True)) as paint:
        panels.append((paint(moments[-1][1], *JUDGED), "what is judged"))
    return _grid([panels], []), f"trial {trial} of {method}"


def methods_over_time(
    run: Run, reader: Reader, methods: Sequence[str], trial: int | None
) -> tuple[Any, str]:
    """A row for each method on the same trial: its motion, and its verdict."""
    trial = shared_trial(run, methods) if trial is None else trial
    short, drawings = short_names(methods), [Drawing(reader.trial(trial, m)) for m in methods]
    view = view_of(drawings, SIZE[0] / SIZE[1])
    rows: list[list[Panel]] = []
    names = []
    for method, drawing in zip(methods, drawings, strict=True):
        rows.append([*images(drawing, SIZE, MOMENTS, view)])
        rows[-1] += [(None, "")] * (MOMENTS - len(rows[-1]))
        names.append(f"{short[method]}\n{verdict_of(drawing.stored)}")
    return _grid(rows, names), f"trial {trial}"


def failures(run: Run, reader: Reader, methods: Sequence[str]) -> tuple[Any, str]:
    """One success and one failure of each kind that occurs, of the first method that has one."""
    short, named = short_names(methods), []
    panels: list[Panel] = []
    found = {method: first_of_each_outcome(run, method, 1) for method in methods}
    for outcome in SHOWN:
        method = next((m for m in methods if found[m].get(outcome)), None)
        if method is None:
            continue
        trial = found[method][outcome][0]
        drawing = Drawing(reader.trial(trial, method))
        image = image_at_end(drawing, SIZE, close=outcome in CLOSE)
        panels.append((image, verdict_of(drawing.stored)))
        named.append(f"{outcome}: trial {trial} of {short[method]}")
    columns = min(3, len(panels))
    panels += [(None, "")] * (-len(panels) % columns)
    rows = [panels[i : i + columns] for i in range(0, len(panels), columns)]
    return _grid(rows, []), "; ".join(named)


def _grid(rows: Sequence[Sequence[Panel]], names: Sequence[str]) -> Any:
    """Pictures with words below each; names of rows at the left."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    columns, wide = len(rows[0]), 1.45
    with style(page=False):
        layout = ConstrainedLayoutEngine(w_pad=0.01, h_pad=0.01, wspace=0.01, hspace=0.02)
        inches = (wide * columns, (wide * SIZE[1] / SIZE[0] + 0.2) * len(rows))
        figure = Figure(figsize=inches, layout=layout)
        axes = figure.subplots(len(rows), columns, squeeze=False)
        for place, (image, words) in zip(axes.ravel(), (p for row in rows for p in row)):
            place.set_xticks([])
            place.set_yticks([])
            place.set_frame_on(False)
            if image is not None:
                place.imshow(image)
                place.set_xlabel(textwrap.fill(words, 26), fontsize=7, labelpad=2)
        for place, name in zip(axes[:, 0], names, strict=False):
            lines = (textwrap.fill(line, 30) for line in name.splitlines())
            place.set_ylabel("\n".join(lines), fontsize=6)
    return figure


def write(figure: Any, folder: Path, name: str) -> list[Path]:
    """Writes the figure as PDF and PNG."""
    paths = [folder / f"{name}.{ending}" for ending in ("pdf", "png")]
    with style(page=False):
        for path in paths:
            date = {"CreationDate": None} if path.suffix == ".pdf" else {"Software": None}
            how: dict[str, Any] = {"dpi": DPI, "bbox_inches": "tight", "pad_inches": 0.02}
            with atomic_path(path) as temporary:
                figure.savefig(temporary, metadata=date, **how)
    return paths
