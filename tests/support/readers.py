"""Readers of meshes, HDF5 and Parquet files in this process: one of its own takes a CPU second to import them, for each file.

Tests of what such a process is for (`own_process`) have it: tests/scene/test_hostile_meshes.py,
tests/data/test_grasps_refused.py and tests/runs/test_hostile_folders.py.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Any, BinaryIO

import pytest

from r2h_batch.base.errors import FileError
from r2h_batch.base.io import child

READERS = {
    "r2h_batch.scene.mesh_import.file": "_child",
    "r2h_batch.data.hdf5": "_read",
    "r2h_batch.base.io.parquet": "_child",
    "r2h_batch.base.io.onnx": "_child",
}
"""Module -> what it gives to `answer_parent`."""
IN_PROCESS = True
_apart = child.read_in_child


def _read_here(module: str, file: BinaryIO, options: Mapping[str, Any], **how: Any) -> list[Any]:
    if not IN_PROCESS:
        return _apart(module, file, options, **how)
    data = file.read()
    try:
        return getattr(import_module(module), READERS[module])(data, {**options, "bytes": len(data)})
    except FileError:
        raise
    except Exception as error:
        raise FileError(f"cannot be read: {type(error).__name__}: {error}") from error


def read_in_this_process() -> None:
    """For all modules that are imported from now on."""
    child.read_in_child = _read_here


@pytest.fixture
def own_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readers have a process of their own, as users have it."""
    monkeypatch.setitem(globals(), "IN_PROCESS", False)
