"""docs/results/sources.md names what is behind each published figure: rows that are there, or a command that is."""

import json
import re
from pathlib import Path

import pytest
from rounds import each

from r2h_batch.report.table import record, table_of
from r2h_batch.runs.store import load_run

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
LIST = (RESULTS / "sources.md").read_text("utf-8")
BY_TABLES = {"findings", "ranks", "sensitivity", "sources", "table1-v1"}
"""Pages that bench/tables.py writes from the tables, from the JSON of other pages, or from a JSON beside them."""


def test_every_page_of_results_is_on_the_list():
    listed = {
        name
        for cell in re.findall(r"^\| \w+ \| (.*?) \|", LIST, re.MULTILINE)
        for name in re.findall(r"\[([\w-]+)\]", cell)
    }
    pages = {p.stem for p in RESULTS.glob("*.md")}
    assert pages - BY_TABLES <= listed, "a page without a bench: name its JSON on it, or its rows in bench/sources.py"


def test_every_json_and_every_folder_of_rows_is_on_the_list():
    for path in each(sorted((ROOT / "bench" / "results").glob("*.json"))):
        assert f"| {path.stem} | " in LIST
    folders = {*re.findall(r"`((?:bench/rows|bench/options|r2h_batch)/[\w/-]+)`", LIST)}
    kept = [
        p
        for place in ("bench/rows", "bench/options", *(f"r2h_batch/report/compare/{x}" for x in ("rows", "later")))
        for p in (ROOT / place).iterdir()
    ]
    assert {p.relative_to(ROOT).as_posix() for p in kept if p.is_dir()} == folders


def test_each_command_of_the_list_is_a_program_of_the_project():
    for line in each(re.findall(r"`(bench/\w+\.py)[^`]*`", LIST)):
        assert (ROOT / line).is_file(), line


def test_no_kept_row_says_where_it_was_made():
    for path in each(sorted((ROOT / "bench" / "options").rglob("*.json"))):
        assert not re.search(r'"/|/(tmp|work|home|root)/', path.read_text("utf-8")), path


@pytest.mark.parametrize("name", ["robots", "robustness"])
def test_the_rates_of_a_page_are_those_of_its_rows(name):
    data = json.loads((ROOT / "bench" / "results" / f"{name}.json").read_text("utf-8"))
    for folder in each(sorted(p for p in (ROOT / "bench" / "options" / name).iterdir() if p.is_dir())):
        rows = {r.method.partition(" (")[0]: record(r) for r in table_of(load_run(folder)).rows if r.split == "Avg"}
        assert len(rows) == 6
        for method, row in rows.items():
            assert row["n"] == 2 * data["trials"]
            if name == "robots":
                stored = data["robots"][folder.name]["table"][method]
                assert {k: stored[k] for k in row} == row
            else:
                (curve,) = [c for c in data["curves"] if c["method"].partition(" (")[0] == method]
                level = sorted(
                    (ROOT / "bench" / "options" / name).iterdir(), key=lambda p: int(p.name.partition("mm")[0])
                ).index(folder)
                assert row["sr"] == pytest.approx(curve["sr"][level]["percent"])
                assert data["rates"][method][level].startswith(f"{row['sr']:.1f} [")
