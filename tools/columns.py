"""Writes the tables of docs/run_folder.md from the table of columns: `python tools/columns.py [--check]`.

Each table stands between `<!-- columns KIND -->` and `<!-- end -->`. `--check` changes nothing and ends with 1 where
the page differs.
"""

import re
import sys
from itertools import groupby
from pathlib import Path

import pyarrow as pa

from r2h_batch.runs.columns import TABLES, Column

PAGE = Path(__file__).resolve().parents[1] / "docs" / "run_folder.md"


def shown(kind: pa.DataType) -> str:
    """A column's type as the page names it: a word is a string, a list says how many it holds."""
    if pa.types.is_dictionary(kind):
        return "string"
    if pa.types.is_fixed_size_list(kind):
        return f"{shown(kind.value_type)}[{kind.list_size}]"
    if pa.types.is_list(kind):
        return f"list of {shown(kind.value_type)}"
    return {"float": "float32", "double": "float64"}.get(str(kind), str(kind))


def table(columns: tuple[Column, ...]) -> str:
    """Markdown; neighbours that differ in nothing but their names share a line."""
    lines = ["| column | type | unit | meaning | since |", "|---|---|---|---|---|"]
    for (_, *rest), group in groupby(columns, lambda c: ("", shown(c.type), c.unit, c.meaning, c.since)):
        lines.append(f"| {' | '.join([', '.join(f'`{c.name}`' for c in group), *rest])} |".replace("|  |", "| |"))
    return "\n".join(lines)


def page(text: str) -> str:
    """The page's text with the tables of today."""

    def today(found: re.Match[str]) -> str:
        return f"{found[1]}\n\n{table(TABLES[found[2]])}\n\n{found[3]}"

    return re.sub(r"(<!-- columns (\w+) -->).*?(<!-- end -->)", today, text, flags=re.DOTALL)


def main() -> int:
    """The exit code."""
    before = PAGE.read_text(encoding="utf-8")
    after = page(before)
    if "--check" in sys.argv[1:]:
        if before != after:
            print(f"{PAGE}: differs from r2h_batch/runs/columns.py; run python tools/columns.py", file=sys.stderr)
        return int(before != after)
    PAGE.write_text(after, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
