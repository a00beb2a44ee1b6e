"""Versions, digest of the code and its data, commit and device that a figure was made with. For
run.json and bench."""

import hashlib
import io
import os
import platform
import subprocess
from collections.abc import Iterable
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import cast

from r2h_batch.base.io.read import open_file
from r2h_batch.base.package import FOLDERS, ROOT, VERSION
from r2h_batch.base.registry import ENGINES

PACKAGES = sorted(
    {
        *("numpy", "pyarrow", "pytorch-kinematics", "scikit-learn", "scipy", "torch", "trimesh"),
        *("warp-lang", *(package for engine in ENGINES for package in engine.packages)),
    }
)
"""Packages whose version can change a verdict or a time."""


def versions() -> dict[str, str]:
    """Name -> version of this package, of Python and of `PACKAGES` (`not installed` where it is
    not)."""
    found = {"r2h_batch": VERSION, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


ONLY_READ_ROWS = (
    *(
        "report",
        "view",
        "commands",
        "sweep/results",
        "sweep/study",
        "sweep/ls.py",
        "sweep/submission.py",
        "sweep/submission_judge.py",
        "closed_loop/transfer",
    ),
    *("base/loggers.py", "base/io/log.py", "base/command_line.py", "__main__.py"),
)
"""Folders and modules of the package that look at rows or at command lines: no row depends on
them."""

DATA = (".json", ".npy", ".npz", ".safetensors")


@lru_cache(maxsize=1)
def code_digest() -> str:
    """sha256 over what decides rows: the judging modules, the kernels, the committed data, wherever
    they are installed.

    Not over what only reads rows (`ONLY_READ_ROWS`), nor over the scripts that build the data: a
    comment in a chart must not make two runs incomparable, or a sweep that is half done impossible
    to go on with.
    """
    files = {p.relative_to(FOLDERS[0]): p for p in _sources(FOLDERS[0], (".py", *DATA))}
    for name, kinds in (("kernels", (".py", ".h")), ("assets", DATA)):
        # in a wheel inside the package, in a checkout beside it
        folder = next((f for f in FOLDERS if (f / name).is_dir()), None)
        files = {key: p for key, p in files.items() if key.parts[0] != name}
        if folder is not None:
            files |= {p.relative_to(folder): p for p in _sources(folder / name, kinds)}
    judging = (
        k
        for k in files
        if not any(map(k.is_relative_to, ONLY_READ_ROWS)) and k.name != "__main__.py"
    )
    return file_digest(files[key] for key in sorted(judging))


def _sources(folder: Path, kinds: tuple[str, ...]) -> Iterable[Path]:
    return (p for p in folder.rglob("*") if p.suffix in kinds and p.is_file())


MAX_BYTES = 1 << 42


def file_digest(paths: Iterable[Path]) -> str:
    """sha256 over the names and contents of files, in the order given."""
    digest = hashlib.sha256()
    for path in paths:
        with open_file(path, MAX_BYTES) as file:  # a user may name a pipe
            content = hashlib.file_digest(cast(io.BufferedReader, file), "sha256")
            digest.update(path.name.encode() + b"\0" + content.digest())
    return digest.hexdigest()


def git_commit() -> str | None:
    """Commit of the checkout that this package runs from, `-dirty` where files differ; None outside
    a checkout."""
    root = ROOT.parent
    if not (root / ".git").exists():
        return None
    describe = ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    command = ["git", "-C", str(root), *describe]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def device_name(device: str) -> str:
    """`cpu: MODEL, N cores` or `cuda: MODEL`."""
    if device != "cpu":
        import torch

        return f"cuda: {torch.cuda.get_device_name(device)}"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"cpu: {_cpu_model()}, {cores} cores"


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    except OSError:
        pass
    return platform.processor() or platform.machine()
