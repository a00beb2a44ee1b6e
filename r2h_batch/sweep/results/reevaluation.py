"""Judge a random sample of stored rows again, from the poses stored beside them.

A digest shows that a file is as it was written, but a forger can write digests too. So verdicts are
computed again: trials follow from their ids, and poses are stored. A built-in method answers the
sampled trials again, so its rows cannot hold the poses of another method. A user's method is not run,
because a folder may come from anybody.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch

from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.validate import check_arguments, instance_of, integer, optional, text
from r2h_batch.config import BORDERLINE_M
from r2h_batch.runs.before import has_head
from r2h_batch.runs.files import RunError
from r2h_batch.runs.header import TIMING, schema_of
from r2h_batch.runs.methods import Entry
from r2h_batch.runs.rows import DETAIL_SCHEMA, EPISODE_SCHEMA, PATH_SCHEMA, TRIAL_SCHEMA
from r2h_batch.runs.store import Run
from r2h_batch.sweep.jobs import Job, NotBuiltIn, job_of_run
from r2h_batch.sweep.results.judge import Judge, check_poses
from r2h_batch.sweep.results.questions import Part, Question, answers
from r2h_batch.trials.predictions import Motions
from r2h_batch.verdicts import ELSEWHERE, NO_LONGER

COMPARED = {
    "trials": tuple(name for name in TRIAL_SCHEMA.names if name not in TIMING),
    "details": tuple(DETAIL_SCHEMA.names),
    "paths": tuple(PATH_SCHEMA.names),
    "episodes": tuple(EPISODE_SCHEMA.names),
}
"""Columns that are judged again; poses are what they are judged from."""

TOLERANCES = {"_m": BORDERLINE_M, "_deg": 0.05, "_s": 0.02, "q": 1e-3, "q_goal": 1e-3}
"""Tolerances of stored numbers on another kind of machine or with other versions, by the end of
the column's name: m, degrees, s (two samples of a motion and rounding), rad. With the same machine and
versions the tolerance is 0."""

EPISODE_TOLERANCE = 0.05
"""Tolerance of all numbers of an episode, in s, m, m/s and shares: about one time step."""

MOST_OTHER_CHOICES = 0.1
"""On another machine, choices may differ in this share of rows: between two grasps of nearly the same
cost, or two places that are nearly as near. Answers of a different method differ in nearly all rows."""

CHOICES = (
    "answer",
    "nearest_pair",
    "presented_by",
    *(n for n in DETAIL_SCHEMA.names if n.startswith("witness_")),
)


@dataclass(frozen=True)
class Difference:
    """A stored value that differs from the evaluator's; `borderline`: float32 does not decide that
    trial's verdict."""

    trial_id: int
    column: str
    stored: Any
    again: Any
    borderline: bool

    def __str__(self) -> str:
        words = [
            f"{v:.6g}" if isinstance(v, float) else "none" if v is None else str(v)[:200]
            for v in (self.stored, self.again)
        ]
        mark = " (borderline: float32 does not decide this trial)" if self.borderline else ""
        return f"trial {self.trial_id}: {self.column} is stored as {words[0]}, scored again it is {words[1]}{mark}"


@dataclass(frozen=True)
class Reevaluation:
    """The outcome of one method's reevaluation.

    Args:
        method: its name.
        stored: rows in the run folder.
        scored: rows that were judged again.
        equal: rows of those that are equal bit for bit, with a built-in method's answers.
        differences: the values that differ.
        asked: a sentence: whether the method answered again, or why not.
    """

    method: str
    stored: int
    scored: int
    equal: int
    differences: tuple[Difference, ...]
    asked: str


@check_arguments(
    run=instance_of(Run, "what load_run(FOLDER) gives"),
    method=text,
    n=integer(0),
    judge=instance_of(Judge, "Judge(RUN)"),
    seed=optional(integer(0)),
)
def reevaluate(
    run: Run, method: str, n: int, judge: Judge, *, seed: int | None = None
) -> Reevaluation:
    """Judge `n` rows of a method again, drawn without replacement; one shard is in memory.

    Args:
        run: the stored run.
        method: name of the method.
        n: rows; all of them if the run has fewer.
        judge: the evaluator of the run.
        seed: of the draw.

    Raises:
        RunError: the run holds no poses.
    """
    check_poses(run)
    entry = run.entry(method)
    total = sum(s.shard.last - s.shard.first for s in entry.shards.values())
    chosen = np.sort(np.random.default_rng(seed).choice(total, min(n, total), replace=False))
    job, asked = _who_answers(run, entry, judge)
    LOG.info(f"{method}: judging {len(chosen)} of {total} rows again")
    differences: list[Difference] = []
    unequal: set[int] = set()
    kinds = (
        "trials",
        "poses",
        "details",
        "paths",
        *(["episodes"] if judge.loop is not None else []),
    )
    question = Question("reevaluate", None, 1, partial(_differing, job=job))
    for found, moved in answers(
        question, run, method, judge, kinds=kinds, positions=chosen, at_once=max(total, 1)
    ):
        differences += found
        unequal |= moved
    unequal |= {d.trial_id for d in differences}
    if judge.other:
        differences = [d for d in differences if not _close(d)]
        loose = [d for d in differences if d.column.rpartition(" ")[2] in CHOICES]
        if len({d.trial_id for d in loose}) <= MOST_OTHER_CHOICES * len(chosen):
            differences = [d for d in differences if d not in loose]
    counts = (total, len(chosen), len(chosen) - len(unequal))
    asked += judge.played
    return Reevaluation(method, *counts, tuple(differences), asked)


def _differing(judge: Judge, part: Part, *, job: Job | None) -> tuple[list[Difference], set[int]]:
    """What differs of a part, and the ids of trials that the method answers with other bits now."""
    differences: list[Difference] = []
    moved: set[int] = set()
    if job is not None:
        differences, moved = _differing_answers(job, part, judge)
    return [*differences, *_differing_rows(part, judge)], moved


def _who_answers(run: Run, entry: Entry, judge: Judge) -> tuple[Job | None, str]:
    """The built-in method to be asked again, and a phrase; `RunError` if it has another name, or
    options that it does not take."""
    try:
        job = job_of_run(run.header, entry.source, judge.evaluator)
    except NotBuiltIn as error:
        return None, f"not asked again: {error}"
    except UsageError as error:
        raise RunError(f"{run.folder}: {entry.name!r} cannot be called again: {error}") from None
    if job.name != entry.name:
        function = entry.source["function"]
        words = f"{entry.name!r} is said to be {function}, which is called {job.name!r}"
        raise RunError(f"{run.folder}: {words}")
    return job, "asked again for the same trials"


def _differing_answers(job: Job, part: Part, judge: Judge) -> tuple[list[Difference], set[int]]:
    """The trials to which the method now gives another answer than the stored one, and the ids of those
    whose answers do not have the same bits."""
    ids, poses = part.trial_id, part.tables["poses"]
    again = job.predict(judge.trials(ids), None).to("cpu")
    place = {int(trial_id): i for i, trial_id in enumerate(ids)}
    rows = [place[i] for i in poses["trial_id"].to_pylist()]
    off = np.full(len(ids), np.inf)
    off[rows] = 0.0
    tcp = []
    for name, T in (("T_obj_ee", again.T_obj_ee), ("T_world_ee", again.T_world_ee)):
        stored, new = np.full((len(ids), 4, 4), np.nan, np.float32), T.numpy()
        stored[rows] = _matrices(poses[name])
        apart = np.where((stored == new) | (np.isnan(stored) & np.isnan(new)), 0.0, stored - new)
        off = np.maximum(off, np.nan_to_num(np.abs(apart), nan=np.inf).max((1, 2)))
        tcp = [stored[:, :3, 3], new[:, :3, 3]]
    wrong = np.flatnonzero(off > (BORDERLINE_M if judge.other else 0.0))
    words = [["TCP at {:.4g}, {:.4g}, {:.4g} m".format(*p[i]) for p in tcp] for i in wrong]
    found = [
        Difference(int(ids[i]), "answer", a, f"{b} (poses differ by {off[i]:.2g})", False)
        for i, (a, b) in zip(wrong, words)
    ]
    return found, set(ids[off > 0.0].tolist())


def _differing_rows(part: Part, judge: Judge) -> Iterator[Difference]:
    """Every stored value that the evaluator does not give again bit for bit. Of a file of motions, rows without `t_plan_s` were
    judged as given motions."""
    run, stored = part.run, part.tables
    as_motions = part.entry.source.get("kind") == "motions"
    compared = _compared(run)
    again: dict[str, dict[int, dict[str, Any]]] = {kind: {} for kind in compared}
    if as_motions and "paths" not in stored:
        raise RunError(f"{run.folder}: a method of motions has no paths; sweep again")
    poses, rows = stored["poses"], stored["trials"]
    groups: list[tuple[pa.Table, Motions | None]] = [(poses, None)]
    if as_motions:
        unplanned = rows.filter(pc.is_null(rows["t_plan_s"]))["trial_id"]
        paths = stored["paths"].filter(pc.is_in(stored["paths"]["trial_id"], unplanned))
        moved = pc.is_in(poses["trial_id"], paths["trial_id"])
        groups = [(poses.filter(pc.invert(moved)), None), (poses.filter(moved), _motions(paths))]
    for answered, motions in groups:
        if not len(answered):
            continue
        grasp, handover = (_matrices(answered[k]) for k in ("T_obj_ee", "T_world_ee"))
        ids = answered["trial_id"].to_numpy()
        tables = judge.tables(ids, grasp, handover, motions, tuple(stored))
        for kind in again.keys() & tables.keys():
            again[kind] |= _by_id(tables[kind], compared[kind])
    unsure = {i for i, row in again["trials"].items() if row["borderline"]}
    for kind, table in stored.items():
        if kind not in compared:
            continue
        # a run of another version may lack columns; a stored value or null must match
        silent = set(compared[kind]) - set(table.column_names)
        if silent and "code" not in judge.other:
            raise RunError(f"{run.folder}: its {kind} lack column {min(silent)!r}; sweep again")
        found = _by_id(table, compared[kind])
        for trial_id in sorted(found.keys() | again[kind].keys()):
            # without a pose the method gave no answer, and the row must say so
            row = found.get(trial_id, {"trial_id": None})
            same = {k: row.get(k) for k in ("trial_id", "object", "split", "side")}
            none = dict.fromkeys(compared[kind]) | same | {"outcome": "missing"}
            other = again[kind].get(trial_id, none if kind == "trials" else {"trial_id": None})
            # failed by what nobody judges by any more, or nobody here: it passes all the others
            unseen = row.get("outcome") in (*NO_LONGER, ELSEWHERE)
            passes = unseen and other.get("outcome") == "success"
            for k in row.keys() & other.keys() - silent - ({"outcome"} if passes else set()):
                if row[k] != other[k] and repr(row[k]) != repr(other[k]):  # a nan is one
                    name = k if kind == "trials" else f"{kind} {k}"
                    yield Difference(trial_id, name, row[k], other[k], trial_id in unsure)


def _compared(run: Run) -> dict[str, tuple[str, ...]]:
    """`COMPARED` with the columns of what the run's benchmark asks for; without `body_m` of persons who had no head."""
    left_out = TIMING if has_head(run.header) else (*TIMING, "body_m")
    own = schema_of(run.header, "trials").names
    return {**COMPARED, "trials": tuple(n for n in own if n not in left_out)}


def _by_id(table: pa.Table, compared: Sequence[str]) -> dict[int, dict[str, Any]]:
    names = [n for n in compared if n in table.column_names]
    return {row["trial_id"]: row for row in table.select(names).to_pylist()}


def _motions(paths: pa.Table) -> Motions:
    q, length = _postures(paths["q"])
    seconds = paths["time_s"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    plan = () if paths["planned_q"].null_count else _postures(paths["planned_q"])
    return Motions(q, torch.from_numpy(np.array(seconds)), length, *plan)


def _postures(column: pa.ChunkedArray) -> tuple[torch.Tensor, torch.Tensor]:
    """Postures of all rows one after another, and their number in each."""
    lists = column.combine_chunks()
    postures = lists.flatten()
    flat = postures.flatten().to_numpy(zero_copy_only=False).reshape(-1, postures.type.list_size)
    counts = lists.value_lengths().to_numpy(zero_copy_only=False).astype(np.int64)
    return torch.from_numpy(np.array(flat)), torch.from_numpy(counts)


def _matrices(column: pa.ChunkedArray) -> np.ndarray:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return np.asarray(flat, np.float32).reshape(-1, 4, 4)


def tolerances() -> str:
    """The tolerances in words: 0.0001 m, 0.05 deg, 0.02 s, 0.001 rad."""
    named = {
        "m": TOLERANCES["_m"],
        "deg": TOLERANCES["_deg"],
        "s": TOLERANCES["_s"],
        "rad": TOLERANCES["q"],
    }
    return ", ".join(f"{value:g} {unit}" for unit, value in named.items())


def _close(difference: Difference) -> bool:
    """Whether another kind of processor or other versions explain the difference."""
    a, b, column = difference.stored, difference.again, difference.column
    if a is None or b is None:
        return False
    if column.startswith("episodes ") and isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= EPISODE_TOLERANCE
    if column.startswith("margin_kind_"):  # it follows from the margin, which is compared
        return True
    ends = [most for end, most in TOLERANCES.items() if column.endswith(end)]
    try:
        apart = np.abs(np.subtract(a, b, dtype=np.float64))
    except (TypeError, ValueError):  # words, or postures of other numbers
        return False
    return bool(ends) and bool((apart <= ends[0]).all())
