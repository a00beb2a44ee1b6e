"""Bodies as tables on a device, and as one MuJoCo model."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.scene.scene import BodyPoses, Scene

__all__ = ["BodyPoses", "Scene"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "BodyPoses": "scene",
            "Scene": "scene",
        },
    )
