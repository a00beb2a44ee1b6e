"""What a file says about its own numbers: the frame of its poses, its units, the order of its joints and quaternions.

A file may declare each of `DECLARED`. What it declares is converted to ours; what it does not declare is ours. A declared
word that the numbers contradict is refused: with another allowed word they would be what they are said to be.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.read import printable

Array = NDArray[Any]

FRAMES = ("world", "base_link", "base", "hand")
"""Of poses that are ours in the world: world and ROS 2's base_link are the same; base is the frame of a UR's pendant, turned
by half a turn about z; hand is the trial's own hand (`trials.T_world_hand`)."""
LENGTH_UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "inch": 1 / 0.0254}
ANGLE_UNITS = ("rad", "deg")
TIME_UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
QUATERNION_ORDERS = {"wxyz": (1, 2, 3, 0), "xyzw": (0, 1, 2, 3)}
"""Which numbers are x, y, z, w."""

ALLOWED: Mapping[str, Collection[str]] = {
    "frame": FRAMES, "length_unit": LENGTH_UNITS, "angle_unit": ANGLE_UNITS, "time_unit": TIME_UNITS,
    "quaternion_order": QUATERNION_ORDERS,
}  # fmt: skip
DECLARED = (*ALLOWED, "joint_names")
"""All that a file may declare."""

OURS = {"frame": "world", "length_unit": "m", "angle_unit": "rad", "time_unit": "s"}
"""What is meant where a file says nothing, and what our files say."""

MOST_JOINTS, MOST_CHARS = 100, 200
UNIT = 1e-2
"""A quaternion whose length is so near 1 was rounded when it was written."""
Range = tuple[float, float]
FROM_BASE_M: tuple[Range, Range] = (0.15, 3.0), (0.35, 1.2)
OF_OBJECT_M: tuple[Range, Range] = (0.0, 1.0), (0.0, 0.3)
FROM_HAND_M: tuple[Range, Range] = (0.02, 1.0), (0.05, 0.4)
"""How far poses may lie from the robot's base, from the object's frame and from the hand's, as a median, and how far they
lie in a unit that is named instead [choice]."""
LASTS_S, USUAL_S = (0.05, 600.0), (0.5, 60.0)
"""How long a median motion may last in the unit that is declared, and in one that is named instead [choice]."""
DEGREES, RADIANS = 6.5, 12.6
"""A median motion whose largest angle is less is not in degrees; one whose largest is more, two turns, not in radians
[choice]."""


def ours(*names: str) -> dict[str, Any]:
    """Our own declarations of these names, as arrays of a file."""
    return {name: np.array(OURS[name]) for name in names}


def unit_of(distance: float) -> str:
    """The one unit in which a gripper's distance from the robot's base is a usual one; empty where none is, or several."""
    low, high = FROM_BASE_M[1]
    fitting = [unit for unit, n in LENGTH_UNITS.items() if low <= distance / n <= high]
    return fitting[0] if len(fitting) == 1 else ""


def declaration(name: str, value: str) -> str:
    """How a hint tells a user to declare a convention."""
    return f"a file may declare {name}={value}"


@dataclass(frozen=True)
class Declared:
    """What a file declares; an empty word: it does not say."""

    where: str = ""
    frame: str = ""
    length_unit: str = ""
    angle_unit: str = ""
    time_unit: str = ""
    quaternion_order: str = ""
    joint_names: tuple[str, ...] = ()

    def lengths(self, value: Array) -> Array:
        """Lengths in metres."""
        of_metre = LENGTH_UNITS[self.length_unit or "m"]
        convert = of_metre != 1.0 and _converts(value)
        return value.astype(np.float64) / of_metre if convert else value

    def angles(self, value: Array) -> Array:
        """Angles in radians."""
        convert = self.angle_unit == "deg" and _converts(value)
        return np.radians(value.astype(np.float64)) if convert else value

    def times(self, value: Array) -> Array:
        """Times in seconds; whole numbers are allowed where the unit is declared."""
        if self.time_unit and value.dtype.kind in "iu":
            value = value.astype(np.float64)
        of_second = TIME_UNITS[self.time_unit or "s"]
        convert = of_second != 1.0 and _converts(value)
        return value.astype(np.float64) / of_second if convert else value

    def poses(self, name: str, value: Array) -> Array:
        """Poses (N, 4, 4) in metres, of matrices or, where their order is declared, of x, y, z and a quaternion (N, 7)."""
        if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
            return value
        if value.ndim == 2 and value.shape[1] == 7:
            if not self.quaternion_order:
                raise FileError(
                    f"{self.where}: {name} has 7 numbers a row; declare quaternion_order: wxyz or xyzw"
                )
            ahead, behind = (
                np.abs((value[:, k : k + 4].astype(np.float64) ** 2).sum(1) - 1) < UNIT
                for k in (0, 3)
            )
            if ahead.any() and not (behind | ~ahead).any():
                raise FileError(
                    f"{self.where}: the first four of the 7 numbers of {name} are a quaternion, the last four are none; write x,"
                    " y, z first"
                )
            value = _matrices(value, QUATERNION_ORDERS[self.quaternion_order])
        elif self.quaternion_order:
            shape = " x ".join(map(str, value.shape))
            raise FileError(
                f"{self.where}: quaternion_order is {self.quaternion_order}, and {name} is {shape}, no quaternions; give"
                " N x 7 (x, y, z and the quaternion), or leave quaternion_order out"
            )
        if value.ndim != 3 or value.shape[1:] != (4, 4) or not _converts(value):
            return value
        if self.length_unit not in ("", "m"):
            value = value.astype(np.float64)
            value[:, :3, 3] = self.lengths(value[:, :3, 3])
        return value

    def in_world(self, value: Array) -> Array:
        """Poses (N, 4, 4) or points (..., 3) in the world, of `base` or a frame that is the world's."""
        if self.frame != "base" or not _converts(value):
            return value
        value = value.copy()
        if value.ndim == 3 and value.shape[1:] == (4, 4):
            value[:, :2] = 0.0 - value[:, :2]  # no negative zeros
        elif value.shape[-1] == 3:
            value[..., :2] = 0.0 - value[..., :2]
        return value

    def check_lengths(self, name: str, T: Array, far: tuple[Range, Range] = FROM_BASE_M) -> None:
        """Refuse a declared unit of length with which poses (N, 4, 4), now in metres, lie where none does.

        Args:
            name: of the poses.
            T: the poses, or points (N, ..., 3).
            far: how far they may lie from their frame's origin, and how far they usually do, m.
        """
        if not self.length_unit:
            return
        at = T[:, :3, 3] if T.ndim == 3 and T.shape[1:] == (4, 4) else T.reshape(-1, 3)
        with np.errstate(all="ignore"):
            distance = np.linalg.norm(at.astype(np.float64), axis=1)
        found = float(np.median(distance[np.isfinite(distance)])) if len(distance) else np.nan
        raw = found * LENGTH_UNITS[self.length_unit]
        fitting = _other(raw, self.length_unit, LENGTH_UNITS, *far)
        if fitting:
            raise FileError(
                f"{self.where}: length_unit is {self.length_unit}, and the median {name} then lies {found:.3g} m from the"
                f" origin of its frame; with {fitting} it lies {raw / LENGTH_UNITS[fitting]:.3g} m: declare the unit in which"
                " the numbers are"
            )

    def check_angles(self, name: str, q: Array, length: Array) -> None:
        """Refuse a declared unit of angles that the motions (S, joints), as they stand in the file, contradict."""
        if not self.angle_unit or not len(q):
            return
        first = (np.cumsum(length) - length)[length > 0]
        most = np.maximum.reduceat(np.abs(q.astype(np.float64)).max(1, initial=0.0), first)
        most = most[np.isfinite(most)]
        found = float(np.median(most)) if len(most) else np.nan
        if self.angle_unit == "deg" and 0.0 < found < DEGREES:
            what = f"of {name} has no angle beyond {found:.3g} degrees: radians?"
        elif self.angle_unit == "rad" and found > RADIANS:
            what = f"of {name} turns by {found:.3g} rad, {found / (2 * np.pi):.0f} turns: degrees?"
        else:
            return
        raise FileError(
            f"{self.where}: angle_unit is {self.angle_unit}, and the median motion {what} Declare the unit in which the"
            " numbers are, rad or deg"
        )

    def check_times(self, time_s: Array, length: Array) -> None:
        """Refuse a declared unit of time with which the motions, now in seconds, last as none does."""
        if not self.time_unit or not (length > 0).any():
            return
        found = _median_s(time_s, length)
        raw = found * TIME_UNITS[self.time_unit]
        fitting = _other(raw, self.time_unit, TIME_UNITS, LASTS_S, USUAL_S)
        if fitting:
            raise FileError(
                f"{self.where}: time_unit is {self.time_unit}, and the median motion then lasts {found:.3g} s; with {fitting}"
                f" it lasts {raw / TIME_UNITS[fitting]:.3g} s: declare the unit in which the numbers are"
            )

    def other_time_unit(self, time_s: Array, length: Array) -> str:
        """The unit in which motions would last as motions do, where none is declared and in seconds they do not; else empty.

        Args:
            time_s: (S,) of all samples.
            length: (N,) samples of each motion.
        """
        if self.time_unit or not (length > 0).any():
            return ""
        return _other(_median_s(time_s, length), "s", TIME_UNITS, LASTS_S, USUAL_S)


def _median_s(time_s: Array, length: Array) -> float:
    """How long the median motion lasts, of the times of all samples."""
    last = (np.cumsum(length) - 1)[length > 0]
    first = (np.cumsum(length) - length)[length > 0]
    return float(np.median(time_s[last] - time_s[first]))


def taken(arrays: dict[str, Any], where: str, allowed: Sequence[str] = DECLARED) -> Declared:
    """What a file declares; its arrays lose that.

    Args:
        arrays: of the file, by name. A word may stand alone or, in tables, in every row.
        where: the file, for messages.
        allowed: what this kind of file may declare.

    Raises:
        FileError: one line, if something else is declared, or the rows differ.
    """
    said: dict[str, Any] = {}
    for name in DECLARED:
        if name not in arrays:
            continue
        if name not in allowed:
            raise FileError(
                f"{where}: declares {name}, which nothing in this file has; allowed are {', '.join(allowed)}"
            )
        if name == "joint_names":
            said[name] = _joint_names(arrays.pop(name), where)
        else:
            said[name] = _word(arrays.pop(name), name, where)
    return Declared(where, **said)


def _word(value: Any, name: str, where: str) -> str:
    allowed = ", ".join(ALLOWED[name])
    if not isinstance(value, np.ndarray) or value.dtype.kind != "U" or value.ndim > 1:
        found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else "no text"
        raise FileError(f"{where}: {name} is {found}; it must be one word: {allowed}")
    words = np.unique(value)
    if len(words) != 1:
        listed = ", ".join(repr(printable(w)[:40]) for w in words[:3]) or "no word"
        raise FileError(
            f"{where}: {name} is {listed} in different rows; a file declares one word: {allowed}"
        )
    word = str(words[0])
    if word not in ALLOWED[name]:
        near = nearest(word, list(ALLOWED[name]))
        raise FileError(f"{where}: {name} is {printable(word)[:40]!r}{near}; allowed are {allowed}")
    return word


def _joint_names(value: Any, where: str) -> tuple[str, ...]:
    how = "it must be a list of texts, one for each column of q"
    if not isinstance(value, np.ndarray) or value.dtype.kind != "U" or value.ndim not in (1, 2):
        found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else "no list"
        raise FileError(f"{where}: joint_names is {found}; {how}")
    if value.ndim == 2:  # of a table: the same list in every row
        if not len(value) or (value != value[0]).any():
            raise FileError(f"{where}: joint_names differ between rows; a file has one order")
        value = value[0]
    names = tuple(map(str, value))
    if not 1 <= len(names) <= MOST_JOINTS or any(not 1 <= len(n) <= MOST_CHARS for n in names):
        raise FileError(
            f"{where}: joint_names has {len(names)} entries, or one without letters; {how}"
        )
    if twice := [n for n in names if names.count(n) > 1]:
        raise FileError(f"{where}: joint_names has {printable(twice[0])[:60]!r} twice; {how}")
    return names


def joint_columns(names: Sequence[str], joints: Sequence[str], where: str) -> list[int]:
    """Which column of a file holds each joint of a robot. Further names, such as a gripper's, are nobody's. All names may
    have one prefix before the robot's.

    Args:
        names: `joint_names` of the file.
        joints: of the robot, in its order.
        where: the file, for messages.

    Raises:
        FileError: a joint is not among the names.
    """
    if joints and not set(joints) <= set(names):
        ends = [n.removesuffix(joints[0]) for n in names if n.endswith(joints[0])]
        if len(ends) == 1 and {ends[0] + joint for joint in joints} <= set(names):
            return [names.index(ends[0] + joint) for joint in joints]
        missing = next(joint for joint in joints if joint not in names)
        shown = printable(", ".join(names))[:300]
        raise FileError(
            f"{where}: joint_names has no {missing}; it has {shown}, and the robot's joints are {', '.join(joints)}: name"
            " these, or the robot with --robot"
        )
    return [names.index(joint) for joint in joints]


def _converts(value: Any) -> bool:
    """Whether numbers are precise enough to be converted: the reader refuses the others as they are."""
    return isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.dtype.itemsize >= 4


def _matrices(value: Array, order: Sequence[int]) -> Array:
    """(N, 4, 4) poses of positions and quaternions (N, 7). What is no unit quaternion scales, as a matrix would."""
    T = np.zeros((len(value), 4, 4), np.float64 if value.dtype.itemsize >= 4 else value.dtype)
    x, y, z, w = (value[:, 3 + k].astype(np.float64) for k in order)
    square = x * x + y * y + z * z + w * w
    with np.errstate(all="ignore"):
        near = np.abs(square - 1.0) < UNIT
        x, y, z, w = (np.where(near, v / np.sqrt(square), v) for v in (x, y, z, w))
        T[:, 0, 0], T[:, 1, 1], T[:, 2, 2] = (
            w * w + x * x - y * y - z * z,
            w * w - x * x + y * y - z * z,
            w * w - x * x - y * y + z * z,
        )
        T[:, 0, 1], T[:, 1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
        T[:, 0, 2], T[:, 2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
        T[:, 1, 2], T[:, 2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    T[:, :3, 3], T[:, 3, 3] = value[:, :3], 1.0
    return T


def _other(
    raw: float,
    unit: str,
    units: Mapping[str, float],
    allowed: Range,
    usual: Range,
) -> str:
    """The unit in which a number is a usual one, where in its own it is not even allowed; empty: there is none."""
    if not np.isfinite(raw) or allowed[0] <= raw / units[unit] <= allowed[1]:
        return ""
    return next((u for u, n in units.items() if usual[0] <= raw / n <= usual[1]), "")
