"""The command `results`: `verify RUN [--rejudge N]` finds damaged, foreign and made-up rows,
`digest RUN` names the rows."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from r2h_batch.benchmark.flags import BUILT_IN, BenchmarkFlags
from r2h_batch.command_line import call, check_seed, refuse
from r2h_batch.runs import command as stored
from r2h_batch.runs.command import digest

if TYPE_CHECKING:
    from r2h_batch.benchmark.build import BenchmarkOverrides
    from r2h_batch.rejudge.again import Rejudged

LISTED = 200
"""Differences of one method that are printed; their number is always told."""


def verify(
    folder: Path,
    /,
    *,
    rejudge: int = 0,
    method: tuple[str, ...] = (),
    seed: int | None = None,
    benchmark: BenchmarkFlags = BUILT_IN,
    device: str = "cpu",
) -> int:
    """Find truncated, flipped and foreign shards and mark them for rerun; with --rejudge, judge a
    sample of rows again.

    Exit code 0: every stored shard is as it was written, and every row that was judged again came
    out the same; 1: some are to be scored again by the same sweep, or a row differs.

    Args:
        folder: a run folder, as `python -m r2h_batch.sweep --out` writes it.
        rejudge: rows of each method to judge again from their stored poses, drawn at random; 0:
        none. method: judge only these methods again, by the sweep's word (fc) or the table's name;
        all unless given. seed: of the draw; another one each time unless given. benchmark: as the
        sweep had them; none of these where it had the built-in benchmark. device: cpu, cuda or
        cuda:N.
    """
    if rejudge < 0:
        return refuse("results", f"--rejudge is {rejudge}; it must be 0 or more rows")
    if seed is not None:
        check_seed(seed)
    code = stored.verify(folder)
    if code > 1 or not rejudge:
        return code
    from r2h_batch.benchmark.build import BenchmarkOverrides

    try:
        given = BenchmarkOverrides.of(benchmark)
        return max(code, _again(folder, rejudge, method, seed, given, device))
    except ValueError as error:
        return refuse("results", error)


def _again(
    folder: Path,
    n: int,
    method: Sequence[str],
    seed: int | None,
    given: "BenchmarkOverrides",
    device: str,
) -> int:
    """Print what the evaluator says to a sample of each method's rows; 1 where a row differs."""
    import numpy as np

    from r2h_batch.rejudge.again import Judge, rejudge
    from r2h_batch.runs.store import RunError, load_run

    run = load_run(folder, verify=False).only(method)
    names = [e["name"] for e in run.entries if e["receipts"]]
    if not names:
        raise RunError(f"{folder}: no shard of any method is stored")
    if "poses" not in run.header["stored"]:
        raise RunError(
            f"{folder}: stored without poses; sweep again without --no-poses into another --out"
        )
    draw = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
    judge = Judge(run, given=given, device=device)
    if judge.other:
        print(
            f"not as when it was scored: {', '.join(judge.other)}; so verdicts are compared exactly, margins to 0.1 mm,"
            " times to 0.05 s"
        )
    bad = 0
    for name in names:
        found = rejudge(run, name, n, judge, seed=draw)
        print("\n".join(_lines(found, draw)))
        bad += len(found.differences)
    return 1 if bad else 0


def _lines(found: "Rejudged", draw: int) -> list[str]:
    differing = len({d.trial_id for d in found.differences})
    words = f"{differing or 'none'} {'differs' if differing < 2 else 'differ'}"
    head = f"{found.method}: {found.scored} of {found.stored} rows judged again (--seed {draw}): {words}"
    lines = [head + f", {found.equal} are equal bit for bit"]
    lines += [f"  {d}" for d in found.differences[:LISTED]]
    if len(found.differences) > LISTED:
        lines.append(f"  and {len(found.differences) - LISTED} more differences")
    return lines


def main(arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.runs") -> int:
    """Exit code of the chosen subcommand; 2 refused with one line."""
    given = sys.argv[1:] if arguments is None else arguments
    return call({"verify": verify, "digest": digest}, given, prog=prog, name="results")
