"""Code and commands of the documentation's pages, run as a reader runs them, on small input.

    python tests/support/pages.py FOLDER PAGE ... [--slow]

Python blocks share one namespace, and run as files. Commands run in this process, in their order on the page, with small numbers
(`SMALL`). Only packages of the core install can be imported, until the page says `pip install ...[extra]`. What stands in a
comment before a block, or names the beginning of a command, leaves it out: `<!-- not run: why -->`, `<!-- not run `COMMAND`:
why -->`; `slow` instead of `not run`: it runs with --slow alone.
"""

import argparse
import io
import os
import re
import runpy
import shlex
import shutil
import signal
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any, NamedTuple

from packaging.requirements import Requirement

from r2h_batch import Evaluator, load_benchmark

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ("r2h-batch", "make", "python", "pip", "git", "docker", "hf", "ray", "scp", ".")
"""A command begins with one of these; text in backquotes that begins with another word is none."""
SHELL = ("", "bash", "sh")
SMALL = {"8": "1", "20": "3", "60": "2", "500": "3", "100000": "4", "1000000": "5", "32": "4"}
"""Numbers of trials on a page -> those of the test: other ones stay apart."""
STEPS = {"range(80)": "range(2)"}
FEW = {
    "results reevaluate": "--rows 2",
    "view": "--port 0",
}
"""Flags that make a command small."""
SERVED_S, LATEST_S = 1.5, 120.0
"""A command that serves until Ctrl-C is interrupted so long after it has said its address, at the latest after `LATEST_S`."""
COMMENT = re.compile(r"<!-- (not run|slow)(?: `([^`]+)`)?: (.+?) -->", re.DOTALL)


class Piece(NamedTuple):
    """A block of Python, or one command."""

    line: int
    text: str
    language: str
    kept_from: str
    """`not run` or `slow` with its reason; "" if it runs."""
    before: str
    """The paragraph before a block."""


def pieces(text: str) -> Iterator[Piece]:
    """Blocks and commands in backquotes, in their order.

    Raises:
        ValueError: a comment that leaves nothing out.
    """
    named = {m[2]: f"{m[1]}: {m[3]}" for m in COMMENT.finditer(text) if m[2]}
    used: set[str] = set()
    fenced = r"^```(?P<language>[\w-]*)\n(?P<code>.*?)^```$"
    indented = r"(?<=\n\n)(?P<lines>(?:    [^\n]*\S[^\n]*\n?)+)|(?<=-->\n)(?P<more>(?:    [^\n]*\S[^\n]*\n?)+)"
    inline = r"(?<!`)`(?P<inline>[^`\n]+)`(?!`)"
    quiet = COMMENT.sub(lambda m: "<!--" + re.sub(r"[^\n]", " ", m[0][4:-3]) + "-->", text)
    for found in re.finditer(f"{fenced}|{indented}|{inline}", quiet, re.MULTILINE | re.DOTALL):
        block = found["code"] or found["lines"] or found["more"] or ""
        start, line = found.start(), quiet.count("\n", 0, found.start()) + 1
        before = text[:start].rstrip("\n").rpartition("\n\n")[2]
        comment = COMMENT.search(before) if block else None
        why = f"{comment[1]}: {comment[3]}" if comment and not comment[2] and before.endswith("-->") else ""
        language = (found["language"] or "") if found["code"] else ""
        if block and not found["code"]:
            block = re.sub(r"^    ", "", block, flags=re.MULTILINE)
            language = "" if block.split()[0] in PROGRAMS else "python"
        if block and language not in SHELL:
            yield Piece(line, block, language, why, before)
            continue
        for command in commands(block) if block else [found["inline"]]:
            if (not block and command.split(" ")[0] not in PROGRAMS) or " " not in command:
                continue
            part = [k for k in named if command.startswith(k)]
            used.update(part)
            yield Piece(line, command, "shell", why or (named[part[0]] if part else ""), before)
    if unused := {*named} - used:
        raise ValueError(f"no command begins with {', '.join(sorted(unused))}, which a comment leaves out")


def commands(block: str) -> list[str]:
    """Lines of a shell block without comments, those that end in a backslash joined."""
    joined = re.sub(r"\\\n\s*", " ", block)
    return [
        " ".join(map(shlex.quote, words)) for line in joined.splitlines() if (words := shlex.split(line, comments=True))
    ]


class OnlyInstalled:
    """A finder of modules that hides packages which neither the core install nor a given extra brings."""

    def __init__(self) -> None:
        self.allowed = self._closure("")
        self.owners = metadata.packages_distributions()

    def install(self, extra: str) -> None:
        """From here on packages of the extra are found.

        Raises:
            KeyError: r2h_batch has no such extra.
        """
        if extra not in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]:
            raise KeyError(f"r2h_batch has no extra {extra!r}")
        self.allowed |= self._closure(extra)

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """As Python's own finder; None for a hidden package."""
        owners = self.owners.get(name.partition(".")[0], [])
        if owners and not {_plain(o) for o in owners} & self.allowed:
            return None
        return PathFinder.find_spec(name, path, target)

    find_distributions = staticmethod(PathFinder.find_distributions)
    invalidate_caches = staticmethod(PathFinder.invalidate_caches)

    def _closure(self, extra: str) -> set[str]:
        """Distributions that `pip install r2h_batch[extra]` brings."""
        found: set[tuple[str, str]] = set()
        todo = [("r2h-batch", extra), ("r2h-batch", "")]
        while todo:
            name, extra = todo.pop()
            if (name, extra) in found:
                continue
            found.add((name, extra))
            try:
                needed = metadata.requires(name) or []
            except metadata.PackageNotFoundError:
                continue
            for line in needed:
                needs = Requirement(line)
                if needs.marker is None or needs.marker.evaluate({"extra": extra}):
                    todo += [(_plain(needs.name), e) for e in ("", *needs.extras)]
        return {name for name, _ in found}


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


class Reader:
    """Somebody who follows a page in a folder."""

    def __init__(self, folder: Path, packages: OnlyInstalled, *, slow: bool) -> None:
        self.folder, self.packages, self.slow = folder, packages, slow
        self.names: dict[str, Any] = {}
        self.ran: list[str] = []
        self.made = 0
        os.environ |= {"SLURM_ARRAY_TASK_ID": "1", "SLURM_CPUS_PER_TASK": "1", "SCRATCH": str(folder / "scratch")}

    def follow(self, page: Path) -> None:
        """Runs all of a page.

        Raises:
            RuntimeError: a block or command failed; the message has place and reason.
        """
        for piece in pieces(page.read_text("utf-8")):
            if piece.kept_from and not (self.slow and piece.kept_from.startswith("slow")):
                continue
            run = {"shell": self.command, "python": self.python}.get(piece.language)
            if run is None:  # YAML, BibTeX: no program
                continue
            try:
                run(piece)
            except Exception as error:
                where = f"{page.relative_to(ROOT)}:{piece.line}"
                raise RuntimeError(f"{where}: {piece.text.strip()[:300]}\n{type(error).__name__}: {error}") from error
            self.ran.append(piece.text)

    def python(self, piece: Piece) -> None:
        """Runs a block as the file that the paragraph before it names (a method of the reader's), or any."""
        code = piece.text
        for given, few in STEPS.items():
            code = code.replace(given, few)
        code = re.sub(r"(\btrials=|\.trials\()(\d+)", lambda m: m[1] + SMALL.get(m[2], m[2]), code)
        named = re.findall(r"This `(\w+\.py)`", piece.before)
        file = self.folder / (named[0] if named else "block.py")
        file.write_text(code)
        self.names |= runpy.run_path(str(file), init_globals=self.names)

    def command(self, piece: Piece) -> None:
        """Runs a command of ours; checks that others name what exists."""
        words = shlex.split(os.path.expandvars(piece.text), comments=True)
        words = words[1:] if words[0] == "srun" else words
        program, given = words[0], words[1:]
        if program == "export":
            os.environ |= dict(w.split("=", 1) for w in given)
        elif program == "pip":
            for extras in re.findall(r"\[([\w,-]+)\]", piece.text):
                for extra in extras.split(","):
                    self.packages.install(extra)
        elif program == "make":
            targets = (ROOT / "Makefile").read_text()
            assert re.search(rf"^{given[0]}:", targets, re.MULTILINE), f"the Makefile has no target {given[0]}"
        elif program == "python":
            assert given[0] == "-m" or (ROOT / given[0]).is_file(), f"{given[0]} is not a file"
        elif program == "r2h-batch":
            self.ours(given)
        else:
            raise ValueError(f"{program} cannot be run here: say why in a comment `<!-- not run: ... -->`")

    def ours(self, words: list[str]) -> None:
        """One of our commands, small."""
        from r2h_batch.__main__ import main

        out, error = io.StringIO(), io.StringIO()
        served = (lambda: "http://" in out.getvalue() + error.getvalue()) if self.serves(words) else None
        with redirect_stdout(out), redirect_stderr(error), interrupted(served):
            code = main(self.small(words))
        if code:
            raise RuntimeError(f"exit code {code}: {error.getvalue()[-1500:]}")

    def small(self, words: list[str]) -> list[str]:
        """The words with small numbers, with this folder's files in place of the page's placeholders."""
        few: list[str] = []
        for before, word in zip(["", *words], words, strict=False):
            if before == "--out" and (word in PLACEHOLDERS or word.startswith("/tmp/")):
                self.made += 1
                word = f"made/{self.made}"
            elif before == "--trials":
                word = SMALL.get(word, word)
            few.append(PLACEHOLDERS.get(word, word))
        if words[0] == "sweep" and not {"--trials", "--config", "--trials-from"} & {*words}:
            few += ["--trials", "2"]
        for command, more in FEW.items():
            if " ".join(words).startswith(command):
                few = [w for w in few if w not in ("--rows", "200")] + more.split()
        return few

    def serves(self, words: list[str]) -> bool:
        """Whether the command runs until it is interrupted."""
        return words[0] == "view" and not {"--html", "--video", "--strips"} & {*words}


class interrupted:
    """Ctrl-C once `served` has been true for `SERVED_S` seconds; never without it."""

    def __init__(self, served: Callable[[], bool] | None) -> None:
        self.served = served
        self.ends_s = time.monotonic() + LATEST_S

    def __enter__(self) -> None:
        if self.served:
            signal.signal(signal.SIGALRM, self.look)
            signal.setitimer(signal.ITIMER_REAL, SERVED_S, SERVED_S)

    def look(self, *of_the_signal: Any) -> None:
        """Ctrl-C, the second time that it serves."""
        if time.monotonic() > self.ends_s:
            signal.default_int_handler(*of_the_signal)
        if self.served and self.served():
            self.ends_s = 0.0

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def demo(reader: Reader) -> None:
    """The run that `make demo` leaves: the sweep that its line of the Makefile runs."""
    recipe = (ROOT / "Makefile").read_text().partition("\ndemo:")[2].splitlines()[1]
    reader.ours(["sweep", *shlex.split(recipe.partition("r2h_batch.sweep")[2])])


def poses(reader: Reader) -> None:
    """The poses of a reader's own program, for 2 trials of each split, and a motion that stands still."""
    import torch

    from r2h_batch.methods.random import predict

    benchmark = load_benchmark()
    evaluator, trials = Evaluator(benchmark), benchmark.trials(2)
    answer = predict(trials, evaluator.scene)
    q = torch.tensor(evaluator.scene.robot.home_q, dtype=torch.float32).expand(len(trials), 2, -1)
    reader.names |= {"T_obj_ee": answer.T_obj_ee, "T_world_ee": answer.T_world_ee, "k": 1}
    reader.names |= {"evaluator": evaluator, "trials": trials, "q": q, "time_s": torch.tensor([0.0, 1.0])}


def motions(reader: Reader) -> None:
    """A file of these motions."""
    import numpy as np

    own, n = reader.names, len(reader.names["trials"])
    flat = {"q": own["q"].reshape(2 * n, -1), "time_s": own["time_s"].repeat(n), "length": np.full(n, 2)}
    np.savez("motions.npz", trial_id=own["trials"].trial_id, T_obj_ee=own["T_obj_ee"], **flat)


def mine(reader: Reader) -> None:
    """The run of the reader's own method."""
    rules(reader)
    reader.ours(["sweep", "--method", "mine=my_rules.py:predict", "--trials", "60", "--out", "runs/mine"])


def tutorials_file(reader: Reader) -> None:
    """mine.npz, as the tutorial's section 3 writes it."""
    poses(reader)
    (block,) = [p for p in pieces((ROOT / "docs" / "tutorial.md").read_text()) if "np.savez" in p.text]
    reader.python(block)


def rules(reader: Reader) -> None:
    """my_rules.py, copied from the page that has it."""
    page = (ROOT / "docs" / "howto" / "method.md").read_text()
    block = next(p for p in pieces(page) if "def predict" in p.text)
    (reader.folder / "my_rules.py").write_text(block.text)
    at = reader.folder / "path" / "to"
    at.mkdir(parents=True)
    shutil.copy(reader.folder / "my_rules.py", at)


def two_robots(reader: Reader) -> None:
    """Runs of two robots."""
    for robot in ("ur5e_2f85", "ur3e_2f85"):
        reader.ours(["sweep", "--robot", robot, "--method", "random", "--out", f"runs/{robot.partition('_')[0]}"])


def scans(reader: Reader) -> None:
    """The demo's methods on a mesh of the reader's own."""
    import trimesh

    Path("meshes").mkdir()
    trimesh.creation.box((0.05, 0.06, 0.1)).export("meshes/box.obj")
    line = ["--method", "random", "oracle", "--objects", "meshes", "--splits", "S0", "--trials", "60"]
    reader.ours(["sweep", *line, "--out", "runs/scans"])


def theirs(reader: Reader) -> None:
    """Somebody else's run."""
    reader.ours(["sweep", "--method", "random", "--trials", "60", "--out", "runs/theirs"])


def sweep_file(reader: Reader) -> None:
    """sweep.yaml with the fields that the page lists."""
    text = (ROOT / "docs" / "sweeps.md").read_text()
    sentence = re.findall(r"`sweep.yaml` has.*?\)\.", text, re.DOTALL)[0]
    fields = re.findall(r"`(\w+: [^`]+)`", sentence)
    assert len(fields) >= 3
    Path("sweep.yaml").write_text("\n".join(re.sub(r"\d+", lambda m: SMALL[m[0]], f) for f in fields))


def released(reader: Reader) -> None:
    """A run, and its trials as files of the release, with results."""
    reader.ours(["sweep", "--method", "random", "--benchmark", "r2h-release", "--out", "runs/demo"])
    reader.ours(["export", "release", "runs/demo", "--out", "files"])


PAGES: dict[str, tuple[Callable[[Reader], None], ...]] = {
    "README.md": (),
    "docs/tutorial.md": (rules, poses),
    "docs/howto/method.md": (rules, poses, motions),
    "docs/howto/report.md": (demo, poses, mine, two_robots),
    "docs/training_loop.md": (poses,),
    "docs/robots.md": (),
    "docs/benchmark.md": (),
    "docs/closed_loop.md": (),
    "docs/r2h_v3.md": (mine,),
    "docs/choices.md": (),
    "docs/sweeps.md": (rules, sweep_file),
    "docs/release.md": (released,),
}
"""Page -> what a reader has made before."""
SLOW_PAGES = {"docs/howto/report.md": (scans, theirs)}
"""Page -> what else its slow parts need."""
PLACEHOLDERS = {"RUN": "runs/demo", "OTHER": "runs/mine", "FOLDER": "files", "FILE": "motions.npz"}


def warm() -> None:
    """Imports and kernels that most pages need: once, and not in every page's process."""
    from r2h_batch import EvalConfig
    from r2h_batch.__main__ import command_of
    from r2h_batch.config import ExecConfig
    from r2h_batch.methods.random import predict

    for name in ("sweep", "report", "compare"):
        command_of(name)
    evaluator, trials = (
        Evaluator(load_benchmark("r2h-v1"), EvalConfig(execute=ExecConfig(sim="none"))),
        load_benchmark("r2h-v1").trials(2),
    )
    answer = predict(trials, evaluator.scene)
    evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="gets a folder for each page, with all that it wrote and PAGE.log")
    parser.add_argument("pages", nargs="+", choices=PAGES, metavar="PAGE")
    parser.add_argument("--slow", action="store_true")
    asked = parser.parse_args()
    packages = OnlyInstalled()
    sys.meta_path[sys.meta_path.index(PathFinder)] = packages
    warm()
    failed = 0
    for page in asked.pages:
        folder = asked.folder.resolve() / page.replace("/", "_")
        folder.mkdir(parents=True)
        if not (child := os.fork()):
            with (asked.folder.resolve() / f"{folder.name}.log").open("w") as log:
                os.dup2(log.fileno(), 1)
                os.dup2(log.fileno(), 2)
            os._exit(followed(page, folder, packages, asked.slow))
        failed += os.waitpid(child, 0)[1] != 0
    sys.exit(min(failed, 1))


def followed(page: str, folder: Path, packages: OnlyInstalled, slow: bool) -> int:
    """The exit code of a page's own process; its last line says how many pieces ran, or what failed."""
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    reader = Reader(folder, packages, slow=slow)
    try:
        for prepare in PAGES[page] + (SLOW_PAGES.get(page, ()) if slow else ()):
            prepare(reader)
        reader.follow(ROOT / page)
    except BaseException as error:
        print(f"FAILED {error}", flush=True)
        return 1
    print(f"{len(reader.ran)} ran", flush=True)
    return 0


if __name__ == "__main__":
    main()
