"""Shortcuts in waves (kernels/wave/shortcuts.py): as a GPU makes paths shorter, several changes of
each at once."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from r2h_batch.judge.wave.waves import PER_ROW, Waves
from r2h_batch.kernels.plan.codes import WAYPOINTS
from r2h_batch.kernels.wave.arcs import LANES, Arcs, Paths, draw_arcs
from r2h_batch.kernels.wave.queues import Edges
from r2h_batch.kernels.wave.shortcuts import begin_shortcuts, take_arcs
from r2h_batch.launch.arguments import struct_of

ROUNDS_OF_LINES, TRIES_A_ROUND = 2, 4
"""Rounds: so many, and one more for every so many tries that one thread would have."""
WAVES_A_ROUND, WAVES_MORE = 6, 15
"""Waves: so many for each round, and so many besides. A path whose edges take longer has fewer
rounds."""
LANES_AT_ONCE = 1 << 16
"""Lanes of one launch: of more paths some come after others."""
ROOM = 12
"""Stretches that a queue has room for, for each lane."""


@dataclass(frozen=True)
class Law:
    """Up to how many times the time between its ends a path is left as it is; the speed and
    acceleration that time it."""

    enough: float
    speed: float
    acceleration: float


def shorten_in_waves(
    waves: Waves, rows: Int32[Tensor, " r"], law: Law, tries: int, seed: int, key: Int32[Tensor, " b"],
    margin: Float32[Tensor, " b"], path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"],
) -> None:  # fmt: skip
    """Shortcuts on the paths that `rows` have, in place; what comes of a path does not depend on
    the others.

    Certified with the same `margin` to the hand as their edges are; a path never takes longer than
    before.
    """
    for part in rows.split(LANES_AT_ONCE // LANES):
        _Shortcuts(waves, part)(
            law, tries, {"seed": seed, "key": key}, margin, {"path": path, "length": length}
        )


class _Shortcuts:
    def __init__(self, waves: Waves, rows: Tensor) -> None:
        n, device = len(rows), rows.device
        lanes = n * LANES
        self._all, self._n = waves, n
        self._waves = Waves(**waves.scene, device=waves.device, rows=-(-lanes * ROOM // PER_ROW))

        def new(*shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
            return torch.empty(shape, dtype=dtype, device=device)

        self._state = new(n)
        paths = {
            "trial": rows, "state": self._state, "rounds": new(n),
            "known": new(n, WAYPOINTS, dtype=torch.int64), "copy": new(n, WAYPOINTS, 6, dtype=torch.float32),
        }  # fmt: skip
        arcs = {x: new(lanes) for x in ("kind", "number", "lo", "hi", "n", "asking")}
        arcs |= {
            "point": new(2 * lanes, 6, dtype=torch.float32),
            "time": new(lanes, dtype=torch.float32),
        }
        edges = {x: new(2 * lanes) for x in ("trial", "owner", "left")} | {
            "a": new(2 * lanes, 6, dtype=torch.float32), "b": new(2 * lanes, 6, dtype=torch.float32),
            "hand_margin": new(2 * lanes, dtype=torch.float32), "found": new(lanes, dtype=torch.int64),
        }  # fmt: skip
        self._edges = struct_of(Edges, edges)
        self._tables: dict[str, Any] = {
            "edges": self._edges,
            "paths": struct_of(Paths, paths),
            "arcs": struct_of(Arcs, arcs),
        }

    def __call__(
        self, law: Law, tries: int, drawn: dict[str, Any], margin: Tensor, inout: dict[str, Tensor]
    ) -> None:
        waves, n = self._waves, self._n
        waves.clear()
        waves.ask(0, 0.0)
        waves.launch(
            begin_shortcuts, n, self._tables | {"margin": margin, "length": inout["length"]}
        )
        rounds = ROUNDS_OF_LINES + -(-tries // TRIES_A_ROUND)
        limits = {"speed": law.speed, "acceleration": law.acceleration}
        take = (
            self._tables
            | limits
            | {"rounds": rounds, "changes": int(tries > 0), "enough": law.enough}
        )
        draw = self._tables | limits | drawn | inout
        for wave in range(WAVES_A_ROUND * rounds + WAVES_MORE):
            parity = wave & 1
            waves.launch(take_arcs, n, take, inout)
            if waves.device == "cpu" and bool((self._state != 0).all()):
                break  # asking a GPU would wait for it; its empty waves take next to nothing
            waves.launch_queued(
                draw_arcs, draw | {"parity": parity, "queue": waves.stretches[parity]}
            )
            waves.wave(self._edges, parity, certify=1)
        waves.note_full()
        self._all.full |= waves.full  # asked at the end of planning
