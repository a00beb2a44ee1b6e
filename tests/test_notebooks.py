"""The notebooks under examples/ are kept without output: the site shows what they print (tests/test_docs.py runs them)."""

from pathlib import Path

import nbformat

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_notebooks_are_kept_without_output():
    found = sorted(EXAMPLES.glob("*.ipynb"))
    assert len(found) >= 2
    for file in found:
        book = nbformat.read(file, as_version=4)
        nbformat.validate(book)
        assert not any(c.get("outputs") or c.get("execution_count") for c in book.cells)
