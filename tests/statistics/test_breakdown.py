"""Per object, co-failures and other orders, against counting by hand."""

from itertools import permutations

import numpy as np
import pytest
from made_runs import OBJECTS, write_run

from r2h_batch.statistics import breakdown
from r2h_batch.statistics.aggregate import PATTERNS, first_failure, group_row, pattern_outcomes, verdicts
from r2h_batch.types import CRITERIA, Outcome

OUTCOMES = np.random.default_rng(3).choice([0, 0, 0, 1, 2, 3, 5, 6, 8], 120)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    run = write_run(tmp_path_factory.mktemp("b") / "run", {"m": OUTCOMES}, 60, 60, shard_trials=17)
    table = run.trials("m").to_pylist()
    return verdicts(run, "m"), table


def test_the_outcome_of_every_pattern_is_its_first_failure():
    evaluated, passed = PATTERNS > 0, PATTERNS == 2
    for split, needed in enumerate(([1, 1, 1, 0, 1], [1, 1, 1, 1, 1])):
        found = pattern_outcomes()[split]
        told = found >= 0
        assert told.any() and (~told).any()
        expected = first_failure(passed[told], evaluated[told], np.array(needed, bool))
        assert np.array_equal(found[told], expected)
        for row in np.flatnonzero(~told):
            with pytest.raises(ValueError, match="not evaluated"):
                first_failure(passed[[row]], evaluated[[row]], np.array(needed, bool))


def test_co_failures_are_counted_where_both_were_evaluated(made):
    v, table = made
    rows = v.split == 1
    found = breakdown.co_failures(v, rows)
    mine = [r for r in table if r["split"] == "S1"]
    for i, a in enumerate(CRITERIA):
        for j, b in enumerate(CRITERIA):
            pairs = [(r[f"passed_{a}"], r[f"passed_{b}"]) for r in mine]
            assert found.failed[i, j] == sum(x is False and y is False for x, y in pairs)
            assert found.evaluated[i, j] == sum(x is not None and y is not None for x, y in pairs)
    assert found.failed[2, 0] > 0 and found.failed[0, 4] == 0


def test_any_order_gives_the_first_failure_in_that_order_and_the_same_success_rate(made):
    v, table = made
    for order in permutations(CRITERIA):
        again = breakdown.in_order(v, order)
        for code, row in zip(again.outcome, table):
            failed = [c for c in order if row[f"passed_{c}"] is False]
            if row["outcome"].startswith(("invalid", "missing")):
                assert code == v.outcome[table.index(row)]
            else:
                assert code == (Outcome[failed[0].upper()] if failed else Outcome.SUCCESS)
        assert (again.outcome == 0).sum() == (v.outcome == 0).sum()
    assert np.array_equal(breakdown.in_order(v, CRITERIA).outcome, v.outcome)
    reach_first = breakdown.in_order(v, breakdown.parse_order("reach"))
    assert (reach_first.outcome == Outcome.REACH).sum() > (v.outcome == Outcome.REACH).sum()


def test_object_rows_add_up_to_their_split(made):
    v, _ = made
    rows = breakdown.by_object(v)
    assert [name for name, _ in rows] == sorted(OBJECTS[:3]) + sorted(OBJECTS[3:])
    for k, split in enumerate(("S0", "S1")):
        whole = group_row(v, v.split == k, split)
        parts = [row for _, row in rows if row.split == split]
        assert {n: sum(r.counts[n] for r in parts) for n in whole.counts} == dict(whole.counts)
        assert all(r.n_objects == 1 and r.sr_new_objects is None for r in parts)


@pytest.mark.parametrize(("text", "message"), [("reach,plam", "plam"), ("plan,plan", "twice")])
def test_an_order_that_is_none_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        breakdown.parse_order(text)
    assert breakdown.parse_order("Safe, plan") == ("safe", "plan", "stability", "reach", "affordance")
