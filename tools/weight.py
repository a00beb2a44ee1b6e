"""Counts statements, files, commands, flags, dependencies and pages of this tree and of an earlier commit.

python tools/weight.py [COMMIT]        (default: 7d23856b, the commit before "Lighter")

A statement is a node `ast.stmt`, so neither blank lines nor denser ones change the count.
"""

import ast
import io
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PARTS = {"package with kernels": ("r2h_batch", "kernels"), "tests": ("tests",), "bench": ("bench",)}


def statements(file: Path) -> int:
    """Statements of a Python file."""
    return sum(isinstance(node, ast.stmt) for node in ast.walk(ast.parse(file.read_text("utf-8"))))


def sources(root: Path, folders: tuple[str, ...]) -> Iterator[Path]:
    """The Python files of some folders."""
    return (p for folder in folders for p in (root / folder).rglob("*.py"))


def named(file: Path, name: str) -> list[ast.stmt | ast.expr]:
    """The entries of a dict, or the fields of a class, that a module calls `name`."""
    for node in ast.parse(file.read_text("utf-8")).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return [x for x in node.body if isinstance(x, ast.AnnAssign)]
        targets = node.targets if isinstance(node, ast.Assign) else []
        if any(isinstance(t, ast.Name) and t.id == name for t in targets) and isinstance(node.value, ast.Dict):
            return [key for key in node.value.keys if key is not None]
    raise LookupError(f"{file} has no {name}")


def weight(root: Path) -> dict[str, int]:
    """Count -> number, of a tree."""
    found = {}
    for part, folders in PARTS.items():
        files = list(sources(root, folders))
        found[f"{part}: statements"] = sum(map(statements, files))
        found[f"{part}: files"] = len(files)
    pages = [root / "README.md", *(root / "docs").rglob("*.md")]
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    return found | {
        "commands": len(named(root / "r2h_batch" / "__main__.py", "COMMANDS")),
        "flags of sweep": len(named(root / "r2h_batch" / "sweep" / "options.py", "Flags")),
        "dependencies": len(project["dependencies"]),
        "packages in constraints.txt": (root / "constraints.txt").read_text("utf-8").count("=="),
        "pages": len(pages) - 1,
        "words of pages and README": sum(len(p.read_text("utf-8").split()) for p in pages),
    }


def main() -> None:
    """Prints the table."""
    commit = sys.argv[1] if len(sys.argv) > 1 else "7d23856b"
    files = subprocess.run(["git", "-C", str(ROOT), "archive", commit], capture_output=True, check=True).stdout
    with tempfile.TemporaryDirectory() as before:
        with tarfile.open(fileobj=io.BytesIO(files)) as tar:
            tar.extractall(before, filter="data")
        old, new = weight(Path(before)), weight(ROOT)
    print(f"| | {commit} | here | |\n|---|--:|--:|--:|")
    for name, count in new.items():
        print(f"| {name} | {old[name]:,} | {count:,} | {count - old[name]:+,} |")


if __name__ == "__main__":
    main()
