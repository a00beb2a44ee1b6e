"""The commands `submit` and `leaderboard`: a run as one checked file, and a page of such files that
have been judged again."""

import contextlib
import json
import shutil
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from r2h_batch.base.command_line import UsageError, counted, refuse
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import FileError, archive_members, open_archive, printable
from r2h_batch.base.io.write import atomic_path, check_output_file, write_text
from r2h_batch.trials.benchmark.flags import BUILT_IN, BenchmarkFlags

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run
    from r2h_batch.sweep.results.reevaluation import Judge

JUDGED_BY = ("protocol", "configuration", "digests", "versions", "device", "benchmark", "objects")
"""Fields of run.json that an evaluator, and what it may compare bit for bit, depend on."""
MAX_BYTES, MAX_MEMBERS = 4 << 30, 100_000
BUNDLE = "submission.json"
"""Digest of each method's rows, the versions that scored them, and which methods are built in."""


def submit(
    run: Path,
    /,
    *,
    out: Path | None = None,
    rows: int = 200,
    benchmark: BenchmarkFlags = BUILT_IN,
    overwrite: bool = False,
) -> int:
    """Write a finished run as one file for a leaderboard, after judging a sample of its rows again.

    The file holds rows, scored poses, configuration, checksums and the run's card.

    Args:
        run: a run folder with poses, as `r2h-batch sweep --out` writes it.
        out: the file to write; RUN.zip by default.
        rows: rows of each method that the command judges again before it writes.
        benchmark: the flags that the sweep had.
        overwrite: replace a file of this name.
    """
    from r2h_batch.report.card import write_summary
    from r2h_batch.runs.store import load_run

    out = out or Path(f"{run}.zip")
    check_output_file(out, overwrite=overwrite)
    stored = load_run(run)
    try:
        built_in = _judged_again(stored, rows, {}, benchmark)
    except ValueError as error:
        raise ValueError(f"{run}: {error}; the run cannot be submitted") from None
    write_summary(stored)
    files = ["run.json", "README.md", "table.md", "results.json"]  # what a run is read from
    for entry in stored.entries:
        files.append(f"methods/{entry.slug}.json")
        for shard in entry.shards.values():
            files += [str(file.relative_to(entry.folder)) for file in shard.files]
    digests = {m: stored.digest(m) for m in stored.methods}
    about = {"format": 1, "rows": digests, "versions": stored.header["versions"]}
    about["built_in"] = built_in
    with atomic_path(out) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for file in files:
            archive.write(stored.folder / file, f"run/{file}")
        archive.writestr(BUNDLE, json.dumps(about, indent=1))
    held = counted(len(digests), "methods")
    print(f"{out}: {held}, {len(files)} files, {out.stat().st_size:,} bytes")
    return 0


def _judged_again(
    run: "Run", rows: int, judges: "dict[str, Judge]", benchmark: BenchmarkFlags
) -> list[str]:
    """The run's built-in methods, which answered again; ValueError where a row is not what the
    evaluator says.

    `judges`: evaluators by what they depend on (`JUDGED_BY`); runs that agree in these share one.
    """
    from r2h_batch.sweep.results.reevaluation import Judge, check_poses, reevaluate
    from r2h_batch.trials.benchmark.build import BenchmarkOverrides

    if run.unfinished or not run.methods:
        raise ValueError(f"{(run.unfinished or ('no method',))[0]} is not complete")
    check_poses(run)
    key = json.dumps({k: run.header.get(k) for k in JUDGED_BY}, sort_keys=True)
    if key not in judges:
        judges[key] = Judge(run, given=BenchmarkOverrides.of(benchmark))
    judge = judges[key]
    found = [reevaluate(run, method, rows, judge) for method in run.methods]
    for method in found:
        if method.differences:
            raise ValueError(f"{method.method}: {method.differences[0]}")
    return [method.method for method in found if method.built_in]


def _largest(runs: "Sequence[Run]") -> "list[Run]":
    """Picks, of runs that were not all judged alike, those with the shipped rows among them, else the most;
    ValueError where two groups are as large."""
    from r2h_batch.report.compare.command import stored_rows
    from r2h_batch.report.statistics.common import common_trials

    groups: list[list[Run]] = []
    for run in runs:
        for group in groups:
            with contextlib.suppress(ValueError):
                common_trials([*group, run], proven=stored_rows())
                group.append(run)
                break
        else:
            groups.append([run])
    sizes = [(any(r.folder in stored_rows() for r in group), len(group)) for group in groups]
    if sizes.count(max(sizes)) > 1:
        common_trials(runs, proven=stored_rows())  # says what differs
    return groups[sizes.index(max(sizes))]


def leaderboard(
    submissions: tuple[Path, ...],
    /,
    *,
    out: Path = Path("leaderboard.html"),
    rows: int = 200,
    benchmark: BenchmarkFlags = BUILT_IN,
    overwrite: bool = False,
) -> int:
    """Judge a sample of each submission's rows again, and write a static page of all submissions.

    `(submitted)` marks methods that the command cannot ask again. The command names and leaves out
    submissions that fail. It also leaves out those whose configuration differs from the shipped rows,
    or from most submissions if no rows are shipped. Exit code 0: all are listed. Exit code 1: some
    are left out.

    Args:
        submissions: files of `submit`, run folders, folders of these, or the word baselines.
        out: the page to write.
        rows: rows of each method that are judged again.
        benchmark: the flags that their sweeps had.
        overwrite: replace a page of this name.
    """
    from r2h_batch.report.compare.command import BASELINES, baselines_for, stored_rows
    from r2h_batch.report.page import page
    from r2h_batch.report.statistics.common import common_trials
    from r2h_batch.runs.store import join, load_run

    check_output_file(out, overwrite=overwrite)
    if not submissions:
        raise UsageError("no submission is given; give files of r2h-batch submit")
    judges: dict[str, Judge] = {}
    held: dict[str, Run] = {}
    left_out = 0
    with tempfile.TemporaryDirectory() as place:
        each: list[Path] = []
        for path in submissions:  # a folder that is no run folder holds several
            several = path.is_dir() and not (path / "run.json").exists()
            inside = sorted(path.iterdir()) if several else []
            each += [p for p in inside if p.suffix == ".zip" or p.is_dir()] if several else [path]
        for number, path in enumerate(each):
            try:
                shipped = str(path) == BASELINES and not path.exists()
                folder = baselines_for() if shipped else _unpacked(path, Path(place) / str(number))
                stored = load_run(folder, verify=False)
                stored.verify(whole=not shipped)
                built_in = stored.methods
                if not shipped:
                    built_in = tuple(_judged_again(stored, rows, judges, benchmark))
                entries = []
                for e in stored.entries:  # a name says nothing of who answered
                    mark = "" if e.name in built_in else " (submitted)"
                    entries.append(replace(e, name=e.name + mark))
                stored = replace(stored, entries=tuple(entries))
                join([*held.values(), stored])  # refuses a second run and method of one name
                held[printable(path)] = stored
            except (ValueError, MemoryError) as error:
                left_out += 1
                LOG.info(f"leaderboard: {printable(path)} is left out: {error}")
        if not held:
            return refuse("leaderboard", "no submission passed; no file is written", 1)
        try:
            listed = _largest(list(held.values()))
        except ValueError as error:
            return refuse("leaderboard", f"{error}, or add the word {BASELINES}", 1)
        for name, run in held.items():
            if run in listed:
                LOG.info(f"leaderboard: {name}: {', '.join(run.methods)}")
            else:
                left_out += 1
                words = f"it was not judged as the {len(listed)} listed"
                LOG.info(f"leaderboard: {name} is left out: {words}")
        text = page(join(listed), common=common_trials(listed, proven=stored_rows()))
    write_text(out, text)
    print(out)
    return 1 if left_out else 0


def _unpacked(path: Path, place: Path) -> Path:
    """The run folder of a submission; a file is unpacked below `place`."""
    if path.is_dir():
        return path
    folder = place / path.stem
    with open_archive(path, MAX_BYTES) as archive:
        members = archive_members(archive, path, count=MAX_MEMBERS, size=MAX_BYTES)
        for member in members:
            parts = PurePosixPath(member.filename).parts
            if member.filename == BUNDLE:
                continue
            if parts[:1] != ("run",) or member.is_dir():
                what = f"member {printable(member.filename)[:80]!r}"
                raise FileError(f"{printable(path)}: {what}; r2h-batch submit writes run/...")
            target = folder.joinpath(*parts[1:])
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(member) as source, target.open("wb") as file:
                shutil.copyfileobj(source, file)
    return folder
