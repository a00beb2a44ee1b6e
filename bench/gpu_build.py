"""Every kernel as a GPU would get it, without a GPU: CPU seconds to compile, registers, stack, spills (sm_90).

python bench/gpu_build.py [--modules plan.rrt judge.safe ...] [--ptxas FILE] [--json FILE]

A module is compiled as a first launch on a GPU does: Warp's C++ to PTX (NVRTC, which is part of Warp), PTX to machine code
(ptxas). cpu_s is process time of both, of one process, with one module after the other; no kernel cache is used.
ptxas is `--ptxas` or on PATH (package nvidia-cuda-nvcc, as new as Warp's NVRTC or newer).

stack_bytes: of one thread, calls included. spill_*_bytes: stores and loads of registers that did not fit, of the kernel and
of all functions that its module keeps out of line, as they are compiled for this kernel (ptxas makes a copy for each).
"""

import argparse
import pkgutil
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

import warp as wp
from _report import Report
from run import Bench

import r2h_batch.kernels
from r2h_batch.base.launch import init_warp

ARCH = 90
PACKAGE = "r2h_batch.kernels."
FORWARD = "_cuda_kernel_forward"
ENTRY = re.compile(r"Compiling entry function '(\w+?)_[0-9a-f]{8}_cuda_kernel_forward'")
PROPERTIES = re.compile(
    r"Function properties for (\S+)\s+(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes"
)
USED = re.compile(r"Used (\d+) registers")
WITH_CALLS = re.compile(r"(\d+) bytes cumulative stack size")


@dataclass(frozen=True)
class Kernel:
    """Figures that ptxas prints for one kernel."""

    name: str
    registers: int
    stack_bytes: int
    spill_store_bytes: int
    spill_load_bytes: int


@dataclass(frozen=True)
class Build:
    """One module compiled; `cpu_s` of NVRTC and of ptxas together."""

    module: str
    cpu_s: float
    nvrtc_s: float
    kernels: tuple[Kernel, ...]


def kernel_modules() -> list[str]:
    """Names of the modules under kernels/ that have kernels, without the package; the others hold functions only."""
    names = [m.name for m in pkgutil.walk_packages(r2h_batch.kernels.__path__, PACKAGE) if not m.ispkg]
    return [name.removeprefix(PACKAGE) for name in names if has_kernels(import_module(name))]


def has_kernels(module: ModuleType) -> bool:
    return any(isinstance(v, wp.Kernel) and v.module.name == module.__name__ for v in vars(module).values())


def find_ptxas(given: Path | None = None) -> Path | None:
    """ptxas as given, or on PATH."""
    found = given or shutil.which("ptxas")
    return Path(found) if found else None


def build(module: ModuleType, ptxas: Path) -> Build:
    """The module compiled for sm_90. Raises RuntimeError with what ptxas said."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        wp.compile_aot_module(module, arch=ARCH, module_dir=folder, use_ptx=True)
        nvrtc_s = time.process_time() - start
        (source,) = Path(folder).glob("*.ptx")
        source.write_bytes(source.read_bytes().rstrip(b"\0"))  # NVRTC ends it with a zero, which ptxas takes for text
        cubin = Path(folder) / "code"
        before = children_s()
        line = [str(x) for x in (ptxas, "-v", f"-arch=sm_{ARCH}", "-o", cubin, source)]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{ptxas}: {(done.stderr or done.stdout).strip().splitlines()[0]}")
        ptxas_s = children_s() - before
    kernels = tuple(read_kernels(done.stdout + done.stderr))
    name = module.__name__.removeprefix(PACKAGE)
    return Build(name, nvrtc_s + ptxas_s, nvrtc_s, kernels)


def children_s() -> float:
    """Process time of the programs that this one has waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def read_kernels(said: str) -> list[Kernel]:
    """The kernels in what `ptxas -v` printed."""
    entries = list(ENTRY.finditer(said))
    before_all = spills(said[: entries[0].start()] if entries else said)
    found = []
    for at, entry in enumerate(entries):
        block = said[entry.end() : entries[at + 1].start() if at + 1 < len(entries) else len(said)]
        of_block = spills(block)
        symbol = next(name for name in of_block if name.startswith(entry[1]) and name.endswith(FORWARD))
        used, with_calls = USED.search(block), WITH_CALLS.search(block)
        if used is None:
            raise RuntimeError(f"ptxas says nothing of the registers of {entry[1]}")
        frame = of_block[symbol][0]
        stores, loads = (sum(p[i] for p in (before_all | of_block).values()) for i in (1, 2))
        stack = int(with_calls[1]) if with_calls else frame
        found.append(Kernel(entry[1], int(used[1]), stack, stores, loads))
    return found


def spills(said: str) -> dict[str, tuple[int, int, int]]:
    """Stack frame, spill stores and spill loads (bytes) by symbol, as `ptxas -v` printed them."""
    return {m[1]: (int(m[2]), int(m[3]), int(m[4])) for m in PROPERTIES.finditer(said)}


def report_all(builds: Sequence[Build], report: Report) -> None:
    """The figures of all modules together, then those of each module and kernel."""
    for b in builds:
        for k in b.kernels:
            for what, value in list(asdict(k).items())[1:]:
                report.add(f"gpu_build.{b.module}.{k.name}.{what}", value)
    report.add("gpu_build.modules", len(builds))
    report.add("gpu_build.kernels", sum(len(b.kernels) for b in builds))
    report.add("gpu_build.cpu_s_total", sum(b.cpu_s for b in builds))
    report.add("gpu_build.cpu_s_max", max(b.cpu_s for b in builds))
    report.add("gpu_build.cpu_s_max_module", max(builds, key=lambda b: b.cpu_s).module)


def run(options: argparse.Namespace, report: Report) -> None:
    """Compiles the modules and reports each kernel."""
    ptxas, known = find_ptxas(options.ptxas), kernel_modules()
    if ptxas is None:
        sys.exit("no ptxas here: pip install --no-deps nvidia-cuda-nvcc, or give --ptxas FILE")
    if unknown := sorted(set(options.modules or ()) - set(known)):
        sys.exit(f"no module with kernels is called {', '.join(unknown)}; there are {', '.join(known)}")
    init_warp()
    builds = []
    for name in options.modules or known:
        built = build(import_module(PACKAGE + name), ptxas)
        builds.append(built)
        report.add(f"gpu_build.{name}.cpu_s", built.cpu_s)
    report_all(builds, report)


BENCH = Bench(
    __doc__,
    run,
    flags={
        "--modules": {"nargs": "+", "metavar": "NAME", "help": "only these (plan.rrt); all without"},
        "--ptxas": {"type": Path, "metavar": "FILE", "help": "the assembler; looked for without"},
    },
)

if __name__ == "__main__":
    BENCH.main()
