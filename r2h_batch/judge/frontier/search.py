"""RRT-Connect level by level (kernels/frontier/trees.py): the search as a GPU runs it, many lanes a
problem."""

from typing import Any

import torch
from jaxtyping import Int32
from torch import Tensor

from r2h_batch.judge.frontier.levels import PER_ROW, Frontier
from r2h_batch.kernels.frontier.queues import Edges
from r2h_batch.kernels.frontier.trees import (
    Growers,
    Trees,
    draw_targets,
    enter_edges,
    nearest_nodes,
    next_edges,
    plant_trees,
)

FEWEST, MOST = 16, 128
"""Lanes of a problem: an eighth of the iterations, between these. The more, the less each knows of
what the others find."""
LEVELS_A_TURN, LEVELS_MORE = 5, 60
"""Levels of a search: so many for each posture that a lane may draw, and so many besides."""
LANES_AT_ONCE = 1 << 17
"""Lanes of one launch: of more problems some come after others."""
ROOM = 6
"""Intervals that a queue has room for, for each lane."""


def connect_by_frontier(
    trials_frontier: Frontier,
    rows: Int32[Tensor, " r"],
    problem: dict[str, Any],
    found: dict[str, Tensor],
    nodes: int,
) -> None:
    """One search of those `rows` whose length is 0, as plan/rrt.py `rrt_connect` with certified
    edges; writes the paths found.

    Which postures are drawn, and what follows from them, does not depend on the other rows.

    Args:
        trials_frontier: of all trials.
        rows: problems.
        problem: inputs of `rrt_connect` by name.
        found: `path` and `length` of all trials.
        nodes: of all trees at once.
    """
    lanes = min(max(problem["iterations"] // 8, FEWEST), MOST)
    at_once = max(1, min(LANES_AT_ONCE // lanes, nodes // (2 * problem["capacity"])))
    for part in rows.split(at_once):
        _connect(trials_frontier, part, problem | {"lanes_each": lanes}, found)


def _connect(
    trials_frontier: Frontier, rows: Tensor, problem: dict[str, Any], found: dict[str, Tensor]
) -> None:
    n, lanes, device = len(rows), problem["lanes_each"], rows.device
    room = -(-n * lanes * ROOM // PER_ROW)
    frontier = Frontier(**trials_frontier.scene, device=trials_frontier.device, rows=room)
    joints, nodes = frontier.joints, n * 2 * problem["capacity"]
    tables = {
        "trial": rows,
        "nodes": torch.empty((nodes, joints + 1), dtype=torch.float32, device=device),
        "parents": torch.empty(nodes, dtype=torch.int32, device=device),
    }
    trees = frontier.new(Trees, n, tables, size=2)
    edges = frontier.new(Edges, n * lanes, a=joints, b=joints)
    growers = frontier.new(Growers, n * lanes, target=joints)
    frontier.tables |= problem | {"edges": edges, "trees": trees, "growers": growers}
    frontier.clear()
    frontier.ask(0, 0.0)
    frontier.launch(plant_trees, n, {"length": found["length"]})
    for level in range(LEVELS_A_TURN * -(-problem["iterations"] // lanes) + LEVELS_MORE):
        parity = level & 1
        frontier.launch(enter_edges, n, outputs=found)
        if frontier.device == "cpu" and bool((trees.tensors["state"] != 0).all()):
            break  # asking a GPU would wait for it; its empty levels take next to nothing
        frontier.tables |= {"parity": parity, "queue": frontier.intervals[parity]}
        for kernel in (draw_targets, nearest_nodes, next_edges):
            frontier.launch(kernel, frontier.lanes)
        frontier.level(edges, parity, certify=1)
    frontier.note_full()
    trials_frontier.full |= frontier.full  # checked at the end of planning
