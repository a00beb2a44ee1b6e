"""Provenance of a figure in run.json and in the benches."""

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import pytest
from rounds import each

import r2h_batch
from r2h_batch.base.own_imports import PACKAGE, imports_of, modules_of
from r2h_batch.runs import provenance
from r2h_batch.runs.header import differing
from r2h_batch.sweep import command as sweep

DECIDE = {
    "draw of trials": ("trials/draw/reaching.py", "trials/r2h_v2.py", "scene/families/vessels.py"),
    "what methods see": ("trials/noise.py", "methods/predictors/hands.py", "observe/sensor.py", "observe/rig.py"),
    "method": ("methods/fc.py", "methods/ranker/search.py"),
    "closed loop": ("closed_loop/env.py", "closed_loop/policies.py", "closed_loop/episodes.py"),
    "evaluator": (
        "evaluate.py",
        "stages.py",
        "launching.py",
        "work.py",
        "config.py",
        "judge/plan.py",
        "judge/metrics.py",
        "judge/motion/sim_mujoco.py",
    ),
    "scene": ("scene/mesh_import/closed.py", "scene/mesh_import/pieces.py", "scene/robot.py", "data/people.py"),
    "below": ("base/se3.py", "base/launch/cached.py", "base/rng.py"),
    "rows": ("runs/rows.py", "sweep/jobs.py", "sweep/scoring.py"),
    "kernel": ("kernels/plan/rrt.py", "kernels/geometry/gjk.py"),
    "native header": ("kernels/native/lanes.h", "kernels/native/arm.h"),
    "asset": ("assets/robot/robot.json", "assets/hand/handset.npz", "assets/receiving/voxnet.safetensors"),
}
"""Kind -> files of it, each below r2h_batch/ or in a folder beside it."""
READ = {
    "report": ("report/figures.py", "report/page.html", "report/statistics/paired.py", "report/statistics/shares.py"),
    "view": ("view/mjcf.py", "view/drawing.py"),
    "stored rows judged again": (
        "sweep/results/reevaluation.py",
        "sweep/results/rethreshold.py",
        "sweep/study/report.py",
    ),
    "command": (
        *("__main__.py", "base/command_line.py", "sweep/command.py", "commands/ls.py", "commands/compare.py"),
        *("sweep/results/command.py", "commands/report.py"),
    ),
    "words and lines": ("base/loggers.py", "base/io/log.py"),
    "importer": ("data/robot_model.py", "commands/import_robot.py"),
    "script, page": ("assets/objects/build_objects.py", "assets/SOURCES.md"),
}
RUN_BY = {
    "airo-models": "airo_models", "libigl": "igl", "pytorch-kinematics": "pytorch_kinematics", "scikit-learn": "sklearn",
    "mujoco-warp": "mujoco_warp", "warp-lang": "warp",
}  # fmt: skip
"""Package of `PACKAGES` -> the module by which it is imported, where the names differ."""
DECIDES_NOTHING = {
    **dict.fromkeys(("manifold3d", "coacd"), "the digest of the objects has what it made"),
    **dict.fromkeys(("h5py", "yaml", "safetensors"), "reads files, whose digests are stored"),
    **dict.fromkeys(("jaxtyping", "pydantic", "pydantic_core", "tyro"), "says which values are allowed"),
    **dict.fromkeys(("pandas", "rich"), "shows values"),
    "gymnasium": "names of spaces",
    "stable_baselines3": "hands episodes to a learner",
    "threadpoolctl": "how many threads there are", "triton": "is imported before MuJoCo",
}  # fmt: skip
READERS = ("report", "view", "commands", "sweep.results", "sweep.study")
"""Rooms that no module that decides rows may need, but for the imports that `NOT_FOLLOWED` names."""


def package_at(folder: Path) -> list[Path]:
    """The package's folders, its files as links that a test may replace."""
    root = Path(r2h_batch.__file__).resolve().parent.parent
    for name in ("r2h_batch", "kernels", "assets"):
        shutil.copytree(
            root / name, folder / name, copy_function=os.symlink, ignore=shutil.ignore_patterns("__pycache__")
        )
    return [folder / "r2h_batch", folder]


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A copy of the package, whose digest is asked for."""
    monkeypatch.setattr(provenance, "FOLDERS", package_at(tmp_path))
    provenance.code_parts.cache_clear()
    yield tmp_path
    provenance.code_parts.cache_clear()


def change(tree: Path, name: str) -> None:
    file = tree / name if name.startswith(("kernels/", "assets/")) else tree / "r2h_batch" / name
    text = file.read_bytes()
    file.unlink()
    file.write_bytes(text + b"\n# a comment\n")
    provenance.code_parts.cache_clear()


@pytest.mark.parametrize("kind", DECIDE)
def test_a_file_that_decides_rows_is_another_code_and_its_room_is_named(tree, kind):
    for name in each(DECIDE[kind]):
        before, parts = provenance.code_digest(), provenance.code_parts()
        change(tree, name)
        assert provenance.code_digest() != before, name
        room = name.partition("/")[0]
        assert [k for k, v in provenance.code_parts().items() if v != parts[k]] == [room]
        old, new = ({"digests": {"code": d}, "code_parts": p}
                    for d, p in ((before, parts), (provenance.code_digest(), provenance.code_parts())))  # fmt: skip
        assert differing(old, new) == [f"digests (code in {room})"]
        assert differing({**old, "code_parts": {}}, new) == ["digests (code)"]  # a run of an older version


@pytest.mark.parametrize("kind", READ)
def test_a_file_that_decides_no_row_is_the_same_code(tree, kind):
    before = provenance.code_digest()
    for name in each(READ[kind]):
        change(tree, name)
        assert provenance.code_digest() == before, name


def test_new_files_count_where_something_that_decides_rows_needs_them(tree):
    before = provenance.code_digest()
    (tree / "assets" / "a.pyc").write_bytes(b"no source")
    (tree / "kernels" / "b.py").write_bytes(b"nobody imports it")
    (tree / "r2h_batch" / "report" / "c.json").write_bytes(b"{}")
    provenance.code_parts.cache_clear()
    assert provenance.code_digest() == before
    seen = {before}
    for name in (
        "assets/objects/new.npz",
        "kernels/native/new.h",
        "r2h_batch/methods/new.py",
        "r2h_batch/judge/new.json",
    ):
        (tree / name).write_bytes(b"")
        provenance.code_parts.cache_clear()
        assert provenance.code_digest() not in seen, name
        seen.add(provenance.code_digest())
    file = tree / "r2h_batch" / "methods" / "new.py"
    file.write_text("def predict(trials, scene):\n    from r2h_batch.report.few import k\n")
    (tree / "r2h_batch" / "report" / "few.py").write_text("k = 1\n")
    provenance.code_parts.cache_clear()
    seen.add(provenance.code_digest())
    change(tree, "report/few.py")  # it lies among what reads rows, and a method needs it
    assert provenance.code_digest() not in seen


def test_all_of_what_the_judge_is_made_of_decides_rows():
    decides = provenance.deciding_files()
    for room in each(("trials/draw", "methods", "observe", "closed_loop", "judge/motion", "scene/families")):
        files = (provenance.ROOT / room).rglob("*.py")
        assert {f.relative_to(provenance.ROOT) for f in files} <= decides.keys(), room
    modules = [".".join(key.with_suffix("").parts) for key in decides if key.suffix == ".py"]
    for name in each(modules):
        assert not any(f"{name}.".startswith(f"{room}.") for room in READERS), name


def test_the_imports_that_are_not_followed_are_these():
    """Each is there, and needed. Whoever adds one says here why no row depends on what it imports."""
    assert provenance.NOT_FOLLOWED.keys() == {
        ("*", "base.command_line"), ("*", "base.io.log"), ("*", "base.loggers"), ("closed_loop.registered", "view.environment"),
        ("sweep.jobs", "report.trained"),
    }  # fmt: skip
    files = modules_of(provenance.FOLDERS)
    for importing, imported in each(provenance.NOT_FOLLOWED):
        others = files if importing == "*" else [f"{PACKAGE}.{importing}"]
        assert any(f"{PACKAGE}.{imported}" in imports_of(name, files) for name in others), (importing, imported)


def test_the_version_of_every_package_that_decides_rows_is_stored():
    modules = {RUN_BY.get(name, name.replace("-", "_")) for name in provenance.PACKAGES}
    for key, file in each(provenance.deciding_files().items()):
        for found in re.findall(
            r"^\s*(?:from|import)\s+(\w+)", file.read_text() if key.suffix == ".py" else "", re.MULTILINE
        ):
            known = found in sys.stdlib_module_names or found in modules or found in DECIDES_NOTHING or found == PACKAGE
            assert known or not find_spec(found), f"{key} imports {found}: name it in PACKAGES"
    assert {"airo-models", "libigl", "networkx"} <= provenance.versions().keys()
    assert provenance.versions()["libigl"] == version("libigl")


def test_a_sweep_goes_on_after_a_change_that_decides_nothing_and_is_refused_after_another(
    tree, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    line = [
        "--benchmark",
        "r2h-v0",
        "--method",
        "random",
        "--trials",
        "2",
        "--splits",
        "S0",
        "--execute.sim",
        "none",
        "--out",
        "run",
    ]
    assert sweep.main(line) == 0
    stored = sorted(p.name for p in (tmp_path / "run" / "shards" / "random").iterdir())
    for name in ("report/table.py", "view/mjcf.py", "sweep/command.py"):
        change(tree, name)
    assert sweep.main(line) == 0
    change(tree, "closed_loop/policies.py")
    change(tree, "kernels/native/lanes.h")
    capsys.readouterr()
    assert sweep.main(line) == 2
    said = capsys.readouterr().err
    assert "run: another run, which differs in digests (code in closed_loop and kernels); choose another --out" in said
    assert sorted(p.name for p in (tmp_path / "run" / "shards" / "random").iterdir()) == stored


def test_a_wheel_and_a_checkout_of_the_same_files_have_the_same_code_digest(tmp_path, monkeypatch):
    checkout = package_at(tmp_path)
    monkeypatch.setattr(provenance, "FOLDERS", checkout)
    provenance.code_parts.cache_clear()
    before = provenance.code_digest()
    for name in ("kernels", "assets"):
        (tmp_path / name).rename(tmp_path / "r2h_batch" / name)
    monkeypatch.setattr(provenance, "FOLDERS", checkout[:1])
    provenance.code_parts.cache_clear()
    assert provenance.code_digest() == before
    provenance.code_parts.cache_clear()


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
