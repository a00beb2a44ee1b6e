"""Every kernel module compiles for a GPU without one being here (NVRTC, sm_90)."""

from importlib import import_module
from pathlib import Path

import gpu_build
import pytest
import warp as wp
from needs import needs

from r2h_batch.base.launch import init_warp

PACKAGE = "r2h_batch.kernels."
MODULES = gpu_build.kernel_modules()


def compiled(name: str, folder: Path) -> Path:
    init_warp()
    wp.compile_aot_module(import_module(PACKAGE + name), arch=90, module_dir=str(folder), use_ptx=False)
    (code,) = folder.glob("*.cubin")
    return code


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_a_module_compiles_for_sm_90(name: str, tmp_path: Path) -> None:
    assert compiled(name, tmp_path).stat().st_size > 10_000


@needs("ptxas")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["plan.rrt", "plan.shortcut", "judge.goal"])
def test_kernels_of_one_thread_a_trial_that_a_gpu_runs_spill_less_than_a_kilobyte(name: str) -> None:
    ptxas = gpu_build.find_ptxas()
    assert ptxas is not None
    init_warp()
    for kernel in gpu_build.build(import_module(PACKAGE + name), ptxas):
        assert kernel.spill_store_bytes < 1024 and kernel.spill_load_bytes < 1024, kernel
