"""From success to received to taken, where `results transfer` has stored transfers."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.report.held import rows_of
from r2h_batch.report.statistics.aggregate import Rate, clustered_rate, rate_of
from r2h_batch.runs.side import side_path
from r2h_batch.runs.store import Run

FOLDER = "transfer"
"""Folder of a run that holds METHOD.parquet."""
MADE_OF = b"r2h_batch transfer"
"""Key of the Parquet file's metadata: the rows and the code that its transfers were made of, and the cases."""
SCENARIO, TAKEN = "take", "taken"
HEADINGS = ("n", "SR", "received", "taken", "95 %", "taken and success")
NOTE = (
    "From success to taken (results transfer, scenario take; not in SR). Percent of the n transfers: a trial with a pose and a"
    " simulated person each. No success rate of real people."
)


@dataclass(frozen=True)
class Funnel:
    """How far a method's handovers get with a release policy.

    Attributes:
        method: its name in the run.
        release: the policy.
        success: the verdict of the sweep.
        received: a person could take the object (`results reception`).
        taken: the simulated person has it, well held.
        both: taken, and a success.
    """

    method: str
    release: str
    success: Rate
    received: Rate
    taken: Rate
    both: Rate

    @property
    def cells(self) -> list[str]:
        """Texts under `HEADINGS`."""
        low, high = f"{self.taken.low:.1f}", f"{self.taken.high:.1f}"
        percent = [f"{r.percent:.1f}" for r in (self.success, self.received, self.taken, self.both)]
        return [str(self.taken.total), *percent[:3], f"{low}-{high}", percent[3]]


def funnels(run: Run) -> tuple[Funnel, ...]:
    """The funnels of all methods and policies with stored transfers.

    A file that was made of other rows than the run's is left out.

    Args:
        run: what `load_run` or `join` gives.
    """
    found = []
    for entry in run.entries:
        rows = takes_of(run, entry.name)
        for release in dict.fromkeys(rows["release"].tolist()) if rows else ():
            of = rows["release"] == release
            success, got = (rows[k][of].astype(bool) for k in ("success", "received"))
            taken = rows["outcome"][of] == TAKEN
            shares = (success, got, taken, taken & success)
            rates = (_over_trials(hits, rows["trial_id"][of]) for hits in shares)
            found.append(Funnel(entry.name, release, *rates))
    return tuple(found)


def takes_of(run: Run, method: str) -> dict[str, NDArray[Any]]:
    """Column -> values of a method's stored transfers in which the person takes the object; empty without a file, and of a file
    that was made of other rows than the run's.

    Args:
        run: what `load_run` or `join` gives.
        method: its name in the run.
    """
    entry = run.entry(method)
    made_of = rows_of(side_path(entry, FOLDER), MADE_OF)
    if made_of is None or made_of != run.digest(entry.name):
        return {}
    table = run.side(entry.name, FOLDER)
    assert table is not None
    rows = {k: table[k].to_numpy(zero_copy_only=False) for k in table.column_names}
    takes = rows["scenario"] == SCENARIO
    return {k: values[takes] for k, values in rows.items()}


def about(found: Sequence[Funnel]) -> list[dict[str, Any]]:
    """The funnels as JSON has them."""
    return [asdict(funnel) for funnel in found]


def _over_trials(hits: NDArray[np.bool_], trial_id: NDArray[np.int64]) -> Rate:
    """The rate; where trials have several persons, they are the clusters of the interval."""
    trials, of = np.unique(trial_id, return_inverse=True)
    if len(trials) < len(hits):
        won = np.bincount(of, weights=hits).astype(np.int64)
        if (rate := clustered_rate(won, np.bincount(of))) is not None:
            return rate
    return rate_of(int(hits.sum()), len(hits))
