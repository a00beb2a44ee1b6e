"""Score methods or predictions files on a split's trials: `python -m r2h_batch.sweep --help`. Command line only."""

import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from r2h_batch.options import METHODS, Options, UsageError, parse

if TYPE_CHECKING:  # torch, Warp and pyarrow are imported when there is work: --help and typing errors answer at once
    from r2h_batch.jobs import Bench, Job
    from r2h_batch.writing import RunFolder

__all__ = ["METHODS", "Options", "UsageError", "main", "parse", "run"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code of the command: 0 done, 1 failed on the way, 2 refused before any work, 130 interrupted."""
    try:
        options = parse(sys.argv[1:] if arguments is None else arguments)
    except UsageError as error:
        return _fail(error, 2)
    try:
        with stop_signals() as stopping:
            return run(options, stopping)
    except KeyboardInterrupt:
        return _fail("interrupted; shards that were complete are stored, run the same command to go on", 130)
    except OSError as error:
        return _fail(f"{error.filename or 'writing the run folder'}: {error.strerror or error}", 1)


def _fail(error: object, code: int) -> int:
    print(f"sweep: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
    return code


@contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C or SIGTERM was heard: the first one asks to stop after the current chunk, the second stops."""
    heard = []

    def hear(number: int, _: object) -> None:
        heard.append(number)
        if len(heard) > 1:
            raise KeyboardInterrupt
        print("sweep: stopping after the current chunk; once more stops at once", file=sys.stderr, flush=True)

    before = {s: signal.signal(s, hear) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(heard)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run(options: Options, stopping: Callable[[], bool] = lambda: False) -> int:
    """Score every job's shards, print the table of the whole run folder once it is complete."""
    from importlib.util import find_spec

    from r2h_batch import jobs as bench_jobs
    from r2h_batch import results
    from r2h_batch.engine import Stopped, score_local
    from r2h_batch.progress import Log

    try:
        if options.engine == "ray" and find_spec("ray") is None:
            raise UsageError("--engine ray needs Ray: pip install 'r2h_batch[ray]'")
        files = bench_jobs.load_files(options)
        bench = bench_jobs.prepare(options)
        jobs = bench_jobs.make_jobs(options, files, bench)
        out, folder = _open(options, bench, jobs)
        for job in jobs:
            folder.register(job.name, job.source)
    except (UsageError, ValueError, ImportError) as error:
        return _fail(error, 2)
    for line in results.mark_for_rerun(folder.folder, folder.header):
        print(line, file=sys.stderr, flush=True)
    log = Log(folder.folder / ("progress.json" if options.part[1] == 1 else f"progress-{options.part[0]}.json"))
    try:
        if options.engine == "ray":
            from r2h_batch.cluster import score_on_ray

            score_on_ray(bench, jobs, folder, options, stopping, log)
        else:
            score_local(bench, jobs, folder, options, stopping, log)
    except Stopped:
        raise KeyboardInterrupt from None
    return _finish(options, out, [j.name for j in jobs])


def _open(options: Options, bench: "Bench", jobs: "list[Job]") -> "tuple[str, RunFolder]":
    """The run folder of the options: new, or the one to go on with."""
    from pathlib import Path

    from r2h_batch.engine import shard_size
    from r2h_batch.manifest import RunError
    from r2h_batch.writing import open_run

    out, number = options.out or time.strftime("runs/%Y%m%d-%H%M%S"), 1
    while True:
        new = not (Path(out) / "run.json").exists()
        size = options.shard_trials or (shard_size(bench, jobs) if new else 0)
        try:
            # the first of two sweeps that start together decides the shard size; the other takes it
            return out, open_run(out, {**bench.header, "shard_trials": size}, exact=bool(options.shard_trials))
        except RunError:
            if not options.force_new:
                raise
        number += 1
        out = f"{options.out}-{number}"


def _finish(options: Options, out: str, names: list[str]) -> int:
    """Print the table if every method of this sweep is complete, else what is left; the exit code."""
    from r2h_batch import report, results

    stored = results.load_run(out)
    code = 0
    for name in names:
        bad = [str(s.index) for s in stored.quarantined(name)]
        if bad:
            print(f"{name}: quarantined after three tries: shards {', '.join(bad)}", file=sys.stderr, flush=True)
            code = 1
    left = {name: len(stored.missing(name)) for name in names if stored.missing(name)}
    if left and not code:
        if options.part[1] == 1:
            code = 1
        words = ", ".join(f"{name} {n}" for name, n in left.items())
        print(f"shards that other parts have to score: {words}; the table comes with the last", file=sys.stderr)
    if not left:
        sys.stdout.write(report.render(report.table_of(stored), options.format))
        sys.stdout.flush()
    print(f"run folder: {out}", file=sys.stderr, flush=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
