"""The HTML page: everything in it, nothing from outside, and it works in a browser."""

import html.parser
import json
import re
import subprocess

import numpy as np
import pytest
from made_runs import table_1, write_run
from needs import CHROMIUM, needs
from rounds import each

from r2h_batch.base.registry import NOT_SAID
from r2h_batch.base.table import NA
from r2h_batch.report import page
from r2h_batch.report.statistics.paired import compare, pair_up


@pytest.fixture(scope="module")
def paper(paper_rows):
    return paper_rows, page.page(paper_rows)


FETCHING = ("src", "href", "xlink:href", "data", "action", "srcset")


class Outside(html.parser.HTMLParser):
    """Collects whatever a page would fetch, and checks that tags close."""

    def __init__(self):
        super().__init__()
        self.found, self.open = [], []

    def handle_starttag(self, tag, attributes):
        self.found += [v for k, v in attributes if k in FETCHING and not str(v).startswith("#")]
        if tag not in ("meta", "br", "input", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in ("meta", "br", "input", "img"):
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_fetches_nothing(paper):
    _, text = paper
    parser = Outside()
    parser.feed(text)
    assert parser.found == []
    assert not re.search(r"url\((?!#)|@import|https?://(?!www\.w3\.org/2000/svg)", text)
    assert "default-src 'none'" in text


def test_the_page_holds_every_cell_of_table_1(paper):
    _, text = paper
    line = r"<tr><td[^>]*>(S0|S1|Avg)</td><td class=l title=\"(.*?)\">(.*?)</td>(.*?)</tr>"
    rows = re.findall(line, text.partition('<table id="full"')[2])
    found = {}
    for split, method, short, cells in rows:
        assert method == short or f"<li>{short}: {method}.</li>" in text, "the full name stands below the table"
        plain = [re.sub(r"<small>.*?</small>|</?b>", "", c) for c in re.findall(r"<td[^>]*>(.*?)</td>", cells)]
        assert plain[0] == NOT_SAID  # what the method may read
        found[split, method] = plain[1:10]
    names = ("sr", "t_plan_s", "t_exec_s", "t_tot_s", "f_plan", "f_reach", "f_safe", "f_stab", "f_afford")
    assert found == {(r["split"], r["method"]): [r[n] or NA for n in names] for r in table_1()}


def trials_of(text):
    return json.loads(re.search(r"<script type=\"application/json\" id=trials>(.*?)</script>", text)[1])


@needs("chromium")
def test_the_search_works_in_a_browser(paper, tmp_path):
    run, _ = paper
    ids = run.trials(run.methods[0])["trial_id"].to_pylist()
    failed = next(i for i, o in zip(ids, run.trials(run.methods[0])["outcome"].to_pylist()) if o == "reach")
    picture = {"src": "data:,", "alt": "", "caption": "", "href": "a/b.html", "trial": str(failed), "command": "x"}
    (tmp_path / "page.html").write_text(page.page(run, {run.methods[0]: [picture]}), encoding="utf-8")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000", "--dump-dom"]
    address = f"file://{tmp_path}/page.html#outcome=reach"
    assert CHROMIUM
    line = [CHROMIUM, *flags, f"--user-data-dir={tmp_path}/profile", address]
    shown = subprocess.run(line, capture_output=True, text=True, timeout=120, check=True).stdout
    expected = run.trials(run.methods[0])["outcome"].to_pylist().count("reach")
    assert f"{expected} of 1000 trials; margins in mm" in shown
    rows = shown.partition('<div id="search">')[2].partition("<script")[0].count("<tr>")
    assert rows == expected + 1
    assert f'<td><a href="a/b.html" target="_blank" rel="noopener">{failed}</a></td>' in shown
    assert f"r2h-batch view {run.folder} --method {run.methods[0]} --trial ID" in shown


def test_a_page_says_who_is_better_on_which_object_and_shows_only_what_is_there(paper, tmp_path):
    run, text = paper
    compared = compare(pair_up([run]))[-1]
    pair = next(p for p in compared.pairs if p.verdict == "better")
    assert f"{pair.a} is better: {pair.difference:+.1f} points" in text
    assert text.count("<svg") == len(run.methods) + 6  # outcomes of each method; five margins, T_exec
    assert len(re.findall(r'class=h data-v="[\d.]+"', text)) == 6 * len(run.methods)
    assert "Criteria that fail together" in text and len(text) < 5 << 20
    assert (
        re.search(r"<b>\d", text.partition('id="full"')[2]) and "<b>8.5" not in text
    )  # rates may be bold, times never
    alone = page.page(write_run(tmp_path / "run", {"m": np.zeros(8, int)}, 4, 4))
    assert "Criteria that fail together" not in alone and "id=significance" not in alone and "<b>100" not in alone
    pictures = {"src": "data:image/png;base64,AA==", "alt": "<x>", "caption": "trial 3", "href": "t.html"}
    pictures |= {"trial": "3", "command": "r2h-batch view RUN --trial 3"}
    shown = page.page(run, {run.methods[0]: [pictures]})
    assert 'alt="&lt;x&gt;"' in shown and '<a href="t.html"' in shown and "<h2>Gallery</h2>" in shown
    assert "<code>r2h-batch view RUN --trial 3</code>" in shown
    assert trials_of(shown)["pages"][run.methods[0]] == {"3": "t.html"}


@pytest.mark.parametrize("n", [9, 10])
def test_rates_of_fewer_than_ten_trials_are_grey_in_every_table(tmp_path, n):
    text = page.page(write_run(tmp_path / "run", {"mine": np.zeros(2 * n, int)}, n, n))
    top, whole = (re.search(rf'<table id="{i}".*?</table>', text, re.S) for i in ("overview", "full"))
    for table in each([top, whole]):
        grey = re.findall(r'<td class=few title="of (\d+)"', table[0])
        assert (len(grey) > 0) == (n < 10) and set(grey) <= {"9"}
