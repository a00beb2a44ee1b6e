"""The notebooks of examples/ as pages of the site, run from top to bottom while it is built (`hooks` in mkdocs.yml)."""

from html import unescape
from pathlib import Path
from typing import Any

import nbformat
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
FRAME, END = ' srcdoc="', '"></iframe>'
"""How `show` displays a page of its own: as an attribute of its frame. In the site it is a file."""


def on_files(files: Files, config: Any) -> Files:
    """Adds notebooks/NAME.md and the pages in its frames."""
    for path in sorted((ROOT / "examples").glob("*.ipynb")):
        for name, text in pages(path).items():
            files.append(File.generated(config, f"notebooks/{name}", content=text))
    return files


def pages(path: Path) -> dict[str, str]:
    """File name -> text. Cells run in this process: a kernel of its own would import and build everything again.

    Raises:
        Exception: what a cell raises.
    """
    shell, found, parts = InteractiveShell(), dict[str, str](), []
    shown: list[Any] = []
    shell.display_trap.hook = shown.append  # it would print the text alone
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type != "code":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        shown.clear()
        with capture_output() as said:
            done = shell.run_cell(cell.source)
        done.raise_error()
        if said.stdout.strip():
            parts.append(f"```text\n{said.stdout.strip()}\n```")
        for data in (shell.display_formatter.format(value)[0] for value in shown if value is not None):
            text, html = data["text/plain"], data.get("text/html", "")
            head, frame, page = html.partition(FRAME)
            if frame:
                name = f"{path.stem}-{len(found) + 1}.html"
                found[name] = unescape(page.removesuffix(END))
                html = f'{head} src="{name}{END}'
            parts.append(f"<div>{' '.join(html.split())}</div>" if html else f"```text\n{text}\n```")
    return {**found, f"{path.stem}.md": "\n\n".join(parts) + "\n"}
