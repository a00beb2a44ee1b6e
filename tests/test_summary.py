"""What batches look like in a terminal, a notebook and a logger: short, true, and without a second evaluation."""

import copy
import math
import pickle

import pytest
import torch
from needs import needs
from problems import default_evaluator, make_batch

from r2h_batch import CRITERIA, Outcome, Scores, make_trials


@pytest.fixture(scope="module")
def scores():
    batch = make_batch(default_evaluator().scene, 24)
    return default_evaluator().score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages="pose")


@pytest.mark.check
def test_representations_are_short_and_say_what_is_in_them(scores):
    trials, evaluator = make_trials(["S0", "S1"], 20), default_evaluator()
    for thing, words in (
        (scores, ("Scores(24 rows on cpu", f"success {100 * float(scores.success.float().mean()):.1f} %")),
        (scores[3], ("1 row on cpu",)),
        (scores.by_trial(4), ("6 x 4 rows",)),
        (scores[:0], ("0 rows on cpu",)),
        (trials, ("40 on cpu", "20 of S0, 20 of S1", "16 objects")),
        (evaluator.scene, ("Scene(cpu, 16 objects (6 of S0, 10 of S1)", "hands")),
        (evaluator, ("Evaluator(cpu, 16 objects", "preset default")),
    ):
        assert len(repr(thing)) < 200 and "\n" not in repr(thing)
        assert all(word in repr(thing) for word in words), repr(thing)
        assert "<table>" in thing._repr_html_() and len(thing._repr_html_()) < 5000
    assert scores.summary().count("\n") == 6 and max(map(len, scores.summary().splitlines())) < 110


def test_scalars_are_the_rates_and_means_of_the_rows(scores):
    told = scores.scalars()
    assert all(type(v) is float and math.isfinite(v) for v in told.values())
    assert told["success"] == pytest.approx(float(scores.success.float().mean()))
    assert sum(v for k, v in told.items() if k.startswith("outcome/")) == pytest.approx(1)
    margin, seen = scores.margin[:, 2], scores.evaluated[:, 2]
    assert told["margin_m/reach"] == pytest.approx(float(margin[seen].mean()), rel=1e-5)
    assert scores.by_trial(6).scalars() == told and scores[:0].scalars() == {}
    assert "t_exec_s" not in told  # nothing moved


@needs("pandas")
def test_a_frame_has_the_columns_of_a_run_folder(scores):
    frame = scores.to_pandas()
    assert len(frame) == 24 and list(frame["trial_id"]) == scores.trial_id.tolist()
    assert (frame["outcome"] == [Outcome(o).name.lower() for o in scores.outcome.tolist()]).all()
    assert frame["passed_affordance"].isna().sum() == int((~scores.evaluated[:, 3]).sum())
    assert len(scores.by_trial(4).to_pandas()) == 24
    trials = scores.inputs.trials
    assert list(frame["object"]) == trials.named(default_evaluator().scene.objects).object_names
    assert list(frame["split"]) == trials.splits and set(frame["side"]) <= {"left", "right"}
    for name in CRITERIA:
        assert ((frame["outcome"] == name) == scores.failed(name).numpy()).all()
    with pytest.raises(ValueError, match="criterion is 'plam'"):
        scores.failed("plam")


def test_trials_know_their_objects_and_keep_them_through_selection_and_copies():
    trials = make_trials(["S0", "S1"], 20)
    names = trials.object_names
    assert names == [default_evaluator().scene.objects[i].name for i in trials.object_index.tolist()]
    assert trials.splits == ["S0"] * 20 + ["S1"] * 20
    assert trials[torch.tensor([5, 25])].object_names == [names[5], names[25]]
    assert trials.to("cpu").clone()[3].object_names == [names[3]] == pickle.loads(pickle.dumps(trials))[3].object_names
    bare = type(trials)(trials.trial_id, trials.object_index, trials.hand_index, trials.T_world_hand)
    with pytest.raises(ValueError, match=r"trials\.named"):
        _ = bare.object_names
    assert bare.named(default_evaluator().scene.objects).object_names == names


def test_scores_keep_their_inputs_and_copies_hold_numbers_alone(scores):
    batch = make_batch(default_evaluator().scene, 24)
    one = scores[torch.tensor([7])]
    assert (
        torch.equal(one.inputs.T_obj_ee, batch.T_obj_ee[7:8])
        and one.inputs.trials.trial_id.tolist() == one.trial_id.tolist()
    )
    assert one.inputs.evaluator is default_evaluator() and scores.clone().inputs is not None
    assert pickle.loads(pickle.dumps(scores)).inputs is None and copy.deepcopy(scores).inputs is None
    assert Scores.concatenate([scores, scores]).inputs is None


@needs("viser")
def test_a_row_of_scores_is_shown_in_a_notebook_as_it_was_judged():
    from r2h_batch import show

    evaluator = default_evaluator()
    batch = make_batch(evaluator.scene, 8)
    scores = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials)
    shown = show(scores[2])
    assert shown.trial.note == "" and shown.trial.row["outcome"] == Outcome(int(scores.outcome[2])).name.lower()
    assert shown._repr_html_().startswith("<iframe") and "srcdoc=" in shown._repr_html_() and len(repr(shown)) < 100
    for wrong, said in ((scores, r"show\(scores\[0\]\)"), (pickle.loads(pickle.dumps(scores[2])), "score again")):
        with pytest.raises(ValueError, match=said):
            show(wrong)
