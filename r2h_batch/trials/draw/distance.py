"""Squared distances (m^2, float64) of many points: the same sums in the same order wherever trials
are drawn."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def from_box(low: Array, high: Array, point: Array) -> Array:
    """Squared distance of points (n, 3) to a box."""
    d = np.maximum(np.maximum(low - point, point - high), 0.0)
    return np.asarray(d[:, 0] ** 2 + d[:, 1] ** 2 + d[:, 2] ** 2)


def from_segment(a: Array, b: Array, point: Array) -> Array:
    """Squared distance of points (n, 3) to the segment a b: the bits of `from_segments`, without a copy of the segment
    for each point."""
    d = b - a
    length = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    x, y, z = (point[:, i] - a[i] for i in range(3))
    if length > 0:
        t = np.clip((x * d[0] + y * d[1] + z * d[2]) / length, 0.0, 1.0)
        x, y, z = (v - t * d[i] for i, v in enumerate((x, y, z)))
    return np.asarray(x * x + y * y + z * z)


def from_segments(a: Array, b: Array, point: Array) -> Array:
    """Squared distance of points (3, n, V) to one segment a b (n, 3) for each row."""
    d = b - a
    length = d[:, 0] ** 2 + d[:, 1] ** 2 + d[:, 2] ** 2
    x, y, z = (point[i] - a[:, i, None] for i in range(3))
    if length.any():
        t = x * d[:, 0, None] + y * d[:, 1, None] + z * d[:, 2, None]
        t = np.clip(t / np.where(length > 0, length, 1.0)[:, None], 0.0, 1.0)
        x, y, z = (v - t * d[:, i, None] for i, v in enumerate((x, y, z)))
    return np.asarray(x * x + y * y + z * z)
