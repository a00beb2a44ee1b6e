"""Skins of many hands that close: linear blend skinning in float32, from shapes that are known
beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.bodies.hand import HandModel

__all__ = ["Skins"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
JOINTS = 16


@dataclass(frozen=True, eq=False)
class Skins:
    """K right hands at rest: posed in a tenth of `HandModel.pose`'s time, 1e-7 m beside it, not the
    same bits everywhere."""

    rest: F32
    """(K, V, 3) skins"""
    joints: F64
    """(K, 16, 3)"""
    weights: F32
    """(V, 16)"""
    parents: tuple[int, ...]
    pose_basis: F32 | None
    """(135, V * 3)"""

    @classmethod
    def of(cls, hand: HandModel, shape: F32) -> Skins:
        """Hands of these shapes (K, 10)."""
        plain = hand.pose(
            torch.zeros((len(shape), 48), dtype=torch.float32, device="cpu"),
            torch.from_numpy(shape),
        )
        weights = hand.weights.double().numpy()
        basis = None if hand.pose_basis is None else hand.pose_basis.numpy().reshape(-1, 135).T
        return cls(
            plain.vertices.numpy(),
            plain.joints.double().numpy(),
            np.ascontiguousarray(weights / weights.sum(1, keepdims=True), np.float32),
            tuple(int(p) for p in hand.parents),
            None if basis is None else np.ascontiguousarray(basis, np.float32),
        )

    def posed(self, which: NDArray[np.integer], turn: F64) -> tuple[F32, F32]:
        """Skins (n, V, 3) and joints (n, 16, 3), hand frame, of hands `which` (n,) with joints
        turned (n, 16, 3, 3)."""
        rest = self.joints[which]
        R, at = [turn[:, 0]], [rest[:, 0]]
        for j in range(1, JOINTS):
            p = self.parents[j]
            R.append(R[p] @ turn[:, j])
            at.append(np.einsum("nij,nj->ni", R[p], rest[:, j] - rest[:, p]) + at[p])
        world, joints = np.stack(R, 1), np.stack(at, 1)
        shift = joints - np.einsum("njik,njk->nji", world, rest)
        # (n, 12, 16): nine of the turn, three of the shift, of each joint; blended, a plane of each
        # for all of the skin
        moves = (
            np.concatenate([world.reshape(-1, JOINTS, 9), shift], 2)
            .transpose(0, 2, 1)
            .astype(np.float32)
        )
        blended = moves @ self.weights.T
        skin = self.rest[which].transpose(0, 2, 1)
        if self.pose_basis is not None:
            feature = (turn[:, 1:] - np.eye(3)).reshape(-1, 135).astype(np.float32)
            skin = skin + (feature @ self.pose_basis).reshape(len(which), -1, 3).transpose(0, 2, 1)
        out = np.empty((len(which), skin.shape[2], 3), np.float32)
        for i in range(3):
            out[:, :, i] = blended[:, 9 + i] + sum(
                blended[:, 3 * i + k] * skin[:, k] for k in range(3)
            )
        return out, joints.astype(np.float32)
