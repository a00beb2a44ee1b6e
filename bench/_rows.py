"""Rows behind a page: swept, kept in bench/options, and counted: rows of options are no baselines; rates with their intervals
over categories of objects."""

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from _report import ROOT, swept

if TYPE_CHECKING:
    import numpy as np
    import torch

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


def thinned(run: Path, rows: Path, command: Sequence[str], kinds: Sequence[str] = ("poses",)) -> None:
    """Writes the rows of a run again, a shard a method, with these kinds beside the trials.

    Args:
        run: a run folder, whole.
        rows: the new one.
        command: the sweep that makes such rows.
        kinds: of `stored` in run.json.
    """
    from r2h_batch.runs.store import load_run
    from r2h_batch.runs.writing import SHARD_TRIALS, open_run

    shutil.rmtree(rows, ignore_errors=True)
    whole = load_run(run)
    header = {**whole.header, "stored": list(kinds), "shard_trials": SHARD_TRIALS, "command": list(command)}
    folder = open_run(rows, header)
    for entry in whole.entries:
        folder.register(entry.name, entry.source)
        for shard in folder.todo(entry.name):
            tables = {kind: getattr(whole, kind)(entry.name) for kind in ("trials", *kinds)}
            with folder.write(entry.name, shard) as writer:
                writer.append(**tables)


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


def rows_of(run: Any, name: str) -> dict[int, dict[str, Any]]:
    """Trial id -> its columns of all files."""
    rows: dict[int, dict[str, Any]] = {}
    for table in (run.trials(name), run.details(name), run.poses(name), run.paths(name)):
        for row in table.to_pylist():
            rows.setdefault(row["trial_id"], {}).update(row)
    return rows


def poses_of(rows: list[dict[str, Any]]) -> "tuple[torch.Tensor, torch.Tensor]":
    """T_obj_ee and T_world_ee of rows, (N, 4, 4)."""
    import torch

    grasp, pose = (
        torch.tensor([r[k] for r in rows], dtype=torch.float32).reshape(-1, 4, 4) for k in ("T_obj_ee", "T_world_ee")
    )
    return grasp, pose


def over_categories(hit: "np.ndarray", splits: "np.ndarray", kinds: "np.ndarray", only: str) -> list[float]:
    """Percent of the trials of some splits, mean of the splits, and the ends of its 95 % interval for all categories."""
    import numpy as np

    from r2h_batch.report.statistics.aggregate import clustered_rate, mean_rate

    found = []
    for split in only.split("+"):
        names, place = np.unique(kinds[splits == split], return_inverse=True)
        rate = clustered_rate(np.bincount(place, hit[splits == split], len(names)), np.bincount(place))
        assert rate is not None, f"{split} has one category"
        found.append(rate)
    rate = mean_rate(found)
    return [rate.percent, rate.low, rate.high]


def paired_over_categories(
    a: "np.ndarray", b: "np.ndarray", splits: "np.ndarray", kinds: "np.ndarray", only: str
) -> dict[str, float]:
    """Difference of two methods on the same trials, points, its 95 % interval for all categories (`r2h-batch compare`: 95 % all),
    and how many trials only one of them has."""
    import numpy as np

    from r2h_batch.report.statistics.intervals import over_clusters, paired_score_interval

    rows = np.isin(splits, only.split("+"))
    more, strata = a.astype(float) - b, []
    for split in only.split("+"):
        own = splits == split
        _, place = np.unique(kinds[own], return_inverse=True)
        strata.append((np.bincount(place, more[own]), np.bincount(place)))
    spread = float(np.var(more[rows]))
    over = over_clusters(strata, spread)
    assert over is not None
    first, second, n = int((a & ~b)[rows].sum()), int((b & ~a)[rows].sum()), int(rows.sum())
    least, (low, high) = paired_score_interval(first, second, n), over.ends()
    ends = 100 * min(low, least[0]), 100 * max(high, least[1])
    return {"points": 100 * over.value, "low": ends[0], "high": ends[1], "only first": first, "only second": second}


def oracle_percent(run: Path, robot: Path, trials: int) -> float:
    """The oracle's SR on r2h-v1 with a robot, percent; 0 where the sweep refuses the robot."""
    from r2h_batch.report.table import record, table_of
    from r2h_batch.runs.store import load_run

    flags = ("--benchmark", "r2h-v1", "--method", "oracle", "--trials", trials, "--execute.sim", "none", "--quiet")
    try:
        swept(run, "--robot", robot, *flags)
    except SystemExit:  # what it refuses it has said
        return 0.0
    (row,) = (record(row) for row in table_of(load_run(run)).rows if row.split == "Avg")
    return float(row["sr"])
