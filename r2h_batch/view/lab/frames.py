"""The world's frame as a UR's pendant and as ROS 2 call it.

The world's frame is the arm's `base_link` of ROS 2 (REP 103). A UR's controller, so its pendant and RTDE, counts in `base`,
which is `base_link` turned by half a turn about z. Whoever mixes them up sends the arm to the other side of its base.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

T_base_world: Array = np.diag([-1.0, -1.0, 1.0, 1.0])
"""World (`base_link`) to the controller's `base`."""


def turn_vector(R: Array) -> Array:
    """A rotation (3, 3) as a vector (3,) in rad along its axis, as a pendant shows RX, RY, RZ."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def pendant(T_world_x: Array) -> list[float]:
    """A pose in the world as the pendant shows it: X, Y, Z in mm in `base`, RX, RY, RZ in rad."""
    T = T_base_world @ T_world_x
    return [*(1000 * T[:3, 3]).round(2).tolist(), *turn_vector(T[:3, :3]).round(5).tolist()]
