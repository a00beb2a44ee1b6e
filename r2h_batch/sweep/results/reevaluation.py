"""Judge a random sample of stored rows again, from the poses stored beside them.

A digest shows that a file is as it was written, but a forger can write digests too. So verdicts are
computed again: trials follow from their ids, and poses are stored. A built-in method answers the
sampled trials again, so its rows cannot hold the poses of another method. A user's method is not run,
because a folder may come from anybody.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from pydantic import TypeAdapter

from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.progress import progress
from r2h_batch.base.validate import check_arguments, instance_of, integer, optional, text
from r2h_batch.config import BORDERLINE_M, EvalConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.observe.sees import Sees
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.protocols.of_run import benchmark_of_run
from r2h_batch.runs import provenance
from r2h_batch.runs.files import RunError
from r2h_batch.runs.header import TIMING, schema_of
from r2h_batch.runs.methods import Entry
from r2h_batch.runs.plugged import criteria_since
from r2h_batch.runs.rows import DETAIL_SCHEMA, EPISODE_SCHEMA, PATH_SCHEMA, TRIAL_SCHEMA, TrialNames
from r2h_batch.runs.store import Run
from r2h_batch.sweep.jobs import Job, NotBuiltIn, job_of_run
from r2h_batch.sweep.scoring import judged_tables
from r2h_batch.trials.predictions import Motions
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import ELSEWHERE, NO_LONGER

if TYPE_CHECKING:
    from r2h_batch.closed_loop.episodes import Loop

COMPARED = {
    "trials": tuple(name for name in TRIAL_SCHEMA.names if name not in TIMING),
    "details": tuple(DETAIL_SCHEMA.names),
    "paths": tuple(PATH_SCHEMA.names),
    "episodes": tuple(EPISODE_SCHEMA.names),
}
"""Columns that are judged again; poses are what they are judged from."""

LATER_OPTIONS = ("receiver", "estimate", "candidates", "execution_error", "object_errors")
"""Options of `EvalConfig` that older runs do not name, because the option did not exist then. Today's default is what
those runs did."""

TOLERANCES = {"_m": BORDERLINE_M, "_deg": 0.05, "_s": 0.02, "q": 1e-3, "q_goal": 1e-3}
"""Tolerances of stored numbers on another kind of machine or with other versions, by the end of
the column's name: m, degrees, s (two samples of a motion and rounding), rad. With the same machine and
versions the tolerance is 0."""

EPISODE_TOLERANCE = 0.05
"""Tolerance of all numbers of an episode, in s, m, m/s and shares: about one time step."""

MOST_OTHER_CHOICES = 0.1
"""On another machine, choices may differ in this share of rows: between two grasps of nearly the same
cost, or two places that are nearly as near. Answers of a different method differ in nearly all rows."""

CHOICES = ("answer", "nearest_pair", *(n for n in DETAIL_SCHEMA.names if n.startswith("witness_")))


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


class Judge:
    """The evaluator that a run folder describes; objects and hands must have the run's digests.

    `other` names what has changed since the rows were scored: code, versions, processor. If it is
    empty, every bit must agree.

    Args:
        run: what `load_run(FOLDER)` gives.
        given: where its files are now, if they are not where the sweep found them.
        device: cpu, cuda or cuda:N.
    """

    def __init__(self, run: Run, *, given: BenchmarkChoice | None = None, device: str = "cpu"):
        instance_of(Run, "what load_run(FOLDER) gives")("run", run)
        optional(instance_of(BenchmarkChoice, "flags of the benchmark"))("given", given)
        header, where = run.header, run.folder
        config = configuration(header["configuration"], str(where))
        self.benchmark = benchmark_of_run(header, given or BenchmarkChoice(), str(where))
        plans_in = Sees.planning(header)
        self.evaluator = Evaluator(self.benchmark, config, device=device, plans_in=plans_in)
        self.other = _other(header, device)
        self.loop, self.played = _loop_of(header["digests"].get("closed_loop"), run)

    def trials(self, trial_id: Any) -> Trials:
        """The trials with these ids, on the evaluator's device.

        Args:
            trial_id: (N,) whole numbers.
        """
        ids = torch.from_numpy(np.array(trial_id, np.int64))
        return self.benchmark.trials_with_ids(ids).to(self.evaluator.scene.device)

    def tables(
        self, trial_id: Any, T_obj_ee: Any, T_world_ee: Any, motions: Motions | None = None,
        stored: Sequence[str] = (),
    ) -> dict[str, pa.Table]:  # fmt: skip
        """Tables of answered trials, as the sweep stores them: `trials` and the kinds of `stored`.

        Args:
            trial_id: (N,) whole numbers.
            T_obj_ee: (N, 4, 4) grasps, metres.
            T_world_ee: (N, 4, 4) handover poses, metres.
            motions: motions to judge in place of planned ones.
            stored: further kinds: details, poses, paths.
        """
        scene, trials = self.evaluator.scene, self.trials(trial_id)
        grasp, handover = (
            torch.from_numpy(np.array(T, np.float32)).to(scene.device)
            for T in (T_obj_ee, T_world_ee)
        )
        answers = Predictions(trials.trial_id, grasp, handover)
        every = torch.arange(len(trials), dtype=torch.int64, device="cpu")
        padded = None if motions is None else motions.padded(every, scene.device)
        names = TrialNames.of(scene)
        return judged_tables(self.evaluator, trials, answers, padded, stored, names, self.loop)


def _loop_of(identity: Any, run: Run) -> tuple["Loop | None", str]:
    """The policy that plays the run's episodes again, or the reason why none does."""
    if "episodes" not in run.header["stored"]:
        return None, ""
    if not isinstance(identity, str):
        raise RunError(f"{run.folder}: run.json does not say how its episodes were played")
    if "pick" in run.header.get("asks", ()):
        return (
            None,
            "; episodes not played again: they began on the table, and r2h_batch 0.3 played those",
        )
    if find_spec("gymnasium") is None:
        return None, "; episodes not played again: pip install 'r2h_batch[env]'"
    from r2h_batch.closed_loop.episodes import Loop

    try:
        return Loop.of(identity), "; episodes played again"
    except ValueError as error:
        return None, f"; episodes not played again: {error}"


def configuration(data: Mapping[str, Any], where: str) -> EvalConfig:
    """The `EvalConfig` of a run.json; `RunError` where this version has other fields, or one is out
    of bounds.

    Args:
        data: the entry `configuration`.
        where: the folder, for the error.
    """
    kind = TypeAdapter(EvalConfig)
    try:
        config = kind.validate_json(json.dumps(data), strict=True)
    except ValueError as error:  # pydantic's ValidationError is one
        what = " ".join(str(error).split())[:200]
        words = f"its configuration cannot be judged by this version ({what})"
        raise RunError(f"{where}: {words}") from None
    again, now = (json.loads(kind.dump_json(c)) for c in (config, EvalConfig()))
    older: dict[str, Any] = json.loads(json.dumps(data))
    if isinstance(older.get("plan"), dict):  # options that came later say what there was before
        older["plan"] = {"hand": now["plan"]["hand"], **older["plan"]}
    older = {k: now[k] for k in LATER_OPTIONS} | older
    if again != older:
        odd = [k for k in {**again, **older} if again.get(k) != older.get(k)]
        raise RunError(f"{where}: its configuration is of another version: {', '.join(odd)[:200]}")
    return config


def _other(header: Mapping[str, Any], device: str) -> tuple[str, ...]:
    """All that could move a last bit: the digest of the code, versions, the kind of processor."""
    criteria = criteria_since(header)
    same_code = header["digests"].get("code") == provenance.code_digest() and not criteria
    other = [] if same_code else ["code", *criteria]
    installed = provenance.versions()
    other += [k for k, v in header["versions"].items() if k != "python" and installed.get(k) != v]
    device_name = provenance.device_name(device)
    # "cpu: MODEL, N cores"
    same = device_name.rpartition(",")[0] == str(header["device"]["name"]).rpartition(",")[0]
    return (*other, *([] if same else ["processor"]))


def check_poses(run: Run) -> None:
    """`RunError` if the run holds no poses.

    Args:
        run: what `load_run(FOLDER)` gives.
    """
    if "poses" not in run.header["stored"]:
        words = "stored without poses; sweep again without no_poses into another --out"
        raise RunError(f"{run.folder}: {words}")


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
    sizes = {i: s.shard.last - s.shard.first for i, s in sorted(entry.shards.items())}
    ends = np.cumsum([0, *sizes.values()])
    total = int(ends[-1])
    chosen = np.sort(np.random.default_rng(seed).choice(total, min(n, total), replace=False))
    job, asked = _who_answers(run, entry, judge)
    LOG.info(f"{method}: judging {len(chosen)} of {total} rows again")
    differences: list[Difference] = []
    unequal: set[int] = set()
    with progress(f"{method}: judging again", len(chosen), "rows") as told:
        for place, index in enumerate(sizes):
            rows = chosen[(chosen >= ends[place]) & (chosen < ends[place + 1])] - ends[place]
            if not len(rows):
                continue
            files = entry.shards[index].kinds
            kinds: list[str] = [k for k in ("trials", "poses", "details", "paths") if k in files]
            kinds += ["episodes"] if judge.loop is not None and "episodes" in files else []
            stored = {kind: run.shard(kind, method, index) for kind in kinds}
            ids = stored["trials"]["trial_id"].take(pa.array(rows))
            stored = {
                k: table.filter(pc.is_in(table["trial_id"], ids)) for k, table in stored.items()
            }
            if job is not None:
                other, moved = _differing_answers(job, ids.to_numpy(), stored["poses"], judge)
                differences, unequal = differences + other, unequal | moved
            as_motions = entry.source.get("kind") == "motions"
            differences += _differing_rows(run, stored, as_motions, judge)
            told(len(rows))
    unequal |= {d.trial_id for d in differences}
    if judge.other:
        differences = [d for d in differences if not _close(d)]
        loose = [d for d in differences if d.column.rpartition(" ")[2] in CHOICES]
        if len({d.trial_id for d in loose}) <= MOST_OTHER_CHOICES * len(chosen):
            differences = [d for d in differences if d not in loose]
    counts = (total, len(chosen), len(chosen) - len(unequal))
    asked += judge.played
    return Reevaluation(method, *counts, tuple(differences), asked)


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


def _differing_answers(
    job: Job, ids: np.ndarray, poses: pa.Table, judge: Judge
) -> tuple[list[Difference], set[int]]:
    """The trials to which the method now gives another answer than the stored one, and the ids of those
    whose answers do not have the same bits."""
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


def _differing_rows(
    run: Run, stored: Mapping[str, pa.Table], as_motions: bool, judge: Judge
) -> Iterator[Difference]:
    """Every stored value that the evaluator does not give again bit for bit; `as_motions`: the method is a
    file of motions. Rows without `t_plan_s` were judged as given motions."""
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
    for part, motions in groups:
        if not len(part):
            continue
        grasp, handover = (_matrices(part[k]) for k in ("T_obj_ee", "T_world_ee"))
        ids = part["trial_id"].to_numpy()
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
    """`COMPARED` with the columns of what the run's benchmark asks for."""
    own = schema_of(run.header, "trials").names
    return {**COMPARED, "trials": tuple(n for n in own if n not in TIMING)}


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
