"""`sweep --receiver-motion --policy`: what is stored and printed beside the verdicts, which stay."""

from functools import partial

from r2h_batch.closed_loop.env import LoopConfig
from r2h_batch.report.closed_loop import render
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.command import main

BASE = ["--benchmark", "r2h-v1", "--method", "random", "--trials", "1", "--execute.sim", "none", "--quiet"]


def sweep(folder, *more):
    return main([*BASE, "--out", str(folder), *more])


def test_trials_that_begin_on_the_table_are_refused_before_one_is_judged(tmp_path, capsys):
    line = ["--benchmark", "r2h-v3", "--method", "random", "--trials", "1", "--receiver-motion", "moves"]
    assert main([*line, "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "trials of r2h-v3 begin on the table" in said and "r2h_batch/Handover-v3" in said
    assert not (tmp_path / "run" / "run.json").exists()


def test_a_policy_that_raises_or_answers_no_actions_ends_in_one_line(tmp_path, capsys):
    (tmp_path / "mine.py").write_text(
        "import torch\n\n"
        "def falls(seen):\n    return seen['no such']\n\n"
        "def short(seen):\n    return seen['q'][:, :5]\n\n"
        "class Unmade:\n    def __init__(self, env):\n        raise OSError('no weights')\n"
    )
    for name, word in (("falls", "KeyError"), ("short", "actions are (1, 5)"), ("Unmade", "no weights")):
        policy = f"{tmp_path / 'mine.py'}:{name}"
        assert sweep(tmp_path / name, "--splits", "S0", "--receiver-motion", "moves", "--policy", policy) == 2
        said = [x for x in capsys.readouterr().err.splitlines() if "policy" in x]
        assert len(said) == 1 and word in said[0] and f"mine.py:{name}" in said[0]


def test_a_sweep_plays_the_loop_beside_its_verdicts_and_a_users_policy_is_one(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("r2h_batch.closed_loop.env.LoopConfig", partial(LoopConfig, horizon_s=2.0))
    (tmp_path / "mine.py").write_text("import torch\n\ndef wait(seen):\n    return torch.zeros_like(seen['q'])\n")
    assert sweep(tmp_path / "off") == 0
    plain_out = capsys.readouterr().out
    assert "Closed loop" not in plain_out
    assert (
        sweep(tmp_path / "on", "--receiver-motion", "moves:50mm,10deg", "--policy", f"{tmp_path / 'mine.py'}:wait") == 0
    )
    text = capsys.readouterr().out
    assert plain_out.splitlines()[0] in text and "Closed loop: mine.py:wait" in text and "contact by robot" in text
    assert "closed loop (own policy)" in text and "may know what no observation holds" in text
    off, on = load_run(tmp_path / "off"), load_run(tmp_path / "on")
    on.verify()
    name = on.methods[0]
    assert on.digest(name) == off.digest(off.methods[0])  # the verdicts are today's
    rows = on.episodes(name)
    assert rows["trial_id"].to_pylist() == on.trials(name)["trial_id"].to_pylist()
    ends = set(rows["end"].to_pylist())
    assert ends <= {"timeout", "drop", "contact"} and "timeout" in ends
    assert max(rows["robot_idle"].to_pylist()) == 1.0
    assert "shift_m 0.05" in on.header["digests"]["closed_loop"] and "closed_loop" not in off.header["digests"]
    on.header["digests"]["closed_loop"] = "servo; kind moves"
    assert "own policy" not in render(on)
    # another policy is another run
    assert sweep(tmp_path / "on", "--receiver-motion", "moves:50mm,10deg", "--policy", "servo") == 2
    assert "closed_loop" in capsys.readouterr().err
