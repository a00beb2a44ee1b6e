"""Every kernel module compiles for a GPU without one being here (NVRTC, sm_90); rrt takes minutes: its kernels hold the
whole collision check."""

from importlib import import_module, resources
from pathlib import Path

import pytest
import warp as wp

from r2h_batch.launch import init_warp

MODULES = sorted(
    f.name[:-3]
    for f in resources.files("r2h_batch.kernels").iterdir()
    if f.name.endswith(".py") and f.name != "__init__.py"
)


def has_kernels(name: str) -> bool:
    """Whether there is anything to compile: some modules only hold functions for others."""
    return any(isinstance(v, wp.Kernel) for v in vars(import_module(f"r2h_batch.kernels.{name}")).values())


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_a_module_compiles_for_sm_90(name: str, tmp_path: Path) -> None:
    init_warp()
    if not has_kernels(name):
        pytest.skip("functions only")
    wp.compile_aot_module(import_module(f"r2h_batch.kernels.{name}"), arch=90, module_dir=str(tmp_path))
    (code,) = tmp_path.glob("*.cubin")
    assert code.stat().st_size > 10_000
