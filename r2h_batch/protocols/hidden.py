"""Held-out trials of a benchmark: their seed is committed by a hash first, and told afterwards.

`r2h-batch benchmark hide` draws a seed of 128 bits and writes two files. The commitment is for everybody; it holds a sha256
over seed, benchmark and number of trials. The other one is the benchmark with that seed, and stays secret until it is told.
Whoever has it draws the trials, and whoever has the commitment can tell that the seed was not chosen later.
"""

import hashlib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable, read_json
from r2h_batch.base.validate import rule_of
from r2h_batch.protocols.benchmark import MOST_TRIALS, Benchmark

MOST_BYTES = 1 << 16
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Commitment(BaseModel):
    """The promise that is published before the trials are told.

    Attributes:
        format: of this file.
        benchmark: digest of the benchmark with its published trials.
        trials: of each split.
        sha256: over the seed and the two.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    format: Literal[1] = 1
    benchmark: Hash
    trials: Annotated[int, Field(ge=1, le=MOST_TRIALS)]
    sha256: Hash


def commitment_of(benchmark: Benchmark, trials: int) -> Commitment:
    """The commitment to the trials of a benchmark with a seed.

    Args:
        benchmark: with a seed.
        trials: of each split.

    Raises:
        ValueError: it has no seed.
    """
    if not benchmark.seed:
        raise ValueError(
            f"{benchmark.name} has no seed; r2h-batch benchmark hide writes a benchmark with one"
        )
    published = benchmark.with_seed("").digest
    text = f"r2h_batch hidden trials\n{benchmark.seed}\n{published}\n{trials}\n"
    return Commitment(
        benchmark=published, trials=trials, sha256=hashlib.sha256(text.encode()).hexdigest()
    )


def read_commitment(path: Path) -> Commitment:
    """Reads a commitment; `FileError`, one line, for anything else."""
    data = read_json(path, most=MOST_BYTES)
    try:
        return Commitment.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(p) for p in first["loc"])
        what = f"{where}: {rule_of(first)}" if where else "is no mapping"
        raise FileError(
            f"{printable(path)}: {printable(what)[:200]}; r2h-batch benchmark hide writes such a file"
        ) from None


def check_told(path: Path, benchmark: Benchmark) -> Commitment:
    """The commitment, if a benchmark is the one that it was made for.

    Args:
        path: the commitment's file.
        benchmark: with the seed that was told.

    Raises:
        FileError: the benchmark has no seed, another one, or other objects, people or limits.
    """
    said = read_commitment(path)
    if not benchmark.seed:
        raise FileError(
            f"{printable(path)}: --benchmark {printable(benchmark.name)} has no seed; give the file that was told"
        )
    found = commitment_of(benchmark, said.trials)
    if found.benchmark != said.benchmark:
        raise FileError(
            f"{printable(path)}: is of benchmark {said.benchmark[:12]}, {printable(benchmark.name)} is {found.benchmark[:12]}"
            " without its seed; give the file that was told"
        )
    if found.sha256 != said.sha256:
        raise FileError(
            f"{printable(path)}: the seed of {printable(benchmark.name)} is not the committed one (sha256"
            f" {found.sha256[:12]}, committed {said.sha256[:12]}); nobody should trust these trials"
        )
    return said
