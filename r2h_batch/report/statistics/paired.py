"""Which method is better, decided on the same trials: McNemar's test and a t test over categories of
objects, Holm's correction of both, t intervals, and a bootstrap over categories and their objects for
ranks."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.base.io.read import printable
from r2h_batch.base.validate import (
    array,
    check_arguments,
    instance_of,
    integer,
    optional,
    sequence_of,
)
from r2h_batch.report.statistics.codes import codes
from r2h_batch.report.statistics.common import Common, common_trials
from r2h_batch.report.statistics.few import FEW
from r2h_batch.report.statistics.intervals import (
    Clustered,
    over_clusters,
    paired_score_interval,
)
from r2h_batch.report.statistics.tally import check_planned
from r2h_batch.runs.store import Run, robot_words
from r2h_batch.verdicts import SPLITS, Outcome

ALPHA = 0.05
DRAWS = 10_000
BOUNDS = ("r2h_batch.methods.random:predict", "r2h_batch.methods.oracle:predict")
_COLUMNS = ("trial_id", "split", "object", "outcome")
PIECE = 65_536
"""Rows of every method that are in memory together."""


@dataclass(frozen=True)
class Paired:
    """M methods on the same trials, counted by split and by object (K objects).

    Attributes:
        names: of the methods.
        trials: (2, K) trials.
        hits: (2, M, K) trials that a method solves.
        only: (2, M, M) trials that method i solves and method j does not.
        notes: what a reader should know about the methods.
        runs: place of each method's run among the runs given.
        bounds: names of methods that are bounds (random, oracle); they have no rank.
        category: name of each object's category (K); empty: each object is one of its own.
        methods: what each method's run calls it.
    """

    names: tuple[str, ...]
    trials: np.ndarray
    hits: np.ndarray
    only: np.ndarray
    notes: tuple[str, ...] = ()
    runs: tuple[int, ...] = ()
    bounds: tuple[str, ...] = ()
    category: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()

    @property
    def clusters(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Names of the C categories, and (K,) the place of each object's."""
        names = self.category or tuple(map(str, range(self.trials.shape[1])))
        known = {name: i for i, name in enumerate(dict.fromkeys(names))}
        return tuple(known), np.array([known[name] for name in names], np.int64)

    @staticmethod
    def of(
        names: Sequence[str],
        split: np.ndarray,
        objects: np.ndarray,
        success: np.ndarray,
        n: np.ndarray | int = 1,
        category: Sequence[str] = (),
    ) -> "Paired":
        """Count G groups of trials that agree in everything here.

        Args:
            names: M methods.
            split: (G,) int, place in `SPLITS`.
            objects: (G,) int, number of the object.
            success: (M, G) bool.
            n: (G,) int, trials of each group.
            category: name of each object's category.
        """
        m, k = len(names), int(objects.max(initial=-1)) + 1
        solved = np.where(success, n, 0)
        trials = np.zeros((len(SPLITS), k), np.int64)
        hits = np.zeros((len(SPLITS), m, k), np.int64)
        only = np.zeros((len(SPLITS), m, m), np.int64)
        np.add.at(trials, (split, objects), n)
        for i in range(m):
            np.add.at(hits[:, i], (split, objects), solved[i])
        for place in range(len(SPLITS)):
            inside = split == place
            only[place] = solved[:, inside] @ ~success[:, inside].T
        return Paired(tuple(names), trials, hits, only, category=tuple(category))


@dataclass(frozen=True)
class Pair:
    """Two methods compared.

    Attributes:
        a: the first method.
        b: the second method.
        difference: of the success rates, in points.
        low: lower end of the difference's 95 % t interval over categories of objects, which speaks
            about the mean of all categories; never narrower than the score interval for more trials
            with these objects. None with one category. It is this pair's own, not corrected for others.
        high: its upper end.
        few_low: lower end of the 95 % prediction interval of the mean of a few new categories, of each
            split.
        few_high: its upper end.
        only_a: trials that only the first solves.
        only_b: trials that only the second solves.
        p: McNemar's exact p value.
        p_holm: the same, adjusted by Holm over the pairs that are compared.
        p_new: p value of the t test over categories, which speaks about new ones, or `p` if that is
            larger: new categories bring new trials. None with one category.
        p_new_holm: the same, adjusted by Holm over the pairs that are compared.
        verdict: what `a` is. "better" or "worse": p_new_holm is below 0.05. "better here" or "worse
            here": only p_holm is, which speaks about these objects. "tied": neither.
    """

    a: str
    b: str
    difference: float
    low: float | None
    high: float | None
    few_low: float | None
    few_high: float | None
    only_a: int
    only_b: int
    p: float
    p_holm: float
    p_new: float | None
    p_new_holm: float | None
    verdict: str

    @property
    def alone(self) -> str:
        """What the verdict would be if this pair alone were compared: Holm's correction has nothing to do then."""
        return _verdict(self.difference, self.p, 1.0 if self.p_new is None else self.p_new)


@dataclass(frozen=True)
class Worst:
    """The worst rank of a method where one category is left out.

    Attributes:
        rank: 1 is best.
        without: the category whose absence gives it; empty where the method has this rank with all.
    """

    rank: int
    without: str


@dataclass(frozen=True)
class Comparison:
    """Pairs of methods on a group of trials.

    Attributes:
        group: S0, S1 or all.
        n: trials.
        names: M methods.
        rates: (M,) success rates in percent.
        pairs: the pairs that are compared, each once.
        ranked: R of the names: without bounds.
        rank: (R, R) probability that method i of `ranked` has rank j + 1 among new categories and
            objects; None with one category.
        worst: the worst rank of each of `ranked` with one category left out; None with one category.
        categories: number of them.
        objects: number of them.
        few: new categories whose mean the prediction intervals speak about.
    """

    group: str
    n: int
    names: tuple[str, ...]
    rates: tuple[float, ...]
    pairs: tuple[Pair, ...]
    ranked: tuple[str, ...]
    rank: np.ndarray | None
    worst: tuple[Worst, ...] | None
    categories: int
    objects: int
    few: int = FEW

    @property
    def new(self) -> str:
        """Intervals, verdicts and ranks speak about these new things: objects, or categories where these have several."""
        return "categories" if self.categories < self.objects else "objects"


@check_arguments(only_a=integer(0), only_b=integer(0))
def mcnemar(only_a: int, only_b: int) -> float:
    """Two-sided exact p value of McNemar's test of equal success rates (McNemar 1947).

    Args:
        only_a: trials that only the first method solves.
        only_b: trials that only the second method solves.
    """
    from scipy import stats  # takes half a second to import

    # Trials on which both methods agree say nothing about which one is better. If the methods are
    # equal, a fair coin splits the n trials on which they differ.
    n = only_a + only_b
    return 1.0 if n == 0 else float(stats.binomtest(only_a, n, 0.5).pvalue)


@check_arguments(p=array("fiu", 1, "p values, from 0 to 1", low=0, high=1))
def holm(p: Sequence[float]) -> np.ndarray:
    """(P,) p values adjusted for P tests (Holm 1979).

    Args:
        p: (P,) p values, from 0 to 1.
    """
    values = np.asarray(p, np.float64)
    order = np.argsort(values)
    # The i-th smallest of P values (i from 0) is compared with alpha / (P - i). The adjusted values
    # must not fall from the smallest on.
    factors = len(values) - np.arange(len(values))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(values[order] * factors), 1.0)
    return adjusted


@check_arguments(
    runs=sequence_of(Run, "what load_run(FOLDER) gives"),
    common=optional(instance_of(Common, "what common_trials(RUNS) gives")),
)
def pair_up(
    runs: Sequence[Run], common: Common | None = None, called: Sequence[str] | None = None
) -> Paired:
    """All methods of the runs, paired on the trial id.

    A method that several runs hold with the same source and the same successes counts once: Holm's
    correction would count each copy as a method of its own.

    Args:
        runs: what `load_run` gives.
        common: what they share, if `common_trials` was called before.
        called: what each run is called where two of its methods have one name; None: as its folder.

    Raises:
        ValueError: if the runs were not asked the same trials, a method is not complete, or fewer
            than two methods are left.
    """
    common = common or common_trials(runs)
    streams = []
    places = [run.folder.absolute().name for run in runs] if called is None else called
    for run, place in zip(runs, places, strict=True):
        if run.unfinished:
            raise ValueError(f"{run.folder}: {run.not_complete(run.unfinished[0])}")
        streams += [_Stream(run, method, common.trials, place) for method in run.methods]
    if len(streams) < 2:
        only = ", ".join(s.method for s in streams) or "none"
        raise ValueError(
            f"one method ({only}) is nothing to compare; give a second run, or baselines"
        )
    paired = _counted(streams)
    once = _once(streams, paired)
    if len(once) < 2:
        folders = ", ".join(str(s.run.folder) for s in streams)
        what = f"{streams[0].method!r} is given {len(streams)} times ({folders})"
        raise ValueError(f"{what}: one method is nothing to compare; give a second one")
    left_out = [s for i, s in enumerate(streams) if i not in once]
    names = _names([streams[i] for i in once])
    if len(set(names)) != len(names):
        twice = max(names, key=names.count)
        raise ValueError(f"two runs of one name hold {twice!r}; rename a folder")
    notes = [f"{s.run.folder}: {s.method} is given twice, and counted once." for s in left_out]
    kept = paired.only[:, once][:, :, once]
    numbers = tuple(next(k for k, run in enumerate(runs) if run is streams[i].run) for i in once)
    bounds = tuple(n for n, i in zip(names, once, strict=True) if streams[i].is_bound)
    hits = paired.hits[:, once]
    own = tuple(streams[i].method for i in once)
    return Paired(
        tuple(names), paired.trials, hits, kept, tuple(notes), numbers, bounds, paired.category, own
    )


def _counted(streams: Sequence["_Stream"]) -> Paired:
    """The successes of all methods, a piece of the same rows at a time."""
    solved = [str(i) for i in range(len(streams))]
    keys = ["split", "object", *solved]
    objects: dict[str, None] = {}
    groups = []
    # every stream says at its end whether it had as many rows as planned
    for pieces in zip(*(s.pieces() for s in streams), strict=True):
        for stream, rows in zip(streams[1:], pieces[1:], strict=True):
            first, other = streams[0].method, stream.method
            if not pieces[0]["trial_id"].equals(rows["trial_id"]):
                words = f"{other!r} has other trial ids than {first!r}"
                raise ValueError(f"{stream.run.folder}: {words}")
            if not pieces[0]["object"].equals(rows["object"]):
                raise ValueError(f"{other} and {first} have other objects in the same trials")
        objects |= dict.fromkeys(pc.unique(pieces[0]["object"]).to_pylist())
        columns = {key: pieces[0][key] for key in ("split", "object")}
        columns |= {i: piece["success"] for i, piece in zip(solved, pieces)}
        group = pa.table(columns).group_by(keys, use_threads=False)
        groups.append(group.aggregate([([], "count_all")]))
    whole = pa.concat_tables(groups).group_by(keys, use_threads=False)
    whole = whole.aggregate([("count_all", "sum")])
    place = {name: i for i, name in enumerate(objects)}
    category = streams[0].run.categories
    return Paired.of(
        [s.method for s in streams],
        np.array([SPLITS.index(split) for split in whole["split"].to_pylist()]),
        np.array([place[name] for name in whole["object"].to_pylist()]),
        np.array([whole[i].to_numpy() for i in solved]),
        whole["count_all_sum"].to_numpy(),
        [category.get(name, name) for name in objects],
    )


def _once(streams: Sequence["_Stream"], paired: Paired) -> list[int]:
    """Places of the methods without copies: a copy has the source and the successes of a method
    before it (the run was copied, or is a part of a longer one)."""
    kept: list[int] = []
    for i, stream in enumerate(streams):
        alike = [j for j in kept if streams[j].source == stream.source]
        if not any(not paired.only[:, [i, j], [j, i]].any() for j in alike):
            kept.append(i)
    return kept


def _names(streams: Sequence["_Stream"]) -> list[str]:
    """Names of the methods. One has its robot's name in front if there are several robots, and its
    run's name if it is there already, or if it equals that of a built-in method."""
    own = {_plain(s.method) for s in streams if s.is_built_in}
    robots = robot_words([s.run for s in streams])
    names: list[str] = []
    for s in streams:
        name = robots[s.run.robot] + s.method
        taken = name in names or (not s.is_built_in and _plain(s.method) in own)
        names.append(f"{printable(s.place)}/{s.method}" if taken else name)
    return names


def _plain(method: str) -> str:
    """A name as tables shorten it: without what stands in brackets."""
    return method.partition(" (")[0].strip().casefold()


class _Stream:
    """A method's rows on the shared trials, in pieces."""

    def __init__(self, run: Run, method: str, trials: Mapping[str, int], place: str) -> None:
        self.run, self.method, self.trials, self.place = run, method, trials, place
        entry, header = run.entry(method), run.header
        function = entry.source.get("function", "")
        self.is_built_in = function.startswith("r2h_batch.methods.")
        self.is_bound = function in BOUNDS
        # a built-in method is the same method in each release; its verdicts tell whether it answers
        # the same. What it reads decides no row, and 0.3 did not say it
        says_nothing = {"reads", "sha256"} if self.is_built_in else {"reads"}
        source = {k: v for k, v in entry.source.items() if k not in says_nothing}
        self.source = (method, source, header["seed"], header.get("predictors"), run.robot)
        """Identity of what answered: two methods with one source give the same rows for the same
        trials."""

    def pieces(self) -> Iterator[pa.Table]:
        """Columns trial_id, split, object and success in tables of `PIECE` rows; the last one may
        be shorter."""
        planned = self.run.planned(self.method)
        shared = np.array([self.trials.get(split, 0) for split in SPLITS])
        found, waiting = np.zeros(len(SPLITS), np.int64), None
        for shard in self.run.shards("trials", self.method, _COLUMNS):
            split = codes(shard, "split", SPLITS)
            found += np.bincount(split, minlength=len(SPLITS))
            columns = {name: shard[name].cast(pa.string()) for name in ("split", "object")}
            columns["success"] = pc.equal(shard["outcome"], Outcome.SUCCESS.name.lower())
            table = pa.table({"trial_id": shard["trial_id"], **columns})
            if planned != self.trials:
                # a plan is the first N trials of each split; their ids count them (schedule.py)
                table = table.filter(table["trial_id"].to_numpy() // len(SPLITS) < shared[split])
            waiting = table if waiting is None else pa.concat_tables([waiting, table])
            while len(waiting) >= PIECE:
                yield waiting[:PIECE]
                waiting = waiting[PIECE:]
        check_planned(self.method, planned, dict(zip(SPLITS, found.tolist())))
        if waiting is not None:
            yield waiting


@check_arguments(
    paired=instance_of(Paired, "what pair_up(RUNS) gives"),
    draws=integer(1, 10**7),
    seed=integer(0),
    few=integer(1),
)
def compare(
    paired: Paired, *, mine: Sequence[str] = (), draws: int = DRAWS, seed: int = 0, few: int = FEW
) -> tuple[Comparison, ...]:
    """Compare pairs of methods on each split, and on all trials if there are two splits.

    Args:
        paired: what `pair_up` gives.
        mine: only pairs with one of these methods, which stands first; empty: all pairs. Fewer
            pairs need a smaller correction.
        draws: of the bootstrap over categories and objects, for the ranks.
        seed: of the bootstrap. No verdict depends on it.
        few: new categories whose mean the prediction intervals speak about.
    """
    groups = [(SPLITS[k], [k]) for k in range(len(SPLITS)) if paired.trials[k].any()]
    if len(groups) > 1:
        groups.append(("all", list(range(len(SPLITS)))))
    own = [paired.names.index(name) for name in mine]
    pairs = list(combinations(range(len(paired.names)), 2))
    if own:
        chosen = [(i, j) for i, j in pairs if i in own or j in own]
        pairs = [(i, j) if i in own else (j, i) for i, j in chosen]
    return tuple(_compare(name, paired, splits, pairs, draws, seed, few) for name, splits in groups)


def _compare(
    group: str,
    paired: Paired,
    splits: list[int],
    pairs: Sequence[tuple[int, int]],
    draws: int,
    seed: int,
    few: int,
) -> Comparison:
    names, n = paired.names, int(paired.trials[splits].sum())
    sampled = _resampled_rates(paired, splits, draws, seed)
    counts = paired.only[splits].sum(0)
    only = [(int(counts[i, j]), int(counts[j, i])) for i, j in pairs]
    p = [mcnemar(*both) for both in only]
    over = [_over_categories(paired, splits, i, j, *both) for (i, j), both in zip(pairs, only)]
    # new categories come with new trials, so their test never finds more than that of these objects
    known = [None if o is None else max(o.p, raw) for o, raw in zip(over, p, strict=True)]
    p_new = [1.0 if value is None else value for value in known]
    lines = []
    for k, ((i, j), adjusted, adjusted_new) in enumerate(
        zip(pairs, holm(p).tolist(), holm(p_new).tolist(), strict=True)
    ):
        difference = 100 * (only[k][0] - only[k][1]) / n
        own = over[k]
        low, high = _ends(own, only[k], n, None)
        few_low, few_high = _ends(own, only[k], n, few)
        lines.append(
            Pair(
                a=names[i], b=names[j], difference=difference,
                low=low, high=high, few_low=few_low, few_high=few_high,
                only_a=only[k][0], only_b=only[k][1],
                p=p[k], p_holm=adjusted, p_new=known[k],
                p_new_holm=None if own is None else adjusted_new,
                verdict=_verdict(difference, adjusted, adjusted_new),
            )
        )  # fmt: skip
    rates = tuple(float(100 * (hits / n)) for hits in paired.hits[splits].sum((0, 2)))
    places = [i for i, name in enumerate(names) if name not in paired.bounds]
    ranked = tuple(names[i] for i in places)
    rank = None if sampled is None else rank_probabilities(sampled[:, places])
    worst = None if sampled is None else _worst(paired, splits, places)
    asked = paired.trials[splits].any(0)
    categories = len(np.unique(paired.clusters[1][asked]))
    return Comparison(
        group, n, names, rates, tuple(lines), ranked, rank, worst, categories, int(asked.sum()), few
    )


def _verdict(difference: float, p: float, p_new: float) -> str:
    """What a method with this difference to another one is."""
    if p >= ALPHA:
        return "tied"
    word = "better" if difference > 0 else "worse"
    return word if p_new < ALPHA else f"{word} here"


def _over_categories(
    paired: Paired, splits: Sequence[int], i: int, j: int, only_i: int, only_j: int
) -> Clustered | None:
    """The difference of two methods' rates over categories, with the splits as strata; None with one category."""
    more = _by_category(paired, paired.hits[:, i] - paired.hits[:, j])
    trials = _by_category(paired, paired.trials)
    n = trials[splits].sum()
    # a trial's difference is 1, -1 or 0
    spread = (only_i + only_j) / n - ((only_i - only_j) / n) ** 2
    return over_clusters([(more[k], trials[k]) for k in splits], float(spread))


def _ends(
    over: Clustered | None, only: tuple[int, int], n: int, few: int | None
) -> tuple[float | None, float | None]:
    """The 95 % interval of the difference in points, for all categories or for the mean of a few new ones."""
    if over is None:
        return None, None
    share = over.shrunk(few)
    least = paired_score_interval(only[0] * share, only[1] * share, n * share)
    low, high = over.ends(few)
    return 100 * min(low, least[0]), 100 * max(high, least[1])


def _by_category(paired: Paired, counts: np.ndarray) -> np.ndarray:
    """Counts (..., K) of objects added up over their categories (..., C)."""
    names, place = paired.clusters
    belongs = place[:, None] == np.arange(len(names))
    return counts @ belongs.astype(counts.dtype)


def _worst(paired: Paired, splits: Sequence[int], places: Sequence[int]) -> tuple[Worst, ...]:
    """The worst rank of each of these methods with one category left out."""
    names, _ = paired.clusters
    n = _by_category(paired, paired.trials)[splits].sum(0)
    x = _by_category(paired, paired.hits)[splits].sum(0)[places]
    with np.errstate(invalid="ignore"):
        rates = (x.sum(1, keepdims=True) - x) / (n.sum() - n)  # (R, C)
    whole = x.sum(1)
    found = []
    for i in range(len(places)):
        rank = 1 + (rates > rates[i]).sum(0)
        own, left_out = 1 + int((whole > whole[i]).sum()), int(rank.argmax())
        more = int(rank[left_out]) > own
        found.append(Worst(int(rank[left_out]) if more else own, names[left_out] if more else ""))
    return tuple(found)


def _resampled_rates(
    paired: Paired, splits: Sequence[int], draws: int, seed: int
) -> np.ndarray | None:
    """(draws, M) success rates of the bootstrap: the categories of each split are drawn again with
    replacement, and the objects of each drawn one. None with one category."""
    hits, totals = np.zeros((draws, len(paired.names))), np.zeros(draws)
    random = np.random.default_rng(seed)
    place = paired.clusters[1]
    for k in splits:
        kept = np.flatnonzero(paired.trials[k])
        members = [kept[place[kept] == c] for c in np.unique(place[kept])]
        if (count := len(members)) < 2:
            return None
        # The clusters are categories, not trials: trials on one object succeed together, and a reader
        # wants to know about new things. Drawing n of them with replacement is one multinomial; a
        # rate is then a sum of hits over a sum of trials.
        weight = random.multinomial(count, np.full(count, 1 / count), size=draws)
        for times, own in zip(weight.T, members, strict=True):
            each = times[:, None]
            if len(own) > 1:  # every drawn copy of the category draws its objects again
                each = random.multinomial(times * len(own), np.full(len(own), 1 / len(own)))
            hits += each @ paired.hits[k][:, own].T
            totals += each @ paired.trials[k][own]
    return hits / totals[:, None]


@check_arguments(rates=array("fiu", 2, "rates (D, M): draws by methods"))
def rank_probabilities(rates: np.ndarray) -> np.ndarray:
    """How often each method has each rank.

    Args:
        rates: (D, M) success rates of D draws.

    Returns:
        (M, M) share of draws in which method i has rank j + 1. Ties share their ranks evenly.
    """
    m = rates.shape[1]
    probability = np.zeros((m, m))
    # (D, M): how many methods are better in a draw, and how many are equal, itself included
    above = (rates[:, None, :] > rates[:, :, None]).sum(2)
    equal = (rates[:, None, :] == rates[:, :, None]).sum(2)
    for i in range(m):
        for size in np.unique(equal[:, i]):
            start = np.bincount(above[equal[:, i] == size, i], minlength=m)
            for first, count in enumerate(start):
                probability[i, first : first + size] += count / size
    return probability / len(rates)
