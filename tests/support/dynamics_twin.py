"""Another way to the arm's dynamics: sums over bodies."""

import numpy as np

from r2h_batch.scene.dynamics import GRIPPER_BOX_M, GRIPPER_COM_M, Payload
from r2h_batch.scene.robot import forward_kinematics
from r2h_batch.scene.robot_file import ARMATURE, LINK_COM_M, LINK_INERTIA, LINK_MASS_KG, LINK_ROLL, load_robot

ROBOT = load_robot()


def some_payload(rng: np.random.Generator, mass: float = 0.7) -> Payload:
    a = rng.normal(size=(3, 3))
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Q * np.linalg.det(Q), rng.normal(size=3) * 0.1
    spread = a @ a.T * 1e-3
    return Payload(T, mass, rng.normal(size=3) * 0.05, np.trace(spread) * np.eye(3) - spread)


def bodies(payload: Payload) -> list[tuple[int, np.ndarray, float, np.ndarray]]:
    """(link, centre of mass in it, mass, inertia in the link's axes) of everything that moves."""
    out = []
    for i in range(6):
        xx, xy, xz, yy, yz, zz = LINK_INERTIA[i]
        c, s = np.cos(LINK_ROLL[i]), np.sin(LINK_ROLL[i])
        R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        tensor = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
        out.append((i + 1, np.array(LINK_COM_M[i]), LINK_MASS_KG[i], tensor))
    x, y, z = np.square(GRIPPER_BOX_M) * ROBOT.linkage.mass_kg / 12
    out.append((7, np.array(GRIPPER_COM_M), ROBOT.linkage.mass_kg, np.diag([y + z, x + z, x + y])))
    R, p = payload.T_gripper_obj[:3, :3], payload.T_gripper_obj[:3, 3]
    out.append((7, R @ payload.com + p, payload.mass, R @ payload.inertia @ R.T))
    return out


def centers(q: np.ndarray, payload: Payload) -> np.ndarray:
    T = forward_kinematics(ROBOT, q)
    return np.stack([(T[link] @ np.append(com, 1))[:3] for link, com, _, _ in bodies(payload)])


def mass_matrix(q: np.ndarray, payload: Payload) -> np.ndarray:
    """Sum of m Jp^T Jp + Jr^T I Jr with Jp by differences, Jr from the joint axes, and the rotors."""
    h = 1e-6
    step = h * np.eye(6)
    Jp = np.stack([(centers(q + d, payload) - centers(q - d, payload)) / (2 * h) for d in step], -1)  # (bodies, 3, 6)
    T = forward_kinematics(ROBOT, q)
    M = ARMATURE * np.eye(6)
    for k, (link, _, mass, inertia) in enumerate(bodies(payload)):
        Jr = np.zeros((3, 6))
        for j in range(min(link, 6)):
            Jr[:, j] = T[j + 1, :3, 2]
        R = T[link, :3, :3]
        M += mass * Jp[k].T @ Jp[k] + Jr.T @ R @ inertia @ R.T @ Jr
    return M
