"""Every kernel module compiles for a GPU without one being here (NVRTC, sm_90), and the bench of that reads it right."""

import pkgutil
import re
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import r2h_batch.kernels
from r2h_batch.launch import init_warp

sys.path.append(str(Path(__file__).resolve().parents[2] / "bench"))

import _lanes
import gpu_build
from needs import needs

PACKAGE = "r2h_batch.kernels."
MODULES = gpu_build.kernel_modules()


def test_the_modules_of_all_folders_are_found() -> None:
    every = [m.name for m in pkgutil.walk_packages(r2h_batch.kernels.__path__, PACKAGE) if not m.ispkg]
    assert len(every) >= 35 and 20 <= len(MODULES) < len(every)


def compiled(name: str, folder: Path, *, ptx: bool) -> Path:
    init_warp()
    wp.compile_aot_module(import_module(PACKAGE + name), arch=90, module_dir=str(folder), use_ptx=ptx)
    (code,) = folder.glob("*.ptx" if ptx else "*.cubin")
    return code


def test_code_sizes_are_those_of_the_machine_code(tmp_path: Path) -> None:
    code = compiled("methods.approach_hit", tmp_path, ptx=False).read_bytes()
    sizes = gpu_build.code_sizes(code)
    (name,) = (n for n in sizes if n.endswith("_cuda_kernel_forward"))
    assert 128 <= sizes[name] < len(code) and sizes[name] % 128 == 0


SAID = """
ptxas info    : Function properties for gjk_0
    64 bytes stack frame, 8 bytes spill stores, 12 bytes spill loads
ptxas info    : Compiling entry function 'a_b_0123abcd_cuda_kernel_forward' for 'sm_90'
ptxas info    : Function properties for a_b_0123abcd_cuda_kernel_forward
    3744 bytes stack frame, 1456 bytes spill stores, 1596 bytes spill loads
ptxas info    : Used 255 registers, used 0 barriers, 4000 bytes cumulative stack size, 1024 bytes smem
ptxas info    : Compiling entry function 'c_89abcdef_cuda_kernel_forward' for 'sm_90'
ptxas info    : Function properties for c_89abcdef_cuda_kernel_forward
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Function properties for support_0
    0 bytes stack frame, 16 bytes spill stores, 20 bytes spill loads
ptxas info    : Used 32 registers, used 0 barriers
"""


def test_what_ptxas_says_is_read_with_the_functions_that_stay_out_of_line() -> None:
    """Each kernel has its own copy of them, with spills of its own."""
    sizes = {"a_b_0123abcd_cuda_kernel_forward": 512, "c_89abcdef_cuda_kernel_forward": 256}
    assert gpu_build.read_kernels(SAID, sizes) == [
        gpu_build.Kernel("a_b", 255, 4000, 1464, 1608, 512),
        gpu_build.Kernel("c", 32, 0, 24, 32, 256),
    ]


def test_functions_are_out_of_line_on_cuda_only() -> None:
    init_warp()
    module = import_module(PACKAGE + "methods.antipodal")
    builder = wp._src.context.ModuleBuilder(  # private: Warp offers no way to the source without compiling it
        module.opposite_points.module, module.opposite_points.module.resolve_options(wp.config)
    )
    source = {device: builder.codegen(device) for device in ("cpu", "cuda")}
    assert all("WP_NOINLINE" in text for text in source.values())
    only_on_a_cpu = r"#define where where_by_branch\n#else\n(//.*\n)*#undef WP_NOINLINE\n#define WP_NOINLINE\n#endif\n"
    assert all(re.search(only_on_a_cpu, text) for text in source.values())


def registers(code: bytes) -> int:
    """The largest number of registers of a module's kernels: EIATTR_REGCOUNT in the section .nv.info of its machine code."""
    at = code.index(b"\x04\x2f\x08\x00")  # a number follows, REGCOUNT, 8 bytes: symbol, registers
    counts = []
    while at >= 0:
        counts.append(int.from_bytes(code[at + 8 : at + 12], "little"))
        at = code.find(b"\x04\x2f\x08\x00", at + 12)
    return max(counts)


def test_what_an_if_leaves_behind_is_not_kept_in_registers_around_a_loop(tmp_path: Path) -> None:
    """`where` is a branch on CUDA (kernels/options.py): as a select GJK of listed pairs had 239 registers."""
    assert 100 < registers(compiled("frontier.pairs", tmp_path, ptx=False).read_bytes()) < 200


def test_lanes_are_useful_while_the_slowest_of_their_warp_works() -> None:
    even, one, half = np.ones(64), np.eye(1, 32)[0], np.repeat([4.0, 0.0], 16)
    assert (_lanes.useful([even]), _lanes.useful([one]), _lanes.useful([half])) == (1.0, 1 / 32, 0.5)
    assert _lanes.useful([np.ones(8)]) == 0.25  # the last warp is not full
    assert _lanes.useful([even, one]) == pytest.approx((64 + 1) / (64 + 32))
    scattered = np.zeros(64)
    scattered[::4] = 5.0
    assert _lanes.useful([scattered]) == 0.25 and _lanes.useful([_lanes.packed(scattered)]) == 0.5
    assert _lanes.longest_us([even, 3 * one]) == 4.0


def test_every_planning_kernel_is_counted_row_by_row(capsys: pytest.CaptureFixture[str]) -> None:
    assert gpu_build.main(["--lanes", "16"]) == 0
    lines = dict(line.split() for line in capsys.readouterr().out.splitlines())
    for kernel in ("check_postures", "straight_lines", "rrt_connect", "path_clearance", "safe_distance"):
        share = float(lines[f"gpu_build.useful_lanes.{kernel}"])
        assert float(lines["gpu_build.useful_lanes_min"]) <= share <= 1.0
        assert 0.0 < float(lines[f"gpu_build.longest_chain_us.{kernel}"]) <= float(lines["gpu_build.longest_chain"])


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_a_module_compiles_for_sm_90(name: str, tmp_path: Path) -> None:
    assert compiled(name, tmp_path, ptx=False).stat().st_size > 10_000


@needs("ptxas")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["plan.rrt", "plan.shortcut", "judge.goal"])
def test_kernels_of_one_thread_a_trial_that_a_gpu_runs_spill_less_than_a_kilobyte(name: str) -> None:
    ptxas = gpu_build.find_ptxas()
    assert ptxas is not None
    init_warp()
    for kernel in gpu_build.build(import_module(PACKAGE + name), ptxas).kernels:
        assert kernel.spill_store_bytes < 1024 and kernel.spill_load_bytes < 1024, kernel
