"""A body in SMPL-X' layout: SMPLX_MALE.npz with its names, shapes and dtypes, fewer vertices; and the model's own chain."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

CORNERS = np.stack(np.meshgrid(*[[-0.02, 0.02]] * 3), -1).reshape(8, 3)
BODY = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
FINGERS = [(wrist, first + 3 * f, first + 3 * f + 1) for wrist, first in ((20, 25), (21, 40)) for f in range(5)]
PARENTS = (*BODY, 15, 15, 15, *(p for finger in FINGERS for p in finger))
SIDES = {"left": (16, 18, 20), "right": (17, 19, 21)}


def smplx_dictionary(seed=0):
    """Joints at rest where a person's are, each the mean of eight vertices around it; y is up, z ahead, x to the left."""
    at = np.zeros((55, 3))
    at[:16, 1] = [0, -0.1, -0.1, 0.1, -0.5, -0.5, 0.25, -0.9, -0.9, 0.3, -0.95, -0.95, 0.5, 0.42, 0.42, 0.6]
    for sign, joints in ((1, SIDES["left"]), (-1, SIDES["right"])):
        at[list(joints)] = [[0.18 * sign, 0.4, 0], [0.45 * sign, 0.39, -0.02], [0.7 * sign, 0.4, 0.0]]
    at[25:40], at[40:] = at[20] + [0.05, 0, 0], at[21] - [0.05, 0, 0]
    at += np.random.default_rng(seed).normal(0, 0.01, at.shape)
    regressor = np.kron(np.eye(55), np.full(8, 1 / 8))
    count = regressor.shape[1]
    tree = np.array([PARENTS, range(55)], np.int64).astype(np.uint32)  # the root's parent: 4294967295
    return {"v_template": (at[:, None] + CORNERS).reshape(-1, 3), "J_regressor": regressor, "kintree_table": tree,
            "f": np.zeros((1, 3), np.uint32), "weights": np.zeros((count, 55)), "shapedirs": np.zeros((count, 3, 20)),
            "posedirs": np.zeros((count, 3, 486)), "joint2num": np.array({"Pelvis": 0}, object)}  # fmt: skip


def write_smplx(folder: Path, seed=0, gender="MALE"):
    """The model, and its arrays."""
    folder.mkdir(exist_ok=True)
    arrays = smplx_dictionary(seed)
    np.savez(folder / f"SMPLX_{gender}.npz", **arrays)
    return arrays


def smplx_twin(arrays, template, turns, transl):
    """(55, 3) joints of one frame: 4x4 matrices down the tree, float64. `turns` (22, 3): the root's and the body's."""
    rest, turns = arrays["J_regressor"] @ template, np.vstack([turns, np.zeros((33, 3))])
    world = np.zeros((55, 4, 4))
    for j, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_rotvec(turns[j]).as_matrix()
        local[:3, 3] = rest[j] - (rest[parent] if parent >= 0 else 0)
        world[j] = local if parent < 0 else world[parent] @ local
    return world[:, :3, 3] + transl
