"""Figures and tables of the pages are those of committed JSON, the JSON are those of the rows beside them, and all were
measured in one go by (nearly) the present code (bench/figures.py)."""

import importlib
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rounds import each

from r2h_batch.report.table import record, table_of
from r2h_batch.runs.store import load_run

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.check
APART = {
    "people",
    "gates",
    "networks",
    "observe_export",
    "sees",
}
APART |= {"meshes", "r2h_v3", "growth", "gradients", "training_loop"}
APART |= {"registry_arms", "closed_loop", "reception", "robots", "robustness", "adversary", "generators", "rating"}
"""Measured alone, on a commit of its own, since `make bench` has measured the others."""
LONG = {"families", "judge_again", "learn"}
"""Benches of hours, which `make bench` leaves out; their pages name the command."""
OF_OTHERS = {"release", "scanned", "scans", "vendors"}
"""Benches that need files that nobody may commit: `make bench` takes them only if it is given these (RELEASE=, SCANNED=,
SCANS=, VENDORS=). Whoever lacks the files cannot measure again, so their pages name the commit that was measured."""
BY_HAND = OF_OTHERS | LONG


@pytest.fixture(scope="module")
def figures():
    sys.path.insert(0, str(ROOT / "bench"))
    try:
        import figures

        yield figures
    finally:
        sys.path.remove(str(ROOT / "bench"))


@pytest.fixture(scope="module")
def measured(figures):
    return figures.stored()


def test_every_json_says_where_it_comes_from(measured):
    assert len(measured) > 10 and {n: m.lacks() for n, m in measured.items() if m.lacks()} == {}
    assert {n: k for n, m in measured.items() if (k := m.data.get("changed_files"))} == {}


def by_blocks(figures, measured):
    """(page, its text with the figures of the JSON) of pages that persons write."""
    texts = {page: page.read_text("utf-8") for page in figures.pages()}
    values = figures.all_values(measured, texts.values())
    for page, text in texts.items():
        closed = len(figures.BLOCK.findall(text))
        assert text.count("<!-- figures") == closed, f"{page}: a block of figures is not closed"
        if closed:
            yield page, figures.rendered(text, values)


def by_tables():
    """(page or file, its text) of what bench/tables.py writes from the rows of Table I and from JSON."""
    tables = importlib.import_module("tables")
    return ((ROOT / path, text) for path, text in tables.render_all().items())


def test_figures_and_tables_of_every_page_are_those_of_their_json(figures, measured):
    written = set()
    for command, pages in (
        ("figures.py --write", by_blocks(figures, measured)),
        ("tables.py --render", by_tables()),
    ):
        for page, text in each(pages, 8):
            written.add(page)
            assert page.read_text("utf-8") == text, f"{page}: python bench/{command} writes it again"
    results = {*(ROOT / "docs" / "results").glob("*.md")}
    assert results <= written


def test_every_json_that_a_page_cites_is_here_and_every_json_is_cited(figures, measured):
    used = set().union(*(figures.cited(p.read_text("utf-8"), measured) for p in figures.pages()))
    assert used == {*measured}


def test_no_page_shows_figures_of_other_code(figures, measured):
    own = {n: m for n, m in measured.items() if n not in OF_OTHERS}
    assert {n: why for n, m in own.items() if (why := m.outdated())} == {}, "measure again: make bench"


@pytest.mark.parametrize("name", sorted(OF_OTHERS))
def test_a_page_names_the_commit_of_figures_that_need_files_of_others(figures, measured, name):
    citing = [text for p in figures.pages() if name in figures.cited(text := p.read_text("utf-8"), measured)]
    assert citing and all(f"commit {measured[name].data['commit'][:12]}" in text for text in citing)


def test_all_figures_were_measured_in_one_go_on_one_machine(measured):
    made = {
        n: (m.data["commit"], m.data["hardware"]["cpu"])
        for n, m in measured.items()
        if n not in BY_HAND | APART and not m.lacks()
    }
    assert len({*made.values()}) == 1, made


def test_make_bench_measures_every_json(measured):
    text = (ROOT / "Makefile").read_text("utf-8")
    several = [w for line in re.findall(r"^BENCHES := (.*)", text, re.MULTILINE) for w in line.split()]
    recipe = text.partition("\nbench:")[2].partition("\n\n")[0]
    several += [w for line in re.findall(r"for b in ([\w ]+);", recipe) for w in line.split()]
    several += re.findall(r"bench/results/(\w+)\.json", recipe) + ["closed_loop_growth"] * ("--growth" in recipe)
    assert {*several} | LONG == {*measured}


OWN_GATE = {"fc": "hand", "handover_va": "ik", "contact": "none", "intent": "none"}


def rates_in(name: str):
    """(method, options, split) -> percent of successes, counted in the rows of bench/options/NAME."""
    folder = ROOT / "bench" / "options" / name
    for file in sorted((folder / "methods").glob("*.json")):
        text = file.read_text("utf-8")
        assert '"/' not in text and str(ROOT) not in (folder / "run.json").read_text("utf-8")
        source = json.loads(text)["source"]
        method = source["function"].split(":")[0].rpartition(".")[2]
        parts = sorted((folder / "shards" / file.stem).glob("*.parquet"))
        rows = pa.concat_tables([pq.read_table(p, columns=["split", "outcome"]) for p in parts]).to_pylist()
        for split in ("S0", "S1"):
            won = [r["outcome"] == "success" for r in rows if r["split"] == split]
            yield (method, source.get("options", ""), split), 100 * sum(won) / len(won), len(won)


def test_the_rates_of_the_gates_are_those_of_their_stored_rows(measured):
    values, seen = measured["gates"].values, set()
    for (method, options, split), rate, n in each(rates_in("gates")):
        gate = options.removeprefix("gate=") or OWN_GATE[method]
        assert rate == pytest.approx(values[f"gates.{method}.{gate}.{split.lower()}"], abs=1e-9)
        assert n == values["gates.trials"]
        seen.add((method, gate, split))
    assert len(seen) == 4 * 3 * 2
    page = (ROOT / "docs" / "baselines.md").read_text("utf-8")
    assert "the same: Intent, Contact, FC, Handover-VA." in page
    for gate in each(("none", "ik", "hand")):
        means = [values[f"gates.{m}.{gate}.avg"] for m in ("intent", "contact", "fc", "handover_va")]
        assert means == sorted(means, reverse=True)


def test_the_rates_of_the_networks_are_those_of_their_stored_rows(measured):
    values, seen = measured["networks"].values, set()
    names = {"": "all_categories", "contacts=other-categories": "other_categories"}
    for (method, options, split), rate, n in each(rates_in("networks")):
        assert rate == pytest.approx(values[f"networks.{names[options]}.{split.lower()}.sr"], abs=1e-9)
        assert n == values["networks.trials"] and method == "contact"
        seen.add((options, split))
    assert len(seen) == 4
    shown = [e.name for e in load_run(ROOT / "bench" / "options" / "networks").entries]
    assert ["VoxNet" in name for name in shown] == ["trees" not in name for name in shown] == [True, False]
    assert 0.5 < values["networks.other_categories.region_auc"] < values["networks.all_categories.region_auc"]


@pytest.mark.parametrize("name", ["robots", "robustness"])
def test_the_rates_of_a_page_are_those_of_its_rows(name):
    data = json.loads((ROOT / "bench" / "results" / f"{name}.json").read_text("utf-8"))
    folders = [p for p in (ROOT / "bench" / "options" / name).iterdir() if p.is_dir()]
    by_size = sorted(p.name for p in folders) if name == "robots" else sorted((p.name for p in folders), key=size_of)
    for folder in each(folders):
        rows = {r.method.partition(" (")[0]: record(r) for r in table_of(load_run(folder)).rows if r.split == "Avg"}
        assert len(rows) == 6
        for method, row in rows.items():
            assert row["n"] == 2 * data["trials"]
            if name == "robots":
                stored = data["robots"][folder.name]["table"][method]
                assert "sr" in stored  # later code has more columns
                assert {k: stored[k] for k in row if k in stored} == {k: v for k, v in row.items() if k in stored}
            else:
                (curve,) = [c for c in data["curves"] if c["method"].partition(" (")[0] == method]
                level = by_size.index(folder.name)
                assert row["sr"] == pytest.approx(curve["sr"][level]["percent"])
                assert data["rates"][method][level].startswith(f"{row['sr']:.1f} [")


def size_of(name):
    """Millimetres that a folder is named after."""
    return int(name.partition("mm")[0])


def test_rates_of_table_one_are_counted_in_the_rows_that_ship(figures):
    families = importlib.import_module("families")
    stored = json.loads((ROOT / "bench" / "results" / "families.json").read_text("utf-8"))
    found = json.loads(json.dumps(families.of_rows(families.SHIPPED)))
    for now, then in each(zip(found["table"]["rows"], stored["table"]["rows"], strict=True)):
        assert {k: v for k, v in now.items() if not k.startswith("t_")} == {
            k: v for k, v in then.items() if not k.startswith("t_")
        }
    for part in each(("compared", "oracle")):
        assert found[part] == stored[part], "python bench/families.py --counted"


def test_what_the_first_page_claims_follows(measured):
    kinematic = measured["throughput"].values["throughput.trials_per_s_warm"]
    simulated = 2 * 1000 / measured["execute"].values["execute.speed.mujoco.auto.whole_trial_core_ms"]
    claim = "thousands of handovers a second on two CPU cores, and over 100 a second if it also simulates the motion"
    assert claim in (ROOT / "README.md").read_text()
    assert kinematic > 2000 and simulated > 100


@pytest.fixture
def made(figures, tmp_path):
    """A JSON that measured four files of a folder."""
    (tmp_path / "code").mkdir()
    for name in "abcd":
        (tmp_path / "code" / f"{name}.py").write_text(f'"""{name}."""\nX = 1  # one\n')
    data = {
        "measures": ["code"],
        "source": figures.digests(["code"], tmp_path),
        "figures_since": 1,
        "values": {"x.y": 1234.5},
    }
    return figures.Measured("x", json.loads(json.dumps(data))), tmp_path


@pytest.mark.parametrize(
    ("text", "changed"),
    [
        ('"""Another sentence."""\n\n\nX = 1\n', []),
        ('"""a."""\nX = 2  # one\n', ["code/a.py"]),
        ('X = """a"""\n', ["code/a.py"]),
        ('def f():\n    # why\n    """Does."""\n    return 1\n', ["code/a.py"]),
    ],
)
def test_comments_and_docstrings_are_not_code_and_all_else_is(made, text, changed):
    measured, root = made
    (root / "code" / "a.py").write_text(text)
    assert measured.changed(root) == changed and measured.outdated(root) == ""


def test_figures_are_outdated_when_much_of_the_code_changed_or_a_person_says_so(figures, made, monkeypatch):
    measured, root = made
    (root / "code" / "a.py").unlink()
    assert measured.changed(root) == ["code/a.py"] and measured.outdated(root) == ""
    (root / "code" / "e.py").write_text("Y = 1\n")
    assert measured.outdated(root) == "2 of 4 measured files have changed"
    monkeypatch.setattr(figures, "CHANGED_SHARE", 1.0)
    assert measured.outdated(root) == ""
    raised = [*figures.FIGURES_SINCE, (2, ("x",), "the search is another one")]
    monkeypatch.setattr(figures, "FIGURES_SINCE", raised)
    assert "the search is another one" in measured.outdated(root)
    assert replace(measured, name="z").outdated(root) == ""


def test_a_changed_figure_and_an_unknown_one_are_found(figures, made):
    values = made[0].values
    text = "a\n\n<!-- figures\nIt takes {x.y:~2} us, {x.y*1000:.1e} ns.\n-->\n\nIt takes 1,300 us.\n\n<!-- end -->\n"
    assert "It takes 1,200 us, 1.2e+06 ns.\n\n<!-- end -->" in figures.rendered(text, values)
    assert figures.rendered(figures.rendered(text, values), values) == figures.rendered(text, values)
    assert figures.cited(text, {"x": made[0]}) == {"x"}
    with pytest.raises(KeyError, match="no JSON in bench/results has the figure"):
        figures.rendered(text.replace("x.y:", "x.z:"), values)
    assert figures.written(0.0, None, "~2") == "0.0" and figures.written(0.0234, None, "~2") == "0.023"
