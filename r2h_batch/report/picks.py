"""Share of a seen run's trials in which some posture takes the object up where it lay."""

import pyarrow.compute as pc

from r2h_batch.report.statistics.aggregate import Rate, rate_of
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import SPLITS


def pick_rates(run: Run) -> dict[tuple[str, str], Rate]:
    """(split, method) -> the share of all rows with `pick`. An answer that is no pose picks nothing. Empty for runs whose methods
    were told the truth.

    Args:
        run: what `load_run` or `join` gives.
    """
    if any(r.header.get("sees") is None for r in run.runs):
        return {}
    rates = {}
    for method in run.methods:
        table = run.sees(method)
        split = table["trial_id"].to_numpy() % len(SPLITS)
        picked = pc.fill_null(table["pick"], False).to_numpy()
        for k, word in enumerate(SPLITS):
            own = picked[split == k]
            if len(own):
                rates[word, method] = rate_of(int(own.sum()), len(own))
    return rates
