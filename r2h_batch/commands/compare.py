"""The command `compare`: methods of run folders, paired on the trials that they share. Light until
there is work."""

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from r2h_batch.base.command_line import check_seed
from r2h_batch.base.errors import nearest
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.report.compare.stored import (
    BASELINES,
    baselines_for,
    is_stored,
    load_rows,
    stored_rows,
)
from r2h_batch.report.statistics.few import FEW, check_few

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run


def compare(
    runs: tuple[Path, ...],
    /,
    *,
    seed: int = 0,
    format: Literal["md", "latex", "csv", "json"] = "md",
    method: tuple[str, ...] = (),
    all_pairs: bool = False,
    full: bool = False,
    across_robots: bool = False,
    categories: int = FEW,
) -> int:
    """Compare the methods of run folders on the trials that they share.

    The command compares all pairs of methods. With `baselines` it compares only pairs that have one of
    your methods.

    Args:
        runs: run folders, as `r2h-batch sweep --out` writes them; one with several methods is
            enough. The word baselines stands for the built-in methods' stored rows of the run's
            benchmark. Those of the default benchmark and of r2h-v3 ship with the package.
        seed: seed of the bootstrap that gives the ranks.
        format: md, latex, csv or json.
        method: only these methods, by the sweep's word (fc) or the table's name; by default all.
        all_pairs: also compare the baselines with each other.
        full: md: each split's pairs, ranks and shares, and all notes, where 25 lines do not have them. The other formats have
            all of it.
        across_robots: also pair runs of several robots, by the number of the trial.
        categories: so many new categories of objects: where their mean difference lies, beside the
            interval for the mean of all categories (without families: objects).
    """
    from r2h_batch.base.table import plain
    from r2h_batch.report.compare.text import brief, render
    from r2h_batch.report.statistics import paired as statistics
    from r2h_batch.report.statistics.aggregate import rate_of
    from r2h_batch.report.statistics.common import common_trials
    from r2h_batch.report.statistics.shares import hits_on
    from r2h_batch.report.trained import sentences
    from r2h_batch.report.turn import turned

    check_seed(seed)
    check_few(categories)
    stored = load_runs(runs, method)
    common = common_trials(stored, proven=stored_rows(), across_robots=across_robots)
    some_stored = [is_stored(run) for run in stored]
    one = sum(some_stored) == 1  # two of them would have one name
    folders = [
        BASELINES if here and one else run.folder.absolute().name
        for run, here in zip(stored, some_stored, strict=True)
    ]
    paired = statistics.pair_up(stored, common, folders)
    shipped = [is_stored(stored[k]) for k in paired.runs]
    not_shipped = [n for n, s in zip(paired.names, shipped, strict=True) if not s]
    some = any(shipped) and not all_pairs
    mine = not_shipped if some else ()
    comparisons = statistics.compare(paired, mine=mine, seed=seed, few=categories)
    header = stored[0].header
    origin = {
        "runs": ", ".join(folders),
        "protocol": str(header["protocol"]),
        "trials": ", ".join(f"{n} {split}" for split, n in common.trials.items()),
        "r2h_batch": str(header["versions"]["r2h_batch"]),
    }
    for note in paired.notes if format in ("csv", "json") else ():
        LOG.info(f"compare: {note}")
    tests = [turned(run) for run in stored]
    called = list(zip(paired.names, paired.runs, paired.methods, strict=True))
    turns = [replace(t, method=n) for n, k, own in called for t in tests[k] if t.method == own]
    marked = (test.sentence for test in turns if test.marked)
    learned = [plain(line) if format == "md" else line for r in stored for line in sentences(r)]
    notes = (*common.notes, *paired.notes, *marked, *learned)
    shares = {
        n: {
            key: rate_of(*hits)
            for key, hits in hits_on(stored[k], own, common.trials).items()
            if hits[1]
        }
        for n, k, own in called
    }
    reads = {n: stored[k].entry(own).reads for n, k, own in called}
    if format == "md" and not full:
        sys.stdout.write(brief(comparisons, notes, turns, reads))
        return 0
    text = render(
        comparisons, format, origin=origin, notes=notes, turns=turns, shares=shares, reads=reads
    )
    sys.stdout.write(text)
    return 0


def load_runs(words: Sequence[Path], method: Sequence[str] = ()) -> "list[Run]":
    """The runs of a command line, with these methods alone; `baselines` are the shipped ones.

    Raises:
        RunError, ValueError: a folder is not a run folder, or no run has a method of that name.
    """
    from r2h_batch.runs.store import load_run

    if not words:
        raise ValueError("no run folder is given; one with several methods is enough")
    for word in map(str, words):
        if not Path(word).exists() and word != BASELINES and (hint := nearest(word, [BASELINES])):
            raise ValueError(f"{printable(word)}: no such folder{hint}")
    # a folder of the word's name comes before the shipped baselines
    own = {r: load_run(r) for r in words if str(r) != BASELINES or r.exists()}
    like = next(iter(own.values())).header if own else None
    stored = [own[r] if r in own else load_rows(baselines_for(like)) for r in words]
    return _chosen(stored, method) if method else stored


def _chosen(runs: "list[Run]", words: Sequence[str]) -> "list[Run]":
    """The runs with the chosen methods; every word must be a method of at least one run."""
    from r2h_batch.runs.files import RunError

    kept: list[Run] = []
    known: set[str] = set()
    for stored in runs:
        names = []
        for word in words:
            with contextlib.suppress(RunError):
                names.append(stored.named(word))
                known.add(word)
        kept += [stored.only(names)] if names else []
    for word in words:
        if word not in known:
            if len(runs) == 1:
                runs[0].named(word)
            names = [name for run in runs for name in run.methods]
            near = nearest(word, [w for run in runs for w in run.words]) or nearest(word, names)
            have = ", ".join(dict.fromkeys(names)) or "none"
            raise RunError(f"no run has a method {word!r}{near}; they have {have}")
    return kept
