"""What batches look like in a terminal, a notebook and a logger: short, true, and without a second evaluation."""

import pickle

import pytest
import torch
from needs import needs
from problems import default_evaluator, make_batch

from r2h_batch import CRITERIA, Outcome, make_trials


@pytest.fixture(scope="module")
def scores():
    batch = make_batch(default_evaluator().scene, 24)
    return default_evaluator().score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages="pose")


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
