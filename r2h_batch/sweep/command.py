"""Score methods or predictions files on a split's trials: `python -m r2h_batch.sweep --help`.
Command line only."""

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from r2h_batch.base.command_line import counted, exit_code_of, failed, refuse
from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.log import LOG, telling
from r2h_batch.strangers import end_without_threads
from r2h_batch.sweep.options import Options, parse

# torch, Warp and pyarrow are imported when there is work: --help and typing errors answer at once
if TYPE_CHECKING:
    from r2h_batch.base.loggers import LoggerName
    from r2h_batch.runs.store import Run
    from r2h_batch.sweep.jobs import Setting
    from r2h_batch.sweep.request import Sweep
    from r2h_batch.sweep.scoring import Scoring


def main(arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.sweep") -> int:
    """Exit code of the command: 0 done, 1 failed on the way, 2 refused before any work, 130
    interrupted."""
    words = sys.argv[1:] if arguments is None else arguments
    code = exit_code_of("sweep", lambda: _main(words, prog))
    if arguments is None:
        end_without_threads(code)
    return code


def _main(arguments: Sequence[str], prog: str) -> int:
    options = parse(arguments, prog=prog)
    try:
        with stop_signals() as stopping:
            return run(options, stopping, arguments)
    except KeyboardInterrupt:
        words = "shards that were complete are stored, run the same command to go on"
        return refuse("sweep", f"interrupted; {words}", 130)
    except OSError as error:
        return failed("sweep", error, "writing the run folder")
    except (RuntimeError, AssertionError) as error:
        from r2h_batch.sweep.answers import device_trouble

        if (trouble := device_trouble(error)) is None:
            raise
        words = "shards that were complete are stored; run the same command to go on once `nvidia-smi` shows the GPU"
        return refuse("sweep", f"--device {options.device}: {trouble}; {words}", 1)


@contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C or SIGTERM was heard: the first one asks to stop after the current chunk, the
    second stops. Signals are the main thread's: in another one whoever has it hears them. A child that a method forks ends of
    them: a pool of processes ends its own so, and waits."""
    heard: list[int] = []
    me = os.getpid()
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def hear(number: int, _: object) -> None:
        if os.getpid() != me:
            signal.signal(number, before[signal.Signals(number)])
            os.kill(os.getpid(), number)
            return
        heard.append(number)
        if len(heard) > 1:
            raise KeyboardInterrupt
        LOG.info("sweep: stopping after the current chunk; once more stops at once")

    before = {s: signal.signal(s, hear) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(heard)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run(
    options: Options,
    stopping: Callable[[], bool] = lambda: False,
    arguments: Sequence[str] = (),
) -> int:
    """Score every job's shards, print the table of the whole run folder once it is complete.

    `arguments`: the command line that asked for it, which run.json keeps.
    """
    command = ["python", "-m", "r2h_batch.sweep", *arguments]
    # a method may change the directory, when it is imported or asked
    out = os.path.abspath(options.out or time.strftime("runs/%Y%m%d-%H%M%S"))
    options = replace(options, out=out)
    with telling(quiet=options.quiet, verbose=options.verbose) as log_to:
        return _run(options, stopping, log_to, command)


def _run(
    options: Options,
    stopping: Callable[[], bool],
    log_to: Callable[[Path], None],
    command: list[str],
) -> int:
    from r2h_batch.base.io.read import printable
    from r2h_batch.runs.files import RunError
    from r2h_batch.runs.header import motions_left_out
    from r2h_batch.runs.store import write_labels
    from r2h_batch.runs.writing import check_place, open_run
    from r2h_batch.sweep import jobs as sweep_jobs
    from r2h_batch.sweep.cluster import ClusterError, reach
    from r2h_batch.sweep.request import requested
    from r2h_batch.sweep.scoring import ProgressFile, Scoring, Stopped, shard_size

    try:
        _check_installed(options)
        check_place(Path(options.out))
        if options.address:
            reach(options.address, options.ray_timeout)
        sweep = requested(options)
        files, out = sweep_jobs.load_files(sweep), Path(sweep.out)
        sweep_jobs.resolve(sweep)
        start = time.perf_counter()
        setting = sweep_jobs.set_up(sweep)
        if sweep.object_mesh and (
            shares := sweep.shares(setting.evaluator.benchmark, setting.header["trials"])
        ):
            LOG.info(f"sweep: {shares}")
        if setting.evaluator.benchmark.certified is not None:
            for line in _uncertified(setting):
                LOG.info(f"sweep: {line} (docs/r2h_v3.md#certificates)")
        planned, seconds = counted(setting.planned, "trials"), time.perf_counter() - start
        LOG.debug(f"ready in {seconds:.1f} s: {setting.evaluator!r}, {planned}")
        jobs = sweep_jobs.make_jobs(setting, files)
        new = not (out / "run.json").exists()
        size = sweep.shard_trials or (shard_size(setting, jobs) if new else 0)
        # the first of two sweeps that start together decides the shard size; the other takes it
        header = {**setting.header, "command": command, "shard_trials": size}
        try:
            folder = open_run(out, header, exact=bool(sweep.shard_trials))
        except RunError as error:
            if changed := setting.files.changed(out):
                raise RunError(f"{error}; {printable(', '.join(changed))} changed since") from None
            raise
        log_to(folder.folder / setting.own_file("log.txt"))
        setting.files.copy_into(folder.folder)
        if setting.labels:
            write_labels(folder.folder, setting.labels)
        for job in jobs:
            if folder.register(job.name, job.source, overwrite=sweep.overwrite):
                LOG.info(f"{job.name}: it changed, so its rows of before are gone")
            LOG.debug(f"{job.name}: {', '.join(f'{k} {v}' for k, v in job.source.items() if v)}")
        for line in (line for job in jobs for line in job.lines):
            LOG.info(line)
        for line in (*setting.files.lines(), *motions_left_out(sweep.left_out)):
            LOG.info(line)
    except (ClusterError, ValueError, ImportError) as error:
        return refuse("sweep", error)
    except OSError as error:
        return _failed(error, Path(options.out))
    try:
        progress = ProgressFile(folder.folder / setting.own_file("progress.json"))
        return _score(Scoring(setting, jobs, folder, stopping, progress))
    except OSError as error:
        return _failed(error, folder.folder)
    except Stopped:
        raise KeyboardInterrupt from None
    except (ClusterError, RunError) as error:  # RunError: somebody changed the folder meanwhile
        return refuse("sweep", error, 1)


def _check_installed(options: Options) -> None:
    """Raises `UsageError` where an option needs a package that is not installed."""
    from importlib.util import find_spec

    for module, flag, extra in (
        ("ray" if options.engine == "ray" else "", "--engine ray", "ray"),
        (options.log, f"--log {options.log}", options.log),
        ("gymnasium" if options.receiver_motion else "", "--receiver-motion", "env"),
    ):
        if module and find_spec(module) is None:
            raise UsageError(f"{flag} needs {module}: pip install 'r2h_batch[{extra}]'")


def _failed(error: OSError, folder: Path) -> int:
    from r2h_batch.runs.files import trouble_in

    if words := trouble_in(folder, error):
        return refuse("sweep", words, 1)
    return failed("sweep", error, "writing the run folder")


def _score(work: "Scoring") -> int:
    """Score what is missing or damaged, in this process or on a cluster; the exit code."""
    from r2h_batch.runs.verify import mark_for_rerun
    from r2h_batch.sweep.cluster import score_on_ray
    from r2h_batch.sweep.scoring import score_local

    folder, sweep = work.folder, work.setting.sweep
    for line in mark_for_rerun(folder.folder, folder.header):
        LOG.info(line)
    refused = score_on_ray(work) if sweep.engine == "ray" else score_local(work)
    names = [j.name for j in work.jobs if j.name not in refused]
    for name, shards in work.without.items():
        which, last = ", ".join(map(str, sorted(shards))), list(shards.values())[-1]
        words = f"{name}: left out after three tries: shards {which} (the last: {last})"
        LOG.error(f"{words}; the same command tries them again")
    alone = sweep.part[1] == 1
    code = _finish(sweep, names, alone=alone, without=bool(work.without))
    return max(refused.values(), default=code)


def _log(stored: "Run", kind: "LoggerName") -> None:
    """The table's numbers in a logger, each as METHOD/SPLIT/NAME; what it prints goes to stderr."""
    from r2h_batch.base.loggers import Logger
    from r2h_batch.report.table import record, table_of

    table = table_of(stored)
    with redirect_stdout(sys.stderr), Logger(kind, stored.folder, table.origin) as logger:
        for row in table.rows:
            numbers = {k: v for k, v in record(row).items() if isinstance(v, (int, float))}
            place = f"{row.method.partition(' (')[0]}/{row.split}"
            logger.log({f"{place}/{name}": value for name, value in numbers.items()})


def _finish(sweep: "Sweep", names: list[str], *, alone: bool, without: bool) -> int:
    """Print the table if every method of this sweep is complete, else what is left; the exit code.

    `alone`: no other part of this sweep scores what is left. `without`: it went on without a shard, and has said so.
    """
    from r2h_batch.report import table as report
    from r2h_batch.report.card import write_summary
    from r2h_batch.report.next_commands import next_commands
    from r2h_batch.runs import store as results

    stored = results.load_run(Path(sweep.out))
    code = 1 if without else 0
    left = {name: len(stored.missing(name)) for name in names if stored.missing(name)}
    if left and not code:
        code = 1 if alone else 0
        words = ", ".join(f"{name} {n}" for name, n in left.items())
        level = (
            logging.ERROR if alone else logging.INFO
        )  # --quiet does not leave an exit code unexplained
        LOG.log(
            level, f"shards that other parts have to score: {words}; the table comes with the last"
        )
    if names and not stored.unfinished:
        write_summary(stored)
        if sweep.log:
            _log(stored, sweep.log)
    if names and not left:
        table = report.table_of(stored)
        if sweep.format == "md":
            sys.stdout.write(f"{report.brief(table)}\n{next_commands([stored], printed='brief')}")
        else:
            sys.stdout.write(report.render(table, sweep.format))
        if "episodes" in sweep.stored:
            from r2h_batch.report.closed_loop import render

            words = render(stored)
            (stored.folder / "closed_loop.md").write_text(words)
            (sys.stdout if sweep.format == "md" else sys.stderr).write(f"\n{words}")
        sys.stdout.flush()
    LOG.info(f"run folder: {sweep.out}")
    return code


def _uncertified(setting: "Setting") -> list[str]:
    """Lines on the trials of a benchmark with certificates that have none."""
    own, planned = setting.evaluator.benchmark.own_certified, setting.planned
    ids = setting.ids(0, planned).numpy()
    later = 0 if own is None or not own.search else int((~own.holds(ids)).sum())
    never = planned - later - (0 if own is None else int(own.knows(ids).sum()))
    lines = []
    if later:
        lines.append(
            f"{later} of {planned} trials are searched for a whole way when they are drawn first"
        )
    if never:
        lines.append(f"{never} of {planned} trials are not known to have a whole way")
    return lines
