"""Names and words of strangers, and where they come out: folders, pages, tables, programs of a robot, terminals."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import _strange_answers as answers
import numpy as np
from _attack import OWNED, SCRIPT, TAG, Attack, Command, Place, small, solved
from _source import ROOT

NAMES: dict[str, Callable[[Place], str]] = {
    "a path out of the folder": lambda p: "../../outside/folder/x",
    "an absolute path": lambda p: str(p.outside / "folder" / "x"),
    "a dot": lambda p: ".",
    "two dots": lambda p: "..",
    "nothing": lambda p: "",
    "300 letters": lambda p: "x" * 300,
    "100,000 letters": lambda p: "x" * 100_000,
    "a NUL byte": lambda p: "a\0b",
    "a new line": lambda p: "a\nb: c",
    "text from right to left": lambda p: "a\u202egnp.exe",
    "Cyrillic letters that look like oracle": lambda p: "\u043er\u0430\u0441le",
    "a tag": lambda p: TAG,
    "the end of a script": lambda p: SCRIPT,
    "a command of TeX": lambda p: "\\input{/etc/passwd}\\write18{x}",
    "a formula": lambda p: "=cmd|'/c calc'!A1",
    "a formula behind a space": lambda p: " =1+1",
    "a formula in full-width letters": lambda p: "\uff1d1+1",
    "an option": lambda p: "--help",
    "another case of a built-in name": lambda p: "ORACLE",
    "a letter and its accent apart": lambda p: "e\u0301",
    "half a surrogate": lambda p: "a\ud800b",
    "a thousand accents": lambda p: "a" + "\u0301" * 1000,
    "cells of a table": lambda p: "a|b|c",
    "a link that is a program": lambda p: f"[x](javascript:{OWNED})",
    "a head of a card": lambda p: "---\nlicense: owned\n---",
    "a format": lambda p: "{0.__class__}%s%n",
    "a device of Windows": lambda p: "CON",
    "another C1 control": lambda p: "a\x9b31mb",
    "a word of the command": lambda p: "baselines",
    "a line separator of Unicode": lambda p: "a\u2028b",
    "a joiner of no width": lambda p: "ora\u200dcle",
    "a private character": lambda p: "\U0010ffff",
}


def pages(run: str = "run", *, html: bool = True) -> list[Command]:
    """The commands that write a run's tables and its page."""
    forms = ["csv", "latex", "md", "json", *["html"] * html]
    ending = {"latex": "tex"}
    return [["report", run, "--format", f, "--out", f"told.{ending.get(f, f)}"] for f in forms]


def as_method(name: Callable[[Place], str]) -> Attack:
    """A method of this name in a file of answers, swept and reported."""

    def does(place: Place) -> list[Command]:
        answers.write_npz(place.work / "mine.npz", method=np.array(name(place)))
        return [answers.SWEEP, *pages()]

    return Attack(does)


def as_ids(name: Callable[[Place], str], *commands: Sequence[str]) -> Attack:
    """Trials of this name in a stranger's run."""

    def does(place: Place) -> list[Command]:
        import csv

        run = solved(place)
        with (run / "ids.csv").open("w", newline="", errors="surrogatepass") as file:
            rows = csv.writer(file)
            rows.writerow(["trial_id", "id", "variant"])
            rows.writerows([k, name(place) + "x" * k, name(place)] for k in range(4))
        return [*commands]

    return Attack(does)


ALL_OF_A_RUN: dict[str, Sequence[str]] = {
    "real export": ["real", "export", "run", "--method", "oracle", "--trials", "0-1", "--out", "lab"],
    "export": ["export", "run", "--to", "r2handoversim", "--method", "oracle", "--trials", "1", "--out", "theirs"],
    "report": ["report", "run", "--format", "html", "--out", "told.html"],
    "view": ["view", "run", "--method", "oracle", "--trial", "0", "--html", "trial.html"],
}


def in_json(file: str, change: Callable[[dict], object], *commands: Command) -> Callable[[Place], list[Command]]:
    """A stranger's run with another JSON file in it."""

    def does(place: Place) -> list[Command]:
        path = small(place) / file
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))
        return [*commands]

    return does


def each_word(value: object, new: str) -> object:
    """A JSON value with this behind every text."""
    if isinstance(value, dict):
        return {k: each_word(v, new) for k, v in value.items()}
    if isinstance(value, list):
        return [each_word(v, new) for v in value]
    return value + new if isinstance(value, str) else value


def word_in(key: str, new: str) -> Callable[[dict], object]:
    """One field of a file with this behind every text in it."""
    return lambda data: data.update({key: each_word(data.get(key) or "x", new)})


def objects_of(place: Place, name: str) -> list[Command]:
    """A box under this name in a benchmark file."""
    (place.work / "box.obj").write_text(answers.BOX)
    text = json.dumps({"protocol": "r2h-v1", "objects": [{"file": "box.obj", "name": name, "split": "S0"}]})
    (place.work / "mine.yaml").write_text(text)
    return [["benchmark", "check", "mine.yaml"]]


def object_named(name: Callable[[Place], str]) -> Attack:
    """An object of this name."""
    return Attack(lambda place: objects_of(place, name(place)))


def robot_named(name: Callable[[Place], str]) -> Attack:
    """A robot of this name."""

    def does(place: Place) -> list[Command]:
        folder = Path(shutil.copytree(ROOT / "assets" / "robot" / "panda_hand", place.work / "mine"))
        lines = (folder / "robot.yaml").read_text().splitlines()
        lines = [f"name: {json.dumps(name(place))}" if x.startswith("name:") else x for x in lines]
        (folder / "robot.yaml").write_text("\n".join(lines) + "\n")
        words = "sweep --robot mine --benchmark r2h-v1 --method random --trials 1 --sim none --out run"
        return [words.split(), *pages()]

    return Attack(does)


def folder_named(name: str) -> Attack:
    """A run in a folder of this name."""

    def does(place: Place) -> list[Command]:
        small(place, name)
        return [*pages(name), ["ls", "runs"], ["submit", name, "--out", "x.zip", "--rows", "1"]]

    return Attack(does)


_SOME = ("a path out of the folder", "a tag", "a formula", "a new line", "half a surrogate", "300 letters")
FIELDS = ("command", "git_commit", "created", "platform", "versions", "device", "protocol", "objects", "predictors")
KINDS = {
    "a method's name": {f"{k}, in a file of answers": as_method(v) for k, v in NAMES.items()},
    "trials' names": {
        f"{k}, {command}": as_ids(NAMES[k], words)
        for command, words in ALL_OF_A_RUN.items()
        for k in (_SOME if command != "view" else _SOME[1:2])
    },
    "an object's name": {
        k: object_named(v)
        for k, v in NAMES.items()
        if k in {*_SOME, "nothing", "two dots", "an absolute path", "a NUL byte", "text from right to left"}
    },
    "a robot's name": {k: robot_named(NAMES[k]) for k in _SOME[:4]},
    "a run's folder": {
        k: folder_named(v)
        for k, v in {
            "a tag": "<img src=x onerror=owned()>",
            "a formula": "=1+1",
            "a new line": "a\nb",
            "bytes that are no UTF-8": "a\udcff",
            "the end of a script": "x<script>owned()<script>",
        }.items()
    },
    "words of a run.json": {
        f"a tag, {k}": Attack(in_json("run.json", word_in(k, TAG), *pages(), ["ls", "runs"])) for k in FIELDS
    }
    | {
        f"escape sequences, {k}": Attack(
            in_json("run.json", word_in(k, "\x1b]0;x\x07\x9b1m"), *pages(), ["ls", "runs"])
        )
        for k in ("command", "versions", "device")
    },
    "words of a method's file": {
        "a tag in every word": Attack(
            in_json(
                "methods/random.json", lambda d: [d.update({k: each_word(v, TAG)}) for k, v in [*d.items()]], *pages()
            )
        ),
        "a tag in what it learned from": Attack(
            in_json("methods/random.json", lambda d: d.update(trained_on=[TAG, SCRIPT]), *pages())
        ),
        "another method's name": Attack(in_json("methods/random.json", lambda d: d.update(name="oracle"), *pages())),
    },
}
