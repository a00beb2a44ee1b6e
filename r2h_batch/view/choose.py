"""Which trials of a run one looks at: filters over stored rows, and lists of what can be filtered
by."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from r2h_batch.verdicts import CRITERIA

__all__ = ["ANY", "ORDERS", "Filter", "chosen", "words_of"]

ANY = "any"
ORDERS = ("trial", *(f"margin of {name}" for name in CRITERIA))
"""What a list can be sorted by: the trial's number, or a margin, the smallest first."""


@dataclass(frozen=True)
class Filter:
    """What rows must be to be listed; `ANY` says nothing. `order`: one of ORDERS; `below_mm`: of
    the margin it names."""

    object: str = ANY
    outcome: str = ANY
    reason: str = ANY
    order: str = ORDERS[0]
    below_mm: float = np.inf


def words_of(rows: Sequence[dict[str, Any]], column: str) -> list[str]:
    """ANY and the words that a column holds, in order."""
    return [ANY, *sorted({str(row[column]) for row in rows if row[column] is not None})]


def chosen(rows: Sequence[dict[str, Any]], by: Filter) -> list[dict[str, Any]]:
    """The rows that pass, sorted; rows without the margin that is asked for are left out."""
    column = "" if by.order == ORDERS[0] else f"margin_{by.order.rpartition(' ')[2]}_m"
    kept = []
    for row in rows:
        wanted = (("object", by.object), ("outcome", by.outcome), ("plan_reason", by.reason))
        if any(word not in (ANY, str(row[name])) for name, word in wanted):
            continue
        if column and (row[column] is None or 1e3 * row[column] > by.below_mm):
            continue
        kept.append(row)
    return sorted(kept, key=lambda row: (row[column] if column else 0.0, row["trial_id"]))
