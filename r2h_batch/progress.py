"""How far a sweep is, on stderr."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def progress(name: str, total: int, *, plain_every_s: float = 30.0) -> Iterator[Callable[[int], None]]:
    """Gives `advance(n)`: a bar on a terminal, else a plain line every 30 s and one at the end, all on stderr."""
    start = time.perf_counter()
    if sys.stderr.isatty() and os.environ.get("TERM", "dumb") != "dumb":
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(name, total=total)
            yield lambda n: bar.advance(task, n)
    else:
        state = {"done": 0, "said": start}

        def advance(n: int) -> None:
            state["done"] += n
            now = time.perf_counter()
            if now - state["said"] >= plain_every_s:
                rate = state["done"] / (now - start)
                left = (total - state["done"]) / rate
                line = f"{name}: {state['done']}/{total} trials, {rate:.1f} trials/s, {left:.0f} s left"
                print(line, file=sys.stderr, flush=True)
                state["said"] = now

        yield advance
    seconds = time.perf_counter() - start
    print(f"{name}: {total} trials in {seconds:.1f} s, {total / seconds:.1f} trials/s", file=sys.stderr, flush=True)
