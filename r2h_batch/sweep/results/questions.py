"""The loop that judges stored poses again: a question is asked of a method's rows, part by part.

Answers that are kept lie beside the shards (`runs.side`): each method's as soon as it has them all, so whatever ends the command
loses those of one method at most, and the same command goes on with the next one.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from numpy.typing import NDArray

from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.progress import progress
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import check_output_file
from r2h_batch.runs import provenance
from r2h_batch.runs.files import RunError
from r2h_batch.runs.methods import Entry
from r2h_batch.runs.side import made_of, side_path, write_side
from r2h_batch.runs.store import Run
from r2h_batch.sweep.results.judge import Judge, check_poses
from r2h_batch.types import Scores

ROWS = 1024
"""Stored rows that are judged at once."""
KINDS = ("trials", "poses", "details")

T = TypeVar("T")


@dataclass(frozen=True)
class Part:
    """Stored rows that are judged at once, of one shard.

    Attributes:
        run: the stored run.
        entry: the method.
        tables: kind -> the rows of the same trials, in stored order; a trial without an answer has a row in `trials` only.
    """

    run: Run
    entry: Entry
    tables: Mapping[str, pa.Table]

    @property
    def trial_id(self) -> NDArray[np.int64]:
        """(n,) numbers of the trials."""
        ids: NDArray[np.int64] = self.tables["trials"]["trial_id"].to_numpy()
        return ids

    @property
    def success(self) -> dict[int, bool]:
        """Whether each trial succeeded."""
        rows = self.tables["trials"].select(["trial_id", "outcome"]).to_pylist()
        return {r["trial_id"]: r["outcome"] == "success" for r in rows}


@dataclass(frozen=True)
class Question(Generic[T]):
    """What can be asked of stored poses. One whose answers are kept is an entry of `base.registry.QUESTIONS`.

    Attributes:
        name: of the command, and of the folder that keeps the answers.
        schema: of the answers, `trial_id` among its columns; None: they are told and not kept.
        version: counts up where the function answers otherwise than before: answers of other versions are made anew.
        function: the answers about a part.
    """

    name: str
    schema: pa.Schema | None
    version: int
    function: Callable[[Judge, Part], T]


def judge_of(run: Run, code: Sequence[str], device: str) -> tuple[Judge, list[str]]:
    """The evaluator of a run, and its methods with rows.

    Args:
        run: with poses.
        code: functions that the run names and that may run.
        device: cpu, cuda or cuda:N.

    Raises:
        RunError: the run holds no rows or no poses.
    """
    check_poses(run)
    names = [e.name for e in run.entries if e.shards]
    if not names:
        raise RunError(f"{run.folder}: no shard of any method is stored")
    return Judge(run, code=code, device=device), names


def kept_answers(
    question: Question[pa.Table], run: Run, methods: Sequence[str], judge: Judge
) -> dict[str, pa.Table]:
    """Method -> the answers about all its rows. Those of the same rows, version, code and kind of device are read.

    Args:
        question: an entry of `QUESTIONS`.
        run: with poses.
        methods: names in the run.
        judge: the evaluator of the run.

    Raises:
        RunError: the run holds no poses, or a file that should have the answers is damaged.
    """
    found, schema = {}, question.schema
    assert schema is not None, question.name
    for name in methods:
        path, about = side_path(run.entry(name), question.name), _about(question, run, name, judge)
        if made_of(path) == about:
            LOG.info(f"{name}: {printable(path)} has these rows")
            table = run.side(name, question.name, schema)
            if table is None:
                raise RunError(f"{printable(path)}: changed while it was read; try again")
        else:
            check_output_file(path, overwrite=True, flag="the answers go into")
            parts_of_it = answers(question, run, name, judge)
            table = pa.concat_tables([schema.empty_table(), *parts_of_it])
            write_side(path, table, about)
        found[name] = table
    return found


def _about(question: Question[Any], run: Run, method: str, judge: Judge) -> dict[str, Any]:
    """All that decides the answers: shards have a digest of their rows and poses in their names."""
    shards = [s.path.name for _, s in sorted(run.entry(method).shards.items())]
    rows = hashlib.sha256("\n".join([str(run.header["hash"]), *shards]).encode()).hexdigest()
    return {
        "rows": rows,
        "version": question.version,
        "code": provenance.code_digest(),
        "device": torch.device(judge.evaluator.scene.device).type,
    }


def answers(
    question: Question[T],
    run: Run,
    method: str,
    judge: Judge,
    *,
    kinds: Sequence[str] = KINDS,
    positions: NDArray[np.int64] | None = None,
    at_once: int = ROWS,
) -> Iterator[T]:
    """The answers about a method's rows, part by part.

    Args:
        question: what is asked.
        run: with poses.
        method: name in the run.
        judge: the evaluator of the run.
        kinds: tables that the question reads, where the run holds them; `trials` is one of them.
        positions: of the rows, increasing, counted over the stored shards; None: all.
        at_once: rows of a part.

    Raises:
        RunError: the run holds no poses.
    """
    check_poses(run)
    stored = sum(s.shard.last - s.shard.first for s in run.entry(method).shards.values())
    total = stored if positions is None else len(positions)
    with progress(f"{method}: judging again", total, "rows") as told:
        for part in parts(run, method, kinds=kinds, positions=positions, at_once=at_once):
            yield question.function(judge, part)
            told(len(part.trial_id))


def parts(
    run: Run,
    method: str,
    *,
    kinds: Sequence[str] = KINDS,
    positions: NDArray[np.int64] | None = None,
    at_once: int = ROWS,
) -> Iterator[Part]:
    """The stored rows of a method; one shard is in memory. Arguments as in `answers`."""
    entry, first = run.entry(method), 0
    for index, shard in sorted(entry.shards.items()):
        last = first + shard.shard.last - shard.shard.first
        chosen = np.arange(first, last)
        if positions is not None:
            chosen = positions[(positions >= first) & (positions < last)]
        rows, first = chosen - first, last
        if not len(rows):
            continue
        stored = {k: run.shard(k, method, index) for k in kinds if k in shard.kinds}
        ids = np.sort(stored["trials"]["trial_id"].to_numpy()[rows])
        for i in range(0, len(ids), at_once):
            own = pa.array(ids[i : i + at_once])
            of_part = {k: t.filter(pc.is_in(t["trial_id"], own)) for k, t in stored.items()}
            yield Part(run, entry, of_part)


def judged(judge: Judge, part: Part) -> tuple[NDArray[np.int64], Scores]:
    """Numbers of the trials with a pose, increasing, and scores of these poses up to the goal posture: the stored one, where
    the run holds details.

    Args:
        judge: the evaluator of the run.
        part: with poses.
    """
    poses, device = part.tables["poses"].sort_by("trial_id"), judge.evaluator.scene.device
    grasp, handover = (
        torch.tensor(poses[k].to_pylist(), dtype=torch.float32, device=device).reshape(-1, 4, 4)
        for k in ("T_obj_ee", "T_world_ee")
    )
    ids: NDArray[np.int64] = poses["trial_id"].to_numpy()
    scores = judge.evaluator.score(grasp, handover, judge.trials(ids), stages="pose")
    if "details" in part.tables:  # a path may end in another branch than the pose stage's
        rows = {r["trial_id"]: r["q_goal"] for r in part.tables["details"].to_pylist()}
        nowhere = [float("nan")] * scores.q_goal.shape[1]
        q = [rows.get(i) or nowhere for i in ids.tolist()]
        goal = torch.tensor(q, dtype=torch.float32, device=device)
        known = goal.isfinite().all(1, keepdim=True)
        inputs = scores.inputs
        assert inputs is not None
        scores = replace(scores, q_goal=torch.where(known, goal, scores.q_goal)).with_inputs(inputs)
    return ids, scores
