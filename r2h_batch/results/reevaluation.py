"""Judge a random sample of stored rows again, from the poses stored beside them.

sha256 and receipts show that a file is as it was written, but whoever writes a row can write those
too. Nobody can make up a verdict: trials follow from their ids and poses are stored, so the
evaluator computes it again.
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
from r2h_batch.launch import cpu_threads
from r2h_batch.runs import provenance
from r2h_batch.runs.rows import LATER_COLUMNS, TRIAL_SCHEMA, TrialNames, score_rows
from r2h_batch.runs.store import TIMING, Run, RunError
from r2h_batch.trials.protocol import PROTOCOLS, trials_of
from r2h_batch.validate import check_arguments, instance_of, integer, optional, text
from r2h_batch.verdicts import SIDES

COMPARED = tuple(name for name in TRIAL_SCHEMA.names if name not in TIMING)

LATER_OPTIONS = ("receiver", "estimate", "candidates")
"""Of `EvalConfig`: options that older runs do not name, for they had no other way."""

MARGIN_TOLERANCE_M = BORDERLINE_M
TIME_TOLERANCE_S = 0.05  # and for degrees
"""What stored numbers may differ by on another kind of machine or with other versions; on the same,
by nothing."""


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
    """

    method: str
    stored: int
    scored: int
    equal: int
    differences: tuple[Difference, ...]


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

    def rows(self, trial_id: Any, T_obj_ee: Any, T_world_ee: Any) -> pa.Table:
        """`TRIAL_SCHEMA` rows of (N,) trials answered with (N, 4, 4) poses: as the sweep stores
        them."""
        scene = self.evaluator.scene
        trials = trials_of(self.benchmark, torch.from_numpy(np.array(trial_id, np.int64))).to(
            scene.device
        )
        grasp, handover = (
            torch.from_numpy(np.array(T, np.float32)).to(scene.device)
            for T in (T_obj_ee, T_world_ee)
        )
        names = TrialNames(
            objects=[o.name for o in scene.objects],
            object_splits=[o.split for o in scene.objects],
            hand_sides=[SIDES[s] for s in scene.hands.set.side.tolist()],
        )
        return score_rows(trials, self.evaluator.score(grasp, handover, trials), names)


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
    receipts = run.entry(method)["receipts"]
    sizes = {index: r["last"] - r["first"] for index, r in sorted(receipts.items())}
    ends = np.cumsum([0, *sizes.values()])
    total = int(ends[-1])
    chosen = np.sort(np.random.default_rng(seed).choice(total, min(n, total), replace=False))
    equal, differences = 0, []
    for place, index in enumerate(sizes):
        rows = chosen[(chosen >= ends[place]) & (chosen < ends[place + 1])] - ends[place]
        if len(rows):
            stored = run.shard("trials", method, index).take(pa.array(rows))
            same, found = _shard_again(stored, run.shard("poses", method, index), judge)
            equal += same
            differences += found
    return Reevaluation(method, total, len(chosen), equal, tuple(differences))


def _shard_again(stored: pa.Table, poses: pa.Table, judge: Judge) -> tuple[int, list[Difference]]:
    """How many rows are equal bit for bit, and what differs by more than the machine explains."""
    ids = stored["trial_id"].to_numpy()
    posed = poses.filter(pc.is_in(poses["trial_id"], stored["trial_id"]))
    again: dict[int, dict[str, Any]] = {}
    if len(posed):
        T = [_matrices(posed[k]) for k in ("T_obj_ee", "T_world_ee")]
        rows = judge.rows(posed["trial_id"].to_numpy(), *T).select(COMPARED).to_pylist()
        again = {row["trial_id"]: row for row in rows}
    # an older run lacks some columns; they are read as null and claim nothing
    silent = [k for k in LATER_COLUMNS if stored[k].null_count == len(stored)]
    equal, found = 0, []
    for trial_id, row in zip(ids, stored.select(COMPARED).to_pylist()):
        # without a pose the method gave no answer, and the row must say so
        same = {k: row[k] for k in ("trial_id", "object", "split", "side")}
        other = again.get(int(trial_id), {**dict.fromkeys(COMPARED), **same, "outcome": "missing"})
        differing = [k for k in COMPARED if row[k] != other[k] and k not in silent]
        equal += not differing
        found += [
            Difference(row["trial_id"], k, row[k], other[k], bool(other["borderline"]))
            for k in differing
            if not judge.other or not _close(k, row[k], other[k])
        ]
    return equal, found


def _matrices(column: pa.ChunkedArray) -> np.ndarray:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return np.asarray(flat, np.float32).reshape(-1, 4, 4)


def _close(column: str, a: Any, b: Any) -> bool:
    if not (isinstance(a, float) and isinstance(b, float)):
        return False
    lengths = column.startswith("margin_") or column == "presented_distance_m"
    return abs(a - b) <= (MARGIN_TOLERANCE_M if lengths else TIME_TOLERANCE_S)
