"""Which OpenGL Python's binding is bound to: it is bound once, by whoever imports it first. Imports nothing."""

import os
import sys

CONTEXT = "mujoco.rendering.classic.gl_context"
"""The module of MuJoCo that binds an OpenGL while MuJoCo is imported, as MUJOCO_GL says."""

_GIVEN = os.environ.get("PYOPENGL_PLATFORM")


def unbind() -> None:
    """The binding as if nobody had imported it, and PYOPENGL_PLATFORM as it was when the program started."""
    for name in list(sys.modules):
        if name.partition(".")[0] == "OpenGL" or name.startswith(("mujoco.egl", "mujoco.osmesa")):
            del sys.modules[name]
    os.environ.pop("PYOPENGL_PLATFORM", None)
    if _GIVEN is not None:
        os.environ["PYOPENGL_PLATFORM"] = _GIVEN
