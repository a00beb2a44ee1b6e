"""The command `results`: `verify DIR` finds damaged and foreign shards, `digest DIR` names its rows."""

import sys
from collections.abc import Sequence
from pathlib import Path

from r2h_batch.command_line import call, refuse


def verify(folder: Path, /) -> int:
    """Find truncated, flipped and foreign shards and mark them for rerun.

    Exit code 0: every stored shard is as it was written; 1: some are to be scored again by the same sweep.

    Args:
        folder: a run folder, as `python -m r2h_batch.sweep --out` writes it.
    """
    from r2h_batch.results.manifest import read_header, shards_of
    from r2h_batch.results.reading import load_run, mark_for_rerun

    try:
        lines = mark_for_rerun(folder, read_header(folder))
        print("\n".join(lines or [f"{folder}: every stored shard is as it was written"]))
        run = load_run(folder, verify=False)
    except (ValueError, OSError) as error:
        return _refuse(error)
    for name in run.unfinished:
        missing = [str(s.index) for s in run.missing(name)]
        print(f"{name}: {len(missing)} of {len(shards_of(run.header))} shards to be scored: {_first(missing)}")
    return 1 if lines else 0


def digest(folder: Path, /) -> int:
    """Print the digest of each method's rows: equal digests, equal verdicts, whatever the machine, shards or order.

    Args:
        folder: a run folder, as `python -m r2h_batch.sweep --out` writes it.
    """
    from r2h_batch.results.reading import load_run

    try:
        run = load_run(folder)
        for name in (e["name"] for e in run.entries):
            left = len(run.missing(name))
            print(f"{run.digest(name)}  {name}" + (f" (without {left} shards)" if left else ""))
    except (ValueError, OSError) as error:
        return _refuse(error)
    return 0


def main(arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.results") -> int:
    """Exit code of the chosen subcommand; 2 refused with one line."""
    given = sys.argv[1:] if arguments is None else arguments
    return call({"verify": verify, "digest": digest}, given, prog=prog, name="results")


def _refuse(error: Exception) -> int:
    return refuse("results", error)


def _first(items: Sequence[str], n: int = 10) -> str:
    return ", ".join(items[:n]) + (", ..." if len(items) > n else "")
