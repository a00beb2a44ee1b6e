"""Figures of counted rows, drawn by matplotlib: as SVG for a page that may be light or dark, or as
PDF and PNG for print."""

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from r2h_batch.report.statistics.breakdown import Histogram
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.verdicts import ELSEWHERE, EVERY, NO_LONGER

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {
    "success": "#009e73",
    **{entry.name: entry.color for entry in EVERY},
    "invalid_input": "#8c8c8c",
    "invalid_sim": "#5a5a5a",
    "missing": "#c8c8c8",
    **dict.fromkeys(NO_LONGER, "#9467bd"),
    ELSEWHERE: "#b3a369",
}
"""One colour for each outcome, from Okabe and Ito's palette, which colour-blind readers can tell
apart."""

WORDS = {name: name.replace("_", " ") for name in OUTCOME_NAMES}

INK, FAINT, RIDGE = "#010203", "#040506", "#040507"
PAGE_COLORS = {INK: "currentColor", FAINT: "var(--rule)", RIDGE: "var(--bar)"}
"""Colours that `svg` exchanges, and the page's colours of text, rules and bars."""


def needs_matplotlib() -> None:
    """Raise `ValueError` with what to install if matplotlib is missing."""
    from importlib.util import find_spec

    if find_spec("matplotlib") is None:
        raise ValueError("figures need matplotlib: pip install 'r2h_batch[report]'")


@contextmanager
def style(*, page: bool) -> Iterator[None]:
    """matplotlib's settings for figures of a page or of a paper. Names from files are never read as
    mathematics."""
    import matplotlib

    ink, faint = (INK, FAINT) if page else ("#000000", "#cccccc")
    settings: Any = {
        "font.size": 9,
        "font.family": ["DejaVu Sans"],
        "svg.fonttype": "none",
        "svg.hashsalt": "r2h_batch",
        "pdf.fonttype": 42,
        "text.parse_math": False,
        "text.color": ink,
        "axes.labelcolor": ink,
        "axes.edgecolor": faint,
        "axes.titlecolor": ink,
        "axes.titlesize": 10,
        "axes.titlelocation": "left",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "xtick.color": ink,
        "ytick.color": ink,
        "grid.color": faint,
    }
    with matplotlib.rc_context(settings):
        yield


def make_figure(width: float, height: float) -> "Figure":
    """A figure of this size in inches, without a window system."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def svg(figure: "Figure", title: str) -> str:
    """The figure as one <svg> element in the page's colours, as wide as its place; screen readers
    say the title."""
    text = io.StringIO()
    how: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.03, "metadata": {"Date": None}}
    figure.savefig(text, format="svg", transparent=True, **how)
    # A tree, not a pattern over the text: only attributes get the page's colours, whatever a name
    # says.
    root = ElementTree.fromstring(text.getvalue())
    for parent in list(root.iter()):
        parent.tag = parent.tag.rpartition("}")[2]
        for child in list(parent):
            if child.tag.endswith("}metadata"):
                parent.remove(child)
        for key, value in list(parent.attrib.items()):
            del parent.attrib[key]
            if (parent.tag, key) != ("g", "id"):  # several figures of one page would share them
                for color, own in PAGE_COLORS.items():
                    value = value.replace(color, own)
                parent.set(key.rpartition("}")[2], value)
    root.attrib = {"xmlns": "http://www.w3.org/2000/svg", "viewBox": root.attrib["viewBox"]}
    root.attrib |= {"role": "img", "aria-label": title}
    return ElementTree.tostring(root, encoding="unicode")


def _bars(axes: "Axes", bars: Sequence[tuple[str, Mapping[str, int]]]) -> None:
    """Draw a stacked bar of 100 % for each (label, counts by outcome)."""
    used = [o for o in OUTCOME_NAMES if any(counts[o] for _, counts in bars)]
    totals = np.array([max(sum(counts.values()), 1) for _, counts in bars], float)
    left = np.zeros(len(bars))
    for outcome in used:
        share = 100 * np.array([counts[outcome] for _, counts in bars]) / totals
        color, label = COLORS[outcome], WORDS[outcome]
        axes.barh(range(len(bars)), share, left=left, height=0.7, color=color, label=label)
        for row, (x, width) in enumerate(zip(left, share, strict=True)):
            if width >= 9:
                how: Any = {"ha": "center", "va": "center", "color": "#ffffff", "fontsize": 8}
                axes.text(x + width / 2, row, f"{width:.0f}", **how)
        left += share
    axes.set_yticks(range(len(bars)), [label for label, _ in bars])
    axes.set_ylim(len(bars) - 0.5, -0.5)
    axes.set_xlim(0, 100)
    axes.tick_params(length=0)
    axes.set_xticks([0, 50, 100], ["0", "50", "100 %"])
    axes.spines["left"].set_visible(False)


def failure_bars(title: str, bars: Sequence[tuple[str, Mapping[str, int]]]) -> str:
    """A method's outcomes by split as SVG, without a legend."""
    with style(page=True):
        figure = make_figure(3.4, 0.55 + 0.24 * len(bars))
        axes = figure.add_subplot()
        _bars(axes, bars)
        axes.set_title(title)
        words = "; ".join(
            f"{label}: " + ", ".join(f"{WORDS[o]} {n}" for o, n in counts.items() if n)
            for label, counts in bars
        )
        return svg(figure, f"{title}. {words}")


def ridges(
    title: str, series: Mapping[str, Histogram], *, scale: float, unit: str, zero: bool = False
) -> str:
    """A ridge for each method over one axis as SVG, scaled to its highest bin; `zero` marks 0."""
    known = {name: h for name, h in series.items() if h.counts.sum()}
    if not known:
        return ""
    with style(page=True):
        figure = make_figure(3.4, 0.75 + 0.34 * len(known))
        axes = figure.add_subplot()
        for row, (_, h) in enumerate(known.items()):
            x = scale * (h.edges[:-1] + h.edges[1:]) / 2
            height = 0.85 * h.counts / h.counts.max()
            look: Any = {"step": "mid", "color": RIDGE, "alpha": 0.75, "linewidth": 0}
            axes.fill_between(x, row, row - height, **look)
            axes.axhline(row, color=FAINT, linewidth=0.6, zorder=0)
        if zero:
            axes.axvline(0, color=INK, linewidth=0.8, linestyle=(0, (3, 3)))
        axes.set_yticks(range(len(known)), list(known))
        axes.set_ylim(len(known) - 0.8, -1.0)
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        axes.set_xlabel(unit)
        axes.set_title(title)
        counted = ", ".join(f"{name} {int(h.counts.sum())} trials" for name, h in known.items())
        return svg(figure, f"{title}: {counted}")
