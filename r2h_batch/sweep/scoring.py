"""Score shards in this process: claim one, take it chunk by chunk through the evaluator, store it,
go on."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import torch

from r2h_batch.base.command_line import counted, refuse
from r2h_batch.base.errors import AnswerError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.progress import progress as steps
from r2h_batch.base.io.read import printable
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.plan import load_searches
from r2h_batch.runs.files import replace_json
from r2h_batch.runs.header import Shard, shards_of
from r2h_batch.runs.writing import SHARD_TRIALS, TRIES, RunFolder, ShardWriter
from r2h_batch.sweep.jobs import CPU_CHUNK, Job, Setting
from r2h_batch.sweep.rows import (
    TrialNames,
    detail_rows,
    episode_rows,
    failure_rows,
    missing_rows,
    path_rows,
    pose_rows,
    score_rows,
    sees_rows,
)
from r2h_batch.trials.predictions import doubts
from r2h_batch.types import Outcome, Predictions, Trials

if TYPE_CHECKING:
    from r2h_batch.closed_loop.episodes import Loop

WARM_TRIALS = 32
"""Scored once before the clock starts, so that no method's T_plan contains the compilation of kernels."""

SHARD_SECONDS = 60.0
PROBE_TRIALS = 128
UNPROBED_TRIALS = 1000
"""A plan this small takes less than a minute at the slowest rate seen: nothing to measure."""

LOG_EVERY_S = WAIT_S = 5.0
PLAIN_EVERY_S = 30.0


class Stopped(Exception):
    """A stop signal was heard and the current chunk is done."""


class ProgressFile:
    """progress.json: each method's trials done and planned in this sweep, trials/s and seconds
    left."""

    def __init__(self, path: Path) -> None:
        self.path, self.methods, self._written = path, {}, 0.0  # type: ignore[var-annotated]
        for left in path.parent.glob(f".{path.name}.*.tmp"):  # by a sweep that was killed
            left.unlink(missing_ok=True)

    def say(self, name: str, done: int, total: int, seconds: float) -> None:
        """Note a method's state; the file is replaced every few seconds and when the method is
        done."""
        rate = done / seconds if seconds > 0 else 0.0
        left = (total - done) / rate if rate > 0 else None
        self.methods[name] = {"done": done, "planned": total, "trials_per_s": rate, "left_s": left}
        now = time.monotonic()
        if done == total or now - self._written >= LOG_EVERY_S:
            state: dict[str, Any] = {"updated": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
            # another sweep may have begun and removed it as a leftover
            with contextlib.suppress(FileNotFoundError):
                replace_json(self.path, {**state, "methods": self.methods})
            self._written = now


@contextlib.contextmanager
def progress(
    name: str, total: int, *, file: ProgressFile | None = None
) -> Iterator[Callable[[int], None]]:
    """Gives `advance(n)`: a bar on a terminal, else a plain line every 30 s and one at the end, all
    on stderr."""
    start, done = time.perf_counter(), 0
    with steps(name, total, "trials", every_s=PLAIN_EVERY_S) as advance:

        def count(n: int) -> None:
            nonlocal done
            done += n
            if file is not None:
                file.say(name, done, total, time.perf_counter() - start)
            advance(n)

        yield count
    seconds = time.perf_counter() - start
    rate = f"{total / seconds:.1f} trials/s"
    LOG.info(f"{name}: {counted(total, 'trials')} in {seconds:.1f} s, {rate}")


@dataclass(frozen=True)
class Scoring:
    """The work of a process: setting, jobs, the folder for rows, and what stops it."""

    setting: Setting
    jobs: Sequence[Job]
    folder: RunFolder
    stopping: Callable[[], bool]
    progress: ProgressFile
    without: dict[str, dict[int, str]] = field(default_factory=dict)
    """method -> number of a shard that the sweep goes on without -> why its last try ended"""

    def go_on_without(self, name: str, shard: Shard, why: str) -> None:
        """After `TRIES` tries the other shards are scored, and the command says which one is missing."""
        LOG.info(f"{name}: shard {shard.index} is left out after {TRIES} tries: {why}")
        self.without.setdefault(name, {})[shard.index] = why


def score_local(work: Scoring) -> dict[str, int]:
    """Every job's shards of this part into the run folder, sharing them with other sweeps that work
    on it.

    Returns the methods whose answers cannot be scored, with the exit code that this means: each is said in one line, and
    the others go on.
    """
    refused, folder = {}, work.folder
    for job in work.jobs:
        todo = folder.todo(job.name, work.setting.sweep.part)
        if not todo:
            LOG.info(f"{job.name}: {_nothing_left(folder, work.setting.sweep.part)}")
            continue
        LOG.info(f"{job.name}: warming up (kernels are compiled on first use)")
        try:
            with steps(f"{job.name}: warming up", 1, ""):
                warm_up(job, work.setting)
            with progress(
                job.name, sum(s.last - s.first for s in todo), file=work.progress
            ) as advance:
                _score_job(work, job, todo, advance)
        except AnswerError as error:
            refused[job.name] = refuse("sweep", error)
    return refused


def _nothing_left(folder: RunFolder, part: tuple[int, int]) -> str:
    """Why a part has nothing to do: its shards are stored, or there are fewer shards than parts."""
    shards, (i, n) = len(shards_of(folder.header)), part
    if i <= shards:
        return "already in the run folder, reused"
    trials = sum(folder.header["trials"].values())
    return (
        f"part {i} of {n} has nothing to do, because the {counted(trials, 'trials')} are {counted(shards, 'shards')}; in a new"
        f" folder --shard-trials {max(1, trials // n)} gives every part one"
    )


def _score_job(work: Scoring, job: Job, todo: list[Shard], advance: Callable[[int], None]) -> None:
    folder, stopping = work.folder, work.stopping
    since, printed = time.monotonic(), ""
    while todo:
        left, stored = [], folder.stored(job.name)
        for shard in todo:
            if shard.index in stored:
                advance(shard.last - shard.first)
                continue
            with folder.claim(job.name, shard) as claim:
                if claim is None:
                    left.append(shard)
                elif shard.index in (stored := folder.stored(job.name)):
                    advance(shard.last - shard.first)
                elif len(claim.died) >= TRIES:
                    claim.kept = True  # for other sweeps; one that starts later tries again
                    work.go_on_without(job.name, shard, f"{claim.died[-1]} died")
                else:
                    start = time.perf_counter()
                    with folder.write(job.name, shard) as writer:
                        score_shard(job, shard, writer, work.setting, stopping, advance)
                    seconds = time.perf_counter() - start
                    LOG.debug(f"{job.name}: shard {shard.index} stored after {seconds:.1f} s")
        if stopping():
            raise Stopped
        if len(left) < len(todo):
            since = time.monotonic()
        else:  # other processes hold all shards: wait for them, or for their claims to fall
            if time.monotonic() - since > WAIT_S:
                who = folder.claimed_by(job.name, left[0]) or "another process"
                words = f"{job.name}: waiting for shard {left[0].index}, which {who} scores"
                if words != printed:
                    LOG.info(words)
                printed = words
            time.sleep(0.5)
        todo = left


def score_shard(
    job: Job,
    shard: Shard,
    writer: ShardWriter,
    setting: Setting,
    stopping: Callable[[], bool] = lambda: False,
    advance: Callable[[int], None] = lambda n: None,
) -> None:
    """All trials of a shard through the evaluator into a writer; `Stopped` between chunks where
    that is asked."""
    chunk = setting.chunk
    for first in range(shard.first, shard.last, chunk):
        if stopping():
            raise Stopped
        last = min(first + chunk, shard.last)
        rows = None if job.rows is None else job.rows[first:last]
        look = first == 0 and not job.warm  # built-in methods know the conventions
        trials = setting.trials(setting.ids(first, last))
        writer.append(**_score_chunk(job, trials, rows, setting, look=look))
        advance(last - first)


def _functions_of(evaluator: Evaluator) -> dict[str, object]:
    """Functions that an evaluator's names call: those of its classes, and what hides one of these in the evaluator itself."""
    kinds = dict.fromkeys((*Evaluator.__mro__, *type(evaluator).__mro__))
    own = {f"{kind.__name__}.{k}": v for kind in kinds for k, v in vars(kind).items()}
    hiding = {
        k: v for k, v in vars(evaluator).items() if callable(getattr(type(evaluator), k, None))
    }
    return own | {f"{type(evaluator).__name__}.{k}": v for k, v in hiding.items()}


def _check_judge(name: str, evaluator: Evaluator, before: Mapping[str, object]) -> None:
    """`AnswerError` if a method has put another function into the evaluator or its classes while it answered.

    Args:
        name: of the method.
        evaluator: that judges its answers.
        before: `_functions_of` it when the method was asked.
    """
    changed = [k for k, own in _functions_of(evaluator).items() if own is not before.get(k)]
    if changed:
        words = f"it replaced {changed[0]}; a method may not change what judges it"
        raise AnswerError(f"method {printable(name)}: {words}")


def _score_chunk(
    job: Job, trials: Trials, rows: torch.Tensor | None, setting: Setting, *, look: bool = False
) -> dict[str, pa.Table]:
    """Tables of a chunk in the plan's order; `rows`: the answers' rows, -1 for a trial without
    one; `look`: say so where all rows fail alike and pass in another convention."""
    every = torch.ones(len(trials), dtype=torch.bool, device="cpu")
    answered = every if rows is None else rows >= 0
    moved = ~every  # whose answer is a motion
    if rows is not None and job.motions is not None:
        moved = answered & (job.motions.length[rows] > 0)
    evaluator = setting.evaluator
    names = TrialNames.of(evaluator.scene)
    parts: list[dict[str, pa.Table]] = []
    for chosen in (answered & ~moved, moved):
        if chosen.any():
            own = None if rows is None else rows[chosen]
            part = trials[chosen].to(evaluator.scene.device)
            judge = _functions_of(evaluator)
            answers = job.predict(part, own).to(part.trial_id.device)
            _check_judge(job.name, evaluator, judge)
            if look and rows is None:  # of files it was said when they were read
                for words in doubts(answers.to("cpu")):
                    LOG.info(f"{job.name}: {words}")
            motions = None
            if chosen is moved and job.motions is not None and own is not None:
                motions = job.motions.padded(own, evaluator.scene.device)
            stored = setting.header["stored"]
            parts.append(
                judged_tables(
                    evaluator,
                    part,
                    answers,
                    motions,
                    stored,
                    names,
                    setting.sweep.loop,
                    look_for=job.name if look else None,
                )
            )
            if job.looked is not None:
                parts[-1]["sees"] = sees_rows(job.looked(part.trial_id))
    if not answered.all():
        parts.append({"trials": missing_rows(trials[~answered], names, evaluator.benchmark.asks)})
    kinds = dict.fromkeys(kind for part in parts for kind in part)
    whole = {kind: pa.concat_tables([p[kind] for p in parts if kind in p]) for kind in kinds}
    return {k: _in_order(t.unify_dictionaries(), trials.trial_id.numpy()) for k, t in whole.items()}


def judged_tables(
    evaluator: Evaluator,
    part: Trials,
    answers: Predictions,
    motions: dict[str, torch.Tensor] | None,
    stored: Sequence[str],
    names: TrialNames,
    loop: "Loop | None" = None,
    *,
    look_for: str | None = None,
) -> dict[str, pa.Table]:
    """Tables of trials and of the kinds `stored`, as a run folder has them.

    `motions`: motions in place of the handover poses, as `Evaluator.score_motion` takes them. `loop`: how
    `episodes` are played. `look_for`: the method whose hint is said, where all rows fail alike.
    """
    hint = None
    if motions is not None:
        scores = evaluator.score_motion(answers.T_obj_ee, trials=part, **motions)
        assert scores.inputs is not None
        answers = replace(answers, T_world_ee=scores.inputs.T_world_ee)
        if look_for and "planned_q" not in motions:
            hint = evaluator.motion_hint(scores, answers.T_obj_ee, part, **motions)
    else:
        keep = "paths" in stored
        scores = evaluator.score(answers.T_obj_ee, answers.T_world_ee, part, keep_motion=keep)
        if look_for:
            hint = evaluator.hint(scores, answers.T_obj_ee, answers.T_world_ee, part)
    if hint:
        LOG.info(f"{look_for}: {hint}")
    played = None if loop is None else loop(scores)
    # one copy each from a GPU
    part, answers, scores = part.to("cpu"), answers.to("cpu"), scores.to("cpu")
    tables = {"trials": score_rows(part, scores, names, answers.t_method_s)}
    if (scores.outcome == int(Outcome.INVALID_SIM)).any():
        tables["failures"] = failure_rows(part, answers, scores, names)
    for kind in stored:
        if kind == "details":
            tables[kind] = detail_rows(part, scores, names)
        elif kind == "poses":
            tables[kind] = pose_rows(answers)
        elif kind == "paths":
            plan, moved = None, scores
            if motions is not None:  # one beyond the joint limits has no path, but is judged again
                own = {name: value.cpu() for name, value in motions.items()}
                path, time_s, length = own["q"], own["time_s"], own["length"].int()
                moved = replace(scores, path=path, path_time_s=time_s, path_len=length)
                if "planned_q" in own:
                    plan = (own["planned_q"], own["planned_length"])
            tables[kind] = path_rows(moved, plan)
        elif kind == "episodes" and played is not None:
            tables[kind] = episode_rows(part.trial_id, vars(played))
    return tables


def _in_order(table: pa.Table, trial_id: np.ndarray) -> pa.Table:
    """The rows in the order of the trials."""
    by_id = np.argsort(trial_id)
    at = by_id[np.searchsorted(trial_id, table["trial_id"].to_numpy(), sorter=by_id)]
    return table if (np.diff(at) > 0).all() else table.take(pa.array(np.argsort(at)))


def warm_up(job: Job, setting: Setting, trials: int = WARM_TRIALS) -> None:
    """Compile what the job will use; the poses do not matter, and a user's method is not asked."""
    scene = setting.evaluator.scene
    few = setting.trials(setting.ids(0, min(trials, setting.planned))).to(scene.device)
    T_world_ee = few.T_world_hand.clone()
    T_obj_ee = torch.eye(4, dtype=torch.float32, device=T_world_ee.device).expand_as(T_world_ee)
    if job.warm:
        answers = job.predict(few, None)
        T_obj_ee, T_world_ee = answers.T_obj_ee, answers.T_world_ee
    setting.evaluator.called = setting.evaluator.moved = True  # these poses are nobody's mistakes
    setting.evaluator.score(T_obj_ee.contiguous(), T_world_ee, few)
    load_searches(scene.device, len(scene.robot.joints))  # none of these few may have needed them


def shard_size(setting: Setting, jobs: list[Job]) -> int:
    """Trials of a shard in a new folder: `SHARD_TRIALS`, or what the slowest job does in a
    minute."""
    if setting.planned <= UNPROBED_TRIALS:
        return SHARD_TRIALS
    slowest = 0.0
    for job in jobs:
        warm_up(job, setting)
        start = time.perf_counter()
        warm_up(job, setting, PROBE_TRIALS)
        slowest = max(slowest, (time.perf_counter() - start) / min(PROBE_TRIALS, setting.planned))
    return max(CPU_CHUNK, min(SHARD_TRIALS, int(SHARD_SECONDS / slowest) // CPU_CHUNK * CPU_CHUNK))
