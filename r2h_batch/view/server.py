"""The viewer: a run's trials listed and filtered, one (or the same of two methods) in three
dimensions, its motion played."""

import threading
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from r2h_batch.command_line import UsageError, tell
from r2h_batch.export.drawing import Stage
from r2h_batch.export.stored import ExportError, Reader
from r2h_batch.runs.store import RunError
from r2h_batch.view.choose import ANY, ORDERS, Filter, chosen, words_of
from r2h_batch.view.draw import MARKS, Drawn, look_at, prepare
from r2h_batch.view.page import APART_M, new_server, stop_server
from r2h_batch.view.words import as_markdown, in_brief

LISTED = 500
"""Trials in the list; `from` says which of those that pass the filters comes first."""
NOBODY = "nobody"
TICK_S = 0.04


def serve(reader: Reader, methods: Sequence[str], trial: int | None, port: int) -> None:
    """Shows the run until it is interrupted; says where on stderr."""
    viewer = Viewer(reader, methods, trial, port)
    tell(f"view: {viewer.address} (Ctrl-C ends)")
    try:
        viewer.run()
    finally:
        viewer.stop()


class Viewer:
    """A viser server with one run's trials. `run` plays until `stop`; everything else follows the
    controls."""

    def __init__(
        self, reader: Reader, methods: Sequence[str] = (), trial: int | None = None, port: int = 0
    ) -> None:
        self.reader, self.lock, self.ended = reader, threading.RLock(), threading.Event()
        names = list(reader.run.methods)
        if not names:
            raise UsageError(f"{reader.where}: no method is complete; run its sweep again to go on")
        first = [reader.method(m) for m in methods] or names[:1]
        self.server = new_server(port)
        self.address = f"http://127.0.0.1:{self.server.get_port()}"
        self.drawn: list[Drawn] = []
        self.motions: list[tuple[Any, Any]] = []
        self.listed: dict[str, int] = {}
        prepare(self.server)
        self._add_controls(names, first)
        self._filter(trial)

    def stop(self) -> None:
        """Ends `run` and the server."""
        self.ended.set()
        stop_server(self.server)

    def run(self) -> None:
        """Plays while `play` is ticked, in real time times the speed, until `stop` or an
        interrupt."""
        while not self.ended.is_set():
            time.sleep(TICK_S)
            with self.lock:
                if self.play.value and self.slider.max > 0:
                    t = self.slider.value + TICK_S * float(self.speed.value)
                    self.slider.value = (
                        0.0 if t > self.slider.max + 0.5 else min(t, self.slider.max)
                    )

    def _add_controls(self, names: list[str], first: Sequence[str]) -> None:
        gui = self.server.gui
        with gui.add_folder("Trials"):
            self.method = gui.add_dropdown("method", names, initial_value=first[0])
            self.beside = gui.add_dropdown(
                "beside it", [NOBODY, *names], initial_value=[*first, NOBODY][1]
            )
            self.object, self.outcome, self.reason = (
                gui.add_dropdown(word, [ANY], initial_value=ANY)
                for word in ("object", "outcome", "plan's reason")
            )
            self.order = gui.add_dropdown("sorted by", list(ORDERS), initial_value=ORDERS[0])
            self.below = gui.add_number("margin below, mm", 1000.0, step=1.0)
            self.start = gui.add_number(
                "from", 1, min=1, step=LISTED, hint=f"the list holds {LISTED} trials from this one"
            )
            self.count = gui.add_markdown("")
            self.list = gui.add_dropdown("trial", ["none"], initial_value="none")
            self.before, self.after = gui.add_button("previous"), gui.add_button("next")
        self.words = gui.add_markdown("")
        with gui.add_folder("Motion"):
            self.kind = gui.add_dropdown(
                "motion", ["executed", "planned"], initial_value="executed"
            )
            self.slider = gui.add_slider("time, s", 0.0, 10.0, 0.01, 0.0)
            self.play = gui.add_checkbox("play", False)
            self.speed = gui.add_dropdown(
                "speed", ["0.25", "0.5", "1", "2", "4"], initial_value="1"
            )
        with gui.add_folder("Shown"):
            self.shown = {mark: gui.add_checkbox(mark, True) for mark in MARKS}
        for control in (
            self.method,
            self.object,
            self.outcome,
            self.reason,
            self.order,
            self.below,
            self.start,
        ):
            control.on_update(lambda _: self._filter())
        for control in (self.list, self.beside, self.kind):
            control.on_update(lambda _: self._show())
        self.slider.on_update(lambda _: self._pose())
        self.before.on_click(lambda _: self._step(-1))
        self.after.on_click(lambda _: self._step(1))
        for mark, box in self.shown.items():
            box.on_update(partial(self._tick, mark))

    def _tick(self, mark: str, _: Any) -> None:
        for drawn in self.drawn:
            drawn.show(mark, bool(self.shown[mark].value))

    def _filter(self, trial: int | None = None) -> None:
        """The list of trials, as the filters want it; `trial` (or what was shown, or the first) is
        shown."""
        with self.lock:
            rows = self.reader.rows(self.method.value).to_pylist()
            for control, column in (
                (self.object, "object"),
                (self.outcome, "outcome"),
                (self.reason, "plan_reason"),
            ):
                words = words_of(rows, column)
                if tuple(control.options) != tuple(words):
                    control.options = words
            by = Filter(
                self.object.value,
                self.outcome.value,
                self.reason.value,
                self.order.value,
                float(self.below.value),
            )
            kept = chosen(rows, by)
            wanted = trial if trial is not None else self.listed.get(self.list.value)
            if trial is not None and all(row["trial_id"] != trial for row in kept):
                raise ExportError(
                    f"{self.reader.where}: no trial {trial}; it has {len(kept)} of them"
                )
            some, listed = _part(kept, int(self.start.value), wanted if trial is not None else None)
            self.listed = {in_brief(row): row["trial_id"] for row in some}
            self.count.content = f"{len(kept)} of {len(rows)} trials{listed}"
            options = list(self.listed) or ["none"]
            self.list.options = options
            self.list.value = next((k for k, v in self.listed.items() if v == wanted), options[0])
        self._show()

    def _step(self, by: int) -> None:
        names = list(self.listed)
        if names:
            self.list.value = names[(names.index(self.list.value) + by) % len(names)]

    def _show(self) -> None:
        """Draws the trial that is chosen, of one method or of two."""
        with self.lock:
            for drawn in self.drawn:
                drawn.remove()
            self.drawn, self.motions, words = [], [], []
            trial = self.listed.get(self.list.value)
            for name in [
                self.method.value,
                *([self.beside.value] if self.beside.value != NOBODY else []),
            ]:
                if trial is None:
                    continue
                try:
                    stage = Stage(self.reader.trial(trial, name))
                except (ExportError, RunError) as error:
                    words.append(f"{name}: {error}")
                    continue
                self._draw(stage)
                words.append(as_markdown(stage))
            self.words.content = "\n\n---\n\n".join(words)
            last = max((float(times[-1]) for times, _ in self.motions), default=0.0)
            self.slider.max = max(last, 0.01)
            self.slider.value = last
        self._pose()

    def _draw(self, stage: Stage) -> None:
        k = len(self.drawn)
        if k == 0:
            look_at(self.server, stage, aside=APART_M * (self.beside.value != NOBODY))
        drawn = Drawn(self.server.scene, stage, f"/trial_{k}", (0.0, APART_M * k, 0.0))
        for mark, box in self.shown.items():
            drawn.show(mark, bool(box.value) and (mark != "target" or not stage.stored.moves))
        self.drawn.append(drawn)
        moves = stage.stored.moves
        q = stage.stored.target_q[None]
        self.motions.append(
            stage.motion(self.kind.value == "executed") if moves else (np.zeros(1), q)
        )

    def _pose(self) -> None:
        with self.lock:
            for drawn, (times, q) in zip(self.drawn, self.motions, strict=True):
                drawn.pose(q[np.abs(times - self.slider.value).argmin()])


def _part(
    rows: Sequence[dict[str, Any]], start: int, wanted: int | None
) -> tuple[list[dict[str, Any]], str]:
    """The rows that are listed, from number `start` (1 is the first), and words for it; `wanted` is
    listed whatever its place."""
    first = max(0, min(start, len(rows)) - 1)
    some = list(rows[first : first + LISTED])
    words = f", {first + 1} to {first + len(some)} listed" if len(some) < len(rows) else ""
    return some + [row for row in rows if row["trial_id"] == wanted and row not in some], words
