"""From the criteria side by side to a row's verdict: the first that was evaluated and failed, in the paper's order."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

INVALID_INPUT = wp.constant(6)
"""As `r2h_batch.verdicts.Outcome`, of which a criterion's own number is its place + 1."""
INVALID_SIM = wp.constant(7)

RULE_BITS = wp.constant(4)
"""A criterion's rule has so many bits of `rules`, the first criterion the lowest."""
GIVEN = wp.constant(0)
"""Margin, passed and evaluated are as they stand."""
TOUCHING_PASSES = wp.constant(1)
"""What is evaluated passes at a margin of 0 and above; `passed` says nothing. The margin is NaN where not evaluated."""
APART_PASSES = wp.constant(2)
"""The same, above 0."""
NAN_IS_UNASKED = wp.constant(4)
"""Besides: rows whose margin is NaN are not evaluated."""
WITHIN = wp.constant(8)
"""Besides: the margin is what is left from the number to its limit. Without: the number less its limit."""


@wp.kernel
def judge_rows(
    first: int,
    borderline_m: float,
    simulated: int,  # 0: `valid` says nothing
    rules: int,  # how each criterion is to be read
    limit_0: float,
    limit_1: float,
    limit_2: float,
    limit_3: float,
    limit_4: float,
    # the criteria, in the order of `r2h_batch.verdicts.CRITERIA`
    margin_0_in: wp.array(dtype=wp.float32),
    margin_1_in: wp.array(dtype=wp.float32),
    margin_2_in: wp.array(dtype=wp.float32),
    margin_3_in: wp.array(dtype=wp.float32),
    margin_4_in: wp.array(dtype=wp.float32),
    passed_0_in: wp.array(dtype=wp.bool),
    passed_1_in: wp.array(dtype=wp.bool),
    passed_2_in: wp.array(dtype=wp.bool),
    passed_3_in: wp.array(dtype=wp.bool),
    passed_4_in: wp.array(dtype=wp.bool),
    evaluated_0_in: wp.array(dtype=wp.bool),
    evaluated_1_in: wp.array(dtype=wp.bool),
    evaluated_2_in: wp.array(dtype=wp.bool),
    evaluated_3_in: wp.array(dtype=wp.bool),
    evaluated_4_in: wp.array(dtype=wp.bool),
    # rows
    active_in: wp.array(dtype=wp.bool),
    valid_in: wp.array(dtype=wp.bool),
    width_in: wp.array(dtype=wp.float32),
    opening_in: wp.array(dtype=wp.float32),
    shift_in: wp.array(dtype=wp.float32),
    # out
    outcome_out: wp.array(dtype=wp.int8),
    success_out: wp.array(dtype=wp.bool),
    borderline_out: wp.array(dtype=wp.bool),
    passed_out: wp.array2d(dtype=wp.bool),
    evaluated_out: wp.array2d(dtype=wp.bool),
    margin_out: wp.array2d(dtype=wp.float32),
    width_m_out: wp.array(dtype=wp.float32),
    opening_m_out: wp.array(dtype=wp.float32),
    shift_m_out: wp.array(dtype=wp.float32),
):
    """Outcome, the criteria's columns, whether a margin is within `borderline_m` of 0; widths of rows that are active.

    The columns are walked from the last to the first, so that the first criterion that was evaluated and failed is what stays:

    0. `rules` says whether a criterion's columns are given or to be made from its number and limit (NaN passes nothing);
    1. a criterion counts where it was evaluated and the simulation did not fail; its margin is NaN where that did;
    2. what counts and did not pass is the outcome, its place + 1; if nothing is, the row is a success;
    3. what counts and is nearer to 0 than `borderline_m` makes the row borderline;
    4. a row that is not active is INVALID_INPUT, one whose simulation failed INVALID_SIM: neither is judged by anything.
    """
    row = first + wp.tid()
    active = active_in[row]
    judged = simulated == 0 or valid_in[row]
    margin = wp.vector(
        margin_0_in[row], margin_1_in[row], margin_2_in[row], margin_3_in[row], margin_4_in[row], dtype=float
    )
    limit = wp.vector(limit_0, limit_1, limit_2, limit_3, limit_4, dtype=float)
    passed = wp.vector(
        int(passed_0_in[row]), int(passed_1_in[row]), int(passed_2_in[row]), int(passed_3_in[row]),
        int(passed_4_in[row]), dtype=int,
    )  # fmt: skip
    evaluated = wp.vector(
        int(evaluated_0_in[row]), int(evaluated_1_in[row]), int(evaluated_2_in[row]), int(evaluated_3_in[row]),
        int(evaluated_4_in[row]), dtype=int,
    )  # fmt: skip
    outcome = int(0)
    near = bool(False)
    for i in range(5):
        k = 4 - i
        rule = rules >> (RULE_BITS * k)
        m = wp.where((rule & WITHIN) != 0, limit[k] - margin[k], margin[k] - limit[k])
        asked = evaluated[k] != 0
        fine = passed[k] != 0
        if (rule & (TOUCHING_PASSES | APART_PASSES)) != 0:
            if (rule & NAN_IS_UNASKED) != 0 and wp.isnan(m):
                asked = False
            fine = asked and (m > 0.0 or (m == 0.0 and (rule & TOUCHING_PASSES) != 0))
            if not asked:
                m = wp.nan
        asked = judged and asked
        fine = judged and fine
        if not judged:
            m = wp.nan
        if asked and not fine:
            outcome = k + 1
        near = near or (asked and wp.abs(m) < borderline_m)
        passed_out[row, k] = fine
        evaluated_out[row, k] = asked
        margin_out[row, k] = m
    if not active:
        outcome = INVALID_INPUT
    elif not judged:
        outcome = INVALID_SIM
    outcome_out[row] = wp.int8(outcome)
    success_out[row] = outcome == 0
    borderline_out[row] = near
    width_m_out[row] = wp.where(active, width_in[row], wp.nan)
    opening_m_out[row] = wp.where(active, opening_in[row], wp.nan)
    shift_m_out[row] = wp.where(active, shift_in[row], wp.nan)
