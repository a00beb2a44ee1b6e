"""From the criteria to a row's verdict, one after the other: the first one that was evaluated and failed.

The kernels know none of the criteria: numbers say how each is read.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

KIND_DISTANCE = wp.constant(1)
"""As `r2h_batch.verdicts.MarginKind`; its NONE is 0."""
KIND_BOUND = wp.constant(2)
KIND_CAP = wp.constant(3)
LOWEST = wp.constant(-3.4028234663852886e38)
"""Below it is only -inf: no length."""


@wp.func
def kind_of(number: float, cap: float) -> int:
    """MarginKind of a length, or (`cap` above 0) a clearance that counts up to there; NaN says no length."""
    if cap <= 0.0:
        return KIND_DISTANCE
    if number >= LOWEST and number < cap:
        return wp.where(number < 0.0, KIND_BOUND, KIND_DISTANCE)
    return KIND_CAP


@wp.kernel
def open_verdict(
    first: int, invalid_input: int, invalid_sim: int,
    simulated: int,  # 0: `valid` says nothing
    shaken: int,  # 0: `slip` says nothing
    active_in: wp.array(dtype=wp.bool), valid_in: wp.array(dtype=wp.bool), width_in: wp.array(dtype=float),
    opening_in: wp.array(dtype=float), shift_in: wp.array(dtype=float), slip_in: wp.array(dtype=float),
    # out, by the names of `Scores`; columns of criteria are left to `judge_criterion`
    outcome_out: wp.array(dtype=wp.int8), success_out: wp.array(dtype=wp.bool),
    passed_out: wp.array2d(dtype=wp.bool), evaluated_out: wp.array2d(dtype=wp.bool),
    margin_out: wp.array2d(dtype=float), margin_kind_out: wp.array2d(dtype=wp.int8),
    borderline_out: wp.array(dtype=wp.bool), width_m_out: wp.array(dtype=float),
    opening_m_out: wp.array(dtype=float), grasp_shift_m_out: wp.array(dtype=float),
    slip_m_out: wp.array(dtype=float),
):  # fmt: skip
    """Rows before their first criterion; lengths of those that are active.

    A row that is not active is INVALID_INPUT, one whose simulation failed INVALID_SIM.
    """
    row = first + wp.tid()
    active = active_in[row]
    outcome = int(0)
    if not active:
        outcome = invalid_input
    elif simulated != 0 and not valid_in[row]:
        outcome = invalid_sim
    outcome_out[row] = wp.int8(outcome)
    success_out[row] = outcome == 0
    borderline_out[row] = False
    width_m_out[row] = wp.where(active, width_in[row], wp.nan)
    opening_m_out[row] = wp.where(active, opening_in[row], wp.nan)
    grasp_shift_m_out[row] = wp.where(active, shift_in[row], wp.nan)
    slip_m_out[row] = wp.where(shaken != 0, slip_in[row], wp.nan)


@wp.kernel
def judge_criterion(
    first: int, column: int, failure: int, borderline: float,  # its column, and its number among outcomes
    simulated: int,  # 0: `valid` says nothing
    touching: int,  # 1: a margin of 0 passes
    partial: int,  # 1: rows without a number are not evaluated
    below: int,  # 1: the margin is the limit less the number
    limit: float,
    cap: float,  # a clearance counts up to here; 0: a length
    decided: int,  # 1: `passed` says whether it passes; 0: the margin
    kind_from: int,  # 0: the number says the margin's kind, 1: `kind`, 2: `kind_of_code`
    number_in: wp.array(dtype=float), evaluated_in: wp.array(dtype=wp.bool), passed_in: wp.array(dtype=wp.bool),
    kind_in: wp.array(dtype=wp.int8),  # 0: the number says it after all; so in the table
    code_in: wp.array(dtype=int), kind_of_code_in: wp.array(dtype=wp.int8),
    valid_in: wp.array(dtype=wp.bool),
    outcome_inout: wp.array(dtype=wp.int8), success_inout: wp.array(dtype=wp.bool),
    borderline_inout: wp.array(dtype=wp.bool), passed_inout: wp.array2d(dtype=wp.bool),
    evaluated_inout: wp.array2d(dtype=wp.bool), margin_inout: wp.array2d(dtype=float),
    margin_kind_inout: wp.array2d(dtype=wp.int8),
):  # fmt: skip
    """One criterion's columns. The outcome is it where it was evaluated and failed, and no earlier one has.

    Nothing is evaluated where the simulation failed. A margin within `borderline` of 0 makes a row borderline.
    """
    row = first + wp.tid()
    number = number_in[row]
    margin = number - limit
    if below != 0:
        margin = limit - number
    asked = evaluated_in[row] and (simulated == 0 or valid_in[row])
    if partial != 0 and wp.isnan(number):
        asked = False
    fine = margin > 0.0 or (margin == 0.0 and touching != 0)
    if decided != 0:
        fine = passed_in[row]
    kind = int(0)
    if kind_from == 1:
        kind = int(kind_in[row])
    elif kind_from == 2:
        kind = int(kind_of_code_in[code_in[row]])
    if kind == 0:
        kind = kind_of(number, cap)
    if not asked:
        margin = wp.nan
        fine = False
        kind = 0
    elif not fine and outcome_inout[row] == wp.int8(0):
        outcome_inout[row] = wp.int8(failure)
        success_inout[row] = False
    if wp.abs(margin) < borderline:  # NaN is not
        borderline_inout[row] = True
    passed_inout[row, column] = fine
    evaluated_inout[row, column] = asked
    margin_inout[row, column] = margin
    margin_kind_inout[row, column] = wp.int8(kind)


@wp.kernel
def pose_rows(
    first: int, reason_in: wp.array(dtype=int), pair_in: wp.array(dtype=int), plan_body_in: wp.array(dtype=int),
    safe_body_in: wp.array(dtype=int), point_in: wp.array(dtype=wp.vec3), q_in: wp.array2d(dtype=float),
    # out: the fields of `Scores` of these names
    plan_reason_out: wp.array(dtype=wp.int8), plan_pair_out: wp.array(dtype=wp.int8),
    witness_part_out: wp.array2d(dtype=int), witness_time_s_out: wp.array(dtype=float),
    witness_point_out: wp.array(dtype=wp.vec3), t_plan_s_out: wp.array(dtype=float),
    t_exec_s_out: wp.array(dtype=float), q_goal_out: wp.array2d(dtype=float),
    path_len_out: wp.array(dtype=int),
    motion_len_out: wp.array(dtype=int), body_m_out: wp.array(dtype=float),
):  # fmt: skip
    """Results of postures, in memory of their own; postures have no times."""
    row = first + wp.tid()
    plan_reason_out[row] = wp.int8(reason_in[row])
    plan_pair_out[row] = wp.int8(pair_in[row])
    witness_part_out[row, 0] = plan_body_in[row]
    witness_part_out[row, 1] = safe_body_in[row]
    witness_time_s_out[row] = wp.nan
    witness_point_out[row] = point_in[row]
    t_plan_s_out[row] = wp.nan
    t_exec_s_out[row] = wp.nan
    for j in range(q_in.shape[1]):
        q_goal_out[row, j] = q_in[row, j]
    path_len_out[row] = 0
    motion_len_out[row] = 0
    body_m_out[row] = wp.nan


@wp.kernel
def nobody_takes(first: int, receives_out: wp.array2d(dtype=int)):
    """Rows that nobody was asked to take."""
    row = first + wp.tid()
    for k in range(receives_out.shape[1]):
        receives_out[row, k] = -1
