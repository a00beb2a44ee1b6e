"""The table as text: the paper's own numbers come back cell by cell in every format."""

import csv
import dataclasses
import io
import json
import re
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from made_runs import command, files_of, made_trials, make_header, make_scores, store, table_1, write_run
from rounds import each

from r2h_batch.__main__ import main
from r2h_batch.config import PlanConfig
from r2h_batch.report import table as report
from r2h_batch.report.compare.stored import SHIPPED
from r2h_batch.report.statistics import codes
from r2h_batch.report.statistics.rates import OF_ALL
from r2h_batch.runs.files import claim
from r2h_batch.runs.store import join, load_run
from r2h_batch.runs.writing import open_run
from r2h_batch.types import Outcome

COLUMNS = [name for name in report.HEADINGS if name in table_1()[0]]
"""The paper's: further criteria have more."""


@pytest.fixture(scope="module")
def paper(paper_rows):
    return report.table_of(paper_rows)


@pytest.fixture(scope="module")
def expected():
    """(split, method) -> Table I's cells as printed in the paper, n/a where it says N/A."""
    return {(r["split"], r["method"]): [r[c] or "n/a" for c in COLUMNS] for r in table_1()}


def md_tables(text: str) -> list[list[list[str]]]:
    """Cells of every Markdown table, headings first."""
    tables, current = [], []
    for line in [*text.splitlines(), ""]:
        if "|" in line:
            if "--|--" not in line:
                current.append([c.strip() for c in re.split(r"(?<!\\)\|", line) if c])
        elif current:
            tables.append(current)
            current = []
    return tables


def table_with(heading: str, text: str) -> list[list[str]]:
    """The one Markdown table that has a column of this heading."""
    (found,) = (t for t in md_tables(text) if heading in t[0])
    return found


@pytest.mark.check
def test_markdown_gives_back_every_cell_of_table_1_in_its_order(paper, expected):
    heading, *rows = md_tables(report.render(paper, "md"))[0]
    assert heading == ["Split", "Method", "Reads", *report.HEADINGS.values()]
    at = [heading.index(report.HEADINGS[name]) for name in COLUMNS]
    assert {(r[0], r[1]): [r[k] for k in at] for r in rows} == expected and len(COLUMNS) == 9
    assert [(r[0], r[1]) for r in rows] == list(expected)


def test_csv_gives_back_every_cell_of_table_1(paper, expected):
    rows = list(csv.DictReader(io.StringIO(report.render(paper, "csv"))))
    found = {}
    for r in rows:
        decimals = {c: 1 if c in OF_ALL else 2 for c in COLUMNS}
        cells = [r[c] if r[c] == "n/a" else f"{float(r[c]):.{decimals[c]}f}" for c in COLUMNS]
        found[r["split"], r["method"]] = cells
        assert r["protocol"] == "made" and r["preset"] == "default"
        if r["split"] != "Avg":
            assert r["n"] == "500"
    assert found == expected


def test_json_gives_back_every_cell_of_table_1_without_nan(paper, expected):
    def refuse(constant):
        raise AssertionError(constant)

    data = json.loads(report.render(paper, "json"), parse_constant=refuse)
    for row in data["rows"]:
        for column, cell in zip(COLUMNS, expected[row["split"], row["method"]]):
            digits = 1 if column in OF_ALL else 2
            assert (f"{row[column]:.{digits}f}" if row[column] is not None else "n/a") == cell
        if row["split"] != "Avg":
            failures = ("stability", "plan", "reach", "affordance", "safe", "invalid_input", "invalid_sim", "missing")
            assert row["n_success"] + sum(row[f"n_{f}"] for f in failures) == row["n"] == 500
            assert row["t_plan_s_n"] == 500 and row["t_exec_s_n"] == 500 - row["n_plan"]
    assert data["origin"]["protocol"] == "made" and data["origin"]["trials digest"] == "0123456789abcdef"


def test_people_read_twelve_digits_of_a_digest_and_programs_all(paper):
    own, other = "0123456789abcdef" * 4, "fedcba9876543210" * 4
    origin = {"instances": f"2, digest {own}", "trials digest": other, "device": "e" * 63}
    table = dataclasses.replace(paper, origin=origin)
    text = report.render(table, "md")
    assert "digest 0123456789ab  \ntrials digest: fedcba987654  \n" in text and "e" * 63 in text
    for fmt in ("json", "csv"):
        assert own in report.render(table, fmt) and other in report.render(table, fmt)


@pytest.mark.parametrize("fmt", report.FORMATS)
@pytest.mark.parametrize(("n_s0", "n_s1", "code"), [(0, 3, 0), (2, 2, int(Outcome.INVALID_SIM))])
def test_edges_print_na_and_never_nan(tmp_path, fmt, n_s0, n_s1, code):
    run = write_run(tmp_path / "run", {"m": np.full(n_s0 + n_s1, code)}, n_s0, n_s1)
    text = report.render(report.table_of(run), fmt)
    assert not re.search(r"\b(nan|NaN|inf|Infinity|None)\b", text)
    if fmt != "json":
        assert "n/a" in text


def test_motions_that_meet_a_receivers_body_are_a_rate_of_those_past_one(tmp_path):
    trials, run = made_trials(8, 0), open_run(tmp_path / "run", make_header(8, 0))
    body_m = torch.tensor([0.05, -0.01, 0.0, torch.nan, -0.002, 0.03, torch.nan, -0.1])
    store(run, "m", trials, replace(make_scores(trials, np.zeros(8, int)), body_m=body_m))
    table = report.table_of(load_run(tmp_path / "run"))
    met = table_with("Body met", report.render(table, "md"))
    assert met[0] == ["Split", "Method", "Body met", "95 %", "of"] and met[1][2:] == ["50.0", "18.8-81.2", "6"]
    assert table.rows[0].shares["body_met"].percent == 50.0 and '"body_met": 50.0' in report.render(table, "json")


def test_beside_a_run_of_other_choices_the_default_ones_are_named(tmp_path, capsys):
    folders = []
    for name, hand, candidates in (("a", "true", "filtered"), ("b", "estimated", "as-generated")):
        configuration = {"name": "any", "plan": asdict(PlanConfig(hand=hand)), "candidates": candidates}
        folders.append(write_run(tmp_path / name, {"m": np.zeros(4, int)}, 2, 2, configuration=configuration).folder)
    assert command("report", *folders) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "paths planned against: a: the true hand; b: the estimated hand" in text
    assert "grasp candidates: a: filtered; b: as generated" in text and "a: n/a" not in text


@pytest.mark.parametrize("edge_check", ["moveit", "exact"])
def test_successes_that_pass_through_something_have_a_column_where_paths_are_sampled(tmp_path, edge_check):
    configuration = {"name": "any", "plan": asdict(PlanConfig(edge_check=edge_check))}
    trials, run = (
        made_trials(6, 0),
        open_run(tmp_path / "run", make_header(6, 0, configuration=configuration)),
    )
    scores = make_scores(trials, np.array([0, 0, 0, 0, Outcome.REACH, 0]))
    margin = scores.margin.clone()
    margin[:, 1] = torch.tensor([0.02, -0.037, -5e-5, -2e-4, 0.02, 0.01])  # 1 and 3: more than float32's doubt
    margin[:, 1] = margin[:, 1].abs() if edge_check == "exact" else margin[:, 1]
    store(run, "m", trials, replace(scores, margin=margin))
    text = report.render(report.table_of(load_run(tmp_path / "run")), "md")
    assert ("Through" in text) == (edge_check == "moveit")
    if edge_check == "moveit":
        through = table_with("Through", text)
        assert through[0] == ["Split", "Method", "Through", "95 %", "of"] and through[1][2::2] == ["40.0", "5"]


def test_an_unfinished_method_is_named_and_not_in_the_table(tmp_path, capsys):
    run = write_run(tmp_path / "run", {"a": np.zeros(8, int), "b": np.zeros(8, int)}, 4, 4, shard_trials=3)
    files_of(run.folder, "b")[1].unlink()
    assert command("report", run.folder) == 1
    captured = capsys.readouterr()
    assert captured.err == "report: b is not in the table, 3 of its trials are not scored yet\n"
    assert {r[1] for r in md_tables(captured.out)[0][1:]} == {"a"}
    files_of(run.folder, "a")[0].unlink()
    assert command("report", run.folder) == 2
    assert "no method is complete" in capsys.readouterr().err


def test_what_keeps_a_method_out_of_the_table_is_told_where_sweeping_again_is_no_answer(tmp_path, capsys):
    folder = write_run(tmp_path / "run", {"a": np.zeros(8, int), "b": np.zeros(8, int)}, 4, 4, shard_trials=3).folder

    def told(code):
        assert command("report", folder) == code
        (line,) = capsys.readouterr().err.splitlines()
        return line

    file, claimed = files_of(folder, "b")[1], load_run(folder).entry("b").claim_path(1)
    renamed = file.rename(file.with_name(f"{file.stem}_copy.parquet"))
    assert renamed.name in told(1) and renamed.exists()
    renamed.rename(tmp_path / file.name)
    with claim(claimed):
        line = told(1)
        assert "3 of its trials are not scored yet" in line and "a sweep is at work, 5 of 8 trials of b" in line
        with claim(claimed) as again:
            assert again is None  # the report took nothing from the sweep
    claimed.write_text("process 1 on another\n")  # of a sweep that died
    assert "at work" not in told(1) and claimed.exists()
    claimed.unlink()
    files_of(folder, "a")[0].unlink()
    with claim(claimed):
        assert "no method is complete; a sweep is at work, 5 of 8" in told(2)
    (folder / "methods").rename(tmp_path / "methods")
    assert "methods is missing; copy it too" in told(2)
    (tmp_path / "methods").rename(folder / "methods")
    assert "no method is complete; run its sweep again to go on" in told(2)


def test_a_folder_that_is_given_twice_is_in_the_table_once(tmp_path, capsys):
    folder = write_run(tmp_path / "run", {"a": np.zeros(8, int)}, 4, 4).folder
    (tmp_path / "link").symlink_to(folder)
    assert command("report", folder) == 0
    alone = capsys.readouterr()
    assert command("report", folder, tmp_path / "run", tmp_path / "link") == 0
    twice = capsys.readouterr()
    assert twice.out == alone.out
    assert twice.err.count("is given twice, and counted once") == 2


def test_runs_of_several_robots_are_one_page_that_names_them_and_are_paired_only_when_asked(tmp_path, capsys):
    of = {"digests": {"trials": "1" * 16, "objects": "a", "hand_set": "b"}}
    other = {
        **of,
        "digests": {**of["digests"], "trials": "2" * 16, "robot": "c"},
        "robot": {"name": "ur3e", "digest": "c" * 64},
    }
    codes = {"a": np.zeros(20, int), "b": np.arange(20) % 3}
    folders = [write_run(tmp_path / n, codes, 10, 10, **how).folder for n, how in (("old", of), ("new", other))]
    out = tmp_path / "both.html"
    assert command("report", *folders, format="html", out=out) == 0
    assert "differ in robot (ur5e_2f85, ur3e)" in capsys.readouterr().err
    page = out.read_text()
    assert "ur5e/a" in page and "ur3e/a" in page and "old: ur5e_2f85; new: ur3e" in page
    assert command("compare", *folders) == 2
    assert "add --across-robots to compare" in capsys.readouterr().err
    assert command("compare", *folders, across_robots=True, format="json") == 0
    groups = json.loads(capsys.readouterr().out)
    assert groups[-1]["names"] == ["ur5e/a", "ur5e/b", "ur3e/a", "ur3e/b"]
    (same,) = [p for p in groups[-1]["pairs"] if (p["a"], p["b"]) == ("ur5e/b", "ur3e/b")]
    assert same["difference"] == 0 and same["verdict"] == "tied"
    hands = {**other, "digests": {**other["digests"], "hand_set": "x"}}
    strange = write_run(tmp_path / "strange", codes, 10, 10, **hands).folder
    assert command("compare", folders[0], strange, across_robots=True) == 2
    assert "differ in digests (hand_set)" in capsys.readouterr().err


def test_the_readers_own_scans_are_a_column_beside_sr(tmp_path, capsys):
    random = np.random.default_rng(2)
    rows = {m: random.choice([0, 2], 60) for m in "mn"}
    own = [{"name": n, "split": "S0", "built_in": False} for n in ("bowl", "cup", "eyeglasses", "hammer", "knife")]
    write_run(tmp_path / "run", rows, 30, 30)
    scans = write_run(tmp_path / "scans", {"m": rows["m"][::-1]}, 30, 30, objects=own)
    assert command("report", tmp_path / "run", scans=scans.folder, format="json") == 0
    found = {(r["split"], r["method"]): r for r in json.loads(capsys.readouterr().out)["rows"]}
    expected = {r.split: r for r in report.table_of(scans).rows}
    for split in ("S0", "S1", "Avg"):
        line, there = found[split, "m"], expected[split]
        assert line["sr_scans"] == there.rates["sr"].percent
        assert line["sr_scans_low"] == there.sr_new_categories.low < line["sr_scans"] < line["sr_scans_high"]
        assert found[split, "n"]["sr_scans"] is None
    assert command("report", tmp_path / "run", scans=scans.folder) == 0
    assert "SR scans" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"objects": [{"name": "cup", "split": "S0", "built_in": True}]}, "has built-in objects"),
        ({"configuration": {"name": "paper"}}, "another configuration"),
        ({"seed": 3}, "another seed"),
    ],
)
def test_a_run_that_is_none_of_scans_is_refused_as_their_column(tmp_path, capsys, change, said):
    write_run(tmp_path / "run", {"m": np.zeros(4, int)}, 2, 2)
    write_run(tmp_path / "scans", {"m": np.zeros(4, int)}, 2, 2, **change)
    assert command("report", tmp_path / "run", scans=tmp_path / "scans") == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_what_a_sweep_prints_is_the_tables_success_and_first_failures_in_few_lines(paper, expected):
    text = report.brief(paper)
    (heading, *rows), whole = md_tables(text)[0], md_tables(report.render(paper, "md"))
    failures = [c for c in COLUMNS if c not in ("sr", "t_plan_s", "t_exec_s", "t_tot_s")]
    shown = ["sr", *failures]
    at = [heading.index(report.HEADINGS[name]) for name in shown]
    for row in each(rows):
        cells = dict(zip(COLUMNS, expected[row[0], row[1]], strict=True))
        assert [row[i] for i in at] == [cells[name] for name in shown]
    new = whole[2][0].index("SR new obj.")  # one interval: that of new objects like these
    assert [r[heading.index("95 %")] for r in rows] == [r[new] for r in whole[2][1:]]
    assert len(rows) == len(whole[0]) - 1 and md_tables(text)[1:] == []
    lines = text.splitlines()
    assert lines[2 + len(rows)] == "" and len(lines) <= 25 and max(map(len, lines)) <= 100
    notes = lines[lines.index("", 3 + len(rows)) + 1 :]
    assert len(notes) <= 3 and "the mean of all objects" in notes[0] and "r2h-batch report RUN --full" in notes[-1]
    said = " ".join(text.split())
    assert all(f"{key}: {paper.origin[key]}" in said for key in ("preset", "trials"))
    assert f"benchmark: {paper.origin['protocol']}" in said and "protocol" not in said
    assert "digest" not in said  # programs read them: --format json


def test_what_must_be_known_of_a_row_is_printed_with_it_and_the_rest_is_counted(paper):
    more = replace(paper, misses=("It misses 3 of 10 poses.",), trained=("ours: trained on a_*",))
    said = " ".join(report.brief(more).split())
    assert "It misses 3 of 10 poses." in said and "1 more note, times" in said and "misses" not in report.brief(paper)
    alone = report.brief(replace(paper, trained=("ours: trained on a_*",)))
    assert r"trained on a\_\*" in alone and "more note" not in alone


@pytest.mark.parametrize("methods", [1, 6, 18, pytest.param(40, marks=pytest.mark.slow)])
def test_a_report_and_its_objects_have_25_lines_whatever_there_is(tmp_path, methods, capsys):
    rng, ends = np.random.default_rng(7), np.array([Outcome.SUCCESS, Outcome.PLAN], int)
    rows = {f"method {k}": ends[rng.integers(0, 2, 400)] for k in range(methods)}
    run = write_run(tmp_path / "run", rows, 200, 200)
    for line in (["report"], ["report", "--by-object"], *([["compare"]] if methods > 1 else [])):
        assert main([line[0], str(run.folder), *line[1:]]) == 0
        said = capsys.readouterr().out.splitlines()
        assert len(said) <= 25, (line, len(said))
        assert any("--full" in part for part in said)
        assert main([line[0], str(run.folder), *line[1:], "--full"]) == 0
        assert len(capsys.readouterr().out.splitlines()) > len(said)
    if methods > 16:  # a line for each method, with SR of each split
        table = report.table_of(run)
        (heading, *lines), *_ = md_tables(text := report.brief(table))
        assert heading[2:4] == ["SR S0", "SR S1"] and f"{methods - 16} more methods" in text
        for line in each(lines):  # a share is of the successes of both splits
            own = [r.shares for r in table.rows if r.method == line[0]]
            for name, word in each(report.OF_SUCCESSES.items()):
                there = [shares[name] for shares in own if name in shares]
                pooled = 100 * sum(rate.count for rate in there) / sum(rate.total for rate in there)
                assert line[heading.index(word)] == f"{pooled:.1f}"


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_each_run_of_a_table_is_judged_by_the_criteria_of_its_own_benchmark(order, capsys):
    folders = [SHIPPED / name for name in ("r2h-v2-as-planned", "r2h-v3-as-planned")]
    runs = [load_run(folders[k]) for k in order]
    both = report.table_of(join(runs), alike=False)
    lines = {(row.split, row.method): row for row in both.rows}
    for run in each(runs):
        for row in each(report.table_of(run).rows):
            name = row.method if (row.split, row.method) in lines else f"{run.folder.name}/{row.method}"
            found = lines.pop((row.split, name))
            assert found.rates == row.rates and found.counts == row.counts and found.shares == row.shares
            assert ("f_pick" in row.rates) == ("r2h-v3" in run.folder.name)
    assert not lines
    (said,) = (line for line in both.unjudged if line.startswith("r2h-v2-as-planned (r2h-v2) is not judged by "))
    assert {"pick", "presented", "received"} <= {*re.findall(r"[a-z]+", said)}
    # a short table has room for the first notes only: with a criterion more they are about that one
    told = report.brief(both) if both.unjudged == (said,) else report.render(both, "md")
    assert said.partition(":")[0] in told
    cells = {r["method"]: r["f_pick"] for r in csv.DictReader(io.StringIO(report.render(both, "csv")))}
    assert cells["r2h-v2-as-planned/oracle"] == "n/a" and cells["r2h-v3-as-planned/oracle"] == "0.0"
    for fmt in each(("md", "latex", "json")):
        assert "Handover-VA" in report.render(both, fmt)
    assert command("report", *(run.folder for run in runs)) == 0
    assert len(capsys.readouterr().out.splitlines()) <= 25


def test_lines_of_objects_have_the_same_keys_though_some_have_no_success(tmp_path):
    ends = np.where(np.arange(12) % 3 == 0, int(Outcome.PLAN), int(Outcome.SUCCESS))  # each first object fails
    run = write_run(tmp_path / "run", {"m": ends}, 6, 6)
    found = list(csv.DictReader(io.StringIO(report.object_lines(run, "csv"))))
    assert {row["presented"] for row in found if row["object"] in ("bowl", "hammer")} == {"n/a"}
    assert any(row["presented"] not in ("n/a", "") for row in found)
    first, *others = json.loads(report.object_lines(run, "json"))["rows"]
    assert all(row.keys() == first.keys() for row in each(others))


def test_only_objects_with_ten_trials_are_shown_the_hardest_first(tmp_path):
    rng, ends = np.random.default_rng(7), np.array([Outcome.SUCCESS, Outcome.PLAN], int)
    run = write_run(tmp_path / "run", {m: ends[rng.integers(0, 2, 89)] for m in "ab"}, 65, 24)
    (_, *rows), *others = md_tables(report.objects_brief(run))
    counts = {r["object"]: r["n"] for r in json.loads(report.object_lines(run, "json"))["rows"]}
    often = {name for name, n in counts.items() if n >= report.LEAST}
    assert not others and {r[1] for r in rows} == often
    rates = [float(r[3]) + float(r[4]) for r in rows]
    assert rates == sorted(rates)
    assert {*counts.values()} - {*range(report.LEAST, 100)}  # others have fewer
    few = write_run(tmp_path / "few", {"a": ends[:1].repeat(6)}, 6, 0)
    assert "No object has 10 trials" in report.objects_brief(few)


def test_sr_says_how_many_rows_a_criterion_that_came_later_never_judged(tmp_path, monkeypatch, capsys):
    run = write_run(tmp_path / "run", {"a": np.zeros(8, int), "b": np.zeros(8, int)}, 4, 4)
    words = "centred (since strange 1.0) never judged 16 rows of a, b: SR counts as successes some that may fail it."
    assert report.table_of(run).unjudged == ()
    later = codes.REGISTRY[0]._replace(name="centred", since="strange 1.0")
    monkeypatch.setattr(codes, "REGISTRY", (*codes.REGISTRY, later))
    monkeypatch.setattr(codes, "CRITERIA", (*codes.CRITERIA, "centred"))
    assert codes.never_judged(run) == [words] == list(report.table_of(run).unjudged)
    assert words in json.loads(report.render(report.table_of(run), "json"))["notes"]
    assert "centred (since strange 1.0) never judged 16 rows of a, b" in report.brief(report.table_of(run))
    assert main(["compare", str(run.folder)]) == 0
    assert "never judged 16 rows of a, b" in " ".join(capsys.readouterr().out.split())


def test_what_a_method_says_that_it_learned_from_is_text_in_markdown(paper):
    words = "mine: says that it was trained on <img src=x onerror=alert(1)> [x](javascript:alert(1)) | a."
    text = report.render(replace(paper, trained=(words,)), "md")
    assert "\\<img" in text and "\\[x](javascript" in text and "\\| a." in text
    assert all(note in " ".join(text.split()) for note in (" ".join(n.split()) for n in paper.notes))
