"""The command `report`: table, page, gallery. Light until there is work."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import check_output_file, check_output_folder, write_text
from r2h_batch.report.statistics.few import FEW, check_few

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run

MOST = 20
"""Pictures of one method and outcome in a gallery."""


def report(
    runs: tuple[Path, ...],
    /,
    *,
    format: Literal["md", "latex", "csv", "json", "html"] = "md",
    by_object: bool = False,
    by_people: bool = False,
    full: bool = False,
    columns: Literal[1, 2] = 2,
    intervals: bool = False,
    times: bool = False,
    method: tuple[str, ...] = (),
    scans: Path | None = None,
    categories: int = FEW,
    gallery: int = 0,
    out: Path | None = None,
    overwrite: bool = False,
    code: tuple[str, ...] = (),
) -> int:
    """Print the table of run folders, or write their page.

    Args:
        runs: run folders, as `r2h-batch sweep --out` writes them: one table for all. The word
            baselines stands for the built-in methods' rows, which ship with the package.
        format: md, latex, csv or json; html: one page with figures and a search over trials, no
            network needed.
        by_object: print the rates of each object instead of Table I. The html page has both.
        full: md: every table, interval, note and object, and which criteria fail together, where 25 lines do not have them. The
            other formats have all of it.
        by_people: print success by age, stature, hand, sex and seat, and whom no method serves, of a sweep
            with --people.
        columns: latex: width of the table in columns of the page: 2 for all of Table I, 1 for the SR
            of each split.
        intervals: latex: 95 % intervals below all rates; below SR they always stand.
        times: latex: also T_plan of a batch and T_tot, which depend on how many trials are planned at once.
        method: only these methods, by the sweep's word (fc) or the table's name; all by default.
        scans: a run of the same methods on your own meshes (sweep --objects FOLDER): their SR as a
            column of the table.
        categories: so many new categories of objects: where their mean SR lies, beside the interval for
            the mean of all categories (without families: objects).
        gallery: html: draw this many successes and failures of each kind and method. Each picture leads
            to a page of its trial in three dimensions, in a folder beside --out.
        out: the file to write instead of printing.
        overwrite: replace what is there under these names.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.
    """
    if not 0 <= gallery <= MOST:
        raise UsageError(f"--gallery is {gallery}; it must be 0 to {MOST}")
    check_few(categories)
    if gallery and (format != "html" or out is None):
        words = "--format html and --out FILE.html, for the pages of its trials"
        raise UsageError(f"--gallery needs {words}")
    if by_people and (by_object or scans is not None or len(runs) > 1):
        raise UsageError("--by-people prints one run; leave --by-object and --scans out")
    if by_people and format not in ("md", "csv", "json"):
        raise UsageError(f"--by-people prints md, csv or json; --format is {format}")
    if scans is not None and (format == "html" or by_object):
        raise UsageError(
            "--scans adds a column to Table I; leave --format html and --by-object out"
        )
    if out is not None:
        check_output_file(out, overwrite=overwrite)
    if gallery and out is not None:
        check_output_folder(_pages(out), overwrite=overwrite, flag="--out with its pages in")
    from r2h_batch.commands.compare import load_runs
    from r2h_batch.report.compare.stored import stored_rows
    from r2h_batch.runs.store import join, load_run

    once: dict[str, Path] = {}
    for given in runs:
        place = os.path.realpath(given)
        if place in once:
            LOG.info(f"report: {printable(given)} is given twice, and counted once")
        once.setdefault(place, given)
    loaded = load_runs(tuple(once.values()), method)
    stored = join(loaded)
    if not stored.methods:
        raise ValueError(f"{runs[0]}: {stored.not_complete()}")
    if format == "html":
        from r2h_batch.report.page import page
        from r2h_batch.report.statistics.common import common_trials

        pictures: dict[str, list[dict[str, str]]] | None = None
        common = None
        if gallery and out:
            from r2h_batch.scene.offscreen import ready
            from r2h_batch.view.gallery.pictures import gallery as draw
            from r2h_batch.view.stored import Reader

            ready()
            if _pages(out).is_symlink():
                what = f"{out.stem}_trials beside {out.name} is a link"
                raise UsageError(f"{what}; its pages would be written elsewhere")
            # a run may be of several folders, and a joined one may name a method otherwise: all are opened before one is drawn
            folders = [own for run in loaded for own in run.runs]
            readers = [Reader(own.folder, code) for own in folders]
            pictures = {name: [] for name in stored.methods}
            for number, (own, reader) in enumerate(zip(folders, readers, strict=True), 1):
                pages = _pages(out) / str(number) if len(folders) > 1 else _pages(out)
                named = {
                    next(e.name for e in own.entries if e.slug == stored.entry(name).slug): name
                    for name in stored.methods
                    if stored.entry(name).folder == own.folder
                }
                if not named:  # --method names none of its methods
                    continue
                found = draw(own.only(list(named)), reader, gallery, pages, out.parent)
                pictures |= {named[name]: drawn for name, drawn in found.items()}
        try:
            common = common_trials(loaded, proven=stored_rows())
        except ValueError as error:
            LOG.info(f"report: not compared with each other: {error}")
        text = page(stored, pictures, common=common, few=categories)
    elif by_people:
        from r2h_batch.report.people import people_lines

        text = people_lines(stored, format, full=full)
    elif by_object:
        from r2h_batch.report.table import object_lines, objects_brief

        short = format == "md" and not full
        text = objects_brief(stored) if short else object_lines(stored, format)
    else:
        from r2h_batch.report.next_commands import judged_alike, next_commands
        from r2h_batch.report.table import brief, render, table_of
        from r2h_batch.report.text import MOST_LINES

        of_scans = None if scans is None else load_run(scans)
        table = table_of(
            stored, alike=len(loaded) == 1 or judged_alike(loaded), scans=of_scans, few=categories
        )
        if format == "md" and not full:
            text = brief(table)
        else:
            text = render(table, format, columns=columns, intervals=intervals, times=times)
        if format == "md" and (
            played := _played(loaded, brief=not full)
        ):  # else the hand at rest looks like the result
            text = (
                f"{played}\nThe plans of the same trials, judged with the hand at rest:\n\n{text}"
            )
        if format == "md" and out is None:
            more = "\n" + next_commands(loaded)
            if full or (text + more).count("\n") <= MOST_LINES:
                text += more
    if out is None:
        sys.stdout.write(text)
    else:
        write_text(out, text)
        print(out)
    for name in stored.unfinished:
        missing = sum(s.last - s.first for s in stored.missing(name))
        why = stored.entry(name).hindrance
        LOG.info(
            f"report: {name} is not in the table, {missing} of its trials are not scored yet"
            + (why and f"; {why}")
        )
    return 1 if stored.unfinished else 0


def _played(runs: "Sequence[Run]", *, brief: bool) -> str:
    """The tables of the runs that were played in closed loop, or how their episodes ended; empty where none was."""
    played = [own for run in runs for own in run.runs if "episodes" in own.header["stored"]]
    if not played:
        return ""
    from r2h_batch.report.closed_loop import render

    return "\n".join(render(own, brief=brief) for own in played if own.methods)


def _pages(out: Path) -> Path:
    """The folder of a gallery's pages."""
    return out.parent / f"{out.stem}_trials"
