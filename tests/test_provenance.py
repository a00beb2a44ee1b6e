"""What run.json and the benchmarks say about where a figure comes from."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import torch

import r2h_batch
from r2h_batch import provenance


def test_versions_name_what_runs():
    found = provenance.versions()
    assert found["r2h_batch"] == r2h_batch.__version__
    assert found["numpy"] == np.__version__
    assert found["torch"].split("+")[0] == torch.__version__.split("+")[0]
    assert set(provenance.PACKAGES) < set(found)


def test_the_code_digest_changes_with_any_module_kernel_or_data_file_and_with_nothing_else(tmp_path, monkeypatch):
    root = Path(r2h_batch.__file__).resolve().parent.parent
    for name in ("r2h_batch", "kernels", "assets"):
        (tmp_path / name).mkdir()
        shutil.copy(next(p for p in (root / name).glob("*.py") if p.name == "__init__.py"), tmp_path / name / "a.py")
    (tmp_path / "assets" / "hand.npz").write_bytes(b"1")
    monkeypatch.setattr(r2h_batch, "__path__", [str(tmp_path / "r2h_batch"), str(tmp_path)])

    def digest() -> str:
        provenance.code_digest.cache_clear()
        return provenance.code_digest()

    seen = [digest()]
    (tmp_path / "README.md").write_text("not code")
    (tmp_path / "assets" / "a.pyc").write_bytes(b"not source")
    assert digest() == seen[0]
    for name in ("r2h_batch/a.py", "kernels/a.py", "assets/hand.npz"):
        (tmp_path / name).write_bytes(b"changed")
        seen.append(digest())
    (tmp_path / "kernels" / "b.py").write_bytes(b"new")
    seen.append(digest())
    assert len(set(seen)) == 5
    monkeypatch.undo()
    provenance.code_digest.cache_clear()


def test_the_commit_is_that_of_the_checkout_and_says_when_files_differ(tmp_path, monkeypatch):
    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "init.defaultBranch=main"]
        line = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(line, check=True, capture_output=True, text=True).stdout.strip()

    (tmp_path / "r2h_batch").mkdir()
    file = tmp_path / "r2h_batch" / "__init__.py"
    file.write_text("1")
    monkeypatch.setattr(r2h_batch, "__file__", str(file))
    assert provenance.git_commit() is None
    git("init")
    git("add", ".")
    git("commit", "-m", "one")
    git("tag", "v1")
    assert provenance.git_commit() == git("rev-parse", "HEAD")
    file.write_text("2")
    assert provenance.git_commit() == git("rev-parse", "HEAD") + "-dirty"


def test_the_cpu_is_named_with_its_cores():
    name = provenance.device_name("cpu")
    assert name.startswith("cpu: ") and name.endswith(" cores") and len(name) > len("cpu: , 2 cores")
