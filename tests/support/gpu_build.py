"""Every kernel as a GPU would get it, without a GPU: registers, stack, spills (sm_90).

A module is compiled as a first launch on a GPU does: Warp's C++ to PTX (NVRTC, which is part of Warp), PTX to machine code
(ptxas, of the package nvidia-cuda-nvcc, as new as Warp's NVRTC or newer).

stack_bytes: of one thread, calls included. spill_*_bytes: stores and loads of registers that did not fit, of the kernel and
of all functions that its module keeps out of line, as they are compiled for this kernel (ptxas makes a copy for each).
"""

import pkgutil
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

import warp as wp

import r2h_batch.kernels

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


def kernel_modules() -> list[str]:
    """Names of the modules under kernels/ that have kernels, without the package; the others hold functions only."""
    names = [m.name for m in pkgutil.walk_packages(r2h_batch.kernels.__path__, PACKAGE) if not m.ispkg]
    return [name.removeprefix(PACKAGE) for name in names if has_kernels(import_module(name))]


def has_kernels(module: ModuleType) -> bool:
    return any(isinstance(v, wp.Kernel) and v.module.name == module.__name__ for v in vars(module).values())


def find_ptxas() -> Path | None:
    """ptxas on PATH."""
    found = shutil.which("ptxas")
    return Path(found) if found else None


def build(module: ModuleType, ptxas: Path) -> list[Kernel]:
    """The module compiled for sm_90. Raises RuntimeError with what ptxas said."""
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(module, arch=ARCH, module_dir=folder, use_ptx=True)
        (source,) = Path(folder).glob("*.ptx")
        source.write_bytes(source.read_bytes().rstrip(b"\0"))  # NVRTC ends it with a zero, which ptxas takes for text
        cubin = Path(folder) / "code"
        line = [str(x) for x in (ptxas, "-v", f"-arch=sm_{ARCH}", "-o", cubin, source)]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{ptxas}: {(done.stderr or done.stdout).strip().splitlines()[0]}")
    return read_kernels(done.stdout + done.stderr)


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
