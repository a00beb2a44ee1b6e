"""Limits of a user's mesh: its sizes, its time, and the one line that refuses a mesh beyond
them."""

from __future__ import annotations

import time

from r2h_batch.base.errors import UserError
from r2h_batch.base.io.log import LOG

MOST_BYTES = 1 << 30
"""Largest mesh file, and largest file that it names."""
MOST_GIVEN_FACES = 5_000_000
MOST_BODIES = 1000
"""Bodies that do not touch: more are a cloud of triangles, no object."""
REPAIRED = "mesh repaired: "
"""Begins what is said of a repair, once: when it is made."""
MOST_SECONDS = 60.0
"""CPU seconds for reading a file, and again for repairing what was in it."""
SILENT_SECONDS = 5.0
THINNEST_M = 1e-4
"""Mean thickness below which a closed body is a sheet: no nearer than this are float32 distances
trusted (`config.BORDERLINE_M`)."""


class ObjectMeshError(UserError):
    """A mesh that cannot become an object: what was given, what is allowed, what to do."""


class Budget:
    """CPU time of this process, kernels' workers too, for one mesh. `spend` between pieces of work: a
    line on stderr after 5 s and every 5 s from then on, an `ObjectMeshError` once the time is used
    up."""

    def __init__(self, label: str, seconds: float = MOST_SECONDS) -> None:
        self.label, self.seconds = label, seconds
        self._start, self._said = time.process_time(), time.monotonic()

    def spend(self, doing: str, share: float | None = None) -> None:
        """Say what is being done, and `share` (0 to 1) of it that is; refuse to go on when there is
        no time left."""
        used, now = time.process_time() - self._start, time.monotonic()
        part = "" if share is None else f" ({100 * share:.0f} %)"
        if used > self.seconds:
            raise ObjectMeshError(
                f"{self.label}: repairing the mesh takes more than {self.seconds:g} s of CPU time, which ran out while "
                f"{doing}{part}; decimate it or close its surface in a modelling tool"
            )
        if now - self._said > SILENT_SECONDS:
            self._said = now
            LOG.info(f"{self.label}: {doing}{part}, {used:.0f} s")
