"""Attacks by somebody who had not written the commands: outputs over runs, links, pipes, stray files, Ctrl-C."""

import re
import warnings

import numpy as np
import pytest
from made_runs import write

from r2h_batch.__main__ import main
from r2h_batch.base.command_line import exit_code_of
from r2h_batch.trials.predictions import load_predictions


@pytest.fixture
def run(tmp_path):
    write(tmp_path / "run", shard_trials=12)
    return tmp_path / "run"


WRITERS = {
    "report": ["report", "RUN", "--format", "csv", "--out"],
    "view": ["view", "RUN", "--trial", "0", "--html"],
    "strips": ["view", "RUN", "--trial", "0", "--method", "random", "--strips"],
    "scene": ["export", "scene", "RUN", "--trial", "0", "--out"],
    "a scene's picture": ["export", "scene", "RUN", "--trial", "0", "--out", "NEW", "--render"],
    "trials": ["export", "trials", "--trials", "1", "--out"],
    "a hand": ["import", "hand", "--mano-right", "NEW", "--out"],
    "grasps": ["import", "grasps", "NEW", "--from", "own", "--out"],
    "objects": ["import", "objects", "NEW", "--from", "oakink", "--out"],
}
ENDING = {
    **dict.fromkeys(("strips", "a scene's picture"), ".png"),
    **dict.fromkeys(("a hand", "grasps"), ".npz"),
}


@pytest.mark.parametrize("who", WRITERS)
def test_no_command_writes_over_what_is_there_unless_that_is_said(who, run, tmp_path, capsys):
    """Before any work: the inputs of some are missing, and that is not what is said."""
    mine = tmp_path / f"mine{ENDING.get(who, '.txt')}"
    mine.write_text("precious")
    names = {"RUN": run, "NEW": tmp_path / "new"}
    line = [str(names.get(word, word)) for word in WRITERS[who]]
    assert main([*line, str(mine)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(
        r"is there already; give another name, or add --overwrite|is not a folder; give a new or empty", error
    )
    assert mine.read_text() == "precious"
    long = tmp_path / f"{'a' * 300}{ENDING.get(who, '.txt')}"
    assert main([*line, str(long)]) == 2  # not 1: no disk will ever have it
    error = capsys.readouterr().err
    assert "File name too long" in error and error.count("\n") == 1


def test_ctrl_c_is_one_line_and_130(capsys):
    def work():
        raise KeyboardInterrupt

    assert exit_code_of("view", work) == 130
    assert capsys.readouterr().err == "view: interrupted\n"


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
