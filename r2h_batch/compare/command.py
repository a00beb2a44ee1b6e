"""The command `compare`: methods of run folders, paired on the trials that they share. Light until there is work."""

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from r2h_batch.command_line import call, refuse

if TYPE_CHECKING:
    from r2h_batch.results.reading import Run


def run(
    runs: tuple[Path, ...], /, *, seed: int = 0, format: Literal["md", "json"] = "md", method: tuple[str, ...] = ()
) -> int:
    """Compare all methods of run folders on the trials that they share.

    Args:
        runs: run folders, as `python -m r2h_batch.sweep --out` writes them; one with several methods is enough.
        seed: of the bootstrap.
        format: md or json.
        method: only these methods, by the sweep's word (fc) or the table's name; all unless given.
    """
    import json
    from dataclasses import asdict

    from r2h_batch.compare.text import render
    from r2h_batch.results.reading import load_run
    from r2h_batch.statistics.paired import compare, pair_up

    try:
        if not runs:
            raise ValueError("no run folder is given; one with several methods is enough")
        stored = [load_run(r) for r in runs]
        comparisons = compare(pair_up(_chosen(stored, method) if method else stored), seed=seed)
    except (ValueError, OSError) as error:
        return refuse("compare", error)
    if format == "md":
        sys.stdout.write(render(comparisons))
    else:
        records = [{**asdict(c), "rank": None if c.rank is None else c.rank.tolist()} for c in comparisons]
        print(json.dumps(records, indent=1, allow_nan=False))
    return 0


def _chosen(runs: "list[Run]", words: Sequence[str]) -> "list[Run]":
    """The runs with the chosen methods; every word must be a method of at least one run."""
    from r2h_batch.results.manifest import RunError

    kept: list[Run] = []
    known: set[str] = set()
    for stored in runs:
        mine = []
        for word in words:
            with contextlib.suppress(RunError):
                mine.append(stored.named(word))
                known.add(word)
        kept += [stored.only(mine)] if mine else []
    for word in words:
        if word not in known:
            runs[0].named(word)
    return kept


def main(arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.compare") -> int:
    """Exit code: 0 compared, 2 refused with one line."""
    return call(run, sys.argv[1:] if arguments is None else arguments, prog=prog, name="compare")
