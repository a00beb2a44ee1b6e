"""Which trials stand for the others, and that a report's pictures open the pages of their trials."""

from types import SimpleNamespace

import numpy as np
import pytest
from made_runs import write_run

from r2h_batch.__main__ import main
from r2h_batch.runs.store import load_run
from r2h_batch.verdicts import Outcome
from r2h_batch.view.gallery import pictures
from r2h_batch.view.gallery.pictures import first_of_each_outcome

OUTCOMES = np.array([0, 0, 0, 0, 2, 2, 3, int(Outcome.INVALID_SIM), 0, 1, 4, 5])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    names = {"m": OUTCOMES, "<b>n</b>": np.where(np.arange(12) == 7, 0, OUTCOMES[::-1] % 4)}
    return write_run(tmp_path_factory.mktemp("gallery") / "run", names, 6, 6, shard_trials=5)


@pytest.mark.check
def test_each_outcome_is_represented_by_its_first_trials_of_different_objects(run):
    assert first_of_each_outcome(run, "m", 1) == {
        "success": [0],
        "stability": [9],
        "plan": [4],
        "reach": [6],
        "affordance": [10],
        "safe": [11],
    }
    found = first_of_each_outcome(run, "m", 3)
    assert found["success"] == [0, 1, 2]  # bowl, cup, eyeglasses; trial 3 is a bowl again
    assert found["plan"] == [4, 5] and "missing" not in found


def test_pictures_of_a_report_open_the_pages_of_their_trials(run, tmp_path, capsys, monkeypatch):
    def page(stored, file):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"trial {stored.row['trial_id']}")
        return file

    asked = SimpleNamespace(nearest=SimpleNamespace(kind="object_hand", part="object", other="hand"))

    class Reader:
        def __init__(self, folder, code):
            assert code == ()
            self.run = load_run(folder)

        def trial(self, trial, method):
            rows = self.run.trials(method).to_pylist()
            row = next(r for r in rows if r["trial_id"] == trial)
            return SimpleNamespace(row=row, asked=asked, head_clearance_m=0.0)

    monkeypatch.setattr("r2h_batch.view.stored.Reader", Reader)
    monkeypatch.setattr("r2h_batch.scene.offscreen.ready", lambda: "none")
    monkeypatch.setattr(pictures, "write_page", page)
    monkeypatch.setattr(pictures, "Drawing", lambda stored: stored)
    monkeypatch.setattr(pictures, "image_at_end", lambda drawing, size, close: np.zeros((8, 8, 3), np.uint8))
    out = tmp_path / "a" / "report.html"
    line = [str(run.folder), "--format", "html", "--gallery", "1", "--out", str(out)]
    assert main(["report", *line]) == 0 and capsys.readouterr().out == f"{out}\n"
    text = out.read_text()
    links = [part.partition('"')[0] for part in text.split('<a href="')[1:]]
    assert len(set(links)) == 6 + 4 and len(links) == 6 + 4 + 3  # three of them stand above the tables too
    assert all((out.parent / link).is_file() for link in links)
    assert text.count("data:image/jpeg;base64,") == len(links) and "<b>n</b>" not in text
    assert text.count("</code></figcaption>") == len(set(links))
    assert f"<code>r2h-batch view {run.folder} --method m --trial 4</code>" in text
    assert "4 cup: plan fails: every posture at the target collides (object and hand)" in text and "6 knife" not in text
    second = write_run(tmp_path / "second", {"other": OUTCOMES}, 6, 6)
    both, runs = tmp_path / "both.html", [str(run.folder), str(second.folder)]
    line = ["--format", "html", "--gallery", "1", "--out", str(both)]
    assert main(["report", *runs, *line]) == 0
    links = [part.partition('"')[0] for part in both.read_text().split('<a href="')[1:]]
    # three of them stand above the tables too
    assert len(links) > 10 and len(set(links)) == len(links) - 3 and all((tmp_path / link).is_file() for link in links)
    assert {link.split("/")[1] for link in links} == {"1", "2"}
    assert f"r2h-batch view {second.folder} --method other --trial" in both.read_text()


def test_what_a_gallery_needs_is_said_in_one_line(run, tmp_path, capsys):
    for line, words in (
        (["--gallery", "2"], "--gallery needs --format html and --out FILE.html"),
        (
            ["--format", "html", "--gallery", "99", "--out", str(tmp_path / "x.html")],
            "--gallery is 99; it must be 0 to 20",
        ),
    ):
        assert main(["report", str(run.folder), *line]) == 2
        assert words in capsys.readouterr().err
    assert main(["report", str(run.folder), "--format", "csv", "--out", str(tmp_path / "t.csv")]) == 0
    assert (tmp_path / "t.csv").read_text().startswith("split,method,n,")
