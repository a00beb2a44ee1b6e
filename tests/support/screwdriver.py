"""A screwdriver or a knife in the gripper's pads, and a person's hand beside them."""

import numpy as np

from r2h_batch.closed_loop.transfer.handed import Handed
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot import drive_from_gap, load_robot, pad_center_z

ROBOT, OBJECTS = load_robot(), load_objects(["screwdriver", "knife"])


def screwdrivers(n: int = 3, below_m: float = 0.06, index: int = 0) -> Handed:
    """The handle between the pads, long axis across them; gravity along it. The hand is `below_m` below."""
    model = OBJECTS[index]
    long = int(np.ptp(model.vertices, axis=0).argmax())
    R = np.roll(np.eye(3), -long, axis=1).T  # the long axis becomes x of the gripper
    R = R if np.linalg.det(R) > 0 else -R
    center = np.asarray(model.com, float)
    T = np.eye(4)
    T[:3, :3] = R
    gap = (0.03, 0.019)[index]
    T[:3, 3] = [0, 0, float(pad_center_z(ROBOT, drive_from_gap(ROBOT, gap)))] - R @ center
    slip = np.eye(4)
    slip[:3, 3] = T[:3, 3] + R @ center + [below_m, 0, 0]
    down = np.array([1.0, 0.0, 0.0])
    R_world = np.array([[0.0, 1, 0], [0, 0, 1], [-1, 0, 0]])
    R_world = R_world if np.linalg.det(R_world) > 0 else R_world * [1, -1, 1]
    assert np.allclose(R_world @ down, [0, 0, -1])

    def rows(x: object) -> np.ndarray:
        return np.repeat(np.asarray(x, float)[None], n, axis=0)

    return Handed(
        np.arange(n, dtype=np.int64), np.full(n, index, np.int64), rows(T), np.full(n, gap), rows(down), rows(slip),
        rows([0.6, 0.6, 0.6, 0.01, 0.01, 0.01]), np.full(n, 20.0), rows([-0.2, 0.0, 0.98]), rows(slip[:3, 3]),
        rows([0.0, 0.0, 1.0]), np.full(n, float(model.mass) * 9.81), rows(R_world), np.zeros(n), np.full(n, np.nan),
    )  # fmt: skip
