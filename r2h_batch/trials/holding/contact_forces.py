"""Linear programs over the forces of contacts: many loads on the same contacts at once.

Forces f >= 0 along the edges of friction cones balance a load: edges @ f = load, with normal forces that sum up to a
limit at most. The revised simplex method takes one step of all programs at a time. A solver from a library takes one
program at a time and 7 ms for each; the grasps of an object need 40,000.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

AXES = 6
FORBIDDEN = 1e4
"""Price of what only starts the method, and has to leave."""
PRICE, PIVOT, ROOM, NOTHING = 1e-9, 1e-7, 1e-9, 1e-6
"""Tolerances: of a price that is worth a step, of a pivot, of a variable's sign, of a load that is left over."""
OFF = 1e-7 * np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 0.0])
"""The method works with loads that are off by so little: no two variables become 0 in the same step, so it does not
turn in a circle. Results are those of the exact loads."""
MOST_STEPS, AFRESH = 500, 20


class ContactForces:
    """Programs over the same contacts.

    A program's variables are a force for each edge, what is left of the normal forces' limit, and a load along each
    axis and against it. A basis is the seven of them that are not 0.
    """

    def __init__(self, edges: Float64[Array, "6 m"]) -> None:
        """Args:
        edges: force (N) and moment of each edge of the friction cones, with 1 N along the normal.
        """
        m = edges.shape[1]
        self.left, self.first_axis = m, m + 1
        self.columns = np.zeros((m + 1 + 2 * AXES, AXES + 1))
        self.columns[:m, :AXES] = edges.T
        self.columns[: m + 1, AXES] = 1.0
        self.columns[m + 1 :, :AXES] = np.concatenate([np.eye(AXES), -np.eye(AXES)])

    def carry(
        self, load: Float64[Array, "k 6"], most: float
    ) -> tuple[Float64[Array, " k"], Int64[Index, "k 7"]]:
        """Least sum of normal forces that balances each load, inf where `most` does not, and the bases found."""
        axis = self.first_axis + np.where(load + OFF[:AXES] >= 0, 0, AXES) + np.arange(AXES)
        basis = np.concatenate([axis, np.full((len(load), 1), self.left)], 1).astype(np.int64)
        rhs = np.concatenate([load, np.full((len(load), 1), most)], 1)
        value = self._improve(basis, rhs, np.full(len(load), self.left))
        over = np.where(basis >= self.first_axis, value, 0.0).sum(1)
        left = np.where(basis == self.left, value, 0.0).sum(1)
        return np.where(over < NOTHING, most - left, np.inf), basis

    def withstand(
        self,
        load: Float64[Array, "k 6"],
        total: Float64[Array, " k"],
        basis: Int64[Index, "k 7"],
    ) -> Float64[Array, "k 6"]:
        """The largest further load along each axis, less of both signs, that normal forces of this sum balance.

        Args:
            load: that they carry too.
            total: sum of the normal forces, at least what carries the load.
            basis: what `carry` found.
        """
        k, ways = len(load), 2 * AXES
        rhs = np.repeat(np.concatenate([load, total[:, None]], 1), ways, axis=0)
        own = np.tile(self.first_axis + np.arange(ways), k)
        basis = np.repeat(basis, ways, axis=0)
        value = self._improve(basis, rhs, own)
        found = np.where(basis == own[:, None], value, 0.0).sum(1)
        return np.asarray(found.reshape(k, 2, AXES).min(1).clip(min=0.0))

    def _improve(
        self,
        basis: Int64[Index, "l 7"],
        rhs: Float64[Array, "l 7"],
        wanted: Int64[Index, " l"],
    ) -> Float64[Array, "l 7"]:
        """Replaces bases by the best ones, and says the values of their variables.

        Args:
            basis: a feasible one of each program.
            rhs: load, and sum of the normal forces.
            wanted: the variable that is to be as large as can be. Of the loads along axes only this one may enter.
        """
        # of what is left of the limit, and of the loads along axes; edges gain nothing
        gain = np.zeros((len(basis), 1 + 2 * AXES))
        gain[:, 1:] = -FORBIDDEN
        gain[np.arange(len(basis)), wanted - self.left] = 1.0
        may = np.zeros(gain.shape, np.bool_)
        may[:, 0] = may[np.arange(len(basis)), wanted - self.left] = True
        near, todo = rhs + OFF, np.arange(len(basis))
        for step in range(MOST_STEPS):
            if step % AFRESH == 0:
                inverse = self._inverse(basis[todo])
            place = basis[todo] - self.left
            gains = np.take_along_axis(gain[todo], place.clip(min=0), 1) * (place >= 0)
            worth = -(gains[:, None] @ inverse)[:, 0] @ self.columns.T
            ends = worth[:, self.left :] + gain[todo]
            worth[:, self.left :] = np.where(may[todo], ends, -np.inf)
            enters = worth.argmax(1)
            goes = worth[np.arange(len(todo)), enters] > PRICE
            todo, inverse, enters = todo[goes], inverse[goes], enters[goes]
            if not len(todo):
                break
            value = (inverse @ near[todo][:, :, None])[:, :, 0]
            change = (inverse @ self.columns[enters][:, :, None])[:, :, 0]
            falls = change > PIVOT
            pivots = np.where(falls, change, 1.0)
            until = np.where(falls, (value + ROOM) / pivots, np.inf).min(1)
            # of those that reach 0 by then, the one with the largest pivot
            first = falls & (value / pivots <= until[:, None])
            leaves = np.where(first, change, -1.0).argmax(1)
            row = np.arange(len(todo))
            scaled = inverse[row, leaves] / change[row, leaves][:, None]
            inverse = inverse - change[:, :, None] * scaled[:, None]
            inverse[row, leaves] = scaled
            basis[todo, leaves] = enters
        else:
            raise RuntimeError(f"{len(todo)} linear programs over contacts took {MOST_STEPS} steps")
        return np.asarray((self._inverse(basis) @ rhs[:, :, None])[:, :, 0])

    def _inverse(self, basis: Int64[Index, "l 7"]) -> Float64[Array, "l 7 7"]:
        return np.asarray(np.linalg.inv(self.columns[basis].transpose(0, 2, 1)))
