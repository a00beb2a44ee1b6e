"""How far long work is: a bar on a terminal, else lines on stderr once it takes longer than a few seconds, also while a
single step of it lasts."""

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
EVERY_S = 15.0
"""Between further lines."""
FREE_S = 1.0
"""Steps done by then may have been kept from before: the speed is that of the others."""
_bars: list[str] = []
"""Names of the bars that are on the terminal, one at a time: what is done inside of it has lines."""


@contextlib.contextmanager
def progress(
    name: str, total: int, unit: str, *, first_s: float = FIRST_S, every_s: float = EVERY_S
) -> Iterator[Callable[[int], None]]:
    """Gives `advance(n)`, for commands and in Python alike.

    Args:
        name: what is done.
        total: of the things that are done; 1: what nobody can count, so a line says the seconds alone.
        unit: what they are: trials, pictures.
        first_s: when the first line comes, s.
        every_s: between later lines, s.
    """
    start, done = time.perf_counter(), 0
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
            wait = every_s
            now = time.perf_counter()
            if free < done < total:
                speed = (done - free) / (now - begin)
                left = (total - done) / speed
                LOG.info(f"{name}: {done}/{total} {unit}, {speed:.1f} {unit}/s, {left:.0f} s left")
            elif done < total:
                so_far = f"{done}/{total} {unit} after " if total > 1 else ""
                LOG.info(f"{name}: {so_far}{now - start:.0f} s{'' if so_far else ' so far'}")

    def count(n: int) -> None:
        nonlocal done
        done += n

    # a thread, because one step may take longer than the time until the next line
    speaker = threading.Thread(target=speak, name=f"progress of {name}", daemon=True)
    speaker.start()
    try:
        yield count
    finally:
        ended.set()
        speaker.join()


@contextlib.contextmanager
def not_silent(name: str) -> Iterator[None]:
    """Says every few seconds that a command works, until anything else is said: reading and drawing come before what
    `progress` counts.

    Args:
        name: of the command.
    """
    ended, before, start = threading.Event(), lines_said(), time.perf_counter()

    def speak() -> None:
        wait, own = SILENT_S, 0
        while not ended.wait(wait) and lines_said() == before + own and not _bars:
            LOG.info(f"{name}: working, {time.perf_counter() - start:.0f} s")
            wait, own = EVERY_S, lines_said() - before

    speaker = threading.Thread(target=speak, name=f"{name} is not silent", daemon=True)
    speaker.start()
    try:
        yield
    finally:
        ended.set()
        speaker.join()
