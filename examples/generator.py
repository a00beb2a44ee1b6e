"""A small conditional flow over handovers (g, h): what examples/train_generator.py trains.

Two flows in a chain. The grasp is drawn in the frame of a surface point, the handover pose in the frame of the palm, so
that neither knows in which frame an object happens to be stored, nor where the hand stands:

    p(g | object) = sum over surface points p(point | cloud) flow(T_point_ee | cloud in the point's frame)
    p(h | g, hand) = flow(T_palm_ee | cloud in the ee frame, where the palm is and how it is turned)
"""

import torch
from torch import Tensor, nn

from r2h_batch.base import se3

CLOUD = 96
SEEN = 512
"""Points of an object that features are made from: the first ones, themselves an area-weighted sample."""
NEAR_M, SCALE_M = 0.03, 0.05
STEPS = 16
"""Euler steps from noise to sample."""


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


def cloud_in(T_obj_frame: Tensor, points: Tensor, normals: Tensor, region: Tensor, seed: Tensor) -> Tensor:
    """Features (B, CLOUD, 8) of clouds (B, P, 3) seen from a frame: point, normal, region flag, distance to the z axis.

    Half of the points are those nearest to the frame's origin line along z, the rest is drawn from all with `seed`.
    """
    inverse = se3.inverse(T_obj_frame)[:, None]
    p = se3.apply(inverse, points)
    n = se3.apply(inverse, normals) - inverse[..., :3, 3]
    off = p[..., :2].norm(dim=-1) + 0.3 * p[..., 2].abs()
    near = off.topk(CLOUD // 2, dim=1, largest=False).indices
    rows = torch.cat([near, seed % points.shape[1]], 1)
    take = rows[..., None].expand(-1, -1, 3)
    q, m = p.gather(1, take), n.gather(1, take)
    flag = region.gather(1, rows)[..., None].float()
    return torch.cat([q / SCALE_M, m, flag, q[..., :2].norm(dim=-1, keepdim=True) / SCALE_M], -1)


class Encoder(nn.Module):
    """A cloud as 128 numbers: the largest response of any point (PointNet)."""

    def __init__(self) -> None:
        super().__init__()
        self.each = nn.Sequential(nn.Linear(8, 64), nn.SiLU(), nn.Linear(64, 128))

    def forward(self, cloud: Tensor) -> Tensor:
        return self.each(cloud).amax(1)


class Flow(nn.Module):
    """Velocity of 9 numbers at time t, and the logit that a point is one to grasp at (unused by the second flow)."""

    def __init__(self, extra: int) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.velocity = nn.Sequential(
            nn.Linear(9 + 8 + 128 + extra, 256), nn.SiLU(), nn.Linear(256, 256), nn.SiLU(), nn.Linear(256, 256), nn.SiLU(),
            nn.Linear(256, 9),
        )  # fmt: skip
        self.logit = nn.Sequential(nn.Linear(128, 64), nn.SiLU(), nn.Linear(64, 1))

    def forward(self, x: Tensor, t: Tensor, condition: Tensor) -> Tensor:
        turn = torch.pi * t[:, None] * torch.arange(1, 5)
        return self.velocity(torch.cat([x, torch.sin(turn), torch.cos(turn), condition], -1))

    def loss(self, target: Tensor, condition: Tensor, generator: torch.Generator) -> Tensor:
        """Flow matching (Lipman et al. 2023): the velocity of the straight line from noise to the target."""
        noise = torch.randn(target.shape, generator=generator)
        t = torch.rand(len(target), generator=generator)
        x = (1 - t[:, None]) * noise + t[:, None] * target
        return (self(x, t, condition) - (target - noise)).square().mean()

    def sample(self, condition: Tensor, generator: torch.Generator) -> Tensor:
        """9 numbers for each row of the condition."""
        x = torch.randn((len(condition), 9), generator=generator)
        for i in range(STEPS):
            x = x + self(x, torch.full((len(x),), i / STEPS), condition) / STEPS
        return x
