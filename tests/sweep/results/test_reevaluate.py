"""Rows that the evaluator does not give again are found, whoever wrote them and however well the folder is made up."""

import json
import shutil
import sys
from copy import copy
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from made_runs import files_of, forged, receipt_of, with_receipt, write_run

from r2h_batch.__main__ import main
from r2h_batch.closed_loop.env import LoopConfig
from r2h_batch.closed_loop.episodes import Loop
from r2h_batch.closed_loop.moving import ReceiverMotion
from r2h_batch.runs.files import RunError
from r2h_batch.runs.rows import TRIAL_SCHEMA
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.results import reevaluation as again
from r2h_batch.sweep.results.judge import Judge, configuration
from r2h_batch.sweep.results.reevaluation import reevaluate

FROZEN = Path(__file__).resolve().parents[2] / "frozen"
LINE = [
    "--benchmark",
    "r2h-v1",
    "--method",
    "random",
    "--trials",
    "12",
    "--execute.sim",
    "none",
    "--shard-trials",
    "9",
    "--save-paths",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """24 rows of `random` in 3 shards, as a sweep stores them unless told otherwise."""
    out = tmp_path_factory.mktemp("rejudge") / "run"
    assert sweep([*LINE, "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def judge(folder):
    return Judge(load_run(folder))


LIAR = """
import torch
from r2h_batch.evaluate import Evaluator

own = Evaluator.score

def score(self, *args, **more):
    scores = own(self, *args, **more)
    for name, value in dict(outcome=0, success=True, passed=True, evaluated=True, margin=0.01).items():
        getattr(scores, name).fill_(value)
    return scores

Evaluator.score = score

def predict(trials, scene, *, seed):
    T = torch.eye(4).repeat(len(trials), 1, 1)
    return T, T
"""


def test_rows_of_a_method_that_changed_its_judge_when_it_was_imported_are_refused(tmp_path, monkeypatch, capsys):
    from r2h_batch.evaluate import Evaluator

    (tmp_path / "rj_liar.py").write_text(LIAR)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    with monkeypatch.context() as judge:
        judge.setattr(Evaluator, "score", Evaluator.score)  # put back, as a new process has it
        line = [
            "--method",
            "rj_liar:predict",
            "--benchmark",
            "r2h-v1",
            "--trials",
            "3",
            "--execute.sim",
            "none",
            "--out",
            "run",
        ]
        assert sweep(line) == 0
        assert "100.0" in capsys.readouterr().out, "its own sweep prints what it likes"
    sys.modules.pop("rj_liar")
    assert main(["results", "reevaluate", "run"]) == 1
    assert "6 differ, 0 are equal" in capsys.readouterr().out
    assert "rj_liar" not in sys.modules, "nothing of the run's method is loaded"


def as_success(row):
    if row["outcome"] == "success":
        return False
    for name in [k.removeprefix("passed_") for k, v in row.items() if k.startswith("passed_") and v is False]:
        row |= {f"passed_{name}": True, f"margin_{name}_m": 0.01}  # margins that go with it: the row could be a verdict
    row["outcome"] = "success"
    return True


def test_every_row_of_an_honest_run_comes_out_bit_for_bit(folder, capsys, judge, monkeypatch):
    assert main(["results", "reevaluate", str(folder), "--rows", "200"]) == 0
    out = capsys.readouterr().out
    assert "random: 24 of 24 rows judged again" in out and "none differs, 24 are equal bit for bit; asked again" in out
    monkeypatch.setattr(again, "Judge", lambda *_, **__: judge)
    assert main(["results", "reevaluate", str(folder), "--rows", "5", "--seed", "3"]) == 0
    assert "5 of 24 rows judged again (--seed 3): none differs, 5 are equal" in capsys.readouterr().out


def test_one_made_up_success_is_found_though_every_checksum_agrees(folder, tmp_path, capsys, judge, monkeypatch):
    monkeypatch.setattr(again, "Judge", lambda *_, **__: judge)
    done = []

    def one(row):
        if done or not as_success(row):
            return False
        done.append(row["trial_id"])
        return True

    assert forged(folder, tmp_path / "run", one) == done and len(done) == 1
    assert main(["results", "verify", str(tmp_path / "run")]) == 0  # a checksum sees nothing
    assert main(["results", "reevaluate", str(tmp_path / "run"), "--rows", "24"]) == 1
    out = capsys.readouterr().out
    assert "24 of 24 rows judged again" in out and ": 1 differs, 23 are equal bit for bit" in out
    assert f"trial {done[0]}: outcome is stored as success, scored again it is" in out
    told = {line.split(":")[0] for line in out.splitlines() if line.startswith("  trial")}
    assert told == {f"  trial {done[0]}"}


def test_episodes_are_played_again_and_a_made_up_one_is_found(tmp_path, capsys, monkeypatch):
    run = tmp_path / "run"
    monkeypatch.setattr("r2h_batch.closed_loop.env.LoopConfig", partial(LoopConfig, horizon_s=2.0))
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "random",
        "--trials",
        "1",
        "--execute.sim",
        "none",
        "--quiet",
        "--receiver-motion",
        "moves:50mm,10deg",
    ]
    assert sweep([*line, "--policy", "servo", "--seed", "3", "--out", str(run)]) == 0
    assert main(["results", "reevaluate", str(run)]) == 0
    out = capsys.readouterr().out
    assert "2 of 2 rows judged again" in out and "2 are equal bit for bit" in out and "episodes played again" in out
    done = []

    def won(row):
        if done or row["end"] != "timeout":
            return False
        done.append(row["trial_id"])
        row["end"] = "success"
        return True

    assert len(forged(run, tmp_path / "forged", won, "episodes")) == 1
    assert main(["results", "reevaluate", str(tmp_path / "forged")]) == 1
    out = capsys.readouterr().out
    assert f"trial {done[0]}: episodes end is stored as success, scored again it is timeout" in out


def test_episodes_that_began_on_the_table_are_not_played_again():
    run = load_run(FROZEN / "draft")
    run.header["stored"] = [*run.header["stored"], "episodes"]  # as r2h_batch 0.3 stored what it played
    run.header["digests"]["closed_loop"] = Loop(ReceiverMotion.parse("moves"), "servo", LoopConfig()).identity
    old = Judge(run)
    assert old.loop is None and "episodes not played again: they began on the table" in old.played


def test_a_loop_comes_back_from_its_words_and_users_policies_do_not():
    loop = Loop(ReceiverMotion.parse("takes:50mm,10deg", 4), "replan", LoopConfig(seed=4, latency_s=0.2))
    assert Loop.of(loop.identity) == loop
    for words, why in (
        (loop.identity.replace("replan", "mine.py:wait 12ab"), "mine.py:wait is not built in"),
        (loop.identity.replace("kind takes", "kind replay"), "imported motion is not in the folder"),
        (loop.identity.replace("rate_hz 20", "rate_hz 5000"), "no closed loop is"),
        (loop.identity.replace("kind takes", "kind flies"), "no closed loop is"),
        (loop.identity + ", gravity 3", "no closed loop is"),
    ):
        with pytest.raises(ValueError, match=why):
            Loop.of(words)


def test_a_margin_moved_by_a_micrometre_is_found_here_and_by_a_millimetre_anywhere(folder, tmp_path, judge):
    def moved(by):
        def change(row):
            if row["trial_id"] != 8:
                return False
            row["margin_stability_m"] += by
            return True

        return change

    for name, by in (("micro", 1e-6), ("milli", 1e-3)):
        forged(folder, tmp_path / name, moved(by))
    micro, milli = (load_run(tmp_path / name) for name in ("micro", "milli"))
    found = {}
    assert judge.other == ()
    for name, run in (("micro", micro), ("milli", milli)):
        found[name] = reevaluate(run, "random", 24, judge).differences
        assert [(d.trial_id, d.column) for d in found[name]] == [(8, "margin_stability_m")]
    elsewhere = copy(judge)
    elsewhere.other = ("processor",)
    assert reevaluate(micro, "random", 24, elsewhere).differences == ()
    assert reevaluate(milli, "random", 24, elsewhere).differences == found["milli"]


CHANGES = {
    "body_m": ("trials", lambda row: row | {"body_m": 0.01}),
    "width_m": ("trials", lambda row: row | {"width_m": row["width_m"] + 2e-4}),
    "t_exec_s": ("trials", lambda row: row | {"t_exec_s": row["t_exec_s"] and row["t_exec_s"] + 0.05}),
    "presented_margin_m": ("trials", lambda row: row | {"presented_margin_m": None}),
    "opening_m": ("details", lambda row: row | {"opening_m": row["opening_m"] + 2e-4}),
    "q_goal": ("details", lambda row: row | {"q_goal": row["q_goal"] and [x + 0.01 for x in row["q_goal"]]}),
    "witness_plan_part": ("details", lambda row: row | {"witness_plan_part": "shoulder"}),
    "q": ("paths", lambda row: row | {"q": [[x + 0.01 for x in q] for q in row["q"]]}),
}  # fmt: skip


def test_what_is_judged_again_is_compared_whatever_versions_the_run_names(folder, tmp_path, judge):
    elsewhere, run, edited = copy(judge), folder, set()
    elsewhere.other = ("code", "torch", "processor")
    assert reevaluate(load_run(folder), "random", 24, elsewhere).differences == ()
    for column, (kind, change) in CHANGES.items():

        def one(row, change=change):
            new = change(row)
            return new != dict(row) and not row.update(new)

        made = tmp_path / column
        edited |= {(i, column) for i in forged(run, made, one, kind)}
        run = made
    found = reevaluate(load_run(run), "random", 24, elsewhere).differences
    assert {c for _, c in edited} == CHANGES.keys()
    assert {(d.trial_id, d.column.rpartition(" ")[2]) for d in found} == edited


def test_an_answer_that_is_said_to_be_missing_is_found_by_its_pose(folder, tmp_path, judge):
    def silent(row):
        if row["trial_id"] not in (2, 4):
            return False
        row |= {k: None for k in row if k not in ("trial_id", "object", "split", "side")} | {"outcome": "missing"}
        return True

    forged(folder, tmp_path / "run", silent)
    with pytest.raises(RunError, match=r"shards/random/.* holds 9 rows of details, planned were 7"):
        reevaluate(load_run(tmp_path / "run"), "random", 24, judge)


def test_rows_and_poses_of_another_answer_are_found_under_a_built_in_methods_name(folder, tmp_path, judge, capsys):
    """Poses of seed 1 stand in the run of seed 0: verdicts, checksums and plan agree, only the method would not answer
    so."""
    assert sweep([*LINE, "--seed", "1", "--out", str(tmp_path / "other")]) == 0
    run = load_run(folder)
    shutil.copytree(folder, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "shards")
    shutil.copytree(tmp_path / "other" / "shards", tmp_path / "run" / "shards")
    for path in files_of(tmp_path / "run"):
        with_receipt(path, {**receipt_of(path), "run": run.header["hash"]})
    swapped = load_run(tmp_path / "run")
    found = reevaluate(swapped, "random", 10, judge)
    assert [d.column for d in found.differences] == ["answer"] * 10 and found.equal == 0
    elsewhere = copy(judge)
    elsewhere.other = ("processor",)
    assert len(reevaluate(swapped, "random", 10, elsewhere).differences) == 10
    elsewhere.other = ("code", "torch")
    assert len(reevaluate(swapped, "random", 10, elsewhere).differences) == 10
    file = tmp_path / "run" / "methods" / "random.json"
    data = json.loads(file.read_text())
    for function, words in (("oracle:predict", "is called 'oracle'"), ("no:predict", "only built-in methods can")):
        file.write_text(json.dumps({**data, "source": {"function": f"r2h_batch.methods.{function}"}}))
        if words.startswith("is"):
            with pytest.raises(RunError, match=words):
                reevaluate(load_run(tmp_path / "run"), "random", 1, judge)
        else:
            assert words in reevaluate(load_run(tmp_path / "run"), "random", 1, judge).asked
    source = {"function": "r2h_batch.methods.fc:predict", "options": "bogus=1"}
    file.write_text(json.dumps({**data, "source": source}))
    with pytest.raises(RunError, match=r"'random' cannot be called again: .*bogus"):
        reevaluate(load_run(tmp_path / "run"), "random", 1, elsewhere)


def test_what_cannot_be_judged_again_is_refused_with_one_line(folder, tmp_path, capsys):
    write_run(tmp_path / "a", {"m": np.zeros(4, int)}, 2, 2)
    assert main(["results", "reevaluate", str(tmp_path / "a"), "--rows", "5"]) == 2
    assert "stored without poses; sweep again without no_poses" in capsys.readouterr().err
    assert main(["results", "reevaluate", str(folder), "--rows", "-5"]) == 2
    assert "--rows is -5" in capsys.readouterr().err
    assert main(["results", "reevaluate", str(folder), "--rows", "5", "--method", "fc"]) == 2
    assert "no method 'fc'" in capsys.readouterr().err
    assert main(["results", "reevaluate", str(folder), "--rows", "5", "--object-mesh", "mug.obj"]) == 2
    assert "results reevaluate --object-mesh: r2h_batch 0.3 had it" in capsys.readouterr().err


@pytest.mark.check
def test_a_configuration_comes_back_as_it_was_or_is_refused(tmp_path):
    from dataclasses import asdict

    from r2h_batch.config import EvalConfig

    for name in ("default", "paper"):
        config = EvalConfig.preset(name)
        assert configuration(json.loads(json.dumps(asdict(config))), "run") == config
    data = json.loads(json.dumps(asdict(EvalConfig())))
    for wrong in ({"chunk": "many"}, {"chunk": 0}, {"gravity": 9.81}, {"width": "lips"}):
        with pytest.raises(RunError, match="run: its configuration"):
            configuration({**data, **wrong}, "run")
    data.pop("stability")
    with pytest.raises(RunError, match="of another version: stability"):
        configuration(data, "run")
    assert set(again.COMPARED["trials"]) == set(TRIAL_SCHEMA.names) - {"t_plan_s", "t_method_s"}
