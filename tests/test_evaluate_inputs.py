"""Bad rows, wrong arguments, strides and gradients at the Evaluator's border."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from problems import assert_same, default_evaluator, make_batch
from rounds import each
from staging import BACK, TOOL, Staged, batch_of, hand_at, staged_evaluator

from r2h_batch.types import CRITERIA, Outcome, PlanReason, Trials

GOOD = Staged()
every_stage = pytest.mark.parametrize("stages", ["all", "pose"])
OUT_OF_THE_WAY = hand_at(np.array([1.5, 1.5, 0.4]), BACK, np.array([0.0, 0, 1]))


# --- bad rows ------------------------------------------------------------------------------------------------------


NO_POSE = (
    ((0, 1), torch.nan), ((2, 3), torch.inf), ((3, 0), 0.1), ((3, 3), 2.0), ((0, 3), 1e9),
    ((slice(3), slice(3)), 0.0), ((slice(3), 0), -1.0), ((slice(3), slice(3)), 1.01),
)  # fmt: skip
"""(entries, what stands there); the last two: what they are multiplied with, a reflection and a scale."""


@every_stage
def test_rows_that_are_no_pose_are_invalid_and_leave_their_neighbours_untouched(stages):
    evaluator, n = default_evaluator(), len(NO_POSE)
    good = make_batch(evaluator.scene, 6 * n, random_share=0.3)
    bad_rows = torch.arange(0, 6 * n, 2)
    tensors = [good.T_obj_ee.clone(), good.T_world_ee.clone(), good.trials.T_world_hand.clone()]
    for row in range(3 * n):
        T, (where, value) = tensors[row // n][2 * row], NO_POSE[row % n]
        T[where] = T[where] * value if row % n >= n - 2 else value
    s = evaluator.score(*tensors[:2], replace(good.trials, T_world_hand=tensors[2]), stages)
    bad = s[bad_rows]
    assert (bad.outcome == int(Outcome.INVALID_INPUT)).all() and not bad.success.any()
    assert (
        torch.isnan(bad.margin).all() and not bad.passed.any() and not bad.evaluated.any() and not bad.borderline.any()
    )
    assert (bad.plan_reason == int(PlanReason.NOT_EVALUATED)).all() and (bad.plan_pair == 0).all()
    for name in (
        "t_plan_s",
        "t_exec_s",
        "q_goal",
        "width_m",
        "opening_m",
        "grasp_shift_m",
        "witness_time_s",
        "witness_point",
    ):
        assert torch.isnan(getattr(bad, name)).all(), name
    assert (bad.path_len == 0).all() and (bad.witness_part == -1).all()
    kept = bad_rows + 1
    alone = evaluator.score(good.T_obj_ee[kept], good.T_world_ee[kept], good.trials[kept], stages)
    assert_same(s[kept], alone)


@every_stage
@pytest.mark.parametrize("how", ["scaled", "sheared"])
def test_a_rotation_off_by_less_than_a_thousandth_is_accepted_as_a_rotation(how, stages):
    T_obj_ee, T_world_ee, trials = batch_of([GOOD])
    for T in (T_obj_ee, T_world_ee, trials.T_world_hand):
        if how == "scaled":
            T[:, :3, :3] *= 1.0004  # R R^T is off by 8e-4
        else:
            T[:, :3, 0] += 8e-4 * T[:, :3, 1]
    s = staged_evaluator().score(T_obj_ee, T_world_ee, trials, stages)
    clean = staged_evaluator().score(*batch_of([GOOD]), stages)
    assert s.outcome.tolist() == clean.outcome.tolist() == [int(Outcome.SUCCESS)]
    assert s.plan_pair.tolist() == clean.plan_pair.tolist()
    torch.testing.assert_close(s.margin, clean.margin, atol=1e-5 if how == "scaled" else 2e-3, rtol=0, equal_nan=True)


@every_stage
def test_denormal_numbers_are_as_good_as_zeros(stages):
    evaluator = default_evaluator()
    batch = make_batch(evaluator.scene, 8)
    zero, tiny = (
        [torch.where(T.abs() < 1e-6, torch.tensor(small), T) for T in (batch.T_obj_ee, batch.T_world_ee)]
        for small in (0.0, 1e-41)
    )
    plain = evaluator.score(*zero, batch.trials, stages)
    assert_same(evaluator.score(*tiny, batch.trials, stages), plain)
    torch.set_flush_denormal(True)  # what a program may do for its own speed
    try:
        assert_same(evaluator.score(*tiny, batch.trials, stages), plain)
    finally:
        torch.set_flush_denormal(False)


@every_stage
@pytest.mark.parametrize("which", ["T_world_ee", "T_world_hand"])
def test_rows_a_hundred_metres_away_are_judged_and_beyond_a_kilometre_are_invalid(which, stages):
    T_obj_ee, T_world_ee, trials = batch_of([GOOD, GOOD])
    moved = {"T_world_ee": T_world_ee.clone(), "T_world_hand": trials.T_world_hand.clone()}
    moved[which][:, 0, 3] = torch.tensor([100.0, 2000.0])
    trials = replace(trials, T_world_hand=moved["T_world_hand"])
    s = staged_evaluator().score(T_obj_ee, moved["T_world_ee"], trials, stages)
    far = Outcome.PLAN if which == "T_world_ee" else Outcome.REACH
    assert s.outcome.tolist() == [int(far), int(Outcome.INVALID_INPUT)]
    assert -101 < float(s.margin[0, CRITERIA.index("reach")]) < -98 and bool(s.margin[1].isnan().all())


# --- refused before any work ---------------------------------------------------------------------------------------


@pytest.fixture
def no_work(monkeypatch):
    """Fails the test if a stage is entered."""

    def refuse(*_, **__):
        raise AssertionError("work was done before the input was checked")

    monkeypatch.setattr("r2h_batch.judge.attach.close_pads", refuse)
    monkeypatch.setattr("r2h_batch.stages.solve_ik", refuse)


def wrong_inputs() -> dict[str, tuple]:
    grasp, handover, trials = batch_of([GOOD, GOOD])

    def but(**changes) -> tuple:
        return grasp, handover, replace(trials, **changes)

    return {
        "3 x 4": ((grasp, handover[:, :3], trials), ValueError, "T_world_ee"),
        "too many rows": ((grasp, torch.cat([handover, handover]), trials), ValueError, "T_world_ee"),
        "float16": ((grasp.half(), handover, trials), TypeError, "T_obj_ee"),
        "masked": ((np.ma.masked_greater(grasp.numpy(), 0.9), handover, trials), TypeError, r"T_obj_ee.*\.filled\("),
        "a list of masked": ((grasp, [*np.ma.masked_less(handover.numpy(), 0.1)], trials), TypeError, "T_world_ee"),
        "meta device": ((grasp.to("meta"), handover, trials), TypeError, "T_obj_ee"),
        "hand pose dtype": (but(T_world_hand=trials.T_world_hand.double()), TypeError, "T_world_hand"),
        "trial id dtype": (
            but(trial_id=trials.trial_id.int()),
            ValueError,
            r"trials\.trial_id is .* must be torch\.int64",
        ),
        "object dtype": (but(object_index=trials.object_index.long()), (TypeError, ValueError), "object_index"),
        "object 99": (but(object_index=trials.object_index + 99), ValueError, "object_index"),
        "hand 9999": (but(hand_index=trials.hand_index + 9999), ValueError, "hand_index"),
        "candidates for one pose only": ((grasp[:, None], handover, trials), ValueError, "T_world_ee"),
        "other numbers of candidates": (
            (grasp[:, None].expand(2, 3, 4, 4), handover[:, None].expand(2, 2, 4, 4), trials),
            ValueError,
            "T_world_ee",
        ),
        "one grasp for three trials' poses": (
            (grasp[:1], handover[:, None].expand(2, 3, 4, 4), trials),
            ValueError,
            "T_obj_ee",
        ),
    }


@pytest.mark.parametrize("case", wrong_inputs())
def test_wrong_inputs_are_refused_by_name_before_any_work(case, no_work):
    arguments, error, name = wrong_inputs()[case]
    with pytest.raises(error, match=name):
        staged_evaluator().score(*arguments)


@every_stage
@pytest.mark.parametrize("own_axis", [True, False], ids=["(N, 1)", "(N,)"])
def test_a_trials_grasp_goes_with_all_of_its_poses(own_axis, stages):
    """The same bits as with copies of the grasp, and a gradient that is the sum of theirs."""
    T_obj_ee, handover, trials = batch_of([GOOD, GOOD.but(object_index=TOOL)])
    T_world_ee = handover[:, None].repeat(1, 3, 1, 1)
    T_world_ee[:, 1, 0, 3] += 0.01
    T_world_ee[1, 2, 2, 3] += 5.0
    T_obj_ee[1, 2, 3] += 0.002
    copies = T_obj_ee[:, None].repeat(1, 3, 1, 1)
    given = T_obj_ee[:, None] if own_axis else T_obj_ee
    evaluator = staged_evaluator()
    found = evaluator.score(given, T_world_ee, trials, stages)
    assert_same(evaluator.score(copies, T_world_ee, trials, stages), found)
    assert len(found.trial_id) == 6 and len(set(found.outcome.tolist())) > 1
    if stages == "pose":
        one, many = given.clone().requires_grad_(), copies.clone().requires_grad_()
        for poses in each((one, many)):
            evaluator.score(poses, T_world_ee, trials, stages).margin.nan_to_num(nan=0.0).sum().backward()
        assert one.grad is not None and many.grad is not None and many.grad.abs().sum() > 0
        torch.testing.assert_close(one.grad.reshape(2, 4, 4), many.grad.sum(1))


@every_stage
@pytest.mark.parametrize("kind", ["float64", "numpy", "lists"])
def test_poses_may_be_float64_arrays_or_lists(kind, stages):
    T_obj_ee, T_world_ee, trials = batch_of([GOOD, GOOD.but(object_index=TOOL)])
    change = {"float64": torch.Tensor.double, "numpy": torch.Tensor.numpy, "lists": torch.Tensor.tolist}[kind]
    evaluator = staged_evaluator()
    plain = evaluator.score(T_obj_ee, T_world_ee, trials, stages)
    assert_same(plain, evaluator.score(change(T_obj_ee), change(T_world_ee), trials, stages))


def test_the_first_call_warns_of_poses_that_look_wrong():
    T_obj_ee, T_world_ee, trials = batch_of([GOOD, GOOD])
    millimetres, evaluator = T_world_ee.clone(), staged_evaluator()
    millimetres[:, :3, 3] *= 1000
    for poses, words in (((T_obj_ee, millimetres), "lengths are in metres"), ((T_world_ee, T_obj_ee), "exchanged")):
        evaluator.called = False
        with pytest.warns(UserWarning, match=words):
            evaluator.score(*poses, trials, "pose")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            evaluator.score(*poses, trials, "pose")


@every_stage
def test_gradients_strides_and_views_change_nothing(stages):
    T_obj_ee, T_world_ee, trials = batch_of([GOOD, GOOD.but(object_index=TOOL), GOOD.but(T_world_hand=OUT_OF_THE_WAY)])
    evaluator = staged_evaluator()
    plain = evaluator.score(T_obj_ee, T_world_ee, trials, stages)
    assert_same(
        plain, evaluator.score(T_obj_ee.clone().requires_grad_(), T_world_ee.clone().requires_grad_(), trials, stages)
    )

    def strided(x: torch.Tensor) -> torch.Tensor:
        wide = torch.zeros(len(x), 2, *x.shape[1:], dtype=x.dtype)
        wide[:, 1] = x
        return wide[:, 1]

    def transposed(T: torch.Tensor) -> torch.Tensor:
        return T.transpose(1, 2).contiguous().transpose(1, 2)

    other = Trials(
        strided(trials.trial_id),
        strided(trials.object_index),
        strided(trials.hand_index),
        transposed(trials.T_world_hand),
    )
    assert not other.T_world_hand.is_contiguous()
    assert_same(plain, evaluator.score(transposed(T_obj_ee), strided(T_world_ee), other, stages))
    assert not plain.path.requires_grad and not plain.margin.requires_grad
