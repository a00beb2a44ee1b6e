"""The same branches as judge/ik.py, found by pytorch-kinematics: its chain, forward kinematics and
batched Jacobian.

Which branches exist is the closed form's word in both solvers (that is what makes "unreachable" a
proof); the joint angles are this file's: damped least squares on all six joints in float64, from
the committed seeds moved into the asked branch.

Of an arm without a closed form the postures are this file's too: from the seeds of judge/ik_any.py
that stand nearest to the target. Only the proof of "unreachable" is shared.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.judge import ik as fused
from r2h_batch.judge import ik_any
from r2h_batch.kernels.ik import any_arm
from r2h_batch.kernels.ik import step as ik_step
from r2h_batch.kernels.plan.codes import BRANCHES
from r2h_batch.scene.robot import Robot, ee_pose
from r2h_batch.scene.robot_file import DEFAULT_ROBOT, load_robot

ITERATIONS = 20
"""Damped least squares steps per seed."""

ROWS = 512
"""Branches iterated at once. Always as many: what is short is filled up, so that a row never meets
another shape."""

TOLERANCE = 1e-9
"""Metres and radians at which a branch counts as found."""

DAMPING, DAMPING_MIN = 0.1, 1e-12
"""lambda = DAMPING |error|^2 + DAMPING_MIN (Sugihara 2011, Solvability-unconcerned inverse kinematics by
the Levenberg-Marquardt method)."""

FIRST_SEEDS = 16
"""Seeds of an arm without a closed form that every row tries; the others are for rows without a posture."""

SEED_LEVER_M = 0.3
"""Weight of a radian in the choice of the nearest seeds."""


@torch.no_grad()
def solve_ik(
    T_world_ee: Float[Tensor, "b 4 4"],
    *,
    active: Bool[Tensor, "b"] | None = None,
    robot: Robot | None = None,
    home: Sequence[float] | None = None,
    iterations: int = ITERATIONS,
) -> fused.IkResult:
    """The result of `judge.ik.solve_ik`, with joint angles from pytorch-kinematics on the device of
    `T_world_ee`.

    Slots, statuses and residuals mean the same. A pair of branches is CONVERGED where both of its
    elbows were found, FOUND where the closed form's solution stands in for one. Same bits for any
    batch size and order (tests/judge/test_ik_jacobian.py).
    """
    robot = load_robot(DEFAULT_ROBOT) if robot is None else robot
    home = robot.home_q if home is None else tuple(home)
    if robot.family != "ur":
        kernels = fused.solve_ik(T_world_ee, active=active, robot=robot, home=home)
        assert isinstance(kernels, fused.SearchedIk)
        return _searched(robot, T_world_ee, kernels)
    exact = fused.solve_ik(T_world_ee, active=active, robot=robot, home=home)
    device = T_world_ee.device
    slot = torch.arange(BRANCHES, dtype=torch.int64, device=device)
    pair = 2 * (slot // 4) + slot % 2
    # (b, 8): it exists and is a point, not a line
    row, column = (exact.status == int(ik_step.STATUS_FOUND))[:, pair].nonzero(as_tuple=True)
    targets = se3.orthonormalise(T_world_ee.double())[row]
    signs = torch.stack(
        [1.0 - 2.0 * (column // 4), 1.0 - 2.0 * (column // 2 % 2), 1.0 - 2.0 * (column % 2)], 1
    ).double()
    q, found = _search(
        robot, targets, signs, torch.from_numpy(fused.ik_seeds().copy()).to(device), iterations
    )
    return _filled(robot, exact, row, column, targets, q, found, home)


def _searched(
    robot: Robot, T_world_ee: Float[Tensor, "b 4 4"], fused_found: fused.SearchedIk
) -> fused.SearchedIk:
    """Up to eight postures for each target that is not proven out of reach, of an arm without a
    closed form.

    A row tries its nearest seeds in order until it has eight postures, each `ik_any.APART_RAD` from
    the others in some joint; after `FIRST_SEEDS` only rows without a posture go on.
    """
    rows = fused_found.unproven.nonzero(as_tuple=True)[0]
    device, joints = T_world_ee.device, len(robot.joints)
    targets = se3.orthonormalise(T_world_ee.double())[rows]
    seeds, order = _nearest_seeds(robot, targets)
    lower, upper = (torch.from_numpy(np.array(x)).to(device) for x in (robot.lower, robot.upper))
    held = torch.full((len(rows), BRANCHES, joints), torch.nan, dtype=torch.float32, device=device)
    error = torch.full((2, len(rows), BRANCHES), torch.inf, dtype=torch.float32, device=device)
    count = torch.zeros(len(rows), dtype=torch.int64, device=device)
    for k in range(ik_any.TRIED):
        open_rows = (count < (BRANCHES if k < FIRST_SEEDS else 1)).nonzero(as_tuple=True)[0]
        for i in range(0, len(open_rows), ROWS):
            some = open_rows[i : i + ROWS]
            filled = torch.cat([some, some[:1].expand(ROWS - len(some))])
            q = _descend_within(robot, targets[filled], seeds[order[filled, k]], lower, upper)
            q32 = q[: len(some)].float()
            position, rotation = _residuals(robot, q32, targets[some])
            apart = (
                ((q32[:, None] - held[some]).abs() < ik_any.APART_RAD).all(2).any(1).logical_not()
            )
            good = (
                apart
                & (position <= fused.POSITION_TOLERANCE_M)
                & (rotation <= fused.ROTATION_TOLERANCE_RAD)
                & (q32.double() >= lower).all(1)
                & (q32.double() <= upper).all(1)
            )
            at = (some[good], count[some[good]])
            held[at], error[0][at], error[1][at] = (
                q32[good], position[good].float(), rotation[good].float(),
            )  # fmt: skip
            count[some[good]] += 1
    none = count == 0
    status = torch.where(none, int(any_arm.STATUS_NOT_FOUND), int(any_arm.STATUS_SOME))
    # where this search found nothing and the kernel did, the kernel's posture came nearest
    reached = fused_found.valid[rows, 0]
    nearest = torch.where(reached[:, None], fused_found.q[rows, 0], fused_found.nearest[rows])
    miss_m = torch.where(reached, 0.0, fused_found.miss_m[rows])
    return replace(
        fused_found,
        q=fused_found.q.index_put((rows,), held),
        valid=fused_found.valid.index_put((rows,), error[0].isfinite()),
        position_error_m=fused_found.position_error_m.index_put((rows,), error[0]),
        rotation_error_rad=fused_found.rotation_error_rad.index_put((rows,), error[1]),
        status=fused_found.status.index_put((rows,), status[:, None].expand(-1, 4).to(torch.uint8)),
        nearest=fused_found.nearest.index_put(
            (rows,), torch.where(none[:, None], nearest, torch.nan)
        ),
        miss_m=fused_found.miss_m.index_put((rows,), torch.where(none, miss_m, torch.inf)),
    )


def _nearest_seeds(
    robot: Robot, targets: Float[Tensor, "m 4 4"]
) -> tuple[Float[Tensor, "s j"], Int[Tensor, "m k"]]:
    """All seeds, and for each target those whose ee is nearest to it, nearest first; a radian counts
    `SEED_LEVER_M`."""
    q = ik_any.tables(robot, "cpu")[1].q.numpy().astype(np.float64)
    ee = torch.from_numpy(ee_pose(robot, q)).to(targets.device)
    order = []
    for i in range(0, len(targets), ROWS):
        chunk = targets[i : i + ROWS]
        away = (chunk[:, None, :3, 3] - ee[None, :, :3, 3]).square().sum(2)
        turned = (chunk[:, None, :3, :3] - ee[None, :, :3, :3]).square().sum((2, 3))
        order.append(
            torch.argsort(away + 0.5 * SEED_LEVER_M**2 * turned, dim=1, stable=True)[
                :, : ik_any.TRIED
            ]
        )
    found = torch.cat(order) if order else targets.new_zeros((0, ik_any.TRIED), dtype=torch.int64)
    return torch.from_numpy(q).to(targets.device), found


def _descend_within(
    robot: Robot, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n j"], lower: Tensor, upper: Tensor
) -> Float[Tensor, "n j"]:
    """Damped least squares from seeds, joints clamped to their limits: d = J^T (J J^T + lambda 1)^-1 e."""
    chain = _chain(robot, str(T.device))
    unit = torch.eye(6, dtype=torch.float64, device=T.device)
    for _ in range(2 * ITERATIONS):
        J, now = chain.jacobian(q, ret_eef_pose=True)
        e, _ = _error(now, T)
        done = e.abs().amax(1) < TOLERANCE
        if bool(done.all()):
            break
        Jt = J.transpose(1, 2)
        normal = J @ Jt + (DAMPING * e.square().sum(1) + DAMPING_MIN)[:, None, None] * unit
        d = (Jt @ torch.linalg.solve(normal, e[:, :, None]))[:, :, 0]
        moved = (q + 2.0 * torch.atan(0.5 * d)).clamp(lower, upper)
        q = torch.where(done[:, None], q, moved)
    return q


def _filled(
    robot: Robot, exact: fused.IkResult, row: Tensor, column: Tensor, targets: Tensor, q: Tensor, found: Tensor,
    home: Sequence[float],
) -> fused.IkResult:  # fmt: skip
    """The closed form's result with the branches that were found put in: turns nearest home,
    residuals, statuses."""
    q32 = _nearest_turns(robot, q, home)
    position, rotation = _residuals(robot, q32, targets)
    found = (
        found
        & _within_limits(robot, q32)
        & (position <= fused.POSITION_TOLERANCE_M)
        & (rotation <= fused.ROTATION_TOLERANCE_RAD)
    )
    at = (row[found], column[found])
    result = replace(
        exact,
        q=exact.q.index_put(at, q32[found]),
        position_error_m=exact.position_error_m.index_put(at, position[found].float()),
        rotation_error_rad=exact.rotation_error_rad.index_put(at, rotation[found].float()),
        valid=exact.valid.index_put(at, torch.ones_like(at[0], dtype=torch.bool)),
    )
    missing = torch.zeros_like(exact.valid).index_put((row, column), ~found)
    both = (exact.status == int(ik_step.STATUS_FOUND)) & ~(
        missing.reshape(-1, 2, 2, 2).any(2).reshape(-1, 4)
    )
    return replace(result, status=torch.where(both, int(ik_step.STATUS_CONVERGED), result.status))


def _search(
    robot: Robot,
    targets: Float[Tensor, "m 4 4"],
    signs: Float[Tensor, "m 3"],
    seeds: Float[Tensor, "s 6"],
    iterations: int,
) -> tuple[Float[Tensor, "m 6"], Bool[Tensor, "m"]]:
    """Joint angles, and whether a seed led to them; `signs`: shoulder, elbow, wrist of the asked
    branch."""
    m = len(targets)
    q = torch.zeros((m, 6), dtype=torch.float64, device=targets.device)
    found = torch.zeros(m, dtype=torch.bool, device=targets.device)
    # one after the other: the first that converges counts, whoever shares the chunk
    for seed in seeds:
        left = (~found).nonzero(as_tuple=True)[0]
        for i in range(0, len(left), ROWS):
            some = left[i : i + ROWS]
            filled = torch.cat([some, some[:1].expand(ROWS - len(some))])
            reached, converged = _descend(robot, targets[filled], signs[filled], seed, iterations)
            q[some], found[some] = reached[: len(some)], converged[: len(some)]
    return q, found


def _descend(
    robot: Robot,
    T: Float[Tensor, "n 4 4"],
    signs: Float[Tensor, "n 3"],
    seed: Float[Tensor, "6"],
    iterations: int,
) -> tuple[Tensor, Tensor]:
    """Damped least squares from one seed: the last joint angles, and whether they are the asked
    branch.

    d = (J^T J + lambda 1)^-1 J^T e with pytorch-kinematics' geometric Jacobian; each joint turns by
    2 atan(d / 2), so that no step is above half a turn. Rows that have arrived stand still.
    """
    ur = fused.ur_parameters(robot, robot.home_q)
    chain, tool, links = _chain(robot, str(T.device)), float(ur.tool), (float(ur.a2), float(ur.a3))
    p5 = T[:, :3, 3] - tool * T[:, :3, 2]
    q = _seeded(seed, p5, signs)
    unit = torch.eye(6, dtype=torch.float64, device=T.device)
    for step in range(iterations + 1):
        q = _in_branch(q, signs, links)
        J, now = chain.jacobian(q, ret_eef_pose=True)
        e, trace = _error(now, T)
        size = e.square().sum(1)
        done = (e.abs().amax(1) < TOLERANCE) & (trace > 1.0)
        if step == iterations or bool(done.all()):
            break
        Jt = J.transpose(1, 2)
        normal = Jt @ J + (DAMPING * size + DAMPING_MIN)[:, None, None] * unit
        d = torch.linalg.solve(normal, (Jt @ e[:, :, None])[:, :, 0])
        q = torch.where(done[:, None], q, q + 2.0 * torch.atan(0.5 * d))
    ahead = torch.cos(q[:, 0]) * p5[:, 0] + torch.sin(q[:, 0]) * p5[:, 1]
    return q, done & (ahead * signs[:, 0] >= 0)


def _error(now: Tensor, T: Tensor) -> tuple[Float[Tensor, "n 6"], Float[Tensor, "n"]]:
    """Position (m) and rotation vector (length 2 tan(angle / 2)) that take the pose `now` to T; the
    rotation's trace."""
    axes, goal = now[:, :3, :3].transpose(1, 2), T[:, :3, :3].transpose(1, 2)
    vee = torch.linalg.cross(axes, goal).sum(1)
    trace = (axes * goal).sum((1, 2))
    turn = vee * (2.0 / (1.0 + trace).clamp(min=0.2))[:, None]
    return torch.cat([T[:, :3, 3] - now[:, :3, 3], turn], 1), trace


def _seeded(
    seed: Float[Tensor, "6"], p5: Float[Tensor, "n 3"], signs: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 6"]:
    """A committed seed, turned to the wrist centres' azimuth, mirrored in the arm's plane for the
    other shoulder side."""
    shoulder = signs[:, 0]
    q1 = seed[0] + torch.atan2(shoulder * p5[:, 1], shoulder * p5[:, 0])
    psi1, psi2, psi3 = torch.cumsum(seed[1:4], 0)
    behind = shoulder < 0
    psi1, psi2 = (torch.where(behind, torch.pi - psi, psi) for psi in (psi1, psi2))
    return torch.stack(
        [q1, psi1, psi2 - psi1, psi3 - psi2, seed[4].expand_as(q1), seed[5].expand_as(q1)], 1
    )


def _in_branch(
    q: Float[Tensor, "n 6"], signs: Float[Tensor, "n 3"], links: tuple[float, float]
) -> Float[Tensor, "n 6"]:
    """The same ee poses with the asked signs of sin q3 and sin q5: the elbow mirrored, the wrist
    flipped where they are not."""
    a2, a3 = links
    q1, q2, q3, q4, q5, q6 = q.unbind(1)
    # the links' end seen from the shoulder has the angle phi: mirrored at that line, psi becomes 2
    # phi - psi
    phi = q2 + torch.atan2(a3 * torch.sin(q3), a2 + a3 * torch.cos(q3))
    wrong = torch.sin(q3) * signs[:, 1] < 0
    psi3 = q2 + q3 + q4
    q2, q3 = torch.where(wrong, 2 * phi - q2, q2), torch.where(wrong, -q3, q3)
    flip = torch.sin(q5) * signs[:, 2] < 0
    psi3, q5, q6 = psi3 + torch.pi * flip, torch.where(flip, -q5, q5), q6 + torch.pi * flip
    return torch.stack([q1, q2, q3, psi3 - q2 - q3, q5, q6], 1)


def _nearest_turns(
    robot: Robot, q: Float[Tensor, "m 6"], home: Sequence[float]
) -> Float[Tensor, "m 6"]:
    """float32 angles moved by whole turns: as near to home as the limits allow, and within them
    after rounding."""
    two_pi = 2 * torch.pi
    lower, upper, at = (
        torch.tensor(np.asarray(x), dtype=torch.float64, device=q.device)
        for x in (robot.lower, robot.upper, home)
    )
    q = q - two_pi * torch.floor((q - at) / two_pi + 0.5)
    q = torch.where(q > upper, q - two_pi, q)
    q = torch.where(q < lower, q + two_pi, q)
    q32 = q.float()
    outside = (q32.double() > upper) | (q32.double() < lower)
    return torch.where(outside, (q * 0.9999999).float(), q32)


def _within_limits(robot: Robot, q: Float32[Tensor, "m 6"]) -> Bool[Tensor, "m"]:
    """Whether all six angles lie in their ranges: a range of less than a turn may hold none of the turns."""
    lower, upper = (
        torch.tensor(np.asarray(x), dtype=torch.float64, device=q.device)
        for x in (robot.lower, robot.upper)
    )
    return ((q.double() >= lower) & (q.double() <= upper)).all(1)


def _residuals(
    robot: Robot, q: Float[Tensor, "m 6"], T: Float[Tensor, "m 4 4"]
) -> tuple[Tensor, Tensor]:
    """Position (m) and angle (rad) between the poses of float32 joint angles and T, by
    pytorch-kinematics in float64."""
    if len(q) == 0:
        return T.new_zeros(0), T.new_zeros(0)
    chain = _chain(robot, str(T.device))
    parts = []
    for i in range(0, len(q), ROWS):
        some = q[i : i + ROWS].double()
        filled = torch.cat([some, some[:1].expand(ROWS - len(some), some.shape[1])])
        parts.append(chain.forward_kinematics(filled).get_matrix()[: len(some)])
    e, _ = _error(torch.cat(parts), T)
    return e[:, :3].norm(dim=1), 2.0 * torch.atan(0.5 * e[:, 3:].norm(dim=1))


@cache
def _chain(robot: Robot, device: str) -> Any:
    """pytorch-kinematics' chain base -> ee in float64 on a device."""
    return fused.reference_chain(robot, dtype=torch.float64, device=device)
