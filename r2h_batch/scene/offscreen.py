"""Pictures without a screen: which OpenGL works here is found out, not asked for.

MuJoCo reads MUJOCO_GL when it is imported and a library that fails may end the process, so each is
tried in a process of its own, once. EGL first where there is a GPU, OSMesa first where there is
none (half the time of EGL's software).
"""

import os
import subprocess
import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from r2h_batch.base.errors import MachineError

BACKENDS = ("egl", "osmesa", "glfw")
INSTALL = "no OpenGL draws here; install one: Debian, Ubuntu: apt-get install libosmesa6 libegl1; conda: mesalib"
_TRY = (
    "import mujoco\n"
    "with mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8) as r:\n"
    "    assert r.render().shape == (8, 8, 3)\n"
    "print('drawn')\n"
)


class RenderError(MachineError):
    """Nothing draws on this machine: one line that says what to install."""


def _has_gpu() -> bool:
    return any(Path("/dev").glob("nvidia[0-9]*")) or any(Path("/dev/dri").glob("renderD*"))


def _works(backend: str) -> bool:
    environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"} | {
        "MUJOCO_GL": backend
    }
    try:
        done = subprocess.run(
            [sys.executable, "-c", _TRY],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and "drawn" in done.stdout


@cache
def ready() -> str:
    """The name of a backend that draws here, ready to be used; raises `RenderError`.

    MUJOCO_GL comes first where it is set, then the others.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    order = BACKENDS if _has_gpu() else ("osmesa", "egl", "glfw")
    for backend in dict.fromkeys([*([wanted] if wanted in BACKENDS else []), *order]):
        if _works(backend):
            _use(backend)
            return backend
    raise RenderError(INSTALL)


def _use(backend: str) -> None:
    """MuJoCo draws with this backend, whether it was imported before or will be."""
    os.environ["MUJOCO_GL"] = backend
    imported: Any = sys.modules.get("mujoco.rendering.classic.gl_context")
    if imported is None:
        return
    if "OpenGL" not in sys.modules:  # it is bound to one library once
        os.environ.pop("PYOPENGL_PLATFORM", None)
    imported.GLContext = import_module(f"mujoco.{backend}").GLContext


def renderer(model: Any, width: int, height: int) -> Any:
    """A `mujoco.Renderer` of this size (pixels), to be used in a `with`; raises `RenderError`."""
    backend = ready()
    import mujoco

    try:
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # what an OpenGL library raises is its own
        raise RenderError(
            f"OpenGL ({backend}) does not start: {' '.join(str(error).split())[:200]}; {INSTALL}"
        ) from None
