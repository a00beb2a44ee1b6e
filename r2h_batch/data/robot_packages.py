"""Robots' files of installed packages: those among a distribution's files, and those whose paths a module tells,
as robot_descriptions does."""

import json
import os
import subprocess
import sys
from difflib import get_close_matches
from importlib import metadata
from importlib.machinery import PathFinder
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from r2h_batch.base.errors import FileError, UsageError
from r2h_batch.base.io.read import printable

SUFFIXES = (".urdf", ".xml")
MOST_SECONDS = 60
SHOWN = 8
"""Names in a message."""
_TELL = """
import importlib, json, sys
m = importlib.import_module(sys.argv[1])
print(json.dumps([getattr(m, k, None) for k in ("URDF_PATH", "MJCF_PATH", "PACKAGE_PATH")]))
"""


class Packaged(NamedTuple):
    """A robot's file, and the folder of its package: what it names lies there."""

    file: Path
    folder: Path


def file_from(source: str) -> Packaged:
    """The URDF or MJCF that `PACKAGE:NAME` means.

    NAME is a module of PACKAGE that has URDF_PATH or MJCF_PATH (`robot_descriptions:panda_description`), or how the path
    of one of the package's files ends (`example-robot-data:tiago.urdf`). Nothing is downloaded: the module runs in a
    process whose git reaches no other machine.

    Raises:
        UsageError: it is not written like that.
        FileError: no package, or no file, of this name is installed, or several files end so.
    """
    package, _, name = source.partition(":")
    if not (package and name):
        raise UsageError(
            f"--from {printable(source)[:80]}: write PACKAGE:NAME, such as example-robot-data:tiago.urdf"
        )
    module = _module(package, name)
    if module:
        return _told(module, source)
    try:
        files = metadata.distribution(package).files or []
    except (metadata.PackageNotFoundError, ValueError):
        how = f"install it in this environment: pip install --no-deps {printable(package)[:60]}"
        raise FileError(f"--from {printable(source)[:80]}: no such package here; {how}") from None
    robots = [f for f in files if f.suffix.lower() in SUFFIXES]
    wanted = PurePosixPath(name).parts
    found = [f for f in robots if _ends(f, wanted)]
    if len(found) == 1:
        return _packaged(found[0])
    if found:
        words = ", ".join(str(f) for f in found[:SHOWN])
        raise FileError(
            f"--from {printable(source)[:80]}: {len(found)} files end so; give more of the path: {printable(words)}"
        )
    near = get_close_matches(PurePosixPath(name).stem, {f.stem for f in robots}, SHOWN, 0.3)
    words = ", ".join(near or sorted({f.stem for f in robots})[:SHOWN]) or "none"
    raise FileError(
        f"--from {printable(source)[:80]}: the package has no file that ends so; of its {len(robots)} .urdf and .xml: {words}"
    )


def _packaged(file: metadata.PackagePath) -> Packaged:
    """Where a distribution's file is. A wheel's data lie beside its packages, as ../../../share/NAME/...; `pip install
    --target` puts them into the folder of the packages, and lists them as if it had not."""
    inside = tuple(part for part in file.parts if part != "..")
    place, beside = Path(str(file.locate())), len(inside) < len(file.parts)
    if beside and not place.is_file():
        place = Path(str(file.locate()).split("..", 1)[0], *inside)
    up = len(inside) - (3 if beside else 2)
    return Packaged(place, place.parents[max(up, 0)])


def _ends(file: PurePosixPath, wanted: tuple[str, ...]) -> bool:
    return wanted in (file.parts[-len(wanted) :], file.with_suffix("").parts[-len(wanted) :])


def _module(package: str, name: str) -> str:
    """The dotted name of a package's module of this name, or of NAME_description; "": it has none. Nothing runs."""
    if not (package.isidentifier() and name.isidentifier()):
        return ""
    spec = PathFinder.find_spec(package)
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        for stem in (name, f"{name}_description"):
            if (Path(folder) / f"{stem}.py").is_file():
                return f"{package}.{stem}"
    return ""


def _told(module: str, source: str) -> Packaged:
    """The file that a module tells."""
    shown = f"--from {printable(source)[:80]}"
    paths, folder = _paths_of(module, shown)
    found = [path for path in paths if isinstance(path, str)]
    if not found:
        raise FileError(f"{shown}: {module} has neither URDF_PATH nor MJCF_PATH")
    file = Path(found[0])
    return Packaged(file, Path(folder) if isinstance(folder, str) else file.parent)


def _paths_of(module: str, shown: str) -> tuple[list[Any], Any]:
    """URDF_PATH and MJCF_PATH of a module, and its PACKAGE_PATH; None: it has none. It runs in a process of its own."""
    line = [sys.executable, "-c", _TELL, module]
    env = {**os.environ, "GIT_ALLOW_PROTOCOL": "none", "PYTHONPATH": os.pathsep.join(sys.path)}
    try:
        done = subprocess.run(
            line, capture_output=True, text=True, check=False, env=env, timeout=MOST_SECONDS
        )
        *paths, folder = json.loads(done.stdout.strip().splitlines()[-1])
    except (subprocess.TimeoutExpired, ValueError, IndexError):
        how = f"fetch them first: python -c 'import {module}'"
        raise FileError(
            f"{shown}: its files are not here, and nothing is downloaded; {how}"
        ) from None
    return paths, folder
