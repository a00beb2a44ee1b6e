"""Judges a stranger's submission in a process of its own, with limits of time and memory.

Whatever a submission holds, it can end only its own process: the leaderboard goes on without it.
`python -m r2h_batch.sweep.submission_judge` is the child.
"""

import json
import shutil
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.child import answer_parent, read_in_child
from r2h_batch.base.io.read import archive_members, open_archive, printable
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.protocols.hidden import Commitment
from r2h_batch.report.board import Judged, Standing, section_of_draft, standing_of
from r2h_batch.report.compare.shipped_answers import answers_of_shipped
from r2h_batch.report.compare.stored import (
    baselines_for,
    has_baselines,
    load_baselines,
    stored_rows,
)
from r2h_batch.report.statistics.common import Common, common_trials
from r2h_batch.runs.store import Run, load_run
from r2h_batch.verdicts import SPLITS

MAX_BYTES, MAX_MEMBERS = 4 << 30, 100_000
MEMORY_BYTES = 16 << 30
"""Address space of the process. Judging takes 4 GB of it, and 1 GB of memory."""

BUNDLE = "submission.json"
"""Digest of each method's rows, the versions that scored them, and which methods are built in."""

_MODULE = "r2h_batch.sweep.submission_judge"


@dataclass(frozen=True)
class Hidden:
    """Held-out trials that have been told.

    Attributes:
        promise: what was published before.
        digest: of the benchmark that was told.
        seed: that was told.
    """

    promise: Commitment
    digest: str
    seed: str

    @property
    def setting(self) -> dict[str, str]:
        """Name and text of the trials on the page."""
        held_out = f"{self.promise.trials} a split, sha256 {self.promise.sha256}, seed {self.seed}"
        return {"held-out trials": held_out}


@dataclass(frozen=True)
class Verdict:
    """A submission that passed.

    Attributes:
        baselines: the run folder that it was compared with; None: a draft, of which none is stored.
        standings: a line for each of its methods.
        setting: of a draft, what all lines of its section share.
    """

    baselines: Path | None
    standings: tuple[Standing, ...]
    setting: dict[str, str] = field(default_factory=dict)


def judge_alone(
    path: Path,
    name: str,
    *,
    rows: int,
    seconds: int,
    benchmark: BenchmarkChoice,
    baselines: str,
    hidden: Hidden | None = None,
) -> Verdict:
    """Unpack, verify and judge a submission, and compare it with the baselines.

    Args:
        path: a file of `submit`, or a run folder.
        name: what the leaderboard calls it.
        rows: rows of each method that are judged again.
        seconds: CPU time that the process may take.
        benchmark: the flags that its sweep had.
        baselines: run folder with the baselines; empty: the shipped ones of its protocol and preset.
        hidden: the trials that it must be on; None: those of its header.

    Raises:
        FileError: what is wrong with it, in one line without its name.
    """
    asked = {
        "path": str(path),
        "name": name,
        "rows": rows,
        "benchmark": asdict(benchmark),
        "baselines": baselines,
        "hidden": hidden and {"digest": hidden.digest, "trials": hidden.promise.trials},
    }
    with tempfile.TemporaryDirectory() as place, tempfile.TemporaryFile() as words:
        words.write(json.dumps({**asked, "place": place}).encode())
        words.seek(0)
        (answer,) = read_in_child(
            _MODULE,
            words,
            {"memory": MEMORY_BYTES},
            count=1,
            seconds=seconds,
            doing=f"judging {printable(path)}",
        )
    return TypeAdapter(Verdict).validate_json(str(answer))


def unpack(path: Path, folder: Path) -> Path:
    """The run folder of a submission; a file is unpacked into `folder`.

    Raises:
        FileError: it is no file of `submit`.
    """
    if path.is_dir():
        return path
    with open_archive(path, MAX_BYTES) as archive:
        members = archive_members(archive, path, count=MAX_MEMBERS, size=MAX_BYTES)
        for member in members:
            parts = PurePosixPath(member.filename).parts
            if member.filename == BUNDLE:
                continue
            if parts[:1] != ("run",) or member.is_dir():
                what = f"member {printable(member.filename)[:80]!r}"
                raise FileError(f"{printable(path)}: {what}; r2h-batch submit writes run/...")
            target = folder.joinpath(*parts[1:])
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(member) as source, target.open("wb") as file:
                shutil.copyfileobj(source, file)
    return folder


def judged_again(run: Run, rows: int, benchmark: BenchmarkChoice) -> dict[str, Judged]:
    """How a sample of each method's rows was judged again; ValueError where a row is not what the
    evaluator says."""
    from r2h_batch.sweep.results.reevaluation import Judge, check_poses, reevaluate

    if run.unfinished or not run.methods:
        raise ValueError(f"{(run.unfinished or ('no method',))[0]} is not complete")
    check_poses(run)
    judge = Judge(run, given=benchmark)
    judged = {}
    for method in run.methods:
        found = reevaluate(run, method, rows, judge)
        if found.differences:
            raise ValueError(f"{method}: {found.differences[0]}")
        judged[method] = Judged(found.stored, found.scored, found.equal, found.built_in)
    return judged


def _child(data: bytes, _: Mapping[str, Any]) -> list[Any]:
    asked = json.loads(data)
    given = Path(asked["path"])
    folder = given if given.is_dir() else Path(asked["place"]) / "run"
    try:
        verdict = _verdict(asked, unpack(given, folder))
    except ValueError as error:  # what the package says about files and rows, with their folder
        words = str(error)
        for where in (folder, given):
            words = words.removeprefix(f"{printable(where)}: ").replace(f"{where}/", "")
        raise FileError(words) from None
    return [np.array(TypeAdapter(Verdict).dump_json(verdict).decode(), np.str_)]


def _verdict(asked: Mapping[str, Any], folder: Path) -> Verdict:
    run = load_run(folder, verify=False)
    if (hidden := asked["hidden"]) is not None:
        _check_hidden(run, hidden["digest"], hidden["trials"])
    place: Path | None = None
    baselines, setting = replace(run, entries=()), {}
    if asked["baselines"] or has_baselines(run.header):
        place = Path(asked["baselines"]) if asked["baselines"] else baselines_for(run.header)
        baselines = load_baselines(place, verify=False)
    else:
        setting = section_of_draft(run)
    common = _common(run, baselines)  # first: then its configuration is that of the baselines
    run.verify(whole=True)
    flags: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in asked["benchmark"].items()
    }
    judged = judged_again(run, asked["rows"], BenchmarkChoice(**flags))
    standings = [
        standing_of(
            run,
            method,
            asked["name"],
            judged[method],
            baselines,
            common,
            answers_of_shipped(run, method, baselines),
        )
        for method in run.methods
    ]
    return Verdict(place, tuple(standings), setting)


def _check_hidden(run: Run, digest: str, trials: int) -> None:
    """`FileError` unless a run is on all held-out trials. Its claim is checked when its rows are judged again."""
    if run.header["digests"].get("benchmark") != digest:
        raise FileError(
            "its trials are not the held-out ones; sweep with --benchmark FILE that was told"
        )
    if short := [s for s in SPLITS if run.header["trials"].get(s, 0) < trials]:
        held = run.header["trials"].get(short[0], 0)
        raise FileError(
            f"it has {held} trials of {short[0]}, held out are {trials}; sweep --trials {trials}"
        )


def _common(run: Run, baselines: Run) -> Common:
    try:
        return common_trials([run, baselines], proven=stored_rows())
    except ValueError as error:
        what = str(error).rpartition(" differ in ")[2].partition(":")[0]
        words = f"differs from the baselines in {what}"
        raise FileError(f"{words}; give a run with its own baselines to --baselines") from None


if __name__ == "__main__":
    sys.exit(answer_parent(_child))
