"""The live viewer: it lists and filters a run's trials and shows one, or two methods on it."""

import threading
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.table import plain
from r2h_batch.runs.files import RunError
from r2h_batch.verdicts import CRITERIA, REGISTRY, UNITS
from r2h_batch.view.captions import as_markdown, summary
from r2h_batch.view.drawing import MARKS, Drawing
from r2h_batch.view.page import APART_M, Drawn, aim, light, new_server, stop_server
from r2h_batch.view.stored import Reader

ANY = "any"
NO_METHOD = "none"
ORDERS = ("trial", *(f"margin of {name}" for name in CRITERIA))
"""Orders of the list: the trial's number, or a margin, the smallest first."""
BELOW = " or ".join(dict.fromkeys(UNITS[entry.unit].shown for entry in REGISTRY))
FILTERS = {"object": "object", "outcome": "outcome", "plan's reason": "plan_reason"}
"""Controls that choose trials, and the columns that they look at."""
LISTED = 500
"""Trials in the list; `from` says which of those that pass the filters comes first."""
TICK_S = 0.04


@dataclass(frozen=True)
class Filter:
    """Which rows are listed: column -> the word that it must hold (ANY: every word), and the order.
    `below` bounds the margin that `order` names, in mm or deg."""

    words: dict[str, str]
    order: str = ORDERS[0]
    below: float = np.inf

    def chosen(self, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """The rows that pass, sorted; without a row that lacks the margin to sort by."""
        named = {f"margin of {e.name}": e for e in REGISTRY}.get(self.order)
        column, scale = (named.margin_column, UNITS[named.unit].scale) if named else ("", 1.0)

        def passes(row: dict[str, Any]) -> bool:
            wanted = all(word in (ANY, str(row[name])) for name, word in self.words.items())
            if not wanted or not column:
                return wanted
            return row[column] is not None and scale * row[column] <= self.below

        kept = [row for row in rows if passes(row)]
        return sorted(kept, key=lambda row: (row[column] if column else 0.0, row["trial_id"]))


def serve(
    reader: Reader,
    methods: Sequence[str],
    trial: int | None,
    port: int,
    only: Collection[int] | None = None,
) -> None:
    """Shows the run, or `only` these trials of it, until it is interrupted; prints the address on stderr."""
    viewer = Viewer(reader, methods, trial, port, only)
    LOG.info(f"view: {viewer.address} (Ctrl-C ends)")
    try:
        viewer.run()
    except KeyboardInterrupt:
        LOG.info("view: ended")
    finally:
        viewer.stop()


class Viewer:
    """A viser server with one run's trials; `run` plays their motion until `stop`."""

    def __init__(
        self,
        reader: Reader,
        methods: Sequence[str] = (),
        trial: int | None = None,
        port: int = 0,
        only: Collection[int] | None = None,
    ) -> None:
        self.only = only
        self.reader, self.lock, self.ended = reader, threading.RLock(), threading.Event()
        names = list(reader.run.methods)
        if not names:
            raise UsageError(f"{reader.where}: {reader.run.not_complete()}")
        first = [reader.method(m) for m in methods] or names[:1]
        self.server = new_server(port)
        self.address = f"http://127.0.0.1:{self.server.get_port()}"
        self.drawn: list[Drawn] = []
        self.listed: dict[str, int] = {}
        light(self.server)
        self._add_controls(names, first)
        self._filter(trial)

    def stop(self) -> None:
        """Ends `run` and the server."""
        self.ended.set()
        stop_server(self.server)

    def run(self) -> None:
        """Plays the motion while `play` is ticked, until `stop` or an interrupt."""
        while not self.ended.is_set():
            time.sleep(TICK_S)
            with self.lock:
                if self.play.value and self.slider.max > 0:
                    t, end = self.slider.value + TICK_S * float(self.speed.value), self.slider.max
                    self.slider.value = 0.0 if t > end + 0.5 else min(t, end)

    def _add_controls(self, names: list[str], first: Sequence[str]) -> None:
        gui = self.server.gui

        def menu(label: str, words: Sequence[str], value: str | None = None) -> Any:
            return gui.add_dropdown(label, list(words), initial_value=value or words[0])

        with gui.add_folder("Trials"):
            self.method = menu("method", names, first[0])
            self.beside = menu("beside it", [NO_METHOD, *names], [*first, NO_METHOD][1])
            self.filters = {column: menu(label, [ANY]) for label, column in FILTERS.items()}
            self.order = menu("sorted by", ORDERS)
            self.below = gui.add_number(f"margin below, {BELOW}", 1000.0, step=1.0)
            hint = f"the list holds {LISTED} trials from this one"
            self.start = gui.add_number("from", 1, min=1, step=LISTED, hint=hint)
            self.count = gui.add_markdown("")
            self.list = menu("trial", ["none"])
            self.before, self.after = gui.add_button("previous"), gui.add_button("next")
        self.words = gui.add_markdown("")
        with gui.add_folder("Motion"):
            self.kind = menu("motion", ["executed", "planned"])
            self.slider = gui.add_slider("time, s", 0.0, 10.0, 0.01, 0.0)
            self.play = gui.add_checkbox("play", False)
            self.speed = menu("speed", ["0.25", "0.5", "1", "2", "4"], "1")
        with gui.add_folder("Shown"):
            self.shown = {mark: gui.add_checkbox(mark, True) for mark in MARKS}
        for control in (self.method, *self.filters.values(), self.order, self.below, self.start):
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
        """Lists the trials that pass the filters; shows `trial`, or the one shown before, or the
        first."""
        with self.lock:
            rows = self.reader.rows(self.method.value).to_pylist()
            rows = [r for r in rows if self.only is None or r["trial_id"] in self.only]
            for column, control in self.filters.items():
                words = (ANY, *sorted({str(r[column]) for r in rows if r[column] is not None}))
                if tuple(control.options) != words:
                    control.options = words
            words_of = {column: control.value for column, control in self.filters.items()}
            kept = Filter(words_of, self.order.value, float(self.below.value)).chosen(rows)
            first = max(0, min(int(self.start.value), len(kept)) - 1)
            some = kept[first : first + LISTED]
            part = f", {first + 1} to {first + len(some)} listed" if len(some) < len(kept) else ""
            wanted = self.listed.get(self.list.value) if trial is None else trial
            if trial is not None:
                own = [row for row in kept if row["trial_id"] == trial]
                if not own:
                    why = f"no trial {trial}; it has {len(kept)} of them"
                    raise RunError(f"{self.reader.where}: {why}")
                some += [row for row in own if row not in some]
            self.listed = {summary(row): row["trial_id"] for row in some}
            self.count.content = f"{len(kept)} of {len(rows)} trials{part}"
            options = list(self.listed) or ["none"]
            self.list.options = options
            self.list.value = next((k for k, v in self.listed.items() if v == wanted), options[0])
        self._show()

    def _step(self, by: int) -> None:
        names = list(self.listed)
        if names:
            self.list.value = names[(names.index(self.list.value) + by) % len(names)]

    def _show(self) -> None:
        """Draws the chosen trial, of one method or of two."""
        with self.lock:
            for drawn in self.drawn:
                drawn.root.remove()
            self.drawn, words, last = [], [], 0.0
            trial, drawings = self.listed.get(self.list.value), []
            for name in dict.fromkeys((self.method.value, self.beside.value)):
                if trial is None or name == NO_METHOD:
                    continue
                try:
                    drawings.append(Drawing(self.reader.trial(trial, name)))
                    words.append(as_markdown(drawings[-1]))
                except RunError as error:
                    words.append(plain(f"{name}: {error}"))
            view = aim(self.server, drawings) if drawings else None
            for k, drawing in enumerate(drawings):
                assert view is not None
                drawn = Drawn(self.server.scene, drawing, view, f"/trial_{k}", APART_M * k)
                for mark, box in self.shown.items():
                    ghost = mark == "target" and not drawing.away
                    drawn.show(mark, bool(box.value) and not ghost)
                self.drawn.append(drawn)
                last = max(last, drawn.play(self.kind.value == "executed"))
            self.words.content = "\n\n---\n\n".join(words)
            self.slider.max = max(last, 0.01)
            self.slider.value = last
        self._pose()

    def _pose(self) -> None:
        with self.lock:
            for drawn in self.drawn:
                drawn.at(self.slider.value)
