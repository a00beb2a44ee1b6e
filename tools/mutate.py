"""Puts random faults into one file, one at a time: does a test fail?

python tools/mutate.py FILE TEST... [--count 20] [--seed 0] [--minutes 30]

A copy of the tree gets one fault at a time: a comparison turned, an operator exchanged, a constant moved, a condition negated,
min and max exchanged, an assignment left without its change. Nothing is kept by hand: faults follow from file, seed and number,
so a table can be made again, and code that moves needs no care. A row says killed or SURVIVED; a survivor shows what changed.
Exit codes: 0 all killed, 1 one survived, 2 the tests fail without any fault, or none of them ran: a mark leaves them out
(`... TEST -- -m slow` runs those). Kernels with a fault are compiled anew.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LINKED = ("assets", "docs", "bench")
"""Folders that are linked into the copy: no fault goes there."""
LEFT_OUT = (".git", ".venv", "build", "runs")
NO_TEST_RAN = 5
"""pytest's exit code."""
MOST_S = 1500
"""A test run that takes longer counts as failed: a fault may make a loop endless."""
EDGE: dict[type, type] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}
TURNED: dict[type, type] = {ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE}
OPERATOR: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
CALLED = {"min": "max", "amin": "amax", "any": "all", "minimum": "maximum"}
CALLED |= {new: old for old, new in CALLED.items()}


class Fault(NamedTuple):
    """A place in the syntax tree, what kind of fault it gets, and the change itself."""

    node: Any
    kind: str
    put: Callable[[Any], None]


def _compared(operators: dict[type, type]) -> Callable[[Any], None]:
    def put(node: Any) -> None:
        node.ops[0] = operators[type(node.ops[0])]()

    return put


def _operator(node: Any) -> None:
    node.op = OPERATOR[type(node.op)]()


def _either(node: Any) -> None:
    node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()


def _negated(node: Any) -> None:
    node.test = ast.UnaryOp(ast.Not(), node.test)


def _unsigned(node: Any) -> None:
    node.op = ast.UAdd()


def _moved(node: Any) -> None:
    node.value = node.value + 1 if isinstance(node.value, int) else 1.1 * node.value + 1e-3


def _called(node: Any) -> None:
    key = "attr" if isinstance(node.func, ast.Attribute) else "id"
    setattr(node.func, key, CALLED[getattr(node.func, key)])


def _unchanged(node: Any) -> None:
    node.value = ast.Constant(0)


def faults_of(tree: ast.AST) -> Iterator[Fault]:
    """Every fault that a module can get; docstrings and annotations are left out."""
    silent = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            silent.add(id(node.value))
        for part in (getattr(node, "annotation", None), getattr(node, "returns", None)):
            silent |= {id(n) for n in ast.walk(part)} if part is not None else set()
    for node in ast.walk(tree):
        if id(node) in silent:
            continue
        if isinstance(node, ast.Compare) and type(node.ops[0]) in EDGE:
            yield Fault(node, "edge", _compared(EDGE))
            if type(node.ops[0]) in TURNED:
                yield Fault(node, "turned", _compared(TURNED))
        elif isinstance(node, ast.BinOp) and type(node.op) in OPERATOR:
            yield Fault(node, "operator", _operator)
        elif isinstance(node, ast.BoolOp):
            yield Fault(node, "and, or", _either)
        elif isinstance(node, (ast.If, ast.IfExp, ast.While)):
            yield Fault(node, "negated", _negated)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield Fault(node, "sign", _unsigned)
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            yield Fault(node, "constant", _moved)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in CALLED:
            yield Fault(node, "min, max", _called)
        elif isinstance(node, ast.AugAssign):
            yield Fault(node, "left out", _unchanged)


class Mutant(NamedTuple):
    """A module with one fault: where, of which kind, the code there before and after, and the whole text."""

    line: int
    kind: str
    before: str
    after: str
    text: str


def mutant(text: str, drawn: random.Random) -> Mutant:
    """A module with a drawn fault, formatted as `ast.unparse` does: comments go.

    Raises:
        ValueError: the module has no place for a fault.
    """
    tree = ast.parse(text)
    faults = list(faults_of(tree))
    if not faults:
        raise ValueError("this file has no place for a fault")
    fault = drawn.choice(faults)
    before = ast.unparse(fault.node)
    fault.put(fault.node)
    after = ast.unparse(fault.node)
    return Mutant(fault.node.lineno, fault.kind, before, after, ast.unparse(ast.fix_missing_locations(tree)))


def copy_tree(to: Path) -> None:
    """The repository in the folder `to`, with links to what gets no fault."""
    for item in ROOT.iterdir():
        if item.name in LEFT_OUT or item.suffix == ".egg-info":
            continue
        if item.name in LINKED:
            (to / item.name).symlink_to(item, target_is_directory=True)
        elif item.is_dir():
            shutil.copytree(item, to / item.name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(item, to / item.name)


def tested(tree: Path, tests: list[str]) -> tuple[int, str]:
    """pytest's exit code for the tests in a copy, and what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    line = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(line, cwd=tree, env=environment, capture_output=True, text=True, timeout=MOST_S)
    except subprocess.TimeoutExpired:
        return 1, f"ended after {MOST_S} s"
    return done.returncode, done.stdout + done.stderr


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", help="the file that gets faults, from the root of the repository")
    parser.add_argument("tests", nargs="+", help="tests, as pytest takes them")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=30.0, help="no new fault after so long")
    options = parser.parse_args()
    until, survived, tried = time.monotonic() + 60 * options.minutes, 0, 0
    text = (ROOT / options.file).read_text("utf-8")
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        copy_tree(tree)
        code, said = tested(tree, options.tests)
        if code:
            why = "no test ran: does a mark leave them out? ... TEST -- -m slow" if code == NO_TEST_RAN else ""
            print(f"{why or 'the tests fail without any fault'}:\n{said[-2000:]}")
            return 2
        print("| | line | fault | | s | before | after |\n|--:|--:|---|---|--:|---|---|")
        for k in range(options.count):
            if time.monotonic() > until:
                break
            found, begin = mutant(text, random.Random(f"{options.file} {options.seed} {k}")), time.monotonic()
            (tree / options.file).write_text(found.text, "utf-8")
            killed = tested(tree, options.tests)[0] not in (0, NO_TEST_RAN)
            tried, survived = tried + 1, survived + (not killed)
            shown = "killed | " if killed else "SURVIVED | "
            row = f"| {k} | {found.line} | {found.kind} | {shown}{time.monotonic() - begin:.0f} |"
            print(row + (" | |" if killed else f" `{found.before[:80]}` | `{found.after[:80]}` |"), flush=True)
    print(f"{tried - survived} of {tried} killed")
    return int(survived > 0)


if __name__ == "__main__":
    sys.exit(main())
