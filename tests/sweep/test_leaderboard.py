"""A page of submissions: each fails alone and in one line, and no claim of a submitter decides what it says."""

import json
import re
import shutil

import pytest
from made_runs import command, files_of, read_json, receipt_of, with_a_fatal_footer, with_receipt

from r2h_batch.runs.files import sha256_of
from r2h_batch.runs.header import run_hash
from r2h_batch.runs.store import load_run
from r2h_batch.sweep import submission_judge
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.results import reevaluation

LINE = ["--benchmark", "r2h-v1", "--method", "random", "--trials", "3", "--sim", "none", "--shard-trials", "2"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("board") / "mine"
    assert sweep([*LINE, "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """The same method with another seed: other rows."""
    folder = tmp_path_factory.mktemp("board") / "other"
    assert sweep([*LINE, "--seed", "1", "--out", str(folder)]) == 0
    return folder


def copied(run, out, *, method=None, header=None):
    """A copy of a run whose method's file and run.json say something else; all hashes agree."""
    folder = shutil.copytree(run, out)
    file = folder / "methods" / "random.json"
    file.write_text(json.dumps({**read_json(file), **(method or {})}))
    data = read_json(folder / "run.json")
    for where, value in (header or {}).items():
        *path, last = where.split(".")
        inside = data
        for key in path:
            inside = inside[key]
        inside[last] = value
    data["hash"] = run_hash(data)
    (folder / "run.json").write_text(json.dumps(data))
    for path in files_of(folder):
        with_receipt(path, {**receipt_of(path), "run": data["hash"], "method": read_json(file)["name"]})
    return folder


def board(out, *submissions, **flags):
    """The exit code, and (place, method, submission) of each line of the page."""
    code = command("leaderboard", *submissions, rows=6, out=out, overwrite=True, **flags)
    lines = re.findall(
        r"<tr[^>]*><td>([^<]*)</td><td class=l>([^<]*)(?:<small>[^<]*</small>)?</td><td class=l>([^<]*)</td>",
        out.read_text(),
    )
    return code, lines


def test_each_hostile_or_like_named_submission_fails_alone_in_one_line(run, other, tmp_path, capsys):
    theirs = {"source": {"kind": "method", "function": "mine_too:mine"}, "name": "random"}
    hostile = {
        "motions": ({"source": {"kind": "motions"}}, {}, "a method of motions has no paths"),
        "rounds": ({}, {"configuration.plan.rounds": [50, 2_000_000_000]}, "differs from the baselines in configuration"),
        "shortcuts": ({}, {"configuration.plan.shortcuts": 10**12}, "differs from the baselines in configuration"),
        "chunk": ({}, {"configuration.chunk": 10**15}, "differs from the baselines in configuration"),
        "policy": ({}, {"digests.closed_loop": "evil:policy"}, "differs from the baselines in digests"),
    }  # fmt: skip
    given = [run, copied(other, tmp_path / "twin", method=theirs)]
    given += [copied(run, tmp_path / name, method=m, header=h) for name, (m, h, _) in hostile.items()]
    (tmp_path / "empty").mkdir()
    (tmp_path / "no.zip").write_bytes(b"PK\x03\x04 no archive")
    given += [tmp_path / "no.zip", tmp_path / "nowhere.zip"]
    code, lines = board(tmp_path / "board.html", *given)
    error = capsys.readouterr().err
    assert code == 1 and {line[1:] for line in lines} >= {("random", "mine"), ("random (submitted)", "twin")}
    assert not {name for _, _, name in lines} & set(hostile)
    for name, (_, _, words) in hostile.items():
        (line,) = [x for x in error.splitlines() if f"/{name} is left out" in x]
        assert words in line, line
    assert len(re.findall(r"(no|nowhere)\.zip is left out: .", error)) == 2 and "Traceback" not in error


def test_a_claimed_machine_excuses_no_answer_of_a_built_in_method(run, other, tmp_path):
    """One of six answers is that of another seed, and run.json says that an unknown processor scored them: within what
    `results reevaluate` allows elsewhere, but not with the same bits."""
    claimed = copied(run, tmp_path / "claimed", header={"device.name": "cpu: Z80, 1 cores", "seed": 1})
    code, lines = board(tmp_path / "board.html", claimed, run)
    assert code == 1 and ("random", "claimed") not in {line[1:] for line in lines}
    judge = reevaluation.Judge(load_run(run))
    judge.other = ("processor",)
    found = reevaluation.reevaluate(load_run(run), "random", 6, judge)
    assert found.built_in and found.equal == 6
    job = reevaluation.job_of_run(load_run(run).header, load_run(run).entry("random").source, judge.evaluator)

    def moved(trials, rows):
        answer = job.predict(trials, rows)
        answer.T_world_ee[0, 0, 3] += 1e-6
        return answer

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reevaluation, "job_of_run", lambda *_: type("J", (), {"name": "random", "predict": moved}))
        found = reevaluation.reevaluate(load_run(run), "random", 6, judge)
    assert not found.differences and not found.built_in and found.equal < 6


def test_what_only_the_submitter_knows_is_marked_as_claimed_or_not_shown(run, tmp_path):
    words = ("NASA supercomputer", "beefbeefbeefbeef", "Plan 9", "1970-01-01")
    header = {
        "device.name": words[0], "git_commit": words[1], "platform": words[2], "created": words[3],
        "command": ["r2h-batch", "sweep", "--magic"],
    }  # fmt: skip
    out = tmp_path / "board.html"
    assert board(out, copied(run, tmp_path / "proud", header=header), least=3)[0] == 0
    assert not [w for w in (*words, "--magic") if w in out.read_text()]
    assert re.search(r"T_plan<small>claimed</small>", out.read_text())


def test_a_place_needs_the_least_plan_and_a_copy_of_rows_has_none(run, other, tmp_path, capsys):
    code, lines = board(tmp_path / "board.html", run, other, least=3)
    places = {name: place for place, _, name in lines if name in ("mine", "other")}
    assert code == 0 and places == {"mine": "bound", "other": "bound"}
    # answers of `run` are shipped ones
    twin = copied(other, tmp_path / "twin", method={"source": {"kind": "method", "function": "a:b"}, "name": "mine"})
    code, lines = board(tmp_path / "board.html", twin, other, least=3)
    assert (
        code == 1
        and "other: random is left out: its rows are those of mine (submitted) of twin" in capsys.readouterr().err
    )
    (place,) = [place for place, _, name in lines if name == "twin"]
    assert place.isdigit()
    _, lines = board(tmp_path / "board.html", twin, least=4)
    assert [place for place, _, name in lines if name == "twin"] == ["n/a"]
    _, lines = board(tmp_path / "board.html", twin, least=3, baselines=run)
    assert {name for _, _, name in lines} == {"twin", "baseline"} and len(lines) == 2


def test_the_judge_of_strangers_has_limits_of_time_and_memory(run, tmp_path, own_process, monkeypatch, capfd):
    out = tmp_path / "board.html"
    assert command("leaderboard", run, rows=6, seconds=1, out=out) == 1
    assert f"{run} is left out: takes more than 1 s of CPU time" in capfd.readouterr().err and not out.exists()
    monkeypatch.setattr(submission_judge, "MEMORY_BYTES", 1 << 30)
    assert command("leaderboard", run, rows=6, out=out) == 1
    assert f"{run} is left out: " in capfd.readouterr().err and not out.exists()


def test_a_footer_that_ends_its_reader_ends_no_leaderboard(run, tmp_path, own_process, capfd):
    folder, out = shutil.copytree(run, tmp_path / "fatal"), tmp_path / "board.html"
    path = files_of(folder)[0]
    path.write_bytes(with_a_fatal_footer(path.read_bytes()))
    path.rename(path.with_name(f"{path.name[:6]}-{sha256_of(path)[:16]}.parquet"))
    assert command("leaderboard", folder, rows=6, out=out) == 1
    (line,) = [x for x in capfd.readouterr().err.splitlines() if "left out" in x]
    assert "fatal is left out: shards/random/" in line and "ends its reader" in line


def test_a_board_of_held_out_trials_takes_runs_on_these_alone(run, tmp_path, capsys):
    told = tmp_path / "told.yaml"
    assert command("benchmark", "hide", "r2h-v1", out=told, trials=3) == 0
    line = ["--benchmark", str(told), "--method", "random", "--sim", "none"]
    for name, more in (("base", []), ("theirs", ["--seed", "1"]), ("short", ["--seed", "2"])):
        count = "2" if name == "short" else "3"
        assert sweep([*line, *more, "--trials", count, "--out", str(tmp_path / name)]) == 0
    promise = told.with_suffix(".commitment.json")
    page = tmp_path / "board.html"
    flags = {"hidden": promise, "benchmark": told, "baselines": tmp_path / "base", "least": 3}
    capsys.readouterr()
    code, lines = board(page, tmp_path / "theirs", tmp_path / "short", run, **flags)
    error = capsys.readouterr().err
    assert code == 1 and {who for _, _, who in lines} == {"theirs", "baseline"}
    assert f"{run} is left out: its trials are not the held-out ones" in error
    assert "short is left out: it has 2 trials of S0, held out are 3" in error
    assert read_json(promise)["sha256"] in page.read_text()
    other = tmp_path / "other.yaml"
    other.write_text('protocol: r2h-v1\nseed: "' + "0" * 32 + '"\n')
    for benchmark, words in ((other, "is not the committed one"), ("r2h-v1", "has no seed")):
        assert (
            command("leaderboard", tmp_path / "theirs", **{**flags, "benchmark": benchmark}, out=tmp_path / "no.html")
            == 2
        )
        assert words in capsys.readouterr().err and not (tmp_path / "no.html").exists()


def test_a_board_of_a_draft_says_so_and_has_no_baselines(tmp_path, capsys):
    line = ["--benchmark", "r2h-v3-draft", "--method", "random", "--trials", "2", "--sim", "none"]
    for seed in (0, 1):
        assert sweep([*line, "--seed", str(seed), "--out", str(tmp_path / f"seed{seed}")]) == 0
    runs, out = (tmp_path / "seed0", tmp_path / "seed1"), tmp_path / "board.html"
    code, lines = board(out, *runs, least=1)
    page = out.read_text()
    # one section for both, without a line that nobody submitted
    assert code == 0 and sorted(who for _, _, who in lines) == ["seed0", "seed1"]
    assert page.count("<h2") == 1 and "its trials may change; not to be published; no baselines" in page
    # with rows of one's own both are compared, and nothing says draft
    code, lines = board(out, runs[0], baselines=runs[1], least=1)
    assert code == 0 and "no baselines" not in out.read_text()
    assert {who for _, _, who in lines} == {"seed0", "baseline"}


def test_a_board_of_a_draft_compares_no_run_with_one_whose_methods_see_or_that_is_judged_otherwise(tmp_path):
    line = ["--benchmark", "r2h-v3-draft", "--method", "random", "--trials", "2", "--sim", "none"]
    more = {
        "truth": [],
        "chunk": ["--seed", "1", "--chunk", "64"],
        "seen": ["--sees", "cell-v1", "--seed", "2"],
        "told": ["--sees", "cell-v1,region=told"],
        "strict": ["--seed", "3", "--set", "plan.edge_check=moveit"],
    }
    for name, flags in more.items():
        assert sweep([*line, *flags, "--out", str(tmp_path / name)]) == 0
    out = tmp_path / "board.html"
    code, lines = board(out, *(tmp_path / name for name in more), least=1)
    assert code == 0 and {who for _, _, who in lines} == {*more}
    _, *sections = out.read_text().split("<h2")
    held = [{name for name in more if f">{name}<" in section} for section in sections]
    assert sorted(map(sorted, held)) == [["chunk", "truth"], ["seen"], ["strict"], ["told"]]
    words = next(s for s in sections if ">told<" in s)
    assert "cell-v1, noise 1" in words and "region told" in words
    assert sum("the truth" in s for s in sections) == 2
