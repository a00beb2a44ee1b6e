"""The commands `submit` and `leaderboard`: a run as one checked file, and a page of such files that
have been judged again."""

import json
import tempfile
import zipfile
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

from r2h_batch.base.command_line import check_range, counted, refuse
from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import atomic_path, check_output_file, write_text
from r2h_batch.protocols.choice import DEFAULT, BenchmarkChoice

if TYPE_CHECKING:
    from r2h_batch.report.board import Standing


def submit(
    run: Path,
    /,
    *,
    out: Path | None = None,
    rows: int = 200,
    benchmark: BenchmarkChoice = DEFAULT,
    overwrite: bool = False,
) -> int:
    """Write a finished run as one file for a leaderboard, after judging a sample of its rows again.

    The file holds rows, scored poses, configuration, checksums and the run's card.

    Args:
        run: a run folder with poses, as `r2h-batch sweep --out` writes it.
        out: the file to write; RUN.zip by default.
        rows: rows of each method that the command judges again before it writes.
        benchmark: where its files are now, if they are not where the sweep found them.
        overwrite: replace a file of this name.
    """
    from r2h_batch.report.card import write_summary
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.submission_judge import BUNDLE, judged_again

    check_rows(rows)
    out = out or Path(f"{run}.zip")
    check_output_file(out, overwrite=overwrite)
    stored = load_run(run)
    try:
        judged = judged_again(stored, rows, benchmark)
    except ValueError as error:
        raise ValueError(f"{run}: {error}; the run cannot be submitted") from None
    files = ["run.json"]
    for entry in stored.entries:
        files.append(f"methods/{entry.slug}.json")
        for shard in entry.shards.values():
            files.append(str(shard.path.relative_to(entry.folder)))
    digests = {m: stored.digest(m) for m in stored.methods}
    about = {"format": 1, "rows": digests, "versions": stored.header["versions"]}
    about["built_in"] = [method for method, found in judged.items() if found.built_in]
    with (
        tempfile.TemporaryDirectory() as place,  # the run may be somebody's, and read-only
        atomic_path(out) as temporary,
        zipfile.ZipFile(temporary, "w") as archive,
    ):
        write_summary(stored, Path(place))
        for file in files:
            archive.write(stored.folder / file, f"run/{file}")
        for card in sorted(Path(place).iterdir()):
            archive.write(card, f"run/{card.name}")
        archive.writestr(BUNDLE, json.dumps(about, indent=1))
    held = counted(len(digests), "methods")
    print(f"{out}: {held}, {len(files) + 3} files, {out.stat().st_size:,} bytes")
    return 0


def leaderboard(
    submissions: tuple[Path, ...],
    /,
    *,
    out: Path = Path("leaderboard.html"),
    rows: int = 200,
    least: int = 200,
    baselines: Path | None = None,
    hidden: Path | None = None,
    seconds: int = 1800,
    benchmark: BenchmarkChoice = DEFAULT,
    overwrite: bool = False,
) -> int:
    """Judge a sample of each submission's rows again, and write a static page that ranks their methods.

    Each method is compared with the baselines on its own trials; of a draft none are stored, and its section says
    so. `(submitted)` marks methods that did
    not answer again with the same bits on this machine. A process of its own judges each submission.
    The command names and leaves out submissions that fail. Exit code 0: all are listed. Exit code 1:
    some are left out.

    Args:
        submissions: files of `submit`, run folders, or folders of these.
        out: the page to write.
        rows: rows of each method that are judged again.
        least: trials of each split that a method needs for a place.
        baselines: a run folder with the baselines; by default the shipped rows of a submission's
            protocol and preset.
        hidden: the commitment of `benchmark hide`; --benchmark is then the file that was told. The command checks that it
            is what the commitment promised, and leaves out runs on other trials.
        seconds: CPU time that judging one submission may take.
        benchmark: where its files are now, if they are not where the sweep found them.
        overwrite: replace a page of this name.
    """
    from r2h_batch.base.errors import FileError
    from r2h_batch.report.board import Section, page, section_of
    from r2h_batch.report.compare.stored import load_baselines
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.submission_judge import Hidden, judge_alone

    check_output_file(out, overwrite=overwrite)
    check_rows(rows)
    check_range("--least", least, 0, 10**9)
    check_range("--seconds", seconds, 1, 10**6)
    if not submissions:
        raise UsageError("no submission is given; give files of r2h-batch submit")
    if baselines is not None:
        load_run(baselines)
    promise = None
    if hidden is not None:
        from r2h_batch.protocols.edit import edited
        from r2h_batch.protocols.hidden import check_told

        told = edited(benchmark)
        promise = Hidden(check_told(hidden, told), told.digest, told.seed)
    each = _each(submissions)
    # what is judged alike: the baselines' folder, or the setting of a draft that has none
    found: defaultdict[Path | tuple[tuple[str, str], ...], list[Standing]] = defaultdict(list)
    left_out = 0
    for path, name in each.items():
        try:
            verdict = judge_alone(
                path,
                name,
                rows=rows,
                seconds=seconds,
                benchmark=benchmark,
                baselines="" if baselines is None else str(baselines),
                hidden=promise,
            )
        except FileError as error:
            left_out += 1
            LOG.info(f"leaderboard: {printable(path)} is left out: {error}")
            continue
        alike = verdict.baselines or tuple(verdict.setting.items())
        known = {s.digest: s for s in found[alike]}
        for standing in verdict.standings:
            if (same := known.get(standing.digest)) is not None:
                left_out += 1
                words = f"its rows are those of {printable(same.method)} of {same.submission}"
                LOG.info(f"leaderboard: {name}: {printable(standing.method)} is left out: {words}")
                continue
            found[alike].append(standing)
            LOG.info(f"leaderboard: {name}: {printable(standing.method)}")
        more = {} if promise is None else promise.setting
        sections = [
            section_of(load_baselines(key), own, more)
            if isinstance(key, Path)
            else Section(dict(key) | more, (), tuple(own))
            for key, own in found.items()
            if own
        ]
        if sections:  # after each submission: judging takes minutes, and what is known is shown
            write_text(out, page(sections, least=least))
    if not any(found.values()):
        return refuse("leaderboard", "no submission passed; no file is written", 1)
    print(out)
    return 1 if left_out else 0


def check_rows(rows: int) -> None:
    """Raise `UsageError` unless at least one row is to be judged again."""
    check_range("--rows", rows, 1, 10**9)


def _each(submissions: tuple[Path, ...]) -> dict[Path, str]:
    """Submission -> what the page calls it: the file's name, or the path where several have it."""
    paths: list[Path] = []
    for path in submissions:  # a folder that is no run folder holds several
        several = path.is_dir() and not (path / "run.json").exists()
        inside = sorted(path.iterdir()) if several else []
        paths += [p for p in inside if p.suffix == ".zip" or p.is_dir()] if several else [path]
    stems = [p.absolute().stem for p in paths]
    return {
        p: printable(s if stems.count(s) == 1 else p) for p, s in zip(paths, stems, strict=True)
    }
