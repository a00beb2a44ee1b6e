"""Reception of a stored run: can the person take what each method handed over? (`results reception`)"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from r2h_batch.base.registry import QUESTIONS
from r2h_batch.base.table import Table, document, notes_list, of_lines
from r2h_batch.judge.reception import ANGLES, STEPS, chance_of_one, reception
from r2h_batch.report.text import short_names
from r2h_batch.runs.files import RunError
from r2h_batch.sweep.results.judge import Judge
from r2h_batch.sweep.results.questions import Part, Question, judged
from r2h_batch.types import Scores

CURVE_K = (8, 32, 64, 128, 256)
TURNS_DEG = (45, 60, 90, 180)

SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("success", pa.bool_(), nullable=False),
        pa.field("evaluated", pa.bool_(), nullable=False),
        pa.field("received", pa.bool_(), nullable=False),
        pa.field("known", pa.int16(), nullable=False),
        *(pa.field(f"n_{step}", pa.int16(), nullable=False) for step in STEPS),
        pa.field("grasp", pa.int32()),
        pa.field("effort", pa.float32()),
        pa.field("turn_deg", pa.float32()),
        pa.field("travel_m", pa.float32()),
        *(pa.field(f"{name}_deg", pa.float32()) for name in ANGLES),
        pa.field("rula", pa.int8()),
    ]
)
"""A row for each stored row that has a pose; fields as in `judge.reception.Reception`, null where nothing is
received."""

NOTES = (
    "Percent of the rows with a held object and a goal posture; `n` counts them. A column of a step: rows with a grasp left that"
    " passes it and all before. received: the whole way to the easiest of these is free too. No part of SR, but where the"
    " benchmark asks for Received.",
    "K: how many of the received would be if only K grasps a side were known (drawn at random): at least one of them passes"
    " every step. Turn: received with the hand turned by at most so much in the easiest grasp.",
    "Hands have the shape of the held-out grasps, not of the trial's person (docs/r2h_v3.md).",
)


def answer(judge: Judge, part: Part) -> pa.Table:
    """Reception of stored rows, as a table of `SCHEMA`.

    Args:
        judge: the evaluator of the run.
        part: of the stored rows.

    Raises:
        RunError: its trials have no receiver's body.
    """
    if not len(part.tables["poses"]):
        return SCHEMA.empty_table()
    if judge.trials(part.trial_id[:1]).receiver is None:
        raise RunError(
            f"{part.run.folder}: its trials have no receiver's body; sweep a benchmark of people"
        )
    return rows_of(*judged(judge, part), part.success)


QUESTION = Question("reception", SCHEMA, 1, answer)
QUESTIONS.add(QUESTION.name, QUESTION)


def rows_of(trial_id: np.ndarray, scores: Scores, success: Mapping[int, bool]) -> pa.Table:
    """Reception of judged handovers as a table of `SCHEMA`.

    Args:
        trial_id: (n,) numbers of the trials.
        scores: n rows with their inputs.
        success: whether each trial succeeded.
    """
    found = reception(scores)
    count, angles = found.count.cpu().numpy(), found.angles_deg.cpu().numpy()
    columns: dict[str, Any] = {
        "trial_id": trial_id,
        "success": np.array([success[i] for i in trial_id.tolist()], bool),
        **{k: getattr(found, k).cpu().numpy() for k in ("evaluated", "received", "known")},
        **{f"n_{step}": count[:, j] for j, step in enumerate(STEPS)},
    }
    names = ("grasp", "effort", "turn_deg", "travel_m", "rula")
    easiest = {k: getattr(found, k).cpu().numpy() for k in names}
    easiest |= {f"{name}_deg": angles[:, j] for j, name in enumerate(ANGLES)}
    none = ~columns["received"]
    columns |= {k: pa.array(v, SCHEMA.field(k).type, mask=none) for k, v in easiest.items()}
    return pa.table({name: columns[name] for name in SCHEMA.names}, schema=SCHEMA)


def render(tables: dict[str, pa.Table]) -> str:
    """The funnel, what it says with fewer grasps and with less turn of the hand, and the effort, of each
    method, as text that ends in a newline."""
    short = short_names(list(tables))
    funnel, curve, effort = [], [], []
    for name, table in tables.items():
        row = {k: table[k].to_numpy(zero_copy_only=False) for k in table.column_names}
        judged = row["evaluated"]
        got = row["received"] & judged
        label = short[name]
        last = row[f"n_{STEPS[-1]}"]
        steps = [_percent((row[f"n_{step}"] > 0)[judged]) for step in STEPS]
        shares = [*steps, _percent(got[judged]), _percent(got), _percent(got & row["success"])]
        funnel.append([label, str(int(judged.sum())), *shares])
        # of received rows alone: so no column K exceeds received
        passing = np.where(got, last, 0)[judged]
        chances = [chance_of_one(passing, row["known"][judged], k) for k in CURVE_K]
        turned = [np.nan_to_num(row["turn_deg"][judged], nan=np.inf) <= t for t in TURNS_DEG]
        curve.append([label, *map(_percent, chances), *map(_percent, turned)])
        effort.append([label, *_means(row, got)])
    curve_head = [*(f"K={k}" for k in CURVE_K), *(f"{t} deg" for t in TURNS_DEG)]
    parts: list[Table | str] = [
        "Received, by step",
        of_lines(["Method", "n", *STEPS, "received", "of all", "and success"], funnel),
        "With fewer known grasps, and with less turn of the hand",
        of_lines(["Method", *curve_head], curve),
        "Means of the easiest grasp",
        of_lines(["Method", "turn, deg", "travel, cm", "lean, deg", "effort", "RULA"], effort),
        notes_list(NOTES),
    ]
    return document(parts)


def _percent(hits: Sequence[bool] | np.ndarray) -> str:
    return f"{100 * float(np.mean(hits)):.1f}" if len(hits) else "-"


def _means(row: dict[str, np.ndarray], got: np.ndarray) -> list[str]:
    if not got.any():
        return ["-"] * 5
    turn, travel, lean, effort, rula = (
        float(np.mean(row[k][got])) for k in ("turn_deg", "travel_m", "lean_deg", "effort", "rula")
    )
    return [f"{turn:.0f}", f"{100 * travel:.1f}", f"{lean:.1f}", f"{effort:.3f}", f"{rula:.2f}"]
