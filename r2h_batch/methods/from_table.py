"""Grasps that the arm can pick from the table: candidates, backed out of the table where it is in the way.

A candidate holds a thing about the middle of its pads. Of a thing that lies flat the fingertips would then reach into the
table. Backed out along its approach, the tips alone hold it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base import rng
from r2h_batch.judge.pick import Picked, picked
from r2h_batch.observe.known import known_moments
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
        T_obj_ee: (N, KEPT, 4, 4) of N trials.
        count: (N,) how many of a trial count; 0: none was found.
    """

    T_obj_ee: Array
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


def picked_grasps(scene: Scene, trials: Trials, candidates: Callable[[int], Array]) -> PickedGrasps:
    """Up to `KEPT` grasps of each trial that Pick accepts.

    Args:
        scene: robot, objects, hands and table.
        trials: N trials.
        candidates: number of a draw -> (N, 4, 4) a candidate of each trial.
    """
    n = len(trials)
    T_world_obj = known_moments(scene).of(trials)
    found, count = np.zeros((n, KEPT, 4, 4)), np.zeros(n, np.int64)
    drawn, backs, back = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n)
    for _ in range(TURNS):
        todo = np.flatnonzero(count < KEPT)
        if not len(todo):
            break
        T = np.empty((len(todo), 4, 4))
        for draw in np.unique(drawn[todo]):
            own = drawn[todo] == draw
            T[own] = candidates(int(draw))[todo[own]]
        T[:, :3, 3] -= back[todo, None] * T[:, :3, 2]
        rows = torch.from_numpy(todo).to(scene.device)
        tried = torch.from_numpy(T.astype(np.float32)).to(scene.device)
        judged = picked(scene, tried, T_world_obj[rows], trials[rows])
        good = todo[got := judged.picked.cpu().numpy()]
        found[good, count[good]] = T[got]
        count[good] += 1
        more = _more_back(judged)
        again = ~got & (more > 0) & (backs[todo] < BACKS) & (back[todo] + more < MOST_BACK_M)
        backs[todo] = np.where(again, backs[todo] + 1, 0)
        back[todo] = np.where(again, back[todo] + more, 0.0)
        drawn[todo] += ~again
    return PickedGrasps(found, count)


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
