"""Score shards on a Ray cluster: one actor per device with a warm Evaluator, shards fed to actors that are ready."""

import contextlib
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from r2h_batch import jobs as bench_jobs
from r2h_batch.engine import Stopped, chunk_of, score_shard, warm_up
from r2h_batch.jobs import Bench, Job
from r2h_batch.manifest import Shard, differing, quarantine_path
from r2h_batch.options import Options
from r2h_batch.progress import Log, progress
from r2h_batch.writing import RunFolder, ShardWriter

TRIES = 3
"""Deaths or errors of a shard after which it is quarantined."""

STARTS = 5
"""Actors that may die one after the other before their first shard; then the cluster is given up."""

POLL_S = 0.5

Task = tuple[str, Shard]


class Worker:
    """Lives in an actor: an evaluator, its kernels warm, that scores the shards it is sent."""

    def __init__(self, make_bench: Callable[[Options], Bench], options: Options) -> None:
        self.options, self.bench = options, make_bench(options)
        files = bench_jobs.load_files(options)
        self.jobs = {j.name: j for j in bench_jobs.make_jobs(options, files, self.bench)}
        for job in self.jobs.values():
            warm_up(job, self.bench)

    def header(self) -> dict[str, Any]:
        """What this node would write into run.json: the driver refuses to mix versions."""
        return self.bench.header

    def score(self, name: str, shard: Shard) -> tuple[ShardWriter, float]:
        """A shard's rows and the seconds that they took."""
        start = time.perf_counter()
        writer = ShardWriter()
        score_shard(self.jobs[name], shard, writer, self.bench, chunk_of(self.options, self.bench))
        return writer, time.perf_counter() - start


@dataclass
class Pool:
    """Actors and what they do; a fresh one for each that dies, fed only once it has answered that it is ready."""

    ray: Any
    start: Callable[[], Any]
    starting: dict[Any, Any] = field(default_factory=dict)  # ready ref -> actor
    busy: dict[Any, tuple[Any, Task]] = field(default_factory=dict)  # result ref -> actor, task
    idle: list[Any] = field(default_factory=list)
    deaths: int = 0  # since the last actor that came up

    def fill(self, size: int) -> None:
        """Start as many actors as are missing."""
        while len(self.starting) + len(self.busy) + len(self.idle) < size:
            actor = self.start()
            self.starting[actor.header.remote()] = actor

    def stop(self) -> None:
        """End all actors."""
        for actor in [*self.starting.values(), *(a for a, _ in self.busy.values()), *self.idle]:
            self.ray.kill(actor)


def score_on_ray(
    bench: Bench, jobs: list[Job], folder: RunFolder, options: Options, stopping: Callable[[], bool], log: Log
) -> None:
    """Every job's shards of this part through a pool of actors; only this process writes to the run folder.

    An actor or node that dies costs the shard it was at, which goes to the next one. After `TRIES` failures a shard is
    quarantined and the others go on. Ctrl-C stores what is finished.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    for job in jobs:  # compiles the kernels once, before several processes would at the same time
        warm_up(job, bench)
    todo = deque((j.name, s) for j in jobs for s in folder.todo(j.name, options.part))
    if not todo:
        return
    for name, shard in todo:
        quarantine_path(folder.folder, folder.slugs[name], shard).unlink(missing_ok=True)
    with contextlib.redirect_stdout(sys.stderr):  # Ray's threads print; stdout is for the table
        _on_cluster(ray, bench, todo, folder, options, stopping, log)


def _on_cluster(
    ray: Any,
    bench: Bench,
    todo: "deque[Task]",
    folder: RunFolder,
    options: Options,
    stopping: Callable[[], bool],
    log: Log,
) -> None:
    handlers = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    ray.init(address=options.address or None, log_to_driver=False, include_dashboard=False, logging_level="ERROR")
    for number, handler in handlers.items():  # Ray puts its own in their place, which end the driver at once
        signal.signal(number, handler)
    try:
        gpus = options.gpus_per_worker or (1.0 if options.device != "cpu" else 0.0)
        size = options.workers or _devices(ray, gpus)
        # an actor sees its own GPUs only, as cuda:0; max_restarts 0: the pool replaces actors itself
        mine = replace(options, device="cuda" if options.device != "cpu" else "cpu")
        remote = ray.remote(Worker).options(num_cpus=1, num_gpus=gpus, max_restarts=0)
        pool = Pool(ray, partial(remote.remote, bench_jobs.prepare, mine))
        try:
            total = sum(s.last - s.first for _, s in todo)
            with progress("all methods", total, log=log) as advance:
                _feed(pool, size, todo, folder, bench, stopping, advance)
        finally:
            pool.stop()
    finally:
        ray.shutdown()


def _devices(ray: Any, gpus: float) -> int:
    resources = ray.cluster_resources()
    return max(1, int(resources.get("GPU", 0) / gpus if gpus else resources.get("CPU", 1) / 4))


def _feed(
    pool: Pool,
    size: int,
    todo: "deque[Task]",
    folder: RunFolder,
    bench: Bench,
    stopping: Callable[[], bool],
    advance: Callable[[int], None],
) -> None:
    errors: dict[Task, list[str]] = {}
    while todo or pool.busy:
        if stopping():
            todo.clear()  # what is being scored is stored, nothing new is begun
        while pool.idle and todo:
            actor, task = pool.idle.pop(), todo.popleft()
            pool.busy[actor.score.remote(*task)] = actor, task
        pool.fill(min(size, len(todo) + len(pool.busy)))
        done, _ = pool.ray.wait([*pool.starting, *pool.busy], num_returns=1, timeout=POLL_S)
        for ref in done:
            if ref in pool.starting:
                _came_up(pool, ref, bench)
                continue
            actor, task = pool.busy.pop(ref)
            name, shard = task
            try:
                writer, seconds = pool.ray.get(ref)
            except pool.ray.exceptions.RayError as error:
                if isinstance(error, pool.ray.exceptions.RayTaskError):
                    pool.idle.append(actor)  # the shard failed, the actor lives
                errors.setdefault(task, []).append(" ".join(str(error).split())[-300:])
                if len(errors[task]) < TRIES:
                    todo.append(task)
                else:
                    folder.quarantine(name, shard, errors[task])
                    print(f"{name}: shard {shard.index} failed {TRIES} times", file=sys.stderr, flush=True)
                continue
            pool.idle.append(actor)
            with folder.claim(name, shard):  # no other sweep takes the files for foreign ones meanwhile
                folder.commit(name, shard, writer, seconds)
            advance(shard.last - shard.first)
    if stopping():
        raise Stopped


def _came_up(pool: Pool, ref: Any, bench: Bench) -> None:
    actor = pool.starting.pop(ref)
    try:
        header = pool.ray.get(ref)
    except pool.ray.exceptions.RayError as error:
        pool.deaths += 1
        if pool.deaths >= STARTS:
            raise OSError(f"{STARTS} Ray actors died before their first shard: {error}") from error
        return
    pool.deaths = 0
    if fields := differing(bench.header, {**header, "format": bench.header.get("format")}):
        raise OSError(f"a Ray worker has another {', '.join(fields)}; install the same version on every node")
    pool.idle.append(actor)
