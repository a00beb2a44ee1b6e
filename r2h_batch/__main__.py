"""The one command: `r2h-batch SUBCOMMAND ...`, or `python -m r2h_batch SUBCOMMAND ...`; `--version`
names the version."""

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Literal

import r2h_batch
from r2h_batch.command_line import Command, answer, failed, nearest, read, refuse

COMMANDS = {
    "sweep": (
        "r2h_batch.sweep.command",
        "Score methods or predictions files on the trials and print Table I.",
    ),
    "trials": (
        "r2h_batch.export.command",
        "Write the trials and everything that a method may read.",
    ),
    "scene": (
        "r2h_batch.export.command",
        "Write one stored trial as a folder that plain MuJoCo opens.",
    ),
    "export": (
        "r2h_batch.export.command",
        "Write trials of a run as files of the authors' release.",
    ),
    "submit": (
        "r2h_batch.submission",
        "Write a finished run as one checked file for a leaderboard.",
    ),
    "leaderboard": (
        "r2h_batch.submission",
        "Write a page of submissions, each judged again first.",
    ),
    "ls": (
        "r2h_batch.ls",
        "List methods, objects, robots, protocols or runs.",
    ),
    "benchmark": (
        "r2h_batch.benchmark.command",
        "Show what a benchmark file may say, or check one.",
    ),
    "view": (
        "r2h_batch.view.command",
        "Look at trials in three dimensions, or write one as a page, a film or strips.",
    ),
    "video": ("r2h_batch.view.command", "The former name of view --video."),
    "strips": ("r2h_batch.view.command", "The former name of view --strips."),
    "import": (
        "r2h_batch.importers.command",
        "Turn other people's hands and grasps into files that sweeps read.",
    ),
    "results": (
        "r2h_batch.results.command",
        "Check a run folder, judge its rows again, or count them at other thresholds.",
    ),
    "report": ("r2h_batch.gallery.command", "Print the table of a run folder, or write its page."),
    "figures": (
        "r2h_batch.gallery.command",
        "Draw the paper's figures of a run: protocol, methods over time, failures.",
    ),
    "study": ("r2h_batch.study.command", "Compare simulation with people, as the user study does."),
    "compare": ("r2h_batch.compare.command", "Compare methods on the trials that they share."),
}
"""Subcommand -> the module whose `main` (or `NAME_main`, where it holds several) it is, and what it
does.

A module is imported when its subcommand is chosen, not before.
"""


ALIASES = {"rescore": ("results", "rethreshold")}
"""Old name of a subcommand -> what it is called now; old names stay for one version."""


def main(arguments: Sequence[str] | None = None, *, prog: str = "r2h-batch") -> int:
    """Exit code of the chosen subcommand; 2 with one line where there is no such."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    given = [*ALIASES.get(given[0], given[:1]), *given[1:]] if given else given
    name = given[0] if given else "--help"
    if name in COMMANDS:
        if arguments is None:
            # run.json keeps the sweep's command line as the sweep would see it
            sys.argv = [
                sys.argv[0],
                *given[1:],
            ]
        try:
            return main_of(name)(given[1:], prog=f"{prog} {name}")
        # while the subcommand is imported; what it does itself, `answer` hears
        except KeyboardInterrupt:
            return refuse(name, "interrupted", 130)
    return answer(prog, lambda: _about(name, given, prog))


def _about(name: str, given: Sequence[str], prog: str) -> int:
    """What is asked of the command itself: its version, its help, shell completion; or a slip."""
    if name == "--version":
        print(f"r2h_batch {r2h_batch.__version__}")
        return 0
    if name in ("-h", "--help"):
        read(
            {name: _described(text) for name, (_, text) in COMMANDS.items()}, ["--help"], prog=prog
        )
    if name.startswith("--tyro-"):
        try:
            read(_completed(), given, prog=prog)
        except OSError as error:
            return failed(prog, error)
    kind, allowed = (
        ("flag", ["--help", "--version"])
        if name.startswith("-")
        else ("subcommand", list(COMMANDS))
    )
    return refuse(
        prog, f"unknown {kind} {name!r}{nearest(name, allowed)}; allowed are {', '.join(allowed)}"
    )


def main_of(name: str) -> Callable[..., int]:
    """The `main(arguments, prog=...)` of a subcommand."""
    module = import_module(COMMANDS[name][0])
    found: Callable[..., int] = getattr(module, f"{name}_main", None) or module.main
    return found


def _completed() -> dict[str, Command]:
    """Subcommands with all their flags, for shell completion: here every command's module is
    imported."""
    from r2h_batch import ls, submission
    from r2h_batch.compare import command as compare
    from r2h_batch.export import command as export
    from r2h_batch.gallery import command as gallery
    from r2h_batch.sweep.options import Options
    from r2h_batch.view import command as view

    def results(
        command: Literal["verify", "digest", "reevaluate", "rethreshold"], folder: Path, /
    ) -> None: ...

    def study(
        command: Literal["paper", "ratings", "real", "plan"], files: tuple[Path, ...], /
    ) -> None: ...

    def import_(
        command: Literal["hand", "hands", "grasps"], files: tuple[Path, ...], /
    ) -> None: ...

    def benchmark(command: Literal["show", "check"], files: tuple[Path, ...], /) -> None: ...

    return {
        "sweep": Options,
        "trials": export.trials,
        "scene": export.scene,
        "submit": submission.submit,
        "leaderboard": submission.leaderboard,
        "ls": ls.ls,
        "benchmark": benchmark,
        "view": view.view,
        "video": view.view,
        "strips": view.view,
        "import": import_,
        "results": results,
        "report": gallery.report,
        "figures": gallery.figures,
        "study": study,
        "compare": compare.run,
    }


def _described(text: str) -> Callable[[], None]:
    def subcommand() -> None: ...

    subcommand.__doc__ = text
    return subcommand


if __name__ == "__main__":
    sys.exit(main(prog="python -m r2h_batch"))
