"""Help of every command on the site's page of commands (`hooks` in mkdocs.yml): `<!-- commands -->` is its place."""

import io
import os
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from typing import Any
from unittest import mock

from r2h_batch.__main__ import COMMANDS, command_of, main

PLACE = "<!-- commands -->"
WIDTH = "110"


def lines() -> Iterator[list[str]]:
    """The words of every command, those of groups (`export`, `import`, ...) one by one."""
    for name in COMMANDS:
        command = command_of(name)
        yield from ([name, word] for word in command) if isinstance(command, dict) else [[name]]


def help_of(words: list[str]) -> str:
    """What a command prints with --help."""
    said = io.StringIO()
    with mock.patch.dict(os.environ, {"COLUMNS": WIDTH, "NO_COLOR": "1"}), redirect_stdout(said), suppress(SystemExit):
        main([*words, "--help"])
    return "\n".join(line.rstrip() for line in said.getvalue().strip().splitlines())


def on_page_markdown(markdown: str, **_: Any) -> str:
    """A page with the help of all commands at the place for them."""
    if PLACE not in markdown:
        return markdown
    parts = (f"### {' '.join(words)}\n\n```text\n{help_of(words)}\n```" for words in lines())
    return markdown.replace(PLACE, "\n\n".join(parts))
