"""Table I of a run: its columns and notes, and the text of it as Markdown, LaTeX, CSV or JSON; also
object by object."""

import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from math import floor, log10
from pathlib import Path
from typing import Any

from r2h_batch.config import ExecutionError, ObjectErrors
from r2h_batch.report.picks import pick_rates
from r2h_batch.report.statistics import breakdown
from r2h_batch.report.statistics.aggregate import (
    ASKED_FAILURES,
    FAILURES,
    PARTIAL,
    TIMES,
    Rate,
    Row,
    summarise,
)
from r2h_batch.report.statistics.common import complete
from r2h_batch.report.statistics.few import FEW
from r2h_batch.report.statistics.paired import BOUNDS
from r2h_batch.report.statistics.shares import (
    PICK,
    SHARES,
    THROUGH,
    Share,
)
from r2h_batch.report.statistics.tally import Tally, tally
from r2h_batch.report.text import (
    NA,
    NOTE,
    aligned,
    csv_text,
    json_text,
    legend,
    notes_list,
    plain,
    short_digests,
    short_names,
    tex,
    tex_cell,
    tex_comments,
    tex_number,
    tex_table,
)
from r2h_batch.report.trained import sentences
from r2h_batch.report.turn import MARK, Turned, about, turned
from r2h_batch.runs.header import motions_left_out
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import ELSEWHERE, IN_ORDER, NO_LONGER, SPLITS, UNITS, CriterionEntry

FORMATS = ("md", "latex", "csv", "json")

HEADINGS = {
    "sr": "SR",
    "t_plan_s": "T_plan",
    "t_exec_s": "T_exec",
    "t_tot_s": "T_tot",
    **{rate: entry.heading for rate, entry in FAILURES.items()},
}
"""Table I's columns in its order."""

_SKIPPED = " and ".join(
    f"{split}'s {entry.heading}"
    for split in SPLITS
    for entry in FAILURES.values()
    if split not in entry.splits
)

FOOTNOTES = (
    "SR and F_*: percent of all N planned trials of the split; a trial counts once, at its first failure in the order"
    " {0}. With invalid and missing they add up to 100.",
    "T_plan: a batch's planning time divided by its trials, so no latency; the method's own time is not in it. T_exec: mean"
    " over the trials whose arm came to rest at its goal. T_tot is their sum. A table below counts the trials of each.",
    f"Avg: mean of the two splits, {_SKIPPED} (not evaluated) taken as 0.",
    "Presented (information only, no part of SR): percent of S1's trials, failed ones too, in which the receiver's region faces"
    " the palm and is in reach. Facing: within 90 degrees, seen from the TCP. In reach: within the ball's radius.",
    "Intervals: 95 %. One is for more trials with these objects (Wilson; MOVER in Avg). The object-clustered one (t, of log"
    " odds) is for the mean of all objects of the same kind.",
)

CATEGORY_NOTE = (
    "SR new cat.: the category-clustered interval, about the mean of all categories of objects. SR new obj. takes the objects"
    " for independent, and those of one category are not."
)
FEW_NOTE = (
    "SR of {0} new: the prediction interval. It says where the mean of {0} {1} lies that you bring (of each split; Avg: of both)."
    " Read it for your own things, and the interval for all to say what a method is worth."
)


ASKED_FOR = (PICK,)
"""Shares without a column in tables that have none: of methods that are told the truth."""

BEST_NOTE = (
    "Bold: best rate of a split whose methods all answered the same trials and were judged alike; of a failure only where no"
    " other method brings more trials to that criterion. It does not say that the difference is more than chance: r2h-batch"
    " compare does. Bounds (random, oracle), times of a machine, and means over the trials that moved, are never best."
)


@dataclass(frozen=True)
class Table:
    """Content of a report.

    Attributes:
        rows: lines of the table in order.
        origin: where the rows come from: protocol, digest, preset, device, ...
        alike: whether all methods were asked the trials of one plan and judged the same.
        misses: what the inverse kinematics of each robot without a closed form misses, and which
            motions of a file are not judged, a sentence each.
        turns: turn tests of the methods that have one (`turn.turned`).
        scans: the lines of the same methods on the reader's own objects, by split and method.
        bounds: methods that are bounds (random, oracle): none of their cells is best.
        trained: what methods that learned were trained on, a sentence each.
    """

    rows: tuple[Row, ...]
    origin: Mapping[str, str]
    alike: bool = True
    misses: tuple[str, ...] = ()
    turns: tuple[Turned, ...] = ()
    scans: Mapping[tuple[str, str], Row] = field(default_factory=dict)
    bounds: tuple[str, ...] = ()
    trained: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines under the table."""
        marks = (test.sentence for test in self.turns if test.marked)
        own = [
            f"{row.split} {row.method}: {row.n_objects} objects, {row.n} trials, {cell(row, 'sr')} ({interval(sr_of_scans(row))})"
            for row in self.scans.values()
        ]
        scans = [f"SR scans, and its 95 % interval for new objects like these: {'; '.join(own)}."]
        families = [CATEGORY_NOTE] if self.families else []
        families += [FEW_NOTE.format(self.few, self.new)]
        return (
            _first_failure(self.failures),
            *FOOTNOTES[1:],
            *map(self._partial, PARTIAL),
            *families,
            *(scans if own else []),
            *self.misses,
            *self._no_longer(),
            *self.trained,
            *marks,
        )

    def _no_longer(self) -> Iterator[str]:
        """A sentence about the rows that failed what nobody judges by any more."""
        for name in NO_LONGER:
            for method in dict.fromkeys(row.method for row in self.rows):
                own = [row for row in self.rows if row.method == method and row.split in SPLITS]
                if lost := sum(row.counts[name] for row in own):
                    of = f"{lost} of {sum(row.n for row in own)} rows of {method}"
                    yield f"{of} failed {name.capitalize()}, by which r2h_batch 0.3 judged: failures without a column here."

    @property
    def failures(self) -> dict[str, CriterionEntry]:
        """Rate of first failures -> its criterion, in the order of the columns: also of what the benchmark asks for."""
        asked = {
            c: e for c, e in ASKED_FAILURES.items() if any(c in row.rates for row in self.rows)
        }
        return FAILURES | asked

    @property
    def headings(self) -> dict[str, str]:
        """Columns of Table I in their order."""
        return HEADINGS | {rate: entry.heading for rate, entry in self.failures.items()}

    @property
    def shares(self) -> dict[str, Share]:
        """The shares that at least one line has."""
        return {
            name: SHARES[name] for name in SHARES if any(name in row.shares for row in self.rows)
        }

    def _partial(self, rate: str) -> str:
        """Which trials the rate of a criterion for some objects is of."""
        known = [(row, own) for row in self.rows if (own := row.rates[rate]) and own.total]
        n = "; ".join(f"{row.split} {row.method} {own.total}" for row, own in known) or "none"
        entry = PARTIAL[rate]
        unit = UNITS[entry.unit].shown
        return (
            f"{entry.heading}: percent of the trials whose object the criterion concerns ({n}), so no part of that sum;"
            f" Avg: mean of the splits that have such objects. Its margins are in {unit}."
        )

    @property
    def new(self) -> str:
        """The things that a prediction interval is about, in words."""
        return "new categories" if self.families else "new objects"

    @property
    def few(self) -> int:
        """New categories whose mean the prediction intervals speak about."""
        return self.rows[0].few if self.rows else FEW

    def turn_of(self, row: Row) -> Turned | None:
        """The turn test of a line, where its method has one."""
        key = (row.method, "all" if row.split == "Avg" else row.split)
        return next((t for t in self.turns if (t.method, t.group) == key), None)

    def mark(self, row: Row) -> str:
        """The mark behind a method's name where a turn moves its SR by too much."""
        test = self.turn_of(row)
        return f" {MARK}" if test and test.marked else ""

    @property
    def families(self) -> bool:
        """Whether categories have several objects."""
        return any(row.n_categories < row.n_objects for row in self.rows)


def table_of(
    run: Run,
    counted: Sequence[Tally] | None = None,
    *,
    alike: bool = True,
    scans: Run | None = None,
    few: int = FEW,
) -> Table:
    """The table of every complete method of a run folder.

    Args:
        run: what `load_run` or `join` gives.
        counted: these methods' trials, if they were counted before.
        alike: of joined runs, whether they were judged the same (`next_commands.judged_alike`).
        scans: a run of the same methods on the reader's own objects, for a column beside SR.
        few: new categories whose mean the prediction intervals speak about.

    Raises:
        ValueError: the run of the scans was judged by another configuration, or has none of the methods.
    """
    tallies = [tally(run, method) for method in run.methods] if counted is None else counted
    runs = run.runs
    robots = any("robot" in r.header["digests"] for r in runs)  # else all have the usual one
    named = [(r, {"robot": r.robot} if robots else {}) for r in runs]
    origin = _joined([(r.folder.absolute().name, robot | _origin(r.header)) for r, robot in named])
    configurations = [r.header["configuration"] for r in runs]
    averages = {str(c.get("averages", "trials")) for c in configurations}
    rows = summarise(tallies, "objects" if averages == {"objects"} else "trials", few)
    if all((c.get("plan") or {}).get("edge_check") != "moveit" for c in configurations):
        rows = tuple(_without(row, THROUGH) for row in rows)  # certified paths meet nothing
    rates = pick_rates(run)
    rows = tuple(
        replace(row, shares={**row.shares, PICK: rates[row.split, row.method]})
        if (row.split, row.method) in rates
        else row
        for row in rows
    )
    misses = dict.fromkeys(filter(None, (_misses(r.header) for r in runs)))
    planned = (
        line for r in runs for line in motions_left_out(r.header.get("motions_left_out", {}))
    )
    misses |= dict.fromkeys(planned)
    beside = {} if scans is None else _beside(run, scans)
    bounds = tuple(e.name for e in run.entries if e.source.get("function") in BOUNDS)
    return Table(
        rows,
        origin,
        alike,
        tuple(misses),
        turned(run),
        beside,
        bounds,
        sentences(run),
    )


def _without(row: Row, share: str) -> Row:
    return replace(row, shares={k: rate for k, rate in row.shares.items() if k != share})


def _beside(run: Run, scans: Run) -> dict[tuple[str, str], Row]:
    """The lines of the run's methods in a run of the reader's own objects."""
    words = f"{scans.folder} is no run of your scans for {run.folder}"
    if any(o["built_in"] for o in scans.header.get("objects", ())):
        raise ValueError(
            f"{words}: it has built-in objects; sweep with --objects FOLDER of your meshes"
        )
    asked = [
        {**r.header, "configuration": complete(r.header["configuration"])} for r in (run, scans)
    ]
    for key in ("configuration", "seed", "predictors"):
        if asked[0].get(key) != asked[1].get(key):
            raise ValueError(f"{words}: it has another {key}; sweep with the same options")
    methods = [name for name in run.methods if name in scans.methods]
    if not methods:
        raise ValueError(f"{words}: it has none of its methods; sweep the same --method")
    return {(r.split, r.method): r for r in summarise([tally(scans, m) for m in methods])}


def _misses(header: Mapping[str, Any]) -> str:
    """Miss rate of a robot's numerical inverse kinematics, as its import measured it; empty for a
    closed form or an older run."""
    robot = header.get("robot") or {}
    targets, missed = robot.get("ik_missed") or (0, 0)
    if not targets:
        return ""
    return (
        f"Inverse kinematics of {robot['name']}: numerical; of {targets:,} random reachable poses it misses {missed:,}"
        f" ({100 * missed / targets:.3g} %). A trial whose target is missed fails Plan (ik_not_found)."
    )


BY_DEFAULT = {
    "benchmark": "the protocol's own",
    "paths planned against": "the true hand",
    "grasp candidates": "filtered",
    "execution error": "none",
    "averages": "trials of a split count the same",
}
"""Choices that `_origin` leaves out of a run, by its keys: a table names them beside a run that made another one."""


def _joined(origins: Sequence[tuple[str, Mapping[str, str]]]) -> dict[str, str]:
    """Where rows of several runs come from: once what is the same, else run by run."""
    joined = {}
    for key in dict.fromkeys(key for _, origin in origins for key in origin):
        values = [(name, origin.get(key, BY_DEFAULT.get(key, NA))) for name, origin in origins]
        same = len({value for _, value in values}) == 1
        joined[key] = values[0][1] if same else "; ".join(f"{n}: {v}" for n, v in values)
    return joined


def _origin(header: Mapping[str, Any]) -> dict[str, str]:
    """Origin of the rows, from run.json."""
    configuration = header["configuration"]
    origin = {
        "preset": str(configuration.get("name", "custom")),
        "protocol": str(header["protocol"]),
        **_instances(header),
        "trials": ", ".join(f"{n} {split}" for split, n in header["trials"].items()),
        "trials digest": str(header["digests"]["trials"]),
        "device": str(header["device"]["name"]),
        "r2h_batch": str(header["versions"]["r2h_batch"]),
    }
    if flags := (header.get("benchmark") or {}).get("flags"):
        digest = header["digests"].get("benchmark", "unknown")
        words = (Path(w).name if Path(w).is_absolute() else w for w in " ".join(flags).split())
        origin["benchmark"] = f"{' '.join(words)}, digest {digest}"
    if "motion" in header:
        origin["motion"] = str(header["motion"]["engine"]).replace("none", "as planned")
    if "predictors" in header:
        origin["predictor noise"] = f"{header['predictors']['noise_factor']:g}"
    if (sees := header.get("sees")) is not None:
        origin["methods see"] = (
            f"{sees['rig']}, digest {sees['rig_digest']}, noise {sees['noise']:g}, labels {sees['labels']}, object"
            f" {sees['object']}, seed {sees['seed']}{', region told' if 'region' in sees else ''}"
        )
    # what methods and planner know, where it differs from the default
    if (hand := (configuration.get("plan") or {}).get("hand", "true")) != "true":
        origin["paths planned against"] = f"the {hand} hand"
    if (candidates := configuration.get("candidates", "filtered")) != "filtered":
        origin["grasp candidates"] = str(candidates).replace("-", " ")
    for section, kind in (("execution_error", ExecutionError), ("object_errors", ObjectErrors)):
        if (error := configuration.get(section, none := asdict(kind()))) != none:
            origin[section.replace("_", " ")] = ", ".join(f"{k} {v}" for k, v in error.items() if v)
    if (averages := configuration.get("averages", "trials")) != "trials":
        origin["averages"] = f"{averages} of a split count the same"
    return origin


def _instances(header: Mapping[str, Any]) -> dict[str, str]:
    """How many instances of how many families the objects are, and the digest of their list."""
    families = [o["category"] for o in header.get("objects", ()) if "category" in o]
    if not families:
        return {}
    number = f"{len(families)} of {len(set(families))} families"
    return {"instances": f"{number}, digest {header['digests'].get('objects', 'unknown')}"}


def render(table: Table, fmt: str, *, columns: int = 2, intervals: bool = False) -> str:
    """The table as text that ends in a newline.

    Args:
        table: what `table_of` gives.
        fmt: one of `FORMATS`.
        columns: LaTeX: all of Table I over both columns of a page (2), or SR alone in one (1).
        intervals: LaTeX: 95 % intervals below the rates. The other formats always have them.

    Raises:
        ValueError: if the format or number of columns does not exist.
    """
    if fmt == "md":
        return _md(table)
    if fmt == "latex":
        return _latex(table, columns, intervals)
    if fmt == "csv":
        origin = {k.replace(" ", "_"): v for k, v in table.origin.items()}
        return csv_text([_with_more(table, row) | origin for row in table.rows])
    if fmt == "json":
        rows = [_with_more(table, row) for row in table.rows]
        content = {"format": 1, "origin": dict(table.origin), "rows": rows, "notes": table.notes}
        more = {"turns": about(table.turns)} if table.turns else {}
        return json_text(content | more)
    raise ValueError(f"unknown format {fmt!r}; allowed are {', '.join(FORMATS)}")


def cell(row: Row, column: str) -> str:
    """One cell of Table I: rates with one decimal, seconds with two, or two digits below 0.1 s:
    amortised planning takes less than a millisecond."""
    if column not in TIMES:
        rate = row.rates.get(column)
        return NA if rate is None else f"{rate.percent:.1f}"
    if (value := row.times[column].value) is None:
        return NA
    decimals = 2 if value >= 0.1 or value == 0 else 1 - floor(log10(value))
    return f"{value:.{decimals}f}"


def invalid(row: Row) -> int:
    """Trials of a line that could not be judged."""
    return row.counts["invalid_input"] + row.counts["invalid_sim"]


def interval(rate: Rate | None) -> str:
    """`LOW-HIGH` in percent."""
    return NA if rate is None else f"{rate.low:.1f}-{rate.high:.1f}"


def best_cells(table: Table) -> set[tuple[str, str, str]]:
    """Which cells are bold.

    Only rates can be, and only where all methods answered the same trials and were judged alike: a preset is no
    method. T_plan depends on the machine, and T_exec is a mean over the trials that moved. A bound is no method either.
    A trial counts at its first failure, so a method that loses more of them earlier has fewer left to fail later: the
    lowest rate of a failure is best only where no other method brings more trials to that criterion.

    Returns:
        (split, method, column) of the best printed rate of each split, ties included; none where
        all are equal.
    """
    best: set[tuple[str, str, str]] = set()
    if not table.alike:
        return best
    for split in dict.fromkeys(row.split for row in table.rows):
        rows = [r for r in table.rows if r.split == split]
        same = len({r.n for r in rows}) == 1
        rows = [r for r in rows if r.method not in table.bounds]
        for column in (c for c in table.headings if c not in TIMES):
            printed = {r.method: cell(r, column) for r in rows}
            values = {method: float(text) for method, text in printed.items() if text != NA}
            if len(set(values.values())) > 1 and same:
                top = (max if column == "sr" else min)(values.values())
                lost = {r.method: 0.0 if column == "sr" else _lost_before(r, column) for r in rows}
                least = min(lost.values())
                best |= {
                    (split, method, column)
                    for method, v in values.items()
                    if v == top and lost[method] <= least
                }
    return best


def _lost_before(row: Row, column: str) -> float:
    """Percent of the trials that a method loses before the criterion of a failure: its earlier failures, and what was not
    judged; as printed, to a tenth."""
    order = [entry.rate for entry in IN_ORDER]
    rates = (row.rates.get(c) for c in ("sr", *order[order.index(column) :]))
    return round(100.0 - sum(0.0 if r is None else r.percent for r in rates), 1)


def sr_of_scans(row: Row) -> Rate | None:
    """SR on the reader's own objects with its interval for new ones; of one object for more trials with it."""
    return row.sr_new_categories or row.rates["sr"]


def _scans(table: Table, row: Row) -> Row | None:
    return table.scans.get((row.split, row.method))


def _with_more(table: Table, row: Row) -> dict[str, Any]:
    """A record, with SR on the reader's own objects and the turn test where the table has them."""
    found = record(row)
    ends: tuple[float | None, ...]
    for name in ASKED_FOR:
        if name in table.shares and name not in row.shares:  # a line of averages
            found |= {name: None, f"{name}_low": None, f"{name}_high": None}
    if table.scans:
        rate = sr_of_scans(own) if (own := _scans(table, row)) else None
        ends = (rate.percent, rate.low, rate.high) if rate else (None, None, None)
        found |= dict(zip(("sr_scans", "sr_scans_low", "sr_scans_high"), ends, strict=True))
    if table.turns:
        test = table.turn_of(row)
        most = None if test is None else test.most
        ends = (most.points, most.low, most.high) if most else (None, None, None)
        found |= dict(zip(("turn", "turn_low", "turn_high"), ends, strict=True))
        found["turn_marked"] = None if test is None else test.marked
    return found


def _share(row: Row, name: str) -> list[str]:
    rate = row.shares.get(name)
    return [f"{rate.percent:.1f}", interval(rate), str(rate.total)] if rate else []


def _new_ones(row: Row, families: bool) -> list[str]:
    new = [interval(row.sr_new_objects), *([interval(row.sr_new_categories)] if families else [])]
    return [cell(row, "sr"), *new, interval(row.sr_few)]


def _counts(row: Row) -> list[str]:
    n_plan, n_exec = row.times["t_plan_s"].count, row.times["t_exec_s"].count
    cells = [row.n, n_plan, n_exec, cell(row, "t_method_s"), invalid(row), row.counts["missing"]]
    return [*map(str, cells)]


def brief(table: Table) -> str:
    """The short table that a sweep prints: success and first failures, where the rows come from, what must be known about them.
    `render` has the other intervals, counts, times and shares with their notes."""
    rates = [c for c in table.headings if c not in TIMES and c != "sr"]
    short = short_names([row.method for row in table.rows])
    head = [
        "Split",
        "Method",
        "SR",
        "95 %",
        f"{table.few} new",
        *(table.headings[c] for c in rates),
    ]
    lines = [
        [
            *(row.split, plain(short[row.method]) + table.mark(row), cell(row, "sr")),
            *(interval(row.rates["sr"]), interval(row.sr_few)),
            *(cell(row, c) for c in rates),
        ]
        for row in table.rows
    ]
    origin = "; ".join(f"{key}: {short_digests(value)}" for key, value in table.origin.items())
    notes = [
        _first_failure(table.failures),
        f"95 %: the interval of SR for more trials with these objects. {table.few} new: where the mean of {table.few}"
        f" {table.new} lies that you bring, with 95 %.",
        *map(plain, legend(short)),
        *table.misses,
        *map(plain, table.trained),
        *(test.sentence for test in table.turns if test.marked),
    ]
    return (
        "\n\n".join(
            [
                aligned(head, lines, 2),
                textwrap.fill(origin, NOTE, break_long_words=False, break_on_hyphens=False),
                notes_list(notes),
            ]
        )
        + "\n"
    )


def _first_failure(failures: Mapping[str, CriterionEntry]) -> str:
    """The note on SR and first failures."""
    order = ", ".join(e.name.capitalize() for e in IN_ORDER if e.rate in failures)
    return FOOTNOTES[0].format(order)


def _md(table: Table) -> str:
    columns = table.headings
    rates = [c for c in columns if c not in TIMES]
    short = short_names([row.method for row in table.rows])
    more = ["SR scans"] if table.scans else []
    sections: list[tuple[str, Sequence[str], Callable[[Row], list[str]]]] = [
        (
            "Rates in percent, times in seconds.",
            [*columns.values(), *more],
            lambda row: [
                *(cell(row, c) for c in columns),
                *(_sr_cells(table, row) if more else ()),
            ],
        ),
        (
            "95 % intervals of the rates (Wilson; Avg: MOVER).",
            [columns[c] for c in rates],
            lambda row: [interval(row.rates.get(c)) for c in rates],
        ),
        (
            "95 % intervals of SR for new things.",
            [
                *("SR", "SR new obj.", *(["SR new cat."] if table.families else [])),
                f"SR of {table.few} new",
            ],
            lambda row: _new_ones(row, table.families),
        ),
        (
            "Counts, and T_method, the method's own time per trial.",
            ["N", "n T_plan", "n T_exec", "T_method", "invalid", "missing"],
            _counts,
        ),
        *(
            (share.caption, [share.heading, "95 %", "of"], partial(_share, name=name))
            for name, share in table.shares.items()
        ),
    ]
    parts = ["  \n".join(f"{key}: {short_digests(value)}" for key, value in table.origin.items())]
    for caption, headings, cells_of in sections:
        cells = [(row, cells_of(row)) for row in table.rows]
        lines = [
            [row.split, plain(short[row.method]) + table.mark(row), *line]
            for row, line in cells
            if line
        ]
        if lines:
            parts += [caption, aligned(["Split", "Method", *headings], lines, 2)]
    notes = (
        plain(n) if n in table.trained else n for n in table.notes
    )  # a method's own words are a stranger's
    parts.append(notes_list([*map(plain, legend(short)), *notes]))
    return "\n\n".join(parts) + "\n"


def _sr_cells(table: Table, row: Row) -> list[str]:
    own = _scans(table, row)
    return [cell(own, "sr") if own else NA]


def record(row: Row) -> dict[str, Any]:
    """One flat row: every number of the table under its own name, None where nothing is defined."""

    def with_ends(name: str, rate: Rate | None) -> dict[str, float | None]:
        percent, low, high = (rate.percent, rate.low, rate.high) if rate else (None, None, None)
        return {name: percent, f"{name}_low": low, f"{name}_high": high}

    fields: dict[str, Any] = {"split": row.split, "method": row.method}
    fields |= {"n": row.n, "n_objects": row.n_objects, "n_categories": row.n_categories}
    for name in row.rates:
        fields |= with_ends(name, row.rates[name])
        if name in PARTIAL:
            own = row.rates[name]
            fields[f"{name}_of"] = own.total if own else None
    for what, clustered in (("objects", row.sr_new_objects), ("categories", row.sr_new_categories)):
        fields |= with_ends(f"sr_new_{what}", clustered)
        del fields[f"sr_new_{what}"]  # it is "sr"
    few = with_ends("sr_few", row.sr_few)
    del few["sr_few"]
    fields |= {"few": row.few} | few
    for name in SHARES:
        if name not in ASKED_FOR or name in row.shares:
            fields |= with_ends(name, row.shares.get(name))
    for name in TIMES:
        fields |= {name: row.times[name].value, f"{name}_n": row.times[name].count}
    others = {entry.name for rate, entry in ASKED_FAILURES.items() if rate not in row.rates}
    others |= {name for name in (*NO_LONGER, ELSEWHERE) if not row.counts[name]}
    return fields | {f"n_{name}": n for name, n in row.counts.items() if name not in others}


def _latex(table: Table, columns: int, intervals: bool) -> str:
    if columns not in (1, 2):
        raise ValueError(f"--columns is {columns}; a page has 1 or 2")
    short = short_names([row.method for row in table.rows])
    counts = [
        f"{row.split} {short[row.method]}: N {row.n}, T_plan over {row.times['t_plan_s'].count}, T_exec over"
        f" {row.times['t_exec_s'].count}, invalid {invalid(row)}, missing {row.counts['missing']}, SR of new objects"
        f" {interval(row.sr_new_objects)}"
        f"{f', of new categories {interval(row.sr_new_categories)}' if table.families else ''}"
        f", of the mean of {row.few} new ones {interval(row.sr_few)}"
        for row in table.rows
    ]
    of = [
        f"{share.heading}: {share.caption} Of: "
        + "; ".join(
            f"{r.split} {short[r.method]} {r.shares[k].total}" for r in table.rows if k in r.shares
        )
        for k, share in table.shares.items()
    ]
    origin = "; ".join(f"{key}: {value}" for key, value in table.origin.items())
    bold = [BEST_NOTE] if best_cells(table) else []
    comments = tex_comments(
        {}, [origin, *legend(short), "; ".join(counts), *of, *bold, *table.notes]
    )
    write = _wide if columns == 2 else _narrow
    return "\n".join([*comments, *write(table, short, intervals)]) + "\n"


def _ends(rate: Rate | None) -> str:
    return rf"{{\scriptsize [{rate.low:.1f}, {rate.high:.1f}]}}" if rate else ""


def _wide(table: Table, short: Mapping[str, str], intervals: bool) -> list[str]:
    best, headings = best_cells(table), table.headings
    groups: dict[str, list[str]] = {}
    for row in table.rows:
        n = {r.n for r in table.rows if r.split == row.split}
        size = f"$N={row.n}$" if len(n) == 1 else "$N$ in brackets"
        heading = rf"\multicolumn{{{1 + len(headings) + len(table.shares)}}}{{@{{}}l}}{{{row.split}, {size}}} \\"
        lines = groups.setdefault(row.split, [heading])
        values = [tex_cell(cell(row, c), bold=(row.split, row.method, c) in best) for c in headings]
        name = tex(short[row.method] + table.mark(row)) + (f" ({row.n})" if len(n) > 1 else "")
        values += [
            tex_cell(f"{s.percent:.1f}" if (s := row.shares.get(k)) else NA) for k in table.shares
        ]
        lines.append(" & ".join([name, *values]) + r" \\")
        if intervals:
            ends = (
                *(_ends(row.rates.get(c)) for c in headings),
                *(_ends(row.shares.get(k)) for k in table.shares),
            )
            lines.append(" & ".join(["", *ends]) + r" \\[2pt]")
    decimals = max([len(cell(r, "t_plan_s").partition(".")[2]) for r in table.rows], default=2)
    sizes = [
        (3, 1) if c not in TIMES else (2, decimals if c == "t_plan_s" else 2) for c in headings
    ]
    sizes += [(3, 1)] * len(table.shares)
    spec = ["l", *(tex_number(*size) for size in sizes)]
    times, failures = (sum(c in of for c in headings) for of in (TIMES, table.failures))
    first_failure = 3 + times  # the method and SR stand before the times
    first_share, shares = first_failure + failures, len(table.shares)
    over = rf" & \multicolumn{{{shares}}}{{c}}{{Share (\%)}}" if shares else ""
    under = rf"\cmidrule(l){{{first_share}-{first_share + shares - 1}}}" if shares else ""
    top = [
        rf" & {{SR}} & \multicolumn{{{times}}}{{c}}{{Time (s)}}"
        rf" & \multicolumn{{{failures}}}{{c}}{{First failure (\%)}}{over} \\",
        rf"\cmidrule(lr){{3-{first_failure - 1}}}"
        rf"\cmidrule(l{'r' if shares else ''}){{{first_failure}-{first_share - 1}}}{under}",
    ]
    names = {c: h.partition("_")[2] for c, h in headings.items()} | {"sr": r"(\%)"}
    head = ["Method", *(f"{{{n}}}" for n in names.values())]
    head += [f"{{{tex(share.heading)}}}" for share in table.shares.values()]
    return tex_table(spec, head, groups.values(), top)


def _narrow(table: Table, short: Mapping[str, str], intervals: bool) -> list[str]:
    best = best_cells(table)
    splits = list(dict.fromkeys(row.split for row in table.rows))
    rows = {(row.method, row.split): row for row in table.rows}
    lines = []
    for method, name in short.items():
        own = [rows.get((method, s)) for s in splits]
        values = [
            tex_cell(cell(r, "sr") if r else NA, bold=(s, method, "sr") in best)
            for s, r in zip(splits, own)
        ]
        lines.append(" & ".join([tex(name), *values]) + r" \\")
        if intervals:
            lines.append(
                " & ".join(["", *(_ends(r.rates["sr"] if r else None) for r in own)]) + r" \\[2pt]"
            )
    sizes = {s: sorted({r.n for r in table.rows if r.split == s}) for s in splits}
    n = [f"{{{k[0]}}}" if len(k) == 1 else f"{{{k[0]}--{k[-1]}}}" for k in sizes.values()]
    spec = ["l", *[tex_number(3, 1)] * len(splits)]
    top = [
        rf" & \multicolumn{{{len(splits)}}}{{c}}{{Success (\%)}} \\",
        rf"\cmidrule(l){{2-{len(splits) + 1}}}",
        " & ".join(["", *(f"{{{s}}}" for s in splits)]) + r" \\",
    ]
    return tex_table(spec, ["Method, $N$", *n], [lines], top)


def object_lines(run: Run, fmt: str = "md") -> str:
    """Every method's rates for every object.

    Args:
        run: what `load_run` gives.
        fmt: md, csv or json. Markdown also says which criteria fail together.
    """
    counted = [tally(run, method) for method in run.methods]
    lines = [line for t in counted for line in breakdown.by_object(t)]
    if fmt == "md":
        return _objects_md(counted, lines)
    records = [{"object": name} | record(row) for name, row in lines]
    if fmt == "csv":
        return csv_text(records)
    if fmt == "json":
        origin = dict(table_of(run, counted=counted).origin)
        return json_text({"format": 1, "origin": origin, "rows": records})
    raise ValueError(f"no table of objects in format {fmt!r}; allowed are md, csv, json")


def _objects_md(counted: Sequence[Tally], lines: Sequence[tuple[str, Row]]) -> str:
    names = short_names([t.method for t in counted])
    short = {method: plain(name) for method, name in names.items()}
    headings = Table(tuple(row for _, row in lines), {}).headings
    shown = [c for c in headings if c not in TIMES]
    rows = []
    for name, row in lines:
        cells = [*(cell(row, c) for c in shown), interval(row.rates["sr"])]
        rows.append([row.split, name, short[row.method], str(row.n), *cells])
    head = ["Split", "Object", "Method", "N", *(headings[c] for c in shown), "SR 95 %"]
    parts = [aligned(head, rows, 3)]
    if shortened := legend(names):
        parts.append(notes_list(map(plain, shortened)))
    for t in counted:
        for split in t.splits:
            both = breakdown.co_failures(t, split)
            pairs = [
                [c, *(f"{f}/{e}" if e else NA for f, e in zip(failed, evaluated))]
                for c, failed, evaluated in zip(t.judged, both.failed, both.evaluated)
            ]
            parts += [
                f"{short[t.method]}, {split}: trials that fail both / in which both were evaluated.",
                aligned(["", *t.judged], pairs, 1),
            ]
    return "\n\n".join(parts) + "\n"
