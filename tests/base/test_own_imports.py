"""Imports of the package's modules, as their text says, compared with their syntax trees."""

import ast

import pytest
from rounds import each

from r2h_batch.base.own_imports import PACKAGE, imported_by, imports_of, is_package, modules_of
from r2h_batch.base.package import FOLDERS

FILES = {
    "r2h_batch/__init__.py": "",
    "r2h_batch/top.py": "def later():\n    from r2h_batch.room import (\n        a,  # one, (two)\n        b as c,\n    )\n",
    "r2h_batch/room/__init__.py": (
        "from r2h_batch.base.package import lazy_names\nif TYPE_CHECKING:\n    from r2h_batch.room.lazy import thing\n"
        "    from r2h_batch.room.other import more\n__getattr__, __dir__ = lazy_names(__name__, {})\n"
    ),
    "r2h_batch/room/a.py": "import os, r2h_batch.plain as p\n",
    "r2h_batch/room/b.py": '"""Say\n    from r2h_batch.told import it\n"""\nif x:\n    from .. import up\n',
    "r2h_batch/room/lazy.py": "",
    "r2h_batch/room/other.py": "",
    "r2h_batch/plain.py": "if TYPE_CHECKING:\n    from r2h_batch import told\n\nX = 1\n",
    "r2h_batch/told.py": "",
    "r2h_batch/up.py": "from .room import thing\n",
    "r2h_batch/named.py": 'A = "r2h_batch.plain"\nB = f"r2h_batch.sim_{A}"\nC = ("r2h_batch.kinds",)\n',
    "r2h_batch/sim_one.py": "",
    "r2h_batch/sim_two.py": "",
    "r2h_batch/kinds/__init__.py": "",
    "r2h_batch/kinds/red.py": "",
    "r2h_batch/kinds/deep/blue.py": "",
    "kernels/__init__.py": "",
    "kernels/plan/k.py": "from ..robot import j\n",
    "kernels/robot/j.py": "",
    "r2h_batch/whole.py": "from r2h_batch import room\nimport r2h_batch.kernels.plan.k\n",
}


@pytest.fixture
def files(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return modules_of((tmp_path / "r2h_batch", tmp_path))


IMPORTS = {
    "top": {"room.a", "room.b"},
    "room.a": {"plain"},
    "room.b": {"up"},
    "plain": set(),
    "up": {"room", "room.lazy"},  # the one name that it takes
    "whole": {"room", "room.lazy", "room.other", "kernels.plan.k"},  # any of its names may follow
    "named": {"plain", "sim_one", "sim_two", "kinds", "kinds.red"},
    "kernels.plan.k": {"kernels.robot.j"},
}


@pytest.mark.parametrize("name", IMPORTS)
def test_imports_count_wherever_they_stand_and_in_whatever_form(files, name):
    found = {m.removeprefix(f"{PACKAGE}.") for m in imports_of(f"{PACKAGE}.{name}", files)} - {PACKAGE}
    assert found == IMPORTS[name]


def test_what_a_root_needs_has_its_packages_and_stops_where_it_is_told_to(files):
    found = imported_by([f"{PACKAGE}.top"], files)
    assert found == {
        PACKAGE,
        *(f"{PACKAGE}.{m}" for m in ("top", "room", "room.a", "room.b", "plain", "up", "room.lazy")),
    }
    stop = imported_by([f"{PACKAGE}.top"], files, not_followed={(f"{PACKAGE}.top", f"{PACKAGE}.room.b")})
    assert stop == {PACKAGE, *(f"{PACKAGE}.{m}" for m in ("top", "room", "room.a", "plain"))}
    anywhere = imported_by([f"{PACKAGE}.top"], files, not_followed={("*", f"{PACKAGE}.plain")})
    assert anywhere == found - {f"{PACKAGE}.plain"}
    assert f"{PACKAGE}.kinds.deep.blue" in imported_by([f"{PACKAGE}.kinds"], files)  # a package is all that lies in it
    with pytest.raises(ModuleNotFoundError, match=f"no module {PACKAGE}.gone"):
        imported_by([f"{PACKAGE}.gone"], files)


def of_tree(name: str, files) -> set[str]:
    """Modules that the import statements of a syntax tree name, those for type checkers left out."""
    found = set()

    def look(node: ast.AST) -> None:
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            for inner in node.orelse:
                look(inner)
            return
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            rooms = name.split(".") if is_package(files[name]) else name.split(".")[:-1]
            above = rooms[: len(rooms) - node.level + 1] if node.level else []
            base = ".".join((*above, *filter(None, [node.module])))
            inner = {f"{base}.{alias.name}" for alias in node.names} & files.keys()
            found.update(inner or [base])
        for child in ast.iter_child_nodes(node):
            look(child)

    look(ast.parse(files[name].read_bytes()))
    return found & files.keys() - {name}


def test_no_import_of_the_package_is_overlooked_and_none_is_made_up():
    files = modules_of(FOLDERS)
    for name in each(files):
        tree, found = of_tree(name, files), imports_of(name, files)
        assert tree <= found, f"{name}: {sorted(tree - found)}"
        words = files[name].read_text()
        for other in found - tree:  # a lazy name, or a name in a string
            room = other.rpartition(".")[0]
            lazy = room in tree or any(m.startswith(f"{room}.") for m in tree) or "lazy_names" in words
            assert lazy or f'"{room}' in words, f"{name}: {other}"
