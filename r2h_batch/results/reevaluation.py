"""Judge a random sample of stored rows again, from the poses stored beside them.

sha256 and receipts show that a file is as it was written, but whoever writes a row can write those
too. Nobody can make up a verdict: trials follow from their ids and poses are stored, so the
evaluator computes it again. Nor can anybody give a built-in method the poses of another one: it
answers the sampled trials again. A user's method is not run: a folder may come from anybody.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from pydantic import TypeAdapter, ValidationError

from r2h_batch.benchmark.build import BenchmarkOverrides, benchmark_of_run
from r2h_batch.benchmark.trials_file import LISTED
from r2h_batch.config import BORDERLINE_M, EvalConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.frontier.levels import Form, planning_form
from r2h_batch.launch import cpu_threads
from r2h_batch.predictions import Motions
from r2h_batch.runs import provenance
from r2h_batch.runs.rows import LATER_COLUMNS, TRIAL_SCHEMA, TrialNames, score_rows
from r2h_batch.runs.store import TIMING, Run, RunError
from r2h_batch.sweep.jobs import Job, job_of_run
from r2h_batch.sweep.options import UsageError
from r2h_batch.trials.protocol import PROTOCOLS, trials_of
from r2h_batch.types import Trials
from r2h_batch.validate import check_arguments, instance_of, integer, optional, text

COMPARED = tuple(name for name in TRIAL_SCHEMA.names if name not in TIMING)

LATER_OPTIONS = ("receiver", "estimate", "candidates", "execution_error")
"""Of `EvalConfig`: options that older runs do not name, for they had no other way."""

MARGIN_TOLERANCE_M = BORDERLINE_M
TIME_TOLERANCE_S = 0.05  # and for degrees
"""What stored numbers may differ by on another kind of machine or with other versions; on the same,
by nothing."""

MOST_OTHER_ANSWERS = 0.1
"""Share of answers that may differ on another kind of machine, where a choice between two grasps of
nearly the same cost can fall the other way. Of another method's answers nearly all differ."""


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
            f"{v:.6g}" if isinstance(v, float) else "none" if v is None else v
            for v in (self.stored, self.again)
        ]
        mark = " (borderline: float32 does not decide this trial)" if self.borderline else ""
        return f"trial {self.trial_id}: {self.column} is stored as {words[0]}, scored again it is {words[1]}{mark}"


@dataclass(frozen=True)
class Reevaluation:
    """What came of one method.

    Args:
        method: its name.
        stored: rows in the run folder.
        scored: rows that were judged again.
        equal: rows of those that are equal bit for bit.
        differences: the values that differ.
        asked: whether the method answered again, and if not, why.
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
        given: the flags that the sweep had.
        device: cpu, cuda or cuda:N.
        threads: CPU threads; None: all cores.
    """

    def __init__(
        self,
        run: Run,
        *,
        given: BenchmarkOverrides | None = None,
        device: str = "cpu",
        threads: int | None = None,
    ):
        instance_of(Run, "what load_run(FOLDER) gives")("run", run)
        optional(instance_of(BenchmarkOverrides, "flags of the benchmark"))("given", given)
        cpu_threads(threads)
        header, where = run.header, run.folder
        if header["protocol"] not in (*PROTOCOLS, LISTED):
            known = ", ".join(PROTOCOLS)
            raise RunError(
                f"{where}: protocol {header['protocol']!r}; this version makes the trials of {known}"
            )
        config = configuration(header["configuration"], str(where))
        self.benchmark = benchmark_of_run(header, given or BenchmarkOverrides(), str(where))
        self.evaluator = Evaluator.from_benchmark(
            self.benchmark, config, device=device, threads=threads
        )
        self.other = _other(header, device)
        # searched paths, and what depends on them, are the form's own (docs/gpu.md)
        self.form: Form = "one_thread" if header["device"]["kind"] == "cpu" else "frontier"

    def trials(self, trial_id: Any) -> Trials:
        """The trials with these ids, on the evaluator's device."""
        ids = torch.from_numpy(np.array(trial_id, np.int64))
        return trials_of(self.benchmark, ids).to(self.evaluator.scene.device)

    def rows(
        self, trial_id: Any, T_obj_ee: Any, T_world_ee: Any, motions: Motions | None = None
    ) -> pa.Table:
        """`TRIAL_SCHEMA` rows of (N,) trials answered with (N, 4, 4) poses, or with grasps and
        motions: as the sweep stores them."""
        scene, trials = self.evaluator.scene, self.trials(trial_id)
        grasp, handover = (
            torch.from_numpy(np.array(T, np.float32)).to(scene.device)
            for T in (T_obj_ee, T_world_ee)
        )
        with planning_form(self.form):
            if motions is None:
                scores = self.evaluator.score(grasp, handover, trials)
            else:
                every = torch.arange(len(trials), dtype=torch.int64, device="cpu")
                given = motions.padded(every, scene.device)
                scores = self.evaluator.score_motion(grasp, trials=trials, **given)
        return score_rows(trials, scores, TrialNames.of(scene))


def configuration(data: Mapping[str, Any], where: str) -> EvalConfig:
    """The `EvalConfig` of a run.json; `RunError` where this version has other fields, or one is out
    of bounds."""
    try:
        config = TypeAdapter(EvalConfig).validate_json(json.dumps(data), strict=True)
    except (ValidationError, ValueError) as error:
        what = " ".join(str(error).split())[:200]
        raise RunError(
            f"{where}: its configuration cannot be judged by this version ({what})"
        ) from None
    again = json.loads(TypeAdapter(EvalConfig).dump_json(config))
    data = _with_later(json.loads(json.dumps(data)))
    if again != data:
        odd = [k for k in {**again, **data} if again.get(k) != data.get(k)]
        raise RunError(f"{where}: its configuration is of another version: {', '.join(odd)[:200]}")
    return config


def _with_later(data: dict[str, Any]) -> dict[str, Any]:
    """A run.json's configuration with the options that came later, at the value that says what
    there was before."""
    now = json.loads(TypeAdapter(EvalConfig).dump_json(EvalConfig()))
    plan = data.get("plan")
    if isinstance(plan, dict):
        data = {**data, "plan": {"hand": now["plan"]["hand"], **plan}}
    return {**{k: now[k] for k in LATER_OPTIONS}, **data}


def _other(header: Mapping[str, Any], device: str) -> tuple[str, ...]:
    """What could move a last bit: the digest of the code, versions, the kind of processor."""
    other = [] if header["digests"].get("code") == provenance.code_digest() else ["code"]
    mine = provenance.versions()
    other += [k for k, v in header["versions"].items() if k != "python" and mine.get(k) != v]
    here = provenance.device_name(device)
    # "cpu: MODEL, N cores"
    same = here.rpartition(",")[0] == str(header["device"]["name"]).rpartition(",")[0]
    return (*other, *([] if same else ["processor"]))


def check_poses(run: Run) -> None:
    """`RunError` if the run holds no poses."""
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
    sizes = {index: r["last"] - r["first"] for index, r in sorted(entry["receipts"].items())}
    ends = np.cumsum([0, *sizes.values()])
    total = int(ends[-1])
    chosen = np.sort(np.random.default_rng(seed).choice(total, min(n, total), replace=False))
    job, asked = _who_answers(run, entry, judge)
    differences, answers, unequal = [], [], set()
    for place, index in enumerate(sizes):
        rows = chosen[(chosen >= ends[place]) & (chosen < ends[place + 1])] - ends[place]
        if not len(rows):
            continue
        stored, poses = (run.shard(kind, method, index) for kind in ("trials", "poses"))
        stored = stored.take(pa.array(rows))
        poses = poses.filter(pc.is_in(poses["trial_id"], stored["trial_id"]))
        if job is not None:
            answers += _other_answers(job, stored["trial_id"].to_numpy(), poses, judge)
        paths = None
        if entry["source"].get("kind") == "motions":
            paths = run.shard("paths", method, index)
        for difference in _other_rows(stored, poses, paths, judge):
            unequal.add(difference.trial_id)
            if not judge.other or not _close(difference):
                differences.append(difference)
    unequal |= {d.trial_id for d in answers}
    if not judge.other or len(answers) > MOST_OTHER_ANSWERS * len(chosen):
        differences = [*answers, *differences]
    return Reevaluation(
        method, total, len(chosen), len(chosen) - len(unequal), tuple(differences), asked
    )


def _who_answers(run: Run, entry: Mapping[str, Any], judge: Judge) -> tuple[Job | None, str]:
    """The built-in method to be asked again, and a phrase; `RunError` if it has another name."""
    if "code" in judge.other:
        return None, "not asked again: its code is not the one that answered"
    try:
        job = job_of_run(run.header, entry, judge.evaluator)
    except UsageError as error:
        return None, f"not asked again: {error}"
    if job.name != entry["name"]:
        function = entry["source"]["function"]
        words = f"{entry['name']!r} is said to be {function}, which is called {job.name!r}"
        raise RunError(f"{run.folder}: {words}")
    return job, "asked again for the same trials"


def _other_answers(job: Job, ids: np.ndarray, poses: pa.Table, judge: Judge) -> list[Difference]:
    """The trials to which the method now gives another answer than the stored one."""
    with planning_form(judge.form):
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
    wrong = np.flatnonzero(off > (MARGIN_TOLERANCE_M if judge.other else 0.0))
    words = [["TCP at {:.4g}, {:.4g}, {:.4g} m".format(*p[i]) for p in tcp] for i in wrong]
    return [
        Difference(int(ids[i]), "answer", a, f"{b} (poses differ by {off[i]:.2g})", False)
        for i, (a, b) in zip(wrong, words)
    ]


def _other_rows(
    stored: pa.Table, poses: pa.Table, paths: pa.Table | None, judge: Judge
) -> list[Difference]:
    """Every stored value that the evaluator does not give again bit for bit; `paths`: those of a
    file of motions. A motion was judged as it is where nothing was planned."""
    again: dict[int, dict[str, Any]] = {}
    groups: list[tuple[pa.Table, Motions | None]] = [(poses, None)]
    if paths is not None:
        unplanned = stored.filter(pc.is_null(stored["t_plan_s"]))["trial_id"]
        paths = paths.filter(pc.is_in(paths["trial_id"], unplanned))
        moved = pc.is_in(poses["trial_id"], paths["trial_id"])
        groups = [(poses.filter(pc.invert(moved)), None), (poses.filter(moved), _motions(paths))]
    for part, motions in groups:
        if not len(part):
            continue
        grasp, handover = (_matrices(part[k]) for k in ("T_obj_ee", "T_world_ee"))
        ids = part["trial_id"].to_numpy()
        rows = judge.rows(ids, grasp, handover, motions).select(COMPARED).to_pylist()
        again |= {row["trial_id"]: row for row in rows}
    # an older run lacks some columns; they are read as null and claim nothing
    silent = [k for k in LATER_COLUMNS if stored[k].null_count == len(stored)]
    found = []
    for row in stored.select(COMPARED).to_pylist():
        # without a pose the method gave no answer, and the row must say so
        same = {k: row[k] for k in ("trial_id", "object", "split", "side")}
        none = {**dict.fromkeys(COMPARED), **same, "outcome": "missing"}
        other = again.get(row["trial_id"], none)
        found += [
            Difference(row["trial_id"], k, row[k], other[k], bool(other["borderline"]))
            for k in COMPARED
            if row[k] != other[k] and k not in silent
        ]
    return found


def _motions(paths: pa.Table) -> Motions:
    q, length = _postures(paths["q"])
    seconds = paths["time_s"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    plan = () if paths["planned_q"].null_count else _postures(paths["planned_q"])
    return Motions(q, torch.from_numpy(np.array(seconds)), length, *plan)


def _postures(column: pa.ChunkedArray) -> tuple[torch.Tensor, torch.Tensor]:
    """Postures of all rows one after another, and their number in each."""
    lists = column.combine_chunks()
    flat = lists.flatten().flatten().to_numpy(zero_copy_only=False).reshape(-1, 6)
    counts = lists.value_lengths().to_numpy(zero_copy_only=False).astype(np.int64)
    return torch.from_numpy(np.array(flat)), torch.from_numpy(counts)


def _matrices(column: pa.ChunkedArray) -> np.ndarray:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return np.asarray(flat, np.float32).reshape(-1, 4, 4)


def _close(difference: Difference) -> bool:
    """Whether another kind of processor or other versions explain the difference."""
    a, b, column = difference.stored, difference.again, difference.column
    if column.startswith("margin_kind_"):  # it follows from the margin, which is compared
        return True
    if not (isinstance(a, float) and isinstance(b, float)):
        return False
    lengths = column.startswith("margin_") or column == "presented_distance_m"
    return abs(a - b) <= (MARGIN_TOLERANCE_M if lengths else TIME_TOLERANCE_S)
