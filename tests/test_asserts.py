"""Every test asserts something whatever its data are: a loop over nothing, or an `if` that nobody enters, asserts nothing."""

import ast
from functools import cache
from pathlib import Path

import pytest
from rounds import each

TESTS = Path(__file__).resolve().parent
pytestmark = pytest.mark.usefixtures("syntax_trees")

FAIL_BY_THEMSELVES = {"raises", "warns", "fail"}
"""Functions of pytest that fail by themselves."""

KNOWN: tuple[str, ...] = ()
"""Tests whose asserts all stand in loops or ifs that may be empty. This list only shrinks: mend a test (`rounds.each` demands
rounds of its loop), and take its line out."""


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def functions_of(path: Path) -> dict[str, ast.FunctionDef]:
    """Functions of a file, and those that it imports from tests/support, by the names that the file has for them."""
    tree = tree_of(path)
    found: dict[str, ast.FunctionDef] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (helper := TESTS / "support" / f"{node.module}.py").is_file():
            theirs = functions_of(helper)
            found |= {a.asname or a.name: theirs[a.name] for a in node.names if a.name in theirs}
        elif isinstance(node, ast.FunctionDef):
            found[node.name] = node
    return found


def has_rounds(items: ast.expr) -> bool:
    """Whether the items of a loop are some by what is written: literals, constants, a range of numbers, `each(...)`."""
    if isinstance(items, (ast.Tuple, ast.List, ast.Set)):
        return any(not isinstance(e, ast.Starred) or has_rounds(e.value) for e in items.elts)
    if isinstance(items, ast.Dict):
        return bool(items.keys)
    if isinstance(items, ast.Constant):
        return bool(items.value)
    if isinstance(items, (ast.Name, ast.Attribute)):
        return (items.id if isinstance(items, ast.Name) else items.attr).isupper()
    if not isinstance(items, ast.Call):
        return False
    of = items.func
    if isinstance(of, ast.Attribute):
        return of.attr in ("items", "keys", "values") and has_rounds(of.value)
    name = of.id if isinstance(of, ast.Name) else ""
    strict = any(k.arg == "strict" and isinstance(k.value, ast.Constant) and k.value.value for k in items.keywords)
    if name == "zip" and items.args:
        return (any if strict else all)(has_rounds(a) for a in items.args)
    if name in ("enumerate", "sorted", "reversed", "list", "tuple", "set") and items.args:
        return has_rounds(items.args[0])
    return name == "each" or (name == "range" and all(isinstance(a, ast.Constant) for a in items.args))


def asserts(body: list[ast.stmt], known: dict[str, ast.FunctionDef], inside: frozenset[str] = frozenset()) -> bool:
    """Whether an assert of these statements is reached whatever the data are."""
    return any(_asserts(statement, known, inside) for statement in _reached(body))


def _reached(body: list[ast.stmt]) -> list[ast.stmt]:
    """The statements up to the first `if` that may leave the block."""
    leaves = (ast.Continue, ast.Break, ast.Return)
    for k, statement in enumerate(body):
        if isinstance(statement, ast.If) and any(isinstance(n, leaves) for n in ast.walk(statement)):
            return body[: k + 1]
    return body


def _asserts(node: ast.stmt, known: dict[str, ast.FunctionDef], inside: frozenset[str]) -> bool:
    if isinstance(node, ast.Assert):
        return True
    if isinstance(node, ast.With):
        return any(_fails(i.context_expr, known, inside) for i in node.items) or asserts(node.body, known, inside)
    if isinstance(node, ast.For):
        return has_rounds(node.iter) and asserts(node.body, known, inside)
    if isinstance(node, ast.Try):
        return asserts([*node.body, *node.finalbody], known, inside)
    if isinstance(node, ast.If):
        return bool(node.orelse) and asserts(node.body, known, inside) and asserts(node.orelse, known, inside)
    if isinstance(node, (ast.Expr, ast.Assign, ast.Return)) and node.value is not None:
        return _fails(node.value, known, inside)
    return False


def _fails(value: ast.expr, known: dict[str, ast.FunctionDef], inside: frozenset[str]) -> bool:
    """Whether an expression calls something that asserts."""
    may_not_run = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp, ast.Lambda, ast.IfExp)
    left: list[ast.AST] = [value]
    while left:
        node = left.pop()
        if isinstance(node, may_not_run):
            continue
        left += ast.iter_child_nodes(node)
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in FAIL_BY_THEMSELVES or name.startswith("assert_"):
            return True
        own = known.get(name) if isinstance(node.func, ast.Name) and name not in inside else None
        if own is not None and asserts(own.body, known, inside | {name}):
            return True
    return False


def without_sure_assert(path: Path) -> list[str]:
    """Tests of a file that may pass without an assert."""
    functions = functions_of(path)
    own = [n for n in ast.walk(tree_of(path)) if isinstance(n, ast.FunctionDef)]
    return [
        f"{path.relative_to(TESTS).as_posix()}::{f.name}"
        for f in own
        if f.name.startswith("test_") and not asserts(f.body, functions)
    ]


def test_asserts_of_a_test_are_reached_whatever_its_data_are() -> None:
    paths = sorted(TESTS.rglob("test_*.py"))
    found = {name for path in paths for name in without_sure_assert(path)}
    assert len(paths) > 100 and sorted(found - set(KNOWN)) == []
    mended = sorted(set(KNOWN) - found)
    assert mended == [], "take these lines out of KNOWN"


@pytest.mark.check
@pytest.mark.parametrize(
    ("text", "sure"),
    [
        ("assert x", True),
        ("for a in x: assert a", False),
        ("for a in each(x): assert a", True),
        ("for a in each(x):\n if a: continue\n assert a", False),
        ("for a in (1, 2):\n for b in x: assert b", False),
        ("for a in zip(x, (1, 2)): assert a", False),
        ("for a in zip(x, (1, 2), strict=True): assert a", True),
        ("for a in range(len(x)): assert a", False),
        ("if x: assert x", False),
        ("if x: assert x\nelse: assert not x", True),
        ("if x: return\nassert x", False),
        ("with pytest.raises(ValueError): x()", True),
        ("with open(x): assert x", True),
        ("while x: assert x", False),
        ("helper(x)", True),
        ("weak(x)", False),
        ("[helper(a) for a in x]", False),
        ("x()", False),
    ],
)
def test_what_counts_as_an_assert_that_is_reached(tmp_path: Path, text: str, sure: bool) -> None:
    helpers = "def helper(x):\n    assert x\n\n\ndef weak(x):\n    for a in x:\n        assert a\n\n\n"
    path = tmp_path / "test_made.py"
    body = "\n".join(f"    {line}" for line in text.splitlines())
    path.write_text(f"{helpers}def test_it():\n{body}\n")
    functions = functions_of(path)
    assert asserts(functions["test_it"].body, functions) == sure


@pytest.mark.check
def test_each_demands_rounds_and_gives_all_items() -> None:
    assert each(iter("abc"), 3) == ["a", "b", "c"]
    for items, at_least in (([], 1), (iter("ab"), 3)):
        with pytest.raises(AssertionError, match=rf"rounds; its test needs {at_least} or more"):
            each(items, at_least)
