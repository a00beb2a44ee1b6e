"""Why the trials of a run failed: the reasons of each method, how many trials have each, and one of them."""

from collections.abc import Sequence
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.base.table import Column, Record, Table, document, notes_list
from r2h_batch.report.text import MOST_LINES, short_names
from r2h_batch.runs.explain import REASON_COLUMNS, reason_of
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import Outcome

WON = Outcome.SUCCESS.name.lower()
MOST = MOST_LINES - 9
"""Lines of the table: title, head, notes and what stands between are nine more."""


def reasons(run: Run, method: str) -> list[Record]:
    """The reasons of a method in the words of `why`: success, then the failures, the most frequent first.

    Args:
        run: what `load_run` gives.
        method: its name in the run.

    Returns:
        A record for each: method, reason, n (trials), share (percent of all its trials) and trial (the lowest number that
        has it).
    """
    trials: dict[str, int] = {}
    n: dict[str, int] = {}
    for table in run.shards("trials", method, ["trial_id", *REASON_COLUMNS]):
        for row in _counted(table):
            words, first = reason_of(row), row["trial_id_min"]
            n[words] = n.get(words, 0) + row["trial_id_count"]
            trials[words] = min(trials.get(words, first), first)
    total = sum(n.values())
    order = sorted(n, key=lambda words: (words != WON, -n[words], trials[words]))
    return [
        {"method": method, "reason": w, "n": n[w], "share": 100 * n[w] / total, "trial": trials[w]}
        for w in order
    ]


def _counted(table: pa.Table) -> list[dict[str, Any]]:
    """Number and lowest trial of the rows that agree in all that a reason is made of."""
    width = pc.if_else(pc.is_valid(table["width_m"]), 0.0, None)  # only whether there is one
    table = table.set_column(table.column_names.index("width_m"), "width_m", width)
    groups = table.group_by(list(REASON_COLUMNS), use_threads=False)
    found: list[dict[str, Any]] = groups.aggregate(
        [("trial_id", "min"), ("trial_id", "count")]
    ).to_pylist()
    return found


def brief(run: Run, methods: Sequence[str]) -> str:
    """The most frequent reasons of these methods in `MOST_LINES` lines, and the command that explains a trial.

    Args:
        run: what `load_run` gives.
        methods: names of complete methods.
    """
    every = [record for method in methods for record in reasons(run, method)]
    often = sorted(range(len(every)), key=lambda k: -every[k]["n"])[:MOST]
    shown, short = [every[k] for k in sorted(often)], short_names(methods)
    columns = [
        Column("method", "Method", lambda r: short[r["method"]], left=True),
        *(Column("reason", "Why", left=True), Column("n", "N")),
        *(Column("share", "%", "{value:.1f}"), Column("trial", "Trial")),
    ]
    left = len(every) - len(shown)
    more = "" if len(methods) == 1 else "; all of a method: --method NAME"
    notes = ["N, %: of all trials of the method."]
    notes += [f"{left} rarer reasons are left out{more}."] if left else []
    table = Table(columns, shown, title="First failures by their reason, and one trial of each.")
    text = document([table, notes_list(notes)])
    failed = next((r for r in shown if r["reason"] != WON), None)
    if failed is None:
        return text
    return f"{text}\nOne of them: {run.why_command(failed['method'], failed['trial'])}\n"
