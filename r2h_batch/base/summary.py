"""Printed form of batches: one line for a terminal, a small table for a notebook, numbers for a
logger. No torch, no pandas."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.verdicts import EVERY, UNITS, CriterionEntry, MarginKind, Outcome, PlanReason

Array = NDArray[Any]


def counted(n: int, word: str) -> str:
    """1 trial, 2 trials."""
    return f"{n:,} {word}{'' if n == 1 else 's'}"


def share(part: int, whole: int) -> str:
    """Percent with one digit."""
    return f"{100 * part / whole:.1f} %" if whole else "none"


def outcome_counts(outcome: Array) -> dict[str, int]:
    """How often each outcome is there, success first, only those that are."""
    codes = outcome.reshape(-1).astype(int)
    return {o.name.lower(): n for o in Outcome if (n := int((codes == o).sum()))}


def scores_line(shape: Sequence[int], device: str, outcome: Array) -> str:
    """`Scores(512 rows on cpu: success 41.2 %, plan 30.1 %, reach 28.7 %)`."""
    n = int(np.prod(shape, dtype=np.int64))
    size = " x ".join(map(str, shape)) if len(shape) > 1 else f"{n:,}"
    parts = ", ".join(f"{name} {share(k, n)}" for name, k in outcome_counts(outcome).items())
    return f"Scores({size} row{'' if n == 1 else 's'} on {device}{': ' + parts if parts else ''})"


def scores_table(
    entries: Sequence[CriterionEntry], passed: Array, evaluated: Array, margin: Array
) -> list[tuple[str, str, str, str, str]]:
    """(criterion, evaluated, passes, median margin, 5 % margin) of each criterion, those of the columns; margins in mm, others
    say their unit."""
    p, e, m = (np.reshape(x, (-1, x.shape[-1])) for x in (passed, evaluated, margin))
    rows = []
    for k, entry in enumerate(entries):
        name, (shown, scale, *_) = entry.name, UNITS[entry.unit]
        column = e[:, k]
        finite = m[column & np.isfinite(m[:, k]), k]
        unit = "" if shown == "mm" else f" {shown}"
        low, middle = (
            f"{scale * float(np.quantile(finite, q)):.1f}{unit}" if len(finite) else "none"
            for q in (0.05, 0.5)
        )
        n = int(column.sum())
        rows.append((name, f"{n:,}", share(int(p[column, k].sum()), n), middle, low))
    return rows


def scalars_of(
    entries: Sequence[CriterionEntry],
    passed: Array,
    evaluated: Array,
    margin: Array,
    kind: Array,
    outcome: Array,
    times: Mapping[str, Array],
) -> dict[str, float]:
    """Numbers for a logger: `success`, `outcome/NAME`, `passed/NAME` and `margin_m/NAME` (or the
    criterion's other unit) of criteria, means of times. Margins that are caps are not lengths: means leave them out.

    Rates are of all rows (outcomes) or of those evaluated (criteria); what no row has is left out,
    so nothing is NaN.
    """
    codes = outcome.reshape(-1).astype(int)
    n = len(codes)
    if not n:
        return {}
    found = {"success": float((codes == Outcome.SUCCESS).mean())}
    others = {entry.name for entry in EVERY} - {
        entry.name for entry in entries
    }  # of other benchmarks
    names = {o: o.name.lower() for o in Outcome if o.name.lower() not in others}
    found |= {f"outcome/{name}": float((codes == o).mean()) for o, name in names.items()}
    p, e, m, kinds = (np.reshape(x, (-1, x.shape[-1])) for x in (passed, evaluated, margin, kind))
    for k, entry in enumerate(entries):
        name = entry.name
        column = e[:, k]
        finite = m[column & np.isfinite(m[:, k]) & (kinds[:, k] != MarginKind.CAP), k]
        if column.any():
            found[f"passed/{name}"] = float(p[column, k].mean())
        if len(finite):
            found[f"margin_{entry.unit}/{name}"] = float(finite.astype(np.float64).mean())
    for name, values in times.items():
        finite = values.reshape(-1)[np.isfinite(values.reshape(-1))]
        if len(finite):
            found[name] = float(finite.astype(np.float64).mean())
    return found


def frame_of(columns: Mapping[str, Any]) -> Any:
    """A pandas DataFrame of these columns; ImportError with one line where pandas is not there."""
    try:
        import pandas
    except ImportError:
        raise ImportError("to_pandas needs pandas: pip install 'r2h_batch[pandas]'") from None
    return pandas.DataFrame(columns)


def score_columns(
    entries: Sequence[CriterionEntry], names: Callable[[str], Array]
) -> dict[str, Any]:
    """The columns of a frame of scores, whose criteria are `entries`; `names(field)` gives a field of `Scores` as an array of
    B rows."""
    passed, evaluated, margin = names("passed"), names("evaluated"), names("margin")
    kind = names("margin_kind")
    columns: dict[str, Any] = {
        "trial_id": names("trial_id"),
        "outcome": [Outcome(int(o)).name.lower() for o in names("outcome")],
        "success": names("success"),
        "plan_reason": [PlanReason(int(r)).name.lower() for r in names("plan_reason")],
        "borderline": names("borderline"),
    }
    for k, entry in enumerate(entries):
        judged = zip(passed[:, k], evaluated[:, k])
        columns[entry.passed_column] = [bool(p) if e else None for p, e in judged]
        columns[entry.margin_column] = margin[:, k]
        columns[entry.kind_column] = [MarginKind(int(i)).name.lower() for i in kind[:, k]]
    more = ("t_plan_s", "t_exec_s", "width_m", "opening_m", "grasp_shift_m", "presented_margin_m")
    return columns | {name: names(name) for name in more}
