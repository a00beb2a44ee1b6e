"""The shipped rows of the built-in methods: whole, as the present code judges them, and comparable with a run of any size."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from made_runs import made_trials, make_header, make_scores

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError
from r2h_batch.base.registry import DEFAULT_BENCHMARK, METHOD_NAMES
from r2h_batch.base.schedule import trial_ids
from r2h_batch.report.compare.stored import LATER, SHIPPED, baselines_for, load_baselines, load_rows, stored_rows
from r2h_batch.report.statistics.common import common_trials
from r2h_batch.report.statistics.paired import pair_up
from r2h_batch.runs.store import join, load_run
from r2h_batch.runs.writing import open_run
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.rows import TrialNames, score_rows


@pytest.mark.parametrize("folder", stored_rows(), ids=lambda f: f.name)
def test_the_shipped_rows_are_whole_and_of_all_built_in_methods(folder):
    run = load_run(folder)
    assert run.header["trials"] == {"S0": 500, "S1": 500} and not run.unfinished
    without = {"learned", "robust"}
    # of r2h-v3 the robust search is the bound of methods that see, the oracle of those that are told
    if run.header["protocol"] == "r2h-v3":
        without = {"oracle"} if "sees" in run.header else {"robust"}
    assert functions(run) == {named(m) for m in METHOD_NAMES if m not in without}
    assert baselines_for(run.header) == folder
    # trained for the default benchmark; its rows stand beside the others'. The robust search is a bound
    # for methods that see errors; these rows have none
    later = {"learned"} if run.header["protocol"] == DEFAULT_BENCHMARK else set()
    assert functions(load_rows(folder)) == functions(run) | {named(m) for m in later}


def functions(run) -> set[str]:
    return {e.source["function"] for e in run.entries}


def named(method: str) -> str:
    return f"r2h_batch.methods.{method.replace('-', '_')}:predict"


@pytest.mark.parametrize("folder", sorted(LATER.iterdir()), ids=lambda f: f.name)
def test_rows_that_came_later_are_of_the_same_trials_judged_alike(folder):
    run = load_run(folder)
    assert run.header["trials"] == {"S0": 500, "S1": 500} and not run.unfinished
    shipped = load_run(SHIPPED / folder.name)
    assert common_trials([shipped, run], proven=stored_rows()).trials == {"S0": 500, "S1": 500}
    own, theirs = ([*r.trials(r.methods[0], ["trial_id"])["trial_id"].to_pylist()] for r in (run, shipped))
    assert own == theirs


def test_baselines_of_the_default_benchmark_hold_the_learned_method_and_what_it_was_trained_on(tmp_path, capsys):
    """A user's own run of it is the stored one; a joined run's parts are found."""
    line = ["--method", "learned", "--trials", "3", "--execute.sim", "none", "--out", str(tmp_path / "mine")]
    assert sweep(line) == 0
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "mine"), "baselines", "--format", "json"]) == 0
    found = capsys.readouterr()
    (whole,) = (c for c in json.loads(found.out) if c["group"] == "all")
    assert len(whole["names"]) == 7 and whole["ranked"].count("Learned (ranker, oracle labels + noise)") == 1
    assert main(["compare", str(tmp_path / "mine"), "baselines", "--full"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "is given twice, and counted once" in text and "and 76 more objects. None of them is tested here." in text
    other = [
        "--method",
        "random",
        "--seed",
        "3",
        "--trials",
        "4",
        "--execute.sim",
        "none",
        "--out",
        str(tmp_path / "own"),
    ]
    assert sweep(other) == 0
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "own"), "baselines"]) == 0
    text = capsys.readouterr().out
    assert "baselines/random" in text and ".." not in text and "as-planned" not in text
    assert main(["report", str(tmp_path / "mine"), "baselines", "--format", "csv"]) == 0
    assert "Contact-Handover" in capsys.readouterr().out
    baselines = load_baselines(load_benchmark())
    assert len(baselines.methods) == 7 and "learned" in baselines.view_command(
        "Learned (ranker, oracle labels + noise)"
    )
    both = join([load_run(tmp_path / "mine"), baselines])
    assert "learned" in both.view_command("r2h-v2/Learned (ranker, oracle labels + noise)")


def test_rows_of_the_runs_benchmark_preset_and_engine_are_its_baselines_whatever_their_folder_is_called(tmp_path):
    for folder in stored_rows():
        header = load_run(folder).header
        assert baselines_for({k: header[k] for k in ("protocol", "digests", "configuration")}) == folder
    unknown = {"protocol": "mine", "digests": {"benchmark": "0"}, "configuration": {"name": "paper"}}
    with pytest.raises(
        FileError,
        match=r"benchmark mine --preset paper; make them with `r2h-batch sweep --method random ",
    ):
        baselines_for({**unknown, "benchmark": {"flags": ["--benchmark mine.yaml"]}})


def test_r2h_v3_has_baselines_in_both_tracks_and_they_are_never_paired(tmp_path, capsys):
    folders = {name: SHIPPED / name for name in ("r2h-v3-as-planned", "r2h-v3-sees-cell-v1")}
    truth, seen = (load_run(folder) for folder in folders.values())
    assert load_baselines(load_benchmark("r2h-v3")).folder == truth.folder
    assert {truth.header["protocol"], seen.header["protocol"]} == {"r2h-v3"} and seen.header["sees"]["rig"] == "cell-v1"
    with pytest.raises(ValueError, match="differ in what their methods see"):
        common_trials([truth, seen], proven=stored_rows())
    line = ["--benchmark", "r2h-v3", "--method", "random", "--trials", "3", "--execute.sim", "none"]
    assert sweep([*line, "--out", str(tmp_path / "mine")]) == 0
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "mine"), "baselines", "--format", "json"]) == 0
    (whole,) = (c for c in json.loads(capsys.readouterr().out) if c["group"] == "all")
    assert len(whole["names"]) == 7 and whole["n"] == 6
    # of a run that sees the same, the rows that see; of one that sees otherwise, a line that says so
    other = {**seen.header, "digests": {**seen.header["digests"], "sees": "0" * 64}}
    assert baselines_for(seen.header) == seen.folder and baselines_for(other) != seen.folder


def test_stored_rows_of_another_preset_are_no_baselines_and_those_of_the_same_engine_come_first():
    headers = {folder.name: load_run(folder, verify=False).header for folder in stored_rows()}
    moved, planned = headers["v1"], headers["v1-as-planned"]
    assert moved["digests"]["benchmark"] == planned["digests"]["benchmark"]
    for header, name in ((moved, "v1"), (planned, "v1-as-planned")):
        assert baselines_for(header).name == name
    config = {**moved["configuration"], "name": "strict"}
    with pytest.raises(FileError, match="are stored for benchmark r2h-v1 --preset strict"):
        baselines_for({**moved, "configuration": config})
    # of the same rule, objects and hands, but another limit: comparable, and the same benchmark goes first
    other = {**moved, "digests": {**moved["digests"], "benchmark": "0"}}
    assert baselines_for(other).name == "v1"
    for part in ("objects", "hand_set"):
        with pytest.raises(FileError, match="no rows of the built-in methods are stored"):
            baselines_for({**other, "digests": {**other["digests"], part: "0"}})


def test_a_benchmark_knows_its_stored_rows_by_digest_simulated_ones_of_the_default_preset():
    v1, v0 = load_benchmark("r2h-v1"), load_benchmark("r2h-v0")
    assert load_baselines(v1).folder.name == "v1" and load_baselines(v0).folder.name == "v0"
    assert load_baselines(replace(v1, name="mine")).folder.name == "v1"
    with pytest.raises(FileError, match="no rows of the built-in methods are stored for benchmark r2h-v1"):
        load_baselines(replace(v1, receiver="body"))
    with pytest.raises(FileError, match="stored for benchmark r2h-release"):  # its rows are of another preset
        load_baselines(load_benchmark("r2h-release"))


def test_a_small_run_is_compared_with_the_shipped_baselines_without_a_rerun(tmp_path, capsys, monkeypatch):
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "random",
        "--trials",
        "12",
        "--execute.sim",
        "none",
        "--out",
        str(tmp_path / "mine"),
    ]
    assert sweep(line) == 0
    capsys.readouterr()
    monkeypatch.chdir(tmp_path)
    assert (
        main(["compare", str(tmp_path / "mine"), "baselines", "--method", "random", "oracle", "--format", "csv"]) == 0
    )
    rows = {(r["group"], r["a"], r["b"]): r for r in csv.DictReader(io.StringIO(capsys.readouterr().out))}
    assert {(a, b) for _, a, b in rows} == {
        ("random", "oracle")
    }  # the shipped random has the same answers and verdicts
    assert rows["S0", "random", "oracle"]["n"] == "12" and float(rows["S0", "random", "oracle"]["difference"]) < 0
    assert main(["compare", str(tmp_path / "mine"), "baselines", "--format", "json"]) == 0
    whole = json.loads(capsys.readouterr().out)[-1]
    assert [p["a"] for p in whole["pairs"]] == ["random"] * 5 and len(whole["names"]) == 6  # each baseline once
    assert len(whole["ranked"]) == len(whole["rank"]) == 4 and not {"random", "oracle"} & set(whole["ranked"])
    assert all(p["p_holm"] <= 5 * p["p"] + 1e-12 for p in whole["pairs"])
    assert main(["compare", str(tmp_path / "mine"), "baselines", "--all-pairs", "--full"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert (
        "the first 12 S0, 12 S1, which all of them hold" in text and "random is given twice, and counted once" in text
    )
    with pytest.raises(ValueError, match=r"differ in digests \(code\)|differ in configuration"):
        mine, shipped = load_run(tmp_path / "mine"), load_run(baselines_for(load_run(tmp_path / "mine").header))
        mine.header["digests"]["code"] = "another"
        common_trials([mine, shipped])
    shipped.header["digests"]["objects"] = "others"
    with pytest.raises(ValueError, match=r"differ in digests \(objects\).*stored rows have default options"):
        common_trials([mine, shipped], proven=stored_rows())


def write_protocol_run(folder, n, method, header, s1=None):
    """A made run whose ids are the protocol's: 2 i in S0, 2 i + 1 in S1."""
    m = n if s1 is None else s1
    names = TrialNames(objects=("bowl", "knife"), object_splits=("S0", "S1"), hand_sides=("right", "left"))
    trials = made_trials(n, m)
    scores = make_scores(trials, np.random.default_rng(len(method) + n).choice([0, 2], n + m))
    ids = torch.from_numpy(trial_ids({"S0": n, "S1": m}, 0, n + m))
    trials.trial_id[:] = ids  # the scores' too
    trials.object_index[:] = (ids % 2).int()
    trials.hand_index[:] = (ids // 2 % 2).int()
    run = open_run(folder, make_header(n, m, **header))
    run.register(method, {"kind": "test"})
    for shard in run.todo(method):
        with run.write(method, shard) as writer:
            writer.append(trials=score_rows(trials, scores, names))
    return load_run(folder)


def test_runs_of_different_size_are_compared_on_the_trials_that_both_hold(tmp_path):
    same = {"protocol": DEFAULT_BENCHMARK, "digests": {"trials": "t", "objects": "o", "hand_set": "h"}}
    objects = [{"name": n, "split": s, "built_in": True} for s, n in (("S0", "bowl"), ("S1", "knife"))]
    runs = [write_protocol_run(tmp_path / str(n), n, m, {**same, "objects": objects}) for m, n in (("a", 9), ("b", 5))]
    common = common_trials(runs)
    assert dict(common.trials) == {"S0": 5, "S1": 5} and "first 5 S0, 5 S1" in common.notes[0]
    paired = pair_up(runs, common)
    success = [np.array(r.trials(r.methods[0])["outcome"].to_pylist()) == "success" for r in runs]
    kept = np.r_[0:5, 9:14]
    assert int(paired.only.sum(0)[0, 1]) == int((success[0][kept] & ~success[1]).sum())
    assert int(paired.trials.sum()) == 10
    with pytest.raises(ValueError, match=r"differ in digests \(objects\)"):
        other = {**same, "digests": {**same["digests"], "objects": "x"}, "objects": objects}
        common_trials([runs[0], write_protocol_run(tmp_path / "x", 5, "c", other)])
    with pytest.raises(ValueError, match="share no split"):
        one = write_protocol_run(tmp_path / "one", 5, "c", {**same, "objects": objects}, s1=0)
        common_trials([one, write_protocol_run(tmp_path / "two", 0, "d", {**same, "objects": objects}, s1=5)])
