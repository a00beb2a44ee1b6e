"""Text beside a picture of a trial: its verdict in words and the margins."""

from collections.abc import Collection, Sequence
from html import escape
from typing import Any

import numpy as np

from r2h_batch.report.text import plain
from r2h_batch.verdicts import CRITERIA, REGISTRY, UNITS, Unit
from r2h_batch.view.drawing import MARKS, Drawing, body_name

MEANING = {
    "stability": "room left between the pads and at the ends of their stroke",
    "plan": "smallest distance to an obstacle along the path",
    "reach": "how far the object reaches into the ball in front of the palm",
    "affordance": "distance from the fingers to the receiver's part of the object",
    "safe": "smallest distance from the robot to the hand",
}
"""Meaning of each margin; a criterion that is not named here has no tooltip."""
REASONS = {
    "start_in_collision": "the arm collides at home",
    "ik_unreachable": "the arm cannot reach the target",
    "ik_in_collision": "every posture at the target collides",
    "no_path_in_budget": "no path was found in time",
    "not_settled": "the arm did not come to rest",
    "motion_in_collision": "the given motion collides",
    "beyond_joint_limits": "a joint goes beyond its limit",
    "beyond_speed_limits": "a joint turns faster than it can",
    "ik_not_found": "no posture was found at the target",
    "no_free_posture_found": "every posture found at the target collides",
}


FAILS = {
    "stability": "the gripper does not hold it",
    "reach": "the hand does not reach the object",
    "affordance": "the gripper holds the receiver's part",
    "safe": "the robot meets the hand",
}
"""Meaning of a failed criterion; `headline` adds by how much."""
PAIRS = {"hand": "robot and hand", "table": "robot and table", "self": "robot and robot"}
"""Pairs whose stored name (`CollidingPair`) leaves out the robot."""


LEGEND = {
    "target": "requested pose",
    "region": "the receiver's part",
    "ball": "where the object must be",
    "palm": "out of the palm",
    "width": "between the pads",
    "witness": "what fails",
}
"""Meaning of each group of `MARKS`."""


def legend(drawings: Sequence[Drawing], groups: Collection[str] = MARKS) -> list[tuple[str, str]]:
    """(#rrggbb, words) of the marks that these trials have, of these groups."""
    colors = {m.group: m.rgba[:3] for d in drawings for m in d.marks if m.group in groups}
    return [
        ("#" + "".join(f"{round(255 * c):02x}" for c in colors[group]), LEGEND[group])
        for group in MARKS
        if group in colors
    ]


def headline(row: dict[str, Any]) -> str:
    """The verdict in one line: success, or the criterion that fails first, why, and by how much."""
    outcome = str(row["outcome"])
    if outcome == "success":
        return outcome if row.get("t_exec_s") is None else f"success, {row['t_exec_s']:.1f} s"
    if outcome not in CRITERIA:
        return outcome.replace("_", " ")
    column, unit = _margin_column(outcome)
    size = row.get(column)
    size = None if size is None or not np.isfinite(size) else -unit.scale * size
    least = "at least " if row.get(f"margin_kind_{outcome}") == "bound" else ""
    by = "" if size is None else f"{least}{size:.1f} {unit.shown}"
    words = f"{outcome} fails: "
    if outcome == "plan":
        reason, pair = str(row["plan_reason"]), row.get("plan_pair")
        met = f" ({PAIRS.get(pair, pair.replace('_', ' and '))})" if pair else ""
        short = f": {by} short" if by and reason in ("ik_unreachable", "ik_not_found") else ""
        return f"{words}{REASONS.get(reason, reason.replace('_', ' '))}{met}{short}"
    if outcome == "safe" and row.get("witness_safe_part") and row.get("witness_time_s") is not None:
        return f"{words}{body_name(str(row['witness_safe_part']))} meets the hand at {row['witness_time_s']:.1f} s"
    if outcome == "stability" and row.get("width_m") is None:
        return f"{words}nothing lies between the pads"
    if outcome == "stability":
        words += f"{1e3 * row['width_m']:.1f} mm of material between the pads, "
    text = FAILS.get(outcome)
    if text is None or not by:
        return f"{words}{text or ''}".rstrip(" :,")
    return f"{words}{text}, by {by}"


def summary(row: dict[str, Any]) -> str:
    """A trial in a list: its number, object and verdict."""
    return f"{row['trial_id']} · {str(row['object']).replace('_', ' ')} · {headline(row)}"


def title(drawing: Drawing) -> str:
    """Trial, object, hand and split."""
    row = drawing.stored.row
    name = str(row["object"]).replace("_", " ")
    return f"Trial {row['trial_id']}: {name} to a {row['side']} hand ({row['split']})"


def as_markdown(drawing: Drawing) -> str:
    """The panel of the viewer."""
    verdict = f"{plain(drawing.stored.method)}: **{plain(headline(drawing.stored.row))}**"
    lines = [f"**{plain(title(drawing))}**", "", verdict, "", "| | | margin |", "|---|---|---|"]
    lines += [f"| {name} | {verdict} | {margin} |" for name, verdict, margin in _criteria(drawing)]
    return "\n".join([*lines, "", *(f"- {plain(line)}" for line in _facts(drawing))])


def as_html(drawing: Drawing) -> str:
    """The panel of a page, as a fragment of HTML."""
    rows = "".join(
        f'<tr class="{verdict.split()[0]}" title="{escape(MEANING.get(name, ""))}">'
        f"<th>{escape(name)}</th><td>{verdict}</td><td>{escape(margin)}</td></tr>"
        for name, verdict, margin in _criteria(drawing)
    )
    facts = "".join(f"<li>{escape(line)}</li>" for line in _facts(drawing))
    verdict = f"{escape(drawing.stored.method)}: <b>{escape(headline(drawing.stored.row))}</b>"
    heading = escape(title(drawing))
    groups = [g for g in MARKS if g != "target" or not drawing.stored.moves]
    marks = "".join(
        f'<span><b style="color: {color}">\u25a0</b> {escape(words)}</span> '
        for color, words in legend([drawing], groups)
    )
    verdict, margins = f"<p>{verdict}</p>", f"<table>{rows}</table><ul>{facts}</ul>"
    return f'<h1>{heading}</h1>{verdict}{margins}<p class="legend">{marks}</p>'


def _criteria(drawing: Drawing) -> list[tuple[str, str, str]]:
    """(name, verdict, margin) of each criterion."""
    row, found = drawing.stored.row, []
    for name in CRITERIA:
        passed = row.get(f"passed_{name}")
        verdict = "not evaluated" if passed is None else "passes" if passed else "fails"
        found.append((name, verdict, _margin(row, name)))
    return found


def _margin(row: dict[str, Any], name: str) -> str:
    """A margin with its unit. What saturates is no distance, and is not printed as one."""
    column, unit = _margin_column(name)
    size, kind = row.get(column), row.get(f"margin_kind_{name}")
    if size is None or not np.isfinite(size):
        return ""
    if kind == "cap":
        return f"more than {unit.scale * size:.0f} {unit.shown}" if size > 0 else ""
    return f"{unit.scale * size:+.1f} {unit.shown}{' or less' if kind == 'bound' else ''}"


def _margin_column(name: str) -> tuple[str, Unit]:
    """The stored column of a criterion's margin, and how it is shown."""
    entry = REGISTRY[CRITERIA.index(name)]
    return entry.margin_column, UNITS[entry.unit]


def _facts(drawing: Drawing) -> list[str]:
    """Further facts of the trial, a line each."""
    row, lines = drawing.stored.row, []
    if row.get("width_m") is not None:
        width, opening = (f"{1e3 * row[k]:.1f} mm" for k in ("width_m", "opening_m"))
        lines.append(f"material between the pads {width}, opening of the pads {opening}")
    if row.get("t_exec_s") is not None:
        lines.append(f"the arm reaches its goal after {row['t_exec_s']:.1f} s")
    if drawing.witness is not None:
        lines.append(drawing.witness.caption)
    return [*lines, *([drawing.stored.note] if drawing.stored.note else [])]
