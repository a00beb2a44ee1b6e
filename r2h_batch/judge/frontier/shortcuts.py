"""Shortcuts level by level (kernels/frontier/shortcuts.py): as a GPU makes paths shorter, several changes of
each at once."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from r2h_batch.judge.frontier.levels import PER_ROW, Frontier
from r2h_batch.kernels.frontier.arcs import LANES, Arcs, Paths, draw_arcs
from r2h_batch.kernels.frontier.queues import Edges
from r2h_batch.kernels.frontier.shortcuts import begin_shortcuts, take_arcs
from r2h_batch.kernels.plan.codes import WAYPOINTS

ROUNDS_OF_LINES, TRIES_A_ROUND = 2, 4
"""Rounds: so many, and one more for every so many tries that one thread would have."""
LEVELS_A_ROUND, LEVELS_MORE = 6, 15
"""Waves: so many for each round, and so many besides. A path whose edges take longer has fewer
rounds."""
LANES_AT_ONCE = 1 << 16
"""Lanes of one launch: of more paths some come after others."""
ROOM = 12
"""Intervals that a queue has room for, for each lane."""


@dataclass(frozen=True)
class Law:
    """Up to how many times the time between its ends a path is left as it is; the pace that times it."""

    enough: float
    pace: Any


def shorten_by_frontier(
    frontier: Frontier, rows: Int32[Tensor, " r"], law: Law, tries: int, seed: int, key: Int32[Tensor, " b"],
    margin: Float32[Tensor, " b"], path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"],
) -> None:  # fmt: skip
    """Shortcuts on the paths that `rows` have, in place; what comes of a path does not depend on
    the others.

    Certified with the same `margin` to the hand as their edges are; a path never takes longer than
    before.
    """
    for part in rows.split(LANES_AT_ONCE // LANES):
        _Shortcuts(frontier, part)(
            law, tries, {"seed": seed, "key": key}, margin, {"path": path, "length": length}
        )


class _Shortcuts:
    def __init__(self, frontier: Frontier, rows: Tensor) -> None:
        n, device = len(rows), rows.device
        lanes = n * LANES
        self._all, self._n = frontier, n
        self._frontier = Frontier(
            **frontier.scene, device=frontier.device, rows=-(-lanes * ROOM // PER_ROW)
        )

        new, joints = self._frontier.new, frontier.joints
        copy = torch.empty((n, WAYPOINTS, joints), dtype=torch.float32, device=device)
        point = torch.empty((2 * lanes, joints), dtype=torch.float32, device=device)
        found = torch.empty(lanes, dtype=torch.int64, device=device)
        self._edges = new(Edges, 2 * lanes, {"found": found}, a=joints, b=joints)
        self._tables: dict[str, Any] = {
            "edges": self._edges,
            "paths": new(Paths, n, {"trial": rows, "copy": copy}, known=WAYPOINTS),
            "arcs": new(Arcs, lanes, {"point": point}),
        }
        self._state = self._tables["paths"].tensors["state"]

    def __call__(
        self, law: Law, tries: int, drawn: dict[str, Any], margin: Tensor, inout: dict[str, Tensor]
    ) -> None:
        frontier, n = self._frontier, self._n
        frontier.clear()
        frontier.ask(0, 0.0)
        frontier.launch(
            begin_shortcuts, n, self._tables | {"margin": margin, "length": inout["length"]}
        )
        rounds = ROUNDS_OF_LINES + -(-tries // TRIES_A_ROUND)
        pace = {"pace": law.pace}
        take = (
            self._tables
            | pace
            | {"rounds": rounds, "changes": int(tries > 0), "enough": law.enough}
        )
        draw = self._tables | pace | drawn | inout
        for level in range(LEVELS_A_ROUND * rounds + LEVELS_MORE):
            parity = level & 1
            frontier.launch(take_arcs, n, take, inout)
            if frontier.device == "cpu" and bool((self._state != 0).all()):
                break  # asking a GPU would wait for it; its empty levels take next to nothing
            frontier.launch_queued(
                draw_arcs, draw | {"parity": parity, "queue": frontier.intervals[parity]}
            )
            frontier.level(self._edges, parity, certify=1)
        frontier.note_full()
        self._all.full |= frontier.full  # asked at the end of planning
