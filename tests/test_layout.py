"""The layout that .importlinter cannot see: circles, and private names borrowed across folders."""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytestmark = [pytest.mark.check, pytest.mark.usefixtures("syntax_trees")]


@cache
def modules() -> dict[str, Path]:
    """Dotted name -> file, as in a wheel: kernels/ inside the package."""
    found = {}
    for folder, prefix in (("r2h_batch", "r2h_batch"), ("kernels", "r2h_batch.kernels")):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((prefix, *parts)).removesuffix(".__init__")] = path
    return found


@cache
def nodes_of(path: Path, *, types: bool = False) -> list[ast.AST]:
    """Every node of a file's syntax; what only type checkers import is left out, unless `types`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and getattr(node.test, "id", getattr(node.test, "attr", "")) == "TYPE_CHECKING":
            node.body = node.body if types else []
    return list(ast.walk(tree))


@cache
def imports_of(path: Path, *, types: bool = False) -> list[tuple[str, str]]:
    """(module, name) of every import of the package's own, lazy ones included; those for type checkers with `types`."""
    found = []
    for node in nodes_of(path, types=types):
        if isinstance(node, ast.Import):
            found += [(a.name, "") for a in node.names if a.name.startswith("r2h_batch")]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if node.level:
                package = ("r2h_batch", *path.relative_to(ROOT).parts)[: -node.level]
                module = ".".join((*package, *module.split(".") * bool(module)))
            if module.startswith("r2h_batch"):
                found += [(module, a.name) for a in node.names]
    return found


def test_kernels_import_relatively_what_depends_on_the_number_of_joints_and_nothing_else() -> None:
    """A second instance of the kernels (r2h_batch.base.launch.instances) has its own of these, and shares all others."""
    kernels = {n: path for n, path in modules().items() if n.startswith("r2h_batch.kernels.")}
    imported = {n: {m for m, _ in imports_of(path)} for n, path in kernels.items()}
    sized, before = {"r2h_batch.kernels.robot.joints"}, 0
    while before < len(sized):
        before = len(sized)
        sized |= {n for n, own in imported.items() if own & sized}
    wrong = []
    for name, path in kernels.items():
        for node in nodes_of(path):
            if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module in sized:
                wrong.append(f"{name} imports {node.module}")
            elif isinstance(node, ast.ImportFrom) and node.level and name not in sized:
                wrong.append(f"{name} imports relatively")
    assert len(sized) > 20 and wrong == []


def test_no_file_imports_itself_through_others_not_even_lazily_or_for_its_types() -> None:
    """For types an `__init__.py` names what it hands on when it is asked: that is no import of the file."""
    known = modules()
    own = {name: imports_of(path, types=path.name != "__init__.py") for name, path in known.items()}
    graph = {
        name: {f"{m}.{n}" if f"{m}.{n}" in known else m for m, n in found} - {"r2h_batch"}
        for name, found in own.items()
    }
    assert len(graph) > 150 and sum(map(len, graph.values())) > 400
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_no_file_takes_what_the_package_offers_its_users_from_there() -> None:
    """`r2h_batch/__init__.py` stands above all: a file that asks it for a name imports upwards."""
    known = modules()
    wrong = [(n, w) for n, p in known.items() for m, w in imports_of(p) if m == "r2h_batch" and f"{m}.{w}" not in known]
    assert wrong == []


def test_no_private_name_is_borrowed_across_folders() -> None:
    borrowed = [
        f"{name}: {module}.{word}"
        for name, path in modules().items()
        for module, word in imports_of(path)
        if any(p.startswith("_") and not p.startswith("__") for p in (*module.split("."), word))
        and module.rpartition(".")[0] != name.rpartition(".")[0]
    ]
    assert borrowed == []


def test_no_build_script_of_the_assets_is_imported() -> None:
    wrong = [(n, m) for n, path in modules().items() for m, _ in imports_of(path) if m.startswith("r2h_batch.assets")]
    assert wrong == []


FACTORIES = (
    *("arange", "empty", "eye", "full", "linspace", "logspace", "normal", "ones", "rand", "randint", "randn"),
    *("randperm", "scalar_tensor", "tensor", "tril_indices", "triu_indices", "zeros"),
)
"""Functions of torch whose results have the default dtype and device, which belong to the caller's program."""


def test_every_new_tensor_says_its_dtype_and_device() -> None:
    silent, seen = [], 0
    for name, path in modules().items():
        for node in nodes_of(path):
            if (
                isinstance(node, ast.Call)
                and getattr(node.func, "attr", "") in FACTORIES
                and ast.unparse(node.func.value) == "torch"
            ):
                seen += 1
                if missing := {"dtype", "device"} - {k.arg for k in node.keywords}:
                    silent.append(f"{name}:{node.lineno} {', '.join(sorted(missing))}")
    assert seen > 100 and silent == []


def test_every_fault_of_the_list_says_what_happens_and_has_a_test_that_is_there() -> None:
    """`tests/faults.tsv`: what goes wrong, what happens then, and `FILE::test_...` or a bench."""
    listed = [line.split("\t") for line in (ROOT / "tests/faults.tsv").read_text().splitlines()]
    assert len(listed) > 60 and len({fault for fault, *_ in listed}) == len(listed)
    assert [fault for fault, happens, _ in listed if not happens.strip()] == []
    for _, _, place in listed:
        path, _, name = place.split(" ")[0].partition("::")
        assert f"def {name}(" in (ROOT / path).read_text(encoding="utf-8") if name else (ROOT / path).is_file(), place
