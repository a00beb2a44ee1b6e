"""What somebody who had not written the commands broke: outputs over runs, links, pipes, stray files, Ctrl-C."""

import os
import sys
import warnings

import numpy as np
import pytest
from made_runs import write

from r2h_batch.benchmark.given import _objects_of  # no public way to a folder's files without building its meshes
from r2h_batch.command_line import answer, telling, write_answer
from r2h_batch.files import FileError
from r2h_batch.files.plain_yaml import read_plain_yaml
from r2h_batch.gallery.command import report_main as report
from r2h_batch.predictions import load_predictions
from r2h_batch.rescore.command import main as rescore
from r2h_batch.view.command import view


@pytest.fixture
def run(tmp_path):
    write(tmp_path / "run", shard_trials=12)
    return tmp_path / "run"


@pytest.mark.parametrize("name", ["run.json", "log.txt", "trials/m/mine.csv", ".hidden"])
def test_an_answer_never_takes_the_place_of_what_a_run_stores(run, name, capsys):
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    assert report([str(run), "--format", "csv", "--out", str(run / name)]) == 2
    assert "write elsewhere" in capsys.readouterr().err
    assert {p: p.read_bytes() for p in run.rglob("*") if p.is_file()} == before
    assert report([str(run), "--format", "csv", "--out", str(run / "table.csv")]) == 0


def test_a_link_is_replaced_and_a_pipe_or_folder_refused(run, tmp_path, capsys):
    precious = tmp_path / "precious.npz"
    precious.write_text("kept")
    (tmp_path / "link.csv").symlink_to(precious)
    assert report([str(run), "--format", "csv", "--out", str(tmp_path / "link.csv")]) == 0
    assert precious.read_text() == "kept" and not (tmp_path / "link.csv").is_symlink()
    os.mkfifo(tmp_path / "pipe.csv")
    for name in ("pipe.csv", "run"):
        assert report([str(run), "--format", "csv", "--out", str(tmp_path / name)]) == 2
    assert not list(tmp_path.glob(".*.tmp"))


def test_half_an_answer_is_none(tmp_path):
    (tmp_path / "page.html").write_text("old")
    with pytest.raises(UnicodeEncodeError):
        write_answer(tmp_path / "page.html", "new \ud800")
    assert (tmp_path / "page.html").read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_ctrl_c_is_one_line_and_130(capsys):
    def work():
        raise KeyboardInterrupt

    assert answer("figures", work) == 130
    assert capsys.readouterr().err == "figures: interrupted\n"


@pytest.mark.parametrize("port", [-1, 99999])
def test_a_port_that_is_none_is_refused_before_the_run_is_read(tmp_path, port, capsys):
    assert view(tmp_path / "none", port=port) == 2
    assert f"--port is {port}; it must be 0 (any free one) to 65535" in capsys.readouterr().err


def test_a_sidecar_that_is_about_no_mesh_is_refused(tmp_path):
    (tmp_path / "brick.stl").write_text("solid\nendsolid")
    for name in ("brick.yml", "Brick.yaml", "cup.yaml"):
        (tmp_path / name).write_text("split: S1")
        with pytest.raises(FileError, match="is about no mesh of this folder"):
            _objects_of(tmp_path, False)
        (tmp_path / name).unlink()


@pytest.mark.parametrize(("text", "value"), [("1e-3", 1e-3), ("8.5E-2", 0.085), ("-2e3", -2000.0)])
def test_a_number_with_an_exponent_is_a_number(tmp_path, text, value):
    (tmp_path / "a.yaml").write_text(f"scale: {text}\n")
    assert read_plain_yaml(tmp_path / "a.yaml") == {"scale": value}


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
            assert rescore([str(tmp_path / "new"), "--reach-radius", radius]) == 2
            assert "--reach-radius 1e+308 cannot be rescored exactly; allowed is 0 to 1e+06" in capsys.readouterr().err
