"""Table I of a run: its columns and notes, and the text of it as Markdown, LaTeX, CSV or JSON; also
object by object."""

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from math import floor, log10
from pathlib import Path
from typing import Any

from r2h_batch.base.registry import NOT_SAID, benchmark_in_words
from r2h_batch.base.table import (
    INTERVAL,
    NA,
    NOTE,
    PERCENT,
    Column,
    Record,
    Table,
    document,
    notes_list,
    of_lines,
    plain,
    tex,
)
from r2h_batch.config import PRESENTED_M, ExecutionError, ObjectErrors
from r2h_batch.report.picks import pick_rates
from r2h_batch.report.statistics import breakdown
from r2h_batch.report.statistics.aggregate import Rate, Row, rate_of, summarise
from r2h_batch.report.statistics.codes import never_judged
from r2h_batch.report.statistics.common import complete
from r2h_batch.report.statistics.few import FEW
from r2h_batch.report.statistics.paired import BOUNDS
from r2h_batch.report.statistics.rates import (
    ASKED_FAILURES,
    FAILURES,
    PARTIAL,
    PICK,
    PRESENTED,
    PRESENTED_BEFORE,
    RATES,
    THROUGH,
    TIMES,
    UPRIGHT,
    Share,
    shares,
)
from r2h_batch.report.statistics.tally import Tally, tally
from r2h_batch.report.text import (
    MOST_LINES,
    NOTE_LINES,
    few_notes,
    in_words,
    legend,
    rate_fields,
    short_digests,
    short_names,
)
from r2h_batch.report.trained import sentences
from r2h_batch.report.turn import MARK, Turned, about, turned
from r2h_batch.runs.header import motions_left_out
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import ELSEWHERE, IN_ORDER, NO_LONGER, SPLITS, UNITS, CriterionEntry

FORMATS = ("md", "latex", "csv", "json")

HEADINGS = {name: RATES[name].heading for name in ("sr", *TIMES[:3], *FAILURES)}
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


INVALID_NOTE = "invalid: count as failures; most often a matrix is no pose: r2h-batch why RUN TRIAL says which."

PRESENTED_NOTES = {
    PRESENTED: "Presented (information only, no part of SR): percent of the successes in which the wanted part (S0: the object)"
    f" is within the ball, and neither the gripper nor a sharp part is nearer to the palm by more than"
    f" {100 * PRESENTED_M['S0']:g} cm (S0) or {100 * PRESENTED_M['S1']:g} cm (S1).",
    PRESENTED_BEFORE: "Presented, before 0.4: what r2h_batch 0.3 stored under that name. It is no part of SR, and another"
    " question than Presented.",
}

OF_SUCCESSES = {PRESENTED: "Pres.", UPRIGHT: "Upright"}
"""Shares that the short table has, too, and their headings there."""

ASKED_FOR = (PICK, PRESENTED, PRESENTED_BEFORE)
"""Shares without a column in tables that have none: of methods that are told the truth, of what the benchmark judges by, of
rows of later versions."""

BEST_NOTE = (
    "Bold: best rate of a split whose methods all answered the same trials and were judged alike; of a failure only where no"
    " other method brings more trials to that criterion. It does not say that the difference is more than chance: r2h-batch"
    " compare does. Bounds (random, oracle), times of a machine, and means over the trials that moved, are never best."
)


@dataclass(frozen=True)
class Report:
    """Content of a report.

    Attributes:
        rows: lines of the table in order.
        origin: where the rows come from: benchmark (`protocol`), digest, preset, device, ...
        alike: whether all methods were asked the trials of one plan and judged the same.
        misses: what the inverse kinematics of each robot without a closed form misses, and which
            motions of a file are not judged, a sentence each.
        turns: turn tests of the methods that have one (`turn.turned`).
        scans: the lines of the same methods on the reader's own objects, by split and method.
        bounds: methods that are bounds (random, oracle): none of their cells is best.
        trained: what methods that learned were trained on, a sentence each.
        reads: method -> what it may read, a word of `READS`; empty where nobody says.
        unjudged: criteria that did not judge rows, or whose package is not installed, or for which one of several benchmarks
            does not ask, a sentence each.
    """

    rows: tuple[Row, ...]
    origin: Mapping[str, str]
    alike: bool = True
    misses: tuple[str, ...] = ()
    turns: tuple[Turned, ...] = ()
    scans: Mapping[tuple[str, str], Row] = field(default_factory=dict)
    bounds: tuple[str, ...] = ()
    trained: tuple[str, ...] = ()
    unjudged: tuple[str, ...] = ()
    reads: Mapping[str, str] = field(default_factory=dict)

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
            *(PRESENTED_NOTES[name] for name in PRESENTED_NOTES if name in self.shares),
            *map(self._partial, PARTIAL),
            *families,
            *(scans if own else []),
            *self.unjudged,
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
            name: share
            for name, share in shares().items()
            if any(name in row.shares for row in self.rows)
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
) -> Report:
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
    judged = {method for method in run.methods if PRESENTED in run.run_of(method).asks}
    rows = tuple(  # a column of first failures says it
        _without(row, PRESENTED) if row.method in judged else row for row in rows
    )
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
    return Report(
        rows,
        origin,
        alike,
        tuple(misses),
        turned(run),
        beside,
        bounds,
        sentences(run),
        _unjudged(run, rows),
        {e.name: e.reads for e in run.entries},
    )


def _unjudged(run: Run, rows: Sequence[Row]) -> tuple[str, ...]:
    """A sentence for each criterion of a package that came after rows were judged, or that is not installed any more, and for
    each run whose benchmark does not ask for what that of another one asks."""
    gone = [words for words in run.lacking if words.startswith("criterion ")]
    sentences_of = never_judged(run)
    for method in run.methods if gone else ():
        own = [row for row in rows if row.method == method and row.split in SPLITS]
        if lost := sum(row.counts[ELSEWHERE] for row in own):
            sentences_of.append(
                f"{lost} of {sum(row.n for row in own)} rows of {method} failed {' or '.join(gone)}, not installed here: SR"
                " counts them as failed."
            )
    for part in run.runs:
        if lacks := [name for name in run.asks if name not in part.asks]:
            of = f"{part.folder.absolute().name} ({benchmark_in_words(part.header['protocol'])})"
            sentences_of.append(f"{of} is not judged by {', '.join(lacks)}: compare no SR with it.")
    return tuple(dict.fromkeys(sentences_of))


def _without(row: Row, share: str) -> Row:
    return replace(row, shares={k: rate for k, rate in row.shares.items() if k != share})


def _beside(run: Run, scans: Run) -> dict[tuple[str, str], Row]:
    """The lines of the run's methods in a run of the reader's own objects."""
    _check_scans(run, scans)
    methods = [name for name in run.methods if name in scans.methods]
    return {(r.split, r.method): r for r in summarise([tally(scans, m) for m in methods])}


def _check_scans(run: Run, scans: Run) -> None:
    """Refuses a run that has not the same methods and options as `run`, or not the reader's own objects."""
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
    if not set(run.methods) & set(scans.methods):
        raise ValueError(f"{words}: it has none of its methods; sweep the same --method")


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
    "benchmark": "none",
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


def render(
    report: Report,
    fmt: str,
    *,
    columns: int = 2,
    intervals: bool = False,
    times: bool = False,
) -> str:
    """The table as text that ends in a newline.

    Args:
        report: what `table_of` gives.
        fmt: one of `FORMATS`.
        columns: LaTeX: all of Table I over both columns of a page (2), or SR alone in one (1).
        intervals: LaTeX: 95 % intervals below all rates; below SR they always stand. The other formats have them.
        times: LaTeX: also T_plan of a batch, and T_tot with it. The other formats have them.

    Raises:
        ValueError: if the format or number of columns does not exist.
    """
    if fmt == "md":
        return _md(report)
    if fmt == "latex":
        return _latex(report, columns, intervals=intervals, times=times)
    records = _same_keys([_with_more(report, row) for row in report.rows])
    if fmt == "csv":
        origin = {k.replace(" ", "_"): v for k, v in report.origin.items()}
        return Table((), [found | origin for found in records]).csv()
    if fmt == "json":
        turns = {"turns": about(report.turns)} if report.turns else {}
        return Table((), records, report.notes).json(origin=dict(report.origin), **turns)
    raise ValueError(f"unknown format {fmt!r}; allowed are {', '.join(FORMATS)}")


def cell(row: Row, column: str) -> str:
    """One cell of Table I."""
    if column in TIMES:
        return seconds(row.times[column].value)
    rate = row.rates.get(column)
    return NA if rate is None else f"{rate.percent:.1f}"


def seconds(value: float | None) -> str:
    """Seconds with two decimals, or two digits below 0.1 s: amortised planning takes less than a millisecond."""
    if value is None:
        return NA
    decimals = 2 if value >= 0.1 or value == 0 else 1 - floor(log10(value))
    return f"{value:.{decimals}f}"


def invalid(row: Row) -> int:
    """Trials of a line that could not be judged."""
    return row.counts["invalid_input"] + row.counts["invalid_sim"]


def interval(rate: Rate | None) -> str:
    """`LOW-HIGH` in percent."""
    return NA if rate is None else f"{rate.low:.1f}-{rate.high:.1f}"


def best_cells(report: Report) -> set[tuple[str, str, str]]:
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
    if not report.alike:
        return best
    for split in dict.fromkeys(row.split for row in report.rows):
        rows = [r for r in report.rows if r.split == split]
        same = len({r.n for r in rows}) == 1
        rows = [r for r in rows if r.method not in report.bounds]
        for column in (c for c in report.headings if c not in TIMES):
            printed = {r.method: cell(r, column) for r in rows}
            values = {method: float(text) for method, text in printed.items() if text != NA}
            if len(set(values.values())) > 1 and same:
                higher = RATES[column].higher
                top = (max if higher else min)(values.values())
                lost = {r.method: 0.0 if higher else _lost_before(r, column) for r in rows}
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


def _scans(report: Report, row: Row) -> Row | None:
    return report.scans.get((row.split, row.method))


def _with_more(report: Report, row: Row) -> dict[str, Any]:
    """A record, with SR on the reader's own objects and the turn test where the table has them."""
    found = record(row) | {"reads": report.reads.get(row.method) or NOT_SAID}
    ends: tuple[float | None, ...]
    for name in ASKED_FOR:
        if name in report.shares and name not in row.shares:  # a line of averages
            found |= {name: None, f"{name}_low": None, f"{name}_high": None}
    if report.scans:
        rate = sr_of_scans(own) if (own := _scans(report, row)) else None
        ends = (rate.percent, rate.low, rate.high) if rate else (None, None, None)
        found |= dict(zip(("sr_scans", "sr_scans_low", "sr_scans_high"), ends, strict=True))
    if report.turns:
        test = report.turn_of(row)
        most = None if test is None else test.most
        ends = (most.points, most.low, most.high) if most else (None, None, None)
        found |= dict(zip(("turn", "turn_low", "turn_high"), ends, strict=True))
        found["turn_marked"] = None if test is None else test.marked
    return found


def _same_keys(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The records with the keys of all: None where a line has no such value."""
    keys = list(dict.fromkeys(key for found in records for key in found))
    return [{key: found.get(key) for key in keys} for found in records]


def records_of(report: Report) -> list[dict[str, Any]]:
    """Records for people: also of how many rows each rate is, and what could not be judged."""
    return [
        _with_more(report, row)
        | {
            f"{n}_of": rate.total
            for n, rate in (dict(row.rates) | dict(row.shares)).items()
            if rate
        }
        | {"invalid": invalid(row)}
        for row in report.rows
    ]


SPLIT = Column("split", "Split", left=True)
READS_COLUMN = Column("reads", "Reads", left=True, title="what the method may read")


def method_column(short: Mapping[str, str]) -> Column:
    """The methods under short names, marked where a turn moves SR by too much."""

    def name(record: Record) -> str:
        return short[record["method"]] + (f" {MARK}" if record.get("turn_marked") else "")

    return Column("method", "Method", name, left=True)


def number_column(report: Report, name: str) -> Column:
    """A rate or time of Table I, headed and grouped as the paper has it."""
    heading = report.headings[name]
    if name in TIMES:
        return Column(
            name, heading, lambda r: seconds(r[name]), group="Time (s)", tex=_behind(heading)
        )
    if name == "sr":
        return Column(name, heading, PERCENT, group="SR", tex=r"(\%)", ends=True)
    group = r"First failure (\%)"
    return Column(name, heading, PERCENT, group=group, tex=_behind(heading), ends=True)


def _behind(heading: str) -> str:
    return tex(heading.partition("_")[2])


def share_columns(report: Report) -> list[Column]:
    """The shares of rows that the table has."""
    return [
        Column(name, share.heading, PERCENT, group=r"Share (\%)", title=share.caption, ends=True)
        for name, share in report.shares.items()
    ]


def brief(report: Report, more: str = "r2h-batch report RUN --full") -> str:
    """The short table of a sweep and of a report: success with one interval, first failures, where the rows come from, and what
    must be known about them, in `MOST_LINES` lines. `render` has the other intervals, counts, times and shares with all notes.

    Args:
        report: what `table_of` gives.
        more: the command that prints all of it.
    """
    short = short_names([row.method for row in report.rows])
    most = MOST_LINES - NOTE_LINES - 6  # head, origin and what stands between
    records = [record | sr_ends(row) for record, row in zip(records_of(report), report.rows)]
    wide = len(records) > most
    if wide:  # a line for each method: SR of each split, the rest of all its trials
        records = _by_method(report, records)
    failures = [c for c in report.headings if c not in TIMES and c != "sr"]
    said = [c for c in OF_SUCCESSES if c in report.shares]
    splits = [Column(s, f"SR {s}", PERCENT) for s in SPLITS if any(s in r for r in records)]
    columns = [
        *(() if wide else (SPLIT,)),
        *(
            method_column(short),
            READS_COLUMN,
            *splits,
            number_column(report, "sr"),
            Column("ci", "95 %", INTERVAL),
        ),
        *([Column("sr_scans", "SR scans", PERCENT)] if report.scans else []),
        *(number_column(report, c) for c in failures),
        *(Column(c, OF_SUCCESSES[c], PERCENT) for c in said),
        *([Column("invalid")] if (none := sum(map(invalid, report.rows))) else []),
    ]
    left = len(records) - most
    rest = f"{left} more methods, " if left > 0 else ""
    known = [
        *map(plain, report.unjudged),
        *([INVALID_NOTE] if none else []),
        *report.misses,
        *map(plain, report.trained),
        *(test.sentence for test in report.turns if test.marked),
    ]
    kind = "categories" if report.families else "objects"
    of = f" {', '.join(OF_SUCCESSES[c] for c in said)}: % of successes." if said else ""
    notes = few_notes(
        f"F_*: % of N, first failures.{of} 95 %: the mean of all {kind}.",
        known,
        f"{rest}times, counts, intervals: {more}",
    )
    words = textwrap.shorten(_asked(report), 2 * NOTE - 10, placeholder=" ...")
    asked = textwrap.fill(words, NOTE, break_long_words=False, break_on_hyphens=False)
    return document([Table(columns, records[:most]), asked, notes])


def sr_ends(row: Row) -> dict[str, float | None]:
    """The one interval of SR of a short table under `ci`: for the mean of all categories, or objects, like these; of a single one
    for more trials with it."""
    rate = row.sr_new_categories or row.sr_new_objects or row.rates["sr"]
    return rate_fields("ci", rate)


def _by_method(report: Report, records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A record for each method: that of its last line (all its trials), with SR of each split, and shares of the successes of
    all."""
    found: dict[str, dict[str, Any]] = {}
    for record in records:
        splits = {k: v for k, v in found.get(record["method"], {}).items() if k in SPLITS}
        found[record["method"]] = {**splits, record["split"]: record["sr"], **record}
    for name, (method, record) in product(OF_SUCCESSES, found.items()):
        own = [r.shares[name] for r in report.rows if r.method == method and name in r.shares]
        if n := sum(rate.total or 0 for rate in own):
            record |= rate_fields(name, rate_of(sum(rate.count or 0 for rate in own), n))
    return list(found.values())


DETAILS = ("trials digest", "device", "r2h_batch", "instances")
"""Where rows come from, in more detail than a short table says."""


def _asked(report: Report) -> str:
    """What was asked and how it was judged, without digests."""
    kept = {k: _without_digests(v) for k, v in report.origin.items() if k not in DETAILS}
    if kept.get("benchmark") == f"--benchmark {kept.get('protocol')}":
        del kept["benchmark"]
    return "; ".join(f"{k}: {v}" for k, v in in_words(kept).items())


def _without_digests(text: str) -> str:
    return re.sub(r",? digest [0-9a-f]+", "", text)


def _first_failure(failures: Mapping[str, CriterionEntry]) -> str:
    """The note on SR and first failures."""
    order = ", ".join(e.name.capitalize() for e in IN_ORDER if e.rate in failures)
    return FOOTNOTES[0].format(order)


def _md(report: Report) -> str:
    headings, few = report.headings, report.few
    rates = [c for c in headings if c not in TIMES]
    short = short_names([row.method for row in report.rows])
    families = [Column("sr_new_categories", "SR new cat.", INTERVAL)] if report.families else []
    sections = {
        "Rates in percent, times in seconds.": [
            READS_COLUMN,
            *(number_column(report, c) for c in headings),
            *([Column("sr_scans", "SR scans", PERCENT)] if report.scans else []),
        ],
        "95 % intervals of the rates (Wilson; Avg: MOVER).": [
            Column(c, headings[c], INTERVAL) for c in rates
        ],
        "95 % intervals of SR for new things.": [
            *(Column("sr", "SR", PERCENT), Column("sr_new_objects", "SR new obj.", INTERVAL)),
            *(*families, Column("sr_few", f"SR of {few} new", INTERVAL)),
        ],
        "Counts, and T_method, the method's own time per trial.": [
            *(Column("n", "N"), Column("t_plan_s_n", "n T_plan"), Column("t_exec_s_n", "n T_exec")),
            Column("t_method_s", "T_method", lambda r: seconds(r["t_method_s"])),
            *(Column("invalid"), Column("n_missing", "missing")),
        ],
    }
    first, records = [SPLIT, method_column(short)], records_of(report)
    tables = [Table([*first, *own], records, title=title) for title, own in sections.items()]
    for name, share in report.shares.items():
        own = [Column(name, share.heading, PERCENT), Column(name, "95 %", INTERVAL)]
        known = [r for r in records if r.get(name) is not None]
        tables.append(Table([*first, *own, Column(f"{name}_of", "of")], known, title=share.caption))
    origin = "  \n".join(
        f"{k}: {short_digests(value)}" for k, value in in_words(report.origin).items()
    )
    notes = (
        plain(n) if n in (*report.trained, *report.unjudged) else n for n in report.notes
    )  # a method's own words are a stranger's
    return document([origin, *tables, notes_list([*map(plain, legend(short)), *notes])])


def record(row: Row) -> dict[str, Any]:
    """One flat row: every number of the table under its own name, None where nothing is defined."""

    fields: dict[str, Any] = {"split": row.split, "method": row.method}
    fields |= {"n": row.n, "n_objects": row.n_objects, "n_categories": row.n_categories}
    for name in row.rates:
        fields |= rate_fields(name, row.rates[name])
        if name in PARTIAL:
            own = row.rates[name]
            fields[f"{name}_of"] = own.total if own else None
    for what, clustered in (("objects", row.sr_new_objects), ("categories", row.sr_new_categories)):
        fields |= rate_fields(f"sr_new_{what}", clustered)
        del fields[f"sr_new_{what}"]  # it is "sr"
    few = rate_fields("sr_few", row.sr_few)
    del few["sr_few"]
    fields |= {"few": row.few} | few
    for name in shares():
        if name not in ASKED_FOR or name in row.shares:
            fields |= rate_fields(name, row.shares.get(name))
    for name in TIMES:
        fields |= {name: row.times[name].value, f"{name}_n": row.times[name].count}
    others = {entry.name for rate, entry in ASKED_FAILURES.items() if rate not in row.rates}
    others |= {name for name in (*NO_LONGER, ELSEWHERE) if not row.counts[name]}
    return fields | {f"n_{name}": n for name, n in row.counts.items() if name not in others}


def _latex(report: Report, columns: int, *, intervals: bool, times: bool) -> str:
    if columns not in (1, 2):
        raise ValueError(f"--columns is {columns}; a page has 1 or 2")
    short = short_names([row.method for row in report.rows])
    counts = [
        f"{row.split} {short[row.method]}: N {row.n}, T_plan over {row.times['t_plan_s'].count}, T_exec over"
        f" {row.times['t_exec_s'].count}, invalid {invalid(row)}, missing {row.counts['missing']}, SR of new objects"
        f" {interval(row.sr_new_objects)}"
        f"{f', of new categories {interval(row.sr_new_categories)}' if report.families else ''}"
        f", of the mean of {row.few} new ones {interval(row.sr_few)}"
        for row in report.rows
    ]
    of = [
        f"{share.heading}: {share.caption} Of: "
        + "; ".join(
            f"{r.split} {short[r.method]} {r.shares[k].total}" for r in report.rows if k in r.shares
        )
        for k, share in report.shares.items()
    ]
    origin = "; ".join(f"{key}: {value}" for key, value in in_words(report.origin).items())
    bold = [BEST_NOTE] if best_cells(report) else []
    kind = "categories" if report.families else "objects"
    ends = f"Below SR: the 95 % interval for the mean of all {kind}."
    notes = [origin, *legend(short), ends, "; ".join(counts), *of, *bold, *report.notes]
    found = _wide(report, short, times=times) if columns == 2 else _narrow(report, short)
    if not intervals:  # that of SR alone
        found = replace(
            found,
            columns=[replace(c, ends=c.ends and c.name in ("sr", *AVG)) for c in found.columns],
        )
    return replace(found, notes=notes).latex(intervals=True) + "\n"


AVG = (*SPLITS, "Avg")
OF_BATCH = ("t_plan_s", "t_tot_s")
"""Times that depend on how many trials were planned at once, so that no paper's seconds compare with them."""


def _wide(report: Report, short: Mapping[str, str], *, times: bool) -> Table:
    """All of Table I, split by split."""
    headings = [c for c in report.headings if times or c not in OF_BATCH]
    best = best_cells(report)
    sizes: dict[str, list[int]] = {}
    for row in report.rows:
        sizes.setdefault(row.split, []).append(row.n)
    differ = {split for split, own in sizes.items() if len(set(own)) > 1}
    names = method_column(short)

    def name(record: Record) -> str:
        return names.say(record) + (f" ({record['n']})" if record["split"] in differ else "")

    columns = [
        replace(names, form=name),
        *(number_column(report, c) for c in headings),
        *share_columns(report),
        READS_COLUMN,
    ]
    bold = {
        (k, c)
        for k, row in enumerate(report.rows)
        for c in headings
        if (row.split, row.method, c) in best
    }
    groups = [
        (f"{split}, {'$N$ in brackets' if split in differ else f'$N={own[0]}$'}", len(own))
        for split, own in sizes.items()
    ]
    return Table(columns, _with_ends(report), bold=frozenset(bold), groups=groups)


def _with_ends(report: Report) -> list[dict[str, Any]]:
    """The records with the one interval of SR of a short table."""
    ends = [sr_ends(row) for row in report.rows]
    return [
        r | {"sr_low": e["ci_low"], "sr_high": e["ci_high"]}
        for r, e in zip(records_of(report), ends)
    ]


def _narrow(report: Report, short: Mapping[str, str]) -> Table:
    """SR of each method, a column for each split."""
    best, columns = best_cells(report), [Column("method", left=True, tex="\nMethod, $N$")]
    records: dict[str, dict[str, Any]] = {
        method: {"method": name} for method, name in short.items()
    }
    for split in dict.fromkeys(row.split for row in report.rows):
        own = [row for row in report.rows if row.split == split]
        n = sorted({row.n for row in own})
        size = f"{n[0]}" if len(n) == 1 else f"{n[0]}--{n[-1]}"
        group = r"Success (\%)"
        columns.append(Column(split, form=PERCENT, group=group, tex=f"{split}\n{size}", ends=True))
        for row in own:
            ends = sr_ends(row)
            records[row.method] |= rate_fields(split, row.rates["sr"])
            records[row.method] |= {
                f"{split}_low": ends["ci_low"],
                f"{split}_high": ends["ci_high"],
            }
    bold = {
        (k, split)
        for k, method in enumerate(records)
        for split in records[method]
        if (split, method, "sr") in best
    }
    return Table(columns, list(records.values()), bold=frozenset(bold))


LEAST = 10
"""Trials of an object below which its rate says little."""


def objects_brief(run: Run) -> str:
    """SR of each method for the objects with `LEAST` trials or more, the hardest first, in `MOST_LINES` lines.

    Args:
        run: what `load_run` gives.
    """
    more, short = "r2h-batch report RUN --by-object --full", short_names(run.methods)
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for method in run.methods:
        for name, row in breakdown.by_object(tally(run, method)):
            record = found.setdefault(
                (row.split, name), {"split": row.split, "object": name, "n": row.n}
            )
            record["n"] = min(record["n"], row.n)
            record[method] = None if (rate := row.rates["sr"]) is None else rate.percent
    often = [r for r in found.values() if r["n"] >= LEAST]
    if not often:
        largest = max((r["n"] for r in found.values()), default=0)
        return (
            f"No object has {LEAST} trials (the most is {largest}), and a rate of fewer says little: sweep with more --trials."
            f"\nAll objects: {more}\n"
        )
    often.sort(key=lambda r: sum(r.get(m) or 0.0 for m in run.methods))
    columns = [SPLIT, Column("object", "Object", left=True), Column("n", "N")]
    columns += [Column(m, plain(short[m]), PERCENT) for m in run.methods]
    most = MOST_LINES - NOTE_LINES - 3
    notes = few_notes(
        f"SR in percent, the hardest objects first: {min(most, len(often))} of {len(often)} with N of {LEAST} or more.",
        (),
        f"{len(found)} objects with first failures and intervals: {more}",
    )
    return document([Table(columns, often[:most]), notes])


def object_lines(run: Run, fmt: str = "md") -> str:
    """Every method's rates for every object.

    Args:
        run: what `load_run` gives.
        fmt: md, csv or json. Markdown also says which criteria fail together.
    """
    counted = [tally(run, method) for method in run.methods]
    lines = [line for t in counted for line in breakdown.by_object(t)]
    records = _same_keys([{"object": name} | record(row) for name, row in lines])
    if fmt == "md":
        return _objects_md(counted, Report(tuple(row for _, row in lines), {}), records)
    if fmt == "csv":
        return Table((), records).csv()
    if fmt == "json":
        return Table((), records).json(origin=dict(table_of(run, counted=counted).origin))
    raise ValueError(f"no table of objects in format {fmt!r}; allowed are md, csv, json")


def _objects_md(counted: Sequence[Tally], report: Report, records: Sequence[Record]) -> str:
    short = short_names([t.method for t in counted])
    columns = [
        *(SPLIT, Column("object", "Object", left=True), method_column(short), Column("n", "N")),
        *(number_column(report, c) for c in report.headings if c not in TIMES),
        Column("sr", "SR 95 %", INTERVAL),
    ]
    parts: list[Table | str] = [Table(columns, records, [*map(plain, legend(short))])]
    for t in counted:
        for split in t.splits:
            both = breakdown.co_failures(t, split)
            pairs = [
                [c, *(f"{f}/{e}" if e else NA for f, e in zip(failed, evaluated))]
                for c, failed, evaluated in zip(t.judged, both.failed, both.evaluated)
            ]
            words = "trials that fail both / in which both were evaluated."
            title = f"{plain(short[t.method])}, {split}: {words}"
            parts.append(of_lines(["", *t.judged], pairs, title=title))
    return document(parts)
