"""Charts as SVG text for one page: no script, no network. Colours are told apart by the colour-blind too."""

import html
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from r2h_batch.results.rows import OUTCOME_NAMES
from r2h_batch.statistics.breakdown import Histogram

# Okabe and Ito's palette, one colour per outcome wherever it appears
COLORS = {
    "success": "#009e73",
    "stability": "#e69f00",
    "plan": "#0072b2",
    "reach": "#56b4e9",
    "affordance": "#cc79a7",
    "safe": "#d55e00",
    "invalid_input": "#8c8c8c",
    "invalid_sim": "#5a5a5a",
    "missing": "#c8c8c8",
}
LINES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5a5a5a", "#000000")
DASHES = ("", "6 3", "2 3", "8 3 2 3")

LABEL, BAR, ROW, FONT = 250, 560, 22, 12


class Box(Protocol):
    """What a box of a box plot shows."""

    @property
    def mean(self) -> float: ...
    @property
    def median(self) -> float: ...
    @property
    def q1(self) -> float: ...
    @property
    def q3(self) -> float: ...
    @property
    def min(self) -> float: ...
    @property
    def max(self) -> float: ...


def outcome_bars(bars: Sequence[tuple[str, Mapping[str, int]]]) -> str:
    """One stacked bar of 100 % per (label, counts by outcome), with SR and N in figures."""
    used = [o for o in OUTCOME_NAMES if any(counts[o] for _, counts in bars)]
    height = ROW * (len(bars) + 1) + 22
    parts = [_open(LABEL + BAR + 120, height)]
    for i, (label, counts) in enumerate(bars):
        n, x, y = sum(counts.values()), float(LABEL), ROW * i + 4
        parts.append(_label(LABEL - 8, y + 12, label, "end"))
        for outcome in used:
            width = BAR * counts[outcome] / n if n else 0.0
            if width:
                share = f"{100 * counts[outcome] / n:.1f} %"
                tip = html.escape(f"{label}: {outcome} {counts[outcome]} of {n} ({share})")
                parts.append(
                    f'<rect x="{x:.2f}" y="{y}" width="{width:.2f}" height="{ROW - 6}" fill="{COLORS[outcome]}">'
                    f"<title>{tip}</title></rect>"
                )
            x += width
        share = f"{100 * counts['success'] / n:.1f} %  n={n}" if n else "no trials"
        parts.append(_label(LABEL + BAR + 8, y + 12, share))
    y = ROW * len(bars) + 4
    for percent in (0, 25, 50, 75, 100):
        parts.append(_label(LABEL + BAR * percent / 100, y + 10, f"{percent} %", "middle"))
    return f"<div class=scroll>{''.join(parts)}</svg></div>{_legend([(o, COLORS[o], '') for o in used])}"


def histograms(title: str, series: Mapping[str, Histogram], *, scale: float, unit: str, zero: bool = False) -> str:
    """Steps of several histograms over one axis as shares of each one's count; `zero` marks 0."""
    width, height, left, bottom = 420, 190, 40, 34
    inner_w, inner_h = width - left - 12, height - bottom - 24
    shares = {name: h.counts / h.counts.sum() for name, h in series.items() if h.counts.sum()}
    if not shares:
        return f"<figure><figcaption>{html.escape(title)}: none defined</figcaption></figure>"
    first = next(iter(series.values()))
    top = max(float(s.max()) for s in shares.values())
    low, high = first.low * scale, first.high * scale

    def at_x(value: float) -> float:
        return left + inner_w * (value - low) / (high - low)

    parts = [_open(width, height), _label(left, 14, title, bold=True)]
    base = height - bottom
    parts.append(f'<path d="M{left} {base}H{left + inner_w}" stroke="#888"/>')
    for value in np.linspace(low, high, 5):
        parts.append(_label(at_x(float(value)), base + 15, _number(float(value)), "middle"))
    parts.append(_label(left + inner_w / 2, base + 30, unit, "middle"))
    parts.append(_label(left - 6, base - inner_h + 8, f"{100 * top:.0f} %", "end"))
    if zero and low < 0 < high:
        parts.append(f'<path d="M{at_x(0):.1f} {base}V{base - inner_h}" stroke="#444" stroke-dasharray="3 3"/>')
    for i, (name, share) in enumerate(shares.items()):
        points = [f"M{left} {base}"]
        for k, value in enumerate(share):
            points.append(f"V{base - inner_h * value / top:.1f}H{left + inner_w * (k + 1) / len(share):.1f}")
        points.append(f"V{base}")
        color, dash = LINES[i % len(LINES)], DASHES[i // len(LINES) % len(DASHES)]
        tip = html.escape(f"{name}: {int(series[name].counts.sum())} trials")
        parts.append(
            f'<path d="{"".join(points)}" fill="none" stroke="{color}" stroke-width="1.6" stroke-dasharray="{dash}">'
            f"<title>{tip}</title></path>"
        )
    names = [(name, LINES[i % len(LINES)], DASHES[i // len(LINES) % len(DASHES)]) for i, name in enumerate(shares)]
    return f"<figure>{''.join(parts)}</svg>{_legend(names)}</figure>"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _open(width: float, height: float) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}"'
        f' height="{height:.0f}" font-family="system-ui, sans-serif" font-size="{FONT}" role="img">'
    )


def _label(x: float, y: float, text: str, anchor: str = "start", *, bold: bool = False) -> str:
    weight = ' font-weight="600"' if bold else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="#222"{weight}>{html.escape(text)}</text>'


def _legend(entries: Sequence[tuple[str, str, str]]) -> str:
    marks = "".join(
        f'<span><i style="background:{color}"></i>{html.escape(name)}{" (dashed)" if dash else ""}</span>'
        for name, color, dash in entries
    )
    return f"<div class=legend>{marks}</div>"


def box_plots(groups: Mapping[str, Mapping[str, Box]]) -> str:
    """Boxes of ratings from 1 to 5, one group per method, one colour per dimension; a dotted line at the midpoint 3."""
    names = list(dict.fromkeys(d for boxes in groups.values() for d in boxes))
    step, left, top, unit = 34, 40, 20, 56
    group_w = step * len(names) + 40
    width, base = left + group_w * len(groups) + 10, top + 4 * unit

    def at_y(rating: float) -> float:
        return base - unit * (rating - 1)

    parts = [_open(width, base + 58)]
    for rating in range(1, 6):
        dash = ' stroke-dasharray="2 3"' if rating == 3 else ""
        color = "#444" if rating == 3 else "#ddd"
        parts.append(f'<path d="M{left} {at_y(rating)}H{width - 10}" stroke="{color}"{dash}/>')
        parts.append(_label(left - 8, at_y(rating) + 4, str(rating), "end"))
    for g, (method, boxes) in enumerate(groups.items()):
        start = left + group_w * g + 20
        parts.append(_label(start + step * len(names) / 2, base + 22, method, "middle"))
        for k, name in enumerate(names):
            if name not in boxes:
                continue
            box, x, color = boxes[name], start + step * k + step / 2, LINES[k % len(LINES)]
            low, q1, q3, high = map(at_y, (box.min, box.q1, box.q3, box.max))
            tip = html.escape(
                f"{method}, {name}: median {box.median:g}, Q1 {box.q1:g}, Q3 {box.q3:g}, mean {box.mean:.2f}"
            )
            parts.append(
                f'<g stroke="{color}"><title>{tip}</title>'
                f'<path d="M{x} {low}V{q1}M{x} {q3}V{high}M{x - 6} {low}h12M{x - 6} {high}h12"/>'
                f'<rect x="{x - 11}" y="{q3}" width="22" height="{max(q1 - q3, 1)}" fill="{color}" fill-opacity="0.2"/>'
                f'<path d="M{x - 11} {at_y(box.median)}h22" stroke-width="2.5"/>'
                f'<path d="M{x} {at_y(box.mean) - 5}l5 5l-5 5l-5 -5z" fill="#fff"/></g>'
            )
    x = float(left)
    for k, name in enumerate(names):
        parts.append(f'<rect x="{x}" y="{base + 36}" width="11" height="11" fill="{LINES[k % len(LINES)]}"/>')
        parts.append(_label(x + 16, base + 46, name))
        x += 30 + 7 * len(name)
    return "".join([*parts, "</svg>\n"])
