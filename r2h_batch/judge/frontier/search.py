"""RRT-Connect level by level (kernels/frontier/trees.py): the search as a GPU runs it, many lanes a
problem."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from r2h_batch.config import PlanConfig
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


@dataclass(frozen=True)
class Problem:
    """What a search of B trials starts from: the goals that it may end at, how many, the hand
    clearance that it keeps."""

    start: Float32[Tensor, "b 6"]
    goals: Float32[Tensor, "b 8 6"]
    n_goals: Int32[Tensor, " b"]
    margin: Float32[Tensor, " b"]
    key: Int32[Tensor, " b"]


def connect_by_frontier(
    frontier: Frontier, rows: Int32[Tensor, " r"], problem: Problem, config: PlanConfig,
    iterations: int, seed: int, shorter: float,
    path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"], nodes: int,
) -> None:  # fmt: skip
    """One search of those `rows` whose `length` is 0, as plan/rrt.py `rrt_connect` with certified
    edges; writes the paths found.

    `iterations` random postures a problem; which are drawn, and what follows from them, does not
    depend on the other rows. `nodes`: of all trees at once.
    """
    lanes = min(max(iterations // 8, FEWEST), MOST)
    at_once = max(1, min(LANES_AT_ONCE // lanes, nodes // (2 * _capacity(iterations))))
    for part in rows.split(at_once):
        _Search(frontier, part, problem, config, iterations, lanes)(seed, shorter, path, length)


def _capacity(iterations: int) -> int:
    """Nodes of one tree, as search.py has it: a tree that is full ends the search."""
    return 4 * iterations + 16


class _Search:
    def __init__(
        self,
        frontier: Frontier,
        rows: Tensor,
        problem: Problem,
        config: PlanConfig,
        iterations: int,
        lanes: int,
    ) -> None:
        self._all = frontier
        self._frontier = Frontier(
            **frontier.scene, device=frontier.device, rows=-(-len(rows) * lanes * ROOM // PER_ROW)
        )
        self._rows, self._problem, self._config = rows, problem, config
        self._iterations, self._lanes, self._capacity = iterations, lanes, _capacity(iterations)
        device, n, all_lanes = rows.device, len(rows), len(rows) * lanes

        new, joints, nodes = self._frontier.new, frontier.joints, n * 2 * self._capacity
        trees = {
            "trial": rows,
            "nodes": torch.empty((nodes, joints + 1), dtype=torch.float32, device=device),
            "parents": torch.empty(nodes, dtype=torch.int32, device=device),
        }
        self._edges = new(Edges, all_lanes, a=joints, b=joints)
        self._tables: dict[str, Any] = {
            "edges": self._edges,
            "trees": new(Trees, n, trees, size=2),
            "growers": new(Growers, all_lanes, target=joints),
        }
        self._state = self._tables["trees"].tensors["state"]

    def __call__(self, seed: int, shorter: float, path: Tensor, length: Tensor) -> None:
        frontier, p = self._frontier, self._problem
        n = len(self._rows)
        sizes = {
            "capacity": self._capacity, "lanes_each": self._lanes, "range_rad": self._config.range_rad,
        }  # fmt: skip
        ends = {
            "start": p.start,
            "goals": p.goals.flatten(0, 1),
            "n_goals": p.n_goals,
            "margin": p.margin,
        }
        frontier.clear()
        frontier.ask(0, 0.0)
        frontier.launch(plant_trees, n, self._tables | sizes | ends | {"length": length})
        enter = self._tables | sizes | {"iterations": self._iterations, "shorter": shorter}
        grown = {
            "trees": self._tables["trees"],
            "growers": self._tables["growers"],
            "lanes_each": self._lanes,
        }
        draw = grown | {"seed": seed, "start": p.start, "key": p.key}
        for level in range(LEVELS_A_TURN * -(-self._iterations // self._lanes) + LEVELS_MORE):
            parity = level & 1
            frontier.launch(enter_edges, n, enter, {"path": path, "length": length})
            if frontier.device == "cpu" and bool((self._state != 0).all()):
                break  # asking a GPU would wait for it; its empty levels take next to nothing
            frontier.launch_queued(draw_targets, draw)
            frontier.launch_queued(nearest_nodes, grown | {"capacity": self._capacity})
            queue = {"parity": parity, "queue": frontier.intervals[parity]}
            frontier.launch_queued(next_edges, self._tables | sizes | queue)
            frontier.level(self._edges, parity, certify=1)
        frontier.note_full()
        self._all.full |= frontier.full  # checked at the end of planning
