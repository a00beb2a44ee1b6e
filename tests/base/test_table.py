"""One table in five formats, read back by readers that are not ours; and what would break out of each."""

import csv
import html.parser
import io
import json
import re

import pytest

from r2h_batch.base.table import INTERVAL, NA, PERCENT, RATE, Column, Table, document, of_lines

NASTY = "a|b_ <i>&amp; 50% \\x {y} $z$ #1 ~^ [l](u) `c`"
RECORDS = (
    {"name": "plain", "n": 1200, "sr": 87.5, "sr_low": 52.9, "sr_high": 97.8, "sr_of": 8, "gap_m": 0.0123, "on": True},
    {"name": NASTY, "n": 7, "sr": None, "sr_low": None, "sr_high": None, "sr_of": None, "gap_m": None, "on": False},
    {"name": "=1+1", "n": 0, "sr": 5.0, "sr_low": 1.0, "sr_high": 9.0, "sr_of": 40, "gap_m": -1.5, "on": True},
)
TABLE = Table(
    (
        Column("name", "Name", left=True, about="name"),
        Column("n", "N", group="Counts"),
        Column("sr", "SR", PERCENT, group="Rates", ends=True),
        Column("sr", "95 %", INTERVAL, group="Rates"),
        Column("sr", "both", RATE + " {of}"),
        Column("gap_m", "gap, mm", "{value:+.1f}", scale=1e3, none="-"),
        Column("on", "on", lambda r: "yes" if r["on"] else "no"),
    ),
    RECORDS,
    notes=("first note", "second note"),
    title="Of made rows",
    bold=frozenset({(0, "sr")}),
)
SHOWN = [
    ["plain", "1200", "87.5", "52.9-97.8", "87.5 [52.9, 97.8] 8", "+12.3", "yes"],
    [NASTY, "7", NA, NA, NA, "-", "no"],
    ["=1+1", "0", "5.0", "1.0-9.0", "5.0 [1.0, 9.0] 40", "-1500.0", "yes"],
]
HEAD = ["Name", "N", "SR", "95 %", "both", "gap, mm", "on"]


def markdown_rows(text):
    """Cells of the lines of a Markdown table: a backslash takes a sign's meaning."""
    lines = [line for line in text.splitlines() if line.count("|") > 3]
    cells = [re.split(r"(?<!\\)\|", line.strip().strip("|")) for line in lines]
    return [[re.sub(r"\\(.)", r"\1", c.strip()) for c in line] for line in cells]


def test_markdown_says_every_cell_and_the_notes():
    head, rule, *rows = markdown_rows(TABLE.md())
    assert head == HEAD and rows == SHOWN
    assert [cell.endswith(":") for cell in rule] == [False] + [True] * 6
    assert TABLE.md().startswith("Of made rows\n\n") and TABLE.md().endswith("\n\n- first note\n- second note")
    assert not re.search(r"(?<!\\)(<i>|`|\[l)", TABLE.md()), "a name is no markup"


def test_csv_has_every_value_and_runs_no_formula():
    rows = list(csv.DictReader(io.StringIO(TABLE.csv())))
    assert [list(r) for r in rows] == [list(r) for r in RECORDS]
    assert rows[2]["name"] == "'=1+1" and rows[1]["name"] == NASTY
    for row, record in zip(rows, RECORDS, strict=True):
        own = {k: NA if v is None else str(v) for k, v in record.items() if k != "name"}
        assert {k: v for k, v in row.items() if k != "name"} == own


def test_json_has_every_value_with_its_type():
    found = json.loads(TABLE.json(origin={"a": 1}))
    assert found == {"format": 1, "origin": {"a": 1}, "rows": list(RECORDS), "notes": ["first note", "second note"]}
    assert "notes" not in json.loads(Table((), RECORDS).json())
    with pytest.raises(ValueError, match="JSON"):
        Table((), [{"x": float("nan")}]).json()


UNTEX = {r"\textbackslash{}": "\\", r"\textasciitilde{}": "~", r"\textasciicircum{}": "^", r"\textbar{}": "|"}
UNTEX |= {r"\textless{}": "<", r"\textgreater{}": ">"}


def untex(cell):
    """The text of a cell as LaTeX prints it."""
    cell = cell.strip().removeprefix(r"\bfseries ")
    cell = re.sub(r"\\text[a-z]+\{\}", lambda m: chr(0xE000 + list(UNTEX).index(m[0])), cell)
    cell = re.sub(r"(?<!\\)[{}]", "", cell)
    cell = re.sub(r"\\([&%$#_{}])", r"\1", cell)
    return "".join(UNTEX[list(UNTEX)[ord(c) - 0xE000]] if ord(c) >= 0xE000 else c for c in cell)


def tex_rows(text):
    lines = [x for x in text.splitlines() if x.endswith(r" \\")]
    return [[untex(c) for c in re.split(r"(?<!\\)&", x.removesuffix(r" \\"))] for x in lines]


def test_latex_says_every_cell_between_its_rules():
    text = TABLE.latex()
    (over, head, *rows), comments = tex_rows(text), text.partition(r"\begin")[0].splitlines()
    assert rows == SHOWN and head == HEAD
    assert over == ["", "Counts", r"\multicolumn2cRates", "", "", ""] and r"\cmidrule(lr){3-4}" in text
    assert r"\bfseries 87.5" in text and r"{n/a}" in text
    kinds = re.search(r"pt\}\}(.*)@\{\}\}", text)[1]
    assert re.sub(r"\[table-format=(.*?),.*?\]", r"(\1)", kinds) == "lS(4.0)S(2.1)ccS(+4.1)c"
    assert comments == [r"% needs \usepackage{booktabs,siunitx}", "% first note", "% second note"]
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")


def test_latex_writes_intervals_below_and_parts_between_rules():
    parts = Table(TABLE.columns, RECORDS, groups=[("$N=2$", 2), ("", 1)]).latex(intervals=True)
    assert r"{\scriptsize [52.9, 97.8]}" in parts and parts.count(r"\\[2pt]") == 3
    assert parts.count(r"\midrule") == 2 and r"\multicolumn{7}{@{}l}{$N=2$} \\" in parts
    evil = Table(TABLE.columns, RECORDS, notes=["a\n\\input{/etc/passwd}\r% b"]).latex().partition(r"\begin")[0]
    assert all(line.startswith("% ") for line in evil.splitlines())


class Rows(html.parser.HTMLParser):
    """Texts of the cells, row by row, without the small intervals; tags must close in order."""

    def __init__(self):
        super().__init__()
        self.rows, self.open, self.about = [], [], []

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
            self.about.append(dict(attributes))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if {"td", "th"} & set(self.open) and "small" not in self.open:
            self.rows[-1][-1] += data


def test_html_says_every_cell_and_its_order():
    reader = Rows()
    reader.feed(TABLE.html(name="t", sortable=True, least=10, rows="on"))
    assert reader.rows == [HEAD, *SHOWN] and reader.open == []
    cells = reader.about[len(HEAD) :]
    assert cells[7]["title"] == NASTY and cells[1]["data-v"] == "1200" and cells[9]["data-v"] == "-1"
    assert cells[2]["class"] == "few" and cells[2]["title"] == "of 8" and "class" not in cells[16]
    text = TABLE.html()
    assert "<b>87.5</b><small>52.9\u201397.8</small>" in text and "data-v" not in text and "<i>" not in text
    assert "<li>first note</li>" in text and "<b>Of made rows</b>" in text


def test_a_document_leaves_out_tables_without_records():
    some = of_lines(["", "b"], [["x", "1"]], title="T")
    assert document([some, of_lines(["a"], []), "", "end"]) == f"{some.md()}\n\nend\n"


@pytest.mark.parametrize(("width", "outer"), [(20, True), (85, False)])
def test_wide_markdown_loses_its_outer_pipes(width, outer):
    text = of_lines(["a", "b"], [["x" * width, "y" * 12]]).md()
    assert all(line.startswith("|") == outer for line in text.splitlines())
