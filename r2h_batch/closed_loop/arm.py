"""Forward kinematics of the arm in torch, and joint speeds for a twist of the gripper."""

from functools import lru_cache

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.scene.hand import rotation_from_axis_angle
from r2h_batch.scene.robot import Robot

DAMPING = 0.03
"""Damping of least squares: joints stay slow where the arm is singular [choice]."""


@lru_cache(maxsize=4)
def _links(robot: Robot, device: torch.device) -> tuple[Tensor, Tensor]:
    """T_parent_joint (n, 4, 4) and T_wrist_ee on a device."""
    return (
        torch.tensor(robot.T_parent_joint, dtype=torch.float64, device=device),
        torch.tensor(robot.T_wrist3_ee, dtype=torch.float64, device=device),
    )


def ee_and_jacobian(
    robot: Robot, q: Float[Tensor, "b n"]
) -> tuple[Float64[Tensor, "b 4 4"], Float64[Tensor, "b 6 n"]]:
    """The ee's pose and Jacobian; the same bits at any batch size.

    Args:
        robot: the arm.
        q: (B, J) joint angles, rad.

    Returns:
        T_world_ee (B, 4, 4), m; (B, 6, J) how the ee's place (m) and turn (rad), world axes, change with
        the joints.
    """
    links, tool = _links(robot, q.device)
    turns = torch.zeros((*q.shape, 3), dtype=torch.float64, device=q.device)
    turns[..., 2] = q.double()
    R = rotation_from_axis_angle(turns)
    T = torch.eye(4, dtype=torch.float64, device=q.device).expand(len(q), 4, 4)
    axes, places = [], []
    for k in range(q.shape[1]):
        T = se3.matmul(T, links[k])
        T = se3.matmul(T, se3.from_rotation(R[:, k], torch.zeros_like(T[:, :3, 3])))
        axes.append(T[:, :3, 2])
        places.append(T[:, :3, 3])
    T = se3.matmul(T, tool)
    moved = [se3.cross(a, T[:, :3, 3] - p) for a, p in zip(axes, places, strict=True)]
    return T, torch.cat([torch.stack(moved, 2), torch.stack(axes, 2)], 1)


def joint_speeds(
    jacobian: Float64[Tensor, "b 6 n"], twist: Float64[Tensor, "b 6"]
) -> Float64[Tensor, "b n"]:
    """Joint speeds that come near to a twist, by damped least squares.

    Args:
        jacobian: (B, 6, J) of `ee_and_jacobian`.
        twist: (B, 6) first three numbers in m/s, then three in rad/s, world axes.

    Returns:
        (B, J) rad/s.
    """
    A = DAMPING**2 * torch.eye(6, dtype=torch.float64, device=twist.device)
    for column in jacobian.unbind(2):  # in a fixed order
        A = A + column[:, :, None] * column[:, None, :]
    x = torch.linalg.solve(A, twist)
    total = jacobian[:, 0] * x[:, :1]
    for k in range(1, 6):
        total = total + jacobian[:, k] * x[:, k : k + 1]
    return total


def twist_between(
    T_from: Float64[Tensor, "b 4 4"], T_to: Float64[Tensor, "b 4 4"]
) -> Float64[Tensor, "b 6"]:
    """Shift (m) and turn from one pose to another, world axes. The turn is its axis times 2 sin(angle / 2):
    the angle to second order, and never falling up to a half turn."""
    R = se3.matmul(T_to[:, :3, :3], T_from[:, :3, :3].transpose(1, 2))
    axis = torch.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1
    )
    trace = R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2]
    turn = axis / (1.0 + trace).clamp(min=1e-6).sqrt()[:, None]
    return torch.cat([T_to[:, :3, 3] - T_from[:, :3, 3], turn], 1)
