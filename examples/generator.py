"""A small generator of handovers: which candidate to take, and a flow over the pose. examples/train_generator.py trains it.

    p(candidate | cloud in its gripper's frame, palm)              among the object's candidates
    p(pose | cloud in the gripper's frame, palm)                   a flow over the gripper in the palm's frame

Neither knows in which frame an object happens to be stored, nor where the hand stands. All inputs are what methods see.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from r2h_batch.base import se3

SCALE_M = 0.05
STEPS = 16
"""Euler steps from noise to sample."""
PALM, MIDDLE = 8, 3
"""Numbers that say where the palm is; where the gripper has the point that is brought to it."""

Seen = Mapping[str, Tensor]
"""Trials as `training.stream` and `observe` show them."""


def frame_of(z: Tensor, towards: Tensor, origin: Tensor) -> Tensor:
    """Frames (..., 4, 4) at `origin` with the given z axis and x as near to `towards` as that allows."""
    x = towards - z * (towards * z).sum(-1, keepdim=True)
    x = torch.where(x.norm(dim=-1, keepdim=True) > 1e-4, x, torch.linalg.cross(z, z.roll(1, -1)))
    x = x / x.norm(dim=-1, keepdim=True)
    return se3.from_rotation(torch.stack([x, torch.linalg.cross(z, x), z], -1), origin)


def to_numbers(T: Tensor) -> Tensor:
    """A pose as 9 numbers of order 1: origin, y and z axis."""
    return torch.cat([T[..., :3, 3] / SCALE_M, T[..., :3, 1], T[..., :3, 2]], -1)


def to_pose(x: Tensor) -> Tensor:
    """The pose nearest to 9 numbers in the sense of Gram-Schmidt (z, then y); differentiable."""
    z = nn.functional.normalize(x[..., 6:9], dim=-1)
    y = x[..., 3:6] - z * (x[..., 3:6] * z).sum(-1, keepdim=True)
    y = nn.functional.normalize(y, dim=-1)
    return se3.from_rotation(torch.stack([torch.linalg.cross(y, z), y, z], -1), SCALE_M * x[..., :3])


def middle_of(seen: Seen) -> Tensor:
    """(N, 3) the point that is brought to the palm: the middle of the receiver's region, or of the object if it has none."""
    region = seen["region"].bool()
    use = (region | ~region.any(1, keepdim=True)).float()[..., None]
    return (seen["cloud"] * use).sum(1) / use.sum(1)


def palm_of(seen: Seen) -> tuple[Tensor, Tensor]:
    """T_world_palm (N, 4, 4): at the ball's centre, z out of the palm, x away from the robot; and where it stands (N, 8)."""
    center = seen["ball_center"]
    out = center * torch.tensor([1.0, 1.0, 0.0])
    far = out.norm(dim=-1, keepdim=True)
    T = frame_of(seen["palm_normal"], out / far, center)
    return T, torch.cat([center * 2, T[:, 2, :3], far, seen["side"].float()[:, None]], -1)


def held(seen: Seen, T_obj_ee: Tensor) -> tuple[Tensor, Tensor]:
    """Clouds as the grippers (N, K) see them, 8 numbers a point (N, K, P, 8), and the middle (N, K, 3), m."""
    inverse = se3.inverse(T_obj_ee)[:, :, None]
    p = se3.apply(inverse, seen["cloud"][:, None])
    n = se3.apply(inverse, seen["normals"][:, None]) - inverse[..., :3, 3]
    flag = seen["region"][:, None, :, None].float().expand(*p.shape[:3], 1)
    off = p[..., :2].norm(dim=-1, keepdim=True)
    middle = se3.apply(inverse[:, :, 0], middle_of(seen)[:, None])
    return torch.cat([p / SCALE_M, n, flag, off / SCALE_M], -1), middle


def at_middle(T_palm_ee: Tensor, middle: Tensor) -> Tensor:
    """The gripper's turn, at the place of the object's middle: what is to be near the palm."""
    return se3.from_rotation(T_palm_ee[..., :3, :3], se3.apply(T_palm_ee, middle))


def from_middle(T_palm_middle: Tensor, middle: Tensor) -> Tensor:
    """The inverse of `at_middle`."""
    R = T_palm_middle[..., :3, :3]
    return se3.from_rotation(R, T_palm_middle[..., :3, 3] - (R @ middle[..., None])[..., 0])


class Generator(nn.Module):
    """A PointNet of the held object, the logit that its candidate can be handed over, and the velocity of the pose's numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.each = nn.Sequential(nn.Linear(8, 48), nn.SiLU(), nn.Linear(48, 96))
        known = 96 + PALM + MIDDLE
        self.choice = nn.Sequential(nn.Linear(known, 96), nn.SiLU(), nn.Linear(96, 96), nn.SiLU(), nn.Linear(96, 1))
        self.velocity = nn.Sequential(
            nn.Linear(9 + 8 + known, 256), nn.SiLU(), nn.Linear(256, 256), nn.SiLU(), nn.Linear(256, 256), nn.SiLU(),
            nn.Linear(256, 9),
        )  # fmt: skip

    def known(self, cloud: Tensor, palm: Tensor, middle: Tensor) -> Tensor:
        """All that both parts go by, of pairs (N, K): clouds (N, K, P, 8), palms (N, 8), middles (N, K, 3)."""
        code = self.each(cloud).amax(-2)
        return torch.cat([code, palm[:, None].expand(*code.shape[:2], -1), 10 * middle], -1)

    def _speed(self, x: Tensor, t: Tensor, known: Tensor) -> Tensor:
        turn = torch.pi * t[:, None] * torch.arange(1, 5)
        return self.velocity(torch.cat([x, turn.sin(), turn.cos(), known], -1))

    def loss(self, known: Tensor, passed: Tensor, target: Tensor, random: torch.Generator) -> Tensor:
        """That of the choice among a trial's pairs, and of the flow on the pairs that pass.

        The choice's is minus the logarithm of the share that it gives to pairs that pass. The flow's is flow matching (Lipman
        et al. 2023): the velocity of the straight line from noise to the target.
        """
        logit = self.choice(known)[..., 0].log_softmax(1)
        some = passed.any(1)
        choice = -logit.masked_fill(~passed, -torch.inf)[some].logsumexp(1).mean()
        x1, condition = target[passed], known[passed]
        x0 = torch.randn(x1.shape, generator=random)
        t = torch.rand(len(x1), generator=random)
        x = (1 - t[:, None]) * x0 + t[:, None] * x1
        return 0.3 * choice + (self._speed(x, t, condition) - (x1 - x0)).square().mean()

    def poses(self, known: Tensor, random: torch.Generator) -> Tensor:
        """9 numbers of a pose for each row of `known`."""
        x = torch.randn((len(known), 9), generator=random)
        for i in range(STEPS):
            x = x + self._speed(x, torch.full((len(x),), i / STEPS), known) / STEPS
        return x
