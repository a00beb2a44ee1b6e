"""One trial of a run folder, whole: what is stored, and what is not, computed again.

The built-in methods and the evaluator draw by trial number and not from a stream, so one trial
alone gives the same bits as in its batch. `StoredTrial.note` says where a computed verdict differs
from the stored one (another machine, another version).
"""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow.compute as pc
import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter

from r2h_batch.base import se3
from r2h_batch.base.errors import AnswerError, FileError, UsageError
from r2h_batch.config import EvalConfig, ExecutionError, ObjectErrors, Workplace
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.observe.sees import Sees
from r2h_batch.runs.files import RunError
from r2h_batch.runs.store import UNJUDGED, Run, load_run
from r2h_batch.scene.robot import Robot
from r2h_batch.sweep.jobs import job_of_run
from r2h_batch.sweep.rows import TrialNames, detail_rows, path_rows, score_rows
from r2h_batch.trials.benchmark import Benchmark, trials_digest
from r2h_batch.trials.of_run import benchmark_of_run
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import ELSEWHERE, EVERY, IN_ORDER, MOST_SECONDS, NO_LONGER, UNITS
from r2h_batch.view.believed import as_believed
from r2h_batch.view.legs import with_legs
from r2h_batch.view.postures import postures_at
from r2h_batch.view.stored_trial import StoredTrial

Array = NDArray[np.float64]

CHECKED_TRIALS = 20_000
"""Runs of at most this many trials have their whole trial list compared with its digest."""
SAME_M = 1e-6
"""Margins that differ by no more than this are the same: float32 of numbers below 10 m."""
POSES = ("T_obj_ee", "T_world_ee")


Section = TypeVar("Section")


class Reader:
    """Trials of one run folder, one after the other; `run` is the folder, or what `load_run` gave. `code`: functions that
    the run names and that may run."""

    def __init__(self, run: str | Path | Run, code: Collection[str] = ()) -> None:
        self.run: Run = run if isinstance(run, Run) else load_run(run)
        self.where = str(self.run.folder)
        self.code = code
        self._rows: dict[str, Any] = {}

    def method(self, word: str | None = None) -> str:
        """The full name of a method; the only one where none is named (`Run.complete`)."""
        return self.run.complete(word)

    def rows(self, method: str) -> Any:
        """All rows of a method, a pyarrow table."""
        if method not in self._rows:
            self._rows[method] = self.run.trials(method)
        return self._rows[method]

    def trial(self, trial_id: int, method: str | None = None) -> StoredTrial:
        """The trial as it was scored.

        Raises:
            RunError: no such trial or method, it was not judged, it cannot be computed again, or the
                run folder is damaged.
        """
        name, stored = self.method(method), self.run.header["stored"]
        found = _rows(self.rows(name), trial_id)
        if not found or found[0]["outcome"] in UNJUDGED:
            self.run.holding(trial_id, [name])  # it raises
        row = found[0]
        for details in _rows(self.run.details(name), trial_id) if "details" in stored else ():
            row |= details
        trial = self.trial_of(row)
        poses = _rows(self.run.poses(name), trial_id) if "poses" in stored else []
        path = _rows(self.run.paths(name), trial_id) if "paths" in stored else []
        if not _possible(poses, path):
            words = "no motion can be: numbers are missing, not finite or out of order"
            raise RunError(f"{self.where}: trial {trial_id} of {name!r} is stored as {words}")
        answer = None
        if poses:
            T = {k: _tensor(poses[0][k], torch.float32).reshape(1, 4, 4) for k in POSES}
            answer = Predictions(trial.trial_id, **T, method=name)
        if answer is not None and path and "details" in stored:
            own = self.benchmark
            place = (own.objects, own.hand_set, own.robot, own.workplace)
            moved = _stored(self.run.header, name, row, path[0], trial, answer, *place)
            return self._whole(moved, trial, answer)
        try:
            header, evaluator = self.run.header, self.evaluator
            source = self.run.entry(name).source
            answer = answer or job_of_run(header, source, evaluator).predict(trial, None)
        except (UsageError, AnswerError) as error:
            words = (
                f"are not stored, and it cannot answer again ({error}); sweep without --no-poses"
            )
            raise RunError(f"{self.where}: the poses of {name!r} {words}") from error
        again = judged_again(evaluator, trial, answer, name, row=row, header=header)
        return self._whole(again, trial, answer)

    def _whole(self, stored: StoredTrial, trial: Trials, answer: Predictions) -> StoredTrial:
        """The trial with the legs before its motion, where it begins on the table."""
        if "passed_pick" not in stored.row:
            return stored
        believed = as_believed(stored, self.evaluator, trial, answer)
        if believed is not None:
            return believed
        return with_legs(stored, self.evaluator, trial, answer)

    @cached_property
    def benchmark(self) -> Benchmark:
        """The run's benchmark, compared with the run's digests."""
        header = self.run.header
        parts = {"plan", "execute"} <= header["configuration"].keys()
        if not {"objects", "motion", "seed"} <= header.keys() or not parts:
            words = "run.json lacks objects or configuration; it was not made by a sweep"
            raise RunError(f"{self.where}: {words}")
        try:
            benchmark = benchmark_of_run(header, self.where, self.code)
        except FileError as error:
            raise RunError(str(error)) from None
        # the run's trials once more, as far as that is cheap
        counts = header["trials"]
        listed = benchmark.listed is not None or len(set(counts.values())) == 1
        if sum(counts.values()) <= CHECKED_TRIALS and listed:
            trials = benchmark.trials(max(counts.values()), splits=list(counts))
            if trials_digest(trials) != header["digests"]["trials"]:
                version, commit = header["versions"].get("r2h_batch"), header.get("git_commit")
                words = f"was made with other trials: use r2h_batch {version} at commit {commit}"
                raise RunError(f"{self.where}: {words}")
        return benchmark

    @cached_property
    def evaluator(self) -> Evaluator:
        """An evaluator on the CPU with the run's configuration."""
        header = self.run.header
        try:
            text = json.dumps(header["configuration"])
            config = TypeAdapter(EvalConfig).validate_json(text, strict=True)
            if config.execute.sim == "mjwarp" and header["device"]["kind"] != "cpu":
                config = replace(config, execute=replace(config.execute, sim="mujoco"))
            return Evaluator(self.benchmark, config, plans_in=Sees.planning(header))
        except ValueError as error:  # pydantic's ValidationError is one
            what = " ".join(str(error).split())[:200]
            words = f"its configuration cannot be judged by this version ({what})"
            raise RunError(f"{self.where}: {words}") from None

    def trial_of(self, row: dict[str, Any]) -> Trials:
        """The trial of a stored row, made from the protocol.

        Raises:
            RunError: the protocol has another one.
        """
        objects = self.benchmark.objects
        trial = self.benchmark.trials_with_ids(_tensor([row["trial_id"]], torch.int64))
        hand, name = int(trial.hand_index[0]), objects[int(trial.object_index[0])].name
        if name != row["object"] or hand != row.get("hand_index", hand):
            words = f"trial {row['trial_id']} is not the one of {self.run.header['protocol']!r}"
            raise RunError(f"{self.where}: {words}")
        return trial.named(objects)


def one_failure_of_each(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Kind of failure -> the first trial that has it, in the order of the criteria; Plan's by their reasons."""
    found: dict[str, int] = {}
    order = [*(entry.name for entry in IN_ORDER), *NO_LONGER]
    for row in sorted(rows, key=lambda r: r["trial_id"]):
        if row["outcome"] in order:
            plan = row["outcome"] == "plan"
            kind = f"plan-{row['plan_reason']}" if plan else str(row["outcome"])
            found.setdefault(kind.replace("_", "-"), row["trial_id"])
    return dict(sorted(found.items(), key=lambda item: order.index(item[0].partition("-")[0])))


def judged_again(
    evaluator: Evaluator,
    trial: Trials,
    answer: Predictions,
    method: str,
    *,
    row: dict[str, Any] | None = None,
    header: dict[str, Any] | None = None,
) -> StoredTrial:
    """One answer judged with its motion, as if a run folder had stored it.

    Args:
        evaluator: judges the answer.
        trial: one trial.
        answer: one prediction for it.
        method: the name of who answered.
        row: what was stored of the verdict; it stands where it differs, and `note` says so.
        header: of the run folder; the evaluator's configuration where there is none.
    """
    if header is None:
        execute = evaluator.config.execute
        sample_s = execute.step_s * execute.record_steps
        header = {"configuration": asdict(evaluator.config), "protocol": ""}
        header["motion"] = {"sample_s": sample_s}
    scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trial, keep_motion=True)
    names, path = TrialNames.of(evaluator.scene), path_rows(scores).to_pylist()
    again = score_rows(trial, scores, names).to_pylist()[0]
    again |= detail_rows(trial, scores, names).to_pylist()[0]
    asked = None if path else postures_at(evaluator, trial, answer)
    scene = evaluator.scene
    stored = _stored(
        header, method, again | (row or {}), path[0] if path else None, trial, answer,
        scene.objects, scene.hands.set, scene.robot, evaluator.config.workplace,
    )  # fmt: skip
    note = "" if row is None else difference(row, again)
    return replace(stored, asked=asked, note=note)


def _unseen(stored: Mapping[str, Any]) -> tuple[str, ...]:
    """The outcome that a row may also have that failed a criterion whose package is not installed here."""
    return ("success",) if stored["outcome"] == ELSEWHERE else ()


def difference(stored: dict[str, Any], again: dict[str, Any]) -> str:
    """Differences between a stored verdict and the one computed here; empty if they are equal."""
    if again["outcome"] not in (stored["outcome"], *_unseen(stored)):
        words = f"the outcome is {again['outcome']}, stored is {stored['outcome']}"
        return f"computed again here {words}"
    for entry in (e for e in EVERY if e.margin_column in stored and e.margin_column in again):
        a, b = (row[entry.margin_column] for row in (stored, again))
        same = SAME_M / UNITS[entry.unit].worth_m
        if (a is None) != (b is None) or (a is not None and a != b and abs(a - b) > same):
            unit = entry.unit
            return f"computed again here the margin of {entry.name} is {b} {unit}, stored is {a} {unit}"
    return ""


def _stored(
    header: dict[str, Any], method: str, row: dict[str, Any], path: dict[str, Any] | None,
    trial: Trials, answer: Predictions, objects: Sequence[Any], hand_set: Any, robot: Robot,
    workplace: Workplace,
) -> StoredTrial:  # fmt: skip
    config = EvalConfig(
        execution_error=_section(header, "execution_error", ExecutionError),
        object_errors=_section(header, "object_errors", ObjectErrors),
    )
    poses = executed_poses(config, objects, answer.T_obj_ee, answer.T_world_ee, trial)
    T_obj_ee, T_world_ee = map(_orthonormal, poses)
    attached = T_obj_ee.copy()
    attached[:3, 3] += T_obj_ee[:3, 1] * np.float32(row["grasp_shift_m"])
    q = np.array(path["q"] if path else [workplace.home_q], np.float64)
    time_s = np.array(path["time_s"] if path else [0.0], np.float64)
    executed_q = np.array(path["executed_q"], np.float64) if path and path["executed_q"] else None
    plan = path["planned_q"] if path else None
    receiver = None if trial.receiver is None else trial.receiver[0].double().cpu().numpy()
    return StoredTrial(
        header, method, row, T_obj_ee, attached, T_world_ee, _orthonormal(trial.T_world_hand), q,
        time_s, executed_q, objects[int(trial.object_index[0])], hand_set, robot, workplace, receiver,
        planned_q=None if plan is None else np.array(plan, np.float64),
    )  # fmt: skip


def _section(header: dict[str, Any], name: str, kind: type[Section]) -> Section:
    """A section of the run's configuration; its defaults in a run that is older than the section."""
    return TypeAdapter(kind).validate_python(header["configuration"].get(name, {}))


def _rows(table: Any, trial_id: int) -> list[dict[str, Any]]:
    if trial_id >= 1 << 63:  # no id is, and Arrow compares no such number
        return []
    rows: list[dict[str, Any]] = table.filter(pc.equal(table["trial_id"], trial_id)).to_pylist()
    return rows


def _possible(poses: Sequence[Mapping[str, Any]], paths: Sequence[Mapping[str, Any]]) -> bool:
    """Whether stored poses and paths of a judged trial are numbers that a motion can have."""
    found = all(np.isfinite(row[k]).all() for row in poses for k in POSES)
    for row in paths:
        q, time_s = (np.array(row[k], np.float64) for k in ("q", "time_s"))
        every = [q, time_s, np.array(row["executed_q"] or 0.0)]
        found &= len(q) == len(time_s) > 0 and all(bool(np.isfinite(x).all()) for x in every)
        found &= bool((np.diff(time_s, prepend=0.0) >= 0).all())
        found &= bool(time_s.max(initial=0.0) <= MOST_SECONDS)
    return found


def _tensor(values: Any, dtype: torch.dtype) -> torch.Tensor:
    return torch.tensor(values, dtype=dtype, device="cpu")


def _orthonormal(T: torch.Tensor) -> Array:
    """The first of poses (1, 4, 4) as the evaluator reads it: float32, z kept, x and y made
    orthonormal."""
    return se3.orthonormalise(T.cpu().float())[0].double().numpy()
