"""A simulator of transfers: its state at each tick, and its input. The same for every engine."""

from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Bool, Float64
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Seen:
    """N transfers at a tick, float64, frame gripper (at the handover pose).

    Attributes:
        load: (N, 3) force of the fingers' load on the wrist, N; the gripper's own inertia is taken off.
        shifted: (N, 3) how far the robot's hand is from the handover pose, m.
        com: (N, 3) centre of mass of the object, m.
        p_obj: (N, 3) origin of its frame, m.
        R_obj: (N, 3, 3) its axes.
        slip: (N, 7) shift (m) and turn (quaternion, w first) of the object in the person's hand.
        arm: (N, 3) force of the person's arm on the hand, N.
        touching: (N,) whether a pad touches the object.
        fine: (N,) whether all numbers are finite and nothing moves at more than 300 m/s or rad/s.
    """

    load: Float64[Tensor, "n 3"]
    shifted: Float64[Tensor, "n 3"]
    com: Float64[Tensor, "n 3"]
    p_obj: Float64[Tensor, "n 3"]
    R_obj: Float64[Tensor, "n 3 3"]
    slip: Float64[Tensor, "n 7"]
    arm: Float64[Tensor, "n 3"]
    touching: Bool[Tensor, " n"]
    fine: Bool[Tensor, " n"]


@dataclass(frozen=True, eq=False)
class Told:
    """Inputs of N transfers for a tick, float64, frame gripper.

    Attributes:
        effort: (N,) of the fingers' motors, share of the largest; positive closes.
        shift: (N, 3) where the robot moves its hand, from the handover pose, m.
        hand: (N, 3) where the person's arm pulls the hand, from the grasp, m.
        friction: (N, 6) force (N) and moment (N m) at which the object slips in the hand.
        push: (N, 6) force on the object of a finger that does not grip (N), and where it acts (m); None: no finger.
    """

    effort: Float64[Tensor, " n"]
    shift: Float64[Tensor, "n 3"]
    hand: Float64[Tensor, "n 3"]
    friction: Float64[Tensor, "n 6"]
    push: Float64[Tensor, "n 6"] | None


class Worlds(Protocol):
    """N transfers with closed grippers, in some simulator."""

    def seen(self) -> Seen:
        """The state now. The tensors are the worlds' own: valid until the next step."""
        ...

    def step(self, told: Told, running: Bool[Tensor, " n"]) -> None:
        """Goes on by a tick where `running`."""
        ...
