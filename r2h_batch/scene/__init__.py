"""Robot, hand and object: loaded, bounded, as tables on a device and as one MuJoCo model."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.scene.robot import Robot
    from r2h_batch.scene.robot_file import load_robot
    from r2h_batch.scene.scene import Scene

__all__ = ["Robot", "Scene", "load_robot"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__, {"Robot": "robot", "Scene": "scene", "load_robot": "robot_file"}
    )
