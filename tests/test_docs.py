"""The documentation: links lead somewhere, and the site builds strictly without network."""

import dataclasses
import html
import json
import os
import re
import subprocess
from pathlib import Path

import pytest
from needs import CHROMIUM, is_here, needs
from no_network import without_network

from r2h_batch import config
from r2h_batch.types import Predictions, Scores, Trials

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = [k for k, v in vars(config).items() if dataclasses.is_dataclass(v) and not k.startswith("_")]


@pytest.mark.check
@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_every_link_of_a_page_beside_the_site_leads_to_a_file(page):
    links = re.findall(r"\]\(([^)#\s]+)\)", (ROOT / page).read_text(encoding="utf-8"))
    assert len(links) > (10 if page == "README.md" else -1)
    assert [link for link in links if "://" not in link and not (ROOT / link).exists()] == []


@pytest.mark.check
@pytest.mark.parametrize("kind", [Trials, Predictions, Scores, *(getattr(config, name) for name in CONFIGS)])
def test_the_reference_explains_every_field(kind):
    words = kind.__doc__.partition("Attributes:\n")[2]
    named = re.findall(r"^ {8}(\w+): ", words, re.MULTILINE)
    assert named == [f.name for f in dataclasses.fields(kind) if not f.name.startswith("_")]


@needs("chromium")
def test_a_wide_table_of_the_site_scrolls_in_a_narrow_window_and_its_rows_stay_low(tmp_path):
    """Material puts every table into such boxes."""
    cells = "".join(f"<td>99.2-100.0 {k}</td>" for k in range(11))
    boxes = "<div class=md-typeset__scrollwrap style='overflow-x:auto'><div class=md-typeset__table>"
    table = f"{boxes}<table><tr>{cells.replace('td>', 'th>')}</tr><tr>{cells}</tr></table></div></div>"
    told = "[w.scrollWidth > w.clientWidth, document.querySelector('td').clientHeight, getComputedStyle(w).backgroundImage]"
    script = f"const w = document.querySelector('.md-typeset__scrollwrap'); document.title = JSON.stringify({told})"
    style = ":root { --md-default-bg-color: #fff }" + (ROOT / "docs/stylesheets/tables.css").read_text("utf-8")
    inside = f"<div class=md-typeset style='width:360px'>{table}</div><script>{script}</script>"
    page = f"<title></title><style>{style}</style>{inside}"
    (tmp_path / "page.html").write_text(page, "utf-8")
    line = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=390,800", "--dump-dom"]
    line += [f"--user-data-dir={tmp_path}/profile", f"file://{tmp_path}/page.html"]
    shown = subprocess.run(line, capture_output=True, text=True, timeout=120, check=True).stdout
    scrolls, high, shadows = json.loads(html.unescape(re.search(r"<title>(.*?)</title>", shown)[1]))
    assert scrolls and high < 30 and shadows.count("gradient") == 4


def build_site(folder: Path) -> None:
    """`mkdocs build --strict`."""
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    os.chdir(ROOT)
    config = load_config("mkdocs.yml", site_dir=str(folder), strict=True)
    config.plugins.on_startup(command="build", dirty=False)
    build(config)


@pytest.fixture(scope="module")
def site(tmp_path_factory, scene):
    """`make docs`: built strictly, without network; the notebooks run."""
    folder = tmp_path_factory.mktemp("docs") / "site"
    (without_network if is_here("unshare") else lambda work, *given: work(*given))(build_site, folder)
    return folder


@needs("mkdocs", "viser", "pandas")
@pytest.mark.whole(part="site")
def test_the_site_fetches_nothing_and_holds_the_notebooks_with_what_they_show(site):
    page = (site / "reference" / "python.html").read_text(encoding="utf-8")
    assert "load_benchmark" in page and "r2h_batch.evaluate.Evaluator" in page
    outside = [
        address
        for file in site.rglob("*.html")
        for address in re.findall(r'(?:src|<link[^>]*href)="(https?://[^"]+)"', file.read_text(encoding="utf-8"))
    ]
    assert outside == []
    tutorial, training = ((site / "notebooks" / f"{name}.html").read_text() for name in ("tutorial", "training"))
    assert all(words in tutorial for words in ("Scores(32 rows on cpu", "<b>Evaluator(cpu", 'src="tutorial-1.html"'))
    assert "__VISER_EMBED_DATA__" in (site / "notebooks" / "tutorial-1.html").read_text()
    assert training.count("Scores(16 rows on cpu") >= 2 and "CUDA" not in tutorial + training
    learning = (site / "notebooks" / "learning.html").read_text()
    assert "pairs mined, round 1" in learning and "mine: says that it was trained on" in learning
    assert 'href="notebooks/tutorial.html"' in (site / "index.html").read_text()
