"""The notebooks under examples/ run from the first cell to the last, and what they show is there."""

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
def test_a_notebook_runs_from_top_to_bottom(name, shown, capfd):
    """In this process: a kernel of its own would import and build everything again."""
    import nbformat
    from IPython.core.interactiveshell import InteractiveShell

    book = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)
    shell = InteractiveShell()
    said = ""
    for cell in (c for c in book.cells if c.cell_type == "code"):
        done = shell.run_cell(cell.source)
        done.raise_error()
        said += str(shell.display_formatter.format(done.result)[0])
    printed = "".join(capfd.readouterr())
    assert all(word in said for word in shown), said
    assert "CUDA" not in said and "viser" not in printed


@needs("nbclient")
def test_notebooks_are_kept_without_output():
    import nbformat

    found = sorted(EXAMPLES.glob("*.ipynb"))
    assert len(found) >= 2
    for file in found:
        book = nbformat.read(file, as_version=4)
        nbformat.validate(book)
        assert not any(c.get("outputs") or c.get("execution_count") for c in book.cells)
