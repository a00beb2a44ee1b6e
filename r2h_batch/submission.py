"""The commands `submit` and `leaderboard`: a run as one checked file, and a page of such files that
have been judged again."""

import contextlib
import json
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from r2h_batch.benchmark.flags import BUILT_IN, BenchmarkFlags
from r2h_batch.command_line import LOG, UsageError, counted, refuse
from r2h_batch.io.read import FileError, archive_members, open_archive, printable
from r2h_batch.io.write import atomic_path, check_output_file, write_text

if TYPE_CHECKING:
    from r2h_batch.results.reevaluation import Judge
    from r2h_batch.runs.store import Run

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
    files = _files(stored)
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


def _files(run: "Run") -> list[str]:
    """What a run is read from, relative to its folder."""
    files = ["run.json", "README.md", "table.md", "results.json"]
    for entry in run.entries:
        files.append(f"methods/{entry.slug}.json")
        for number, receipt in sorted(entry.receipts.items()):
            files.append(f"manifest/{entry.slug}/{number:06d}.json")
            files += [file["path"] for file in receipt["files"].values()]
    return files


def _judged_again(
    run: "Run", rows: int, judges: "dict[str, Judge]", benchmark: BenchmarkFlags
) -> list[str]:
    """The run's built-in methods, which answered again; ValueError where a row is not what the
    evaluator says.

    `judges`: evaluators by what they depend on (`JUDGED_BY`); runs that agree in these share one.
    """
    from r2h_batch.benchmark.build import BenchmarkOverrides
    from r2h_batch.results.reevaluation import Judge, check_poses, reevaluate

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


def _marked(run: "Run", built_in: Sequence[str]) -> "Run":
    """The run with `(submitted)` behind the names of all methods but the built-in ones: a name says
    nothing of who answered."""
    entries = (
        e if e.name in built_in else replace(e, name=f"{e.name} (submitted)") for e in run.entries
    )
    return replace(run, entries=tuple(entries))


def _largest(runs: "Sequence[Run]") -> "list[Run]":
    """Of runs that were not all judged alike those with the shipped rows among them, else the most;
    ValueError where two groups are as large."""
    from r2h_batch.compare.command import stored_rows
    from r2h_batch.statistics.common import common_trials

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
    from r2h_batch.compare.command import BASELINES, baselines_for, stored_rows
    from r2h_batch.report.page import page
    from r2h_batch.runs.store import join, load_run
    from r2h_batch.statistics.common import common_trials

    check_output_file(out, overwrite=overwrite)
    if not submissions:
        raise UsageError("no submission is given; give files of r2h-batch submit")
    judges: dict[str, Judge] = {}
    held: dict[str, Run] = {}
    left_out = 0
    with tempfile.TemporaryDirectory() as place:
        for number, given in enumerate(_each(submissions)):
            try:
                shipped = str(given) == BASELINES and not given.exists()
                folder = baselines_for() if shipped else _unpacked(given, Path(place) / str(number))
                stored = load_run(folder)
                built_in = (
                    stored.methods if shipped else _judged_again(stored, rows, judges, benchmark)
                )
                stored = _marked(stored, built_in)
                join([*held.values(), stored])  # refuses a second run and method of one name
                held[printable(given)] = stored
            except (ValueError, MemoryError) as error:
                left_out += 1
                LOG.info(f"leaderboard: {printable(given)} is left out: {error}")
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
                LOG.info(
                    f"leaderboard: {name} is left out: it was not judged as the {len(listed)} listed"
                )
        text = page(join(listed), common=common_trials(listed, proven=stored_rows()))
    write_text(out, text)
    print(out)
    return 1 if left_out else 0


def _each(given: Sequence[Path]) -> list[Path]:
    """The submissions: what a folder holds that is no run folder itself."""
    found: list[Path] = []
    for path in given:
        inside = path.is_dir() and not (path / "run.json").exists()
        held = (
            [p for p in sorted(path.iterdir()) if p.suffix == ".zip" or p.is_dir()]
            if inside
            else []
        )
        found += held if inside else [path]
    return found


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
                name = printable(member.filename)[:80]
                raise FileError(
                    f"{printable(path)}: member {name!r}; r2h-batch submit writes run/..."
                )
            target = folder.joinpath(*parts[1:])
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(member) as source, target.open("wb") as file:
                while piece := source.read(1 << 20):
                    file.write(piece)
    return folder
