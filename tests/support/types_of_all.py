"""Type checks of the package as a wheel has it (kernels and assets inside), of bench and of examples: `make lint`.

In the tree kernels/ and assets/ stand beside the package, so mypy on the tree finds none of the modules that the package
imports as `r2h_batch.kernels` and believes whatever is asked of them. Links in build/types put them in their places.
"""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CACHE = ROOT / ".mypy_cache/all"
"""Entries hold for a file's content, wherever it stands: the test of the wheel uses them too. A folder of its own, because
what mypy once stored of the tree, where no kernel was found, would be believed here."""


def assemble(folder: Path) -> Path:
    """`folder` with a package r2h_batch made of links to the tree."""
    package = folder / "r2h_batch"
    package.mkdir(parents=True, exist_ok=True)
    wanted = {path.name: path for path in (ROOT / "r2h_batch").iterdir() if path.name != "__pycache__"}
    wanted |= {name: ROOT / name for name in ("kernels", "assets")}
    for link in package.iterdir():
        if link.name not in wanted or link.readlink() != wanted[link.name]:
            link.unlink()
    for name, path in wanted.items():
        if not (package / name).is_symlink():
            (package / name).symlink_to(path)
    return folder


def check(above: Path, *others: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """mypy's answer on the package r2h_batch in the folder `above` and on `others`, with the options of pyproject.toml."""
    config = ("--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", str(CACHE))
    support = (str(above), *(str(ROOT / name) for name in ("bench", "examples", "tests/support")))
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"MYPYPATH": os.pathsep.join(support)}
    command = [sys.executable, "-m", "mypy", *config, str(above / "r2h_batch"), *others]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


if __name__ == "__main__":
    done = check(assemble(ROOT / "build/types"), "bench", "examples", cwd=ROOT)
    print(done.stdout + done.stderr, end="")
    sys.exit(done.returncode)
