"""Every kernel module compiles for a GPU without one being here (NVRTC, sm_90); rrt takes minutes: its kernels hold the
whole collision check."""

import pkgutil
from importlib import import_module
from pathlib import Path

import pytest
import warp as wp

import r2h_batch.kernels
from r2h_batch.launch import init_warp

PACKAGE = "r2h_batch.kernels."
MODULES = [m.name for m in pkgutil.walk_packages(r2h_batch.kernels.__path__, PACKAGE) if not m.ispkg]


def has_kernels(name: str) -> bool:
    """Whether there is anything to compile: some modules only hold functions for others."""
    return any(isinstance(v, wp.Kernel) and v.module.name == name for v in vars(import_module(name)).values())


def test_the_modules_of_all_folders_are_found() -> None:
    assert len(MODULES) >= 35
    assert sum(has_kernels(name) for name in MODULES) >= 20


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES, ids=lambda name: name.removeprefix(PACKAGE))
def test_a_module_compiles_for_sm_90(name: str, tmp_path: Path) -> None:
    init_warp()
    if not has_kernels(name):
        pytest.skip("functions only")
    wp.compile_aot_module(import_module(name), arch=90, module_dir=str(tmp_path))
    (code,) = tmp_path.glob("*.cubin")
    assert code.stat().st_size > 10_000
