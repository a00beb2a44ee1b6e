"""Programs and packages that a test may miss on a machine, and how to get them: the one place that decides what is
skipped.

`@needs("chromium")` before a test, `pytestmark = needs("ray")` before a file. The `gpu` marker does the same for a GPU.
What was skipped is listed at the end of every run (tests/conftest.py).
"""

import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import NamedTuple

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Want(NamedTuple):
    """One thing that may be missing: what it is, how to get it, and whether it is here."""

    what: str
    how: str
    here: Callable[[], bool]


def _can_render() -> bool:
    import mujoco

    try:
        with mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8) as renderer:
            return renderer.render().shape == (8, 8, 3)
    except Exception:  # whatever the platform's OpenGL raises
        return False


def _sees_a_gpu() -> bool:
    import torch

    return torch.cuda.is_available()


def _can_unshare() -> bool:
    if not shutil.which("unshare"):
        return False
    return subprocess.run(["unshare", "-rn", "true"], capture_output=True, check=False).returncode == 0


def _has_latex() -> bool:
    """pdflatex with booktabs and siunitx: a small TeX Live has the first alone."""
    if not (shutil.which("pdflatex") and shutil.which("kpsewhich")):
        return False
    styles = ["kpsewhich", "booktabs.sty", "siunitx.sty", "graphicx.sty"]
    return subprocess.run(styles, capture_output=True, check=False).stdout.count(b"\n") == 3


def _module(name: str, extra: str) -> Want:
    return Want(
        f"the package {name}", f"pip install -e '.[{extra}]', as `make test` does", lambda: bool(find_spec(name))
    )


WANTS = {
    "chromium": Want("a browser", "install chromium (Debian: apt-get install chromium)", lambda: CHROMIUM is not None),
    "gl": Want(
        "a GL library that draws without a screen",
        "install OSMesa or EGL (Debian: apt-get install libosmesa6 libegl1) and set MUJOCO_GL=osmesa or egl",
        _can_render,
    ),
    "latex": Want(
        "LaTeX with siunitx",
        "install TeX Live (Debian: apt-get install texlive-latex-recommended texlive-science)",
        _has_latex,
    ),
    "gpu": Want("a GPU", "a machine with an NVIDIA GPU and its driver, and `python -m pytest -m gpu`", _sees_a_gpu),
    "ptxas": Want(
        "NVIDIA's assembler",
        "pip install --no-deps --target DIR nvidia-cuda-nvcc, and DIR/nvidia/cu13/bin on PATH",
        lambda: shutil.which("ptxas") is not None,
    ),
    "compiler": Want(
        "a C++ compiler",
        "install g++ or clang++ (Debian: apt-get install g++)",
        lambda: bool(shutil.which("g++") or shutil.which("clang++")),
    ),
    "clang-format": Want("clang-format", "pip install clang-format", lambda: shutil.which("clang-format") is not None),
    "datasets": _module("datasets", "test"),
    "h5py": _module("h5py", "import"),
    "onnxruntime": _module("onnxruntime", "onnx"),
    "unshare": Want(
        "a way to cut the network off", "Linux with util-linux's unshare and user namespaces", _can_unshare
    ),
    "ray": _module("ray", "ray"),
    "mkdocs": _module("mkdocs", "docs"),
    "rtree": _module("rtree", "test"),
    "importlinter": _module("importlinter", "test"),
    "setuptools": _module("setuptools", "test"),
    "tensorboard": _module("tensorboard", "tensorboard"),
    "viser": _module("viser", "view"),
    "pandas": _module("pandas", "pandas"),
    "coacd": _module("coacd", "build"),
    "ur_analytic_ik": Want(
        "the package ur-analytic-ik",
        "its wheels end at Python 3.11; on later ones it is built from source, which downloads Eigen: pip install ur-analytic-ik",
        lambda: bool(find_spec("ur_analytic_ik")),
    ),
}


@cache
def is_here(name: str) -> bool:
    """Whether one of WANTS is on this machine; asked once."""
    return WANTS[name].here()


def reason(name: str) -> str:
    """A line of the summary: the missing thing and how to get it."""
    return f"{WANTS[name].what}: {WANTS[name].how}"


def needs(*names: str) -> pytest.MarkDecorator:
    """A marker that skips where one of the named things is missing. Names: the keys of WANTS."""
    missing = [name for name in names if not is_here(name)]
    return pytest.mark.skipif(bool(missing), reason="; ".join(map(reason, missing)))
