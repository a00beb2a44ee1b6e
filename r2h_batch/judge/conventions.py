"""A hint where all rows of a batch fail: eight rows are judged again in other conventions of frames and units,
and the line says in which one they pass. No verdict depends on it."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.types import Outcome, Scores, Trials

ROWS = 8
"""Rows that are judged again: fewer say nothing."""

MOST = 6
"""Least number of these rows that must be better in another convention."""

AT_HAND_M = 0.06
"""A TCP that is nearer to the origin of the hand's frame lies in the hand; estimated hands are off by up to 5 cm. [choice]"""

SLOW_S = 300.0
"""A median motion of this length is looked at: none of the built-in methods' takes a minute. [choice]"""

Poses = tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b 4 4"]]


def other_poses(T_obj_ee: Tensor, T_world_ee: Tensor) -> dict[str, Poses]:
    """The poses read in each other convention: its words -> T_obj_ee, T_world_ee.

    Args:
        T_obj_ee: (B, 4, 4) grasps as given, m.
        T_world_ee: (B, 4, 4) handover poses as given, m.
    """
    inverse_grasp, inverse_handover = se3.inverse(T_obj_ee), se3.inverse(T_world_ee)
    half = torch.eye(4, dtype=T_world_ee.dtype, device=T_world_ee.device)
    half[0, 0] = half[1, 1] = -1.0
    xyzw, wxyz = ([_reordered(T, order) for T in (T_obj_ee, T_world_ee)] for order in ORDERS)
    return {
        "T_obj_ee inverted: it is the ee in the object's frame": (inverse_grasp, T_world_ee),
        "T_world_ee inverted: it is the ee in the world frame": (T_obj_ee, inverse_handover),
        "both poses inverted: T_a_b is b in the frame of a": (inverse_grasp, inverse_handover),
        "T_world_ee times T_obj_ee: T_world_ee is the ee's pose, not the object's": (
            T_obj_ee,
            se3.matmul(T_world_ee, T_obj_ee),
        ),
        "T_world_ee turned by 180 degrees about z: another base of the robot": (
            T_obj_ee,
            se3.matmul(half.expand_as(T_world_ee), T_world_ee),
        ),
        "lengths read as millimetres: they are in metres": (_shrunk(T_obj_ee), _shrunk(T_world_ee)),
        "T_world_ee read in millimetres: it is in metres": (T_obj_ee, _shrunk(T_world_ee)),
        "T_obj_ee read in millimetres: it is in metres": (_shrunk(T_obj_ee), T_world_ee),
        "quaternions read as x, y, z, w instead of w, x, y, z": (xyzw[0], xyzw[1]),
        "quaternions read as w, x, y, z instead of x, y, z, w": (wxyz[0], wxyz[1]),
    }


ORDERS = ((3, 0, 1, 2), (1, 2, 3, 0))
"""Which numbers of a rotation's quaternion (x, y, z, w) are the true x, y, z, w: it was written as x, y, z, w and read
as w, x, y, z; written as w, x, y, z and read as x, y, z, w."""


def _shrunk(T: Tensor) -> Tensor:
    """The poses with lengths in millimetres as metres."""
    return se3.from_rotation(T[:, :3, :3], T[:, :3, 3] / 1000)


def _reordered(T: Tensor, order: Sequence[int]) -> Tensor:
    """The poses with the numbers of their quaternions in another order."""
    from scipy.spatial.transform import Rotation  # 0.4 s, where a hint is looked for

    quaternion = Rotation.from_matrix(T[:, :3, :3].double().cpu().numpy()).as_quat()
    R = Rotation.from_quat(quaternion[:, list(order)]).as_matrix()
    return se3.from_rotation(torch.from_numpy(R.astype(np.float32)).to(T), T[:, :3, 3])


def failing(scores: Scores) -> Bool[Tensor, " c"]:
    """The criteria that every row fails."""
    return (scores.evaluated & ~scores.passed).all(0)


def pose_hint(
    scores: Scores,
    T_obj_ee: Tensor,
    T_world_ee: Tensor,
    trials: Trials,
    judge: Callable[[Tensor, Tensor, Trials], Scores],
    resting: Callable[[Trials], Tensor] | None = None,
) -> str | None:
    """One line about poses that fail alike and pass in another convention; None: nothing is found.

    Args:
        scores: verdicts of the B rows.
        T_obj_ee: (B, 4, 4) grasps, m.
        T_world_ee: (B, 4, 4) handover poses, m.
        trials: B trials.
        judge: judges poses of trials, at least at the handover.
        resting: says where the objects of trials rest (T_world_obj, m), where the benchmark begins at the table.
    """
    valid = scores.outcome != int(Outcome.INVALID_INPUT)
    apart = (T_world_ee - trials.T_world_hand.to(T_world_ee))[valid, :3, 3].norm(dim=1)
    if len(apart) >= ROWS and bool((apart < AT_HAND_M).all()):
        return (
            f"T_world_ee lies at the hand's pose (trials.T_world_hand, true or estimated) in all {len(apart)} rows: it is"
            " where the gripper's TCP goes, as a rule 12 to 15 cm in front of the palm"
        )
    rows = _eight(scores)
    if rows is None:
        return None
    given = (T_obj_ee[rows], T_world_ee[rows])
    others = other_poses(*given)
    if resting is not None:
        there = se3.inverse(resting(trials[rows]).to(given[0]))
        words = "T_obj_ee taken from the world into the object's frame: inverse(T_world_obj) times the grasp on the table"
        others[words] = (se3.matmul(there, given[0]), given[1])
    grasps, handovers = zip(given, *others.values(), strict=True)
    times = torch.arange(ROWS, dtype=torch.int64, device=rows.device).repeat(1 + len(others))
    found = judge(torch.cat(grasps), torch.cat(handovers), trials[rows][times])
    return _best(scores, found, tuple(others))


def motion_hint(
    scores: Scores, q: Tensor, time_s: Tensor, judge: Callable[[Any, Tensor, Tensor], Scores]
) -> str | None:
    """One line about motions that fail alike, or last long, and pass in other units; None: nothing is found.

    Args:
        scores: verdicts of the B rows.
        q: (B, W, joints) as given, rad.
        time_s: (B, W) or (W,) as given, s.
        judge: judges some of the B rows with other angles and times.
    """
    ended = time_s[..., -1].expand(len(q))
    median = float(ended.double().median()) if len(q) >= ROWS else 0.0
    long = SLOW_S < median < math.inf
    rows = _eight(scores)
    if rows is not None:
        time = time_s if time_s.ndim == 1 else time_s[rows]
        name, unit = "q read as degrees: angles are in radians", 1.0
        if long:
            name, unit = (
                "q read as degrees and time_s as milliseconds: rad and s are the units",
                1e-3,
            )
        parts = [judge(rows, q[rows], time), judge(rows, q[rows] * (math.pi / 180), time * unit)]
        return _best(scores, Scores.concatenate(parts), (name,))
    if not long:
        return None
    rows = torch.arange(ROWS, dtype=torch.int64, device=q.device)
    word, of_second = ("microseconds", 1e6) if median > 1000 * SLOW_S else ("milliseconds", 1e3)
    found = judge(rows, q[rows], (time_s if time_s.ndim == 1 else time_s[rows]) / of_second)
    if not (found.passed.sum(1) >= scores.passed[rows].sum(1)).all():
        return None
    return (
        f"the median motion lasts {median:.0f} s; with time_s read as {word} it lasts {median / of_second:.1f} s and"
        f" {ROWS} of {ROWS} rows pass as many criteria: times are in seconds"
    )


def _eight(scores: Scores) -> Tensor | None:
    """The first rows that can be judged, where no row succeeds; of few rows: where all fail the same criterion."""
    valid = scores.outcome != int(Outcome.INVALID_INPUT)
    judged = scores[valid]
    enough = len(judged) >= 2 * ROWS and not judged.success.any()
    if len(judged) < ROWS or not (enough or failing(judged).any()):
        return None
    return torch.nonzero(valid)[:ROWS, 0]


def _best(scores: Scores, found: Scores, names: Sequence[str]) -> str | None:
    """The line about the convention in which most rows are better: `found` has the rows as given, then those of
    each name."""
    valid = scores[scores.outcome != int(Outcome.INVALID_INPUT)]
    alike = failing(valid)
    words = " and ".join(
        name for name, of in zip(scores.criteria, alike.tolist(), strict=True) if of
    )
    if not words:  # none of them fails in all rows: chance passes some
        alike = torch.ones_like(alike)
    passed = (found.passed & found.evaluated).reshape(1 + len(names), ROWS, -1)
    more = passed[1:].sum(2) > passed[:1].sum(2)
    mended = (passed[1:] & ~passed[:1])[:, :, alike].any(2)
    better = (more & mended).sum(1)
    k = int(torch.argmax(better * 100 + passed[1:].sum((1, 2))))
    if int(better[k]) < MOST:
        return None
    name, _, meaning = names[k].partition(": ")
    how = f": {meaning}" if meaning else ""
    return f"all {len(valid)} rows fail{f' {words}' if words else ''}; {int(better[k])} of {ROWS} pass more with {name}{how}"
