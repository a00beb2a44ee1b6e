"""A run as one file that holds when it is judged again. What a page of such files says: test_leaderboard.py."""

import re
import shutil
import zipfile

import pytest
from made_runs import forged

from r2h_batch.__main__ import main
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.command import main as sweep


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    place = tmp_path_factory.mktemp("submission")
    run = place / "mine"
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "random",
        "--trials",
        "3",
        "--sim",
        "none",
        "--shard-trials",
        "2",
        "--out",
        str(run),
    ]
    assert sweep(line) == 0
    assert main(["submit", str(run), "--rows", "4"]) == 0
    return place / "mine.zip"


def changed(bundle, out, change):
    """A copy of a bundle; `change(name, data)` gives a member's name and bytes."""
    with zipfile.ZipFile(bundle) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            new.writestr(*change(name, old.read(name)))
    return out


def test_a_submission_is_listed_with_the_rows_that_it_had(bundle, tmp_path, capsys):
    assert main(["leaderboard", str(bundle), "--rows", "4", "--out", str(tmp_path / "board.html")]) == 0
    page = (tmp_path / "board.html").read_text()
    assert re.search(r"<td class=l>random</td><td class=l>mine</td>", page)
    with zipfile.ZipFile(bundle) as archive:
        archive.extractall(tmp_path / "out")
    again, before = load_run(tmp_path / "out" / "run"), load_run(bundle.with_suffix(""))
    assert again.digest("random") == before.digest("random") and "README.md" in str(
        list((tmp_path / "out" / "run").iterdir())
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda n, d: (n, d[:-9] + bytes([d[-9] ^ 1]) + d[-8:] if "shards/" in n else d), "sha256"),
        (lambda n, d: (n.replace("run/table.md", "run/../table.md"), d), "points outside the archive"),
        (lambda n, d: (n.replace("run/table.md", "run/" + "x" * 1000), d), "longer name than 1000 letters"),
        (lambda n, d: (n.replace("run/table.md", "run/" + "a/" * 40 + "x"), d), "deeper than 32 folders"),
        (lambda n, d: (n.replace("run/table.md", "table.md"), d), "r2h-batch submit writes run/..."),
    ],
)
def test_what_does_not_hold_is_named_and_left_out(bundle, tmp_path, capsys, change, words):
    bad = changed(bundle, tmp_path / "bad.zip", change)
    assert main(["leaderboard", str(tmp_path), "--rows", "2", "--out", str(tmp_path / "board.html")]) == 1
    error = capsys.readouterr().err
    assert f"{bad} is left out: " in error and words in error and not (tmp_path / "board.html").exists()
    assert not (tmp_path.parent / "table.md").exists()


def test_a_forged_row_is_found_by_judging_it_again(bundle, tmp_path, capsys):
    def reaches_further(row):
        row["margin_reach_m"] += 0.005 if row["passed_reach"] else 0.0
        return bool(row["passed_reach"])

    other = tmp_path / "forged"
    assert forged(bundle.with_suffix(""), other, reaches_further)
    assert main(["leaderboard", str(bundle), str(other), "--rows", "6", "--out", str(tmp_path / "board.html")]) == 1
    assert "forged is left out: random" in capsys.readouterr().err and (tmp_path / "board.html").exists()
    assert main(["submit", str(other), "--rows", "6"]) == 2
    assert "cannot be submitted" in capsys.readouterr().err


def test_a_run_that_cannot_be_written_into_is_submitted(bundle, tmp_path):
    run = shutil.copytree(bundle.with_suffix(""), tmp_path / "run")
    (run / "README.md").unlink()
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()}
    assert main(["submit", str(run), "--rows", "2", "--out", str(tmp_path / "theirs.zip")]) == 0
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()} == before
    with zipfile.ZipFile(tmp_path / "theirs.zip") as archive:
        assert "run/README.md" in archive.namelist()
