"""The distance of a moving robot from a moving hand: measured where both are, certified in between.

Within a part of a step, joints turn at a constant rate and the hand goes at most so far. No point of the
robot comes nearer to a point of the hand by more than both ways together, L. With the distances a and b at
the ends the distance is at least (a + b - L) / 2 throughout. Where that is not above 0 the part is halved.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from r2h_batch.closed_loop.fingers import OwnHands
from r2h_batch.closed_loop.moving import MovingHands
from r2h_batch.judge.distance import NearestApproach, hand_distance_at
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

CAP_M = 0.25
"""Distances are exact up to here, lower bounds beyond."""
ROUNDING_M = 2e-6
"""Rounding error of float32 in postures and poses."""
RESOLUTION_M = 1e-4
"""Where robot and hand go no farther than this together and are not certified apart, they touch: they came
within half of it."""


@dataclass(frozen=True)
class Passed:
    """A step of B trials.

    Attributes:
        gap_m: distance at its end; not above 0: they touch there.
        least_m: a lower bound of the distance throughout the step.
        touch: they touch within it.
    """

    gap_m: Float32[Tensor, " b"]
    least_m: Float32[Tensor, " b"]
    touch: Bool[Tensor, " b"]


class RelativeDistance:
    """Robot and hands of some trials, with the fingers at an opening. Distances are those of
    `judge.distance`: exact mesh of the hand, primitives of the robot, without the object."""

    def __init__(
        self,
        scene: Scene,
        trials: Trials,
        T_obj_ee: Float32[Tensor, "b 4 4"],
        opening_m: Float32[Tensor, " b"],
        own: OwnHands | None = None,
    ) -> None:
        """`own`: the hands of the trials, row by row; None: those of the scene."""
        self.scene, self.trials, self.own = scene, trials, own
        self._grasp, self._opening = T_obj_ee, opening_m
        self._levers = scene.motion_radii.to(T_obj_ee.device).float()

    def at(
        self,
        rows: Tensor,
        q: Float32[Tensor, "r j"],
        T_world_hand: Float32[Tensor, "r 4 4"],
    ) -> Float32[Tensor, " r"]:
        """Distance of some trials at postures and poses, m."""
        return self.nearest(rows, q, T_world_hand).distance_m

    def nearest(
        self,
        rows: Tensor,
        q: Float32[Tensor, "r j"],
        T_world_hand: Float32[Tensor, "r 4 4"],
    ) -> NearestApproach:
        """As `at`, with the robot's body and the point of the hand."""
        trials, own = self.trials, self.own
        hand = trials.hand_index[rows] if own is None else rows
        bodies = self.scene.body_poses(
            trials.object_index[rows], hand, self._grasp[rows], T_world_hand.contiguous(),
            self._opening[rows],
        )  # fmt: skip
        active = torch.ones(len(rows), dtype=torch.bool, device=q.device)
        tables = None if own is None else own.tables
        return hand_distance_at(
            self.scene, bodies, q.contiguous(), active, cap_m=CAP_M, hands=tables
        )

    def robot_travel(self, turned: Float32[Tensor, "r j"]) -> Float32[Tensor, " r"]:
        """Bound of the distance that any point of the robot moves while each joint turns by this
        much, m."""
        total = self._levers[:, 0] * turned[:, None, 0].abs()
        for k in range(1, turned.shape[1]):
            total = total + self._levers[:, k] * turned[:, None, k].abs()
        return total.amax(1) * 1.00001

    def over_step(
        self,
        rows: Tensor,
        q: tuple[Float32[Tensor, "r j"], Float32[Tensor, "r j"]],
        hands: MovingHands,
        time_s: tuple[Float64[Tensor, " r"], Float64[Tensor, " r"]],
        before_m: Float32[Tensor, " r"],
    ) -> Passed:
        """The step from one posture to the next, while the hands go on.

        Args:
            rows: which trials.
            q: postures at both ends, rad.
            hands: of all trials.
            time_s: both ends.
            before_m: distance at the beginning.
        """
        way = hands.way[rows]
        one = torch.ones(len(rows), dtype=torch.float64, device=rows.device)
        every = torch.arange(len(rows), dtype=torch.int64, device=rows.device)
        after = self.at(rows, q[1], way.pose(time_s[1]).float())
        travel = self.robot_travel(q[1] - q[0]).double()
        span = time_s[1] - time_s[0]

        def way_of(i: Tensor, a: Tensor, b: Tensor) -> Float64[Tensor, " n"]:
            times = (time_s[0][i] + span[i] * x for x in (a, b))
            return (b - a) * travel[i] + way[i].travel(*times)

        least = torch.minimum(before_m, after)
        touch = after <= 0
        i = every
        a, b = torch.zeros_like(one), one
        d_a, d_b = before_m, after
        while len(i):
            L = way_of(i, a, b)
            low = (0.5 * (d_a.double() + d_b.double() - L)).float()
            sure = (low > ROUNDING_M) | touch[i]
            least.scatter_reduce_(0, i, torch.where(sure, low, torch.inf), "amin")
            lost = ~sure & (L <= RESOLUTION_M)
            touch[i[lost]] = True
            go = ~sure & ~lost
            i, a, b, d_a, d_b = (x[go] for x in (i, a, b, d_a, d_b))
            if not len(i):
                break
            m = 0.5 * (a + b)
            at = q[0][i] + m[:, None].float() * (q[1][i] - q[0][i])
            T = way[i].pose(time_s[0][i] + span[i] * m).float()
            d_m = self.at(rows[i], at, T)
            touch[i[d_m <= 0]] = True
            i, a, b = torch.cat([i, i]), torch.cat([a, m]), torch.cat([m, b])
            d_a, d_b = torch.cat([d_a, d_m]), torch.cat([d_m, d_b])
        least = torch.where(touch, least.clamp(max=0.0), least)
        return Passed(after, least, touch)
