"""The paper's figures of a run: the protocol (2), the methods over time (4), success and failures
(5). PDF and PNG."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r2h_batch.config import HOME_Q
from r2h_batch.export.drawing import Stage
from r2h_batch.export.stored import Reader, StoredTrial
from r2h_batch.gallery.chosen import SHOWN, first_of_each_outcome, shared_trial
from r2h_batch.gallery.pictures import still, verdict
from r2h_batch.io.write import atomic_path
from r2h_batch.report.figures import style
from r2h_batch.report.text import short_names
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import Run

__all__ = ["failures", "methods_over_time", "protocol", "write"]

SIZE = (480, 400)
DPI = 200
MOMENTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Of the methods' rows: fractions of each one's own motion."""

Panel = tuple[np.ndarray | None, str]


def protocol(run: Run, reader: Reader, method: str, trial: int | None) -> tuple[Any, str]:
    """Six moments of one success, and which trial it is: start, target, approach, arrival, from
    near."""
    if trial is None:
        found = first_of_each_outcome(run, method, 1).get(OUTCOME_NAMES[0])
        if not found:
            raise ValueError(
                f"{method!r} has no success to show; choose another --method, or a --trial"
            )
        trial = found[0]
    stored = reader.trial(trial, method)
    if not stored.moves:
        raise ValueError(
            f"trial {trial} of {method!r} does not move ({verdict(stored)}); choose another --trial"
        )
    stage = Stage(stored)
    times, q = stage.motion()
    at = [q[np.abs(times - f * times[-1]).argmin()] for f in (0.33, 0.66, 1.0)]
    width, height = SIZE
    home = np.array(HOME_Q)
    images = [*stage.pictures([home], width=width, height=height)]
    stage.witness = None  # the ghost alone: nothing speaks against this target
    images += stage.pictures([home], width=width, height=height, asked=True)
    images += stage.pictures(at, width=width, height=height)
    images += stage.pictures(at[-1:], width=width, height=height, close=True)
    moments = [f"{f * times[-1]:.1f} s" for f in (0.33, 0.66, 1.0)]
    titles = [
        "start",
        "target",
        f"approach, {moments[0]}",
        moments[1],
        f"handover, {moments[2]}",
        "what is judged",
    ]
    return _grid([list(zip(images, titles, strict=True))], []), f"trial {trial} of {method}"


def methods_over_time(
    run: Run, reader: Reader, methods: Sequence[str], trial: int | None
) -> tuple[Any, str]:
    """A row a method: the same trial along each one's motion, and what came of it."""
    trial = shared_trial(run, methods) if trial is None else trial
    short = short_names(methods)
    rows, names = [], []
    first: Stage | None = None
    for method in methods:
        stored = reader.trial(trial, method)
        stage = _SeenAlike(stored, first)
        first = first or stage
        rows.append(_moments(stage))
        names.append(f"{short[method]}\n{verdict(stored)}")
    return _grid(rows, names), f"trial {trial}"


class _SeenAlike(Stage):
    """A trial from where another method's answer to it is seen."""

    def __init__(self, stored: StoredTrial, like: Stage | None) -> None:
        super().__init__(stored)
        self.like = like

    def camera(self, close: bool) -> Any:
        return super().camera(close) if self.like is None else self.like.camera(close)


def _moments(stage: Stage) -> list[Panel]:
    stored, (width, height) = stage.stored, SIZE
    if not stored.moves:
        asked = [np.array(HOME_Q), stored.target_q]
        images = list(stage.pictures(asked, width=width, height=height, asked=True))
        return [(images[0], ""), (images[1], "asked for"), *[(None, "")] * (len(MOMENTS) - 2)]
    times, q = stage.motion()
    at = [q[np.abs(times - f * times[-1]).argmin()] for f in MOMENTS]
    images = list(stage.pictures(at, width=width, height=height))
    return [(image, f"{f * times[-1]:.1f} s") for image, f in zip(images, MOMENTS, strict=True)]


def failures(run: Run, reader: Reader, methods: Sequence[str]) -> tuple[Any, str]:
    """One success and one failure of each kind that occurs, whoever made it."""
    short, said = short_names(methods), []
    panels: list[Panel] = []
    found = {method: first_of_each_outcome(run, method, 1) for method in methods}
    for outcome in SHOWN:
        method = next((m for m in methods if found[m].get(outcome)), None)
        if method is None:
            continue
        stored = reader.trial(found[method][outcome][0], method)
        panels.append((still(stored, SIZE), verdict(stored)))
        said.append(f"{outcome}: trial {found[method][outcome][0]} of {short[method]}")
    columns = 3
    rows = [panels[i : i + columns] for i in range(0, len(panels), columns)]
    rows[-1] += [(None, "")] * (columns - len(rows[-1])) if len(rows) > 1 else []
    return _grid(rows, []), "; ".join(said)


def _grid(rows: Sequence[Sequence[Panel]], names: Sequence[str]) -> Any:
    """Pictures with words below each, names of rows at the left."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    columns = len(rows[0])
    wide = 1.45
    with style(page=False):
        layout = ConstrainedLayoutEngine(w_pad=0.01, h_pad=0.01, wspace=0.01, hspace=0.02)
        figure = Figure(
            figsize=(wide * columns, (wide * SIZE[1] / SIZE[0] + 0.2) * len(rows)), layout=layout
        )
        axes = figure.subplots(len(rows), columns, squeeze=False)
        for r, row in enumerate(rows):
            for place, (image, words) in zip(axes[r], row, strict=True):
                place.set_xticks([])
                place.set_yticks([])
                place.set_frame_on(False)
                if image is not None:
                    place.imshow(image)
                    place.set_xlabel(textwrap.fill(words, 26), fontsize=7, labelpad=2)
            if names:
                axes[r][0].set_ylabel(names[r], fontsize=7)
    return figure


def write(figure: Any, folder: Path, name: str) -> list[Path]:
    """The figure as PDF and PNG."""
    paths = [folder / f"{name}.{ending}" for ending in ("pdf", "png")]
    with style(page=False):
        for path in paths:
            metadata = {"CreationDate": None} if path.suffix == ".pdf" else {"Software": None}
            with atomic_path(path) as temporary:
                figure.savefig(
                    temporary, dpi=DPI, bbox_inches="tight", pad_inches=0.02, metadata=metadata
                )
    return paths
