"""The turn test: the same trials with objects whose frame is turned, paired with the trials as their meshes lie. A method
whose answers depend on how a mesh lies in its file moves; another one does not."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from r2h_batch.base.registry import TURNS
from r2h_batch.base.table import NA
from r2h_batch.report.statistics.cochran import stratified_cochran
from r2h_batch.report.statistics.paired import ALPHA, Pair, Paired, compare, holm
from r2h_batch.runs.files import RunError
from r2h_batch.runs.store import Run, load_run
from r2h_batch.verdicts import SPLITS, Outcome

BESIDE = "-turned"
"""A folder of the run's name with this end, beside the run, holds the runs with turned objects, each called
after its turn."""
MARK = "^"
"""Stands in every table of the run behind a method whose successes depend on the frame, by a test."""

AS_IT_LIES = "as it lies"
WORDS = {"half": "half turn", "cycled": "cycled axes"}


@dataclass(frozen=True)
class Move:
    """How a turn moves a method's success rate.

    Attributes:
        turn: a word of `TURNS`, or degrees about x, y and z, as `20,40,60`.
        points: rate with turned objects less the rate as they lie.
        low: lower end of the 95 % interval over categories of objects; None with one category.
        high: its upper end.
        p_holm: McNemar's exact p value, adjusted by Holm over the turns.
    """

    turn: str
    points: float
    low: float | None
    high: float | None
    p_holm: float

    @property
    def ends(self) -> str:
        """The interval in words."""
        known = self.low is not None and self.high is not None
        return f"{self.low:+.1f} to {self.high:+.1f}" if known else NA


@dataclass(frozen=True)
class Turned:
    """A method's turn test on a split, or on all trials.

    Attributes:
        method: its name in the run.
        group: S0, S1 or all.
        n: trials in each frame.
        rate: success rate in percent as the meshes lie.
        moves: one for each turn.
        p_frames: p value of Cochran's Q: success does not depend on the frame, by category (`stratified_cochran`) and of
            all trials; twice the smaller one of both (Bonferroni).
        p_frames_holm: the same, adjusted by Holm over the methods of the group.
    """

    method: str
    group: str
    n: int
    rate: float
    moves: tuple[Move, ...]
    p_frames: float
    p_frames_holm: float

    @property
    def most(self) -> Move:
        """The turn that moves the rate farthest."""
        return max(self.moves, key=lambda move: abs(move.points))

    @property
    def marked(self) -> bool:
        """Whether success depends on the frame, by the corrected test over all turns."""
        return self.p_frames_holm < ALPHA

    @property
    def sentence(self) -> str:
        """The mark of a table in words."""
        most, rates = self.most, [self.rate, *(self.rate + move.points for move in self.moves)]
        return (
            f"{MARK} {self.method}, {self.group}: success depends on the objects' frames (Cochran's Q, Holm p"
            f" {self.p_frames_holm:.2g}): SR {min(rates):.1f} to {max(rates):.1f} in {len(rates)} frames, {self.n} trials in"
            f" each; {words_for(most.turn)}: {most.points:+.1f} points (95 % {most.ends})."
        )


def turned(run: Run) -> tuple[Turned, ...]:
    """The turn tests of a run's methods: of those that every sweep with `--turn` beside the run holds too.

    Args:
        run: what `load_run` or `join` gives.

    Raises:
        RunError: a folder of turned objects does not belong to the run.
    """
    found: list[Turned] = []
    for own in run.runs:
        runs = _runs(own)
        if not runs:
            continue
        for entry in run.entries:
            if entry.folder != own.folder or not entry.complete:
                continue
            stored = next(e.name for e in own.entries if e.slug == entry.slug)
            asked = {turn: other for turn, other in runs.items() if stored in other.methods}
            if asked.keys() >= {*TURNS}:
                found += _of_method(own, asked, stored, entry.name)
    return _corrected(found)


def _corrected(tests: Sequence[Turned]) -> tuple[Turned, ...]:
    """The tests with p values adjusted over the methods of each group."""
    found = list(tests)
    for group in {test.group for test in tests}:
        own = [i for i, test in enumerate(tests) if test.group == group]
        for i, p in zip(own, holm([tests[i].p_frames for i in own]).tolist(), strict=True):
            found[i] = replace(tests[i], p_frames_holm=p)
    return tuple(found)


def _runs(run: Run) -> dict[str, Run]:
    """Turn -> its run, further turns last; empty where one of `TURNS` is missing."""
    place = folder_of(run.folder, "")
    more = sorted(p.name for p in place.glob("*,*,*")) if place.is_dir() else []
    folders = {turn: folder_of(run.folder, turn) for turn in (*TURNS, *more)}
    folders = {turn: folder for turn, folder in folders.items() if (folder / "run.json").is_file()}
    if not folders.keys() >= {*TURNS}:
        return {}
    runs = {turn: load_run(folder) for turn, folder in folders.items()}
    for turn, other in runs.items():
        _check(run, turn, other)
    return runs


def _check(run: Run, turn: str, other: Run) -> None:
    """`RunError` unless the other run asked the same trials of turned objects and judged them the same."""
    a, b = run.header, other.header
    differs = [k for k in ("protocol", "configuration", "seed") if a[k] != b[k]]
    kept = ("hand_set", "robot")
    differs += [k for k in kept if a["digests"].get(k) != b["digests"].get(k)]
    flags = (b.get("benchmark") or {}).get("flags", ())
    if differs or f"--turn {turn}" not in flags:
        what = ", ".join(differs) or "the turn"
        raise RunError(
            f"{other.folder}: is no turn test of {run.folder}: it differs in {what}; remove it and make the test again"
        )


def _of_method(run: Run, runs: Mapping[str, Run], method: str, shown: str) -> list[Turned]:
    columns = [_solved(one, method) for one in (run, *runs.values())]
    ids = reduce(
        np.intersect1d, [column[0] for column in columns]
    )  # each has the first ones of the run
    if not len(ids):
        raise RunError(f"{run.folder}{BESIDE}: {method!r} has other trials; make the test again")
    rows = [np.searchsorted(other[0], ids) for other in columns]
    success = np.stack([c[3][row] for c, row in zip(columns, rows, strict=True)])
    split, names = columns[0][1][rows[0]], columns[0][2][rows[0]]
    objects, place = np.unique(names, return_inverse=True)
    category = [run.categories.get(str(name), str(name)) for name in objects]
    paired = Paired.of((AS_IT_LIES, *runs), split, place, success, category=category)
    stratum = paired.clusters[1][place]
    inside = {name: split == k for k, name in enumerate(SPLITS)}
    found = []
    for c in compare(paired, mine=[AS_IT_LIES], draws=1):
        own = inside.get(c.group, np.ones(len(split), bool))
        # by category moves of opposite sign do not cancel; of all trials together a few trials of each say more
        kinds = (stratum[own], np.zeros_like(stratum[own]))
        p = min(1.0, 2 * min(stratified_cochran(success[:, own], kind).p for kind in kinds))
        moves = (_move(pair) for pair in c.pairs)
        found.append(Turned(shown, c.group, c.n, c.rates[0], tuple(moves), p, p))
    return found


def _move(pair: Pair) -> Move:
    """The move by a turn, of its frame's comparison with the objects as they lie."""
    low, high = (None if end is None else 0.0 - end for end in (pair.high, pair.low))
    return Move(pair.b, 0.0 - pair.difference, low, high, pair.p_holm)  # never -0.0


def _solved(run: Run, method: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Trial ids, ascending, with place of the split, object and success of each."""
    table = run.trials(method, ["trial_id", "split", "object", "outcome"]).sort_by("trial_id")
    split = np.array([SPLITS.index(s) for s in table["split"].to_pylist()], np.int64)
    success = np.array(table["outcome"].to_pylist()) == Outcome.SUCCESS.name.lower()
    return table["trial_id"].to_numpy(), split, np.array(table["object"].to_pylist()), success


def words_for(turn: str) -> str:
    """A turn as tables name it."""
    return WORDS.get(turn, f"turn of {turn} degrees")


def about(tests: Sequence[Turned]) -> list[dict[str, Any]]:
    """The tests as records of a JSON, with the mark and the turn that moves the rate farthest."""
    return [asdict(test) | {"marked": test.marked, "most": test.most.turn} for test in tests]


def folder_of(run: Path, turn: str) -> Path:
    """The run folder of a run's trials with turned objects."""
    whole = run.absolute()
    return whole.with_name(whole.name + BESIDE) / turn
