"""The notebooks under examples/ run from the first cell to the last, and what they show is there."""

import os
from pathlib import Path

import pytest
from needs import needs

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@needs("nbclient", "viser", "pandas")
@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("tutorial", ("Scores(32 rows on cpu", "srcdoc=", "Evaluator(cpu")),
        pytest.param("training", ("Scores(16 rows on cpu",), marks=pytest.mark.slow),
    ],
)
def test_a_notebook_runs_from_top_to_bottom(name, shown, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    root = str(EXAMPLES.parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([root, os.environ.get("PYTHONPATH", "")]))
    book = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)
    NotebookClient(book, timeout=300, kernel_name="python3").execute()
    said = "".join(str(out) for cell in book.cells if cell.cell_type == "code" for out in cell.outputs)
    assert all(word in said for word in shown)
    told = "".join(out.get("text", "") for cell in book.cells for out in cell.get("outputs", ()))  # printed, not drawn
    assert "CUDA" not in said and "Traceback" not in said and "viser" not in told


@needs("nbclient")
def test_notebooks_are_kept_without_output():
    import nbformat

    found = sorted(EXAMPLES.glob("*.ipynb"))
    assert len(found) >= 2
    for file in found:
        book = nbformat.read(file, as_version=4)
        nbformat.validate(book)
        assert not any(c.get("outputs") or c.get("execution_count") for c in book.cells)
