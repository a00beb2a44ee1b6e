"""Whose answers a run folder holds: the files that decide a user's method, and what happens once one changes."""

import sys

import pytest
from fake_bench import set_up as set_up_fake

from r2h_batch.base.user_code import user_files
from r2h_batch.runs.store import load_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs

METHOD = """
import importlib
import torch
from id_package.net import SCALE
METHOD_FILES = ("weights.bin", "data")

def predict(trials, scene, *, seed, table=""):
    import id_later
    T = SCALE * torch.eye(4).repeat(len(trials), 1, 1)
    return T, T

def secretive(trials, scene, *, seed):
    importlib.import_module("id_secret")
    return predict(trials, scene, seed=seed)
"""
FILES = {
    "id_method.py": METHOD,
    "id_package/__init__.py": "",
    "id_package/net.py": "from . import layers\nfrom .layers import *\nSCALE = 1.0\n",
    "id_package/layers.py": "import numpy\nimport json\n",
    "id_package/unused.py": "",
    "id_later.py": "import id_package.layers\n",
    "id_secret.py": "",
    "weights.bin": "1",
    "data/a.txt": "1",
    "table.csv": "1",
}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A user's files, which each call of `sweep` imports anew."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(jobs, "set_up", set_up_fake)
    yield tmp_path
    forget()


def forget():
    for name in [n for n in sys.modules if n.startswith("id_")]:
        del sys.modules[name]


def run(method="id_method:predict,table=table.csv"):
    forget()
    return sweep.main(["--benchmark", "r2h-v1", "--method", method, "--trials", "3", "--out", "run"])


def test_a_method_is_its_module_what_that_imports_and_the_files_that_it_names(place):
    import id_method  # noqa: F401

    names = {"id_method", "id_package", "id_package.net", "id_package.layers", "id_later", "weights.bin", "data/a.txt"}
    found = user_files(["id_method", "r2h_batch.methods.random"])
    assert set(found) == names and found["id_later"] == place / "id_later.py"
    assert "id_later" not in sys.modules  # it was looked up, not imported


@pytest.mark.parametrize("changed", ["id_package/layers.py", "id_later.py", "data/a.txt", "table.csv"])
def test_a_resume_after_a_change_of_any_of_them_is_refused_by_the_name_of_the_file_before_a_scene_is_prepared(
    place, capsys, changed, monkeypatch
):
    assert run() == 0
    (place / changed).write_text("# other\n")
    capsys.readouterr()
    with monkeypatch.context() as nothing_slow:
        nothing_slow.setattr(jobs, "set_up", None)
        assert run() == 2
    name = changed.removesuffix(".py").replace("/", ".") if changed.endswith(".py") else changed
    said = f"already holds 'id_method:predict (table=table.csv)', and {name} changed since; add --overwrite"
    assert said in capsys.readouterr().err
    (place / changed).write_text(FILES[changed])
    assert run() == 0
    assert len(load_run(place / "run").methods) == 1
