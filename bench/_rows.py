"""Rows behind a page: swept, kept in bench/options, and counted: rows of options are no baselines; rates with their intervals
over categories of objects."""

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from _report import ROOT, swept

KEPT = ("run.json", "methods", "shards")
"""Files of a run folder that are read again."""


def kept_rows(name: str, words: Sequence[str], *flags: object) -> Path:
    """Sweeps these methods and keeps their rows in bench/options/NAME; the folder.

    All paths are relative to the checkout, so that no row says where it was made.
    """
    os.chdir(ROOT)
    run, rows = swept(Path("runs") / name, "--method", *words, *flags), Path("bench/options") / name
    keep(run, rows)
    return rows


def keep(run: Path, rows: Path) -> None:
    """Copies the files of a run that are read again; poses, paths and details stay behind."""
    shutil.rmtree(rows, ignore_errors=True)
    rows.mkdir(parents=True)
    for part in KEPT:
        (shutil.copytree if (run / part).is_dir() else shutil.copy)(run / part, rows / part)


def rate_of(row: Mapping[str, Any]) -> str:
    """A table row's SR with the 95 % interval for the mean of all categories of objects, as README's Table I has it."""
    low, high = row["sr_new_categories_low"], row["sr_new_categories_high"]
    return f"{row['sr']:.1f} [{low:.0f}, {high:.0f}]"


def rate_over_categories(won: str, trials: Mapping[str, Any]) -> str:
    """The same of flags "0" and "1", one for each trial: mean of the splits.

    Args:
        won: a flag a trial.
        trials: `split` and `category` of the trials.
    """
    import numpy as np

    from r2h_batch.report.statistics.aggregate import clustered_rate, mean_rate

    flags = np.array([flag == "1" for flag in won])
    split, category = np.array(trials["split"]), np.array(trials["category"])
    found = []
    for s in sorted({*trials["split"]}):
        kinds, place = np.unique(category[split == s], return_inverse=True)
        own = clustered_rate(
            np.bincount(place, flags[split == s], len(kinds)), np.bincount(place, minlength=len(kinds))
        )
        assert own is not None, f"{s} has one category"
        found.append(own)
    rate = mean_rate(found)
    return f"{rate.percent:.1f} [{rate.low:.0f}, {rate.high:.0f}]"


def rates_of(folder: Path, words: Sequence[str]) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Word of the sweep -> split -> the row of its table."""
    from r2h_batch.report.table import render, table_of
    from r2h_batch.runs.store import load_run

    run = load_run(folder)
    by_name = {e.name: word for e, word in zip(run.entries, words, strict=True)}
    found: dict[str, dict[str, Mapping[str, Any]]] = {word: {} for word in words}
    for row in json.loads(render(table_of(run), "json"))["rows"]:
        found[by_name[row["method"]]][row["split"]] = row
    return found
