"""`why` of a failed plan names the pair that its margin is about, as page and picture do."""

from r2h_batch.__main__ import main
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
        assert "criterion:  plan" in said and f"{1e3 * row['margin_plan_m']:+.1f} mm" in said
