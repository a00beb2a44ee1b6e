"""The same run object by object: Table I's columns of each, and which criteria fail together."""

from r2h_batch.report.table import HEADINGS, cell, interval
from r2h_batch.report.text import NA, aligned, plain
from r2h_batch.results.reading import Run
from r2h_batch.statistics import breakdown
from r2h_batch.statistics.tally import tally
from r2h_batch.verdicts import CRITERIA


def object_lines(run: Run) -> str:
    """Table I's columns for every method and object, and which criteria fail together, as Markdown."""
    lines, parts = [], []
    for method in run.methods:
        counted = tally(run, method, by_object=True)
        for name, row in breakdown.by_object(counted):
            ends = interval(row.rates["sr"])
            lines.append([row.split, name, plain(method), str(row.n), *(cell(row, c) for c in HEADINGS), ends])
        for split in counted.splits:
            counts = breakdown.co_failures(counted, split)
            pairs = [
                [c, *(f"{f}/{e}" if e else NA for f, e in zip(counts.failed[i], counts.evaluated[i]))]
                for i, c in enumerate(CRITERIA)
            ]
            parts += [
                f"{plain(method)}, {split}: trials that fail both / in which both were evaluated.",
                aligned(["", *CRITERIA], pairs, 1),
            ]
    headings = ["Split", "Object", "Method", "N", *HEADINGS.values(), "SR 95 %"]
    return "\n\n".join([aligned(headings, lines, 3), *parts]) + "\n"
