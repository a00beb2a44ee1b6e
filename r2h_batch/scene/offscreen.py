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

import numpy as np

from r2h_batch.base.errors import MachineError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.base.opengl import CONTEXT, unbind

MOST_GEOMS = 10_000
BACKENDS = ("egl", "osmesa", "glfw")
UNSAID = (
    "",
    "enable",
    "enabled",
    "on",
    "true",
    "1",
    "glx",
    "disable",
    "disabled",
    "off",
    "false",
    "0",
)
"""Values of MUJOCO_GL that name no backend of these: MuJoCo chooses, or is told not to draw."""
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

    MUJOCO_GL comes first where it is set, then the others; which one is used in its place is said.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    order = BACKENDS if _has_gpu() else ("osmesa", "egl", "glfw")
    for backend in dict.fromkeys([*([wanted] if wanted in BACKENDS else []), *order]):
        if _works(backend):
            if wanted not in (backend, *UNSAID):
                LOG.info(f"MUJOCO_GL={printable(wanted)} {_why(wanted)}; set MUJOCO_GL={backend}")
            _use(backend)
            return backend
    said = f"MUJOCO_GL={printable(wanted)} {_why(wanted)}, and " if wanted not in UNSAID else ""
    raise RenderError(f"{said}{INSTALL}")


def _why(wanted: str) -> str:
    known = f"is none of {', '.join(BACKENDS)}"
    return "does not draw here" if wanted in BACKENDS else known


def _use(backend: str) -> None:
    """MuJoCo draws with this backend, whether it was imported before or will be."""
    os.environ["MUJOCO_GL"] = backend
    bound = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    if bound not in ("", backend):  # to one that does not draw
        unbind()
        os.environ.pop("PYOPENGL_PLATFORM", None)
    imported: Any = sys.modules.get(CONTEXT)
    if imported is not None:
        imported.GLContext = import_module(f"mujoco.{backend}").GLContext


class Drawer:
    """Draws a model into images, as `mujoco.Renderer` does, and loads meshes anew whose vertices have changed."""

    def __init__(self, model: Any, width: int, height: int, backend: str) -> None:
        import mujoco

        self._mujoco, self._model = mujoco, model
        self._gl = import_module(f"mujoco.{backend}").GLContext(width, height)
        self._gl.make_current()
        self.scene = mujoco.MjvScene(model, MOST_GEOMS)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._rect = mujoco.MjrRect(0, 0, width, height)

    def update_scene(self, data: Any, camera: Any, option: Any = None) -> None:
        """The bodies as `data` has them, seen by a camera (`MjvCamera`, or the name of one of the model)."""
        mj = self._mujoco
        if isinstance(camera, str):
            fixed, camera = self._model.camera(camera).id, mj.MjvCamera()
            camera.type, camera.fixedcamid = mj.mjtCamera.mjCAMERA_FIXED, fixed
        every = mj.mjtCatBit.mjCAT_ALL
        option = mj.MjvOption() if option is None else option
        mj.mjv_updateScene(self._model, data, option, None, camera, every, self.scene)

    def load(self, mesh: int) -> None:
        """The vertices and normals that the model has of a mesh now."""
        self._gl.make_current()
        self._mujoco.mjr_uploadMesh(self._model, self._context, mesh)

    def render(self) -> Any:
        """The image, uint8 (height, width, 3)."""
        self._gl.make_current()
        image = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        self._mujoco.mjr_render(self._rect, self.scene, self._context)
        self._mujoco.mjr_readPixels(image, None, self._rect, self._context)
        return image[::-1]  # OpenGL's first row is the lowest

    def __enter__(self) -> "Drawer":
        return self

    def __exit__(self, *_: object) -> None:
        self._gl.make_current()
        self._context.free()
        self._gl.free()


def renderer(model: Any, width: int, height: int) -> Drawer:
    """Draws images of this size (pixels) of a model, to be used in a `with`; raises `RenderError`."""
    backend = ready()
    try:
        return Drawer(model, width, height, backend)
    except Exception as error:  # what an OpenGL library raises is its own
        raise RenderError(
            f"OpenGL ({backend}) does not start: {' '.join(str(error).split())[:200]}; {INSTALL}"
        ) from None
