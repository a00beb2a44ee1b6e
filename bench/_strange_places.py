"""Links, clocks, other writers, places and words on the command line."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from _attack import SHORT_SWEEP, Attack, Command, Ended, Place, small, small_run
from _strange_answers import write_npz

MORE = [
    "sweep",
    "--method",
    "random",
    "--benchmark",
    "r2h-v1",
    "--trials",
    "3",
    "--save-paths",
    "--sim",
    "none",
    "--out",
    "run",
]
"""The command that made the small run."""
EACH: dict[str, Sequence[str]] = {
    "sweep": MORE,
    "verify": ["results", "verify", "run"],
    "report": ["report", "run", "--format", "csv", "--out", "told.csv"],
}


def linked(
    name: str, target: Callable[[Place], object], *commands: Command, hard: bool = False, must: str = "either"
) -> Attack:
    """A run in which a file or folder is a link to something beside it."""

    def does(place: Place) -> list[Command]:
        run = small(place)
        own, other = run / name, target(place)
        if own.is_dir() and not own.is_symlink():
            shutil.rmtree(own)
        own.unlink(missing_ok=True)
        if hard:
            os.link(str(other), own)
        else:
            own.symlink_to(str(other))
        return [*(commands or EACH.values())]

    return Attack(does, must)


def victim(place: Place) -> Path:
    """A file that nobody may change."""
    return place.outside / "victim.txt"


def secret(place: Place) -> Path:
    """A file that nobody may tell."""
    return place.outside / "secret.txt"


FILES = (
    "run.json",
    "table.md",
    "results.json",
    "README.md",
    "progress.json",
    "log.txt",
    "ids.csv",
    "methods/random.json",
)
FOLDERS = ("methods", "shards", "shards/random", ".claims", "reception")
LINKS: dict[str, Attack] = {
    **{f"{name} is a link to a file beside the run": linked(name, victim) for name in FILES},
    **{f"{name} is a second name of a file beside the run": linked(name, victim, hard=True) for name in FILES[1:6]},
    **{
        f"{name} is a link to a folder beside the run": linked(name, lambda p: p.outside / "folder") for name in FOLDERS
    },
    "a report's file is a link": linked(
        "../told.csv", victim, ["report", "run", "--format", "csv", "--out", "told.csv", "--overwrite"]
    ),
    "a report's file is a link to nothing": linked(
        "../told.csv", lambda p: p.outside / "new.txt", ["report", "run", "--format", "csv", "--out", "told.csv"]
    ),
    "a log of nowhere": linked("log.txt", lambda p: "/dev/full"),
    "a loop of folders": linked("shards/loop", lambda p: ".."),
}


def aged(seconds: float | None) -> Callable[[Place, Path], None]:
    """The claim's time, from now; None: 1970."""

    def change(place: Place, run: Path) -> None:
        claim, when = run / ".claims" / "random-000000", 0.0 if seconds is None else time.time() + seconds
        claim.touch()
        os.utime(claim, (when, when))
        for f in (run / "shards").rglob("*.parquet"):
            f.unlink()

    return change


def claimed(words: bytes) -> Callable[[Place, Path], None]:
    """Another text in the claim of a shard that is not stored."""

    def change(place: Place, run: Path) -> None:
        (run / ".claims" / "random-000000").write_bytes(words)
        for f in (run / "shards").rglob("*.parquet"):
            f.unlink()

    return change


def changed(
    change: Callable[[Place, Path], object],
    *commands: Command,
    must: str = "either",
    then: Callable[[Place, Ended], str] | None = None,
) -> Attack:
    """A run folder in which something else stands."""

    def does(place: Place) -> list[Command]:
        change(place, small(place))
        return [*(commands or (MORE,))]

    return Attack(does, must, then or (lambda place, ended: ""))


def stored_again(place: Place, ended: Ended) -> str:
    """The run has its rows, with their digest."""
    from r2h_batch.runs import load_run

    if ended.how != "read":
        return ""
    sound = load_run(small_run())
    return "" if load_run(place.work / "run").digest("random") == sound.digest("random") else "other rows"


def future(place: Place, run: Path) -> None:
    """Every file of a run is of 2100, and every folder of 1970."""
    for f in run.rglob("*"):
        os.utime(f, (4102444800, 4102444800) if f.is_file() else (0, 0))


CLOCKS: dict[str, Attack] = {
    "a claim of the year 2100": changed(aged(3e9), then=stored_again),
    "a claim of 1970": changed(aged(None), then=stored_again),
    "a claim of a second ago": changed(aged(-1), then=stored_again),
    "a claim of this very process": changed(claimed(b"process 1 on localhost"), then=stored_again),
    "a claim of 64 MiB": changed(claimed(b"x" * (64 << 20)), then=stored_again),
    "a claim of escapes": changed(claimed(b"process \x1b[2J\n on \x9b1m"), then=stored_again),
    "a claim of nothing": changed(claimed(b""), then=stored_again),
    "files of the year 2100": changed(future, ["results", "verify", "run"], ["ls", "runs"], MORE, then=stored_again),
    "a claim at which a thousand processes died": changed(claimed(b"process 7 on host\n" * 1000), then=stored_again),
}


def beside(
    program: str, *commands: Command, must: str = "either", then: Callable[[Place, Ended], str] | None = None
) -> Attack:
    """Another process writes into the folder while the command runs."""

    def does(place: Place) -> list[Command]:
        run = small(place)
        write_npz(place.work / "mine.npz")
        for f in (run / "shards").rglob("*.parquet"):
            (place.work / "kept.parquet").write_bytes(f.read_bytes())
        text = f"import os, time, pathlib, shutil\nend = time.time() + 20\nwork = pathlib.Path({str(place.work)!r})\n{program}"
        subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return [*commands]

    return Attack(does, must, then or (lambda place, ended: ""))


ANSWERS = [*SHORT_SWEEP, "--predictions", "mine.npz", "--out", "other"]
WRITERS: dict[str, Attack] = {
    "answers are rewritten while they are read": beside(
        """
path, data = work / 'mine.npz', (work / 'mine.npz').read_bytes()
while time.time() < end and work.exists():
    for part in (data[:len(data) // 2], data, b''):
        path.write_bytes(part)
        time.sleep(0.01)
""",
        ANSWERS,
    ),
    "answers grow while they are read": beside(
        """
with open(work / 'mine.npz', 'ab') as file:
    while time.time() < end and work.exists():
        file.write(b'x' * 4096)
        file.flush()
        time.sleep(0.001)
""",
        ANSWERS,
    ),
    "answers become a link to a secret": beside(
        """
path, other = work / 'mine.npz', work / 'was.npz'
shutil.copy(path, other)
while time.time() < end and work.exists():
    for target in (other, work.parent / 'outside' / 'secret.txt'):
        part = work / 'part'
        os.symlink(target, part)
        os.replace(part, path)
        time.sleep(0.003)
""",
        ANSWERS,
    ),
    "run.json is rewritten while it is read": beside(
        """
path = work / 'run' / 'run.json'
data = path.read_bytes()
while time.time() < end and work.exists():
    for part in (data[:100], data):
        path.write_bytes(part)
        time.sleep(0.002)
""",
        EACH["report"],
        EACH["verify"],
    ),
    "a shard comes and goes": beside(
        """
(path,) = (work / 'run' / 'shards' / 'random').glob('*.parquet')
data = path.read_bytes()
while time.time() < end and work.exists():
    path.unlink(missing_ok=True)
    time.sleep(0.003)
    path.write_bytes(data)
    time.sleep(0.003)
""",
        EACH["report"],
        EACH["verify"],
        EACH["report"],
    ),
    "the run goes while a sweep writes it": beside(
        """
time.sleep(1.0)
shutil.rmtree(work / 'other', ignore_errors=True)
time.sleep(1.0)
shutil.rmtree(work / 'other', ignore_errors=True)
""",
        ANSWERS,
    ),
    "the run becomes a link while a sweep writes it": beside(
        """
while time.time() < end and work.exists():
    if (work / 'other' / 'run.json').exists():
        os.rename(work / 'other', work / 'away')
        os.symlink(work.parent / 'outside' / 'folder', work / 'other')
        break
    time.sleep(0.001)
""",
        ANSWERS,
    ),
    "the shards' folder becomes a link while a sweep writes": beside(
        """
while time.time() < end and work.exists():
    if (work / 'other' / 'shards').exists():
        os.rename(work / 'other' / 'shards', work / 'away')
        os.symlink(work.parent / 'outside' / 'folder', work / 'other' / 'shards')
        break
    time.sleep(0.001)
""",
        ANSWERS,
    ),
}

# ---- where a command is told to write, and words that are no values


def told(*words: str, must: str = "refused") -> Attack:
    """One command with odd words, beside a small run."""

    def does(place: Place) -> list[Command]:
        small(place)
        write_npz(place.work / "mine.npz")
        return [[w.replace("OUTSIDE", str(place.outside)) for w in words]]

    return Attack(does, must)


OUT: dict[str, str] = {
    "a file as a folder": "mine.npz/x",
    "a device": "/dev/null",
    "a folder of the kernel": "/proc/self/x",
    "a NUL byte": "a\0b",
    "300 letters": "x" * 300,
    "nothing": "",
    "the shards of another run": "run/shards/random",
    "a run's own table": "run/table.md",
    "home of somebody": "~nobody_at_all/x",
}
PLACES: dict[str, Attack] = {
    **{f"sweep --out: {k}": told(*ANSWERS[:-1], v) for k, v in OUT.items() if k != "home of somebody"},
    **{
        f"report --out: {k}": told("report", "run", "--format", "csv", "--out", v)
        for k, v in OUT.items()
        if k not in ("home of somebody", "nothing", "the shards of another run")
    },
    **{
        f"trials --out: {k}": told("trials", "--trials", "1", "--out", v)
        for k, v in OUT.items()
        if k not in ("home of somebody", "nothing")
    },
}
NUMBERS = {
    "10^20": "1" + "0" * 20,
    "-1": "-1",
    "0": "0",
    "1e3": "1e3",
    "digits of full width": "\uff13",
    "an underline": "1_0",
    "base 16": "0x3",
    "a space": " 3 x",
    "NaN": "nan",
    "5,000 digits": "9" * 5000,
}
R = ["sweep", "--method", "random", "--benchmark", "r2h-v1", "--sim", "none", "--out", "other"]
WORDS: dict[str, Attack] = {
    **{
        f"--trials: {k}": told(
            *R, f"--trials={v}", must="refused" if k not in ("an underline", "digits of full width") else "either"
        )
        for k, v in NUMBERS.items()
        if k not in ("10^20",)
    },
    "--trials: 10^20": told(*R, "--trials=1" + "0" * 20),
    **{
        f"--shard: {k}": told(*R, "--trials=1", f"--shard={k}")
        for k in ("0/0", "5/4", "-1/2", "1/1000000000000", "1", "a/b", "1/2/3", "\u0661/\u0662")
    },
    **{
        f"--set: {k}": told(*R, "--trials=1", "--set", k)
        for k in (
            "plan.range_rad=nan",
            "plan.range_rad=-1",
            "__class__=1",
            "plan=1",
            "plan.rounds=[1e99]",
            "a.b.c.d=1",
            "=",
            "plan.range_rad",
            "chunk=-5",
            "chunk=10000000000000",
        )
    },
    **{
        f"--method: {k}": told(*R[:2], k, *R[3:], "--trials=1")
        for k in (
            "os:system",
            "builtins:exec",
            "random,x=__import__('os')",
            "random,seed=",
            "=",
            "a=b=c",
            "a=/dev/zero:f",
            "oracle,proposals=nan",
            "oracle,proposals=10000000000000",
            "r2h_batch.__main__:main",
            "\u0440andom",
        )
    },
    **{
        f"--objects: {k}": told(*R, "--trials=1", "--objects", k)
        for k in (
            "/",
            "/proc/self",
            "OUTSIDE/secret.txt",
            "families:cup x 1e3",
            "families:cup x -1",
            "families:" + "cup," * 20_000 + "cup x 1",
            ".",
            "run",
        )
    },
    **{
        f"--grasps: {k}": told(*R, "--trials=1", "--grasps", k)
        for k in ("cup=OUTSIDE/secret.txt", "=mine.npz", "cup=", "cup=mine.npz:no-such", "cup=/dev/zero")
    },
    **{
        f"--turn: {k}": told(*R, "--trials=1", "--turn", k)
        for k in ("nan,0,0", "1e400,0,0", "1,2", "1,2,3,4", "half,half", "\u0661,\u0662,\u0663")
    },
    **{
        f"--people: {k}": told(*R, "--trials=1", "--people", k)
        for k in ("OUTSIDE/secret.txt", "/dev/zero", "adults,children", "-")
    },
    **{
        f"why: {k}": told("why", "run", k)
        for k in ("-1", "10000000000000000000000000", "nan", "../x", "", "0x1", "\u0661")
    },
}

KINDS = {
    "links in a run folder": LINKS,
    "clocks and claims": CLOCKS,
    "other writers": WRITERS,
    "places to write to": PLACES,
    "words on the command line": WORDS,
}
