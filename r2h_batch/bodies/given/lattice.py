"""The points at which manifold3d asks a field, asked once, near the surface only; and the solid
where a field is positive."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.bodies.solid import Surface

__all__ = ["Lattice"]

STRIDE = 4
NEAR = 2.5
"""Pitches from the surface within which the distance is exact; farther off only its sign counts."""

TRIES = 5
CHILD = """
import io, sys
import numpy as np
from manifold3d import Manifold
with np.load(io.BytesIO(sys.stdin.buffer.read())) as given:
    value = iter(given["field"].tolist())
    bounds, pitch = [*given["low"], *given["high"]], float(given["pitch"])
mesh = Manifold.level_set(lambda *_: next(value), bounds, pitch).to_mesh64()
out = io.BytesIO()
np.savez(out, vertices=np.asarray(mesh.vert_properties)[:, :3], faces=np.asarray(mesh.tri_verts))
sys.stdout.buffer.write(out.getvalue())
"""


class Lattice:
    """manifold3d's body-centred cubic lattice around bounds, three pitches to spare on each
    side."""

    def __init__(self, bounds: NDArray[np.float64], pitch: float) -> None:
        from manifold3d import Manifold

        self.pitch = pitch
        self.low, self.high = bounds[0] - 3 * pitch, bounds[1] + 3 * pitch
        seen: list[float] = []
        note = seen.extend

        def record(*point: float) -> float:
            note(point)
            return -1.0

        Manifold.level_set(record, [*self.low, *self.high], pitch)
        self.points = np.array(seen).reshape(-1, 3)
        """(N, 3) in the order in which they are asked, the same every time"""

    def distance(
        self, surface: Surface, tick: Callable[[float], None]
    ) -> tuple[NDArray[np.float64], float]:
        """(N,) signed distance, exact to `NEAR` pitches from the surface, beyond that +-`NEAR`
        pitches; and how far at least inside and outside meet off the surface (an opening's width,
        0: perhaps nowhere).

        Distances change by no more than one goes: a point nearer than `NEAR` pitches is next to a
        node of a coarse grid that is nearer than that and half the grid's diagonal. Only such
        points are asked. The others have the sign of that node, unless it is so near to the surface
        that it may lie beyond.
        """
        step = STRIDE * self.pitch
        shape = np.ceil((self.points.max(axis=0) - self.low) / step).astype(np.int64) + 1
        grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(
            -1, 3
        )
        coarse = surface.signed(self.low + step * grid, tick)[0].reshape(shape)
        cell = np.round((self.points - self.low) / step).astype(np.int64)
        near = coarse[tuple(cell.clip(0, shape - 1).T)]
        most = NEAR * self.pitch
        half = step * 3**0.5 / 2 * (1 + 1e-5)
        ask = np.flatnonzero(np.abs(near) <= most + half)
        close = surface.within(self.points[ask], most, tick)[1] >= 0
        ask = ask[close | (np.abs(near[ask]) <= half - most)]
        value = np.where(near > 0, most, -most)
        value[ask] = surface.signed(self.points[ask], tick)[0].clip(-most, most)
        return value, _opening(coarse, step)

    def solid(self, field: NDArray[np.float64]) -> tuple[Any, float]:
        """manifold3d's solid where the field (N,) is positive, None where that library fails on it
        every time; and by how much (m) its surface was moved out for that.

        manifold3d 3.5.4 ends its process on some fields with walls of one or two pitches, by chance
        or always. So it works in a process of its own, and what failed is asked again for a surface
        a tenth of a pitch farther out.
        """
        from manifold3d import Manifold, Mesh64

        for attempt in range(TRIES):
            out, data = attempt * 0.1 * self.pitch, io.BytesIO()
            np.savez(data, field=field + out, low=self.low, high=self.high, pitch=self.pitch)
            done = subprocess.run(
                [sys.executable, "-c", CHILD],
                input=data.getvalue(),
                capture_output=True,
                check=False,
            )
            if done.returncode == 0:
                with np.load(io.BytesIO(done.stdout)) as found:
                    return Manifold(Mesh64(found["vertices"], found["faces"])), out
        return None, 0.0


def _opening(coarse: NDArray[np.float64], step: float) -> float:
    """Between neighbours of two signs that are together farther from the surface than from each
    other the sign changes where there is no surface, that far off it at least."""
    least = 0.0
    for axis in range(3):
        a, b = np.moveaxis(coarse, axis, 0)[:-1], np.moveaxis(coarse, axis, 0)[1:]
        free = (np.abs(a) + np.abs(b) - step) / 2
        least = max(least, float(np.where(a * b < 0, free, 0.0).max(initial=0.0)))
    return least
