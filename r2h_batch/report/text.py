"""Words of tables: short names of methods, shares of rows, digests."""

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from r2h_batch.base.registry import benchmark_in_words
from r2h_batch.base.table import NOTE, notes_list
from r2h_batch.report.statistics.aggregate import Rate, rate_of

SHORT = 16
"""Characters of a short method name: `Contact-Handover` has as many."""
SHORT_FOLDER = 9
"""Characters of its run's folder, where that stands before it: `baselines` has as many."""


def short_names(methods: Sequence[str]) -> dict[str, str]:
    """Shorten the names of methods for tables.

    A name first loses what it says in brackets (the stand-in of a network, the noise), then its
    middle; a run's folder before it loses its end. If it then equals another one, it gets a number.

    Args:
        methods: names; one may stand there several times.

    Returns:
        Full name -> a name of at most `SHORT` characters, or FOLDER/NAME with at most `SHORT_FOLDER` for the folder.
        All short names differ.
    """
    names: dict[str, str] = {}
    for method in dict.fromkeys(methods):
        plain_name = method.partition(" (")[0].strip() or method
        folder, slash, own = (
            plain_name.rpartition("/") if len(plain_name) > SHORT else ("", "", plain_name)
        )
        before = (
            folder if len(folder) <= SHORT_FOLDER else f"{folder[: SHORT_FOLDER - 2]}.."
        ) + slash
        short = before + (own if len(own) <= SHORT else f"{own[:9]}..{own[-5:]}")
        for number in range(2, len(methods) + 2):
            if short not in names.values():
                break
            short = f"{before}{own[: SHORT - 1 - len(str(number))]}#{number}"
        names[method] = short
    return names


def legend(names: Mapping[str, str]) -> list[str]:
    """`short: full name` of every name that was shortened."""
    return [f"{short}: {method}" for method, short in names.items() if short != method]


_SAID = {"protocol": "benchmark", "benchmark": "benchmark flags"}


def in_words(origin: Mapping[str, str]) -> dict[str, str]:
    """Where rows come from, as text says it. CSV, JSON and stored files keep their keys."""
    named = {"protocol": benchmark_in_words(origin["protocol"])} if "protocol" in origin else {}
    return {_SAID.get(key, key): value for key, value in {**origin, **named}.items()}


def rate_fields(name: str, rate: Rate | None) -> dict[str, float | None]:
    """The values of a rate in a record: percent, and its interval under NAME_low and NAME_high; None without a rate."""
    percent, low, high = (rate.percent, rate.low, rate.high) if rate else (None, None, None)
    return {name: percent, f"{name}_low": low, f"{name}_high": high}


def hits_fields(name: str, hits: np.ndarray) -> dict[str, float | None]:
    """`rate_fields` of the share of the true ones, with its 95 % Wilson interval; None of none."""
    return rate_fields(name, rate_of(int(hits.sum()), len(hits)) if len(hits) else None)


def short_digests(text: str) -> str:
    """The text with the first 12 of the 64 digits of each sha256: run.json and the other formats have them all."""
    return re.sub(r"\b([0-9a-f]{12})[0-9a-f]{52}\b", r"\1", text)


MOST_LINES = 25
"""Lines that `report` and `compare` print of one question; `--full` has the rest."""
NOTE_LINES = 3


def few_notes(columns: str, known: Iterable[str], more: str) -> str:
    """At most `NOTE_LINES` lines: what the columns say, the first thing that must be known, and where the rest stands.

    Args:
        columns: a note of one line.
        known: what must be known about the rows, the first one first.
        more: what else there is, as `times and counts: r2h-batch report RUN --full`.
    """
    first, *others = [*known, ""]
    shown = [columns, *([textwrap.shorten(first, NOTE - 2, placeholder=" ...")] if first else [])]
    left = len(others) - 1
    notes = f"{left} more note{'s' if left > 1 else ''}, " if left > 0 else ""
    return notes_list([*shown, notes + more])
