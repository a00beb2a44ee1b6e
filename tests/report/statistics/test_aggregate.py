"""Rates, intervals and means from per-trial verdicts, against scipy and against counting by hand."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from made_runs import write_run
from rounds import each
from scipy import stats

from r2h_batch.report.statistics import aggregate, breakdown
from r2h_batch.report.statistics.aggregate import Rate
from r2h_batch.report.statistics.tally import Tally, tally
from r2h_batch.runs.columns import schema_of_kind
from r2h_batch.runs.rows import MISSING, OUTCOME_NAMES
from r2h_batch.verdicts import ELSEWHERE, EVERY, NO_LONGER, REGISTRY, SPLITS, Outcome


def table_of(outcome, split=None, objects=None, t_plan_s=None):
    """Stored rows with these outcomes, as far as they are counted."""
    n = len(outcome)
    split = np.zeros(n, int) if split is None else np.asarray(split, int)
    objects = np.arange(n) % 4 if objects is None else objects
    words = {
        "object": ["abcdefgh"[i] for i in objects],
        "split": [SPLITS[i] for i in split],
        "outcome": [(*OUTCOME_NAMES, "odd")[i] for i in outcome],
    }
    columns = {field.name: pa.nulls(n, field.type) for field in schema_of_kind("trials", unread=True)}
    columns |= {name: pa.array(column, pa.string()).dictionary_encode() for name, column in words.items()}
    if t_plan_s is not None:
        columns["t_plan_s"] = pa.array(t_plan_s, pa.float32())
    return pa.table(columns)


def tally_of(outcome, split=None, objects=None, method="m", splits=SPLITS, t_plan_s=None) -> Tally:
    return Tally.of(method, splits, [table_of(outcome, split, objects, t_plan_s)])


def test_wilson_agrees_with_scipy_on_a_grid():
    for n in (1, 2, 5, 33, 500, 10_000):
        counts = sorted({0, 1, n // 3, n // 2, n - 1, n} & set(range(n + 1)))
        for confidence in (0.9, 0.95, 0.99):
            low, high = aggregate.wilson_interval(counts, n, confidence)
            for k, a, b in each(zip(counts, low, high)):
                expected = stats.binomtest(k, n).proportion_ci(confidence, method="wilson")
                assert a == pytest.approx(expected.low, abs=1e-12)
                assert b == pytest.approx(expected.high, abs=1e-12)
                assert 0 <= a <= k / n <= b <= 1


def test_the_clustered_interval_covers_new_objects_and_wilson_does_not():
    rng = np.random.default_rng(5)
    covered = {"wilson": 0, "clustered": 0}
    runs, objects, trials = 1500, 10, 50
    for _ in range(runs):
        p = rng.beta(6, 4, objects)
        success = rng.random((objects, trials)) < p[:, None]
        clustered = aggregate.clustered_rate(success.sum(1), np.full(objects, trials))
        low, high = aggregate.wilson_interval(success.sum(), success.size)
        covered["wilson"] += bool(low <= 0.6 <= high)
        covered["clustered"] += clustered.low <= 60 <= clustered.high
    assert 0.94 < covered["clustered"] / runs < 0.975
    assert covered["wilson"] / runs < 0.75


def test_the_interval_of_a_mean_rate_covers():
    rng = np.random.default_rng(8)
    p, n, hits = np.array([0.7, 0.93]), 120, 0
    for _ in range(2000):
        parts = []
        for k in rng.binomial(n, p):
            low, high = aggregate.wilson_interval(k, n)
            parts.append(Rate(100 * k / n, 100 * float(low), 100 * float(high)))
        mean = aggregate.mean_rate(parts)
        hits += mean.low <= 100 * p.mean() <= mean.high
    assert 0.93 < hits / 2000 < 0.97


@pytest.mark.check
def test_rates_add_up_to_100_with_invalid_and_missing_counted_separately():
    counts = {"success": 5, "stability": 4, "plan": 3, "reach": 2, "affordance": 1, "safe": 6}
    counts |= {"invalid_input": 7, "invalid_sim": 8, "missing": 9}
    further = dict.fromkeys((*(e.name for e in EVERY[5:]), *NO_LONGER, ELSEWHERE), 0)
    outcome = np.repeat([OUTCOME_NAMES.index(name) for name in counts], list(counts.values()))
    row = aggregate.split_row(tally_of(outcome, np.ones(45)), "S1")
    assert row.n == 45
    rates = {k: r for k, r in row.rates.items() if k not in {e.rate for e in REGISTRY[5:]}}
    assert sum(r.percent for r in rates.values()) == pytest.approx(100)
    assert {k: r.count for k, r in rates.items()} == {
        "sr": 5, "f_stab": 4, "f_plan": 3, "f_reach": 2, "f_afford": 1, "f_safe": 6, "invalid": 15, "missing": 9,
    }  # fmt: skip
    assert row.counts == counts | further


def test_times_are_means_over_the_trials_in_which_the_stage_ran():
    row = aggregate.split_row(tally_of([0, 0, 2, 2], t_plan_s=[1.0, 2.0, None, 6.0]), "S0")
    assert (row.times["t_plan_s"].value, row.times["t_plan_s"].count) == (3.0, 3)
    assert (row.times["t_exec_s"].value, row.times["t_exec_s"].count) == (None, 0)
    assert row.times["t_tot_s"].value is None


def test_an_empty_split_has_no_rates_no_times_and_no_average():
    rows = aggregate.summarise([tally_of([0, 0, 2])])
    by_split = {r.split: r for r in rows}
    assert by_split["S1"].n == 0
    for row in (by_split["S1"], by_split["Avg"]):
        assert all(r is None for r in row.rates.values())
        assert row.sr_new_objects is None
        assert row.times["t_tot_s"].value is None


def test_avg_is_the_mean_of_the_splits_whatever_their_sizes_and_takes_s0s_affordance_as_0():
    outcome = [0, 0, 0, 2] + [0] * 5 + [Outcome.AFFORDANCE] * 5
    rows = {r.split: r for r in aggregate.summarise([tally_of(outcome, [0] * 4 + [1] * 10)])}
    assert rows["Avg"].rates["sr"].percent == pytest.approx((75 + 50) / 2)
    assert rows["S0"].rates["f_afford"] is None
    s1, avg = rows["S1"].rates["f_afford"], rows["Avg"].rates["f_afford"]
    assert (avg.percent, avg.low, avg.high) == pytest.approx((s1.percent / 2, s1.low / 2, s1.high / 2))


def test_avgs_intervals_for_new_ones_are_those_of_the_splits_own():
    """Newcombe's and Zou's MOVER by hand: the squared arms add up, at half the weight."""
    random = np.random.default_rng(2)
    split, objects = np.repeat([0, 1], 240), np.repeat([0, 1, 2, 3, 4, 5, 6, 7], 60)
    outcome = np.where(random.random(480) < np.repeat([0.9, 0.5, 0.6, 0.8, 0.2, 0.9, 0.4, 0.7], 60), 0, 2)
    counted = tally_of(outcome, split, objects)
    named = replace(counted, category={"a": "cup", "b": "cup", "e": "pan", "f": "pan"})
    rows = {r.split: r for r in aggregate.summarise([named])}
    assert (rows["S0"].n_categories, rows["S0"].n_objects) == (3, 4)
    ends = []
    for name in ("sr_new_objects", "sr_new_categories", "sr_few"):
        s0, s1, avg = (getattr(rows[s], name) for s in ("S0", "S1", "Avg"))
        assert avg.percent == pytest.approx((s0.percent + s1.percent) / 2)
        assert avg.percent - avg.low == pytest.approx(np.hypot(s0.percent - s0.low, s1.percent - s1.low) / 2)
        assert avg.high - avg.percent == pytest.approx(np.hypot(s0.high - s0.percent, s1.high - s1.percent) / 2)
        ends.append((avg.low, avg.high))
    assert len(set(ends)) == 3 and ends[1][0] > ends[2][0]  # a few categories say less than all


def test_the_table_is_the_same_for_any_shards(tmp_path):
    outcomes = np.random.default_rng(4).choice([0, 0, 1, 2, 3, 5, Outcome.INVALID_INPUT, MISSING], 240)
    rows = []
    for size in (240, 7, 33):
        run = write_run(tmp_path / str(size), {"m": outcomes}, 120, 120, shard_trials=size)
        counted = tally(run, "m")
        rows.append((aggregate.summarise([counted]), breakdown.by_object(counted)))
    assert rows[0] == rows[1] == rows[2]


def test_an_unknown_outcome_is_refused_by_name():
    with pytest.raises(ValueError, match=r"outcome holds 'odd'; known are success, .*missing"):
        tally_of([0, len(OUTCOME_NAMES), 2])


def test_every_object_counts_the_same_where_averages_are_of_objects():
    counted = tally_of([0, 0, 0, 2, 2, 2], objects=[0, 0, 0, 0, 1, 2], splits=("S0",), t_plan_s=[1, 1, 1, 1, 5, None])
    (row,) = aggregate.summarise([counted], "objects")
    assert row.rates["sr"].percent == pytest.approx((75 + 0 + 0) / 3) and row.rates["sr"].count == 3
    assert row.times["t_plan_s"].value == pytest.approx((1 + 5) / 2)
    (plain,) = aggregate.summarise([counted])
    assert (row.rates["sr"].low, row.rates["sr"].high) == (plain.rates["sr"].low, plain.rates["sr"].high)
