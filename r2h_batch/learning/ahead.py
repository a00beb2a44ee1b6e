"""Instances that other processes draw, while this one draws too or trains on those that are there.

Each instance and its grasp candidates depend on their numbers alone, and go through the cache on disk. So who drew them decides
nothing. `python -m r2h_batch.learning.ahead` is such a process: its stdin says what to draw. What goes wrong in it goes wrong
again, and is said, where the instance is asked for.
"""

import contextlib
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import warnings
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from r2h_batch.base.io.cache import cache_folder
from r2h_batch.base.io.child import end_with
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.progress import progress
from r2h_batch.methods.candidates import CandidateKind, candidates_of
from r2h_batch.protocols.family_objects import Planned
from r2h_batch.scene.families.family import FAMILIES
from r2h_batch.scene.families.kept import is_kept, was_drawn
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot

FEW = 4
"""Instances that this process draws sooner alone than others begin to: each of these takes three seconds of a core to start."""


class _Job(NamedTuple):
    """Instances for a process to draw: (category, series, index, standing) of each instance, and for whose gripper."""

    instances: list[tuple[str, int, int, bool]]
    robot: Robot
    kind: CandidateKind
    claims: str
    cache: str


class Ahead:
    """Instances of families, and the processes that draw them ahead.

    They end when all is drawn, when this object is closed or no longer used, and with this process, however that ends.
    """

    def __init__(
        self,
        planned: Sequence[Planned],
        robot: Robot,
        kind: CandidateKind,
        workers: int | None = None,
    ) -> None:
        """Starts the processes.

        Args:
            planned: the instances, those that are needed first at the beginning.
            robot: whose grasp candidates they get.
            kind: of candidates, as `EvalConfig.candidates`.
            workers: processes; None: one for each core but one, and none for a few instances. Where the cache on disk is off
                there are none.
        """
        self.planned, self.robot, self.kind = tuple(planned), robot, kind
        todo = [p for p in self.planned if _is_shared(p) and not _was_drawn(p)]
        if workers is None:
            workers = len(os.sched_getaffinity(0)) - 1 if len(todo) > FEW else 0
        folder = cache_folder()
        workers = 0 if folder is None else min(workers, len(todo))
        self._claims: Path | None = None
        self._processes: list[subprocess.Popen[bytes]] = []
        if not workers:
            return
        self._claims = Path(tempfile.mkdtemp(prefix="r2h_batch_"))
        self._end = weakref.finalize(self, _end, os.getpid(), self._processes, self._claims)
        job = _Job(
            [(p.family.category, p.series, p.index, p.standing) for p in todo],
            robot, kind, str(self._claims), str(folder),
        )  # fmt: skip
        LOG.info(f"instances: {workers} more processes draw {len(todo)}")
        for _ in range(workers):
            self._processes.append(_started(job))

    def objects(self, numbers: Sequence[int]) -> tuple[ObjectModel, ...]:
        """The instances of these numbers: drawn here, where nobody else draws them yet, or read.

        Args:
            numbers: places in `planned`.
        """
        found: dict[int, ObjectModel] = {}
        with progress("instances (kept on disk)", len(numbers), "objects") as told:
            # first what is free, then what the others have begun
            for later in (False, True):
                for k in numbers:
                    one = self.planned[k]
                    if k not in found and (later or self._is_mine(one)):
                        found[k] = one.drawn()
                        if (
                            self._claims is not None
                        ):  # the others do not come back for its candidates
                            _with_candidates(found[k], self.robot, self.kind)
                        told(1)
        if running := len(self.running):
            there = sum(map(_was_drawn, self.planned))
            LOG.info(
                f"instances: {there} of {len(self.planned)} are there, {running} processes draw the others"
            )
        return tuple(found[k] for k in numbers)

    @property
    def running(self) -> tuple[int, ...]:
        """Ids of the processes that still draw."""
        return tuple(worker.pid for worker in self._processes if worker.poll() is None)

    def close(self) -> None:
        """End the processes; what they have not drawn is drawn where it is asked for."""
        if self._claims is not None:
            self._end()

    def _is_mine(self, one: Planned) -> bool:
        """Whether nobody else draws an instance, so that this process may."""
        return self._claims is None or not _is_shared(one) or _claimed(self._claims, one.name)

    def __getstate__(self) -> dict[str, Any]:
        """For another process: it may claim instances, but ends nothing."""
        return {k: v for k, v in vars(self).items() if k != "_end"} | {"_processes": []}


def _is_shared(one: Planned) -> bool:
    """Whether another process can draw an instance for this one."""
    return is_kept(one.family)


def _was_drawn(one: Planned) -> bool:
    return was_drawn(one.family, one.series, one.index, standing=one.standing)


def _claimed(claims: Path, name: str) -> bool:
    """Whether this call is the first one that claims an instance; nobody can, once the processes have ended."""
    try:
        os.close(os.open(claims / name, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    except (FileExistsError, FileNotFoundError):
        return False
    return True


def _with_candidates(model: ObjectModel, robot: Robot, kind: CandidateKind) -> None:
    with warnings.catch_warnings():  # it comes again where the candidates are asked for
        warnings.simplefilter("ignore")
        candidates_of((model,), kind, robot)


def _started(job: _Job) -> "subprocess.Popen[bytes]":
    """A process that draws. It has a session of its own: Ctrl-C is for the process that trains, which ends it."""
    path = os.pathsep.join(p or os.getcwd() for p in sys.path)
    worker = subprocess.Popen(
        [sys.executable, "-P", "-m", "r2h_batch.learning.ahead", str(os.getpid())],
        stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True,
        env={**os.environ, "PYTHONPATH": path, "R2H_BATCH_CACHE": job.cache},
    )  # fmt: skip
    assert worker.stdin is not None
    with contextlib.suppress(BrokenPipeError), worker.stdin as stream:
        pickle.dump(job, stream)
    return worker


def _end(owner: int, processes: "Sequence[subprocess.Popen[bytes]]", claims: Path) -> None:
    if os.getpid() != owner:  # a fork of it, such as a worker of a DataLoader
        return
    for worker in processes:
        worker.kill()
    for worker in processes:
        worker.wait()
    shutil.rmtree(claims, ignore_errors=True)


def work() -> None:
    """Draw what stdin names and nobody has claimed."""
    end_with(int(sys.argv[1]))
    job: _Job = pickle.load(sys.stdin.buffer)
    torch.set_num_threads(1)
    for category, series, index, standing in job.instances:
        one = Planned(FAMILIES[category], series, index, standing)
        if not _claimed(Path(job.claims), one.name):
            continue
        # both come again where the object is asked for
        with warnings.catch_warnings(), contextlib.suppress(Exception):
            warnings.simplefilter("ignore")
            _with_candidates(one.drawn(), job.robot, job.kind)


if __name__ == "__main__":
    work()
