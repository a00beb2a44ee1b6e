"""The documentation: links lead somewhere, and the site builds strictly without network."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest
from needs import is_here, needs

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


@needs("mkdocs")
def test_the_site_builds_strictly_without_network(tmp_path):
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(tmp_path / "site")]
    line = ["unshare", "-rn", *line] if is_here("unshare") else line
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "site" / "reference" / "python.html").read_text(encoding="utf-8")
    assert "make_trials" in page and "r2h_batch.evaluate.Evaluator" in page
    outside = [
        address
        for file in (tmp_path / "site").rglob("*.html")
        for address in re.findall(r'(?:src|<link[^>]*href)="(https?://[^"]+)"', file.read_text(encoding="utf-8"))
    ]
    assert outside == []
