"""Rows behind a page: swept, kept in bench/options, and counted: rows of options are no baselines."""

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
    shutil.rmtree(rows, ignore_errors=True)
    rows.mkdir(parents=True)
    for part in KEPT:
        (shutil.copytree if (run / part).is_dir() else shutil.copy)(run / part, rows / part)
    return rows


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
