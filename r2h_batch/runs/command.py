"""Two answers of the command `results` (r2h_batch.rejudge.command): which shards are damaged, and
the digest of the rows."""

from collections.abc import Sequence
from pathlib import Path

from r2h_batch.command_line import refuse


def verify(folder: Path, /) -> int:
    """Find truncated, flipped and foreign shards and mark them for rerun.

    Exit code 0: every stored shard is as it was written; 1: some are to be scored again by the same
    sweep.

    Args:
        folder: a run folder, as `python -m r2h_batch.sweep --out` writes it.
    """
    from r2h_batch.runs.store import load_run, mark_for_rerun, read_header, shards_of

    try:
        lines = mark_for_rerun(folder, read_header(folder))
        print("\n".join(lines or [f"{folder}: every stored shard is as it was written"]))
        run = load_run(folder, verify=False)
    except ValueError as error:
        return _refuse(error)
    for name in run.unfinished:
        missing = [str(s.index) for s in run.missing(name)]
        print(
            f"{name}: {len(missing)} of {len(shards_of(run.header))} shards to be scored: {_first(missing)}"
        )
    return 1 if lines else 0


def digest(folder: Path, /) -> int:
    """Print the digest of each method's rows: equal digests, equal verdicts, whatever the machine,
    shards or order.

    Args:
        folder: a run folder, as `python -m r2h_batch.sweep --out` writes it.
    """
    from r2h_batch.runs.store import load_run

    try:
        run = load_run(folder)
        for name in (e["name"] for e in run.entries):
            left = len(run.missing(name))
            print(f"{run.digest(name)}  {name}" + (f" (without {left} shards)" if left else ""))
    except ValueError as error:
        return _refuse(error)
    return 0


def _refuse(error: Exception) -> int:
    return refuse("results", error)


def _first(items: Sequence[str], n: int = 10) -> str:
    return ", ".join(items[:n]) + (", ..." if len(items) > n else "")
