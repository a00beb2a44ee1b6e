"""How a command line is read and refused, for all commands. Imports nothing heavy.

A command is a function with plain types (its docstring is the help), a dataclass of options, or a
dict of functions (subcommands). What cannot be understood is one line: what was given, the nearest
match, what is allowed; exit code 2. Numbers are plain decimal digits, and ~ is the home folder, in
every argument of every command.
"""

import contextlib
import errno
import inspect
import io
import itertools
import os
import re
import resource
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from typing import Annotated, Any, Literal, TextIO, get_args, get_origin, get_type_hints

from r2h_batch.base.errors import FileError, MachineError, UsageError, UserError, nearest
from r2h_batch.base.gone import gone
from r2h_batch.base.io.log import LOG, silence
from r2h_batch.base.io.progress import not_silent
from r2h_batch.base.io.read import printable
from r2h_batch.base.validate import expand_home, parse_number, parse_whole_number
from r2h_batch.plugins import PluginError

Command = Callable[..., Any]

MOST_SEED = (1 << 63) - 1
LEAST_BYTES = 4 << 30
"""Address space that a command may need: at 2 GiB a sweep of four trials fails, at 3.8 GiB it does not."""
HELP_ALL = "--help-all"
"""As --help, with the flags of a group (a dataclass) too: without them the help of a command fits on a screen."""


def parse(
    command: Command | Mapping[str, Command],
    arguments: Sequence[str],
    *,
    prog: str,
    default: Any = None,
    more_flags: Sequence[str] = (),
) -> Any:
    """The options of a dataclass, or a function's call that is still to be made; raises
    `UsageError`.

    `more_flags`: flags that were taken off the command line before. `--help` prints and leaves with
    SystemExit.
    """
    import tyro

    try:
        arguments = [expand_home(a) for a in arguments]
    except FileError as error:
        raise UsageError(str(error)) from None
    for before, argument in itertools.pairwise(("", *arguments)):
        _check_text(argument, "rename the file")
        _check_filled(argument, before)
    # what is hidden is not understood either, so flags are hidden from help alone
    every = HELP_ALL in arguments or not {"-h", "--help"} & set(arguments)
    arguments = ["--help" if a == HELP_ALL else a for a in arguments]
    name = prog.split()[-1].removeprefix("r2h_batch.")
    if isinstance(command, Mapping):
        words = [a for a in arguments if not a.startswith("-")]
        completing = bool(arguments) and arguments[0].startswith("--tyro-")
        if (not words or words[0] not in command) and not completing:
            for asked in (*words[:1], *(a.partition("=")[0] for a in arguments if a[:2] == "--")):
                if told := gone(f"{name} {asked}"):
                    raise UsageError(told)
        if words and words[0] not in command and not completing:
            what = f"unknown subcommand {words[0]!r}{nearest(words[0], list(command))}"
            raise UsageError(f"{what}; allowed are {', '.join(command)}")
        chosen = command.get(words[0]) if words else None
        deferred = {name: _deferred(f, every, first=f is not chosen) for name, f in command.items()}
        cli = partial(tyro.extras.subcommand_cli_from_dict, deferred)
    else:
        chosen = command
        cli = partial(tyro.cli, command if is_dataclass(command) else _deferred(command, every))
        if default is not None:
            cli = partial(cli, default=default)
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            found = cli(
                prog=prog, args=arguments, config=(
                    tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.HelptextFromCommentsOff
                ),
                registry=_plain_numbers(),
            )  # fmt: skip
    except SystemExit as stop:
        if not stop.code:
            raise  # --help, or a shell completion
        flags = [*more_flags, *(_flags(chosen) if chosen is not None else ())]
        if isinstance(command, Mapping) and words:
            name += f" {words[0]}"
        raise UsageError(_one_line(box.getvalue(), arguments, flags, name)) from None
    typed = [a.partition("=")[0].replace("_", "-") for a in arguments if a.startswith("--")]
    kinds = get_type_hints(chosen) if chosen is not None else {}
    for name in (name for name, kind in kinds.items() if get_origin(kind) is tuple):
        flag = f"--{name.replace('_', '-')}"
        if typed.count(flag) > 1:  # the last would silently replace the others
            how = f"write its values one after another: {flag} A B"
            raise UsageError(f"{flag} is given twice; {how}")
    try:
        _check_text(os.getcwd(), "work in another folder")
    except OSError as error:
        what = f"the current folder is gone or closed ({error.strerror})"
        raise UsageError(f"{what}; cd to an existing folder") from None
    return found


def _check_text(path: str, how: str) -> None:
    """`UsageError` for bytes that are no UTF-8: no file that names a path could store it."""
    try:
        path.encode()
    except UnicodeEncodeError:
        if (encoding := sys.getfilesystemencoding()).lower() != "utf-8":
            how = f"Python reads names as {encoding} here (LC_ALL, LANG): set PYTHONUTF8=1"
        raise UsageError(f"{printable(path)}: has a byte that is not UTF-8; {how}") from None


def _check_filled(argument: str, before: str) -> None:
    """`UsageError` for an empty argument, such as "$ROBOT" of a variable without a value: its flag's default would silently
    take its place."""
    flag, equals, value = argument.partition("=")
    if argument and not (equals and not value and flag.startswith("--")):
        return
    named = flag or (before if before.startswith("--") and "=" not in before else "")
    how = f"write one, or leave {named} out" if named else "write a name, or leave it out"
    raise UsageError(f"{named or 'an argument'} {'has no value' if named else 'is empty'}; {how}")


def _plain_numbers() -> Any:
    """How tyro reads numbers: these two functions instead of Python's `int` and `float`."""
    import tyro

    registry = tyro.constructors.ConstructorRegistry()
    for kind, reads in ((int, parse_whole_number), (float, parse_number)):

        @registry.primitive_rule
        def rule(info: Any, kind: Any = kind, reads: Callable[[str], Any] = reads) -> Any:
            if info.type is not kind:
                return None
            return tyro.constructors.PrimitiveConstructorSpec(
                nargs=1,
                metavar=kind.__name__.upper(),
                instance_from_str=lambda args: reads(args[0]),
                is_instance=lambda x: type(x) is kind or (kind is float and type(x) is int),
                str_from_instance=lambda x: [str(x)],
            )

    return registry


def check_range(flag: str, value: float, low: float, high: float, what: str = "") -> None:
    """`UsageError` for a flag's number outside `low` to `high`."""
    if not low <= value <= high:
        raise UsageError(f"{flag} is {value:.15g}; it must be {low:.15g} to {high:.15g}{what}")


def check_seed(seed: int) -> None:
    """`UsageError` for a seed that no generator takes."""
    if not 0 <= seed <= MOST_SEED:
        raise UsageError(f"--seed is {str(seed)[:40]}; it must be 0 or more and fit 64 bits")


def run_command(
    command: Command | Mapping[str, Command], arguments: Sequence[str], *, prog: str, name: str
) -> int:
    """Exit code of a function or of one of several; 2 with one line on stderr where it refuses its
    command line or a file (`ValueError`)."""

    def work() -> int:
        try:
            return int(parse(command, arguments, prog=prog)())
        except ValueError as error:
            return refuse(name, error)

    return exit_code_of(name, work)


def exit_code_of(name: str, work: Callable[[], int]) -> int:
    """Exit code of a command's work; 2 with one line where it raises a `UserError`, 1 for a
    `MachineError` or where stdout does not take the answer.

    What the work prints is kept until it ends: so a closed or full stdout, or one that only takes
    ASCII, is told from an error of the work itself, and no control character of a name in a file
    reaches a terminal.
    """
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115 (as long as the process; print(file=None) would be stdout)
    if sys.stdout is None:
        return refuse(name, "standard output is closed; give it a terminal, a file or a pipe", 1)
    _tell_little_memory(name)
    kept, code, stopped = _Kept(sys.stdout), 0, None
    try:
        with contextlib.redirect_stdout(kept), _warnings_in_a_line(name), not_silent(name):
            code = work()
    except (UserError, PluginError) as error:
        code = refuse(name, error)
    except MachineError as error:
        code = refuse(name, error, 1)
    except OSError as error:
        code = failed(name, error)
    except KeyboardInterrupt:
        code = refuse(name, "interrupted", 130)
    except SystemExit as stop:  # --help
        stopped = stop
    text = kept.getvalue()
    try:
        sys.stdout.write(printable(text, keep="\n\t") if stopped is None else text)
        sys.stdout.flush()
    except UnicodeEncodeError as error:
        shown = error.object[error.start : error.start + 1].encode("unicode_escape").decode()
        what = f"standard output takes {error.encoding} only, the answer has {shown}"
        return refuse(name, f"{what}; set PYTHONIOENCODING=utf-8", 1)
    except (OSError, ValueError) as error:
        silence(sys.stdout)
        why = error.strerror if isinstance(error, OSError) else error
        return refuse(name, f"standard output: {why}; the answer is not complete", 1)
    if stopped is not None:
        raise stopped
    return code


def _tell_little_memory(name: str) -> None:
    """One line where the shell allows too little address space: libraries in C may end the process without a word of ours."""
    allowed, _ = resource.getrlimit(resource.RLIMIT_AS)
    if allowed not in (0, resource.RLIM_INFINITY) and allowed < LEAST_BYTES:
        words = f"`ulimit -v` allows {allowed / 2**30:.1f} GiB of address space, and {LEAST_BYTES >> 30} GiB may be needed"
        LOG.info(f"{name}: {words}; raise it (`ulimit -v unlimited`) if the command fails")


@contextlib.contextmanager
def _warnings_in_a_line(name: str) -> Iterator[None]:
    """Warnings as one line each, once, without the source that Python shows; those of libraries only with
    --verbose, and in the log."""
    said: set[str] = set()

    def one_line(message: Warning | str, category: type[Warning], *_: Any) -> str:
        text = f"{name}: {printable(' '.join(str(message).split()))}"
        if issubclass(category, UserWarning):
            if text not in said:  # Python forgets what it said each time that a filter changes
                said.add(text)
                LOG.info(text)
        else:
            LOG.debug(f"{text} ({category.__name__})")
        return ""

    library: Any = warnings
    before, library.formatwarning = library.formatwarning, one_line
    try:
        yield
    finally:
        warnings.formatwarning = before


def place(error: OSError, otherwise: str = "") -> str:
    """Where an error of the operating system happened and what it is: Warp's kernel cache, a file,
    or `otherwise`."""
    why = error.strerror or str(error)
    frames = traceback.walk_tb(error.__traceback__)
    if any(str(frame.f_globals.get("__name__")).partition(".")[0] == "warp" for frame, _ in frames):
        folder = f" {error.filename}" if error.filename else ""
        return f"kernel cache{folder}: {why}; free it, or set WARP_CACHE_PATH to a folder that can be written"
    return f"{error.filename or otherwise}: {why}" if error.filename or otherwise else why


_SLIPS = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR, errno.ELOOP)
"""Errors of an impossible path, which no state of the disk changes."""


def failed(name: str, error: OSError, otherwise: object = "") -> int:
    """One line about an error of the operating system; 2 where a path was given that cannot be,
    else 1."""
    return refuse(name, place(error, str(otherwise)), 2 if error.errno in _SLIPS else 1)


class _Kept(io.StringIO):
    """Text kept for a stream, which is asked what it is: colours and widths of --help are those of
    the stream."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._stream = stream

    def isatty(self) -> bool:
        return self._stream.isatty()


def refuse(name: str, error: object, code: int | None = None) -> int:
    """Print one line on stderr, whatever the error says; returns the exit code: this one, else that of the error, else 2."""
    LOG.error(f"{name}: {' '.join(str(error).split())}")
    return int(getattr(error, "exit_code", 2)) if code is None else code


def counted(number: int, things: str) -> str:
    """A number and what it counts: `people`, or a plural that ends with s: "1 person", "1 hand", "2 hands"."""
    one = "person" if things == "people" else things[:-1]
    return f"{number} {one if number == 1 else things}"


def _deferred(function: Command, every: bool = False, *, first: bool = False) -> Command:
    """A function with the same parameters and words, whose call only remembers what to call.

    The docstring is the help, and tyro prints its line breaks: the lines of a paragraph become one.

    Args:
        function: the command.
        every: it has the flags of its groups too; else its help names them, and they are not understood.
        first: its help is its first paragraph, in a list of commands.
    """
    words = inspect.cleandoc(function.__doc__ or "")
    hints = _shown_hints(function, every=every)
    text, args, about = words.partition("\n\nArgs:\n")
    if first:
        text = text.split("\n\n")[0]
    grouped = [k for k in function.__annotations__.values() if is_dataclass(k)]
    if grouped and not (first or every):
        flags = [f"--{f.name.replace('_', '-')}" for k in grouped for f in fields(k)]
        text += f"\n\nMore flags ({HELP_ALL} explains them): {', '.join(flags)}."
    words = text + args + about
    parameters = inspect.signature(function).parameters.values()
    given: dict[str, Any] = {p.name: p.annotation for p in parameters if is_dataclass(p.annotation)}

    def later(*args: Any, **kwargs: Any) -> Command:
        for name, kind in given.items():
            values = {f.name: getattr(kwargs[name], f.name) for f in fields(kind)}
            kwargs[name] = kind(**values)
        return partial(function, *args, **kwargs)

    later.__name__ = function.__name__
    later.__doc__ = re.sub(r"(?<=\S)\n(?: {8})?(?=\S)", " ", words)
    later.__annotations__ = hints
    shown = [
        p.replace(
            annotation=hints[p.name],
            default=hints[p.name]() if is_dataclass(p.annotation) else p.default,
        )
        for p in parameters
    ]
    later.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    return later


def _shown_hints(owner: Any, *, every: bool = True, hide: bool = False) -> dict[str, Any]:
    """The annotations of a function or dataclass, with what the help of each flag shows: its
    placeholder, and its default only where there is one to say, not `(default: None)`.

    Args:
        owner: the function or dataclass.
        every: also the flags of the function's dataclasses.
        hide: none of its flags.
    """
    import tyro

    def hint(default: str) -> str:
        return "" if default in ("None", "False", "", "''") else f"(default: {default})"

    def shown(kind: Any) -> Any:
        if is_dataclass(kind):
            return _with_shown_hints(kind, hide=not every)
        about = tyro.conf.arg(metavar=_metavar(kind), help_behavior_hint=hint)
        return Annotated[kind, about, tyro.conf.Suppress] if hide else Annotated[kind, about]

    return {k: shown(v) for k, v in owner.__annotations__.items() if k != "return"}


def _with_shown_hints(kind: Any, *, hide: bool) -> Any:
    """A subclass of a dataclass whose fields have the annotations of `_shown_hints`."""
    hints = _shown_hints(kind, hide=hide)
    body = {f.name: f.default for f in fields(kind)} | {"__annotations__": hints}
    frozen = kind.__dataclass_params__.frozen
    return dataclass(frozen=frozen)(type(kind.__name__, (kind,), body | {"__doc__": kind.__doc__}))


def _metavar(kind: Any) -> str | None:
    """Placeholder in the help: PATH of an optional flag, not `{None}|PATH`; STR... of a list, not `[STR [STR ...]]`;
    of words without the empty one. None: as tyro has it."""
    plain = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    parts = get_args(plain)
    if get_origin(plain) is Literal:
        return _word_of(plain) if "" in parts else None
    if get_origin(plain) is tuple and Ellipsis in parts:
        return f"{_word_of(parts[0])}..."
    some = [k for k in parts if k is not type(None)]
    if len(some) != 1 or len(parts) != 2:
        return None
    return " ".join(map(_word_of, (get_origin(some[0]) is tuple and get_args(some[0])) or some))


def _word_of(kind: Any) -> str:
    """One value in the help: STR, or {a,b} of words."""
    if get_origin(kind) is Literal:
        return "{" + ",".join(str(word) for word in get_args(kind) if word != "") + "}"
    return str(kind.__name__).upper()


def _flags(command: Command) -> list[str]:
    if is_dataclass(command):
        names = [n for f in fields(command) for n in _named(f.name, f.type)]
    else:
        parameters = inspect.signature(command).parameters.values()
        names = [n for p in parameters if p.kind is p.KEYWORD_ONLY for n in _names(p)]
    return ["--" + name.removeprefix("--").replace("_", "-") for name in names]


def _names(parameter: inspect.Parameter) -> list[str]:
    """A parameter's flag: its name, or what `tyro.conf.arg(name=...)` says (--from cannot be a
    parameter); of a dataclass of flags those of its fields."""
    if is_dataclass(parameter.annotation):
        return [f.name for f in fields(parameter.annotation)]
    return _named(parameter.name, parameter.annotation)


def _named(name: str, annotation: Any) -> list[str]:
    metadata = getattr(annotation, "__metadata__", ())
    names = [given for m in metadata if isinstance(given := getattr(m, "name", None), str)]
    return names[:1] or [name]


MOST_FLAGS_IN_A_LINE = 30

_NUMBERS = {"INT": "a whole number in decimal digits", "FLOAT": "a number in decimal digits"}


def _missing(words: str) -> str:
    """What tyro lists as required, each as what it is; "" if it lists nothing."""
    found = re.findall(r"(\{[^}]*\}|(?:--\S+ )?\S+) (.*?)\.? \(required\)", words)
    named = []
    for what, told in found:
        if what.startswith("{"):
            told = f"one of {what[1:-1].replace(',', ', ')}"
        elif what.startswith("--"):
            told = f"{what.partition(' ')[0]}, {told}"
        named.append(told)
    return f"missing: {'; '.join(named)}" if named else ""


def _one_line(box: str, arguments: Sequence[str], flags: Sequence[str], command: str) -> str:
    """tyro's box as one line; a misspelt flag or value with its nearest match, one that `command` has no more with what to
    use instead."""
    for argument in arguments:
        name = argument.partition("=")[0].replace("_", "-")
        is_number = name[1:].replace(".", "").isdigit()
        if name.startswith("-") and name not in (*flags, "-h", "--help") and not is_number:
            if told := gone(f"{command} {name}"):
                return told
            allowed = f"allowed are {', '.join(flags)}" if flags else "it has none but --help"
            if len(flags) > MOST_FLAGS_IN_A_LINE:
                allowed = "see --help-all" if "--help-all" in flags else "see --help"
            return f"unknown flag {name}{nearest(name, flags)}; {allowed}"
    lines = [line.strip("\u2502| \n") for line in box.splitlines()]
    worded = [any(c.isalnum() for c in line) for line in lines]
    # tyro prints a title, the message, a rule or blank, hints
    start = worded.index(True) + 1 if any(worded) else 0
    message = itertools.takewhile(
        lambda i: worded[i], itertools.dropwhile(lambda i: not worded[i], range(start, len(lines)))
    )
    text = " ".join(lines[i] for i in message).rstrip(" .").removeprefix("Error parsing ")
    if found := re.match(r"Missing from .*?: (.*)", text):
        text = _missing(found[1]) or text
    if found := re.search(r"no type matching (.*) could be instantiated from \['(.*)'\]", text):
        choices = re.findall(r"\{(.*?)\}|(INT|FLOAT)", found[1])
        some = [(words, kind) for words, kind in choices if words != "None"]
        kinds = [_NUMBERS.get(kind) or words.replace(",", ", ") for words, kind in some]
        text = f"{text[: found.start()]}{found[2]!r}; it must be {' or '.join(kinds)}"
    if found := re.search(
        r"invalid choice '([^']*)' for argument '(.*)'\. Expected one of \((.*)\)", text
    ):
        if told := gone(f"{command} {found[2]} {found[1]}"):
            return told
        values = [word for word in re.findall(r"'([^']*)'", found[3]) if word not in ("", "None")]
        text = f"{found[2]} is {found[1]!r}{nearest(found[1], values)}; allowed are {', '.join(values)}"
    if found := re.fullmatch(r"Unrecognized options: (\S+).*", text):
        text = _left_over(found[1], arguments, flags)
    return text or "the command line was not understood; see --help"


def _left_over(word: str, arguments: Sequence[str], flags: Sequence[str]) -> str:
    """One line about a word that no flag takes: behind which flag it stands, or could."""
    before = arguments[: arguments.index(word)] if word in arguments else []
    flag = next((a for a in reversed(before) if a.startswith("--")), None)
    ending = f"--{word.rpartition('.')[2].lower()}"
    if flag is None and ending in flags:
        return f"{word!r} stands behind no flag; write {ending} {word}"
    if flag is None:
        return f"{word!r} is not understood; see --help"
    name, equals, _ = flag.partition("=")
    if len(before) - 1 - before[::-1].index(flag) == len(before) - (1 if equals else 2):
        return f"{name} takes one value, and {word!r} stands behind it; give one"
    return f"{word!r} stands behind {name} and its values; leave it out, or see --help"
