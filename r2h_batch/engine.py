"""Score shards in this process: claim one, take it chunk by chunk through the evaluator, store it, go on."""

import sys
import time
from collections.abc import Callable

import numpy as np
import pyarrow as pa
import torch

from r2h_batch.jobs import Bench, Job
from r2h_batch.manifest import SHARD_TRIALS, Shard
from r2h_batch.options import Options
from r2h_batch.progress import Log, progress
from r2h_batch.rows import detail_rows, failure_rows, missing_rows, path_rows, pose_rows, score_rows
from r2h_batch.types import Outcome, Trials
from r2h_batch.writing import RunFolder, ShardWriter

CPU_CHUNK = 256
"""Trials between two looks at the clock on a CPU; on a GPU it is the evaluator's own chunk."""

WARM_TRIALS = 32
"""Scored once before the clock starts, so that compiling kernels is in nobody's T_plan."""

SHARD_SECONDS = 60.0
PROBE_TRIALS = 128
UNPROBED_TRIALS = 1000
"""A plan this small takes less than a minute at the slowest rate seen: nothing to measure."""


class Stopped(Exception):
    """A stop signal was heard and the current chunk is done."""


def chunk_of(options: Options, bench: Bench) -> int:
    """Trials scored at once."""
    return options.chunk or (CPU_CHUNK if options.device == "cpu" else bench.evaluator.config.chunk)


def score_local(
    bench: Bench, jobs: list[Job], folder: RunFolder, options: Options, stopping: Callable[[], bool], log: Log
) -> None:
    """Every job's shards of this part into the run folder, sharing them with other sweeps that work on it."""
    for job in jobs:
        todo = folder.todo(job.name, options.part)
        if not todo:
            print(f"{job.name}: already in the run folder, reused", file=sys.stderr, flush=True)
            continue
        print(f"{job.name}: warming up (kernels are compiled on first use)", file=sys.stderr, flush=True)
        warm_up(job, bench)
        with progress(job.name, sum(s.last - s.first for s in todo), log=log) as advance:
            _score_job(job, todo, bench, folder, options, stopping, advance)


def _score_job(
    job: Job,
    todo: list[Shard],
    bench: Bench,
    folder: RunFolder,
    options: Options,
    stopping: Callable[[], bool],
    advance: Callable[[int], None],
) -> None:
    while todo:
        left = []
        for shard in todo:
            with folder.claim(job.name, shard) as mine:
                if folder.stored(job.name, shard):
                    advance(shard.last - shard.first)
                elif mine:
                    with folder.write(job.name, shard) as writer:
                        score_shard(job, shard, writer, bench, chunk_of(options, bench), stopping, advance)
                else:
                    left.append(shard)
        if stopping():
            raise Stopped
        if len(left) == len(todo):  # all in other hands: wait for them, or for their claims to fall
            time.sleep(0.5)
        todo = left


def score_shard(
    job: Job,
    shard: Shard,
    writer: ShardWriter,
    bench: Bench,
    chunk: int,
    stopping: Callable[[], bool] = lambda: False,
    advance: Callable[[int], None] = lambda n: None,
) -> None:
    """All trials of a shard through the evaluator into a writer; `Stopped` between chunks where that is asked."""
    for first in range(shard.first, shard.last, chunk):
        if stopping():
            raise Stopped
        last = min(first + chunk, shard.last)
        rows = None if job.rows is None else job.rows[first:last]
        writer.append(**_score_chunk(job, bench.trials(bench.ids(first, last)), rows, bench))
        advance(last - first)


def _score_chunk(job: Job, trials: Trials, rows: torch.Tensor | None, bench: Bench) -> dict[str, pa.Table]:
    """Tables of a chunk in the plan's order; `rows`: the answers' rows, -1 for a trial without one."""
    answered = torch.ones(len(trials), dtype=torch.bool) if rows is None else rows >= 0
    names, tables = bench.names, {}
    if not answered.all():
        tables["trials"] = missing_rows(trials[~answered], names)
    if answered.any():
        part = trials[answered].to(bench.evaluator.scene.device)
        answers = job.predict(part, None if rows is None else rows[answered]).to(bench.evaluator.scene.device)
        keep = "paths" in bench.header["stored"]
        scores = bench.evaluator.score(answers.T_obj_ee, answers.T_world_ee, part, keep_motion=keep)
        scored = score_rows(part, scores, names, answers.t_method_s)
        if (scores.outcome == int(Outcome.INVALID_SIM)).any():
            tables["failures"] = failure_rows(part, answers, scores, names)
        tables["trials"] = pa.concat_tables([scored, *([tables["trials"]] if "trials" in tables else [])])
        for kind in bench.header["stored"]:
            if kind == "details":
                tables[kind] = detail_rows(part, scores, names)
            elif kind == "poses":
                tables[kind] = pose_rows(answers)
            elif kind == "paths":
                tables[kind] = path_rows(scores)
    order = np.argsort(np.concatenate([np.flatnonzero(answered.numpy()), np.flatnonzero(~answered.numpy())]))
    tables["trials"] = tables["trials"].unify_dictionaries().take(pa.array(order))
    return tables


def warm_up(job: Job, bench: Bench, trials: int = WARM_TRIALS) -> None:
    """Compile what the job will use; the poses do not matter, and a user's method is not asked."""
    few = bench.trials(bench.ids(0, min(trials, bench.planned))).to(bench.evaluator.scene.device)
    if job.warm:
        answers = job.predict(few, None)
        T_obj_ee, T_world_ee = answers.T_obj_ee, answers.T_world_ee
    else:
        T_obj_ee = torch.eye(4, device=few.T_world_hand.device).repeat(len(few), 1, 1)
        T_world_ee = few.T_world_hand.clone()
    bench.evaluator.score(T_obj_ee, T_world_ee, few)


def shard_size(bench: Bench, jobs: list[Job]) -> int:
    """Trials of a shard in a new folder: `SHARD_TRIALS`, or what the slowest job does in a minute."""
    if bench.planned <= UNPROBED_TRIALS:
        return SHARD_TRIALS
    slowest = 0.0
    for job in jobs:
        warm_up(job, bench)
        start = time.perf_counter()
        warm_up(job, bench, PROBE_TRIALS)
        slowest = max(slowest, (time.perf_counter() - start) / min(PROBE_TRIALS, bench.planned))
    return max(CPU_CHUNK, min(SHARD_TRIALS, int(SHARD_SECONDS / slowest) // CPU_CHUNK * CPU_CHUNK))
