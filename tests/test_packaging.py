"""The project as a package: what a wheel holds, what the public names are, what an import costs."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import r2h_batch

ROOT = Path(__file__).resolve().parents[1]


def test_a_wheel_holds_code_kernels_and_data(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(tmp_path), str(ROOT)]
    pytest.importorskip("setuptools")
    subprocess.run(command, check=True, capture_output=True)
    names = zipfile.ZipFile(next(tmp_path.glob("*.whl"))).namelist()
    for wanted in (
        "r2h_batch/py.typed", "r2h_batch/kernels/gjk.py", "r2h_batch/assets/robot/robot.json",
        "r2h_batch/assets/hand/handset.npz", "r2h_batch/assets/objects/hammer.npz", "r2h_batch/assets/objects/grasps.npz",
        "r2h_batch/assets/receiving/receiving.npz", "r2h_batch/assets/receiving/voxnet.safetensors",
    ):  # fmt: skip
        assert wanted in names
    assert not [n for n in names if n.startswith(("kernels/", "assets/", "tests/", "bench/"))]


def test_every_public_name_can_be_imported() -> None:
    for name in r2h_batch.__all__:
        assert getattr(r2h_batch, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'Evaluater'; it has EvalConfig, Evaluator"):
        _ = r2h_batch.Evaluater  # type: ignore[attr-defined]


def test_importing_the_package_does_not_import_torch_or_warp() -> None:
    code = "import sys, r2h_batch; sys.exit(any(m in sys.modules for m in ('torch', 'warp', 'mujoco')))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_kernels_import_warp_only() -> None:
    for path in (ROOT / "kernels").glob("*.py"):
        for module in re.findall(r"^(?:import|from)\s+([\w.]+)", path.read_text(), re.MULTILINE):
            assert module == "warp" or module.startswith("r2h_batch.kernels"), f"{path.name} imports {module}"


def test_no_file_names_a_package_registry() -> None:
    files = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    hosts = re.compile("|".join(["py" + r"pi\.org", "files\\.python" + "hosted", "registry\\.np" + "mjs"]))
    text = (ROOT / f for f in files if Path(f).suffix in {".py", ".md", ".toml", ".txt", ".json", ".yaml", ".cfg", ""})
    assert [f.name for f in text if f.is_file() and hosts.search(f.read_text(errors="ignore"))] == []
