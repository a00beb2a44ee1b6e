"""Text beside a picture of a trial: its verdict in words and the margins."""

from collections.abc import Collection, Sequence
from html import escape
from typing import Any

import numpy as np

from r2h_batch.base.table import Column, Table, document, notes_list, plain
from r2h_batch.runs.explain import LEAST, PAIRS, headline, presented_words
from r2h_batch.verdicts import EVERY, UNITS, CriterionEntry
from r2h_batch.view.drawing import HULL, MARKS, Drawing
from r2h_batch.view.postures import Postures
from r2h_batch.view.stored_trial import StoredTrial

LEGEND = {
    "target": "requested pose",
    "region": "the receiver's part",
    "ball": "where the object must be",
    "palm": "out of the palm",
    "width": "between the pads",
    "witness": "what fails",
}
"""Meaning of each group of `MARKS`."""
BY_HULL = " (see-through: its hull)"


def legend(drawings: Sequence[Drawing], groups: Collection[str] = MARKS) -> list[tuple[str, str]]:
    """(#rrggbb, words) of the marks that these trials have, of these groups."""
    hull = any(d.witness is not None and HULL in d.witness.geoms for d in drawings)
    colors = {m.group: m.rgba[:3] for d in drawings for m in d.marks if m.group in groups}
    return [
        (
            "#" + "".join(f"{round(255 * c):02x}" for c in colors[group]),
            LEGEND[group] + (BY_HULL if hull and group == "witness" else ""),
        )
        for group in MARKS
        if group in colors
    ]


def verdict_of(stored: StoredTrial) -> str:
    """The verdict of a trial in one line; of a failed plan with the pair that its margin is about."""
    return headline(stored.row, pair_of(stored), stored.head_clearance_m)


def pair_of(stored: StoredTrial) -> str | None:
    """The pair of bodies that a failed plan's margin is about, as `headline` takes it."""
    nearest = None if stored.asked is None else stored.asked.nearest
    if nearest is None:
        return None
    if nearest.other == "head" and stored.head_clearance_m:
        who = "object" if nearest.part == "object" else "robot"
        return f"{who} within {100 * stored.head_clearance_m:g} cm of the head"
    return nearest.kind


def postures(asked: Postures) -> str:
    """Counts of the pairs that overlap in the postures at a target, in one line."""
    n = sum(asked.met.values())
    if n == 1:
        return "one posture reaches the target"
    listed = ", ".join(f"{PAIRS[kind]} {k}" for kind, k in asked.met.items())
    return f"of {n} postures that reach the target: {listed}; shown is the one that overlaps least"


def summary(row: dict[str, Any]) -> str:
    """A trial in a list: its number, object and verdict."""
    return f"{row['trial_id']} · {str(row['object']).replace('_', ' ')} · {headline(row)}"


def title(drawing: Drawing) -> str:
    """Trial, object, hand and split; whether planning's belief is drawn."""
    row = drawing.stored.row
    name = str(row["object"]).replace("_", " ")
    as_what = ", as planning believed it" if drawing.stored.believed else ""
    return f"Trial {row['trial_id']}: {name} to a {row['side']} hand ({row['split']}){as_what}"


def as_markdown(drawing: Drawing) -> str:
    """The panel of the viewer."""
    verdict = f"{plain(drawing.stored.method)}: **{plain(verdict_of(drawing.stored))}**"
    facts = notes_list(map(plain, _facts(drawing)))
    return document([f"**{plain(title(drawing))}**", verdict, _criteria(drawing), facts])


def as_html(drawing: Drawing) -> str:
    """The panel of a page, as a fragment of HTML."""
    facts = "".join(f"<li>{escape(line)}</li>" for line in _facts(drawing))
    verdict = f"{escape(drawing.stored.method)}: <b>{escape(verdict_of(drawing.stored))}</b>"
    heading = escape(title(drawing))
    groups = [g for g in MARKS if g != "target" or drawing.away]
    marks = "".join(
        f'<span><b style="color: {color}">\u25a0</b> {escape(words)}</span> '
        for color, words in legend([drawing], groups)
    )
    margins = _criteria(drawing).html(rows="verdict") + f"<ul>{facts}</ul>"
    return f'<h1>{heading}</h1><p>{verdict}</p>{margins}<p class="legend">{marks}</p>'


def _criteria(drawing: Drawing) -> Table:
    """Verdict and margin of each criterion."""
    row, found = drawing.stored.row, []
    for entry in (e for e in EVERY if not e.asked or e.passed_column in row):
        passed = row.get(entry.passed_column)
        verdict = "not evaluated" if passed is None else "passes" if passed else "fails"
        record = {"criterion": entry.name, "verdict": verdict, "margin": _margin(row, entry)}
        found.append({**record, "meaning": entry.means or None})
    names = Column("criterion", left=True, about="meaning")
    return Table((names, Column("verdict"), Column("margin")), found)


def _margin(row: dict[str, Any], entry: CriterionEntry) -> str:
    """A margin with its unit. What saturates is no distance, and is not printed as one."""
    size, kind, unit = row.get(entry.margin_column), row.get(entry.kind_column), UNITS[entry.unit]
    if size is None or not np.isfinite(size):
        return ""
    if kind == "cap":
        return f"more than {unit.scale * size:.0f} {unit.shown}" if size > 0 else ""
    shown = unit.scale * size
    words = f"0 {unit.shown}" if abs(shown) < LEAST else f"{shown:+.1f} {unit.shown}"
    return f"{words}{' or less' if kind == 'bound' else ''}"


def _facts(drawing: Drawing) -> list[str]:
    """Further facts of the trial, a line each."""
    row, lines = drawing.stored.row, []
    if row.get("width_m") is not None:
        width, opening = (f"{1e3 * row[k]:.1f} mm" for k in ("width_m", "opening_m"))
        lines.append(f"material between the pads {width}, opening of the pads {opening}")
    if "passed_presented" not in row and (words := presented_words(row)):
        lines.append(f"{words} (Presented: no part of the verdict)")
    if row.get("t_exec_s") is not None:
        lines.append(f"the arm reaches its goal after {row['t_exec_s']:.1f} s")
    if drawing.witness is not None:
        lines.append(drawing.witness.caption)
    asked = drawing.stored.asked
    if asked is not None and asked.met:
        lines.append(postures(asked))
    return [*lines, *([drawing.stored.note] if drawing.stored.note else [])]
