"""Small grasp files in the formats of others."""

import numpy as np
from scipy.spatial.transform import Rotation


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(0, 0.1, (count, 3))
    return T


def write_acronym(path, T, held, gripper=b"panda"):
    import h5py

    with h5py.File(path, "w") as f:
        f["grasps/transforms"] = T
        f["grasps/qualities/flex/object_in_gripper"] = held
        f["object/file"], f["object/scale"], f["object/mass"] = b"meshes/Mug/abc.obj", 0.5, 0.2
        f["gripper/type"], f["gripper/configuration"] = gripper, 0.04
    return path


def write_isaac(path, T, confidence):
    lines = ["format: isaac_grasp", "format_version: 1.0", "object_frame_link: /World/mug", "gripper_frame_link: /World/g",
             "grasps:"]  # fmt: skip
    for i, (t, c) in enumerate(zip(T, confidence, strict=True)):
        x, y, z, w = Rotation.from_matrix(t[:3, :3]).as_quat()
        lines += [f"  grasp_{i}:", f"    confidence: {c:.6f}", f"    position: [{', '.join(f'{v:.9f}' for v in t[:3, 3])}]",
                  f"    orientation: {{w: {w:.9f}, xyz: [{x:.9f}, {y:.9f}, {z:.9f}]}}",
                  "    cspace_position:", "      finger_joint: 0.5", "    pregrasp_cspace_position: {}"]  # fmt: skip
    path.write_text("\n".join(lines) + "\n")
    return path
