"""What somebody who had not written the commands broke: outputs over runs, links, pipes, stray files, Ctrl-C."""

import os
import re
import sys
import warnings

import numpy as np
import pytest
from made_runs import write

from r2h_batch.__main__ import main
from r2h_batch.bodies.objects import call_of
from r2h_batch.command_line import answer, telling
from r2h_batch.io.read import read_yaml
from r2h_batch.predictions import load_predictions
from r2h_batch.sweep.options import parse


@pytest.fixture
def run(tmp_path):
    write(tmp_path / "run", shard_trials=12)
    return tmp_path / "run"


@pytest.mark.parametrize("name", ["run.json", "trials/m/mine.csv", ".hidden"])
def test_an_answer_never_takes_the_place_of_what_a_run_stores(run, name, capsys):
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    assert main(["report", str(run), "--format", "csv", "--out", str(run / name)]) == 2
    assert "write elsewhere" in capsys.readouterr().err
    assert {p: p.read_bytes() for p in run.rglob("*") if p.is_file()} == before
    assert main(["report", str(run), "--format", "csv", "--out", str(run / "table.csv")]) == 0


def test_a_link_is_replaced_and_a_pipe_or_folder_refused(run, tmp_path, capsys):
    precious = tmp_path / "precious.npz"
    precious.write_text("kept")
    (tmp_path / "link.csv").symlink_to(precious)
    line = [str(run), "--format", "csv", "--out", str(tmp_path / "link.csv")]
    assert main(["report", *line]) == 2 and (tmp_path / "link.csv").is_symlink()
    assert main(["report", *line, "--overwrite"]) == 0
    assert precious.read_text() == "kept" and not (tmp_path / "link.csv").is_symlink()
    os.mkfifo(tmp_path / "pipe.csv")
    for name in ("pipe.csv", "run"):
        assert main(["report", str(run), "--format", "csv", "--out", str(tmp_path / name)]) == 2
    assert not list(tmp_path.glob(".*.tmp"))


WRITERS = {
    "report": ["report", "RUN", "--format", "csv", "--out"],
    "the report's page": ["report", "RUN", "--format", "html", "--out"],
    "view": ["view", "RUN", "--trial", "0", "--html"],
    "video": ["view", "RUN", "--trial", "0", "--video"],
    "strips": ["view", "RUN", "--trial", "0", "--method", "random", "--strips"],
    "scene": ["scene", "--run", "RUN", "--trial", "0", "--out"],
    "a scene's picture": ["scene", "--run", "RUN", "--trial", "0", "--out", "NEW", "--render"],
    "trials": ["trials", "--trials", "1", "--out"],
    "figures": ["figures", "RUN", "--out"],
    "the paper's study": ["study", "paper", "--box"],
    "ratings": ["study", "ratings", "RATINGS", "--box"],
    "a hand": ["import", "hand", "--mano-right", "NEW", "--out"],
    "hands": ["import", "hands", "--from", "built-in", "--out"],
    "grasps": ["import", "grasps", "NEW", "--from", "own", "--out"],
    "objects": ["import", "objects", "NEW", "--from", "oakink", "--out"],
}
ENDING = {
    "video": ".mp4",
    **dict.fromkeys(("strips", "a scene's picture"), ".png"),
    **dict.fromkeys(("the paper's study", "ratings"), ".svg"),
    **dict.fromkeys(("a hand", "hands", "grasps"), ".npz"),
}


@pytest.mark.parametrize("who", WRITERS)
def test_no_command_writes_over_what_is_there_unless_that_is_said(who, run, tmp_path, capsys):
    """Before any work: the inputs of some are missing, and that is not what is said."""
    (tmp_path / "ratings.csv").write_text("participant,method,dimension,rating\n1,a,comfort,3\n1,b,comfort,4\n")
    mine = tmp_path / f"mine{ENDING.get(who, '.txt')}"
    mine.write_text("precious")
    if who == "figures":
        mine = tmp_path / "folder"
        mine.mkdir()
        (mine / "methods.png").write_text("precious")
    names = {"RUN": run, "NEW": tmp_path / "new", "RATINGS": tmp_path / "ratings.csv"}
    line = [str(names.get(word, word)) for word in WRITERS[who]]
    assert main([*line, str(mine)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(
        r"is there already; give another name, or add --overwrite|is no folder; give a new or empty", error
    )
    kept = mine / "methods.png" if who == "figures" else mine
    assert kept.read_text() == "precious"
    long = tmp_path / f"{'a' * 300}{ENDING.get(who, '.txt')}"
    assert main([*line, str(long)]) == 2  # not 1: no disk will ever have it
    error = capsys.readouterr().err
    assert "File name too long" in error and error.count("\n") == 1


@pytest.mark.parametrize("who", ["strips", "a scene's picture", "ratings", "hands"])
def test_an_ending_that_nobody_writes_is_refused_before_any_work(who, run, tmp_path, capsys):
    names = {"RUN": run, "NEW": tmp_path / "new", "RATINGS": tmp_path / "ratings.csv"}
    line = [str(names.get(word, word)) for word in WRITERS[who]]
    assert main([*line, str(tmp_path / "s.txt")]) == 2
    error = capsys.readouterr().err
    assert re.search(r"s\.txt.*(ending must be|ends in) .*\.(png|svg|npz)", error) and error.count("\n") == 1


def test_overwrite_replaces_and_an_empty_file_is_nothing_to_lose(run, tmp_path):
    line = ["report", str(run), "--format", "csv", "--out", str(tmp_path / "t.csv")]
    (tmp_path / "t.csv").touch()
    assert main(line) == 0 and main(line) == 2
    (tmp_path / "t.csv").write_text("old")
    assert main([*line, "--overwrite"]) == 0 and (tmp_path / "t.csv").read_text().startswith("split,")


PLAIN = {
    "sweep --method random --trials 1_0": "--trials: '1_0' is no whole number; write decimal digits",
    "sweep --method random --ray-timeout inf": "--ray-timeout: 'inf' is no plain number",
    "results rethreshold x --reach-radius 1_0": "--reach-radius is '1_0'; it must be METRES, A,B,... or LOW:HIGH:STEP ",
    "import hands --from h2o --frame ٣ --out o.npz x": "it must be aperture, first, middle, last or a whole number in decimal",
    "compare baselines --seed -5": "--seed is -5; it must be 0 or more and fit 64 bits",
    "sweep --method random --out=~nobody-is-called-so/x": "there is no user with this home",
    "sweep --method random --no-poses --save-poses": "--no-poses stores no poses, --save-poses stores them; leave one",
    "trials --trials 1000000000000 --out x": "--trials is 1000000000000; it must be 1 to 1000000: all are held in memory",
    "view none --port 99999": "--port is 99999; it must be 0 to 65535; 0 takes any free one",
    "sweep --method random --out r\udcff": "r\\udcff: has a byte that is no UTF-8; rename the file",
}


@pytest.mark.parametrize("line", PLAIN)
def test_numbers_and_choices_of_a_command_line_are_plain(line, run, capsys):
    assert main([str(run) if word == "RUN" else word for word in line.split()]) == 2
    error = capsys.readouterr().err
    assert PLAIN[line] in error and error.count("\n") == 1, error


def test_the_home_folder_is_meant_by_a_wave_in_every_argument_and_field(run, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert main(["report", "~/run", "--format", "csv", "--out=~/t.csv"]) == 0 and (tmp_path / "t.csv").is_file()
    (tmp_path / "c.yaml").write_text("method: [random]\nout: ~/r\ngrasps: ['cup=~/g.npz']\n")
    options = parse(["--config", str(tmp_path / "c.yaml"), "--object-mesh", "~/a.obj:S1"])
    assert options.out == f"{tmp_path}/r" and options.grasps == (f"cup={tmp_path}/g.npz",)
    assert options.object_mesh == (f"{tmp_path}/a.obj:S1",)


def test_a_current_folder_that_is_gone_or_has_no_name_is_said(tmp_path, monkeypatch, capsys):
    (tmp_path / "odd\udcff").mkdir()
    monkeypatch.chdir(tmp_path / "odd\udcff")
    assert main(["sweep", "--method", "random"]) == 2
    assert "odd\\udcff: has a byte that is no UTF-8; work in another folder" in capsys.readouterr().err
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    for line in (["report", "x"], ["sweep", "--method", "random"], ["results", "digest", "x"]):
        assert main(line) == 2
        assert "the current folder is gone or closed" in capsys.readouterr().err


def test_ctrl_c_is_one_line_and_130(capsys):
    def work():
        raise KeyboardInterrupt

    assert answer("figures", work) == 130
    assert capsys.readouterr().err == "figures: interrupted\n"


@pytest.mark.parametrize(("text", "value"), [("1e-3", 1e-3), ("8.5E-2", 0.085), ("-2e3", -2000.0)])
def test_a_number_with_an_exponent_is_a_number(tmp_path, text, value):
    (tmp_path / "a.yaml").write_text(f"scale: {text}\n")
    assert read_yaml(tmp_path / "a.yaml") == {"scale": value}


@pytest.mark.parametrize(
    ("flags", "said"),
    [((), "figures: mug: repaired \\x1b[2J\n"), (("quiet",), ""), (("verbose",), "overflow encountered")],
)
def test_a_warning_is_one_line_without_the_source_that_warns(flags, said, capsys, monkeypatch):
    def shown(message, category, filename, lineno, file=None, line=None):  # as outside pytest, which records them
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))

    monkeypatch.setattr(warnings, "showwarning", shown)

    def work():
        warnings.warn("mug:\n repaired \x1b[2J", stacklevel=1)
        return int(np.isfinite(np.float64(1e300).astype(np.float32)))

    with telling(**dict.fromkeys(flags, True)), warnings.catch_warnings():
        warnings.simplefilter("always")
        assert answer("figures", work) == 0
    error = capsys.readouterr().err
    assert said in error and "test_attacked.py" not in error and error.count("\n") <= 1 + ("verbose" in flags)
    assert ("overflow" in error) == ("verbose" in flags)


def test_numbers_that_float32_does_not_hold_are_no_pose_and_no_threshold(run, tmp_path, capsys):
    T = np.eye(4)[None].repeat(2, 0)
    far = np.where(np.arange(4) == 3, 1e300, T)
    np.savez(tmp_path / "p.npz", trial_id=np.arange(2), T_obj_ee=T, T_world_ee=far)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isinf(load_predictions(tmp_path / "p.npz").T_world_ee.numpy()).any()
        write(
            tmp_path / "new",
            configuration={"thresholds": {"reach_radius_m": 0.1, "w_max_m": 0.085, "safe_margin_m": 0.0}},
        )
        for radius in ("1e308", "1e308:1e308:1"):
            assert main(["results", "rethreshold", str(tmp_path / "new"), "--reach-radius", radius]) == 2
            assert "--reach-radius 1e+308 cannot be rescored exactly; allowed is 0 to 1e+06" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("box.obj:", "what stands behind box.obj is ''; expected FILE, FILE:S0, FILE:S1 or FILE:S1:RECEIVER"),
        ("x\ny.obj", "has a line end in its name"),
    ],
)
def test_what_stands_behind_a_mesh_is_named_when_it_is_wrong(argument, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        call_of(argument)
    assert call_of("box.obj:S1:x<0.4")["receiver"] == "x<0.4" and call_of("box.obj:S1")["split"] == "S1"
