"""The flats of two fingers' meshes that face each other: the pads of a gripper whose file names none."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError

Array = NDArray[np.float64]

FACING = np.cos(np.radians(3.0))
"""Least cosine between a flat's normal and the closing axis."""
FLAT_M = 0.4e-3
"""How uneven a flat may be."""
LARGE = 0.15
"""Part of the largest flat's area above which the innermost flat is the pad."""
LEAST_M = 2e-3
"""Least side of a pad."""
HALF_THICKNESS_M = 1e-3


class Window(NamedTuple):
    """Where pads are looked for, with the gripper closed: heights above the flange and a width, m."""

    low: float
    high: float
    width: float


class Pads(NamedTuple):
    """Two pads that mirror each other, gripper frame, closed."""

    face: float
    """distance of the faces from the middle plane, m"""
    half: Array
    """(3,) half sides"""
    height: float
    """of their middles"""
    proud: float
    """how far the fingers stand before the faces, m"""


def find_pads(fingers: tuple[Array, Array], window: Window | None, shown: str) -> Pads:
    """The two facing flats of a closed gripper.

    Args:
        fingers: triangles (F, 3, 3) of the finger at +y and of that at -y: x across, z along the fingers.
        window: where they are; None: wherever the innermost large flats are.
        shown: the file's name in messages.

    Raises:
        FileError: no flats face each other.
    """
    how = "give --pads=LOW,HIGH,WIDTH: heights above the flange and the width of the pads, gripper closed, m"
    found = []
    for sign, triangles in zip((1, -1), fingers, strict=True):
        mirrored = triangles * [1, sign, 1]  # the finger at +y, or its mirror image there
        if window is not None:
            least, most = mirrored.min(1), mirrored.max(1)
            beside = (np.abs(mirrored[:, :, 0]).min(1) > window.width / 2) & (
                least[:, 0] * most[:, 0] > 0
            )
            mirrored = mirrored[~beside & (least[:, 2] < window.high) & (most[:, 2] > window.low)]
        found.append(_flat(mirrored, sign))
    if None in found:
        raise FileError(f"{shown}: the fingers' meshes have no flats that face each other; {how}")
    one, other = (f for f in found if f is not None)
    low, high = np.maximum(one.low, other.low), np.minimum(one.high, other.high)
    face = (one.face + other.face) / 2
    if window is not None:
        low, high = (
            np.array([-window.width / 2, window.low]),
            np.array([window.width / 2, window.high]),
        )
    half_x = float(min(-low[0], high[0]))
    height = float(high[1] - low[1])
    if min(2 * half_x, height) < LEAST_M:
        raise FileError(
            f"{shown}: the flats of the fingers' meshes overlap by {2e3 * half_x:.1f} x {1e3 * height:.1f} mm; {how}"
        )
    half = np.array([half_x, HALF_THICKNESS_M, height / 2])
    nearest = min(
        _nearest(t * [1, s, 1], half_x, low[1], high[1])
        for s, t in zip((1, -1), fingers, strict=True)
    )
    return Pads(face, half, float(low[1] + high[1]) / 2, max(face - nearest, 0.0))


class _Flat(NamedTuple):
    face: float
    low: Array
    high: Array


def _flat(triangles: Array, sign: int) -> _Flat | None:
    """The innermost large flat that faces -y, triangles at +y."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal *= sign  # a mirror image turns triangles round
    area = np.linalg.norm(normal, axis=1) / 2
    facing = triangles[(area > 0) & (-normal[:, 1] / np.maximum(2 * area, 1e-30) > FACING)]
    if not len(facing):
        return None
    area = (
        np.linalg.norm(np.cross(facing[:, 1] - facing[:, 0], facing[:, 2] - facing[:, 0]), axis=1)
        / 2
    )
    y = facing[:, :, 1].mean(1)
    order = np.argsort(y)
    y, area, facing = y[order], area[order], facing[order]
    summed = np.concatenate([[0.0], np.cumsum(area)])
    end = np.searchsorted(y, y + FLAT_M, side="right")
    flat = (
        summed[end] - summed[np.arange(len(y))]
    )  # from each triangle on, as deep as a flat may be
    first = int(np.argmax(flat >= LARGE * flat.max()))
    own = slice(first, int(end[first]))
    corners = facing[own].reshape(-1, 3)[:, [0, 2]]
    return _Flat(float(np.average(y[own], weights=area[own])), corners.min(0), corners.max(0))


def _nearest(triangles: Array, half_x: float, low: float, high: float) -> float:
    """The least y of corners before a pad."""
    points = triangles.reshape(-1, 3)
    before = (np.abs(points[:, 0]) <= half_x) & (low <= points[:, 2]) & (points[:, 2] <= high)
    return float(points[before, 1].min()) if before.any() else np.inf
