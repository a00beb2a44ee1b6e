"""Instances that other processes draw, while this one draws too or trains on those that are there.

Each instance and its grasp candidates depend on their numbers alone, and go through the cache on disk, where one process makes
an entry and the others wait for it. So who drew them decides nothing. The processes are the workers of a torch DataLoader. What
goes wrong in one goes wrong again, and is said, where the instance is asked for.
"""

import atexit
import contextlib
import multiprocessing
import os
import threading
import warnings
import weakref
from collections.abc import Iterator, Sequence
from functools import partial
from multiprocessing.process import BaseProcess
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset

from r2h_batch.base.io.cache import cache_folder
from r2h_batch.base.io.child import end_with
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.progress import progress
from r2h_batch.methods.candidates import CandidateKind, candidates_of
from r2h_batch.scene.families.kept import is_kept, was_drawn
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot
from r2h_batch.trials.family_objects import Planned

FEW = 4
"""Instances that this process draws sooner alone than others begin to: each of these takes seconds of a core to start where it
is no fork."""


class _ToDraw(Dataset[int]):
    """Instances to draw; an item is the number of one that is on disk."""

    def __init__(self, planned: Sequence[Planned], robot: Robot, kind: CandidateKind) -> None:
        self.planned, self.robot, self.kind = planned, robot, kind

    def __len__(self) -> int:
        return len(self.planned)

    def __getitem__(self, k: int) -> int:
        with contextlib.suppress(Exception):  # it comes again where the object is asked for
            _with_candidates(self.planned[k].drawn(), self.robot, self.kind)
        return k


class Drawing:
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
            workers: processes; None: one for each core but one, and none for a few instances. Where the cache on disk is off, and
                in a process that may start none, such as a worker of a DataLoader, there are none.
        """
        self.planned, self.robot, self.kind = tuple(planned), robot, kind
        todo = [p for p in self.planned if is_kept(p.family) and not _was_drawn(p)]
        if workers is None:
            workers = len(os.sched_getaffinity(0)) - 1 if len(todo) > FEW else 0
        alone = cache_folder() is None or multiprocessing.current_process().daemon
        workers = 0 if alone else min(workers, len(todo))
        self._owner, self._stop = os.getpid(), _nothing
        self._processes: list[BaseProcess] = []
        if not workers:
            return
        LOG.info(f"instances: {workers} more processes draw {len(todo)}")
        before, stopped = multiprocessing.active_children(), threading.Event()
        waiting = _begun(_ToDraw(todo, robot, kind), workers, stopped)
        self._processes = [p for p in multiprocessing.active_children() if p not in before]
        self._stop = partial(_end, waiting, stopped, self._owner)
        weakref.finalize(self, stopped.set).atexit = False
        atexit.register(self._stop)  # torch's own, which comes later, waits for each process

    def objects(self, numbers: Sequence[int]) -> tuple[ObjectModel, ...]:
        """The instances of these numbers: drawn here, where nobody else draws them yet, or read.

        Args:
            numbers: places in `planned`.
        """
        found: dict[int, ObjectModel] = {}
        with progress("instances (kept on disk)", len(numbers), "objects") as told:
            for k in reversed(numbers):  # the others begin at the beginning
                found[k] = self.planned[k].drawn()
                if self._processes:
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
        own = self._processes if os.getpid() == self._owner else []
        return tuple(p.pid for p in own if p.pid is not None and p.is_alive())

    def close(self) -> None:
        """End the processes; what they have not drawn is drawn where it is asked for."""
        self._stop()
        atexit.unregister(self._stop)

    def __getstate__(self) -> dict[str, Any]:
        """For another process, which ends nothing."""
        return {**vars(self), "_processes": [], "_stop": _nothing}


def _begun(instances: _ToDraw, workers: int, stopped: threading.Event) -> threading.Thread:
    """The thread that waits for the processes, which draw from now on."""
    # Python's own default may be to start the program anew, and many have no `if __name__ == "__main__"`
    method = multiprocessing.get_start_method(allow_none=True) or "fork"
    with warnings.catch_warnings():
        # more processes than cores; a fork of a process with threads
        warnings.simplefilter("ignore")
        items = iter(
            DataLoader(
                instances,
                batch_size=None,
                num_workers=workers,
                prefetch_factor=-(-len(instances) // workers),
                multiprocessing_context=method,
                worker_init_fn=partial(_end_with_parent, method),
                generator=torch.Generator(),
            )
        )
    waiting = threading.Thread(target=_wait_for, args=(items, stopped), daemon=True)
    waiting.start()
    return waiting


def _wait_for(items: Iterator[int], stopped: threading.Event) -> None:
    """Until all is drawn, nobody wants more, or a process was killed (what it had begun is drawn where it is asked for); then
    the loader goes, and ends its processes."""
    with contextlib.suppress(RuntimeError):
        for _ in items:
            if stopped.is_set():
                return


def _end(waiting: threading.Thread, stopped: threading.Event, owner: int) -> None:
    stopped.set()
    if os.getpid() == owner:  # else a fork of it, such as a worker of a DataLoader
        waiting.join()


def _nothing() -> None:
    """There is no process to end."""


def _end_with_parent(method: str, _: int) -> None:
    """A worker that draws looks for its parent only after all instances that it was given. `method`: how it was started."""
    parent = multiprocessing.parent_process()
    assert parent is not None and parent.pid is not None
    if method == "forkserver":  # it is the server's child

        def watch() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()
    else:
        end_with(parent.pid)


def _was_drawn(one: Planned) -> bool:
    return was_drawn(one.family, one.series, one.index, standing=one.standing)


def _with_candidates(model: ObjectModel, robot: Robot, kind: CandidateKind) -> None:
    with warnings.catch_warnings():  # it comes again where the candidates are asked for
        warnings.simplefilter("ignore")
        candidates_of((model,), kind, robot)
