"""Score shards on a Ray cluster: one actor per device with a warm Evaluator, shards fed to actors that are ready."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from r2h_batch.command_line import refuse, tell
from r2h_batch.files import printable
from r2h_batch.results.manifest import Shard, differing
from r2h_batch.results.writing import TRIES, RunFolder, ShardWriter
from r2h_batch.sweep import jobs as sweep_jobs
from r2h_batch.sweep.answers import AnswerError
from r2h_batch.sweep.engine import Stopped, chunk_of, score_shard, warm_up
from r2h_batch.sweep.jobs import Job, Setting
from r2h_batch.sweep.options import Options
from r2h_batch.sweep.progress import Log, progress

STARTS = 5
"""Actors that may die one after the other before their first shard; then the cluster is given up."""

POLL_S = 0.5

Task = tuple[str, Shard]


class ClusterError(Exception):
    """A cluster that cannot be used: one line that says what was asked for and what to do."""


CONNECT = "import sys, ray; ray.init(address=sys.argv[1], log_to_driver=False, logging_level='ERROR'); ray.shutdown()"


def reach(address: str, timeout_s: float) -> None:
    """Nothing, if a Ray cluster answers at the address within the time; else a `ClusterError`.

    Tried in a process of its own: Ray waits for minutes for a cluster that is gone, and cannot be interrupted.
    """
    line = [sys.executable, "-c", CONNECT, address]
    todo = "start one with `ray start --head`, or leave --address out for one on this machine"
    try:
        done = subprocess.run(line, capture_output=True, text=True, errors="replace", timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        raise ClusterError(
            f"no Ray cluster answered at --address {printable(address)} within {timeout_s:g} s (--ray-timeout); {todo}"
        ) from None
    if done.returncode:
        why = printable((done.stderr.strip().splitlines() or ["it ended without a word"])[-1])[:200]
        raise ClusterError(f"no Ray cluster at --address {printable(address)} ({why}); {todo}")


class Worker:
    """Lives in an actor: an evaluator, its kernels warm, that scores the shards it is sent."""

    def __init__(self, make_setting: Callable[[Options], Setting], options: Options) -> None:
        self.options, self.setting = options, make_setting(options)
        files = sweep_jobs.load_files(options)
        self.jobs = {j.name: j for j in sweep_jobs.make_jobs(options, files, self.setting)}
        for job in self.jobs.values():
            warm_up(job, self.setting)

    def header(self) -> dict[str, Any]:
        """What this node would write into run.json: the driver refuses to mix versions."""
        return self.setting.header

    def score(self, name: str, shard: Shard) -> tuple[ShardWriter, float]:
        """A shard's rows and the seconds that they took."""
        start = time.perf_counter()
        writer = ShardWriter()
        score_shard(self.jobs[name], shard, writer, self.setting, chunk_of(self.options, self.setting))
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
    setting: Setting, jobs: list[Job], folder: RunFolder, options: Options, stopping: Callable[[], bool], log: Log
) -> list[str]:
    """Every job's shards of this part through a pool of actors; only this process writes to the run folder.

    An actor or node that dies costs the shard it was at, which goes to the next one. After `TRIES` failures a shard is
    quarantined and the others go on. Ctrl-C stores what is finished. Returns methods as `score_local` does.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    for job in jobs:  # compiles the kernels once, before several processes would at the same time
        warm_up(job, setting)
    todo = deque((j.name, s) for j in jobs for s in folder.todo(j.name, options.part))
    if not todo:
        return []
    for name, shard in todo:
        folder.give_another_try(name, shard)
    with contextlib.redirect_stdout(sys.stderr):  # Ray's threads print; stdout is for the table
        return _on_cluster(ray, setting, todo, folder, options, stopping, log)


def _on_cluster(
    ray: Any,
    setting: Setting,
    todo: "deque[Task]",
    folder: RunFolder,
    options: Options,
    stopping: Callable[[], bool],
    log: Log,
) -> list[str]:
    handlers = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    # local: a cluster of its own; without an address Ray would join whatever a file in /tmp or the environment names
    own = {} if options.address else {"include_dashboard": False}
    try:
        ray.init(address=options.address or "local", log_to_driver=False, logging_level="ERROR", **own)
    except (OSError, RuntimeError, ValueError) as error:
        raise ClusterError(f"no Ray cluster could be started or joined: {printable(error)[:300]}") from None
    for number, handler in handlers.items():  # Ray puts its own in their place, which end the driver at once
        signal.signal(number, handler)
    try:
        gpus = options.gpus_per_worker or (1.0 if options.device != "cpu" else 0.0)
        size = options.workers or _devices(ray, gpus)
        # an actor sees its own GPUs only, as cuda:0; max_restarts 0: the pool replaces actors itself
        mine = replace(options, device="cuda" if options.device != "cpu" else "cpu")
        remote = ray.remote(Worker).options(num_cpus=1, num_gpus=gpus, max_restarts=0)
        pool = Pool(ray, partial(remote.remote, sweep_jobs.prepare, mine))
        try:
            total = sum(s.last - s.first for _, s in todo)
            with progress("all methods", total, log=log) as advance:
                return _feed(pool, size, todo, folder, setting, stopping, advance)
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
    setting: Setting,
    stopping: Callable[[], bool],
    advance: Callable[[int], None],
) -> list[str]:
    refused: list[str] = []
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
                _came_up(pool, ref, setting)
                continue
            actor, task = pool.busy.pop(ref)
            name, shard = task
            try:
                writer, seconds = pool.ray.get(ref)
            except pool.ray.exceptions.RayError as error:
                if isinstance(error, pool.ray.exceptions.RayTaskError):
                    pool.idle.append(actor)  # the shard failed, the actor lives
                cause = getattr(error, "cause", None)
                if isinstance(cause, AnswerError):  # it would answer the same again
                    if name not in refused:
                        refuse("sweep", cause)
                        refused.append(name)
                    left = [t for t in todo if t[0] != name]
                    todo.clear()
                    todo.extend(left)
                    continue
                errors.setdefault(task, []).append(" ".join(str(error).split())[-300:])
                if len(errors[task]) < TRIES:
                    todo.append(task)
                else:
                    folder.quarantine(name, shard, errors[task])
                    tell(f"{name}: shard {shard.index} failed {TRIES} times")
                continue
            pool.idle.append(actor)
            with folder.claim(name, shard):  # no other sweep takes the files for foreign ones meanwhile
                folder.commit(name, shard, writer, seconds)
            advance(shard.last - shard.first)
    if stopping():
        raise Stopped
    return refused


def _came_up(pool: Pool, ref: Any, setting: Setting) -> None:
    actor = pool.starting.pop(ref)
    try:
        header = pool.ray.get(ref)
    except pool.ray.exceptions.RayError as error:
        pool.deaths += 1
        if pool.deaths >= STARTS:
            raise ClusterError(f"{STARTS} Ray actors died before their first shard: {error}") from error
        return
    pool.deaths = 0
    if fields := differing(setting.header, {**header, "format": setting.header.get("format")}):
        raise ClusterError(f"a Ray worker has another {', '.join(fields)}; install the same version on every node")
    pool.idle.append(actor)
