"""Score shards on a Ray cluster: one actor per device with a warm Evaluator, shards fed to actors
that are ready."""

import contextlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TextIO, cast

from r2h_batch.base.command_line import refuse
from r2h_batch.base.errors import AnswerError, MachineError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.runs.header import Shard, differing
from r2h_batch.runs.writing import TRIES, ShardWriter
from r2h_batch.sweep import jobs as sweep_jobs
from r2h_batch.sweep.jobs import Setting
from r2h_batch.sweep.request import Sweep
from r2h_batch.sweep.scoring import Scoring, Stopped, progress, score_shard, warm_up

STARTS = 5
"""Actors that may die one after the other before their first shard; then the cluster is given
up."""

POLL_S = 0.5
HEAD_EVERY_S, GRACE_S = 2.0, 5.0

Task = tuple[str, Shard]


class ClusterError(MachineError):
    """A cluster that cannot be used: one line that says what was asked for and what to do."""


CONNECT = Path(__file__).with_name("connect.py")
NO_TOKEN = ("InvalidAuthToken", "AuthenticationError", "Unauthenticated")
"""Ray's line when a cluster asks for a token. Ray repeats it until its own time limit."""


def reach(address: str, timeout_s: float) -> None:
    """Nothing, if a Ray cluster answers at the address within the time; else a `ClusterError`.

    Tried in a process of its own: Ray waits for minutes for a cluster that is gone, and cannot be
    interrupted.
    """
    # A token that is there is shown, as `ray start` does: without the mode Ray's own `init` leaves it.
    named = os.environ.get("RAY_AUTH_TOKEN") or os.environ.get("RAY_AUTH_TOKEN_PATH")
    if named or os.path.isfile(os.path.expanduser("~/.ray/auth_token")):
        os.environ.setdefault("RAY_AUTH_MODE", "token")
    where = f"at --address {printable(address)}"
    todo = "start one with `ray start --head`, or leave --address out for one on this machine"
    with tempfile.TemporaryFile() as stderr:
        line = [sys.executable, "-P", str(CONNECT), address]
        process = subprocess.Popen(
            line, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr
        )
        end, text = time.monotonic() + timeout_s, ""
        try:
            while (code := process.poll()) is None and time.monotonic() < end:
                time.sleep(0.05)
                text = os.pread(stderr.fileno(), 1 << 20, 0).decode(errors="replace")
                if any(word in text for word in NO_TOKEN):
                    break
            text = os.pread(stderr.fileno(), 1 << 20, 0).decode(errors="replace")
        finally:
            process.kill()
            process.wait()
    if code == 0:
        return
    if any(word in text for word in NO_TOKEN):
        raise ClusterError(
            f"the Ray cluster {where} asks for another token than this machine shows: export RAY_AUTH_MODE=token and"
            " RAY_AUTH_TOKEN_PATH (or RAY_AUTH_TOKEN) here and on every node alike, docs/sweeps.md has the steps"
        )
    if code is None:
        within = f"within {timeout_s:g} s (--ray-timeout)"
        raise ClusterError(f"no Ray cluster answered {where} {within}; {todo}")
    why = printable((text.strip().splitlines() or ["it ended without a word"])[-1])[:200]
    raise ClusterError(f"no Ray cluster {where} ({why}); {todo}")


@contextlib.contextmanager
def _own_token() -> Iterator[None]:
    """A token for one cluster: Ray would write one to ~/.ray/auth_token, and from then on ask every
    node here for it."""
    if any(os.environ.get(k) for k in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")):
        yield
        return
    # not the mode: `init` sets that, and tells its own core
    os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    try:
        yield
    finally:
        for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_MODE"):
            os.environ.pop(name, None)


class Head:
    """Watches from a thread whether the head of a cluster that was joined still takes connections;
    "" watches nothing.

    Ray itself notices after a minute or more, and then ends the process from inside; until then its
    calls may hang.
    """

    def __init__(self, address: str, timeout_s: float) -> None:
        self.address, self.timeout_s, self.lost, self.reported = address, timeout_s, "", False
        self.over = threading.Event()
        if address:
            threading.Thread(target=self._watch, daemon=True).start()

    def check(self) -> None:
        """Raises `ClusterError` where it has taken none for as long as `--ray-timeout`."""
        if self.lost:
            self.reported = True
            raise ClusterError(self.lost)

    def _watch(self) -> None:
        host, _, port = self.address.rpartition(":")
        heard = time.monotonic()
        while not self.over.wait(HEAD_EVERY_S):
            with contextlib.suppress(OSError):
                place = (host.strip("[]"), int(port))
                socket.create_connection(place, timeout=HEAD_EVERY_S).close()
                heard = time.monotonic()
            if time.monotonic() - heard > self.timeout_s:
                break
        else:
            return
        self.lost = (
            f"the Ray cluster at {printable(self.address)} has not answered for {self.timeout_s:g} s (--ray-timeout):"
            " its head or the network between is gone; complete shards are stored, the same command continues"
        )
        # for the main thread to say so and to leave, unless it hangs in a call of Ray's
        time.sleep(GRACE_S)
        if not self.reported:
            LOG.info(f"sweep: {self.lost}")
        sys.stderr.flush()
        os._exit(1)  # shards appear whole or not at all, so nothing can be left half done


class Worker:
    """Lives in an actor: an evaluator, its kernels warm, that scores the shards it is sent."""

    def __init__(self, set_up: Callable[[Sweep], Setting], sweep: Sweep) -> None:
        self.setting = set_up(sweep)
        files = sweep_jobs.load_files(sweep)
        self.jobs = {j.name: j for j in sweep_jobs.make_jobs(self.setting, files)}
        for job in self.jobs.values():
            warm_up(job, self.setting)

    def header(self) -> dict[str, Any]:
        """The header that this node would write into run.json. The driver refuses to mix versions, methods or
        files."""
        return self.setting.header | {"sources": {n: j.source for n, j in self.jobs.items()}}

    def score(self, name: str, shard: Shard) -> tuple[ShardWriter, float]:
        """A shard's rows and the seconds that they took."""
        start = time.perf_counter()
        writer = ShardWriter()
        score_shard(self.jobs[name], shard, writer, self.setting)
        return writer, time.perf_counter() - start


@dataclass
class Pool:
    """Actors and what they do; a fresh one for each that dies, fed only once it has answered that
    it is ready."""

    ray: Any
    start: Callable[[], Any]
    check: Callable[[], None] = lambda: None  # raises where the cluster is gone
    starting: dict[Any, Any] = field(default_factory=dict)  # ready ref -> actor
    busy: dict[Any, tuple[Any, Task]] = field(default_factory=dict)  # result ref -> actor, task
    idle: list[Any] = field(default_factory=list)
    deaths: int = 0  # since the last actor that came up
    nodes: int = 0  # that were alive when they were counted last

    def fill(self, size: int) -> None:
        """Start as many actors as are missing."""
        while len(self.starting) + len(self.busy) + len(self.idle) < size:
            actor = self.start()
            self.starting[actor.header.remote()] = actor

    def stop(self) -> None:
        """End all actors; those of a cluster that is gone have ended."""
        with contextlib.suppress(OSError, self.ray.exceptions.RayError):
            for actor in [*self.starting.values(), *(a for a, _ in self.busy.values()), *self.idle]:
                self.ray.kill(actor)


def _lost(error: Exception) -> ClusterError:
    """Ray's message of a call that does not reach the cluster."""
    return ClusterError(
        f"the Ray cluster does not answer any more ({printable(error)[:200]}): its node on this machine or its head is"
        " gone; complete shards are stored, the same command continues"
    )


def score_on_ray(work: Scoring) -> dict[str, int]:
    """Every job's shards of this part through a pool of actors, which set up the sweep again; only this
    process writes to the run folder.

    An actor or node that dies loses the shard it was at, which is queued again behind the others. After `TRIES`
    failures a shard is left out and the others go on. Ctrl-C stores what is finished. Returns
    methods as `score_local` does.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if not work.setting.sweep.address:  # on 127.0.0.1: nobody else is to reach what runs code
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    import ray

    for job in work.jobs:  # compiles the kernels once, before several processes would
        warm_up(job, work.setting)
    folder, part = work.folder, work.setting.sweep.part
    todo = deque((j.name, s) for j in work.jobs for s in folder.todo(j.name, part))
    if not todo:
        return {}
    # Ray's threads print; stdout is for the table
    with (
        contextlib.redirect_stderr(cast("TextIO", NotOfRay(sys.stderr))),
        contextlib.redirect_stdout(sys.stderr),
    ):
        return _on_cluster(ray, work, todo)


class NotOfRay:
    """A stream without what Ray's own threads print, such as twenty lines of a dead node's log; what happened is told."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes, unless a thread of Ray's does."""
        if threading.current_thread().name.startswith("ray_"):
            LOG.debug(text)
            return len(text)
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _on_cluster(ray: Any, work: Scoring, todo: "deque[Task]") -> dict[str, int]:
    sweep = work.setting.sweep
    handlers = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    # local: a cluster of its own; without an address Ray would join whatever a file in /tmp or the
    # environment names
    own = {} if sweep.address else {"include_dashboard": False}
    try:
        with contextlib.nullcontext() if sweep.address else _own_token():
            address = sweep.address or "local"
            ray.init(address=address, log_to_driver=False, logging_level="ERROR", **own)
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        words = f"could be started or joined: {printable(error)[:300]}"
        raise ClusterError(f"no Ray cluster {words}") from None
    # Ray puts its own in their place, which end the driver at once
    for number, handler in handlers.items():
        signal.signal(number, handler)
    # a Ray client (ray://) has no head of its own to ask
    watched = sweep.address and "://" not in sweep.address
    head = Head(ray.get_runtime_context().gcs_address if watched else "", sweep.ray_timeout)
    try:
        gpus = sweep.gpus_per_worker or (1.0 if sweep.device != "cpu" else 0.0)
        there = ray.cluster_resources()
        devices = there.get("GPU", 0) / gpus if gpus else there.get("CPU", 1) / 4
        size = sweep.workers or max(1, int(devices))
        # an actor sees its own GPUs only, as cuda:0; max_restarts 0: the pool replaces actors
        # itself
        on_node = replace(sweep, device="cuda" if sweep.device != "cpu" else "cpu")
        remote = ray.remote(Worker).options(num_cpus=1, num_gpus=gpus, max_restarts=0)
        pool = Pool(ray, partial(remote.remote, sweep_jobs.set_up, on_node), head.check)
        pool.nodes = _alive(ray)
        try:
            total = sum(s.last - s.first for _, s in todo)
            with progress("all methods", total, file=work.progress) as advance:
                return _feed(pool, size, todo, work, advance)
        finally:
            if not head.lost:
                pool.stop()
    finally:
        if not head.lost:
            head.over.set()
            ray.shutdown()


def _feed(
    pool: Pool, size: int, todo: "deque[Task]", work: Scoring, advance: Callable[[int], None]
) -> dict[str, int]:
    refused: dict[str, int] = {}
    errors: dict[Task, list[str]] = {}
    while todo or pool.busy:
        pool.check()
        if work.stopping():
            todo.clear()  # what is being scored is stored, nothing new is begun
        try:
            while pool.idle and todo:
                actor, task = pool.idle.pop(), todo.popleft()
                pool.busy[actor.score.remote(*task)] = actor, task
            pool.fill(min(size, len(todo) + len(pool.busy)))
            done, _ = pool.ray.wait([*pool.starting, *pool.busy], num_returns=1, timeout=POLL_S)
        except (OSError, pool.ray.exceptions.RayError) as error:
            raise _lost(error) from error
        for ref in done:
            if ref in pool.starting:
                _came_up(pool, ref, work)
                continue
            actor, task = pool.busy.pop(ref)
            name, shard = task
            try:
                writer, seconds = pool.ray.get(ref)
            except pool.ray.exceptions.RayError as error:
                if isinstance(error, pool.ray.exceptions.RayTaskError):
                    pool.idle.append(actor)  # the shard failed, the actor lives
                    what = "it failed"
                else:
                    what = _died(error, pool)
                cause = getattr(error, "cause", None)
                if isinstance(cause, AnswerError):  # it would answer the same again
                    if name not in refused:
                        refused[name] = refuse("sweep", cause)
                    left = [t for t in todo if t[0] != name]
                    todo.clear()
                    todo.extend(left)
                    continue
                errors.setdefault(task, []).append(" ".join(str(error).split())[-300:])
                if len(errors[task]) < TRIES:
                    todo.append(task)
                    LOG.info(
                        f"{name}: {what} at shard {shard.index}, which is scored again; the sweep goes on"
                    )
                else:
                    work.go_on_without(name, shard, printable(errors[task][-1]))
                continue
            except OSError as error:
                raise _lost(error) from error
            pool.idle.append(actor)
            # no other sweep takes the files for foreign ones meanwhile
            with work.folder.claim(name, shard):
                work.folder.commit(name, shard, writer, seconds)
            advance(shard.last - shard.first)
    if work.stopping():
        raise Stopped
    return refused


def _alive(ray: Any) -> int:
    """How many nodes of the cluster are alive."""
    return sum(1 for node in ray.nodes() if node["Alive"])


def _died(error: Exception, pool: Pool) -> str:
    """Who died, from Ray's error of a call that got no answer.

    Raises:
        ClusterError: no node is left.
    """
    before, pool.nodes = pool.nodes, _alive(pool.ray)
    if not pool.nodes:
        raise ClusterError(
            "the last node of the Ray cluster died (its raylet was killed, by the system where memory ran out); complete shards"
            " are stored, the same command continues"
        )
    of_node = "node has died" in str(error) or type(error).__name__ == "NodeDiedError"
    if of_node or pool.nodes < before:
        return "a node of the cluster died, and its workers with it"
    return "a worker died"


def _came_up(pool: Pool, ref: Any, work: Scoring) -> None:
    actor = pool.starting.pop(ref)
    try:
        header = pool.ray.get(ref)
    except pool.ray.exceptions.RayError as error:
        pool.deaths += 1
        if pool.deaths >= STARTS:
            words = f"{STARTS} Ray actors died before their first shard: {error}"
            raise ClusterError(words) from error
        LOG.info(f"sweep: {_died(error, pool)} before its first shard; another one starts")
        return
    except OSError as error:
        raise _lost(error) from error
    pool.deaths = 0
    sources, own = {job.name: job.source for job in work.jobs}, work.setting.header
    others = [n for n, source in header.get("sources", {}).items() if source != sources[n]]
    if others:
        what = f"another {others[0]} (its module, its imports or its files)"
        raise ClusterError(f"a Ray worker has {what}; copy the same files to every node")
    if fields := differing(own, {**header, "format": own.get("format")}):
        words = "install the same version on every node"
        raise ClusterError(f"a Ray worker differs in {', '.join(fields)}; {words}")
    pool.idle.append(actor)
