"""The project as a package: what a wheel holds, what the public names are, what an import costs."""

import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from needs import HADOLINT, needs
from types_of_all import check

import r2h_batch

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
    assert "5 kept, 0 broken" in done.stdout


@needs("setuptools")
def test_the_wheel_and_the_lock_ask_for_what_is_installed_here_and_nothing_else(wheel: Path) -> None:
    (file,) = wheel.parent.glob("*.whl")
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--no-index", "--disable-pip-version-check"]
    command += ["-c", str(ROOT / "constraints.txt"), f"{file}[test]"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    would = [line for line in done.stdout.splitlines() if line.startswith("Would install")]
    assert done.returncode == 0, done.stdout + done.stderr
    assert [w for line in would for w in line.split()[2:] if not w.startswith("r2h")] == []


USER = """
from r2h_batch import EvalConfig, Evaluator, Scene, Scores, Trials, make_trials

evaluator = Evaluator(EvalConfig(), device="cpu")
trials = make_trials(["S1"], 8)
reveal_type(evaluator)
reveal_type(trials)

def rate(scores: Scores) -> float:
    return float(scores.success.float().mean())

def judge(scene: Scene, asked: Trials) -> Scores:
    reveal_type(scene.part_names)
    return evaluator.score(asked.T_world_hand, asked.T_world_hand, asked)

print(rate(judge(evaluator.scene, trials)))
"""
MISSPELT = """
from r2h_batch import Evaluater
from r2h_batch.kernels.plan.rrt import no_such_kernel
import r2h_batch

print(r2h_batch.make_trails(["S1"], 8), Evaluater, no_such_kernel)
"""


@needs("setuptools")
def test_a_type_checker_sees_the_public_names_and_every_kernel_that_is_imported(wheel: Path) -> None:
    (wheel / "user.py").write_text(USER)
    (wheel / "misspelt.py").write_text(MISSPELT)
    done = check(wheel, "user.py", "misspelt.py", cwd=wheel)
    lines = done.stdout.splitlines()
    mine = [line.partition(": ")[2] for line in lines if line.startswith("user.py")]
    assert not [line for line in mine if "error" in line] and len(mine) == 3, done.stdout + done.stderr
    assert 'Revealed type is "r2h_batch.evaluate.Evaluator"' in mine[0] and "r2h_batch.types.Trials" in mine[1]
    wrong = [line for line in lines if line.startswith("misspelt.py") and "attr-defined" in line]
    assert [any(name in line for line in wrong) for name in ("Evaluater", "make_trails", "no_such_kernel")] == [
        True
    ] * 3
    assert [line for line in lines if "error:" in line and not line.startswith("misspelt.py")] == []


def test_an_editable_install_is_a_path_that_type_checkers_follow() -> None:
    """mypy and pyright do not run the import hook that setuptools writes otherwise."""
    assert [f for f in sys.meta_path if "r2h_batch" in getattr(f, "__module__", "")] == []


def test_containers_run_targets_of_the_makefile() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    container = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text())
    lines = [(ROOT / "Dockerfile").read_text().replace('["make", "test"]', "make test"), container["postCreateCommand"]]
    named = [re.findall(r"(?:RUN|CMD|^)\s*make ([a-z]+)", line, re.MULTILINE) for line in lines]
    assert named == [["demo", "test"], ["demo"]] and targets >= {"demo", "test"}
    assert (ROOT / ".devcontainer" / container["build"]["dockerfile"]).resolve() == ROOT / "Dockerfile"


@needs("hadolint")
def test_the_dockerfile_has_no_fault_that_hadolint_knows() -> None:
    done = subprocess.run([HADOLINT, ROOT / "Dockerfile"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_every_public_name_can_be_imported() -> None:
    for name in r2h_batch.__all__:
        assert getattr(r2h_batch, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'Evaluater'; it has CRITERIA, EvalConfig, Evaluator"):
        _ = r2h_batch.Evaluater  # type: ignore[attr-defined]


def test_importing_the_package_does_not_import_torch_or_warp() -> None:
    code = "import sys, r2h_batch; sys.exit(any(m in sys.modules for m in ('torch', 'warp', 'mujoco')))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


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


def test_no_file_names_a_package_registry() -> None:
    files = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    hosts = re.compile("|".join(["py" + r"pi\.org", "files\\.python" + "hosted", "registry\\.np" + "mjs"]))
    text = (ROOT / f for f in files if Path(f).suffix in {".py", ".md", ".toml", ".txt", ".json", ".yaml", ".cfg", ""})
    assert [f.name for f in text if f.is_file() and hosts.search(f.read_text(errors="ignore"))] == []
