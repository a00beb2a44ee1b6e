"""Hands of trials and their skinning, computed another way."""

from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from r2h_batch.scene.hand import load_hand, load_hand_set, palm_frame
from r2h_batch.types import Trials

MIRROR = np.array([-1.0, 1.0, 1.0])
MANO_PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)


@cache
def hand_vertices() -> torch.Tensor:
    hands = load_hand_set()
    return load_hand().pose(hands.pose, hands.shape, hands.side).vertices.double()


def palms(trials: Trials) -> tuple[np.ndarray, np.ndarray]:
    """c_h and n_h in the world by matrix products."""
    hands = load_hand_set()
    joints = load_hand().pose(hands.pose, hands.shape, hands.side).joints.double()
    point, normal = (x[trials.hand_index.long()].numpy() for x in palm_frame(joints, hands.side))
    T = trials.T_world_hand.double().numpy()
    n = np.einsum("nij,nj->ni", T[:, :3, :3], normal)
    return np.einsum("nij,nj->ni", T[:, :3, :3], point) + T[:, :3, 3] + 0.12 * n, n


def skinning_twin(hand, pose, shape, side):
    """Linear blend skinning of one hand with 4x4 matrices in float64: MANO's, without pose correctives."""
    flip = MIRROR if side else np.ones(3)
    axial = np.array([1.0, -1.0, -1.0]) if side else np.ones(3)
    turns = Rotation.from_rotvec(pose.astype(np.float64).reshape(16, 3) * axial).as_matrix()
    rest = hand.joints_rest.double().numpy() + hand.joint_shape_basis.double().numpy() @ shape.astype(np.float64)
    skin = hand.vertices.double().numpy() + hand.shape_basis.double().numpy() @ shape.astype(np.float64)
    T_world_joint = np.zeros((16, 4, 4))
    for j, parent in enumerate(MANO_PARENTS):
        T_parent_joint = np.eye(4)
        T_parent_joint[:3, :3] = turns[j]
        T_parent_joint[:3, 3] = rest[j] - (rest[parent] if parent >= 0 else 0)
        T_world_joint[j] = T_parent_joint if parent < 0 else T_world_joint[parent] @ T_parent_joint
    T_rest_joint = np.tile(np.eye(4), (16, 1, 1))
    T_rest_joint[:, :3, 3] = rest
    move = T_world_joint @ np.linalg.inv(T_rest_joint)
    weights = hand.weights.double().numpy()
    weights = weights / weights.sum(axis=1, keepdims=True)
    blend = np.einsum("vj,jrc->vrc", weights, move)
    homogeneous = np.concatenate([skin, np.ones((len(skin), 1))], axis=1)
    return np.einsum("vrc,vc->vr", blend, homogeneous)[:, :3] * flip, T_world_joint[:, :3, 3] * flip
