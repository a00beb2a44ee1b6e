"""Versions, digest of the code and its data, commit and device that a figure was made with. For
run.json and bench."""

import hashlib
import io
import json
import os
import platform
import subprocess
from collections.abc import Iterable
from functools import lru_cache
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import cast

from r2h_batch.base.io.read import open_file
from r2h_batch.base.own_imports import PACKAGE, files_below, imported_by, is_package, modules_of
from r2h_batch.base.package import FOLDERS, ROOT, VERSION
from r2h_batch.base.registry import ENGINES

PACKAGES = sorted(
    {
        *("airo-models", "libigl", "networkx", "numpy", "onnxruntime", "pyarrow"),
        *("pytorch-kinematics", "scikit-learn", "scipy", "torch", "trimesh", "warp-lang"),
        *(package for engine in ENGINES for package in engine.packages),
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


ROOTS = (
    *("trials.draw", "trials.load"),  # which trials there are
    *("methods", "observe", "closed_loop"),  # who answers, what is seen, how the answer is played
    *("evaluate", "sweep.scoring"),  # the judge, and what hands it trials and stores its rows
)
"""Modules, and packages with all that lies in them, that decide rows: what they import decides them too."""

NOT_FOLLOWED = {
    ("*", "base.command_line"): "says what was wrong with a command line",
    ("*", "base.io.log"): "prints lines",
    ("*", "base.loggers"): "sends finished tables to experiment trackers",
    ("sweep.jobs", "report.trained"): "the word under which a method's TRAINED_ON is stored",
    ("closed_loop.registered", "view.environment"): "draws an episode",
}
"""(importing, imported) module ("*": any) -> why no row depends on the imported one there. Whatever else is imported counts."""

DATA = (".json", ".npy", ".npz", ".safetensors")


def code_digest() -> str:
    """sha256 over what decides rows: `deciding_files`, wherever they are installed.

    A comment in a chart must not make two runs incomparable, or a sweep that is half done impossible to go on with.
    """
    return hashlib.sha256(json.dumps(code_parts()).encode()).hexdigest()


@lru_cache(maxsize=1)
def code_parts() -> dict[str, str]:
    """Room of the package, or file beside the rooms -> sha256 over its files among `deciding_files`: what changed, where
    two digests of the code differ."""
    files, parts = deciding_files(), {}
    for name, keys in groupby(sorted(files), key=lambda key: key.parts[0]):
        parts[name] = file_digest(files[key] for key in keys)
    return parts


def deciding_files() -> dict[Path, Path]:
    """Place in the package -> file of all that decides rows: the modules on which the draw of trials, the methods,
    cameras, the closed loop and the evaluator depend (`ROOTS`), the data and native headers in their folders, and the
    committed assets. Not the scripts that build the assets, and not what only reads rows.
    """
    modules = modules_of(FOLDERS)
    not_followed = {
        (of if of == "*" else f"{PACKAGE}.{of}", f"{PACKAGE}.{name}") for of, name in NOT_FOLLOWED
    }
    roots = [f"{PACKAGE}.{root}" for root in ROOTS]
    found = imported_by(roots, modules, not_followed=not_followed)
    deciding = [modules[name] for name in found]
    packages = {file.parent for file in modules.values() if is_package(file)}
    rooms = {file.parent for file in deciding if is_package(file)}
    # kernels/ and assets/: in a wheel inside the package, in a checkout beside it
    for folder in (FOLDERS[0], *(f / name for f in FOLDERS[1:] for name in ("kernels", "assets"))):
        for path in files_below(folder, (*DATA, ".h")):
            room = next((p for p in path.parents if p in packages), None)
            if room in rooms or _key(path).parts[0] == "assets":
                deciding.append(path)
    return {_key(file): file for file in deciding}


def _key(file: Path) -> Path:
    """The place of a file in the package: the same in a checkout and in a wheel."""
    inside = FOLDERS[0] if file.is_relative_to(FOLDERS[0]) else FOLDERS[-1]
    return file.relative_to(inside)


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
