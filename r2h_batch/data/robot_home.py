"""The posture from which an imported arm starts, and which way its flange should point."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.base.errors import FileError
from r2h_batch.config import Workplace
from r2h_batch.data.robot_chain import Chain
from r2h_batch.data.robot_pairs import Touching
from r2h_batch.scene.robot import Robot, ee_pose, forward_kinematics, frozen
from r2h_batch.scene.robot_file import DEFAULT_ROBOT, load_robot

Array = NDArray[np.float64]

STARTS, FEW_STARTS = 64, 16
"""From how many postures one is looked for with the gripper at its usual place, and at each other place."""
_TURNED, _DOWN, _TILTED = (0.0, np.pi / 2, -np.pi / 2, np.pi), 0.0, (np.pi / 4, np.pi / 2)
PLACES = (
    *((turn, 1.0, 0.0, _DOWN) for turn in _TURNED), *((turn, 1.0, 0.15, _DOWN) for turn in _TURNED),
    (0.0, 0.8, 0.15, _DOWN), (0.0, 0.8, 0.0, _DOWN), (0.0, 1.15, 0.15, _DOWN),
    *((turn, 1.0, up, tilt) for tilt in _TILTED for up in (0.0, 0.15) for turn in (0.0, np.pi / 2)),
)  # fmt: skip
"""Turn of the gripper about the vertical, rad; distance from the base, in parts of the usual one; height above the
usual place, in parts of the reach; turn forward from straight down, rad. In this order they are tried."""
DRAWN = 256
"""Postures in which a link may be in the table before the arm is refused."""
SAME_RAD = 0.05
STEPS, MOST_STEP_RAD, DIFFERENCE_RAD = 50, 0.5, 1e-6
"""Steps of the search for a posture, the largest one, and that of its differences."""
ACROSS = np.cos(np.radians(60.0))
"""Cosine between two directions below which one points across the other."""
LEAST_M = 1e-3
NO_TURN = "0,0,0,0,0,0"
TURNS = {
    "0,0,0,0,1.5708,0": (0, 1), "0,0,0,0,-1.5708,0": (0, -1), "0,0,0,-1.5708,0,0": (1, 1),
    "0,0,0,1.5708,0,0": (1, -1), NO_TURN: (2, 1), "0,0,0,3.1416,0,0": (2, -1),
}  # fmt: skip
"""`--offset` -> the axis of the link, and its sign, along which the flange's z points then."""


def check_clear_of_table(rods: Robot, table: Workplace, shown: str) -> None:
    """Refuse an arm of which a link is in the table at each of `DRAWN` postures: no search will find one.

    Args:
        rods: the arm as thin rods.
        table: where it stands.
        shown: the file, for the message.

    Raises:
        FileError: it names the link.
    """
    look, lower = Touching(rods, table), np.maximum(rods.lower, -np.pi)
    upper = np.minimum(rods.upper, np.pi)
    unit = _drawn(len(lower), DRAWN)
    always: set[str] | None = None
    for q in lower + (upper - lower) * unit:
        met = set(look(q))
        always = met if always is None else always & met
        if not always:
            return
    what = f"{min(always or ())} overlap in each of {DRAWN} postures drawn at random"
    how = "the frame of --base is the table's, so give a --base below this link"
    raise FileError(f"{shown}: {what}; {how}, as the torso or pedestal that carries the arm")


def usual_place(robot: Robot) -> Array:
    """(4, 4) the TCP at home: the UR5e's, moved in and down, or out and up, as the reach differs."""
    usual = load_robot(DEFAULT_ROBOT)
    goal = ee_pose(usual, usual.home_q)
    goal[:3, 3] *= robot.reach_m / usual.reach_m
    return np.asarray(goal)


def homes(robot: Robot) -> Iterator[tuple[float, ...]]:
    """Postures to start from: first at the usual place with the gripper straight down, the one of a UR or those nearest
    to the middle of the limits; then turned about the vertical, higher, nearer and farther, turned forward."""
    usual = load_robot(DEFAULT_ROBOT)
    goal = usual_place(robot)
    if robot.family == "ur":
        start, turns = np.array(usual.home_q)[None], np.full(len(usual.home_q), np.inf)
        yield from map(_rounded, _led_to(robot, goal, start, -turns, turns))
    for k, (turn, out, up, tilt) in enumerate(PLACES):
        at = goal.copy()
        about = Rotation.from_rotvec([0.0, -tilt, 0.0]) * Rotation.from_rotvec([0.0, 0.0, turn])
        at[:3, :3] = about.as_matrix() @ goal[:3, :3]
        at[:2, 3] *= out
        at[2, 3] += up * robot.reach_m
        yield from _postures(robot, at, STARTS if k == 0 else FEW_STARTS)


def first_home(robot: Robot, shown: str) -> tuple[float, ...]:
    """The first of `homes`.

    Raises:
        FileError: the arm has none.
    """
    found = next(homes(robot), None)
    if found is None:
        raise no_home(robot, shown)
    return found


def no_home(robot: Robot, shown: str) -> FileError:
    """The refusal of an arm without a posture to start from."""
    where = f"at {np.round(usual_place(robot)[:3, 3], 3).tolist()} m of --base or near it, pointing down or forward"
    how = "turn --flange by --offset until its z points away from the arm, or give --home"
    return FileError(f"{shown}: no posture has the gripper {where}; {how}")


def free_home(
    robot: Robot, table: Workplace, shown: str, meshes: Sequence[Array] = ()
) -> tuple[float, ...]:
    """The first of `homes` in which no links overlap, gripper open or closed.

    Args:
        robot: the arm with its bodies, or with rods that stand for them.
        table: where it stands.
        shown: the file, for the message.
        meshes: triangles (F, 3, 3) of each link, whose corners must keep out of the table too: any body covers them.

    Raises:
        FileError: in all of them some do.
    """
    bodies = Touching(robot, table)

    def look(q: Array) -> list[str]:
        return bodies(q) + [f"{name} and table" for name in _in_table(robot, table, meshes, q)]

    met: dict[str, int] = {}
    tried = 0
    for home in homes(robot):
        found = look(np.array(home))
        if not found:
            return home
        tried += 1
        for pair in found:
            met[pair] = met.get(pair, 0) + 1
    most = max(met, key=lambda pair: met[pair])
    what = f"{tried} postures with the gripper down or forward were tried: links overlap in each, most often {most}"
    raise FileError(f"{shown}: {what}; give one with --home, or turn --flange by --offset")


def _in_table(robot: Robot, table: Workplace, meshes: Sequence[Array], q: Array) -> list[str]:
    """The links with a corner in the table's box."""
    T, center, half = forward_kinematics(robot, q), np.array(table.table_center), table.table_half
    found = []
    for k in range(robot.table_from, len(meshes)):
        corners = meshes[k].reshape(-1, 3) @ T[k, :3, :3].T + T[k, :3, 3]
        if (np.abs(corners - center) < np.array(half)).all(1).any():
            found.append(robot.links[k])
    return found


def turn_of(robot: Robot, chain: Chain, *, any_way: bool = False) -> str:
    """The `--offset` that turns the flange's z away from the arm; "" where it points there, or none helps.

    Away is the last joint's axis, or from that joint to the flange. Where the flange lies nearer to the joint than the
    middle of the last link, it is from the joint before, along the axis, to that middle: a link may end in its flange, as
    a UR's, or begin there. An arm has a posture to start from with the z that is proposed.

    Args:
        robot: the arm.
        chain: its chain.
        any_way: propose one even where the z points away: the arm has no posture to start from with it.
    """
    T, middle = chain.T_last_flange, np.asarray(chain.links[-1].com)
    place = T[:3, 3]
    T_before_last = chain.T_parent_joint[-1]
    ahead = (
        T_before_last[:3, :3].T @ T_before_last[:3, 3] * [0.0, 0.0, 1.0]
    )  # along the axis: the rest turns with it
    way = ahead + middle if np.linalg.norm(place) < np.linalg.norm(middle) else place
    axis_z, length = np.array([0.0, 0.0, 1.0]), float(np.linalg.norm(way))
    away = [axis_z, -axis_z]  # where the file says neither place nor masses
    if length > LEAST_M:
        away = [axis_z * (-1.0 if way[2] < 0 else 1.0), way / length]

    def along(turn: str, ways: Sequence[Array] = away) -> float:
        axis, sign = TURNS[turn]
        return max(float(sign * T[:3, axis] @ one) for one in ways)

    if along(NO_TURN) > ACROSS and not any_way:
        return ""
    # where both are proposed alike, the place: a wrist may end in a joint across it
    order = {
        turn: (-round(along(turn), 2), -along(turn, away[-1:]), turn)
        for turn in TURNS
        if turn != NO_TURN
    }
    for turn in sorted(order, key=lambda turn: order[turn]):
        if along(turn) <= ACROSS:
            continue
        one = replace(
            robot, T_wrist3_flange=frozen(T @ turned(turn)), digest=f"{robot.digest} {turn}"
        )
        if next(homes(one), None) is not None:
            return turn
    return ""


def turned(offset: str) -> Array:
    """(4, 4) of an `--offset` of TURNS."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [float(x) for x in offset.split(",")[3:]]).as_matrix()
    T[:3, :3] = T[:3, :3].round()
    return T


def _postures(robot: Robot, goal: Array, starts: int) -> Iterator[tuple[float, ...]]:
    """Postures that differ, nearest to the middle of the limits first."""
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    unit = _drawn(len(lower), starts)
    led = _led_to(robot, goal, lower + (upper - lower) * unit, lower, upper)
    away = np.square((led - (lower + upper) / 2) / (upper - lower)).sum(1)
    found: list[Array] = []
    for q in led[np.argsort(away, kind="stable")]:
        if all(np.abs(q - other).max() > SAME_RAD for other in found):
            found.append(q)
            yield _rounded(q)


def _led_to(robot: Robot, goal: Array, q: Array, lower: Array, upper: Array) -> Array:
    """(K, N) the postures within limits with the TCP at a goal to which starts (B, N) lead: all starts at once, by
    Levenberg and Marquardt's steps, a joint at its limit held while it is pushed out."""
    eye, n = np.eye(q.shape[1]), q.shape[1]

    def off(at: Array) -> Array:
        return (ee_pose(robot, at) - goal)[:, :3].reshape(len(at), 12)

    q = np.clip(q, lower, upper)
    damping, r = np.full(len(q), 1e-2), off(q)
    for _ in range(STEPS):
        near = q[:, None] + DIFFERENCE_RAD * eye
        past = q[:, None] - DIFFERENCE_RAD * eye
        ahead, behind = (off(x.reshape(-1, n)).reshape(len(q), n, 12) for x in (near, past))
        J = (ahead - behind).transpose(0, 2, 1) / (2 * DIFFERENCE_RAD)
        slope = np.einsum("brn,br->bn", J, r)
        held = ((q <= lower) & (slope > 0)) | ((q >= upper) & (slope < 0))
        J = J * ~held[:, None]
        H = np.einsum("brn,brm->bnm", J, J) + damping[:, None, None] * eye
        step = np.linalg.solve(H, np.where(held, 0.0, slope)[..., None])[..., 0]
        new = np.clip(q - np.clip(step, -MOST_STEP_RAD, MOST_STEP_RAD), lower, upper)
        r_new = off(new)
        better = np.square(r_new).sum(1) < np.square(r).sum(1)
        q, r = np.where(better[:, None], new, q), np.where(better[:, None], r_new, r)
        damping = np.clip(np.where(better, damping / 5, damping * 4), 1e-12, 1e4)
    return q[np.abs(r).max(1) <= 1e-6]


def _drawn(joints: int, count: int) -> Array:
    """(count, joints) places in a unit cube: Halton's, without the corner."""
    from scipy.stats import qmc  # 0.5 s: an arm that is refused for its joints needs none

    return np.asarray(qmc.Halton(joints, scramble=False).random(count + 1)[1:])


def _rounded(q: Array) -> tuple[float, ...]:
    return tuple(np.round(q, 4).tolist())
