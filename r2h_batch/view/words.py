"""What stands beside a trial: its verdict in words and the margins of the five criteria, as
Markdown and as HTML."""

from html import escape
from typing import Any

from r2h_batch.export.drawing import Stage
from r2h_batch.verdicts import CRITERIA

__all__ = ["as_html", "as_markdown", "criteria_of", "headline", "in_brief"]

_MEANT = {
    "stability": "room between pads and stroke",
    "plan": "clearance along the path",
    "reach": "object inside the ball",
    "affordance": "fingers to the receiver's region",
    "safe": "robot to the hand",
}


def headline(row: dict[str, Any]) -> str:
    """One line: success, or which criterion failed first, why, and by how much."""
    outcome = str(row["outcome"])
    if outcome not in CRITERIA:
        return outcome.replace("_", " ")
    line = f"{outcome} fails"
    if outcome == "plan":
        pair = f" ({row['plan_pair'].replace('_', ' and ')})" if row.get("plan_pair") else ""
        return f"{line}: {str(row['plan_reason']).replace('_', ' ')}{pair}"
    margin = row.get(f"margin_{outcome}_m")
    return line if margin is None else f"{line} by {-1e3 * margin:.1f} mm"


def in_brief(row: dict[str, Any]) -> str:
    """A trial in a list: its number, object, outcome."""
    return f"{row['trial_id']} · {str(row['object']).replace('_', ' ')} · {headline(row)}"


def criteria_of(row: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """(criterion, verdict, margin in mm, what the margin is) of all five."""
    found = []
    for name in CRITERIA:
        passed, margin = row.get(f"passed_{name}"), row.get(f"margin_{name}_m")
        verdict = "not asked" if passed is None else "passes" if passed else "fails"
        if margin is None or margin in (float("inf"), float("-inf")):
            shown = "none"
        else:
            shown = f"{1e3 * margin:+.1f} mm"
        found.append((name, verdict, shown, _MEANT[name]))
    return found


def facts(stage: Stage) -> list[str]:
    """What else is known of a trial, a line each."""
    row, stored = stage.stored.row, stage.stored
    lines = []
    if row.get("width_m") is not None:
        lines.append(
            f"material between the pads {1e3 * row['width_m']:.1f} mm, opening {1e3 * row['opening_m']:.1f} mm"
        )
    if row.get("t_exec_s") is not None:
        lines.append(f"the arm is at its goal after {row['t_exec_s']:.1f} s")
    if not stored.moves and stage.witness is not None:
        lines.append(stage.witness.words)
    if stored.note:
        lines.append(stored.note)
    return lines


def title(stage: Stage) -> str:
    """Trial, object, hand, method."""
    row = stage.stored.row
    return f"Trial {row['trial_id']}: {str(row['object']).replace('_', ' ')} to a {row['side']} hand ({row['split']})"


def as_markdown(stage: Stage) -> str:
    """The panel of the viewer."""
    row = stage.stored.row
    lines = [
        f"**{title(stage)}**",
        "",
        f"{stage.stored.method}: **{headline(row)}**",
        "",
        "| | | margin |",
        "|---|---|---|",
    ]
    lines += [f"| {name} | {verdict} | {margin} |" for name, verdict, margin, _ in criteria_of(row)]
    return "\n".join([*lines, "", *(f"- {line}" for line in facts(stage))])


def as_html(stage: Stage) -> str:
    """The same as a fragment for a page."""
    row = stage.stored.row
    rows = "".join(
        f'<tr class="{verdict.split()[0]}" title="{escape(meant)}"><th>{escape(name)}</th><td>{escape(verdict)}</td>'
        f"<td>{escape(margin)}</td></tr>"
        for name, verdict, margin, meant in criteria_of(row)
    )
    more = "".join(f"<li>{escape(line)}</li>" for line in facts(stage))
    return (
        f"<h1>{escape(title(stage))}</h1><p>{escape(stage.stored.method)}: <b>{escape(headline(row))}</b></p>"
        f"<table>{rows}</table><ul>{more}</ul>"
    )
