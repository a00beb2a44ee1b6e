"""How far long work is: a bar on a terminal, else lines on stderr once it takes longer than a few seconds."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator

from r2h_batch.base.io.log import LOG, is_quiet

FIRST_S = 4.0
"""Work that takes longer gets its first line about then."""
EVERY_S = 15.0
"""Between further lines."""


@contextlib.contextmanager
def progress(
    name: str, total: int, unit: str, *, first_s: float = FIRST_S, every_s: float = EVERY_S
) -> Iterator[Callable[[int], None]]:
    """Gives `advance(n)`, for commands and in Python alike.

    Args:
        name: what is done.
        total: of the things that are done.
        unit: what they are: trials, pictures.
        first_s: when the first line comes, s.
        every_s: between later lines, s.
    """
    start, done = time.perf_counter(), 0
    due = start + first_s
    if sys.stderr.isatty() and not is_quiet() and os.environ.get("TERM", "dumb") != "dumb":
        from rich import progress as rich
        from rich.console import Console

        kinds = (rich.BarColumn, rich.MofNCompleteColumn, rich.TimeRemainingColumn)
        columns = (rich.TextColumn("{task.description}"), *(kind() for kind in kinds))
        with rich.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(name, total=total)
            yield lambda n: bar.advance(task, n)
        return

    def speak(n: int) -> None:
        nonlocal done, due
        done += n
        now = time.perf_counter()
        if now >= due and done < total:
            rate = done / (now - start)
            left = f"{rate:.1f} {unit}/s, {(total - done) / max(rate, 1e-9):.0f} s left"
            LOG.info(f"{name}: {done}/{total} {unit}, {left}")
            due = now + every_s

    yield speak
