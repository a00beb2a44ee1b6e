"""How Warp compiles the kernels: the options that each file with kernels or their functions sets."""

from pathlib import Path

import warp as wp


def _header(name: str) -> str:
    return (Path(__file__).parent / "native" / name).read_text(encoding="utf-8")


_NATIVE = _header("lanes.h")

OPTIONS = {
    "enable_backward": False,
    "fuse_fp": False,
    "extra_build_options": wp.ModuleBuildOptions(extra_cpu_preamble=_NATIVE, extra_cuda_preamble=_NATIVE),
}
"""The C++ functions of native/lanes.h stand before each module's generated code. Their text is part of the key under which Warp
stores a compiled module, so an edit of the header compiles all modules again. (An include directory would put the path of this
checkout into the key.)

`fuse_fp` off: every product is rounded before it is added, on a CPU as on CUDA, and angles go through geometry/angles.py. So
what decides verdicts has the same float32 bits on both (CONTRIBUTING.md has the evidence). It costs nothing on a CPU. `methods/`,
`receiver/close_hand.py` and `receiver/point_mesh.py` leave it on: the evaluator judges what they find like any other input."""


def with_header(name: str) -> dict:
    """OPTIONS for a file that also calls the C++ functions of native/NAME."""
    both = _NATIVE + _header(name)
    return OPTIONS | {"extra_build_options": wp.ModuleBuildOptions(extra_cpu_preamble=both, extra_cuda_preamble=both)}


@wp.func_native("return r2h::opaque(i);")
def opaque(i: int) -> int:
    """The same number, computed anew on CUDA: addresses that depend on it do not stay in registers throughout a loop."""
    ...


@wp.func_native("return r2h::on_cuda();")
def on_cuda() -> int:
    """1 in code for CUDA, 0 in code for a CPU; a compiler drops the branch that it does not need."""
    ...
