"""Trials that are known to have a whole way: how often each was drawn again until a search found one, and its answer.

`assets/certified/build_certified.py` makes the files. A certificate holds for the benchmark whose digest it names: with other
objects, people, robot, table or seed the trials are drawn once, and nothing is certified.

Where the benchmark names a `search`, its trials beyond the file are certified when they are first asked for, and kept on disk
(`io.cache`): any number of trials is solvable by construction.
"""

import hashlib
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.resources import as_file, files
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.cache import ArraySpec, cached, code_digest, is_cached
from r2h_batch.base.io.progress import progress
from r2h_batch.base.io.read import printable

AT_ONCE = 64
"""Trials that are certified together."""
CODE = tuple(
    f"r2h_batch.{name}"
    for name in (
        *("config", "evaluate", "judge", "observe", "scene", "stages", "trials", "trials.draw", "trials.holding"),
        *("methods.candidates", "methods.certify", "methods.from_table", "methods.oracle"),
        *("kernels.geometry", "kernels.grasp", "kernels.ik", "kernels.judge", "kernels.plan", "kernels.robot"),
    )
)  # fmt: skip
"""What decides a certificate: with other code, those on disk are made anew."""
VERSIONS = ("torch", "warp-lang", "numpy")
_KIND = "certified"
_FORM = {
    "redraws": ArraySpec("int64", (1,)), "solved": ArraySpec("bool", (1,)),
    "T_obj_ee": ArraySpec("float32", (1, 4, 4)), "T_world_ee": ArraySpec("float32", (1, 4, 4)),
}  # fmt: skip
DRAWN_BEFORE = {"r2h-v3": "r2h-v3-0.3"}
"""Rule -> the redraws of r2h_batch 0.3, where they were others, without answers: its runs are of those trials."""
NEVER = 0
"""Redraws of a trial for which nothing was found: it stays the first one, without an answer."""
_ARRAYS = ("trial_id", "redraws", "solved", "T_obj_ee", "T_world_ee")


class Answers(NamedTuple):
    """Certified answers of some trials: where `known`, T_obj_ee and T_world_ee (n, 4, 4), m."""

    known: Bool[NDArray[np.bool_], " n"]
    T_obj_ee: Float32[NDArray[np.float32], "n 4 4"]
    T_world_ee: Float32[NDArray[np.float32], "n 4 4"]


@dataclass(frozen=True, eq=False)
class Certified:
    """N trials of a benchmark, sorted by their ids.

    Attributes:
        trial_id: (N,) their ids.
        redraws: (N,) how often each was drawn again.
        solved: (N,) whether an answer of it is known.
        T_obj_ee: (N, 4, 4) grasps of these answers, m.
        T_world_ee: (N, 4, 4) handover poses, m.
        benchmark: `Benchmark.undrawn_digest` of the benchmark that they are trials of.
        search: name in `benchmark.SEARCH` of what certifies trials that are not here; empty: such trials are drawn once.
    """

    trial_id: Int64[NDArray[np.int64], " N"]
    redraws: Int64[NDArray[np.int64], " N"]
    solved: Bool[NDArray[np.bool_], " N"]
    T_obj_ee: Float32[NDArray[np.float32], "N 4 4"]
    T_world_ee: Float32[NDArray[np.float32], "N 4 4"]
    benchmark: str
    search: str = ""

    @cached_property
    def digest(self) -> str:
        """sha256 (hex) over what decides the trials: ids and redraws."""
        drawn = np.stack([self.trial_id, self.redraws]).astype("<i8")
        return hashlib.sha256(drawn.tobytes()).hexdigest()

    def redraws_of(
        self, trial_id: Int64[NDArray[np.int64], " n"]
    ) -> Int64[NDArray[np.int64], " n"]:
        """How often each of these trials (n,) was drawn again; 0 of those that are not here."""
        at, here = self._at(trial_id)
        return np.where(here, self.redraws[at], 0)

    def knows(self, trial_id: Int64[NDArray[np.int64], " n"]) -> Bool[NDArray[np.bool_], " n"]:
        """Whether an answer of each of these trials (n,) is known."""
        at, here = self._at(trial_id)
        return here & self.solved[at]

    def holds(self, trial_id: Int64[NDArray[np.int64], " n"]) -> Bool[NDArray[np.bool_], " n"]:
        """Whether each of these trials (n,) is here, with an answer or without."""
        return self._at(trial_id)[1]

    def answers(self, trial_id: Int64[NDArray[np.int64], " n"]) -> Answers:
        """The answers of these trials (n,)."""
        at, _ = self._at(trial_id)
        return Answers(self.knows(trial_id), self.T_obj_ee[at], self.T_world_ee[at])

    def _at(self, trial_id: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Rows of these trials, and whether they are here."""
        at = np.minimum(np.searchsorted(self.trial_id, trial_id), len(self.trial_id) - 1)
        return at, self.trial_id[at] == trial_id


Search = Callable[[NDArray[np.int64]], Certified]
"""Certifies trials of a benchmark: ids, ascending -> their certificates."""


def load_certified(name: str, *, search: str = "") -> Certified:
    """The certificates that the package ships for a benchmark.

    Args:
        name: of the benchmark.
        search: of trials beyond those, a name in `benchmark.SEARCH`.
    """
    with as_file(files("r2h_batch.assets") / "certified" / f"{name}.npz") as path:
        return replace(read_certified(path), search=search)


_beyond: dict[tuple[str, float], Certified] = {}
"""Digest of a benchmark and its `head_clearance_m`, which that leaves out -> what was found of its trials beyond its file, in
this process."""
_one_search = Lock()


def certified_of(
    own: Certified,
    trial_id: Int64[NDArray[np.int64], " n"],
    *,
    head_clearance_m: float,
    search: Search,
) -> Certified:
    """Certificates that hold these trials: those of a benchmark's file, and those that are found now.

    Args:
        own: of the benchmark's file.
        trial_id: (n,) ids.
        head_clearance_m: the benchmark's, which its certificates' digest leaves out and a search heeds.
        search: what certifies trials that are not in the file.
    """
    new = np.unique(trial_id[~own.holds(trial_id)])
    if not len(new):
        return own
    key = own.benchmark, head_clearance_m
    with _one_search:
        found = _beyond.get(key)
        left = new if found is None else new[~found.holds(new)]
        if len(left):
            added = _searched(own, left, head_clearance_m, search)
            found = added if found is None else joined_certified(found, added)
            _beyond[key] = found
    assert found is not None
    return joined_certified(own, found)


def _searched(
    own: Certified, trial_id: NDArray[np.int64], head_clearance_m: float, find: Search
) -> Certified:
    """Certificates of these trials, read from disk or found."""
    made_with = f"{own.benchmark} {head_clearance_m} {own.search} {code_digest(CODE, VERSIONS)}"
    keys = {i: hashlib.sha256(f"{made_with} {i}".encode()).hexdigest() for i in trial_id.tolist()}
    rows: dict[int, dict[str, NDArray[Any]]] = {}

    def search(ids: NDArray[np.int64]) -> None:
        found = find(ids)
        for k, i in enumerate(ids.tolist()):
            rows[i] = {name: getattr(found, name)[k : k + 1] for name in _FORM}

    def row(i: int) -> dict[str, NDArray[Any]]:
        if i not in rows:  # its file was there a moment ago, and is gone or damaged
            search(np.array([i]))
        return rows[i]

    new = np.array([i for i, key in keys.items() if not is_cached(_KIND, key)], np.int64)
    kept: dict[int, Any] = {}
    if len(new):
        with progress("searching trials (kept on disk)", len(new), "trials") as advance:
            for part in np.split(new, range(AT_ONCE, len(new), AT_ONCE)):
                search(part)
                for i in part.tolist():  # at once: a search that is stopped goes on behind it
                    kept[i] = cached(_KIND, keys[i], partial(row, i), _FORM)
                advance(len(part))
    for i, key in keys.items():
        kept[i] = kept.get(i) or cached(_KIND, key, partial(row, i), _FORM)
    columns: dict[str, Any] = {
        name: np.concatenate([kept[i][name] for i in keys]) for name in _FORM
    }
    return Certified(trial_id, **columns, benchmark=own.benchmark)


def read_certified(path: Path) -> Certified:
    """A file that `save_certified` wrote.

    Raises:
        FileError: it is damaged, or something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            own = {k: file[k] for k in (*_ARRAYS, "benchmark")}
        found = Certified(**{**own, "benchmark": str(own["benchmark"])})
        if {len(own[k]) for k in _ARRAYS} != {len(found.trial_id)}:
            raise ValueError("its arrays differ in length")
    except (OSError, AttributeError, EOFError, KeyError, TypeError, ValueError, BadZipFile, zlib.error) as error:  # fmt: skip
        words = f"no readable file of certificates ({' '.join(printable(error).split())[:200]})"
        raise FileError(f"{printable(path)}: {words}; install the package again") from error
    return found


def joined_certified(before: Certified, found: Certified) -> Certified:
    """Trials of both, sorted by their ids; of a trial that is in both, what was `found`.

    Args:
        before: trials of a benchmark.
        found: trials of the same benchmark.
    """
    if before.benchmark != found.benchmark:
        raise ValueError("these are trials of two benchmarks; join those of one")
    kept = ~np.isin(before.trial_id, found.trial_id)
    order = np.argsort(np.concatenate([before.trial_id[kept], found.trial_id]), kind="stable")
    columns = {
        k: np.concatenate([getattr(before, k)[kept], getattr(found, k)])[order] for k in _ARRAYS
    }
    return Certified(**columns, benchmark=before.benchmark, search=before.search)


def save_certified(path: Path, certified: Certified) -> None:
    """Writes a file of certificates."""
    arrays = {k: getattr(certified, k) for k in _ARRAYS}
    np.savez_compressed(path, **arrays, benchmark=np.array(certified.benchmark))
