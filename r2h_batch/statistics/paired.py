"""Which method is better, decided on the same trials: McNemar, Holm, intervals and ranks over
objects drawn again."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from r2h_batch.runs.store import Run
from r2h_batch.statistics.common import Common, common_trials
from r2h_batch.statistics.tally import Verdicts, verdicts
from r2h_batch.validate import array, check_arguments, instance_of, integer, optional, sequence_of
from r2h_batch.verdicts import SPLITS, Outcome

ALPHA = 0.05
DRAWS = 10_000
PIECE = 65_536
"""Trials of all methods that are looked at together."""


class Paired:
    """Several methods on the same trials, counted: how many of each split and object, and who
    solved them.

    `trials` (2, K) by split and object; `hits` (2, M, K) those that a method solves; `only` (2, M,
    M) those that method i solves and j does not.
    """

    def __init__(self, names: Sequence[str]) -> None:
        m = len(names)
        self.names = tuple(names)
        self.trials = np.zeros((len(SPLITS), 0), np.int64)
        self.hits = np.zeros((len(SPLITS), m, 0), np.int64)
        self.only = np.zeros((len(SPLITS), m, m), np.int64)
        self.notes: tuple[str, ...] = ()
        """what a reader should know about the methods"""

    def only_of(
        self, methods: Sequence[int], names: Sequence[str], notes: Sequence[str]
    ) -> "Paired":
        """The same counts of some of the methods, under these names."""
        kept = Paired(names)
        kept.trials, kept.notes = self.trials, tuple(notes)
        kept.hits, kept.only = self.hits[:, methods], self.only[:, methods][:, :, methods]
        return kept

    def add(self, success: np.ndarray, split: np.ndarray, objects: np.ndarray) -> None:
        """Count more trials: success (M, B), split and object codes (B,)."""
        if (more := int(objects.max(initial=-1)) + 1 - self.trials.shape[1]) > 0:
            self.trials = np.pad(self.trials, ((0, 0), (0, more)))
            self.hits = np.pad(self.hits, ((0, 0), (0, 0), (0, more)))
        k = self.trials.shape[1]
        for place in np.unique(split).tolist():
            inside = split == place
            solved, code = success[:, inside], objects[inside]
            self.trials[place] += np.bincount(code, minlength=k)
            for row, mine in zip(self.hits[place], solved, strict=True):
                row += np.bincount(code[mine], minlength=k)
            self.only[place] += [
                [int((mine & ~other).sum()) for other in solved] for mine in solved
            ]


@dataclass(frozen=True)
class Pair:
    """Two methods: SR difference in points with its clustered interval (None: one object), exact
    McNemar, Holm.

    `verdict`: "better" or "worse" (of `a`) where Holm's p is below 0.05 and the interval, which
    speaks about new objects, leaves out 0; "better here", "worse here" where only the first holds
    (these objects); "tied" where it does not.
    """

    a: str
    b: str
    difference: float
    low: float | None
    high: float | None
    only_a: int
    only_b: int
    p: float
    p_holm: float
    verdict: str


@dataclass(frozen=True)
class Comparison:
    """All pairs of a group of trials, and (M, M) probability that method i has rank j + 1 among new
    objects."""

    group: str
    n: int
    names: tuple[str, ...]
    rates: tuple[float, ...]
    pairs: tuple[Pair, ...]
    rank: np.ndarray | None


@check_arguments(only_a=integer(0), only_b=integer(0))
def mcnemar(only_a: int, only_b: int) -> float:
    """Two-sided exact p value of McNemar's test: are the trials that only one of two methods solves
    split evenly?"""
    from scipy import stats  # half a second: only where a test is asked for

    # Trials on which both agree say nothing about which is better: given n that differ, a fair coin
    # splits them (McNemar 1947), and its exact tail needs no large n
    n = only_a + only_b
    return 1.0 if n == 0 else float(stats.binomtest(only_a, n, 0.5).pvalue)


@check_arguments(p=array("fiu", 1, "p values, from 0 to 1", low=0, high=1))
def holm(p: Sequence[float]) -> np.ndarray:
    """p values adjusted for looking at all of them (Holm 1979)."""
    values = np.asarray(p, np.float64)
    order = np.argsort(values)
    # The i-th smallest of m is compared with alpha / (m - i); as adjusted values, made monotone
    # from the smallest on
    factors = len(values) - np.arange(len(values))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(values[order] * factors), 1.0)
    return adjusted


@check_arguments(
    runs=sequence_of(Run, "what load_run(FOLDER) gives"),
    common=optional(instance_of(Common, "what common_trials(RUNS) gives")),
)
def pair_up(runs: Sequence[Run], common: Common | None = None) -> Paired:
    """All methods of the runs, paired on the trial id; an error where runs were not asked the same.

    `common`: what they share, where it was looked for already.
    """
    common = common or common_trials(runs)
    streams = []
    for run in runs:
        if run.unfinished:
            raise ValueError(
                f"{run.folder}: {run.unfinished[0]!r} is not complete; run its sweep again to go on"
            )
        streams += [_Stream(run, method, common.trials) for method in run.methods]
    if len(streams) < 2:
        only = ", ".join(s.method for s in streams) or "none"
        raise ValueError(f"one method ({only}) is nothing to compare; give a second run")
    paired = Paired([s.method for s in streams])
    for pieces in _together([s.rows for s in streams]):
        _check_same_trials(streams, pieces)
        success = np.stack([p.outcome == Outcome.SUCCESS for p in pieces])
        paired.add(success, pieces[0].split, pieces[0].object)
    once = _once(streams, paired)
    if len(once) < 2:
        raise ValueError(
            f"{streams[0].method!r} is given {len(streams)} times ({', '.join(str(s.run.folder) for s in streams)}): "
            "one method is nothing to compare; give a second one"
        )
    left_out = [s for i, s in enumerate(streams) if i not in once]
    names = _names([streams[i] for i in once])
    if len(set(names)) != len(names):
        raise ValueError(
            f"two runs of one name hold {next(n for n in names if names.count(n) > 1)!r}; rename a folder"
        )
    return paired.only_of(
        once,
        names,
        [f"{s.run.folder}: {s.method} is given twice, and counted once." for s in left_out],
    )


def _once(streams: Sequence["_Stream"], paired: Paired) -> list[int]:
    """Which methods are not one before them again: the same answers from the same source, in
    another copy of the run or a longer one. Holm's correction would count each as a method of its
    own."""
    kept: list[int] = []
    for i, stream in enumerate(streams):
        again = (
            j
            for j in kept
            if streams[j].source == stream.source and not paired.only[:, [i, j], [j, i]].any()
        )
        if next(again, None) is None:
            kept.append(i)
    return kept


def _names(streams: Sequence["_Stream"]) -> list[str]:
    """What the methods are called: with their run where a name is there already, or is that of a
    method of the package."""
    own = {_plain(s.method) for s in streams if s.is_built_in}
    names: list[str] = []
    for s in streams:
        taken = s.method in names or (not s.is_built_in and _plain(s.method) in own)
        names.append(f"{s.run.folder.absolute().name}/{s.method}" if taken else s.method)
    return names


def _plain(method: str) -> str:
    """A name as tables shorten it: without what stands in brackets."""
    return method.partition(" (")[0].strip().casefold()


class _Stream:
    """A method's verdicts shard by shard, and the names of the objects met so far."""

    def __init__(self, run: Run, method: str, trials: Mapping[str, int]) -> None:
        self.run, self.method = run, method
        entry, header = run.entry(method), run.header
        self.source = (method, entry["source"], header["seed"], header.get("predictors"))
        """What answered: two with one source give the same rows for the same trials."""
        self.is_built_in = str(entry["source"].get("function", "")).startswith("r2h_batch.methods.")
        self.objects: list[str] = []
        rows = verdicts(run, method, self.objects)
        self.rows = rows if run.header["trials"] == trials else _first(rows, trials)


def _first(rows: Iterator[Verdicts], trials: Mapping[str, int]) -> Iterator[Verdicts]:
    """The first so many trials of each split: their ids count them (r2h_batch.schedule)."""
    planned = np.array([trials.get(s, 0) for s in SPLITS])
    for piece in rows:
        kept = piece.trial_id // len(SPLITS) < planned[piece.split]
        if kept.any():
            yield piece.where(kept)


def _together(streams: Sequence[Iterator[Verdicts]]) -> Iterator[list[Verdicts]]:
    """The same rows of every stream at a time; their shards may end in different places."""
    left: list[Verdicts | None] = [None] * len(streams)
    while True:
        left = [
            rows if rows is not None and len(rows) else next(s, None)
            for rows, s in zip(left, streams)
        ]
        pieces = [rows for rows in left if rows is not None]
        if len(pieces) < len(
            streams
        ):  # every stream says at its end whether it had as many rows as planned
            for stream in streams:
                deque(stream, maxlen=0)
            return
        n = min(PIECE, *map(len, pieces))
        yield [rows.rows(0, n) for rows in pieces]
        left = [rows.rows(n) for rows in pieces]


def _check_same_trials(streams: Sequence[_Stream], pieces: Sequence[Verdicts]) -> None:
    first = pieces[0]
    places = {name: i for i, name in enumerate(streams[0].objects)}
    for stream, rows in zip(streams[1:], pieces[1:], strict=True):
        if not np.array_equal(first.trial_id, rows.trial_id):
            raise ValueError(
                f"{stream.run.folder}: {stream.method!r} has other trial ids than {streams[0].method!r}"
            )
        codes = np.array([places.get(o, -1) for o in stream.objects])
        if not np.array_equal(codes[rows.object], first.object):
            raise ValueError(
                f"{stream.method} and {streams[0].method} have other objects in the same trials"
            )


@check_arguments(
    paired=instance_of(Paired, "what pair_up(RUNS) gives"), draws=integer(1, 10**7), seed=integer(0)
)
def compare(paired: Paired, *, draws: int = DRAWS, seed: int = 0) -> tuple[Comparison, ...]:
    """One comparison for each split, and one for all trials where there are two splits."""
    groups = [(SPLITS[k], [k]) for k in range(len(SPLITS)) if paired.trials[k].any()]
    if len(groups) > 1:
        groups.append(("all", list(range(len(SPLITS)))))
    return tuple(_compare(name, paired, splits, draws, seed) for name, splits in groups)


def _compare(group: str, paired: Paired, splits: list[int], draws: int, seed: int) -> Comparison:
    names, n = paired.names, int(paired.trials[splits].sum())
    sampled = _resampled_rates(paired, splits, draws, seed)
    pairs = list(combinations(range(len(names)), 2))
    counts = paired.only[splits].sum(0)
    only = [(int(counts[i, j]), int(counts[j, i])) for i, j in pairs]
    p = [mcnemar(*both) for both in only]
    lines = []
    for (i, j), (only_i, only_j), raw, adjusted in zip(pairs, only, p, holm(p)):
        difference = 100 * (only_i - only_j) / n
        ends = (
            None
            if sampled is None
            else np.quantile(100 * (sampled[:, i] - sampled[:, j]), [0.025, 0.975])
        )
        low, high = (None, None) if ends is None else (float(ends[0]), float(ends[1]))
        word = "better" if difference > 0 else "worse"
        if adjusted >= ALPHA:
            word = "tied"
        elif low is None or high is None or low <= 0 <= high:
            word += " here"
        pair = Pair(
            names[i], names[j], difference, low, high, only_i, only_j, raw, float(adjusted), word
        )
        lines.append(pair)
    rates = tuple(float(100 * (hits / n)) for hits in paired.hits[splits].sum((0, 2)))
    rank = None if sampled is None else rank_probabilities(sampled)
    return Comparison(group, n, names, rates, tuple(lines), rank)


def _resampled_rates(
    paired: Paired, splits: Sequence[int], draws: int, seed: int
) -> np.ndarray | None:
    """(draws, M) success rates when the objects of each split are drawn again with replacement;
    None for one object."""
    hits, totals = np.zeros((draws, len(paired.names))), np.zeros(draws)
    random = np.random.default_rng(seed)
    for k in splits:
        kept = paired.trials[k] > 0
        n, x = paired.trials[k][kept], paired.hits[k][:, kept].astype(np.float64)
        if kept.sum() < 2:
            return None
        # The bootstrap's clusters are objects, not trials: trials on one object succeed together,
        # and a reader asks about new objects. Drawing n objects with replacement is one
        # multinomial; rates then are sums of hits over sums of trials.
        weight = random.multinomial(kept.sum(), np.full(kept.sum(), 1 / kept.sum()), size=draws)
        hits += weight @ x.T
        totals += weight @ n
    return hits / totals[:, None]


@check_arguments(rates=array("fiu", 2, "rates (D, M): draws by methods"))
def rank_probabilities(rates: np.ndarray) -> np.ndarray:
    """(M, M) probability that method i has rank j + 1 over draws (D, M) of rates; ties share their
    ranks evenly."""
    m = rates.shape[1]
    probability = np.zeros((m, m))
    # (D, M): how many methods are better in a draw, and how many are as good, itself included
    above = (rates[:, None, :] > rates[:, :, None]).sum(2)
    equal = (rates[:, None, :] == rates[:, :, None]).sum(2)
    for i in range(m):
        for size in np.unique(equal[:, i]):
            start = np.bincount(above[equal[:, i] == size, i], minlength=m)
            for first, count in enumerate(start):
                probability[i, first : first + size] += count / size
    return probability / len(rates)
