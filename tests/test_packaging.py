"""The project as a package: what a wheel holds, what the public names are, what an import costs."""

import ast
import importlib
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from needs import needs

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package as users get it: a wheel, unpacked."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    subprocess.run([*command, str(ROOT)], check=True, capture_output=True)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as file:
        file.extractall(folder / "unpacked")
    return folder / "unpacked"


@needs("setuptools")
def test_a_wheel_holds_the_modules_and_data_of_the_tree_and_nothing_else(wheel: Path) -> None:
    kinds = {
        ".py",
        ".json",
        ".npy",
        ".npz",
        ".safetensors",
        ".csv",
        ".html",
        ".typed",
        ".md",
        ".parquet",
        ".h",
        ".yaml",
    }
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    tracked = [Path(f) for f in listed if f.split("/")[0] in ("r2h_batch", "kernels", "assets") and (ROOT / f).exists()]
    wanted = {str(f if f.parts[0] == "r2h_batch" else "r2h_batch" / f) for f in tracked if f.suffix in kinds}
    found = {str(f.relative_to(wheel)) for f in wheel.rglob("*") if f.is_file() and ".dist-info" not in str(f)}
    assert len(wanted) > 250 and "r2h_batch/py.typed" in wanted
    assert found - wanted == set() and wanted - found == set()


@needs("setuptools")
@needs("importlinter")
@pytest.mark.check
def test_every_import_of_the_wheel_goes_the_way_the_data_goes(wheel: Path) -> None:
    command = [
        str(Path(sys.executable).with_name("lint-imports")),
        "--no-cache",
        "--config",
        str(ROOT / ".importlinter"),
    ]
    environment = {**os.environ, "PYTHONPATH": str(wheel)}
    done = subprocess.run(command, cwd=wheel, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "20 kept, 0 broken" in done.stdout


@pytest.mark.check
def test_kernels_import_warp_only() -> None:
    files = sorted(path for path in (ROOT / "kernels").rglob("*.py") if path.name != "__init__.py")
    assert len(files) >= 35
    for path in files:
        for module in re.findall(r"^(?:import|from)\s+([\w.]+)", path.read_text(), re.MULTILINE):
            reads_the_header = path.name == "options.py" and module == "pathlib"
            assert module == "warp" or module.startswith(("r2h_batch.kernels", ".")) or reads_the_header, (
                f"{path.relative_to(ROOT)} imports {module}"
            )


ROOMS = [p for p in sorted((ROOT / "r2h_batch").rglob("__init__.py")) if "lazy_names(" in p.read_text()]


@pytest.mark.check
@pytest.mark.parametrize("room", [".".join(p.parent.relative_to(ROOT).parts) for p in ROOMS])
def test_every_name_that_a_room_offers_is_the_one_that_type_checkers_read_there(room: str) -> None:
    module = importlib.import_module(room)
    read = {
        alias.name: node.module
        for branch in ast.parse(Path(module.__file__).read_text(encoding="utf-8")).body
        if isinstance(branch, ast.If) and ast.unparse(branch.test) == "TYPE_CHECKING"
        for node in branch.body
        for alias in node.names
    }
    assert list(read) and sorted(read) == sorted(module.__all__) == sorted(module.__dir__())
    for name, home in read.items():
        found = getattr(module, name)
        assert found is sys.modules.get(f"{home}.{name}") or found is getattr(importlib.import_module(home), name)


def test_a_room_refuses_a_name_that_it_does_not_offer() -> None:
    with pytest.raises(AttributeError, match=r"'r2h_batch\.runs' has no attribute 'lode_run'; it has Run, load_run"):
        getattr(importlib.import_module("r2h_batch.runs"), "lode_run")  # noqa: B009
