"""Published figures follow from stored rows, the rows from this code, and all of it from one clean commit
(bench/tables.py)."""

import hashlib
import json
import re
import subprocess
from itertools import product
from pathlib import Path

import pytest

from r2h_batch.base.registry import DEFAULT_BENCHMARK
from r2h_batch.report.compare.stored import SHIPPED
from r2h_batch.runs import provenance
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.judge import Judge
from r2h_batch.sweep.results.reevaluation import reevaluate

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
NAMES = (*("table1-v1", "table1-v1-paper-preset", "table1-v1-release-preset"), *("table1-release", "table1-v0"))


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import tables

    return tables


def made_from():
    return json.loads((RESULTS / "made_from.json").read_text())


def rejudged(rows, n):
    """Differences of `n` rows of each method; which rows follows from the code, so that other code draws other ones."""
    run = load_run(rows)
    judge = Judge(run)
    judge.other = judge.other or ("code",)  # the digest of the code changes with every comment
    seed = int(provenance.code_digest()[:12], 16)
    return [d for m in run.methods for d in reevaluate(run, m, n, judge, seed=seed).differences]


@pytest.mark.parametrize("name", NAMES)
def test_a_sample_of_each_tables_rows_is_judged_the_same_by_this_code(tables, name):
    (published,) = [p for p in tables.TABLES if p.name == name]
    assert list(map(str, rejudged(ROOT / published.rows, 1))) == []


def test_a_sample_of_the_rows_that_came_later_is_judged_the_same_by_this_code(tables):
    (published,) = [p for p in tables.PUBLISHED if p.name == "r2h-v2-learned"]
    assert list(map(str, rejudged(ROOT / published.rows, 3))) == []


V3 = {"methods": "r2h-v3-as-planned", "seen": "r2h-v3-sees-cell-v1"}
"""Part of bench/results/r2h_v3.json -> the shipped rows that it counts."""


@pytest.mark.parametrize("part", V3)
def test_the_rates_of_r2h_v3_are_those_of_its_rows_and_both_are_of_one_commit(part):
    measured = json.loads((ROOT / "bench" / "results" / "r2h_v3.json").read_text())
    run = load_run(SHIPPED / V3[part])
    assert measured["commit"] == run.header["git_commit"] and list(measured[part]) == list(run.methods)
    for method in run.methods:
        rows = sorted(run.trials(method).to_pylist(), key=lambda r: r["trial_id"])
        assert "".join(str(int(r["outcome"] == "success")) for r in rows) == measured[part][method]["won"], method


@pytest.mark.parametrize(
    ("part", "n"),
    [
        pytest.param("methods", 1, marks=pytest.mark.whole(part="golden")),
        pytest.param("methods", 40, marks=pytest.mark.slow),
        pytest.param("seen", 20, marks=pytest.mark.slow),
    ],
)
def test_a_sample_of_the_rows_of_r2h_v3_is_judged_the_same_by_this_code(part, n):
    assert list(map(str, rejudged(SHIPPED / V3[part], n))) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_all_published_rows_are_judged_the_same_by_this_code(tables, name):
    (published,) = [p for p in tables.TABLES if p.name == name]
    assert list(map(str, rejudged(ROOT / published.rows, 1000))) == []


def test_everything_was_made_from_one_clean_commit_with_the_verdicts_of_today(tables):
    made = made_from()
    assert made["golden"] == tables.golden_digest(), "verdicts moved: run `make tables` on a clean commit"
    headers = [load_run(ROOT / p.rows).header for p in tables.PUBLISHED]
    default = [h for h in headers if h["protocol"] == DEFAULT_BENCHMARK]  # swept when it was frozen
    later = [load_run(ROOT / p.rows).header for p in tables.PUBLISHED if p.methods == tables.LEARNED]
    first = [h for h in default if h not in later]
    others = [h for h in headers if h["protocol"] != DEFAULT_BENCHMARK]
    sensitivity = json.loads((RESULTS / "sensitivity.json").read_text())
    assert {h["git_commit"] for h in others} == {made["commit"]}
    assert len({h["digests"]["code"] for h in others}) == 1
    assert {sensitivity["benchmark"]["digest"]} == {h["digests"]["benchmark"] for h in default}
    for own, key in product((first, later), (lambda h: h["git_commit"], lambda h: h["digests"]["code"])):
        assert len({key(h) for h in own}) == 1 < len(own)
    assert len({h["digests"]["benchmark"] for h in default}) == 1 < len(default) == len(first) + len(later)
    assert all(re.fullmatch("[0-9a-f]{40}", h["git_commit"]) for h in headers)
    for name, digest in made["pictures"].items():
        assert hashlib.sha256((ROOT / "docs" / name).read_bytes()).hexdigest() == digest, name


def test_the_commit_is_part_of_this_history():
    git = ["git", "-C", str(ROOT)]
    try:
        shallow = subprocess.run([*git, "rev-parse", "--is-shallow-repository"], capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("no git")
    if shallow.stdout.strip() != "false":
        pytest.skip("no checkout with its history")
    assert subprocess.run([*git, "merge-base", "--is-ancestor", made_from()["commit"], "HEAD"]).returncode == 0


@pytest.mark.parametrize("path", sorted(p.name for p in RESULTS.glob("*") if p.is_file() and p.suffix != ".png"))
def test_no_published_file_names_a_place_on_a_machine_or_a_changed_checkout(path):
    text = (RESULTS / path).read_text()
    assert not re.search(r"(?<![\w.~])/(work|tmp|home|root|Users|mnt|opt|usr)/", text)
    assert "-dirty" not in text and "\nNext:" not in text
