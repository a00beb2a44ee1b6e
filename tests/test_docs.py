"""The documentation: links lead somewhere, and the site builds strictly without network."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from needs import is_here, needs

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.check
@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_every_link_of_a_page_beside_the_site_leads_to_a_file(page):
    links = re.findall(r"\]\(([^)#\s]+)\)", (ROOT / page).read_text(encoding="utf-8"))
    assert len(links) > (10 if page == "README.md" else -1)
    assert [link for link in links if "://" not in link and not (ROOT / link).exists()] == []


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
