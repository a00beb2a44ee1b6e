"""Per object and co-failures, against counting by hand."""

from itertools import product

import numpy as np
import pytest
from made_runs import OBJECTS, write_run
from rounds import each

from r2h_batch.report.statistics import breakdown
from r2h_batch.report.statistics.aggregate import split_row
from r2h_batch.report.statistics.codes import FAILED, PASSED, UNEVALUATED, first_failures
from r2h_batch.report.statistics.tally import tally
from r2h_batch.runs.rows import MISSING
from r2h_batch.types import CRITERIA, Outcome
from r2h_batch.verdicts import REGISTRY, SPLITS

OUTCOMES = np.random.default_rng(3).choice([0, 0, 0, 1, 2, 3, 5, Outcome.INVALID_INPUT, MISSING], 120)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    run = write_run(tmp_path_factory.mktemp("b") / "run", {"m": OUTCOMES}, 60, 60, shard_trials=17)
    table = run.trials("m").to_pylist()
    return tally(run, "m"), table


def test_the_outcome_is_the_first_failure_and_never_a_success_that_was_not_fully_judged():
    patterns = np.array(list(product((UNEVALUATED, FAILED, PASSED), repeat=len(CRITERIA))), np.uint8)
    by_name = dict(zip(CRITERIA, patterns.T, strict=True))
    for split, of_paper in enumerate(([0, 1, 2, 4], [0, 1, 2, 3, 4])):
        needed = [*of_paper, *(5 + k for k, entry in enumerate(REGISTRY[5:]) if SPLITS[split] in entry.splits)]
        for pattern, code in each(zip(patterns, first_failures(by_name, np.full(len(patterns), split)), strict=True)):
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


def test_object_rows_add_up_to_their_split(made):
    counted, _ = made
    rows = breakdown.by_object(counted)
    assert [name for name, _ in rows] == sorted(OBJECTS[:3]) + sorted(OBJECTS[3:])
    for split in ("S0", "S1"):
        whole = split_row(counted, split)
        parts = [row for _, row in rows if row.split == split]
        assert {n: sum(r.counts[n] for r in parts) for n in whole.counts} == dict(whole.counts)
        assert all(r.n_objects == 1 and r.sr_new_objects is None for r in parts)
