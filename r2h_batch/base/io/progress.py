"""How far long work is: a bar on a terminal, else lines on stderr once it takes longer than a few seconds, also while a
single step of it lasts. In Python too, where several calls of a script are one piece of work."""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator

from r2h_batch.base.io.log import LOG, is_quiet, lines_said

FIRST_S = 4.0
"""Work that takes longer gets its first line about then."""
SILENT_S = 3.5
"""A command that has said nothing by then says that it works: before it come the seconds in which it is imported."""
SOON_S, SOON_UNTIL_S, EVERY_S = 5.0, 20.0, 15.0
"""Between further lines, at first, until work has lasted so long, and then."""
GAP_S, LEAST_S = 2.5, 0.3
"""Calls in Python with less than this between them are one piece of work; a call shorter than this says nothing."""
FREE_S = 1.0
"""Steps done by then may have been kept from before: the speed is that of the others."""
IMPORT_S = 10.0
"""Time after the import of this in which the first call is a part of the same piece of work: more is imported then."""
_bars: list[str] = []
"""Names of the bars that are on the terminal, one at a time: what is done inside of it has lines."""
_counted: list[str] = []
"""Names of what says by itself how far it is."""
_commands: list[str] = []
"""Names of the commands that run: what they say is theirs."""
_calls: dict[str, float] = {"begin": time.perf_counter(), "end": time.perf_counter() + IMPORT_S}
"""When the piece of work in Python began, and when its last call ended: the first one begins as this is imported."""


@contextlib.contextmanager
def progress(
    name: str,
    total: int,
    unit: str,
    *,
    first_s: float = FIRST_S,
    every_s: float = EVERY_S,
    since: float | None = None,
) -> Iterator[Callable[[int], None]]:
    """Gives `advance(n)`, for commands and in Python alike.

    Args:
        name: what is done.
        total: of the things that are done; 1: what nobody can count, so a line says the seconds alone.
        unit: what they are: trials, pictures.
        first_s: when the first line comes, s.
        every_s: between later lines, s.
        since: on the clock of `time.perf_counter`, when what the lines count began; None: now.
    """
    start, done = time.perf_counter(), 0
    since = start if since is None else since
    if (
        total > 1
        and not _bars
        and sys.stderr.isatty()
        and not is_quiet()
        and os.environ.get("TERM", "dumb") != "dumb"
    ):
        from rich import progress as rich
        from rich.console import Console

        kinds = (rich.BarColumn, rich.MofNCompleteColumn, rich.TimeRemainingColumn)
        columns = (rich.TextColumn("{task.description}"), *(kind() for kind in kinds))
        with rich.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(name, total=total)
            _bars.append(name)
            try:
                yield lambda n: bar.advance(task, n)
            finally:
                _bars.remove(name)
        return

    ended = threading.Event()

    def speak() -> None:
        free = 0 if ended.wait(min(FREE_S, first_s / 2)) else done
        begin = time.perf_counter()
        wait = start + first_s - begin
        while not ended.wait(wait):
            now = time.perf_counter()
            wait = every_s if now - start > SOON_UNTIL_S else min(SOON_S, every_s)
            if free < done < total:
                speed = (done - free) / (now - begin)
                left = (total - done) / speed
                LOG.info(f"{name}: {done}/{total} {unit}, {speed:.1f} {unit}/s, {left:.0f} s left")
            elif done < total:
                so_far = f"{done}/{total} {unit} after " if total > 1 else ""
                LOG.info(f"{name}: {so_far}{now - since:.0f} s{'' if so_far else ' so far'}")

    def count(n: int) -> None:
        nonlocal done
        done += n

    # a thread, because one step may take longer than the time until the next line
    speaker = threading.Thread(target=speak, name=f"progress of {name}", daemon=True)
    speaker.start()
    _counted.append(name)
    try:
        yield count
    finally:
        _counted.remove(name)
        ended.set()
        speaker.join()


@contextlib.contextmanager
def busy(name: str) -> Iterator[None]:
    """Says that a call in Python works once the calls of a script have said nothing for `FIRST_S`, together.

    A script imports, loads, draws and judges: each call is short, and all of them are not. A command has `not_silent`.

    Args:
        name: what the call does.
    """
    if _commands or _counted or _bars:
        yield
        return
    now = time.perf_counter()
    if now - _calls["end"] > GAP_S:
        _calls["begin"] = now
    first_s = max(FIRST_S - (now - _calls["begin"]), LEAST_S)
    before = lines_said()
    try:
        with progress(name, 1, "", first_s=first_s, since=_calls["begin"]):
            yield
    finally:
        _calls["end"] = time.perf_counter()
        if lines_said() > before:
            _calls["begin"] = _calls["end"]


@contextlib.contextmanager
def not_silent(name: str) -> Iterator[None]:
    """Says now and then that a command works, while nothing else is said: reading and drawing come before what
    `progress` counts. Once, also while that counts: it may just have begun. As rarely as `progress`, once it has lasted:
    a minute on a busy machine must not fill the screen.

    Args:
        name: of the command.
    """
    ended, start = threading.Event(), time.perf_counter()

    def speak() -> None:
        counted: list[str] = []
        wait, before = SILENT_S, lines_said()
        while not ended.wait(wait):
            lasted = time.perf_counter() - start
            if lines_said() == before and not _bars and not counted:
                LOG.info(f"{name}: working, {lasted:.0f} s")
            wait = EVERY_S if lasted > SOON_UNTIL_S else SOON_S
            before, counted = lines_said(), _counted

    speaker = threading.Thread(target=speak, name=f"{name} is not silent", daemon=True)
    speaker.start()
    _commands.append(name)
    try:
        yield
    finally:
        _commands.remove(name)
        ended.set()
        speaker.join()
