"""An attack on the command line: how it is run, and the conditions that hold after any (bench/strangers.py)."""

import atexit
import csv
import hashlib
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import NamedTuple

from _report import resident_mib

MOST_SECONDS, MOST_MIB = 120.0, 1536
"""Limits of the processor's time, and of memory beyond the bench's own; commands that do not judge stay far below."""
LONGEST = 900.0
"""After so many seconds on the clock a command is ended: other work on the machine counts in these."""
MOST_LINES, MOST_LETTERS = 2, 1500
"""Lines of a refusal: the reason, and what follows from it."""
SHORT_SWEEP = ["sweep", "--benchmark", "r2h-v1", "--trials", "3", "--sim", "none"]
"""Words of a sweep over six trials."""
SECRET = "SECRET-c0ffee52-never-told"
OWNED = "owned()"
"""Name that a stranger's text calls where it becomes a program."""
TAG = f"<img src=x onerror={OWNED}>"
SCRIPT = f"</script><script>{OWNED}</script>"
PROGRESS = re.compile(r", \d+ s$")


class Place(NamedTuple):
    """Where an attack takes place: the command's own folder, and one beside it that nobody may write or tell."""

    work: Path
    outside: Path

    @property
    def call(self) -> str:
        """A Python expression that leaves a file beside the working folder: code that must not run."""
        return f"open({str(self.outside / 'owned')!r}, 'w')"


Command = Sequence[str] | Callable[[], object]


class Ended(NamedTuple):
    """How a command ended, and what it said."""

    how: str
    seconds: float
    mib: int
    said: str
    told: str


class Attack(NamedTuple):
    """`does` writes the files and returns the commands. `must`: whether all of them read, or one refuses. `fell`: what
    happened when the attack was new."""

    does: Callable[[Place], Sequence[Command]]
    must: str = "either"
    then: Callable[[Place, Ended], str] = lambda place, ended: ""
    fell: str = ""


# ---- the sound things that attacks begin with


def swept(name: str, words: str) -> Path:
    """A run of this name in the folder of all sound things, made once."""
    folder = sound() / name
    if not folder.exists():
        command = [sys.executable, "-m", "r2h_batch", "sweep", *words.split(), "--sim", "none", "--out", str(folder)]
        subprocess.run(command, check=True, capture_output=True)
    return folder


@cache
def sound() -> Path:
    """A folder for sound things."""
    folder = Path(tempfile.mkdtemp(prefix="strangers-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def small_run() -> Path:
    """A run of six random rows on r2h-v1."""
    return swept("small", "--benchmark r2h-v1 --method random --trials 3 --save-paths")


def small(place: Place, name: str = "run") -> Path:
    """A copy of the small run."""
    return Path(shutil.copytree(small_run(), place.work / name))


def solved_run() -> Path:
    """A run with paths, of two methods on four trials of r2h-v1."""
    return swept("solved", "--benchmark r2h-v1 --method oracle random --trials 2 --save-paths")


def solved(place: Place, name: str = "run") -> Path:
    """A copy of the solved run."""
    return Path(shutil.copytree(solved_run(), place.work / name))


# ---- what must hold after any attack


def tree(folder: Path) -> dict[str, str]:
    """Entries of a folder: name -> kind, mode and digest."""
    found = {}
    for path in sorted(folder.rglob("*")):
        what = path.lstat()
        if path.is_symlink():
            found[str(path)] = f"link {os.readlink(path)}"
        elif path.is_file():
            found[str(path)] = f"{what.st_mode} {hashlib.sha256(path.read_bytes()).hexdigest()}"
        else:
            found[str(path)] = f"{what.st_mode}"
    return found


class Tags(HTMLParser):
    """Finds a stranger's text that became a tag, a handler, an address or a program of a page."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.found: list[str] = []
        self.script = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """A tag with its attributes."""
        self.script = tag == "script"
        for name, value in attrs:
            text = (value or "").strip().lower()
            if (name.startswith("on") and OWNED in text) or text.startswith("javascript:"):
                self.found.append(f"<{tag} {name}>")

    def handle_data(self, data: str) -> None:
        """Text, and a script's program."""
        if self.script and data.strip().startswith(OWNED):
            self.found.append("<script>")


def became(path: Path, text: str) -> str:
    """Form that a stranger's text took in a file that a command wrote; nothing if it stayed text."""
    match path.suffix:
        case ".html":
            page = Tags()
            page.feed(text)
            return f"{path.name}: {', '.join(page.found)}" if page.found else ""
        case ".csv":
            cells = [c for row in csv.reader(io.StringIO(text)) for c in row if c[:1] in ("=", "+", "-", "@", "\t")]
            cells = [c for c in cells if not re.fullmatch(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?|[-+]?(inf|nan)|-+", c)]
            return f"{path.name}: a formula, {cells[0]!r}" if cells else ""
        case ".tex":
            return f"{path.name}: a command of TeX" if re.search(r"\\(input|write18)\b", text) else ""
        case ".script":
            return f"{path.name}: a line of URScript" if re.search(rf"^\s*{re.escape(OWNED)}", text, re.M) else ""
        case ".md":
            bare = re.sub(r"`[^`\n]*`", "", text)
            marks = rf"(?<!\\)({re.escape(TAG)}|\[[^\]]*\]\(javascript:)"
            return f"{path.name}: a tag or a link" if re.search(marks, bare) else ""
    return ""


def wrong(place: Place, before: Mapping[str, str], outside: Mapping[str, str], ended: Ended, must: str) -> str:
    """Damage that must not have happened; nothing if all is well."""
    if ended.how not in ("read", "refused"):
        return ended.how
    if ended.seconds > MOST_SECONDS:
        return f"{ended.seconds:.0f} s of the processor"
    if ended.mib > MOST_MIB:
        return f"{ended.mib} MiB"
    if (now := tree(place.outside)) != outside:
        return f"wrote {sorted(set(now.items()) ^ set(outside.items()))[0][0]}"
    words = ended.said + ended.told
    if SECRET in words:
        return "told a file"
    if controls := re.findall(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]", words.replace("\r\n", "\n")):
        return f"a control character {controls[0]!r}"
    for path in place.work.rglob("*"):
        if path.is_symlink() or not path.is_file() or path.stat().st_size > 20 << 20:
            continue
        data = path.read_bytes()
        if before.get(str(path), "").endswith(hashlib.sha256(data).hexdigest()):
            continue
        if SECRET.encode() in data:
            return f"told a file in {path.name}"
        if odd := became(path, data.decode("utf-8", "replace")):
            return odd
    return "" if must in ("either", ended.how) else f"{ended.how}, not {must}"


# ---- one attack


def attacked(attack: Attack) -> tuple[str, Ended]:
    """Fault, and how the attack ended."""
    with tempfile.TemporaryDirectory(prefix="attack-", ignore_cleanup_errors=True) as folder:
        place = Place(Path(folder) / "work", Path(folder) / "outside")
        place.work.mkdir()
        place.outside.mkdir()
        (place.outside / "secret.txt").write_text(SECRET + "\n")
        (place.outside / "victim.txt").write_text("as it was\n")
        (place.outside / "folder").mkdir()
        commands = attack.does(place)
        before, outside = tree(place.work), tree(place.outside)
        every = [ran(one, place, Path(folder)) for one in commands]
        ended = joined(every)
        bad = wrong(place, before, outside, ended, attack.must) or attack.then(place, ended)
        for path in place.work.rglob("*"):  # what an attack closed
            if not path.is_symlink() and path.is_dir():
                path.chmod(0o700)
        return bad, ended._replace(
            said=ended.said.replace(folder, "."), told=ended.told.replace(folder, ".").replace(str(sound()), "sound")
        )


def joined(every: Sequence[Ended]) -> Ended:
    """The end of several commands: the worst of their ends, and all that they said."""
    worst = next((e.how for e in every if e.how not in ("read", "refused")), "")
    how = worst or ("refused" if any(e.how == "refused" for e in every) else "read")
    return Ended(
        how,
        round(max(e.seconds for e in every), 2),
        max(e.mib for e in every),
        "".join(e.said for e in every),
        "".join(e.told for e in every),
    )


def ran(one: Command, place: Place, folder: Path) -> Ended:
    """Runs one command in a process of its own."""
    before = resident_mib()
    child = os.fork()
    if not child:
        _run(one, place, folder)
    how, seconds, peak = _wait(child)
    said, told = ((folder / name).read_text(errors="backslashreplace") for name in ("said", "told"))
    if "Traceback (most recent call last)" in said + told:
        how = "traceback"
    if how == "crash (130)":
        how = "refused"  # as an interruption: no row is stored
    if how == "refused":
        lines = [x for x in said.strip().splitlines() if not PROGRESS.search(x)]
        names = {"attack"} if callable(one) else {one[0], " ".join(one[:2]), "r2h-batch"}
        own = [x for x in lines if x.split(":")[0] in names]
        own = own or told.strip().splitlines()[-1:]  # `verify` and `reevaluate` answer: exit 1 is their answer
        if not own or len(own) > MOST_LINES or max(map(len, own)) > MOST_LETTERS:
            how = f"refused in {len(own)} lines of {max(map(len, own), default=0)} letters at most"
    return Ended(how, round(seconds, 2), max(0, peak - round(before)), said, told)


def _run(one: Command, place: Place, folder: Path) -> None:
    """In the child. Never returns."""
    os.setsid()
    os.chdir(place.work)
    for number, name in ((1, "told"), (2, "said")):
        os.dup2(os.open(folder / name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", errors="backslashreplace")
    code = 99
    try:
        from r2h_batch.__main__ import main
        from r2h_batch.base.command_line import exit_code_of

        if callable(one):
            call = one
            code = exit_code_of("attack", lambda: _done(call))
        else:
            code = main([*one])
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if code is not None else 0)


def _done(call: Callable[[], object]) -> int:
    """0 once a call has returned."""
    call()
    return 0


def _wait(child: int) -> tuple[str, float, int]:
    """How the child ended, its seconds of the processor and its largest memory, MiB, with what it started."""
    start = time.monotonic()
    while True:
        done, status, used = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() - start > LONGEST:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "hang", LONGEST, 0
        time.sleep(0.01)
    code = os.waitstatus_to_exitcode(status)
    names = {0: "read", 1: "refused", 2: "refused"}
    return names.get(code, f"crash ({code})"), used.ru_utime + used.ru_stime, used.ru_maxrss >> 10
