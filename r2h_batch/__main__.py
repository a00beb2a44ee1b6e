"""The one command: `r2h-batch SUBCOMMAND ...`, or `python -m r2h_batch SUBCOMMAND ...`; `--version`
names the version."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import make_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from r2h_batch.base.command_line import Command, exit_code_of, failed, parse, refuse, run_command
from r2h_batch.base.errors import nearest
from r2h_batch.base.gone import gone
from r2h_batch.base.package import VERSION
from r2h_batch.plugins import PluginError
from r2h_batch.strangers import end_without_threads

COMMANDS = {
    "sweep": ("sweep.command:main", "Score methods or predictions files on the trials."),
    "report": ("commands.report:report", "Print the table of run folders, or write their page."),
    "compare": ("commands.compare:compare", "Compare methods on the trials that they share."),
    "view": ("view.command:view", "Look at trials, or write one as a page, a film or strips."),
    "why": ("view.why:why", "Say why trials failed, and what would have passed."),
    "ls": ("commands.ls:ls", "List what can be named; show and check a benchmark."),
    "export": (
        "commands.export:COMMANDS",
        "Write trials, scenes, results or views for other programs.",
    ),
    "import": (
        "commands.import_robot:COMMANDS",
        "Read other people's robots, hands, objects, trials.",
    ),
    "results": ("sweep.results.command:COMMANDS", "Check a run folder, or judge its rows again."),
    "study": ("sweep.study.command:COMMANDS", "Compare a real robot with a run; test ratings."),
    "train": ("commands.train:COMMANDS", "Train a method with the evaluator's labels."),
}
"""Subcommand -> the function that it is, or its subcommands' dict, and what it does.

A module is imported when its subcommand is chosen, not before. `sweep` reads its command line
itself.
"""


def main(arguments: Sequence[str] | None = None, *, prog: str = "r2h-batch") -> int:
    """Exit code of the chosen subcommand; 2 and one line if there is no such subcommand."""
    code = _main(list(sys.argv[1:] if arguments is None else arguments), prog)
    if arguments is None:
        end_without_threads(code)
    return code


def _main(given: Sequence[str], prog: str) -> int:
    name = given[0] if given else "--help"
    if name not in COMMANDS:
        return exit_code_of(prog, lambda: _about(name, given, prog))
    try:
        command = command_of(name)
    except KeyboardInterrupt:  # while it is imported; what it does itself, `exit_code_of` hears
        return refuse(name, "interrupted", 130)
    except PluginError as error:  # criteria of packages are read with the words of verdicts
        return refuse(name, error)
    if name == "sweep":
        return int(command(given[1:], prog=f"{prog} {name}"))
    return run_command(command, given[1:], prog=f"{prog} {name}", name=name)


def command_of(name: str) -> Any:
    """The function or the dict of functions that a subcommand is."""
    module, _, attribute = COMMANDS[name][0].partition(":")
    return getattr(import_module(f"r2h_batch.{module}"), attribute)


def _about(name: str, given: Sequence[str], prog: str) -> int:
    """Answers what is asked of the command itself: version, help, shell completion, or a subcommand that is unknown or
    went."""
    if name == "--version":
        print(f"r2h_batch {VERSION}")
        return 0
    if name in ("-h", "--help"):
        parse(
            {name: _described(text) for name, (_, text) in COMMANDS.items()}, ["--help"], prog=prog
        )
    if name.startswith("--tyro-"):
        try:
            parse(_completed(), given, prog=prog)
        except OSError as error:
            return failed(prog, error)
    words = [" ".join(given[:n]) for n in range(len(given), 0, -1)]
    if told := next((told for word in words if (told := gone(word))), ""):
        return refuse(prog, told)
    kind, allowed = (
        ("flag", ["--help", "--version"])
        if name.startswith("-")
        else ("subcommand", list(COMMANDS))
    )
    return refuse(
        prog, f"unknown {kind} {name!r}{nearest(name, allowed)}; allowed are {', '.join(allowed)}"
    )


def _completed() -> dict[str, Command]:
    """Subcommands with all their flags, for shell completion: here every command's module is
    imported."""
    from r2h_batch.sweep.options import line_class

    commands = {name: command_of(name) for name in COMMANDS}
    nested = {k: _chooser(tuple(c)) for k, c in commands.items() if isinstance(c, dict)}
    return {**commands, **nested, "sweep": line_class()}


def _chooser(words: tuple[str, ...]) -> Command:
    """A command of one of the words and files."""
    import tyro

    positional: Any = tyro.conf.Positional
    chosen = [("command", positional[Literal[words]]), ("files", positional[tuple[Path, ...]])]
    return make_dataclass("Chosen", chosen)


def _described(text: str) -> Callable[[], None]:
    def subcommand() -> None: ...

    subcommand.__doc__ = text
    return subcommand


if __name__ == "__main__":
    sys.exit(main(prog="python -m r2h_batch"))
