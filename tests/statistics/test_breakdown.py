"""Per object, co-failures and other orders, against counting by hand."""

from collections import Counter
from itertools import permutations

import numpy as np
import pytest
from made_runs import OBJECTS, write_run

from r2h_batch.runs.columns import FAILED, PASSED, PATTERNS, pattern_outcomes
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.statistics import breakdown
from r2h_batch.statistics.aggregate import group_row
from r2h_batch.statistics.tally import tally
from r2h_batch.types import CRITERIA, Outcome

OUTCOMES = np.random.default_rng(3).choice([0, 0, 0, 1, 2, 3, 5, 6, 8], 120)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    run = write_run(tmp_path_factory.mktemp("b") / "run", {"m": OUTCOMES}, 60, 60, shard_trials=17)
    table = run.trials("m").to_pylist()
    return tally(run, "m"), table


def test_the_outcome_of_every_pattern_is_its_first_failure_and_never_a_success_that_was_not_fully_judged():
    for split, needed in enumerate(([0, 1, 2, 4], [0, 1, 2, 3, 4])):
        for pattern, code in zip(PATTERNS, pattern_outcomes()[split]):
            failed = [c for c, state in zip(CRITERIA, pattern) if state == FAILED]
            if failed:
                assert Outcome(code).name.lower() == failed[0]
            else:  # -1: a required criterion was not evaluated
                assert code == (Outcome.SUCCESS if all(pattern[i] == PASSED for i in needed) else -1)


def test_co_failures_are_counted_where_both_were_evaluated(made):
    counted, table = made
    found = breakdown.co_failures(counted, "S1")
    mine = [r for r in table if r["split"] == "S1"]
    for i, a in enumerate(CRITERIA):
        for j, b in enumerate(CRITERIA):
            pairs = [(r[f"passed_{a}"], r[f"passed_{b}"]) for r in mine]
            assert found.failed[i, j] == sum(x is False and y is False for x, y in pairs)
            assert found.evaluated[i, j] == sum(x is not None and y is not None for x, y in pairs)
    assert found.failed[2, 0] > 0 and found.failed[0, 4] == 0


def test_any_order_gives_the_first_failure_in_that_order_and_the_same_success_rate(made):
    counted, table = made

    def outcomes(tally_):
        found = Counter()
        for split, code, outcome, n in zip(tally_.split, tally_.object, tally_.outcome, tally_.n):
            found[int(split), int(code), int(outcome)] += int(n)
        return found

    for order in permutations(CRITERIA):
        expected = Counter()
        for row in table:
            failed = [c for c in order if row[f"passed_{c}"] is False]
            told = failed[0] if failed else "success"
            name = row["outcome"] if row["outcome"].startswith(("invalid", "missing")) else told
            split = ("S0", "S1").index(row["split"])
            expected[split, counted.objects.index(row["object"]), OUTCOME_NAMES.index(name)] += 1
        again = outcomes(breakdown.in_order(counted, order))
        assert again == expected
        assert {k: n for k, n in again.items() if k[2] == 0} == {
            k: n for k, n in outcomes(counted).items() if k[2] == 0
        }
    assert outcomes(breakdown.in_order(counted, CRITERIA)) == outcomes(counted)
    reach_first = outcomes(breakdown.in_order(counted, breakdown.parse_order("reach")))

    def reached(found):
        return sum(n for k, n in found.items() if k[2] == Outcome.REACH)

    assert reached(reach_first) > reached(outcomes(counted))


def test_object_rows_add_up_to_their_split(made):
    counted, _ = made
    rows = breakdown.by_object(counted)
    assert [name for name, _ in rows] == sorted(OBJECTS[:3]) + sorted(OBJECTS[3:])
    for split in ("S0", "S1"):
        whole = group_row(counted, split)
        parts = [row for _, row in rows if row.split == split]
        assert {n: sum(r.counts[n] for r in parts) for n in whole.counts} == dict(whole.counts)
        assert all(r.n_objects == 1 and r.sr_new_objects is None for r in parts)


@pytest.mark.parametrize(("text", "message"), [("reach,plam", "plam"), ("plan,plan", "twice")])
def test_an_order_that_is_none_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        breakdown.parse_order(text)
    assert breakdown.parse_order("Safe, plan") == ("safe", "plan", "stability", "reach", "affordance")
