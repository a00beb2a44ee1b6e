"""Strips: pictures of the executed motion show robot, object and hand where they are, and their titles say what came of it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from needs import needs
from problems import default_evaluator, make_batch
from staging import Staged, batch_of, frame, hold_across, staged_evaluator

from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator

# _times: no public way to the times that a strip shows, it has pictures only
from r2h_batch.export.pictures import _times, strips, verdict
from r2h_batch.motion.execute import Executed
from r2h_batch.types import Outcome, Predictions

X, Y, Z = np.eye(3)


def prediction(T_obj_ee: torch.Tensor, T_world_ee: torch.Tensor, trial_id: torch.Tensor, name: str) -> Predictions:
    return Predictions(trial_id, T_obj_ee, T_world_ee, method=name)


@cache
def drawn():
    """A handover that works and one whose gripper stays out of reach of the hand, of the same trial."""
    good = Staged()
    far = good.but(T_world_ee=frame(X, Y, np.array([0.5, 0.0, 0.58])))
    answers = []
    for name, row in (
        ("good", good),
        ("far", far),
        ("unreachable", good.but(T_world_ee=frame(X, Y, np.array([2.0, 0, 0.5])))),
    ):
        g, h, trial = batch_of([row])
        answers.append(prediction(g, h, trial.trial_id, name))
    return strips(staged_evaluator(), trial, answers, frames=3, size=(160, 120))


def share(image: np.ndarray, rgb: tuple[float, float, float]) -> float:
    """Share of pixels of about this hue."""
    x = image.astype(float) + 1e-9
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return float((x @ (np.array(rgb) / np.linalg.norm(rgb)) > 0.985).mean())


@needs("gl")
def test_strips_show_robot_object_and_hand_and_what_came_of_them():
    good, far, none = drawn()
    assert [s.method for s in (good, far, none)] == ["good", "far", "unreachable"]
    assert (
        good.outcome == Outcome.SUCCESS
        and good.verdict.startswith("success, ")
        and good.images.shape == (3, 120, 160, 3)
    )
    assert far.outcome == Outcome.REACH and far.verdict.startswith("Reach fails by ")
    assert none.outcome == Outcome.PLAN and none.verdict == "Plan fails: ik unreachable" and len(none.images) == 1
    for strip in (good, far, none):
        for image in strip.images:
            assert share(image, (0.16, 0.44, 0.70)) > 0.001 and share(image, (0.87, 0.68, 0.56)) > 0.001
    for strip in (good, far):
        assert np.abs(np.diff(strip.images.astype(int), axis=0)).mean((1, 2, 3)).min() > 1.0  # it moves
        assert strip.time_s[0] == 0 and np.all(np.diff(strip.time_s) > 0)


def test_times_end_at_rest_and_hold_the_touch_where_safe_fails():
    evaluator = default_evaluator()
    batch = make_batch(evaluator.scene, 1)
    scores = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials)
    path = torch.zeros(1, 101, 6)
    one = torch.ones(1)
    length = torch.tensor([101], dtype=torch.int32)
    rest = Executed(
        path, length, t_exec_s=one * 0.7, settled=one.bool(), valid=one.bool(), slack_m=one * 0,
        slack_with_object_m=one * 0, deviation_m=one * 0, recorded=length, sample_s=0.008,
    )  # fmt: skip
    np.testing.assert_allclose(_times(replace(scores, outcome=torch.tensor([0])), rest, 3), [0, 0.35, 0.7], atol=1e-7)
    touched = replace(scores, outcome=torch.tensor([int(Outcome.SAFE)]), witness_time_s=torch.tensor([0.4]))
    np.testing.assert_allclose(_times(touched, rest, 3), [0, 0.4, 0.7], atol=1e-7)
    restless = replace(rest, settled=~one.bool())
    np.testing.assert_allclose(_times(replace(scores, outcome=torch.tensor([2])), restless, 2), [0, 0.8], atol=1e-7)
    still = replace(rest, length=torch.zeros(1, dtype=torch.int32))
    assert _times(scores, still, 5).tolist() == [0.0]


def test_a_verdict_names_the_first_failure_and_its_cause():
    evaluator = default_evaluator()
    batch = make_batch(evaluator.scene, 1)
    scores = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials)
    parts = evaluator.scene.part_names
    safe = replace(
        scores, outcome=torch.tensor([int(Outcome.SAFE)]), witness_time_s=torch.tensor([4.21]),
        witness_part=torch.tensor([[-1, parts.index("left_pad")]]),
    )  # fmt: skip
    assert verdict(safe, parts) == "Safe fails: left pad meets the hand at 4.2 s"
    wide = replace(scores, outcome=torch.tensor([1]), margin=torch.tensor([[-0.0123, 0, 0, 0, 0]]))
    assert verdict(wide, parts) == "Stability fails by 12.3 mm"
    blocked = replace(scores, outcome=torch.tensor([2]), plan_reason=torch.tensor([3]), plan_pair=torch.tensor([4]))
    assert verdict(blocked, parts) == "Plan fails: ik in collision (object, hand)"
    assert verdict(replace(scores, outcome=torch.tensor([int(Outcome.INVALID_SIM)])), parts) == "invalid sim"


def test_what_cannot_be_shown_is_refused():
    g, h, trial = batch_of([Staged(T_obj_ee=hold_across(-0.07))])
    kinematic = Evaluator(EvalConfig(execute=ExecConfig(sim="none")))
    with pytest.raises(ValueError, match=r"ExecConfig\.sim is 'none'"):
        strips(kinematic, trial, [prediction(g, h, trial.trial_id, "x")])
    with pytest.raises(ValueError, match="one trial; 2 trials"):
        strips(staged_evaluator(), trial[torch.tensor([0, 0])], [prediction(g, h, trial.trial_id, "x")])
