"""A hint where many rows of a batch fail: a sample is judged again in other conventions of frames, units and order,
and the line says in which one far more of them succeed. No verdict depends on it."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.declared import declaration
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Outcome, Scores, Trials

ROWS = 8
"""Fewer rows say nothing. So many motions are judged again."""

SAMPLE = 64
"""Poses that are judged again at most, spread over the batch: the first ones may all be of one object."""

LEAST = 3
"""Least number of the rows, and a quarter of the sample, by which more must succeed in another convention: one or two do
by chance. To pass more criteria is no evidence, since poses that lie nowhere near the hand pass Safe. [choice]"""

TIMES = 3
"""A convention is named where it takes so many times the rows as they are given, or leaves one in so many of those that
fail: by symmetry some succeed in the wrong one, up to half where the object's pose stands for the gripper's. [choice]"""

AT_HAND_M = 0.06
"""A TCP that is nearer to the palm point or to the origin of the hand's frame lies in the hand; estimated hands are off by
up to 5 cm. [choice]"""

AWAY_M, MOST_MOVE_M = 0.3, 5.0
"""Gripper poses that lie so far from the balls before the palms, by the median, may be given from another origin. [choice]"""

TURNED_RAD = 4 * math.pi
"""An angle beyond two turns is in no robot's limits. [choice]"""

SLOW_S = 300.0
"""A median motion of this length is looked at: none of the built-in methods' takes a minute. [choice]"""

USUAL_S = (0.5, 60.0)
"""How long motions last: a unit of time is named where it gives this."""

UNITS_OF_TIME = (
    ("milliseconds", 1e3, "ms"),
    ("microseconds", 1e6, "us"),
    ("nanoseconds", 1e9, "ns"),
)

AT_HOME_RAD = 0.02
"""Motions whose angles, in another order, are this near to home begin there. [choice]"""

Poses = tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b 4 4"]]


def other_poses(
    T_obj_ee: Tensor, T_world_ee: Tensor, T_world_hand: Tensor, T_flange_ee: Tensor
) -> dict[str, Poses]:
    """The poses read in each other convention: its words -> T_obj_ee, T_world_ee.

    Args:
        T_obj_ee: (B, 4, 4) grasps as given, m.
        T_world_ee: (B, 4, 4) handover poses as given, m.
        T_world_hand: (B, 4, 4) hands, m.
        T_flange_ee: (4, 4) the TCP in the frame of the robot's flange, m.
    """
    inverse_grasp, inverse_handover = se3.inverse(T_obj_ee), se3.inverse(T_world_ee)
    xyzw, wxyz = ([_reordered(T, order) for T in (T_obj_ee, T_world_ee)] for order in ORDERS)

    def times(T: Tensor, change: Tensor) -> Tensor:
        return se3.matmul(T, change.to(T).expand_as(T))

    from_flange = (times(T_obj_ee, T_flange_ee), times(T_world_ee, T_flange_ee))
    found: dict[str, Poses] = {
        "T_obj_ee inverted: it is the ee in the object's frame": (inverse_grasp, T_world_ee),
        "T_world_ee inverted: it is the ee in the world frame": (T_obj_ee, inverse_handover),
        "both poses inverted: T_a_b is b in the frame of a": (inverse_grasp, inverse_handover),
        "T_world_ee times T_obj_ee: T_world_ee is the ee's pose, not the object's": (
            T_obj_ee,
            se3.matmul(T_world_ee, T_obj_ee),
        ),
        f"T_world_ee taken from the hand's frame into the world: T_world_hand times the pose given {FRAME_HAND}": (
            T_obj_ee,
            se3.matmul(T_world_hand.to(T_world_ee), T_world_ee),
        ),
        f"T_world_ee {FLANGE}": (T_obj_ee, from_flange[1]),
        f"T_obj_ee {FLANGE}": (from_flange[0], T_world_ee),
        f"both poses {FLANGE}": from_flange,
        "T_obj_ee and T_world_ee exchanged": (T_world_ee, T_obj_ee),
        "T_world_ee mirrored in y: the world is right-handed, z up, x towards the receiver": (
            T_obj_ee,
            _mirrored(T_world_ee),
        ),
        f"the rotations of both poses transposed: {COLUMNS}": (
            _transposed(T_obj_ee),
            _transposed(T_world_ee),
        ),
        f"the rotation of T_obj_ee transposed: {COLUMNS}": (_transposed(T_obj_ee), T_world_ee),
        f"the rotation of T_world_ee transposed: {COLUMNS}": (T_obj_ee, _transposed(T_world_ee)),
        f"quaternions read as x, y, z, w instead of w, x, y, z: {XYZW}": (xyzw[0], xyzw[1]),
        f"quaternions read as w, x, y, z instead of x, y, z, w: {WXYZ}": (wxyz[0], wxyz[1]),
    }
    for degrees in (180, 90, -90):
        words = f"T_world_ee turned by {degrees} degrees about z: another base of the robot"
        if degrees == 180:
            words += f", as a UR's pendant has it {FRAME_BASE}"
        turned = _turn("z", degrees).to(T_world_ee).expand_as(T_world_ee)
        found[words] = (T_obj_ee, se3.matmul(turned, T_world_ee))
    words = "T_world_ee turned by 90 degrees about x: the world's z points up, not its y"
    upright = _turn("x", 90).to(T_world_ee).expand_as(T_world_ee)
    found[words] = (T_obj_ee, se3.matmul(upright, T_world_ee))
    for read, turn in (
        ("x read as z", ("y", 90)),
        ("-z read as z", ("x", 180)),
        ("x read as y", ("z", -90)),
    ):
        turned = _turn(*turn)
        found[f"the gripper's {read}: {AXES}"] = (
            times(T_obj_ee, turned),
            times(T_world_ee, turned),
        )
    for unit, of_metre, word in (("millimetres", 1000.0, "mm"), ("centimetres", 100.0, "cm")):
        small = [_shrunk(T, of_metre) for T in (T_obj_ee, T_world_ee)]
        told = f"({declaration('length_unit', word)})"
        found[f"lengths read as {unit}: they are in metres {told}"] = (small[0], small[1])
        found[f"T_world_ee read in {unit}: it is in metres"] = (T_obj_ee, small[1])
        found[f"T_obj_ee read in {unit}: it is in metres"] = (small[0], T_world_ee)
    return found


def _transposed(T: Tensor) -> Tensor:
    """The poses with transposed rotations, where they are."""
    return se3.from_rotation(T[:, :3, :3].transpose(1, 2), T[:, :3, 3])


def _mirrored(T: Tensor) -> Tensor:
    """The poses of a world whose y points the other way."""
    sign = torch.tensor([1.0, -1.0, 1.0], dtype=T.dtype, device=T.device)
    return se3.from_rotation(T[:, :3, :3] * sign[:, None] * sign, T[:, :3, 3] * sign)


def other_rows(trial_id: Tensor) -> dict[str, Tensor]:
    """Which row's answer each row takes, (B,), where answers stand in another order: its words -> rows. Nothing where a
    trial has several rows.

    Args:
        trial_id: (B,) of the trials in the order in which they were given.
    """
    n, ids = len(trial_id), trial_id.cpu()
    order = torch.argsort(ids)
    if n < ROWS or (ids[order][1:] == ids[order][:-1]).any():
        return {}
    place = torch.arange(n, dtype=torch.int64, device="cpu")
    found = {
        "each answer given for the trial after its own": (place + 1).clamp(max=n - 1),
        "each answer given for the trial before its own": (place - 1).clamp(min=0),
    }
    if not torch.equal(order, place):
        rank = torch.argsort(order)
        found["answers in the order of trial_id: they are in the order of the trials"] = rank
        at = torch.searchsorted(ids[order], place).clamp(max=n - 1)
        known = ids[order][at] == place  # trial ids that count the rows: 0, 1, 2, ...
        if known.sum() >= ROWS:
            found["trial_id counted through: it is trials.trial_id"] = torch.where(
                known, order[at], place
            )
    return {words: rows.to(trial_id.device) for words, rows in found.items()}


def _turn(axis: str, degrees: float) -> Tensor:
    """(4, 4) a turn about an axis."""
    from scipy.spatial.transform import Rotation  # 0.4 s, where a hint is looked for

    T = torch.eye(4, dtype=torch.float32, device="cpu")
    R = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    T[:3, :3] = torch.from_numpy(R.astype(np.float32))
    return T


FRAME_HAND, FRAME_BASE = (f"({declaration('frame', word)})" for word in ("hand", "base"))
XYZW, WXYZ = (
    f"{declaration('quaternion_order', word)}, with poses of 7 numbers" for word in ("xyzw", "wxyz")
)
COLUMNS = "its columns are the ee's axes"
AXES = "z points out of the gripper, and y is the axis along which it closes"
FLANGE = "times T_flange_ee: the ee is the TCP between the fingertips, not the flange"
ORDERS = ((3, 0, 1, 2), (1, 2, 3, 0))
"""Which numbers of a rotation's quaternion (x, y, z, w) are the true x, y, z, w: it was written as x, y, z, w and read
as w, x, y, z; written as w, x, y, z and read as x, y, z, w."""


def _shrunk(T: Tensor, of_metre: float) -> Tensor:
    """The poses with lengths in a unit, of which a metre has so many, as metres."""
    return se3.from_rotation(T[:, :3, :3], T[:, :3, 3] / of_metre)


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
    scene: Scene,
    judge: Callable[[Tensor, Tensor, Trials], Scores],
    resting: Callable[[Trials], Tensor] | None = None,
) -> str | None:
    """One line about poses that all fail and of which some succeed in another convention; None: nothing is found.

    Args:
        scores: verdicts of the B rows.
        T_obj_ee: (B, 4, 4) grasps, m.
        T_world_ee: (B, 4, 4) handover poses, m.
        trials: B trials.
        scene: of the trials.
        judge: judges poses of trials, at least at the handover.
        resting: says where the objects of trials rest (T_world_obj, m), where the benchmark begins at the table.
    """
    if (words := _in_the_hand(scores, T_world_ee, trials, scene)) is not None:
        return words
    rows = _sample(scores)
    if rows is None:
        return None
    given = (T_obj_ee[rows], T_world_ee[rows])
    T_flange_ee = torch.from_numpy(np.array(scene.robot.T_flange_ee))  # a copy: it is read-only
    others = other_poses(*given, trials.T_world_hand[rows], T_flange_ee)
    if resting is not None:
        there = se3.inverse(resting(trials[rows]).to(given[0]))
        words = "T_obj_ee taken from the world into the object's frame: inverse(T_world_obj) times the grasp on the table"
        others[words] = (se3.matmul(there, given[0]), given[1])
    others |= _moved(*given, trials[rows], scene)
    for words, taken in other_rows(trials.trial_id).items():
        others[words] = (T_obj_ee[taken[rows]], T_world_ee[taken[rows]])
    grasps, handovers = zip(given, *others.values(), strict=True)
    times = torch.arange(len(rows), dtype=torch.int64, device=rows.device).repeat(1 + len(others))
    found = judge(torch.cat(grasps), torch.cat(handovers), trials[rows][times])
    return _best(scores, found, tuple(others), len(rows))


def _moved(T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, scene: Scene) -> dict[str, Poses]:
    """The handover poses brought to the hands by one move of the world's origin, where all lie far from them; else nothing."""
    center = scene.palm(trials.hand_index, trials.T_world_hand)[2].to(T_world_ee)
    move = (center - T_world_ee[:, :3, 3]).median(0).values
    if not AWAY_M < float(move.norm()) < MOST_MOVE_M:
        return {}
    moved = T_world_ee.clone()
    moved[:, :3, 3] += move
    x, y, z = (round(v, 1) + 0.0 for v in move.tolist())
    words = f"T_world_ee moved by about ({x:g}, {y:g}, {z:g}) m: the world's origin is at the robot's base"
    return {words: (T_obj_ee, moved)}


def _in_the_hand(scores: Scores, T_world_ee: Tensor, trials: Trials, scene: Scene) -> str | None:
    """One line where no row succeeds and all TCPs lie in the hand; None: they do not."""
    valid = scores.outcome != int(Outcome.INVALID_INPUT)
    T = trials.T_world_hand.to(T_world_ee)
    palm = scene.palm(trials.hand_index, T)[0]
    tcp = T_world_ee[valid, :3, 3]
    apart = {
        "at the hand's pose (trials.T_world_hand, true or estimated)": (tcp - T[valid, :3, 3]).norm(
            dim=1
        ),
        "at the palm (scene.palm, true or estimated)": (tcp - palm[valid]).norm(dim=1),
    }
    place = min(apart, key=lambda k: float(apart[k].sum()))
    if len(tcp) < ROWS or scores.success.any() or not (apart[place] < AT_HAND_M).all():
        return None
    return (
        f"T_world_ee lies {place} in all {len(tcp)} rows: it is where the gripper's TCP goes,"
        " as a rule 12 to 15 cm in front of the palm"
    )


def motion_hint(
    scores: Scores,
    q: Tensor,
    time_s: Tensor,
    judge: Callable[[Any, Tensor, Tensor], Scores],
    robot: Robot,
) -> str | None:
    """One line about motions that all fail, or last long, and succeed in other units or as differences, or begin at home with
    the joints in another order, in turns or shifted by half turns; None: nothing is found.

    Args:
        scores: verdicts of the B rows.
        q: (B, W, joints) as given, rad.
        time_s: (B, W) or (W,) as given, s.
        judge: judges some of the B rows with other angles and times.
        robot: whose joints they are.
    """
    if (words := _order_of_joints(scores, q, robot)) is not None:
        return words
    ended = time_s[..., -1].expand(len(q))
    median = float(ended.double().median()) if len(q) >= ROWS else 0.0
    long = SLOW_S < median < math.inf
    rows = _eight(scores)
    if rows is not None:
        time = time_s if time_s.ndim == 1 else time_s[rows]
        degrees = declaration("angle_unit", "deg")
        name, unit = f"q read as degrees: angles are in radians ({degrees})", 1.0
        if long and (known := _unit_of_time(median)):
            name = f"q read as degrees and time_s as {known[0]}: rad and s are the units ({degrees}, time_unit={known[2]})"
            unit = 1 / known[1]
        given = q[rows].double()
        home = torch.tensor(robot.home_q, dtype=torch.float64, device=q.device)
        others = {
            name: given * (math.pi / 180),
            "q read as differences between samples, from home on: q has the angles themselves": home
            + given.cumsum(1),
        }
        parts = [judge(rows, q[rows], time)]
        parts += [judge(rows, o.to(q.dtype), time * unit) for o in others.values()]
        words = _best(scores, Scores.concatenate(parts), tuple(others), ROWS)
        most = float(q.abs().flatten(1).amax(1).double().median())
        if words is None and TURNED_RAD < most < math.inf:
            words = (
                f"the median motion has an angle of {most:.0f} rad, {most / (2 * math.pi):.0f} turns: angles are in radians"
                f" ({degrees})"
            )
        return words
    if not long:
        return None
    if (known := _unit_of_time(median)) is None:
        return None
    rows = torch.arange(ROWS, dtype=torch.int64, device=q.device)
    word, of_second, declared = known
    found = judge(rows, q[rows], (time_s if time_s.ndim == 1 else time_s[rows]) / of_second)
    if not (found.passed.sum(1) >= scores.passed[rows].sum(1)).all():
        return None
    return (
        f"the median motion lasts {median:.0f} s; with time_s read as {word} it lasts {median / of_second:.1f} s and"
        f" {ROWS} of {ROWS} rows pass as many criteria: times are in seconds ({declaration('time_unit', declared)})"
    )


def _unit_of_time(median: float) -> tuple[str, float, str] | None:
    """The unit, how many make a second, and its word in a file, with which the median motion lasts as long as motions do."""
    for unit in UNITS_OF_TIME:
        if USUAL_S[0] <= median / unit[1] <= USUAL_S[1]:
            return unit
    return None


def _order_of_joints(scores: Scores, q: Tensor, robot: Robot) -> str | None:
    """One line where most motions fail, none begins at home, and all end there, or do with the joints in another order, in
    turns or shifted by half turns."""
    if len(q) < ROWS or 2 * int(scores.success.sum()) > len(q):
        return None
    names, home = robot.joints, torch.tensor(robot.home_q, dtype=torch.float64, device="cpu")
    first = q[:, 0].double().cpu()
    alphabetical = sorted(range(len(names)), key=lambda k: names[k])
    near = first.median(0).values
    sorted_alike = torch.empty(len(names), dtype=torch.int64, device="cpu")
    sorted_alike[near.argsort()] = home.argsort()
    if (first - home).abs().amax(1).min() < AT_HOME_RAD:
        return None
    if (q[:, -1].double().cpu() - home).abs().amax(1).max() < AT_HOME_RAD:
        return f"all {len(q)} motions end at home, and none begins there: a motion leads from home to the handover"
    for order in (alphabetical, sorted_alike.tolist()):  # column k holds joint order[k]
        if (first - home[order]).abs().amax(1).max() < AT_HOME_RAD:
            read = ", ".join(names[k] for k in order)
            why = " (the alphabet's, as in /joint_states)" if order == alphabetical else ""
            return (
                f"all {len(q)} motions begin at home with q read in the order {read}{why}; the order is {', '.join(names)}:"
                f" {declaration('joint_names', 'the names of the columns')}"
            )
    if (first * (2 * math.pi) - home).abs().amax(1).max() < AT_HOME_RAD:
        return f"all {len(q)} motions begin at home with q read as turns (1 is 360 degrees): angles are in radians"
    turns = ((near - home) / math.pi).round()  # half ones
    if (first - home - math.pi * turns).abs().amax(1).max() < AT_HOME_RAD:
        shifted = ", ".join(f"{n} {180 * k:+.0f}" for n, k in zip(names, turns.tolist()) if k)
        return (
            f"all {len(q)} motions begin at home but for whole half turns ({shifted} degrees): take them out, the robot's"
            " zero is that of its URDF"
        )
    return None


def _sample(scores: Scores) -> Tensor | None:
    """Rows that are judged again, where so many fail that another convention could be told from chance."""
    valid = scores.outcome != int(Outcome.INVALID_INPUT)
    judged = scores[valid]
    n, succeed = len(judged), int(judged.success.sum())
    # of few rows: where all fail the same criterion
    if n < ROWS or (n < 2 * ROWS and not succeed and not failing(judged).any()):
        return None
    if 4 * succeed > 3 * n:  # no quarter of them could be won
        return None
    rows = torch.nonzero(valid)[:, 0]
    chosen = torch.linspace(0, n - 1, min(n, SAMPLE), dtype=torch.float64, device="cpu").long()
    return rows[chosen.to(rows.device)]


def _eight(scores: Scores) -> Tensor | None:
    """The first rows that can be judged, where no row succeeds; of few rows: where all fail the same criterion."""
    valid = scores.outcome != int(Outcome.INVALID_INPUT)
    judged = scores[valid]
    enough = len(judged) >= 2 * ROWS and not judged.success.any()
    if len(judged) < ROWS or not (enough or failing(judged).any()):
        return None
    return torch.nonzero(valid)[:ROWS, 0]


def _best(scores: Scores, found: Scores, names: Sequence[str], n: int) -> str | None:
    """The line about the conventions in which most rows succeed: `found` has the n rows as given, then those of
    each name."""
    valid = scores[scores.outcome != int(Outcome.INVALID_INPUT)]
    succeed = found.success.reshape(1 + len(names), n).sum(1).tolist()
    given, others = succeed[0], succeed[1:]
    most = max(others)
    far = most >= TIMES * given or TIMES * (n - most) <= n - given
    if not far or most - given < max(LEAST, n // 4):
        return None
    # What is right and one that a symmetry makes as good are both said: which of them is meant, the user knows.
    best = sorted(range(len(names)), key=lambda k: -others[k])
    said = []
    for k in (k for k in best[:2] if others[k] - given >= max(LEAST, most - given - 1)):
        name, _, meaning = names[k].partition(": ")
        said.append(f"{others[k]} of {n} pass with {name}{f': {meaning}' if meaning else ''}")
    alike = failing(valid).tolist()
    words = " and ".join(name for name, of in zip(scores.criteria, alike, strict=True) if of)
    fail = f"all {len(valid)} rows fail{f' {words}' if words else ''}"
    if passing := int(valid.success.sum()):
        fail = f"{passing} of {len(valid)} rows succeed; at the handover {given} of {n} pass as they are given"
    return f"{fail}; {'; '.join(said)}"
