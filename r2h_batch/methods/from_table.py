"""Grasps that the arm can pick from the table: candidates, backed out of the table where it is in the way.

A candidate holds a thing about the middle of its pads. Of a thing that lies flat the fingertips would then reach into the
table. Backed out along its approach, the tips alone hold it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import rng
from r2h_batch.judge.grasp import close_pads
from r2h_batch.judge.pick import Picked, picked
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.placing import in_order, taken
from r2h_batch.scene.scene import Scene
from r2h_batch.types import CollidingPair, Trials

KEPT = 8
"""Grasps that are looked for of each trial."""
TURNS = 64
"""Grasps that each trial tries at most."""
BACKS = 3
"""How often one candidate is backed out at most."""
SPARE_M = 0.001
"""Farther than the table needs."""
MOST_BACK_M = 0.03
LEAST_DOWN = 0.5
"""Cosine of approach and the vertical; along flatter ones backing out does not lead away from the table."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PickedGrasps:
    """Grasps that the arm can pick.

    Attributes:
        T_obj_ee: (N, K, 4, 4) of N trials; meaningless beyond `count`.
        draw: (N, K) which draw each was.
        count: (N,) how many of a trial count; 0: none was found.
    """

    T_obj_ee: Array
    draw: NDArray[np.int64]
    count: NDArray[np.int64]

    def chosen(self, rows: NDArray[np.int64], u: Array, otherwise: Array) -> Array:
        """(n, 4, 4) a grasp of each of these trials; where none was found, that of `otherwise`.

        Args:
            rows: (n,) trials.
            u: (n,) in [0, 1), which one.
            otherwise: (n, 4, 4) other grasps.
        """
        known = self.count[rows] > 0
        which = rng.choice(u, np.maximum(self.count[rows], 1))
        return np.where(known[:, None, None], self.T_obj_ee[rows, which], otherwise)


def picked_grasps(
    scene: Scene,
    trials: Trials,
    T_world_obj: Float32[Tensor, "n 4 4"],
    draw: Callable[[int], Array],
    number: NDArray[np.int64],
    *,
    kept: int = KEPT,
    turns: int = TURNS,
) -> PickedGrasps:
    """Up to `kept` grasps of each trial that Pick accepts: the first ones of its draws.

    Args:
        scene: robot, objects, hands and table.
        trials: N trials.
        T_world_obj: (N, 4, 4) where their objects rest, m.
        draw: number of a draw -> (N, 4, 4) a candidate of each trial.
        number: (N,) how many draws a trial has.
        kept: a trial with so many is done.
        turns: grasps that a trial tries at most, those that are backed out counted.
    """
    n = len(trials)
    found, which = np.zeros((n, kept, 4, 4)), np.zeros((n, kept), np.int64)
    count, drawn = np.zeros(n, np.int64), np.zeros(n, np.int64)
    backs, back = np.zeros(n, np.int64), np.zeros(n)
    for _ in range(turns):
        todo = np.flatnonzero((count < kept) & (drawn < number))
        if not len(todo):
            break
        T = np.empty((len(todo), 4, 4))
        for k in np.unique(drawn[todo]):
            own = drawn[todo] == k
            T[own] = draw(int(k))[todo[own]]
        T[:, :3, 3] -= back[todo, None] * T[:, :3, 2]
        rows = torch.from_numpy(todo).to(scene.device)
        tried = torch.from_numpy(T.astype(np.float32)).to(scene.device)
        judged = picked(scene, tried, T_world_obj[rows], trials[rows])
        good = todo[got := judged.picked.cpu().numpy()]
        found[good, count[good]], which[good, count[good]] = T[got], drawn[good]
        count[good] += 1
        more = _more_back(judged)
        again = ~got & (more > 0) & (backs[todo] < BACKS) & (back[todo] + more < MOST_BACK_M)
        backs[todo] = np.where(again, backs[todo] + 1, 0)
        back[todo] = np.where(again, back[todo] + more, 0.0)
        drawn[todo] += ~again
    return PickedGrasps(found, which, count)


def first_picked(
    scene: Scene,
    trials: Trials,
    T_world_obj: Float32[Tensor, "b 4 4"],
    T_obj_ee: Float32[Tensor, "b k 4 4"],
    order: Int64[Tensor, "b k"],
    usable: Int64[Tensor, " b"],
) -> tuple[Int64[Tensor, " b"], Float32[Tensor, "b 4 4"], Bool[Tensor, " b"]]:
    """The first grasp of each trial, in a given order, that the arm can pick: what a planner with a rule would take.

    Args:
        scene: robot, objects, hands and table.
        trials: B trials.
        T_world_obj: (B, 4, 4) where their objects rest, m.
        T_obj_ee: (B, K, 4, 4) grasps, m.
        order: (B, K) places of the grasps, the best first.
        usable: (B,) how many of `order` may be taken.

    Returns:
        Its place among the K, the grasp, backed out of the table where it has to be, and whether there is one. Where there is
        none: the best of all, as it is.
    """
    row = torch.arange(len(order), dtype=torch.int64, device=order.device)
    best = T_obj_ee[row, order[:, 0]]

    def draw(k: int) -> Array:
        return T_obj_ee[row, order[:, k]].double().cpu().numpy()

    turns = (1 + BACKS) * order.shape[1]
    number = usable.cpu().numpy()
    there = picked_grasps(scene, trials, T_world_obj, draw, number, kept=1, turns=turns)
    found = torch.from_numpy(there.count > 0).to(order.device)
    place = order[row, torch.from_numpy(there.draw[:, 0]).to(order.device)]
    grasp = torch.from_numpy(there.T_obj_ee[:, 0].astype(np.float32)).to(order.device)
    return place, torch.where(found[:, None, None], grasp, best), found


def best_picked(
    scene: Scene,
    trials: Trials,
    T_world_obj: Float32[Tensor, "b 4 4"],
    T_obj_ee: Float32[Tensor, "b s 4 4"],
    feasible: Bool[Tensor, "b s"],
) -> tuple[Float32[Tensor, "b k 4 4"], Bool[Tensor, "b k"]]:
    """The best `KEPT` grasps of each trial that the arm can pick, and which of these rows are such ones. A trial without any
    keeps its best one.

    Args:
        scene: robot, objects, hands and table.
        trials: B trials.
        T_world_obj: (B, 4, 4) where their objects rest, m.
        T_obj_ee: (B, S, 4, 4) grasps, the best first, m.
        feasible: (B, S) which may be taken: the first ones of each row.
    """

    def draw(k: int) -> Array:
        return T_obj_ee[:, k].double().cpu().numpy()

    number = feasible.sum(1).cpu().numpy()
    found = picked_grasps(scene, trials, T_world_obj, draw, number)
    count = torch.from_numpy(found.count).to(T_obj_ee.device)
    grasps = torch.from_numpy(found.T_obj_ee.astype(np.float32)).to(T_obj_ee.device)
    none = (count == 0)[:, None, None]
    grasps[:, 0] = torch.where(none, T_obj_ee[:, 0], grasps[:, 0])
    place = torch.arange(grasps.shape[1], dtype=torch.int64, device=grasps.device)
    return grasps, place < count.clamp(min=1)[:, None]


def chosen_candidate(
    scene: Scene,
    trials: Trials,
    T_world_obj: Float32[Tensor, "b 4 4"] | None,
    pool: Bool[Tensor, "b k"],
    *keys: Float[Tensor, "b k"],
) -> tuple[Float32[Tensor, "b 4 4"], Float32[Tensor, " b"]]:
    """The candidate of each trial's object that a method's rule puts first, and the opening that it closes to, m.

    Args:
        scene: with the candidates.
        trials: B trials.
        T_world_obj: (B, 4, 4) where the objects rest, m: the first that the arm can pick there is taken. None: the first.
        pool: (B, K) which candidates the rule may take.
        keys: (B, K) what it ranks them by, the least first; the next key where the one before is equal.
    """
    table = candidate_table(scene)
    rows, _ = table.rows(trials.object_index)
    order, usable = in_order(pool, *keys)
    if T_world_obj is None:
        row = taken(rows, order[:, 0])
        return table.T_obj_ee[row], table.opening_m[row]
    _, T_obj_ee, _ = first_picked(scene, trials, T_world_obj, table.T_obj_ee[rows], order, usable)
    return T_obj_ee, close_pads(scene.grasp_tables, T_obj_ee, trials.object_index)[1]


def _more_back(judged: Picked) -> Array:
    """How much farther each grasp has to stay back from the table; 0 where that does not help."""
    down = -judged.T_world_ee[:, 2, 2].double().cpu().numpy()
    margin = judged.margin_m.double().cpu().numpy()
    helps = (
        (judged.pair.cpu().numpy() == CollidingPair.TABLE)
        & np.isfinite(margin)
        & (down >= LEAST_DOWN)
    )
    return np.where(helps, (SPARE_M - margin) / np.maximum(down, LEAST_DOWN), 0.0)
