"""Shortcuts level by level (kernels/frontier/shortcuts.py): as a GPU makes paths shorter, several changes of
each at once."""

from typing import Any

import torch
from jaxtyping import Int32
from torch import Tensor

from r2h_batch.judge.frontier.levels import PER_ROW, Frontier
from r2h_batch.kernels.frontier.arcs import LANES, Arcs, Paths, draw_arcs
from r2h_batch.kernels.frontier.queues import Edges
from r2h_batch.kernels.frontier.shortcuts import begin_shortcuts, take_arcs
from r2h_batch.kernels.plan.codes import WAYPOINTS

ROUNDS_OF_LINES, TRIES_A_ROUND = 2, 4
"""Rounds: so many, and one more for every so many tries that one thread would have."""
LEVELS_A_ROUND, LEVELS_MORE = 6, 15
"""Levels: so many for each round, and so many besides. A path whose edges take longer has fewer
rounds."""
LANES_AT_ONCE = 1 << 16
"""Lanes of one launch: of more paths some come after others."""
ROOM = 12
"""Intervals that a queue has room for, for each lane."""


def shorten_by_frontier(
    trials_frontier: Frontier,
    rows: Int32[Tensor, " r"],
    shortcut_inputs: dict[str, Any],
    paths: dict[str, Tensor],
) -> None:
    """Shortcuts on the paths that `rows` have, in place; what comes of a path does not depend on
    the others.

    Certified with the same margin to the hand as their edges are; a path never takes longer than
    before.

    Args:
        trials_frontier: of all trials.
        rows: problems.
        shortcut_inputs: inputs of plan/shortcut.py `shortcut` by name.
        paths: `path` and `length` of all trials.
    """
    rounds = ROUNDS_OF_LINES + -(-shortcut_inputs["tries"] // TRIES_A_ROUND)
    shortcut_inputs = shortcut_inputs | {
        "rounds": rounds,
        "changes": int(shortcut_inputs["tries"] > 0),
    }
    for part in rows.split(LANES_AT_ONCE // LANES):
        _shorten(trials_frontier, part, shortcut_inputs, paths)


def _shorten(
    trials_frontier: Frontier,
    rows: Tensor,
    shortcut_inputs: dict[str, Any],
    inout: dict[str, Tensor],
) -> None:
    n, lanes, device = len(rows), len(rows) * LANES, rows.device
    frontier = Frontier(
        **trials_frontier.scene, device=trials_frontier.device, rows=-(-lanes * ROOM // PER_ROW)
    )
    joints = frontier.joints
    copy = torch.empty((n, WAYPOINTS, joints), dtype=torch.float32, device=device)
    point = torch.empty((2 * lanes, joints), dtype=torch.float32, device=device)
    found = torch.empty(lanes, dtype=torch.int64, device=device)
    edges = frontier.new(Edges, 2 * lanes, {"found": found}, a=joints, b=joints)
    paths = frontier.new(Paths, n, {"trial": rows, "copy": copy}, known=WAYPOINTS)
    arcs = frontier.new(Arcs, lanes, {"point": point})
    frontier.tables |= shortcut_inputs | inout | {"edges": edges, "paths": paths, "arcs": arcs}
    frontier.clear()
    frontier.ask(0, 0.0)
    frontier.launch(begin_shortcuts, n)
    for level in range(LEVELS_A_ROUND * shortcut_inputs["rounds"] + LEVELS_MORE):
        parity = level & 1
        frontier.launch(take_arcs, n, outputs=inout)
        if frontier.device == "cpu" and bool((paths.tensors["state"] != 0).all()):
            break  # asking a GPU would wait for it; its empty levels take next to nothing
        frontier.tables |= {"parity": parity, "queue": frontier.intervals[parity]}
        frontier.launch(draw_arcs, frontier.lanes)
        frontier.level(edges, parity, certify=1)
    frontier.note_full()
    trials_frontier.full |= frontier.full  # asked at the end of planning
