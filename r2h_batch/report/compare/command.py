"""The command `compare`: methods of run folders, paired on the trials that they share. Light until
there is work."""

import contextlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from r2h_batch.base.command_line import check_seed, nearest
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run

BASELINES = "baselines"
"""The word for the shipped rows of all built-in methods: `compare runs/mine baselines`."""

FOLDERS = tuple(Path(__file__).parent / name for name in (BASELINES, "baselines_as_planned"))
"""The shipped run folders, 500 trials of r2h-v1 of each split: moved by MuJoCo C (with poses), and
with `--sim none`. `make tables` scores them again."""

ROWS = Path(__file__).resolve().parents[3] / "bench" / "rows"
"""Only in a checkout: rows of the other protocols and presets, PROTOCOL[-PRESET-preset]."""


def baselines_for(header: Mapping[str, Any] | None = None) -> Path:
    """The stored run that the run of this run.json can be compared with: in a checkout that of its
    protocol and preset; else the shipped one that the same engine moved, without a header the
    simulated one."""
    configuration = (header or {}).get("configuration", {})
    preset, protocol = configuration.get("name", "default"), str((header or {}).get("protocol", ""))
    name = protocol.removeprefix("r2h-") + (f"-{preset}-preset" if preset != "default" else "")
    stored = {f.name: f for f in ROWS.iterdir()} if ROWS.is_dir() else {}
    execute = configuration.get("execute") or {}
    return stored.get(name, FOLDERS[execute.get("sim") == "none"])


def stored_rows() -> tuple[Path, ...]:
    """All folders of rows that the project's tests judge again."""
    return (*FOLDERS, *(sorted(ROWS.iterdir()) if ROWS.is_dir() else ()))


def compare(
    runs: tuple[Path, ...],
    /,
    *,
    seed: int = 0,
    format: Literal["md", "latex", "csv", "json"] = "md",
    method: tuple[str, ...] = (),
    all_pairs: bool = False,
    across_robots: bool = False,
) -> int:
    """Compare the methods of run folders on the trials that they share.

    The command compares all pairs of methods. With `baselines` it compares only pairs that have one of
    your methods.

    Args:
        runs: run folders, as `r2h-batch sweep --out` writes them; one with several methods is
            enough. The word baselines stands for the built-in methods' rows of r2h-v1, which ship
            with the package. In a checkout it stands for rows of the run's protocol and preset.
        seed: seed of the bootstrap that gives the ranks.
        format: md, latex, csv or json.
        method: only these methods, by the sweep's word (fc) or the table's name; by default all.
        all_pairs: also compare the baselines with each other.
        across_robots: also pair runs of several robots, by the number of the trial.
    """
    from r2h_batch.report.compare.text import render
    from r2h_batch.report.held import NOTE, stable_rates
    from r2h_batch.report.statistics import paired as statistics
    from r2h_batch.report.statistics.common import common_trials
    from r2h_batch.report.turn import turned

    check_seed(seed)
    stored = load_runs(runs, method)
    common = common_trials(stored, proven=stored_rows(), across_robots=across_robots)
    paired = statistics.pair_up(stored, common)
    shipped = [stored[k].folder in FOLDERS for k in paired.runs]
    not_shipped = [n for n, s in zip(paired.names, shipped, strict=True) if not s]
    some = any(shipped) and not all_pairs
    comparisons = statistics.compare(paired, mine=not_shipped if some else (), seed=seed)
    header = stored[0].header
    folders = (BASELINES if r.folder in stored_rows() else r.folder.name for r in stored)
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
    rates = [stable_rates(run) for run in stored]
    held = [
        f"{n} {stable.rate.percent:.1f} ({split}, {stable.rate.total}; undecided {stable.undecided.percent:.1f})"
        for n, k, own in called
        for (split, name), stable in rates[k].items()
        if name == own
    ]
    known = [f"{NOTE}: {'; '.join(held)}"]
    marked = (test.sentence for test in turns if test.marked)
    notes = (*common.notes, *paired.notes, *marked, *(known if held else ()))
    sys.stdout.write(render(comparisons, format, origin=origin, notes=notes, turns=turns))
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
    stored = [own[r] if r in own else load_run(baselines_for(like)) for r in words]
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
            runs[0].named(word)
    return kept
