"""Provenance of a figure in run.json and in the benches."""

import os
import shutil
import subprocess
from pathlib import Path

import r2h_batch
from r2h_batch.runs import provenance

DECIDE = (
    "r2h_batch/evaluate.py", "r2h_batch/judge/plan.py", "r2h_batch/methods/fc.py", "r2h_batch/runs/rows.py",
    "r2h_batch/sweep/jobs.py", "r2h_batch/base/se3.py", "r2h_batch/scene/mesh_import/closed.py",
    "r2h_batch/trials/noise.py", "r2h_batch/methods/predictors/hands.py", "r2h_batch/data/robot_model.py",
    "r2h_batch/config.py", "kernels/plan/rrt.py", "kernels/geometry/gjk.py", "kernels/native/lanes.h",
    "assets/robot/robot.json", "assets/hand/handset.npz", "assets/receiving/voxnet.safetensors",
)  # fmt: skip
READ = (
    "r2h_batch/report/figures.py", "r2h_batch/report/page.html", "r2h_batch/report/statistics/paired.py",
    "r2h_batch/sweep/results/rethreshold.py", "r2h_batch/view/mjcf.py", "r2h_batch/sweep/study/report.py",
    "r2h_batch/report/compare/command.py", "r2h_batch/__main__.py", "r2h_batch/base/command_line.py",
    "r2h_batch/sweep/results/command.py", "r2h_batch/sweep/ls.py", "r2h_batch/sweep/submission.py",
    "r2h_batch/sweep/submission_judge.py",
    "r2h_batch/view/drawing.py", "r2h_batch/base/loggers.py", "assets/objects/build_objects.py",
    "r2h_batch/base/io/log.py", "assets/SOURCES.md",
)  # fmt: skip


def package_at(folder: Path) -> list[Path]:
    """The package's folders, its files as links that a test may replace."""
    root = Path(r2h_batch.__file__).resolve().parent.parent
    for name in ("r2h_batch", "kernels", "assets"):
        shutil.copytree(
            root / name, folder / name, copy_function=os.symlink, ignore=shutil.ignore_patterns("__pycache__")
        )
    return [folder / "r2h_batch", folder]


def test_the_code_digest_changes_with_what_decides_rows_and_with_nothing_else(tmp_path, monkeypatch):
    before = provenance.code_digest()
    monkeypatch.setattr(provenance, "FOLDERS", package_at(tmp_path))

    def digest() -> str:
        provenance.code_digest.cache_clear()
        return provenance.code_digest()

    def change(name: str) -> None:
        text = (tmp_path / name).read_bytes()
        (tmp_path / name).unlink()
        (tmp_path / name).write_bytes(text + b"\n# a comment\n")

    assert digest() == before
    for name in READ:
        change(name)
        assert digest() == before, name
    (tmp_path / "assets" / "a.pyc").write_bytes(b"no source")
    assert digest() == before
    seen = [before]
    for name in DECIDE:
        change(name)
        assert digest() not in seen, name
        seen.append(digest())
    (tmp_path / "kernels" / "b.py").write_bytes(b"new")
    assert digest() not in seen
    provenance.code_digest.cache_clear()


def test_a_wheel_and_a_checkout_of_the_same_files_have_the_same_code_digest(tmp_path, monkeypatch):
    checkout = package_at(tmp_path)
    monkeypatch.setattr(provenance, "FOLDERS", checkout)
    provenance.code_digest.cache_clear()
    before = provenance.code_digest()
    for name in ("kernels", "assets"):
        (tmp_path / name).rename(tmp_path / "r2h_batch" / name)
    monkeypatch.setattr(provenance, "FOLDERS", checkout[:1])
    provenance.code_digest.cache_clear()
    assert provenance.code_digest() == before
    provenance.code_digest.cache_clear()


def test_the_commit_is_that_of_the_checkout_and_says_when_files_differ(tmp_path, monkeypatch):
    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "init.defaultBranch=main"]
        line = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(line, check=True, capture_output=True, text=True).stdout.strip()

    (tmp_path / "r2h_batch").mkdir()
    file = tmp_path / "r2h_batch" / "__init__.py"
    file.write_text("1")
    monkeypatch.setattr(provenance, "ROOT", file.parent)
    assert provenance.git_commit() is None
    git("init")
    git("add", ".")
    git("commit", "-m", "one")
    git("tag", "v1")
    assert provenance.git_commit() == git("rev-parse", "HEAD")
    file.write_text("2")
    assert provenance.git_commit() == git("rev-parse", "HEAD") + "-dirty"
