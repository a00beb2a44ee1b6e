"""Comparisons as Markdown that also reads as plain text."""

from collections.abc import Sequence

from r2h_batch.report.text import NA, aligned
from r2h_batch.statistics.paired import Comparison


def render(comparisons: Sequence[Comparison]) -> str:
    """The comparisons as Markdown that also reads as plain text."""
    parts = []
    for c in comparisons:
        parts.append(f"{c.group}: {c.n} trials, paired on the trial id")
        lines = [
            [
                pair.a,
                pair.b,
                f"{pair.difference:+.1f}",
                NA if pair.low is None or pair.high is None else f"{pair.low:+.1f} to {pair.high:+.1f}",
                str(pair.only_a),
                str(pair.only_b),
                f"{pair.p:.2g}",
                f"{pair.p_holm:.2g}",
                pair.verdict,
            ]
            for pair in c.pairs
        ]
        headings = ["A", "B", "SR A-B", "95 % new obj.", "only A", "only B", "McNemar p", "Holm p", "A is"]
        parts.append(aligned(headings, lines, 2))
        if c.rank is not None:
            ranks = [[f"{100 * p:.0f} %" for p in row] for row in c.rank]
            table = [[n, f"{r:.1f}", *cells] for n, r, cells in zip(c.names, c.rates, ranks)]
            parts.append(aligned(["Method", "SR", *(f"rank {i + 1}" for i in range(len(c.names)))], table, 1))
    parts.append(
        "- McNemar's exact test speaks about these objects; the interval of the difference in points and the ranks come\n"
        "  from drawing the objects again (10000 draws, percentiles) and speak about new ones. Holm: over all pairs.\n"
        "- better, worse: both decide. here: decided for these objects, not for new ones. tied: not decided."
    )
    return "\n\n".join(parts) + "\n"
