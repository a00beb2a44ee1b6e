"""A method's name is data: every output says it as it is, and nothing in it is markup, code or a formula."""

import csv
import html.parser
import io
import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from made_runs import write_run
from markdown_it import MarkdownIt

from r2h_batch.base.table import tex
from r2h_batch.report import page
from r2h_batch.report.compare.text import render as render_comparison
from r2h_batch.report.statistics.paired import compare, pair_up
from r2h_batch.report.table import object_lines, render, table_of
from r2h_batch.report.text import short_names
from r2h_batch.types import Outcome

ODD = (
    r"\input{x}", r"a\1b\g<0>", "<script>x</script>", "a\"b' on=x", "$x^2_{y", "a|b\\|c\\", "=1+1", "&lt;#010203",
    "{{ 7*7 }}{% x", "![p](http://x)`", "Ünï–Ωж", "%s{0}_a_ ~~b~~",
)  # fmt: skip
SHORT = short_names(ODD)
FULL = "Method <b>$x$</b> \\1 of a long name (in brackets | and pipes)"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("odd") / "run"
    return write_run(folder, {name: np.arange(8) % (2 + k % 5) for k, name in enumerate((*ODD, FULL))}, 4, 4)


class Text(html.parser.HTMLParser):
    """The text of each element, the attributes, and the tags of a page; tags must close."""

    EMPTY = ("meta", "br", "input", "img", "hr")

    def __init__(self, source):
        super().__init__()
        self.open, self.tags, self.attributes, self.text = [], [], [], []
        self.feed(source)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += attributes
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += attributes

    def handle_data(self, data):
        self.text.append(data)


def shown(markdown):
    """HTML of a text by a Markdown engine that lets HTML through."""
    return Text(MarkdownIt("commonmark").enable(["table", "strikethrough"]).render(markdown))


def names_in(texts, wanted):
    """The wanted names that stand alone in a text."""
    return {name for name in wanted if any(t.strip() == name.strip() for t in texts)}


def test_markdown_tables_show_every_name_and_hold_no_markup(run):
    wanted = set(SHORT.values())
    compared = compare(pair_up([run]), draws=50)
    for text in (render(table_of(run), "md"), object_lines(run), render_comparison(compared, "md")):
        found = shown(text)
        assert names_in(found.text, wanted) == wanted
        assert not {"script", "b", "img", "a", "em", "s"} & set(found.tags)
        assert FULL in " ".join("".join(found.text).split())


def test_csv_and_json_give_the_names_back_and_no_cell_is_a_formula(run):
    compared = compare(pair_up([run]), draws=50)
    for table, json_text, key in (
        (render(table_of(run), "csv"), render(table_of(run), "json"), "method"),
        (object_lines(run, "csv"), object_lines(run, "json"), "method"),
        (render_comparison(compared, "csv"), render_comparison(compared, "json"), "a"),
    ):
        cells = [row[key] for row in csv.DictReader(io.StringIO(table))]
        assert not [c for c in cells if c.startswith(("=", "+", "-", "@"))]
        assert {c.removeprefix("'") for c in cells} >= {*ODD}
        text = json.dumps(json.loads(json_text), ensure_ascii=False)
        assert all(json.dumps(name, ensure_ascii=False) in text for name in ODD)


def test_the_page_and_its_charts_say_the_names_and_gain_no_tag(run, tmp_path):
    picture = {"src": "data:,", "trial": "1", "href": "x"}
    gallery = {n: [{**picture, "alt": f"1 of {n}", "caption": n, "command": n}] for n in ODD}
    outcomes = np.array([*range(6), Outcome.INVALID_INPUT, Outcome.INVALID_SIM])
    usual = page.page(write_run(tmp_path / "run", {"a": outcomes, "b": outcomes}, 4, 4), {"a": gallery[ODD[0]]})
    text = page.page(run, gallery)
    found, allowed = Text(text), Text(usual)
    assert set(found.tags) <= set(allowed.tags)
    assert found.tags.count("script") == allowed.tags.count("script")
    assert {name for name, _ in found.attributes} <= {name for name, _ in allowed.attributes}
    titles = {value for key, value in found.attributes if key in ("title", "value")}
    assert {*ODD} <= titles and names_in(found.text, ODD) == {*ODD}
    assert {f"1 of {name}" for name in ODD} <= {value for key, value in found.attributes if key == "alt"}
    block = json.loads(re.search(r'<script type="application/json" id=trials>(.*?)</script>', text)[1])
    assert {*ODD} <= block["methods"].keys()
    charts = [ElementTree.fromstring(c) for c in re.findall(r"<svg.*?</svg>", text, re.DOTALL)]
    drawn = {"".join(e.itertext()) for c in charts for e in c.iter("{http://www.w3.org/2000/svg}text")}
    assert {*SHORT.values()} <= drawn
    labels = [c.attrib["aria-label"] for c in charts]
    assert all(any(label.startswith(f"{name}. S0: ") for label in labels) for name in SHORT.values())
    colors = {value for c in charts for e in c.iter() for value in e.attrib.values() if "#010203" in value}
    assert all("&lt;" in value for value in colors)  # in the name's label alone


def test_latex_rows_hold_the_names_with_every_special_character_escaped(run):
    compared = compare(pair_up([run]), draws=50)
    for text in (
        render(table_of(run), "latex"),
        render(table_of(run), "latex", columns=1),
        render_comparison(compared, "latex"),
    ):
        body = text[text.index(r"\begin{tabular}") :]
        assert all(tex(name) in body for name in SHORT.values()) and r"\input" not in body
        assert all(line.startswith("% ") for line in text.partition(r"\begin{tabular}")[0].splitlines())
