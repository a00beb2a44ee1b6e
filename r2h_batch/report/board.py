"""A leaderboard: what is known of each method, and the page that ranks methods.

The page shows what the judge computed or checked. What the submitter alone knows (the times of
planning and of the method) is shown as claimed.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.report.compare.text import p_words
from r2h_batch.report.statistics.aggregate import ASKED_FAILURES, FAILURES, Row, summarise
from r2h_batch.report.statistics.common import Common, complete, seeing
from r2h_batch.report.statistics.paired import BOUNDS, compare, holm, mcnemar, pair_up
from r2h_batch.report.statistics.tally import tally
from r2h_batch.report.text import NA, short_names
from r2h_batch.report.trained import trained_on
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import CRITERIA, SPLITS

SUBMITTED = "(submitted)"
"""Stands behind the name of every method that did not answer again with the same bits."""

CODE = 5
"""Characters that stand for a trial."""
MOST_OTHER = 0.01
"""Share of trials whose margins may differ where two lines are called the same answers."""
LEVEL = 0.05
"""Level of the tests by which places are shared."""

SIGNS = {"better": "\u25b2", "better here": "\u25b3", "tied": "=", "worse here": "\u25bd", "worse": "\u25bc"}  # fmt: skip

CLAIMED = {"t_plan_s": "T_plan", "t_method_s": "T_method"}
"""Times that depend on the submitter's machine; no judge can compute them again."""


@dataclass(frozen=True)
class Judged:
    """How rows of a method were judged again.

    Attributes:
        stored: rows of the method.
        scored: rows of these that were judged again.
        equal: rows of those that are equal bit for bit, answers of built-in methods included.
        built_in: whether it is a built-in method, and all of those rows are equal.
    """

    stored: int
    scored: int
    equal: int
    built_in: bool


@dataclass(frozen=True)
class Against:
    """A method against one baseline, on the trials of both.

    Attributes:
        difference: of the success rates, in points.
        low: lower end of its 95 % interval for the mean of all categories of objects; None with one category.
        high: upper end.
        p: of McNemar's test and of the t test over categories, as `compare` words them; both are corrected over the baselines.
        verdict: what the method is, as `compare` says it.
        trials: number of trials that both answered.
        new: what the interval and the verdict speak about beside these objects: new objects, or new categories.
    """

    difference: float
    low: float | None
    high: float | None
    p: str
    verdict: str
    trials: int
    new: str


@dataclass(frozen=True)
class Standing:
    """A line of the leaderboard.

    Attributes:
        method: name, with the mark of a submitted one.
        submission: where it comes from; empty for a baseline.
        bound: whether it is a bound (random, oracle), which has no rank.
        trials: split -> trials.
        sr: split, or Avg of both -> percent, lower and upper end of the 95 % Wilson interval.
        failures: rate of first failures -> percent of the last row (Avg, or the only split).
        t_exec_s: mean time of execution; it was judged again with the rows.
        claimed: key of `CLAIMED` -> mean time as the submitter wrote it.
        judged: how its rows were judged again; None for a baseline.
        against: baseline -> the comparison with it.
        digest: sha256 of its rows.
        trained: what it says that it was trained on; empty where it says nothing.
        answers: built-in method or baseline -> share of this method's answers that are its stored ones or near them; of a
            method that is not built in.
        codes: split -> `CODE` characters for each trial in order: 1 or 0 for success, and a hash of its verdict and of its
            margins to 0.01 mm.
    """

    method: str
    submission: str
    bound: bool
    trials: Mapping[str, int]
    sr: Mapping[str, tuple[float, float, float]]
    failures: Mapping[str, float | None]
    t_exec_s: float | None
    claimed: Mapping[str, float | None]
    judged: Judged | None
    against: Mapping[str, Against]
    digest: str
    codes: Mapping[str, str]
    trained: str = ""
    answers: Mapping[str, float] = field(default_factory=dict)

    def successes(self, trials: Mapping[str, int]) -> dict[str, NDArray[np.bool_]]:
        """Split -> success of the first so many of its trials."""
        return {
            split: np.array([c == "1" for c in self.codes.get(split, "")[: n * CODE : CODE]], bool)
            for split, n in trials.items()
        }

    def answers_as(self, other: "Standing", trials: Mapping[str, int]) -> bool:
        """Whether the first so many trials of each split end as those of another line, nearly all with the same margins.

        Another processor or version changes a margin's last bits, and a margin that lies where two rounded ones meet
        changes its code.
        """
        mine, others = (
            "".join(x.codes.get(s, "")[: n * CODE] for s, n in trials.items())
            for x in (self, other)
        )
        if len(mine) != len(others) or mine[::CODE] != others[::CODE]:
            return False
        rows = [(mine[k : k + CODE], others[k : k + CODE]) for k in range(0, len(mine), CODE)]
        return sum(a != b for a, b in rows) <= MOST_OTHER * len(rows)

    @property
    def of_all(self) -> float:
        """The success rate that the order goes by: the mean of both splits, or that of the only one."""
        return list(self.sr.values())[-1][0]


def standings_of_baselines(run: Run) -> list[Standing]:
    """Lines of the methods of a run whose rows need no judge."""
    return [_standing(run, method, "", None, {}) for method in run.methods]


def standing_of(
    run: Run,
    method: str,
    submission: str,
    judged: Judged,
    baselines: Run,
    common: Common,
    answers: Mapping[str, float],
) -> Standing:
    """The line of one method of a submission, compared with each baseline on the trials of both.

    Args:
        run: the submission.
        method: name of the method in it.
        submission: what the page calls the submission.
        judged: how its rows were judged again.
        baselines: the run with the baselines.
        common: what `common_trials` says of both runs.
        answers: what `answers_of_shipped` says of the method.

    Raises:
        ValueError: if the rows are not those of the plan, or disagree with themselves.
    """
    # the mark cannot be a part of a submitter's name, so no name is that of a baseline
    shown = method if judged.built_in else f"{method} {SUBMITTED}"
    alone = replace(run, entries=(replace(run.entry(method), name=shown),))
    # what each object is comes from the baselines, which have the same objects by their digest
    alone = replace(alone, header={**alone.header, "objects": baselines.header.get("objects", [])})
    line = _standing(alone, shown, submission, judged, _against(alone, baselines, common))
    return line if judged.built_in else replace(line, answers=answers)


def _against(run: Run, baselines: Run, common: Common) -> dict[str, Against]:
    """The comparisons of a run's only method with all baselines, corrected for their number."""
    if not baselines.entries:
        return {}
    own = [replace(e, name=f"baseline {e.name}") for e in baselines.entries]
    paired = pair_up([run, replace(baselines, entries=tuple(own))], common)
    compared = compare(paired, mine=paired.names[:1], draws=1)[-1]
    return {
        name: Against(p.difference, p.low, p.high, p_words(p), p.verdict, compared.n, compared.new)
        for name, p in zip(baselines.methods, compared.pairs, strict=True)
    }


def _standing(
    run: Run, method: str, submission: str, judged: Judged | None, against: Mapping[str, Against]
) -> Standing:
    averages = run.header["configuration"].get("averages", "trials")
    rows = summarise([tally(run, method)], averages)
    last, known = rows[-1], judged is None or judged.built_in
    return Standing(
        method,
        submission,
        known and run.entry(method).source.get("function", "") in BOUNDS,
        run.planned(method),
        {row.split: _ends(row) for row in rows},
        {
            rate: None if found is None else found.percent
            for rate, found in last.rates.items()
            if rate in FAILURES | ASKED_FAILURES
        },
        last.times["t_exec_s"].value,
        {name: last.times[name].value for name in CLAIMED},
        judged,
        against,
        run.digest(method),
        _codes(run, method),
        trained_on(run.entry(method).source),
    )


def _codes(run: Run, method: str) -> dict[str, str]:
    """`Standing.codes` of a method."""
    margins = [f"margin_{name}_m" for name in CRITERIA]
    found: dict[str, list[str]] = {}
    for table in run.shards("trials", method, ["split", "outcome", *margins]):
        columns = [table[name].to_pylist() for name in ("split", "outcome", *margins)]
        for split, outcome, *lengths in zip(*columns, strict=True):
            words = [outcome, *("" if m is None else f"{round(m, 5) + 0.0:.5f}" for m in lengths)]
            hashed = hashlib.sha256(" ".join(words).encode()).hexdigest()[: CODE - 1]
            found.setdefault(split, []).append(f"{int(outcome == 'success')}{hashed}")
    return {split: "".join(codes) for split, codes in found.items()}


def _ends(row: Row) -> tuple[float, float, float]:
    rate = row.rates["sr"]
    return (math.nan,) * 3 if rate is None else (rate.percent, rate.low, rate.high)


@dataclass(frozen=True)
class Section:
    """The methods that were asked and judged alike.

    Attributes:
        setting: name -> value of what all of them share, as the baselines' run says it.
        baselines: names of the baselines; none of a draft.
        standings: all lines, baselines among them.
    """

    setting: Mapping[str, str]
    baselines: tuple[str, ...]
    standings: tuple[Standing, ...]


def section_of(
    baselines: Run, standings: Sequence[Standing], more: Mapping[str, str] | None = None
) -> Section:
    """The section of submissions that were compared with these baselines.

    Args:
        baselines: the run.
        standings: their lines.
        more: name -> value of what else they share.
    """
    own = standings_of_baselines(baselines)
    setting = {**setting_of(baselines), **(more or {})}
    return Section(setting, baselines.methods, (*own, *standings))


def setting_of(run: Run) -> dict[str, str]:
    """Settings that all methods of a section share: name -> value.

    Args:
        run: one of them.
    """
    header = run.header
    return {
        "protocol": str(header["protocol"]),
        "robot": run.robot,
        "preset": str(header["configuration"].get("name", "")),
        "motion": str(header["configuration"].get("execute", {}).get("sim", "")),
        "digest of trials": str(header["digests"]["trials"])[:12],
    }


def section_of_draft(run: Run) -> dict[str, str]:
    """`setting_of` a run of a draft, whose section has no baselines: it says so. No baselines refuse what was asked or judged
    otherwise, so the section's setting also says what methods see and how they are judged.

    Args:
        run: one of the section.
    """
    setting, digests = setting_of(run), run.header["digests"]
    setting["digest of trials"] = str(digests.get("benchmark", digests["trials"]))[:12]
    # rows have the same bits whatever the chunk; the preset's name stands beside
    judged = {
        k: v for k, v in complete(run.header["configuration"]).items() if k not in ("chunk", "name")
    }
    words = json.dumps(judged, sort_keys=True)
    setting["digest of the configuration"] = hashlib.sha256(words.encode()).hexdigest()[:12]
    setting["methods see"] = seeing(run.header)
    if (sees := digests.get("sees")) is not None:
        setting["methods see"] += f", digest {sees[:12]}"
    return setting | {"a draft": "its trials may change; not to be published; no baselines"}


def page(sections: Sequence[Section], *, least: int) -> str:
    """The leaderboard as one HTML page that needs no network.

    Args:
        sections: groups of methods that were judged alike.
        least: trials of each split that a method needs for a place.
    """
    import jinja2

    every = FAILURES | ASKED_FAILURES
    known = {rate for s in sections for own in s.standings for rate in own.failures}
    failures = {rate: entry.heading for rate, entry in every.items() if rate in {*FAILURES, *known}}
    loader = jinja2.PackageLoader("r2h_batch.report", ".")
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template("board.html").render(
        sections=[_section(section, least) for section in sections],
        failures=failures,
        NA=NA,
        splits=SPLITS,
        claimed=list(CLAIMED.values()),
        signs=SIGNS,
        least=least,
    )


def _section(section: Section, least: int) -> dict[str, Any]:
    """The section as board.html writes it: the lines with a place in their order, then the others."""
    lines = sorted(section.standings, key=lambda s: (-s.of_all, s.method, s.submission))
    own = [s for s in lines if not s.answers]
    enough = [s for s in own if all(s.trials.get(split, 0) >= least for split in SPLITS)]
    trials = {split: min((s.trials.get(split, 0) for s in enough), default=0) for split in SPLITS}
    enough, places = _placed(enough, trials)
    short = short_names(section.baselines)
    same = {
        id(s): next((t.method for t in enough[:k] if t.answers_as(s, trials)), "")
        for k, s in enumerate(enough)
    }
    ranked = [
        _line(s, place, section, trials, same[id(s)])
        for s, place in zip(enough, places, strict=True)
    ]
    placed = {id(s) for s in enough}
    others = [_line(s, None, section, {}, "") for s in lines if id(s) not in placed]
    return {
        "setting": section.setting,
        "baselines": [(name, short[name]) for name in section.baselines],
        "common": ", ".join(f"{n} {split}" for split, n in trials.items()),
        "ranked": ranked,
        "others": others,
    }


def _on_common(s: Standing, trials: Mapping[str, int]) -> float:
    """SR in percent on the first so many trials of each split: the mean of the splits."""
    rates = [100 * float(own.mean()) for own in s.successes(trials).values() if len(own)]
    return float(np.mean(rates)) if rates else math.nan


def _placed(
    standings: Sequence[Standing], trials: Mapping[str, int]
) -> tuple[list[Standing], list[int | None]]:
    """Lines in the order of their success on the trials that all of them hold, and their places.

    A place is one more than the number of methods that are better on these trials by McNemar's test (5 %, Holm over all
    pairs): where nothing is decided, methods share it. Bounds have none.
    """
    rates = {id(s): _on_common(s, trials) for s in standings}
    order = sorted(standings, key=lambda s: (-rates[id(s)], s.method, s.submission))
    ranked = [s for s in order if not s.bound]
    hits = [np.concatenate([*s.successes(trials).values()]) for s in ranked]
    pairs = list(combinations(range(len(ranked)), 2))
    only = [(int((hits[i] & ~hits[j]).sum()), int((hits[j] & ~hits[i]).sum())) for i, j in pairs]
    decided = holm([mcnemar(*both) for both in only]) < LEVEL
    above = [0] * len(ranked)
    for (i, j), (a, b), sure in zip(pairs, only, decided, strict=True):
        if sure:
            above[j if a > b else i] += 1
    places = {
        id(s): 1 + k for s, k in zip(ranked, np.maximum.accumulate(above or [0]), strict=False)
    }
    return order, [None if s.bound else int(places[id(s)]) for s in order]


def _line(
    s: Standing, place: int | None, section: Section, trials: Mapping[str, int], same: str
) -> dict[str, Any]:
    """The cells of a line; `value` is what a column sorts by."""
    common = _on_common(s, trials)
    return {
        "place": "bound" if s.bound else NA if place is None else str(place),
        "same": same,
        "answers": ", ".join(f"{_share(v)} of {short_names([k])[k]}" for k, v in s.answers.items()),
        "common": {"text": NA, "value": -1}
        if math.isnan(common)
        else {"text": f"{common:.1f}", "value": common},
        "method": s.method,
        "trained": s.trained,
        "submission": s.submission,
        "sr": [_sr(s.sr.get(name)) for name in (*SPLITS, "Avg")],
        "n": " + ".join(str(s.trials.get(split, 0)) for split in SPLITS),
        "against": [_cell(s.against.get(name)) for name in section.baselines],
        "failures": {k: NA if v is None else f"{v:.1f}" for k, v in s.failures.items()},
        "times": [NA if v is None else f"{v:.2f}" for v in (s.t_exec_s, *s.claimed.values())],
        "judged": s.judged and _judged(s.judged),
    }


def _share(share: float) -> str:
    """`all answers`, or `12 % of the answers`."""
    return "all answers" if share > 0.995 else f"{100 * share:.0f} % of the answers"


def _judged(judged: Judged) -> dict[str, str]:
    """How many rows were judged again, and what share of the rest can be wrong at most: k rows without a
    difference leave 1 - 0.05^(1/k) (Clopper and Pearson 1934)."""
    left = judged.stored > judged.scored
    share = 100 * (1 - 0.05 ** (1 / judged.scored)) if judged.scored and left else 0.0
    return {
        "rows": f"{judged.scored} of {judged.stored}",
        "equal": str(judged.equal),
        "wrong": f"{share:.1f}" if judged.scored else NA,
    }


def _sr(rate: tuple[float, float, float] | None) -> dict[str, Any]:
    if rate is None or math.isnan(rate[0]):
        return {"text": NA, "value": -1, "ends": ""}
    return {"text": f"{rate[0]:.1f}", "value": rate[0], "ends": f"{rate[1]:.1f}\u2013{rate[2]:.1f}"}


def _cell(against: Against | None) -> dict[str, Any]:
    if against is None:
        return {"text": "", "value": -1000, "words": ""}
    ends = ""
    if against.low is not None and against.high is not None:
        ends = f", 95 % for all {against.new} {against.low:+.1f} to {against.high:+.1f}"
    words = f"{against.verdict}: {against.difference:+.1f} points on {against.trials} trials{ends}; Holm p {against.p}"
    text = f"{against.difference:+.1f} {SIGNS[against.verdict]}"
    return {"text": text, "value": against.difference, "words": words}
