"""Tables for print: the paper's numbers cell by cell, and a page on which nothing sticks out."""

import re
import subprocess
from dataclasses import replace

import pytest
from made_runs import table_1
from needs import needs

from r2h_batch.report import table as report
from r2h_batch.report.compare.text import render as render_comparison
from r2h_batch.report.statistics.paired import compare, pair_up

COLUMNS = [name for name in report.HEADINGS if name in table_1()[0]]
"""The paper's: further criteria have more."""
AT = [list(report.HEADINGS).index(name) for name in COLUMNS]
DOCUMENT = r"""\documentclass[10pt,twocolumn]{article}
\usepackage[letterpaper,textwidth=516pt,columnsep=12pt,textheight=680pt]{geometry}
\usepackage{booktabs,siunitx,graphicx}
\begin{document}
WIDE
NARROW
\end{document}
"""


@pytest.fixture(scope="module")
def paper(paper_rows):
    return report.table_of(paper_rows)


def cells_of(text, columns):
    """(split, method) -> cells of the wide table, without braces and bold."""
    split, found = "", {}
    for line in text.splitlines():
        if heading := re.match(rf"\\multicolumn\{{{columns}\}}\{{@\{{\}}l\}}\{{(\w+), \$N=\d+\$\}}", line):
            split = heading[1]
        cells = [re.sub(r"\\bfseries |[{}]", "", c.strip()) for c in line.removesuffix(r" \\").split(" & ")]
        if len(cells) == columns and cells[0] and cells[0] != "Method":
            found[split, cells[0]] = cells[1:]
    return found


def test_the_wide_table_gives_back_every_cell_of_table_1(paper):
    text = report.render(paper, "latex", times=True)
    found = cells_of(text, 2 + len(report.HEADINGS) + len(paper.shares))  # and what the method may read
    assert {k: [v[place] for place in AT] for k, v in found.items()} == {
        (r["split"], r["method"]): [r[c] or "n/a" for c in COLUMNS] for r in table_1()
    }
    assert r"\multicolumn{2}{c}{Share (\%)} &  \\" in text and list(paper.shares) == ["presented", "upright"]
    for row in paper.rows:
        for own, name in enumerate(paper.shares):
            rate = row.shares.get(name)
            assert found[row.split, row.method][len(report.HEADINGS) + own] == (
                f"{rate.percent:.1f}" if rate else "n/a"
            )
    assert text.count(r"\midrule") == 3 and text.count("{") == text.count("}")
    first = text.partition(r"\begin{tabular}")[0]
    assert all(line.startswith("% ") for line in first.splitlines())  # provenance is there, and not on the page
    assert "benchmark: made; " in first and "; trials digest: 0123456789abcdef" in first
    assert "S0 FC-Handover: N 500" in first and r"\usepackage{booktabs,siunitx}" in first


def test_an_interval_stands_below_sr_and_times_of_a_batch_only_if_they_are_asked_for(paper):
    text, every = report.render(paper, "latex"), report.render(paper, "latex", times=True, intervals=True)
    head = next(line for line in text.splitlines() if line.startswith("Method &"))
    assert "{exec}" in head and "{plan}" in head and head.count("{plan}") == 1 and "{tot}" not in head
    assert "{tot}" in every and every.count(r"\scriptsize") > 3 * text.count(r"\scriptsize")
    row = paper.rows[0]
    ends = row.sr_new_categories or row.sr_new_objects
    lines = text.splitlines()
    below = lines[next(k for k, x in enumerate(lines) if x.startswith(f"{row.method} &")) + 1]
    assert f"[{ends.low:.1f}, {ends.high:.1f}]" in below and below.count("scriptsize") == 1
    assert text.count(r"\scriptsize") == len(paper.rows)
    narrow = report.render(paper, "latex", columns=1)
    assert narrow.count(r"\scriptsize") == len(paper.rows) and f"[{ends.low:.1f}, {ends.high:.1f}]" in narrow


def test_both_tables_say_of_how_many_trials_each_rate_is(paper):
    wide, narrow = report.render(paper, "latex"), report.render(paper, "latex", columns=1)
    assert "{S0, $N=500$}" in wide and "{Avg, $N=1000$}" in wide and "Method, $N$ & {500} & {500} & {1000}" in narrow
    first, *others = paper.rows
    fewer = replace(paper, rows=(replace(first, n=60), *others))
    assert "$N$ in brackets" in report.render(fewer, "latex") and "FC-Handover (60) &" in report.render(fewer, "latex")
    assert "{60--500}" in report.render(fewer, "latex", columns=1)


def test_a_comment_ends_no_comment(paper):
    evil = replace(paper, origin={"preset": "a\n\\input{/etc/passwd}\r% b"})
    first = report.render(evil, "latex").partition(r"\begin{tabular}")[0]
    assert all(line.startswith("% ") for line in first.splitlines())


def test_a_share_that_no_row_has_stands_in_braces_as_any_other_cell_that_is_no_number(paper):
    first, *others = paper.rows
    bare = replace(paper, rows=(replace(first, shares={}), *others))
    line = next(x for x in report.render(bare, "latex").splitlines() if x.startswith("FC-Handover &"))
    assert line.endswith(r"& {n/a} & not said \\") and "& n/a" not in line and "presented" in paper.shares


@needs("latex")
def test_all_tables_compile_and_fit_their_columns(paper_rows, paper, tmp_path):
    name = r"50%_a|b & {c} \d^~<#$>"
    rows = tuple(replace(row, method=name if row.method == "FC-Handover" else row.method) for row in paper.rows)
    hostile = replace(paper, rows=rows)
    pairs = render_comparison(compare(pair_up([paper_rows]), draws=200), "latex", origin=paper.origin)
    wide = [report.render(hostile, "latex", intervals=i) for i in (False, True)] + [pairs]
    narrow = [report.render(hostile, "latex", columns=1, intervals=i) for i in (False, True)]
    parts = {}
    for word, tables, kind in (("WIDE", wide, "table*"), ("NARROW", narrow, "table")):
        parts[word] = "".join(rf"\begin{{{kind}}}[p]\centering" + f"\n{t}\\end{{{kind}}}\n" for t in tables)
    text = DOCUMENT.replace("WIDE", parts["WIDE"]).replace("NARROW", parts["NARROW"])
    (tmp_path / "doc.tex").write_text(text, encoding="utf-8")
    line = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-no-shell-escape", "doc.tex"]
    done = subprocess.run(
        line, cwd=tmp_path, capture_output=True, text=True, errors="replace", timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:]
    log = (tmp_path / "doc.log").read_text(errors="replace")
    assert "Overfull" not in log and "Missing character" not in log, log[-2000:]
    assert (tmp_path / "doc.pdf").stat().st_size > 20_000
