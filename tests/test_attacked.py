"""What somebody who had not written the commands broke: outputs over runs, links, pipes, stray files, Ctrl-C."""

import os

import pytest
from made_runs import write

from r2h_batch.benchmark.given import _objects_of  # no public way to a folder's files without building its meshes
from r2h_batch.command_line import answer, write_answer
from r2h_batch.files import FileError
from r2h_batch.files.plain_yaml import read_plain_yaml
from r2h_batch.gallery.command import report_main as report
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
