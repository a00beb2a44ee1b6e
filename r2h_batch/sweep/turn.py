"""The command `turn`: a run's trials again with turned objects. Light until there is work."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.registry import TURNS
from r2h_batch.protocols.choice import DEFAULT, BenchmarkChoice

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run
    from r2h_batch.sweep.jobs import Job, Setting


def turn(
    folder: Path,
    /,
    *,
    method: tuple[str, ...] = (),
    trials: int = 0,
    by: tuple[str, ...] = (),
    format: Literal["md", "csv", "json"] = "md",
    benchmark: BenchmarkChoice = DEFAULT,
    device: str = "cpu",
) -> int:
    """Score a run's trials again with turned objects: does a method depend on how a mesh lies in its file?

    The objects are turned by 180 degrees, and their axes are cycled. Grasps, hands and trials stay the same. The
    command stores the rows beside the run, in RUN-turned, and prints how far SR moves. Afterwards every report of
    the run has a mark where success depends on the frame, by a test over all turns. The same command goes on after an
    interruption.

    Args:
        folder: a run folder, as `r2h-batch sweep --out` writes it.
        method: only these methods, by the sweep's word (fc) or the table's name; by default all built-in
            ones. Your own as the sweep was given it (NAME=FILE.py:function): nothing that a run folder
            names is run.
        trials: of each split, the first ones of the run; 0: all.
        by: further turns, as degrees about x, y and z: --by 20,40,60 (--by=-20,0,0).
        format: md, csv or json.
        benchmark: where its files are now, if they are not where the sweep found them.
        device: cpu, cuda or cuda:N.
    """
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.options import base_of

    if trials < 0:
        raise UsageError(f"--trials is {trials}; it must be 0 (all) or more")
    if benchmark.turn:
        raise UsageError("--turn is the command's own; leave it out, or give --by")
    run = load_run(folder)
    run.only([word for word in method if ":" not in base_of(word)])  # before torch is imported
    from r2h_batch.protocols.edit import frame_of
    from r2h_batch.report.turn import folder_of, render, turned
    from r2h_batch.runs.writing import open_run
    from r2h_batch.sweep.command import stop_signals
    from r2h_batch.sweep.scoring import ProgressFile, Scoring, Stopped, score_local, shard_size

    words = tuple(dict.fromkeys((*TURNS, *(word.replace(" ", "") for word in by))))
    for word in words:
        frame_of(word)
    refused: list[str] = []
    with stop_signals() as stopping:
        for word in words:
            setting = _setting(run, word, trials, benchmark, device)
            jobs = _jobs(run, method, setting)
            out = folder_of(run.folder, word)
            size = shard_size(setting, jobs) if not (out / "run.json").exists() else 0
            stored = open_run(
                out,
                {**setting.header, "command": ["r2h-batch", "turn"], "shard_trials": size},
                exact=False,
            )
            for job in jobs:
                stored.register(job.name, job.source)
            LOG.info(f"objects turned: {word}")
            progress = ProgressFile(stored.folder / setting.own_file("progress.json"))
            try:
                refused += score_local(Scoring(setting, jobs, stored, stopping, progress))
            except Stopped:
                raise KeyboardInterrupt from None
    found = turned(
        load_run(folder, verify=False).only([job.name for job in jobs if job.name not in refused])
    )
    sys.stdout.write(render(found, format))
    return 2 if refused else 0


def _setting(run: "Run", word: str, trials: int, flags: BenchmarkChoice, device: str) -> "Setting":
    """The run's evaluator and plan with turned objects."""
    from r2h_batch.protocols.edit import in_frame
    from r2h_batch.protocols.of_run import benchmark_of_run
    from r2h_batch.sweep.jobs import prepare
    from r2h_batch.sweep.request import Work
    from r2h_batch.sweep.results.reevaluation import configuration

    header, where = run.header, str(run.folder)
    if (header.get("benchmark") or {}).get("flags") and any(
        "--turn" in f for f in header["benchmark"]["flags"]
    ):
        raise UsageError(
            f"{where}: its objects are turned already; give the run of the objects as they lie"
        )
    own = benchmark_of_run(header, flags, where)
    plan = {split: min(n, trials or n) for split, n in header["trials"].items()}
    config = configuration(header["configuration"], where)
    work = Work(device, None, 0, (1, 1), None)
    setting = prepare(in_frame(own, word), plan, config, work, None)
    said = (header.get("benchmark") or {}).get("flags", ())
    setting.header.update(
        benchmark={"flags": [*said, f"--turn {word}"]}, seed=header["seed"], stored=["poses"]
    )
    if "predictors" in header:
        setting.header["predictors"] = header["predictors"]
    return setting


def _jobs(run: "Run", words: Sequence[str], setting: "Setting") -> list["Job"]:
    """Who answers: the run's built-in methods, and the user's own that the command line names.

    Raises:
        UsageError, RunError: a method is not in the run, or no longer the one that answered there.
    """
    from r2h_batch.sweep.jobs import NotBuiltIn, job_of_run, make_jobs
    from r2h_batch.sweep.options import base_of
    from r2h_batch.sweep.request import Methods

    own = [word for word in words if ":" in base_of(word)]
    header = run.header
    about: dict[str, Any] = header.get("predictors", {})
    errors = (about.get("noise") or {}).get("target_errors", "normal")
    methods = Methods(
        tuple(own), seed=header["seed"], noise_factor=about.get("noise_factor", 1.0), errors=errors
    )
    jobs = make_jobs(methods, [], setting)
    for job in jobs:
        entry = run.entry(job.name)
        changed = [
            k for k, v in entry.source.items() if k != "predictors" and job.source.get(k) != v
        ]
        if changed:
            what = ", ".join(changed)
            raise UsageError(
                f"--method {job.name}: its {what} changed since the run; sweep again into another --out"
            )
    named = [word for word in words if word not in own]
    chosen = run.only(named) if named or not own else replace(run, entries=())
    for entry in chosen.entries:
        try:
            jobs.append(job_of_run(header, entry.source, setting.evaluator))
        except NotBuiltIn as error:
            how = (
                "give --method NAME=FILE.py:function or package.module:function as the sweep had it"
            )
            if named:
                raise UsageError(f"{entry.name}: {error}; {how}") from None
            LOG.info(f"{entry.name}: not turned: {error}; {how}")
    if not jobs:
        raise UsageError(f"{run.folder}: no method to turn; files of answers have one frame only")
    return jobs
