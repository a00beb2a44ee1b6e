"""What a method may read: by its arguments, as it declares, as its file says; in every table and in the run folder."""

import json

import numpy as np
import pytest
from made_runs import made_trials, make_predictions, write_run

from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError
from r2h_batch.base.registry import METHOD_NAMES, READS
from r2h_batch.methods import method
from r2h_batch.report.compare.text import FORMATS
from r2h_batch.report.table import brief, render, table_of
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.jobs import method_reads
from r2h_batch.trials.predictions import load_answers, write_predictions

MINE = """
from r2h_batch.methods import method, random


def rule(trials, scene, *, seed=0):
    return random.predict(trials, scene, seed=seed)


def guess(trials, scene, *, noise):
    return rule(trials, scene)


@method(reads="estimates")
def says(trials, scene, *, noise):
    return rule(trials, scene)


def asks(trials, scene, *, evaluator):
    return rule(trials, scene)


@method(reads="cloud")
def points(trials, scene):
    return rule(trials, scene)


@method(reads="cloud")  # the argument says more
def claims(trials, scene, *, evaluator):
    return rule(trials, scene)
"""


@pytest.mark.parametrize(
    ("function", "word"),
    [
        ("rule", "scene"),
        ("guess", "scene"),
        ("says", "estimates"),
        ("asks", "judge"),
        ("points", "cloud"),
        ("claims", "judge"),
    ],
)
def test_a_function_reads_what_its_arguments_are_or_what_it_declares(function, word, tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    spec = f"{tmp_path / 'mine.py'}:{function}"
    assert method_reads(spec) == word


def test_a_function_that_is_shown_what_cameras_see_reads_cameras(tmp_path):
    (tmp_path / "mine_sees.py").write_text("def looks(seen):\n    return seen\n")
    assert method_reads(f"{tmp_path / 'mine_sees.py'}:looks", seeing=True) == "cameras"


def test_built_in_methods_read_what_their_runs_of_before_are_said_to_have_read(tmp_path):
    for name in METHOD_NAMES:
        run = write_run(tmp_path / name, {"m": np.zeros(4, int)}, 2, 2)
        path = run.folder / "methods" / "m.json"
        source = {"kind": "method", "function": f"r2h_batch.methods.{name.replace('-', '_')}:predict"}
        path.write_text(json.dumps({**json.loads(path.read_text()), "source": source}))
        assert load_run(run.folder).entry("m").reads == method_reads(name), name


@pytest.mark.parametrize("word", ["scan", "", "Scene"])
def test_another_word_is_refused(word):
    with pytest.raises(ValueError, match=r"reads is .*scene, estimates, cloud, cameras, judge"):
        method(reads=word)


@pytest.mark.parametrize("word", [*READS, ""])
def test_a_file_says_it_and_one_of_another_word_is_refused(word, tmp_path):
    file, poses = tmp_path / "mine.npz", make_predictions(made_trials(2, 2))
    write_predictions(file, poses, reads=word)
    assert load_answers(file).reads == word
    with np.load(file) as arrays:
        np.savez(tmp_path / "wrong.npz", **{**arrays, "reads": np.array("camera")})
    with pytest.raises(FileError, match=r"reads is 'camera', did you mean cameras.*allowed are scene"):
        load_answers(tmp_path / "wrong.npz")


def test_every_table_has_the_word_of_each_method(tmp_path, capsys):
    run = write_run(tmp_path / "run", {"mine": np.zeros(60, int), "other": np.zeros(60, int)}, 30, 30)
    path = run.folder / "methods" / "mine.json"
    source = {"kind": "predictions", "reads": "cloud"}
    path.write_text(json.dumps({**json.loads(path.read_text()), "source": source}))
    run = load_run(run.folder)
    table = table_of(run)
    assert [table.reads[m] for m in ("mine", "other")] == ["cloud", run.entry("other").reads]
    assert brief(table).count("cloud") == 3
    for form in FORMATS:
        assert "cloud" in render(table, form), form
        for more in ([], ["--full"]):
            assert main(["compare", str(run.folder), "--format", form, *more]) == 0
            assert "cloud" in capsys.readouterr().out, (form, more)
    page = tmp_path / "page.html"
    assert main(["report", str(run.folder), "--format", "html", "--out", str(page)]) == 0
    assert page.read_text().count("<td class=l>cloud</td>") == 1 + 3  # overview and Table I
    rows = json.loads(render(table, "json"))["rows"]
    assert {r["reads"] for r in rows if r["method"] == "mine"} == {"cloud"}


def test_a_run_of_before_is_gone_on_with(tmp_path):
    from r2h_batch.runs.writing import open_run

    run = write_run(tmp_path / "run", {"m": np.zeros(4, int)}, 2, 2)
    folder, source = open_run(run.folder, run.header), run.entry("m").source
    assert "reads" not in source
    assert folder.register("m", {**source, "reads": "scene"}) is False
