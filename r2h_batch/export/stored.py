"""One trial of a run folder, whole: what is stored, and what is not, computed again from the method
and its seed."""

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from numpy.typing import NDArray

from r2h_batch import se3
from r2h_batch.benchmark import Benchmark
from r2h_batch.benchmark.given import Given
from r2h_batch.benchmark.of_run import benchmark_of_run
from r2h_batch.benchmark.unbuilt import is_unbuilt
from r2h_batch.config import Workplace
from r2h_batch.evaluate import Evaluator
from r2h_batch.export import replay
from r2h_batch.io.read import FileError
from r2h_batch.runs.store import Run, load_run
from r2h_batch.trials.protocol import make_trials, trials_digest, trials_of
from r2h_batch.types import Predictions, Trials

Array = NDArray[np.float64]

CHECKED_TRIALS = 20_000
"""Runs of at most this many trials have their whole trial list compared with its digest."""


class ExportError(ValueError):
    """A trial that cannot be shown: the message says what is there and what to do."""


@dataclass(frozen=True)
class StoredTrial:
    """One trial of one method as it was judged: what a run folder says, and the trial itself made
    from its protocol."""

    header: dict[str, Any]
    method: str
    row: dict[str, Any]  # of trials and details
    T_obj_ee: Array  # as predicted
    T_obj_ee_attached: Array  # after closing moved the object between the pads
    T_world_ee: Array
    T_world_hand: Array
    q: Array  # (W, 6) waypoints; home alone where no path was found
    time_s: Array  # (W,)
    executed_q: Array | None  # (S, 6) every `motion.sample_s` of run.json; None: not simulated
    object_model: Any
    hand_set: Any = None  # None: the built-in one
    workplace: Workplace = field(default_factory=Workplace)
    receiver: Array | None = None  # (5, 4) as in Trials.receiver, where the protocol has a person
    asked_q: Array | None = None  # (6,) posture at the target, or the nearest to it; None: q[-1]
    asked_clearance_m: float | None = None  # of that posture, where there is no path
    note: str = ""  # where what was computed again is not what is stored

    @property
    def target_q(self) -> Array:
        """The posture that was asked for: the goal, or what comes nearest to it."""
        return self.q[-1] if self.asked_q is None else self.asked_q

    @property
    def moves(self) -> bool:
        """Whether there is a path."""
        return len(self.q) > 1


class _Bench:
    """A run's benchmark as far as its objects are built: trials are drawn from all of it, judged on
    what is built."""

    def __init__(self, header: dict[str, Any], benchmark: Benchmark, where: str) -> None:
        self.header, self.where, self.whole, self.benchmark = header, where, benchmark, benchmark
        built = [i for i, o in enumerate(benchmark.objects) if not is_unbuilt(o)]
        self._place = torch.full((len(benchmark.objects),), -1, dtype=torch.int32, device="cpu")
        self._place[built] = torch.arange(len(built), dtype=torch.int32, device="cpu")
        if len(built) < len(benchmark.objects):
            self.benchmark = replace(
                benchmark, objects=tuple(benchmark.objects[i] for i in built), listed=None
            )

    @cached_property
    def evaluator(self) -> Evaluator:
        """An evaluator with the run's configuration, made when the first trial needs it."""
        return replay.evaluator_of(self.header, self.benchmark, self.where)

    def trial(self, row: dict[str, Any]) -> Trials:
        """This row's trial, made from the protocol; its object as `benchmark` counts them."""
        trial = _trial_again(self.header, row, self.whole, self.where)
        own = replace(trial, object_index=self._place[trial.object_index.long()])
        return own.named(self.benchmark.objects)


class Reader:
    """Trials of one run folder, one after the other. Of the user's meshes only those are built that
    a trial needs, each once."""

    def __init__(self, run: str | Path, given: Given | None = None) -> None:
        self.where = str(run)
        self.run: Run = load_run(run)
        self.given = given or Given()
        self._benches: dict[str, _Bench] = {}
        self._rows: dict[str, Any] = {}

    @cached_property
    def _own(self) -> frozenset[str]:
        """Names of the run's objects that are not built in."""
        header = self.run.header
        parts = {"plan", "execute"} <= header["configuration"].keys()
        if not {"objects", "motion", "seed"} <= header.keys() or not parts:
            raise ExportError(
                f"{self.where}: run.json lacks objects or configuration; it was not made by a sweep"
            )
        return frozenset(o["name"] for o in header["objects"] if not o["built_in"])

    def build_for(self, trials: Mapping[str, Sequence[int]]) -> None:
        """Builds the objects of these trials (by method) together, on all cores, before they are
        asked for one by one."""
        names: set[str] = set()
        for method, ids in trials.items():
            table = self.rows(self.method(method))
            names |= set(
                table.filter(pc.is_in(table["trial_id"], pa.array(ids, pa.int64())))[
                    "object"
                ].to_pylist()
            )
        if wanted := names & self._own - self._benches.keys():
            self._know(wanted)

    def _bench_of(self, name: str) -> _Bench:
        """The run's benchmark with at least this object and those that are built in. Raises
        `ExportError`."""
        return self._benches.get(name) or self._know(self._own & {name})

    def _know(self, own: AbstractSet[str]) -> _Bench:
        """The run's benchmark, compared with its digests, with these of the user's objects: kept
        for all that are built."""
        header = self.run.header
        only = (
            frozenset({o["name"] for o in header["objects"]} - self._own | own)
            if self._own
            else None
        )
        try:
            benchmark = benchmark_of_run(header, self.given, self.where, only)
        except FileError as error:
            raise ExportError(str(error)) from None
        if not self._benches:  # the next one has the same names, hands and places
            _check_trials(header, benchmark, self.where)
        bench = _Bench(header, benchmark, self.where)
        self._benches = {o.name: bench for o in bench.benchmark.objects} | self._benches
        return bench

    def method(self, word: str | None = None) -> str:
        """The full name of a method; the only one where none is given. Raises `ExportError`."""
        return _method(self.run, word)

    def rows(self, method: str) -> Any:
        """All rows of a method (pyarrow)."""
        if method not in self._rows:
            self._rows[method] = self.run.trials(method)
        return self._rows[method]

    def trial(self, trial_id: int, method: str | None = None) -> StoredTrial:
        """The trial as it was scored. Raises `ExportError`, `RunError`."""
        name = self.method(method)
        row = _row(self.rows(name), trial_id, f"{self.where}: method {name!r}")
        if not replay.was_judged(row):
            raise ExportError(
                f"trial {trial_id} of {name!r} was not judged ({row['outcome']}): there is nothing to show"
            )
        stored = self.run.header["stored"]
        for details in _rows(self.run.details(name), trial_id) if "details" in stored else ():
            row |= details
        bench = self._bench_of(row["object"])
        trial = bench.trial(row)
        poses = _rows(self.run.poses(name), trial_id) if "poses" in stored else []
        path = _rows(self.run.paths(name), trial_id) if "paths" in stored else []
        if poses and path and "details" in stored:
            return self._as_stored(name, row, trial, poses[0], path[0], bench)
        return self._again(name, row, trial, poses, bench)

    def _as_stored(
        self, name: str, row: dict[str, Any], trial: Trials, poses: dict[str, Any], path: dict[str, Any],
        bench: _Bench,
    ) -> StoredTrial:  # fmt: skip
        T_obj_ee, T_world_ee = (
            torch.tensor(poses[k], dtype=torch.float32, device="cpu").reshape(1, 4, 4)
            for k in _POSES
        )
        answer = Predictions(trial.trial_id, T_obj_ee, T_world_ee, method=name)
        return stored_trial(self.run.header, name, row, path, trial, answer, bench.benchmark)

    def _again(
        self,
        name: str,
        row: dict[str, Any],
        trial: Trials,
        poses: list[dict[str, Any]],
        bench: _Bench,
    ) -> StoredTrial:
        """What is not stored, from the poses or from the method; the stored row stands where it
        says something."""
        try:
            evaluator = bench.evaluator
            if poses:
                T = {
                    k: torch.tensor(poses[0][k], dtype=torch.float32, device="cpu").reshape(1, 4, 4)
                    for k in _POSES
                }
                answer = Predictions(trial.trial_id, **T, method=name)
            else:
                answer = replay.answer_again(
                    self.run.header, self.run.entry(name), trial, evaluator
                )
            again = replay.judge_again(evaluator, trial, answer)
        except replay.ReplayError as error:
            raise ExportError(f"{self.where}: {error}") from error
        note = replay.difference(row, again.row)
        shown = stored_trial(
            self.run.header, name, again.row | row, again.path, trial, answer, bench.benchmark
        )
        return replace(
            shown, asked_q=again.asked_q, asked_clearance_m=again.asked_clearance_m, note=note
        )


_POSES = ("T_obj_ee", "T_world_ee")


def load_trial(
    run: str | Path, trial_id: int, *, method: str | None = None, given: Given | None = None
) -> StoredTrial:  # fmt: skip
    """The trial as it was scored; `given`: what the sweep's flags said of the benchmark. Raises
    `ExportError`, `RunError`."""
    return Reader(run, given).trial(trial_id, method)


def stored_trial(
    header: dict[str, Any], method: str, row: dict[str, Any], path: dict[str, Any] | None, trial: Trials,
    answer: Predictions, benchmark: Any,
) -> StoredTrial:  # fmt: skip
    """A trial from its rows, one row of trials and the answer that was scored; of the benchmark
    objects, hand_set, workplace."""
    T_obj_ee, T_world_ee = (
        _orthonormal(T[0].cpu().numpy()) for T in (answer.T_obj_ee, answer.T_world_ee)
    )
    attached = T_obj_ee.copy()
    attached[:3, 3] += T_obj_ee[:3, 1] * np.float32(row["grasp_shift_m"])
    q = np.array(path["q"], np.float64) if path else np.array([benchmark.workplace.home_q])
    time_s = np.array(path["time_s"], np.float64) if path else np.zeros(1)
    executed_q = np.array(path["executed_q"], np.float64) if path and path["executed_q"] else None
    return StoredTrial(
        header, method, row, T_obj_ee, attached, T_world_ee, _orthonormal(trial.T_world_hand[0].cpu().numpy()), q, time_s,
        executed_q, benchmark.objects[int(trial.object_index[0])], benchmark.hand_set, benchmark.workplace,
        None if trial.receiver is None else trial.receiver[0].double().cpu().numpy(),
    )  # fmt: skip


def _method(stored: Any, method: str | None) -> str:
    names = stored.methods
    if method is None and len(names) == 1:
        return str(names[0])
    if method is None:
        raise ExportError(
            f"{stored.folder}: holds several methods, choose one with --method: {', '.join(names) or 'none'}"
        )
    try:
        name = str(stored.named(method))
    except ValueError as error:
        raise ExportError(str(error)) from None
    if name not in names:
        raise ExportError(
            f"{stored.folder}: {name!r} is not complete; run its sweep again to go on"
        )
    return name


def _rows(table: Any, trial_id: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = table.filter(pc.equal(table["trial_id"], trial_id)).to_pylist()
    return rows


def _row(table: Any, trial_id: int, where: str) -> dict[str, Any]:
    rows = _rows(table, trial_id)
    if not rows:
        ids = table["trial_id"].to_pylist()
        some = ", ".join(map(str, ids[:10])) + (f", ... up to {max(ids)}" if len(ids) > 10 else "")
        raise ExportError(f"{where} has no trial {trial_id}; it has {len(ids)}: {some or 'none'}")
    return rows[0]


def _check_trials(header: dict[str, Any], benchmark: Benchmark, run: str) -> None:
    """The run's trials, as far as that is cheap, made again and checked against their digest."""
    counts = header["trials"]
    if sum(counts.values()) <= CHECKED_TRIALS and (
        benchmark.listed is not None or len(set(counts.values())) == 1
    ):
        trials = make_trials(list(counts), max(counts.values()), benchmark=benchmark)
        if trials_digest(trials, objects=benchmark.objects) != header["digests"]["trials"]:
            raise ExportError(
                f"{run}: was made with other trials: export with r2h_batch {header['versions'].get('r2h_batch')}"
                f" at commit {header.get('git_commit')}"
            )


def _trial_again(
    header: dict[str, Any], row: dict[str, Any], benchmark: Benchmark, run: str
) -> Trials:
    """This row's trial, made from the protocol."""
    trial = trials_of(benchmark, torch.tensor([row["trial_id"]], dtype=torch.int64, device="cpu"))
    other_hand = int(trial.hand_index[0]) != row.get("hand_index", int(trial.hand_index[0]))
    if benchmark.objects[int(trial.object_index[0])].name != row["object"] or other_hand:
        raise ExportError(
            f"{run}: trial {row['trial_id']} is not the one of {header['protocol']!r}"
        )
    return trial


def _orthonormal(T: NDArray[Any]) -> Array:
    """As the evaluator reads a pose: float32, z kept, x and y made orthonormal."""
    return se3.orthonormalise(torch.from_numpy(np.array(T, np.float32))[None])[0].double().numpy()
