"""Batches printed in a terminal, a notebook and a logger: short, true, and without a second evaluation."""

import pytest
from needs import needs
from problems import default_evaluator, make_batch

from r2h_batch import CRITERIA, Outcome


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
