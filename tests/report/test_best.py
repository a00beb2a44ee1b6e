"""Cells that a table may call best: no bound, and no rate of a failure of a method that loses its trials earlier."""

import numpy as np
from made_runs import write_run

from r2h_batch.report.table import best_cells, render, table_of
from r2h_batch.runs.rows import OUTCOME_NAMES

N = 40


def outcomes(**counts):
    """Outcomes of N trials: so many of each, the rest successes."""
    codes = [OUTCOME_NAMES.index(name) for name, n in counts.items() for _ in range(n)]
    return np.array(codes + [0] * (N - len(codes)))


def table(folder, **methods):
    return table_of(write_run(folder / "run", methods, N, 0))


def of(found, column):
    return {method for _, method, c in best_cells(found) if c == column}


def test_a_method_that_fails_earlier_is_not_best_at_what_it_never_came_to(tmp_path):
    found = table(tmp_path, early=outcomes(plan=40), late=outcomes(plan=4, safe=6), later=outcomes(plan=4, safe=8))
    assert of(found, "sr") == {"late"}
    assert of(found, "f_safe") == set()  # `early` has 0.0, because it never came so far
    assert of(found, "f_plan") == {"late", "later"}
    text = render(found, "latex")
    assert r"\bfseries 0.0" not in text


def test_where_all_come_as_far_the_lowest_rate_is_best(tmp_path):
    found = table(tmp_path, a=outcomes(plan=4, safe=6), b=outcomes(plan=4, safe=8))
    assert of(found, "f_safe") == {"a"} and of(found, "f_plan") == set()


def test_no_cell_of_a_bound_is_best(tmp_path):
    found = table(tmp_path, oracle=outcomes(), a=outcomes(plan=4), b=outcomes(plan=9))
    bound = type(found)(**{**vars(found), "bounds": ("oracle",)})
    assert of(found, "sr") == {"oracle"} and of(bound, "sr") == {"a"} == of(bound, "f_plan")


def test_the_builtin_bounds_are_known_as_such():
    from r2h_batch.report.compare.stored import stored_rows
    from r2h_batch.runs import load_run

    found = table_of(load_run(stored_rows()[0]))
    assert set(found.bounds) == {"random", "oracle"} and not of(found, "sr") & {"random", "oracle"}


def test_latex_comments_are_few(tmp_path):
    found = table(tmp_path, a=outcomes(plan=4), b=outcomes(plan=9))
    lines = render(found, "latex").splitlines()
    assert sum(line.startswith("%") for line in lines) <= 14
