"""The tables of columns: `python tools/columns.py` prints them, the site has them on its page of files (`hooks` in mkdocs.yml).

A comment `<!-- columns KIND -->` of docs/run_folder.md is the place of a table.
"""

import re
import sys
from itertools import groupby
from typing import Any

import pyarrow as pa

from r2h_batch.runs.columns import TABLES, Column

PLACE = re.compile(r"<!-- columns (\w+) -->")


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


def on_page_markdown(markdown: str, **_: Any) -> str:
    """A page with the table of columns at each place for one."""
    return PLACE.sub(lambda found: table(TABLES[found[1]]), markdown)


def main() -> int:
    """The exit code."""
    for kind, columns in TABLES.items():
        print(f"{kind}\n\n{table(columns)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
