"""A stored run, to be read: its methods, their shards, tables and digests.

run.json                           the run: protocol, digests, configuration, versions
benchmark/                         the benchmark's files (`trials.run_files`)
ids.csv                            what the owner of listed trials calls them: trial_id, id, variant
imported-SHA/                      trials that were read from somebody's files, as a benchmark
methods/METHOD.json                a method, and where its answers come from
shards/METHOD/000017-SHA.parquet   a shard (`runs.shard`): it is stored when the file exists
.claims/METHOD-000017              who works on a shard, or died at it
reception/METHOD.parquet           what `r2h-batch results` made of the rows (side.py)
"""

import csv
import hashlib
import os
import shlex
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.base.errors import nearest
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import open_file, printable
from r2h_batch.base.io.write import atomic_path, csv_cell
from r2h_batch.base.validate import boolean, check_arguments, sequence_of, text
from r2h_batch.base.validate import path as path_of
from r2h_batch.runs.before import tell_unread
from r2h_batch.runs.files import RunError
from r2h_batch.runs.header import TIMING, Shard, read_header, schema_of, shards_of
from r2h_batch.runs.methods import Entry, read_methods
from r2h_batch.runs.plugged import lacking
from r2h_batch.runs.side import read_side, side_path
from r2h_batch.runs.verify import first_problem
from r2h_batch.verdicts import ASKED_NAMES, REGISTRY, CriterionEntry, criteria_of

if TYPE_CHECKING:
    import pandas

MAX_LABELS_BYTES = 256 << 20
LABELS = "ids.csv"
UNJUDGED = ("invalid_input", "missing")
"""Outcomes of rows without a motion to show."""
LISTED = 10
"""Trials that a message names."""
IMPORTED = "imported-"
"""Begins the name of a folder that holds the trials of a sweep in our form."""


def write_labels(folder: Path, labels: Mapping[int, tuple[str, str]]) -> None:
    """The names that the owner of listed trials gave them, as a table in a run folder."""
    with (
        atomic_path(folder / LABELS) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        rows = csv.writer(file)
        rows.writerow(["trial_id", "id", "variant"])
        rows.writerows([i, *map(csv_cell, pair)] for i, pair in labels.items())


@dataclass(frozen=True)
class Run:
    """A stored run, or several as one (`join`).

    Attributes:
        folder: the run folder; of several runs the first one's.
        header: run.json; of several runs the first one's.
        entries: the methods.
        runs: the runs that were joined, or this one.
    """

    folder: Path
    header: dict[str, Any]
    entries: tuple[Entry, ...]
    joined: tuple["Run", ...] = ()

    @property
    def runs(self) -> tuple["Run", ...]:
        """The runs that were joined, or this one."""
        return self.joined or (self,)

    @property
    def robot(self) -> str:
        """The robot's name; runs that name none are older than the choice."""
        return str((self.header.get("robot") or {}).get("name", "ur5e_2f85"))

    @property
    def categories(self) -> dict[str, str]:
        """Object -> the family that it is an instance of; an object of no family is its own category."""
        objects = [o for run in self.runs for o in run.header.get("objects", ())]
        return {str(o["name"]): str(o.get("category", o["name"])) for o in objects}

    @property
    def asks(self) -> tuple[str, ...]:
        """Criteria that its benchmark asks for beside those of all, of those that there still are; of several runs those of any.
        A method of several runs is judged by those of its own (`run_of`)."""
        asked = {name for run in self.runs for name in run.header.get("asks", ())}
        return tuple(name for name in ASKED_NAMES if name in asked)

    @property
    def criteria(self) -> tuple[CriterionEntry, ...]:
        """All that its benchmark asks for, or one of them, in the order of the stored columns."""
        return criteria_of(self.asks)

    @property
    def lacking(self) -> tuple[str, ...]:
        """Criteria and shares of packages that are not installed here, in words; the run is read without their columns."""
        return tuple(dict.fromkeys(words for run in self.runs for words in lacking(run.header)))

    @property
    def concerned(self) -> dict[str, frozenset[str]]:
        """Criterion that is not for all objects -> those that it concerns, as run.json says."""
        objects = [o for run in self.runs for o in run.header.get("objects", ())]
        return {
            entry.name: frozenset(
                str(o["name"]) for o in objects if entry.name in o.get("concerned", ())
            )
            for entry in REGISTRY
            if entry.applies is not None
        }

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the complete methods, in the order in which they were added."""
        return tuple(e.name for e in self.entries if e.complete)

    @property
    def unfinished(self) -> tuple[str, ...]:
        """Names of the methods with shards still to score."""
        return tuple(e.name for e in self.entries if not e.complete)

    @cached_property
    def labels(self) -> dict[int, tuple[str, str]]:
        """Trial id -> what the trial's owner calls it, and the method behind it; empty where trials
        have numbers only."""
        path = self.folder / LABELS
        if not path.exists():
            return {}

        def cell(text: str) -> str:
            return text[1:] if csv_cell(text[1:]) == text else text  # safe for spreadsheets

        with open_file(path, MAX_LABELS_BYTES) as stream:
            rows = csv.DictReader(TextIOWrapper(stream, encoding="utf-8", newline=""), strict=True)
            try:
                return {int(r["trial_id"]): (cell(r["id"]), cell(r["variant"])) for r in rows}
            except (KeyError, TypeError, ValueError, csv.Error):
                words = "needs the columns trial_id, id, variant; run the sweep again to write it"
                raise RunError(f"{path}: {words}") from None

    def trial_id(self, word: str) -> int:
        """The number of a trial from its number or its owner's text.

        Args:
            word: digits, or the text that the trials' owner gave.
        """
        if word.isascii() and word.isdigit():
            return int(word)
        found = [
            number for number, (text_of_owner, _) in self.labels.items() if text_of_owner == word
        ]
        shown = repr(printable(word)[:80])
        if len(found) > 1:
            numbers = f"{found[0]} and {found[1]}"
            raise RunError(
                f"{self.folder}: trials {numbers} have the id {shown} in {LABELS}; give a trial's number"
            )
        if not found:
            raise RunError(f"{self.folder}: no trial has the id {shown}{self._ids_for(word)}")
        return found[0]

    def _ids_for(self, word: str) -> str:
        """The trials of the object that a word names, or all of them, for a message; empty where no method is complete."""
        if not self.methods:
            return ""
        rows = self.trials(self.methods[0], ["trial_id", "object"])
        ids, objects = rows["trial_id"].to_pylist(), rows["object"].to_pylist()
        if own := [i for i, name in zip(ids, objects, strict=True) if name == word]:
            return f"; trials of this object are {_listed(own)}"
        return f"; there are {len(ids)}: {_listed(ids)}"

    def __repr__(self) -> str:
        planned = sum(self.header["trials"].values())
        splits = ", ".join(f"{n} {split}" for split, n in self.header["trials"].items())
        methods = ", ".join(self.methods) or "none complete"
        more = f"; not complete: {', '.join(self.unfinished)}" if self.unfinished else ""
        where = ", ".join(str(run.folder) for run in self.runs)
        return (
            f"Run({where}: {planned} trials ({splits}) of {self.header.get('protocol', '?')}, {self.robot}; "
            f"methods: {methods}{more})"
        )

    def complete(self, word: str | None = None) -> str:
        """The full name of a method whose rows are all there.

        Args:
            word: the full name, or the sweep's word (fc); None or empty: the only complete method.

        Raises:
            RunError: there is no such method, several, or not all its rows are there.
        """
        names = self.methods
        if not word and len(names) == 1:
            return names[0]
        if not word and names:
            listed = ", ".join(names)
            raise RunError(
                f"{self.folder}: has several methods; choose one with --method: {listed}"
            )
        if not word:
            raise RunError(f"{self.folder}: {self.not_complete()}")
        name = self.named(word)
        if name not in names:
            raise RunError(f"{self.folder}: {self.not_complete(name)}")
        return name

    def not_complete(self, method: str = "") -> str:
        """That a method, or each of them, is not complete, and what to do about it, in words.

        Args:
            method: its name in the run; empty: all.
        """
        for folder in (run.folder for run in self.runs if not run.entries):
            if (folder / "shards").is_dir() and not (folder / "methods").is_dir():
                return (
                    f"no method is known: {printable(folder / 'methods')} is missing; copy it too"
                )
        entries = [self.entry(method)] if method else self.entries
        why = next(filter(None, (e.hindrance for e in entries)), "run its sweep again to go on")
        return f"{f'{method!r} is not' if method else 'no method is'} complete; {why}"

    def holding(self, trial: int, words: Sequence[str] = (), *, judged: bool = True) -> list[str]:
        """The full names of complete methods that hold a trial. Commands ask before they import what draws or judges, so
        that a typing error is told at once.

        Args:
            trial: its id.
            words: full names or words of the sweep; empty: the only method.
            judged: refuse a row that was not judged, too: there is nothing to show.

        Raises:
            RunError: there is no such method or trial, or the row was not judged.
        """
        names = [self.complete(word) for word in words] or [self.complete()]
        for name in names:
            outcome = self.row(trial, name)["outcome"]
            if judged and outcome in UNJUDGED:
                words_of = f"was not judged ({outcome}): there is nothing to show"
                raise RunError(f"{self.folder}: trial {trial} of {name!r} {words_of}")
        return names

    def row(self, trial: int, method: str) -> dict[str, Any]:
        """One row of `trials` with its details, where they are stored.

        Args:
            trial: its id.
            method: its name in the run.

        Raises:
            RunError: there is no such trial or method.
        """
        found: dict[str, Any] = {}
        for kind in ("details", "trials") if trial.bit_length() < 64 else ():
            if kind == "details" and kind not in self.entry(method).header["stored"]:
                continue
            for table in self.shards(kind, method):
                own = table.filter(pc.equal(table["trial_id"], trial)).to_pylist()
                found |= own[0] if own else {}
                if own:
                    break
        if "outcome" not in found:
            ids = self.trials(method, ["trial_id"])["trial_id"].to_pylist()
            what = f"has no trial {str(trial)[:40]}; it has {len(ids)}: {_listed(ids)}"
            raise RunError(f"{self.folder}: {method!r} {what}")
        return found

    def to_pandas(self) -> "pandas.DataFrame":
        """All trials of all complete methods as a table: the columns of `trials` and the method's name.

        Raises:
            ImportError: pandas is missing (extra `pandas`).
        """
        try:
            import pandas
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install 'r2h_batch[pandas]'") from None
        tables = [self.trials(m).to_pandas().assign(method=m) for m in self.methods]
        return pandas.concat(tables, ignore_index=True) if tables else pandas.DataFrame()

    def entry(self, method: str) -> Entry:
        """The method of this name.

        Args:
            method: its name in the run.
        """
        text("method", method)
        for entry in self.entries:
            if entry.name == method:
                return entry
        names = ", ".join(e.name for e in self.entries) or "none"
        raise RunError(f"{self.folder}: no method {method!r}; it has {names}")

    def run_of(self, method: str) -> "Run":
        """The run that holds a method's rows: of several runs one of them, with the header by which they were judged.

        Args:
            method: its name in the run.
        """
        folder = self.entry(method).folder
        return next(run for run in self.runs if run.folder == folder)

    def named(self, word: str) -> str:
        """The full name of a method.

        Args:
            word: the full name, or the sweep's word (fc).
        """
        text("word", word)
        names = [e.name for e in self.entries]
        if word in names:
            return word
        function = f"r2h_batch.methods.{word.replace('-', '_')}:predict"
        found = [e.name for e in self.entries if e.source.get("function") == function]
        if len(found) == 1:
            return found[0]
        if found:
            words = f"{word!r} answered several times: {', '.join(found)}; give one of these names"
            raise RunError(f"{self.folder}: {words}")
        has = ", ".join(names) or "none"
        near = nearest(word, self.words) or nearest(word, names)
        raise RunError(f"{self.folder}: no method {word!r}{near}; it has {has}")

    @property
    def words(self) -> list[str]:
        """The sweep's words of the methods that are functions (fc)."""
        functions = [str(e.source.get("function", "")).partition(":")[0] for e in self.entries]
        return [f.rpartition(".")[2].replace("_", "-") for f in functions if f]

    def only(self, words: Sequence[str]) -> "Run":
        """The same run with these methods alone, in stored order.

        Args:
            words: full names or words of the sweep (see `named`); empty: all.
        """
        if not sequence_of(str, "names of methods", least=0)("words", words):
            return self
        names = {self.named(w) for w in words}
        return replace(self, entries=tuple(e for e in self.entries if e.name in names))

    def view_command(self, method: str) -> str:
        """The command that shows trials of a method: `r2h-batch view RUN --method WORD --trial`.

        Args:
            method: its name in the run.
        """
        folder, name = self._called(method)
        return shlex.join(["r2h-batch", "view", folder, "--method", name, "--trial"])

    def why_command(self, method: str, trial: int) -> str:
        """The command that says why a trial failed: `r2h-batch why RUN TRIAL --method WORD`.

        Args:
            method: its name in the run.
            trial: its number.
        """
        folder, name = self._called(method)
        return shlex.join(["r2h-batch", "why", folder, str(trial), "--method", name])

    def _called(self, method: str) -> tuple[str, str]:
        """The folder of a method's run, and the method as a command there names it."""
        entry, run = self.entry(method), self.run_of(method)
        name = next(e.name for e in run.entries if e.slug == entry.slug)
        module = entry.source.get("function", "").partition(":")[0]
        word = module.removeprefix("r2h_batch.methods.").replace("_", "-")
        with suppress(RunError):
            name = word if run.named(word) == name else name
        return str(entry.folder), name

    def planned(self, method: str) -> dict[str, int]:
        """Split -> trials that a method was asked.

        Args:
            method: its name in the run.
        """
        return dict(self.entry(method).header["trials"])

    def missing(self, method: str) -> list[Shard]:
        """Shards of a method that are planned and not stored.

        Args:
            method: its name in the run.
        """
        entry = self.entry(method)
        return [s for s in shards_of(entry.header) if s.index not in entry.shards]

    def trials(self, method: str, columns: Sequence[str] | None = None) -> pa.Table:
        """One row per trial in planned order.

        Args:
            method: its name in the run.
            columns: names of the table of docs/run_folder.md; None: all that this run may have.
        """
        return self._read("trials", method, columns)

    def details(self, method: str) -> pa.Table:
        """Goal, grasp and witness of the scored trials, `DETAIL_SCHEMA`.

        Args:
            method: its name in the run.
        """
        return self._read("details", method)

    def poses(self, method: str) -> pa.Table:
        """The scored poses, `POSE_SCHEMA`; missing trials have no row.

        Args:
            method: its name in the run.
        """
        return self._read("poses", method)

    def paths(self, method: str) -> pa.Table:
        """Waypoints and times of the trials with a path, `PATH_SCHEMA`.

        Args:
            method: its name in the run.
        """
        return self._read("paths", method)

    def episodes(self, method: str) -> pa.Table:
        """How closed loops ended, `EPISODE_SCHEMA`.

        Args:
            method: its name in the run.
        """
        return self._read("episodes", method)

    def sees(self, method: str) -> pa.Table:
        """Pixels, share and pick of what a method that sees was shown, `SEES_SCHEMA`.

        Args:
            method: its name in the run.
        """
        return self._read("sees", method)

    def failures(self, method: str) -> pa.Table:
        """The inputs that repeat a failed simulation, `FAILURE_SCHEMA`.

        Args:
            method: its name in the run.
        """
        return self._read("failures", method)

    def _read(self, kind: str, method: str, columns: Sequence[str] | None = None) -> pa.Table:
        header = self.entry(method).header
        schema = schema_of(header, kind)
        if columns is not None:
            every = schema_of({**header, "asks": ASKED_NAMES}, kind, unread=True)
            schema = pa.schema([every.field(n) for n in columns])
        tables = [schema.empty_table(), *self.shards(kind, method, columns)]
        return pa.concat_tables(tables).unify_dictionaries()

    def shards(
        self, kind: str, method: str, columns: Sequence[str] | None = None
    ) -> Iterator[pa.Table]:
        """The tables of a kind, one shard at a time, for runs that do not fit into memory. Later
        columns that an older run lacks, and those of criteria that its benchmark does not ask for, are null.

        Args:
            kind: trials, details, poses, paths, episodes, failures or sees.
            method: its name in the run.
            columns: names of the kind's schema; None: all that this run may have.
        """
        entry = self.entry(method)
        names = list(columns or schema_of(entry.header, kind).names)
        every = schema_of({**entry.header, "asks": ASKED_NAMES}, kind, unread=True)
        for stored in entry.shards.values():
            if kind not in stored.kinds:
                if kind == "failures":  # no simulation of this shard failed
                    continue
                words = f"method {method!r} has no {kind}; sweep again with --save-paths"
                raise RunError(f"{entry.folder}: {words}")
            table = stored.table(kind, names)
            for name in set(names) - set(table.column_names):
                field = every.field(name)
                table = table.append_column(field, pa.nulls(len(table), field.type))
            yield table.select(names)

    def shard(self, kind: str, method: str, index: int) -> pa.Table:
        """The table of a kind of one shard, without later columns that an older run lacks.

        Args:
            kind: trials, details, poses, paths, episodes, failures or sees.
            method: its name in the run.
            index: of the shard.
        """
        stored = self.entry(method).shards.get(index)
        if stored is None or kind not in stored.kinds:
            raise RunError(f"{self.folder}: shard {index} of {method!r} has no {kind}")
        return stored.table(kind, schema_of(stored.header, kind).names)

    def side(self, method: str, question: str, schema: pa.Schema | None = None) -> pa.Table | None:
        """The answers beside a method's shards (side.py). None: there are none, or they were made of other rows: their
        `success` is not that of the run.

        Args:
            method: its name.
            question: one of `QUESTIONS`, as `reception`.
            schema: of the columns, `trial_id` among them; None: those that tables read.

        Raises:
            RunError: the file is damaged, too large, lacks a column, or says something about other trials.
        """
        path = side_path(self.entry(method), question)
        if not os.path.lexists(path):
            return None
        rows = self.trials(method, ["trial_id", "outcome"])
        table = read_side(path, rows["trial_id"].to_numpy(), schema)
        if "success" in table.column_names:
            won = rows["trial_id"].filter(pc.equal(rows["outcome"], "success"))
            if not pc.is_in(table["trial_id"], won.combine_chunks()).equals(table["success"]):
                return None
        return table

    def verify(self) -> None:
        """Raise `RunError` unless every stored shard is as it was written."""
        for run in self.runs:
            if problem := first_problem(run.folder, run.entries):
                raise RunError(problem)

    def digest(self, method: str) -> str:
        """sha256 (hex) over all rows of a method without `TIMING`: equal for any shards and
        workers. Later columns that an older run lacks are not part of its digest.

        Args:
            method: its name in the run.
        """
        entry = self.entry(method)
        stored_ones = schema_of(entry.header, "trials", unread=True).names
        columns = [c for c in stored_ones if c not in TIMING]
        hashes: dict[tuple[str, str], Any] = defaultdict(hashlib.sha256)
        for stored in entry.shards.values():
            table = stored.table("trials", columns)
            for name in table.column_names:
                column = table[name].combine_chunks()
                valid = column.is_valid().to_numpy(zero_copy_only=False)
                hashes[name, "valid"].update(valid.tobytes())
                hashes[name, "value"].update(_plain(column).tobytes())
        return hashlib.sha256(b"".join(h.digest() for h in hashes.values())).hexdigest()


def _listed(ids: Sequence[int]) -> str:
    """Numbers of trials for a message."""
    shown = ", ".join(map(str, ids[:LISTED])) or "none"
    return shown + (f", ... up to {max(ids)}" if len(ids) > LISTED else "")


def picture_command(run: Run, method: str, trial: int) -> str:
    """The command that draws a trial into a file."""
    return f"{run.view_command(method)} {trial} --strips trial-{trial}.png"


def _plain(column: pa.Array) -> np.ndarray:
    """Values as numbers of fixed size (a word as its hash, null as 0): equal rows, equal bytes."""
    if pa.types.is_dictionary(column.type):
        words = [hashlib.sha256(w.encode()).digest()[:8] for w in column.dictionary.to_pylist()]
        codes = np.frombuffer(b"".join([*words, bytes(8)]), "<u8")
        return codes[column.indices.fill_null(len(words)).to_numpy()]
    return np.asarray(column.fill_null(False if pa.types.is_boolean(column.type) else 0))


def robot_words(runs: Sequence[Run]) -> dict[str, str]:
    """Robot -> what stands before its methods' names: nothing where all have the same robot, else
    `ur5e/`, or the whole name where several start so."""
    names = list(dict.fromkeys(run.robot for run in runs))
    short = [name.partition("_")[0] for name in names]
    words = short if len(set(short)) == len(names) else names
    return {name: f"{word}/" if len(names) > 1 else "" for name, word in zip(names, words)}


def join(runs: Sequence[Run]) -> Run:
    """Several runs as one, for tables and pages.

    A method has its robot's name in front if the runs have several, and its run's name if there is
    another method of that name.

    Raises:
        RunError: two folders of one name hold a method of one name.
    """
    if len(runs) == 1:
        return runs[0]
    robots = robot_words(runs)
    names = Counter(robots[run.robot] + e.name for run in runs for e in run.entries)
    entries: dict[str, Entry] = {}
    for run in runs:
        for entry in run.entries:
            name = robots[run.robot] + entry.name
            if names[name] > 1:
                name = f"{run.folder.absolute().name}/{entry.name}"
            if name in entries:
                raise RunError(f"two run folders of one name hold {name!r}; rename one of them")
            entries[name] = replace(entry, name=name)
    parts = tuple(part for run in runs for part in run.runs)
    return Run(runs[0].folder, runs[0].header, tuple(entries.values()), parts)


_TOLD: set[tuple[str, ...]] = set()


def _tell_lacking(run: Run) -> None:
    """One line about what is not installed, once for each run."""
    if (words := run.lacking) and (told := (str(run.folder.absolute()), *words)) not in _TOLD:
        _TOLD.add(told)
        LOG.info(
            f"{run.folder}: read without the columns of {' and '.join(words)}, not installed here; a row that failed such a"
            " criterion counts as failed"
        )


@check_arguments(verify=boolean)
def load_run(folder: str | Path, *, verify: bool = True) -> Run:
    """Open a stored run.

    Args:
        folder: the run folder.
        verify: compare every file with its sha256 first. Without, a damaged file can end this process.

    Returns:
        The run; its tables are read when they are asked for.

    Raises:
        RunError: the folder is no run folder, or a file is not as it was written.
    """
    folder = path_of("folder", folder)
    header = read_header(folder)
    tell_unread(folder, header)
    run = Run(folder, header, tuple(e.listed() for e in read_methods(folder, header)))
    _tell_lacking(run)
    if verify:
        run.verify()
    return run
