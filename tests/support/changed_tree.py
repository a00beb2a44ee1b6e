"""A copy of the tree in which a user has changed something: files that are changed are copies, all others are links."""

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("r2h_batch", "kernels", "assets", "docs", "tools")
COPIED = ("r2h_batch/base/package.py",)
"""Files that find others beside themselves: never links."""


@dataclass(frozen=True)
class Tree:
    """A changed copy.

    Attributes:
        folder: of the copy.
        changed: file -> lines that were added or taken away.
    """

    folder: Path
    changed: Mapping[str, int]

    def run(self, code: str, *, seconds: float = 500) -> str:
        """Output of a program that imports the copy; a failure shows all that it said."""
        environment = {**os.environ, "PYTHONPATH": str(self.folder), "R2H_TREE": str(self.folder)}
        command = [sys.executable, "-c", HEAD + code]
        done = subprocess.run(
            command, env=environment, cwd=self.folder, capture_output=True, text=True, timeout=seconds
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def passes(self, *tests: str, seconds: float = 500) -> None:
        """Asserts that tests of ours pass in the copy.

        Args:
            tests: files or tests, as pytest takes them.
            seconds: that they may take.
        """
        for name in ("tests", "pyproject.toml", "bench"):
            if not (self.folder / name).exists():
                (self.folder / name).symlink_to(ROOT / name)
        environment = {**os.environ, "PYTHONPATH": str(self.folder)}
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
        done = subprocess.run(
            command, env=environment, cwd=self.folder, capture_output=True, text=True, timeout=seconds
        )
        assert done.returncode == 0 and " passed" in done.stdout, done.stdout[-4000:] + done.stderr[-2000:]

    def tables_of_columns(self) -> str:
        """What `python tools/columns.py` prints: the tables that the site has."""
        environment = {**os.environ, "PYTHONPATH": str(self.folder)}
        line = [sys.executable, "tools/columns.py"]
        return subprocess.run(line, env=environment, cwd=self.folder, check=True, capture_output=True, text=True).stdout


HEAD = """
import contextlib, io, os, sys
import r2h_batch
from r2h_batch.__main__ import main
assert r2h_batch.__file__.startswith(os.environ["R2H_TREE"])

def said(line):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = main(line.split())
    assert code == 0, err.getvalue()
    return out.getvalue()

"""


def changed_tree(
    folder: Path,
    edits: Mapping[str, Mapping[str, str] | str],
    *,
    package: Mapping[str, str] | None = None,
    points: Mapping[str, str] | None = None,
) -> Tree:
    """Copies the tree.

    Args:
        folder: a new one.
        edits: file -> old text -> new text, each old text once in it; or the text of a new file.
        package: file -> text of a stranger's package beside the tree, which stands in no file of ours.
        points: its entry points in the group r2h_batch.plugins, as an installed package has them.
    """
    inside = {p for name in (*edits, *COPIED) for p in Path(name).parents}
    count = {}
    folder.mkdir()
    for name in FOLDERS:
        _link(ROOT / name, folder / name, Path(name), inside)
    for made in COPIED:
        path = folder / made
        path.unlink()
        path.write_text((ROOT / made).read_text())
    for name, edit in edits.items():
        path = folder / name
        if isinstance(edit, str):
            assert not path.exists(), f"{name} is there already"
            path.write_text(edit)
            count[name] = len(edit.splitlines())
            continue
        text, lines = path.read_text(), 0
        for old, new in edit.items():
            assert text.count(old) == 1, f"{name} has {text.count(old)} times {old!r}"
            text = text.replace(old, new)
            before, after = old.splitlines(), new.splitlines()
            lines += len([x for x in after if x not in before]) + len([x for x in before if x not in after])
        path.unlink()
        path.write_text(text)
        count[name] = lines
    for name, text in (package or {}).items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    if points:
        info = folder / "strange-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: strange\nVersion: 1.0\n")
        lines_of = "".join(f"{name} = {place}\n" for name, place in points.items())
        (info / "entry_points.txt").write_text(f"[r2h_batch.plugins]\n{lines_of}")
    return Tree(folder, count)


def _link(source: Path, target: Path, name: Path, inside: set[Path]) -> None:
    if name not in inside:
        target.symlink_to(source)
        return
    target.mkdir()
    for path in source.iterdir():
        if not path.name.startswith((".", "__pycache__")):
            _link(path, target / path.name, name / path.name, inside)
