"""Trials that are known to have a whole way: how often each was drawn again until a search found one, and its answer.

`assets/certified/build_certified.py` makes the files. A certificate holds for the benchmark whose digest it names: with other
objects, people, robot, table or seed the trials are drawn once, and nothing is certified.
"""

import hashlib
import zlib
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import as_file, files
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable

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
    """

    trial_id: Int64[NDArray[np.int64], " N"]
    redraws: Int64[NDArray[np.int64], " N"]
    solved: Bool[NDArray[np.bool_], " N"]
    T_obj_ee: Float32[NDArray[np.float32], "N 4 4"]
    T_world_ee: Float32[NDArray[np.float32], "N 4 4"]
    benchmark: str

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

    def answers(self, trial_id: Int64[NDArray[np.int64], " n"]) -> Answers:
        """The answers of these trials (n,)."""
        at, _ = self._at(trial_id)
        return Answers(self.knows(trial_id), self.T_obj_ee[at], self.T_world_ee[at])

    def _at(self, trial_id: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Rows of these trials, and whether they are here."""
        at = np.minimum(np.searchsorted(self.trial_id, trial_id), len(self.trial_id) - 1)
        return at, self.trial_id[at] == trial_id


def load_certified(name: str) -> Certified:
    """The certificates that the package ships for a benchmark.

    Args:
        name: of the benchmark.
    """
    with as_file(files("r2h_batch.assets") / "certified" / f"{name}.npz") as path:
        return read_certified(path)


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
    return Certified(**columns, benchmark=before.benchmark)


def save_certified(path: Path, certified: Certified) -> None:
    """Writes a file of certificates."""
    arrays = {k: getattr(certified, k) for k in _ARRAYS}
    np.savez_compressed(path, **arrays, benchmark=np.array(certified.benchmark))
