"""`why` of a failed plan names the pair that its margin is about, as page and picture do."""

import dataclasses

import numpy as np
import pytest
from made_runs import write_run

from r2h_batch.__main__ import main
from r2h_batch.runs import load_run
from r2h_batch.runs.files import RunError
from r2h_batch.view import explain
from r2h_batch.view.drawing import Drawing
from r2h_batch.view.stored import Reader


def test_why_of_a_failed_plan_says_what_its_picture_shows(run, capsys):
    reader = Reader(run)
    rows = [r for r in reader.rows("random").to_pylist() if r["outcome"] == "plan"]
    assert rows
    for row in rows[:3]:
        trial = row["trial_id"]
        assert main(["why", str(run), str(trial), "--method", "random"]) == 0
        said = capsys.readouterr().out
        assert Drawing(reader.trial(trial, "random")).witness.caption in said
        assert said == f"{explain(load_run(run), trial, 'random')}\n"  # Python says the same
        assert "criterion:  plan" in said and f"{1e3 * row['margin_plan_m']:+.1f} mm" in said


@pytest.mark.parametrize(
    ("typed", "near"), [("contakt", "contact"), ("handover-vs", "handover-va"), ("Lerned", "Learned")]
)
def test_a_method_that_a_run_does_not_have_is_compared_with_names_and_words(tmp_path, typed, near):
    def function(word):
        return {"function": f"r2h_batch.methods.{word.replace('-', '_')}:predict"}

    run = write_run(
        tmp_path / "run", {"Contact-Handover (VoxNet)": np.zeros(4, int), "Learned": np.zeros(4, int)}, 2, 2
    )
    run = dataclasses.replace(
        run,
        entries=tuple(
            dataclasses.replace(entry, source=function(word))
            for entry, word in zip(run.entries, ("contact", "handover-va"), strict=True)
        ),
    )
    with pytest.raises(RunError, match=rf"no method '{typed}', did you mean {near}\?; it has"):
        run.named(typed)
