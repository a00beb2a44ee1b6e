"""The smallest of a measured clearance along a way, by halving of intervals: certified where no point goes far within one."""

from collections.abc import Callable

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

TOLERANCE_M, SHARE = 1e-4, 0.1
"""How exact the smallest clearance is: this, or this share of it if that is more."""
LEVELS = 16
"""Halvings at most: the parts of a way of 10 cm are below the tolerance after seven."""

Measure = Callable[[Tensor, Tensor], Tensor]
"""(row, s): clearances (m) of rows at s, the share of the way."""
Travel = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""(row, low, middle, high): how far a point is at most, on the interval, from where it is in its middle (m)."""
Floor = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(row, low, high): a lower bound of the clearance on the interval that is known without a measurement (m)."""


def least_along(
    measure: Measure,
    travel: Travel,
    rows: Int64[Tensor, " r"],
    n: int,
    *,
    parts: int,
    cap_m: float,
    floor: Floor | None = None,
) -> tuple[Float32[Tensor, " b"], Float32[Tensor, " b"]]:
    """The smallest clearance of each row on its way (s from 0 to 1), and where it is. A row does not depend on the others.

    The clearance in the middle of an interval, less what a point travels, is a lower bound on it, and so is its floor.
    Intervals whose bound is more than the tolerance below the smallest clearance so far are halved (branch and bound). Both
    ends are measured.

    Args:
        measure: exact below `cap_m` plus the travel of the first parts, or `cap_m` alone if no more is of interest.
        travel: on an interval.
        rows: rows with a way.
        n: rows in all; the others get `cap_m` and 0.
        parts: intervals that a way begins with.
        cap_m: clearances count this at most, m.
        floor: on an interval, where something is known.
    """
    device = rows.device
    best = torch.full((n,), cap_m, dtype=torch.float32, device=device)
    where = torch.zeros(n, dtype=torch.float32, device=device)
    edges = torch.linspace(0, 1, parts + 1, dtype=torch.float32, device=device)
    row = torch.cat([rows.repeat_interleave(2), rows.repeat_interleave(parts)])
    ends = edges[[0, -1]].repeat(len(rows))
    low = torch.cat([ends, edges[:-1].repeat(len(rows))])
    high = torch.cat([ends, edges[1:].repeat(len(rows))])
    for _ in range(LEVELS):
        if not len(row):
            break
        middle = 0.5 * (low + high)
        found = measure(row, middle)
        lower = best.scatter_reduce(0, row, found, "amin")
        # the first of several places, whatever their order
        at = torch.where(found == lower[row], middle, torch.inf)
        first = torch.full_like(where, torch.inf).scatter_reduce(0, row, at, "amin")
        where = torch.where(lower < best, first, where)
        best = lower
        allowed = torch.clamp(SHARE * best.abs(), min=TOLERANCE_M)[row]
        bound = found - travel(row, low, middle, high)
        if floor is not None:
            bound = torch.maximum(bound, floor(row, low, high))
        left = (low < high) & (bound < best[row] - allowed)
        row, low, middle, high = (x[left] for x in (row, low, middle, high))
        row = row.repeat(2)
        low, high = torch.cat([low, middle]), torch.cat([middle, high])
    return best, where
