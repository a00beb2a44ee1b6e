"""The runner of all benches: `python bench/run.py NAME [FLAGS]`, or `python bench/NAME.py [FLAGS]`; without a name it lists them.

A bench is an entry (`BENCH` of its module): what runs, which source its figures depend on, its flags, and what it is compared
with. The runner reads the flags, writes the JSON (figures, and where they come from) and then the pages that show it. A module's
`shown` gives the tables and words that pages take from its JSON (bench/figures.py); sentences stand in the pages alone.
"""

import argparse
import ast
import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from _report import Report
from _source import ROOT

HERE, STORED = ROOT / "bench", ROOT / "bench" / "results"
DEVICE: dict[str, dict[str, Any]] = {"--device": {"default": "cpu", "help": "cpu or cuda:0 (default: cpu)"}}


@dataclass(frozen=True)
class Bench:
    """A bench.

    Attributes:
        about: what runs and what is counted; the text of its module.
        run: takes the flags and the report. What it gives back stands in the JSON beside the report's figures.
        measures: files and folders whose code the figures depend on.
        flags: flag -> what argparse takes of it; its type is that of the default.
        peer: what it is compared with.
        stored: name of the JSON in bench/results that is written without --json; empty: none is.
    """

    about: str | None
    run: Callable[[argparse.Namespace, Report], Mapping[str, Any] | None]
    measures: Sequence[str] = ()
    flags: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    peer: str = ""
    stored: str = ""

    def main(self, given: Sequence[str] | None = None) -> None:
        """Reads the flags, measures, and writes JSON and pages."""
        beside = f"\n\nBeside: {self.peer}." if self.peer else ""
        parser = argparse.ArgumentParser(
            description=f"{self.about}{beside}", formatter_class=argparse.RawDescriptionHelpFormatter
        )
        usual = STORED / f"{self.stored}.json" if self.stored else None
        parser.add_argument("--json", type=Path, metavar="FILE", default=usual, help="the figures and their origin")
        for name, how in self.flags.items():
            parser.add_argument(name, **typed(how))
        options = parser.parse_args(given)
        options.json = options.json and options.json.resolve()  # some benches work in another folder
        report = Report(self.measures)
        report.beside = dict(self.run(options, report) or {})
        report.write(options.json)
        if usual is not None and options.json == usual:
            import figures

            figures.write()


def typed(how: Mapping[str, Any]) -> dict[str, Any]:
    """What argparse takes of a flag, with the type of its default."""
    default = how.get("default")
    guessed: dict[str, Any] = {} if {"type", "action"} & how.keys() or default is None else {"type": type(default)}
    if isinstance(default, list | tuple):
        guessed = {"nargs": "+", "type": type(default[0])} if default else {}
    return guessed | dict(how)


def names() -> dict[str, str]:
    """Name of each bench -> the first line of its text."""
    found = {}
    for path in sorted(HERE.glob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        if any(isinstance(x, ast.Assign) and getattr(x.targets[0], "id", "") == "BENCH" for x in tree.body):
            found[path.stem] = (ast.get_docstring(tree) or "").partition("\n")[0]
    return found


def main() -> None:
    known, (name, *given) = names(), sys.argv[1:] or [""]
    if name not in known:
        sys.exit("\n".join(f"{k:16} {about}" for k, about in known.items()))
    importlib.import_module(name).BENCH.main(given)


if __name__ == "__main__":
    main()
