"""Every rate that a page states is the one of its JSON, or is listed with what it is instead (tests/rates.tsv).

Pages state rates in three ways: a bench writes the whole page from its JSON, a block of figures takes them from a JSON
(tests/test_figures.py), or a person wrote them. What a person wrote is a definition, a figure of a publication, the tolerance
of a test, or what a command prints. tests/rates.tsv says which. Anything else fails here.
"""

import ast
import importlib
import json
import re
import sys
from pathlib import Path

import pytest
from rounds import each

ROOT = Path(__file__).resolve().parents[1]
RATE = re.compile(r"(?<![\d.,])\d{1,3}(?:\.\d+)? ?(?:%|percent\b|points\b)")
OF_INTERVALS = re.compile(r"(?<![\d.])95 %(?= (?:t )?intervals?\b| \(Wilson\)|\)|:| all\b|,? mm\b| of the difference)")
"""Whose confidence is no rate."""
RATES_IN_HEAD = re.compile(r"\b(?:SR|AUC|IoU|F_\w+|success rates?|share)\b")
NUMBER = re.compile(r"\d")
KINDS = {"definition", "publication", "test", "command", "history"}
"""history: of an earlier version, as the sentence says; its rows are gone."""
ALSO_BY_TABLES = {"closed_loop", "families", "reception"}
"""Benches whose pages bench/tables.py writes too: tests/test_published.py compares these."""
OWN_WORDS = ("bench/gpu.py", "bench/watch.py")
"""Benches that write no page of docs/."""


@pytest.fixture(scope="module", autouse=True)
def bench():
    sys.path.insert(0, str(ROOT / "bench"))
    yield
    sys.path.remove(str(ROOT / "bench"))


def writers():
    """Page of docs/results -> the benches that write the whole of it from one JSON each."""
    found = {}
    for path in sorted((ROOT / "bench").glob("*.py")):
        text = path.read_text("utf-8")
        if path.name != "_report.py" and "page_from(parser" in text:
            (page,) = re.findall(r'PAGE =.*?"docs" / "results" / "([\w-]+\.md)"', text)
            stored = ROOT / "bench" / "results" / f"{path.stem}.json"
            written = (ROOT / "docs" / "results" / page).exists() and f"docs/results/{page}" not in found
            if stored.exists() or written:  # else nobody has measured it yet; two benches may share a page
                found.setdefault(f"docs/results/{page}", []).append(path.stem)
    return found


def by_tables():
    """Pages that bench/tables.py writes (tests/test_published.py compares them), but README.md, of which it writes a block."""
    names = ("table1-v1", "sensitivity", "findings", "ranks", "sources")
    return {f"docs/results/{name}.md" for name in names} | {"docs/results/scans.md"}  # tests/test_scans.py


def test_each_page_that_a_bench_writes_is_what_its_json_gives():
    own = ((page, name) for page, names in writers().items() for name in names if name not in ALSO_BY_TABLES)
    for page, name in each(own):
        module = importlib.import_module(name)
        stored = json.loads((ROOT / "bench" / "results" / f"{name}.json").read_text("utf-8"))
        written = module.markdown(stored)
        assert (ROOT / page).read_text("utf-8") == written, f"python bench/{name}.py --render writes {page} again"


def by_hand(text):
    """The text of a page that a person wrote: without blocks of figures, README's Table I and code."""
    import families
    import figures

    text = families.TABLE.sub("", figures.BLOCK.sub("", text))
    return re.sub(r"<!--.*?-->|```.*?```", "", text, flags=re.DOTALL)


def sentences(text):
    """Sentences, items and rows of tables, each with whether the head of its table says that there are rates in it."""
    for part in text.split("\n\n"):
        lines = part.splitlines()
        if len(lines) > 1 and re.fullmatch(r"[|:\s-]+", lines[1]):
            yield lines[0], False
            yield from ((line, bool(RATES_IN_HEAD.search(lines[0]))) for line in lines[2:])
            continue
        for item in re.split(r"\n(?=\s*[-|*\d]\.? )", part):
            for one in re.split(r"(?<=[.:;!?]) (?=[A-Z`*\[])", " ".join(item.split())):
                yield one, False


def stated(text):
    """Sentences with a rate."""
    return [
        one
        for one, rates in sentences(text)
        if RATE.search(OF_INTERVALS.sub("", one)) or (rates and NUMBER.search(one))
    ]


def words_of_benches():
    """(bench, words) with a rate that stands in the words of a page that the bench writes, and in no JSON."""
    for path in sorted((ROOT / "bench").glob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        spoken = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}  # docstrings
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in spoken:
                for one in stated(node.value):
                    yield path.relative_to(ROOT).as_posix(), one


def listed():
    """Lines of tests/rates.tsv: page, words, kind, what it is."""
    head, *lines = (ROOT / "tests" / "rates.tsv").read_text("utf-8").splitlines()
    assert head.split("\t") == ["page", "words", "kind", "what it is"]
    return [tuple(line.split("\t")) for line in lines]


def all_stated():
    """(page, sentence) of all that persons wrote."""
    import figures

    whole = writers().keys() | by_tables()
    for path in figures.pages():
        page = path.relative_to(ROOT).as_posix()
        if page not in whole:
            yield from ((page, one) for one in stated(by_hand(path.read_text("utf-8"))))
    yield from ((page, one) for page, one in words_of_benches() if page not in OWN_WORDS)


def test_every_rate_that_a_person_wrote_is_listed_with_what_it_is():
    rows, used = listed(), set()
    for page, one in each(all_stated()):
        mine = [row for row in rows if row[0] == page and row[1] in one]
        assert mine, f"{page}: take the rate from a JSON (a block of figures), or list it in tests/rates.tsv: {one}"
        used |= {*mine}
    assert {*rows} == used, "no page says this any more: delete the line"


def test_each_line_of_the_list_says_what_it_is():
    for _, words, kind, what in each(listed()):
        assert kind in KINDS and what and NUMBER.search(words)
        if kind == "test":
            file, _, name = what.partition("::")
            assert f"def {name}(" in (ROOT / file).read_text("utf-8"), what


def test_rates_of_table_one_are_counted_in_the_rows_that_ship():
    import families

    stored = json.loads((ROOT / "bench" / "results" / "families.json").read_text("utf-8"))
    found = json.loads(json.dumps(families.of_rows(families.SHIPPED)))
    for now, then in each(zip(found["table"]["rows"], stored["table"]["rows"], strict=True)):
        assert {k: v for k, v in now.items() if not k.startswith("t_")} == {
            k: v for k, v in then.items() if not k.startswith("t_")
        }
    for part in each(("compared", "oracle", "spreads")):
        assert found[part] == stored[part], "python bench/families.py --counted"
    (whole,) = (c for c in stored["compared"] if c["group"] == "all")
    for pair in each(whole["pairs"]):
        own = stored["spreads"]["pairs"][f"{families.short(pair['a'])} - {families.short(pair['b'])}"]
        assert own["difference"] == pytest.approx(pair["difference"])
        half = families.half_width(own, 16, 6)
        assert half == pytest.approx((pair["high"] - pair["low"]) / 2, rel=0.05)
