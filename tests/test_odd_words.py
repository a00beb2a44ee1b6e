"""Odd words on the command line: refused in one line with exit code 2, before anything is written."""

import hashlib
from pathlib import Path

import made_runs
import pytest

from r2h_batch.__main__ import main

SWEEP = ["sweep", "--method", "random", "--benchmark", "r2h-v1", "--execute.sim", "none", "--quiet", "--out", "new"]
NUMBERS = ("-1", "nan", "1e400", "0x10", "\u0661", "1_0", "", "1 2", "10000000000000000000000000")
WORDS = {
    "--trials": (*NUMBERS, "0"),
    "--chunk": NUMBERS,
    "--threads": NUMBERS,
    "--seed": ("nan", "1e400", "0x10", "\u0661", "", "1 2"),
    "--shard": ("0/0", "5/4", "-1/2", "1", "a/b", "1/2/3", "\u0661/\u0662"),
    "--plan.range-rad": ("nan", "-1", ""),
    "--plan.rounds": ("[1e99]", "0"),
    **dict.fromkeys(("--__class__", "--plan", "--a.b.c.d", "--=", "--set"), ("1",)),
    "--execution-error": ("nanmm,1deg", "5mm,1deg+", "+", "5mm,1000deg", "\u0661mm,1deg"),
    "--object-errors": ("5mm", "1e400mm,1deg", "none,none", ""),
    "--method": (
        *("os:system", "builtins:exec", "random,x=__import__('os')", "random,seed=", "=", "a=b=c", "a=/dev/zero:f"),
        *("oracle,proposals=nan", "oracle,proposals=10000000000000", "\u0440andom"),
    ),
    "--benchmark": ("/", "/dev/zero", "secret.txt", "os:getcwd", "r2h-v9", "\u0440", ""),
    "--objects": ("/", "secret.txt", "families:cup x 1e3", "families:cup x -1", "families:", "run"),
    "--grasps": ("cup=secret.txt", "=mine.npz", "cup=", "cup=mine.npz:no-such", "cup=/dev/zero"),
    "--turn": ("nan,0,0", "1e400,0,0", "1,2", "1,2,3,4", "half,half", "\u0661,\u0662,\u0663"),
    "--people": ("secret.txt", "/dev/zero", "adults,children", "-"),
    "--sees": ("secret.txt", "/dev/zero", "cell-v9", "cell-v1,region=maybe", ""),
    "--config": ("secret.txt", "/dev/zero", "nowhere.yaml", "/"),
    "--robot": ("secret.txt", "/dev/zero", "nobody", "/"),
    "--out": ("secret.txt", "/dev/zero", "secret.txt/new", "a\x00b"),
}
COMMANDS = {
    "why": ("-1", "nan", "../x", "", "0x1", "\u0661", "10000000000000000000000000"),
    "compare": ("secret.txt", "nowhere", "/dev/zero", "."),
}
CASES = [
    *(
        ((*SWEEP, "--trials", "1", flag, word), f"{flag} {word[:30]!a}")
        for flag, words in WORDS.items()
        for word in words
    ),
    *(((name, "run", word), f"{name} {word[:30]!a}") for name, words in COMMANDS.items() for word in words),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working folder with a run and a file that is nobody's business."""
    place = tmp_path_factory.mktemp("odd")
    made_runs.write(place / "run")
    (place / "secret.txt").write_text("key: hunter2\n")
    return place


def held(folder: Path) -> dict[str, str]:
    """Files of a folder with the digests of what they hold."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.mark.parametrize("line", [line for line, _ in CASES], ids=[name for _, name in CASES])
def test_an_odd_word_is_refused_in_one_line_and_nothing_is_written(
    line: tuple[str, ...], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    before = held(folder)
    code = main(list(line))
    error = capsys.readouterr().err
    assert (code, error.count("\n")) == (2, 1), error
    assert "hunter2" not in error and not any(c in error for c in "\x1b\x00")
    assert held(folder) == before
