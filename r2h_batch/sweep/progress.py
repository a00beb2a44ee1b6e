"""How far a sweep is: on stderr, and in progress.json beside the shards."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from r2h_batch.command_line import counted, is_quiet, tell

LOG_EVERY_S = 5.0


class Log:
    """progress.json: each method's trials done and planned in this sweep, trials/s and seconds
    left."""

    def __init__(self, path: Path) -> None:
        self.path, self.methods, self._written = path, {}, 0.0  # type: ignore[var-annotated]

    def say(self, name: str, done: int, total: int, seconds: float) -> None:
        """Note a method's state; the file is replaced every few seconds and when the method is
        done."""
        from r2h_batch.runs.store import replace_json

        rate = done / seconds if seconds > 0 else 0.0
        left = (total - done) / rate if rate > 0 else None
        self.methods[name] = {"done": done, "planned": total, "trials_per_s": rate, "left_s": left}
        now = time.monotonic()
        if done == total or now - self._written >= LOG_EVERY_S:
            state: dict[str, Any] = {"updated": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
            replace_json(self.path, {**state, "methods": self.methods})
            self._written = now


@contextlib.contextmanager
def progress(
    name: str, total: int, *, plain_every_s: float = 30.0, log: Log | None = None
) -> Iterator[Callable[[int], None]]:
    """Gives `advance(n)`: a bar on a terminal, else a plain line every 30 s and one at the end, all
    on stderr."""
    start = said = time.perf_counter()
    done = 0

    def count(n: int) -> None:
        nonlocal done
        done += n
        if log is not None:
            log.say(name, done, total, time.perf_counter() - start)

    if sys.stderr.isatty() and not is_quiet() and os.environ.get("TERM", "dumb") != "dumb":
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
        )

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(name, total=total)

            def move(n: int) -> None:
                count(n)
                bar.advance(task, n)

            yield move
    else:

        def speak(n: int) -> None:
            nonlocal said
            count(n)
            now = time.perf_counter()
            if now - said >= plain_every_s:
                rate = done / (now - start)
                line = f"{name}: {done}/{total} trials, {rate:.1f} trials/s, {(total - done) / rate:.0f} s left"
                tell(line)
                said = now

        yield speak
    seconds = time.perf_counter() - start
    tell(f"{name}: {counted(total, 'trials')} in {seconds:.1f} s, {total / seconds:.1f} trials/s")
