"""Numbers that tell the ranker about a pair (grasp candidate, handover pose), without the judge, IK or a mesh.

Of a candidate: the object's cloud in the gripper's frame, and numbers of the closed fingers. Of a pair: where the arm is to
go, and how hand, gripper and object lie to each other. Lengths are scaled so that all numbers are about 1.
"""

from collections.abc import Mapping
from functools import lru_cache

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from r2h_batch.methods.ranker.observe import Seen
from r2h_batch.verdicts import SIDES

SEE = Seen(cloud=256, hand=48)
"""The points that the ranker looks at."""
SPREAD = "spread"
"""Weights say so of the clouds that they learned from: `Seen.spread`."""
POINTS = 64
"""Points of the cloud that the network and the pair's distances go through; the fingers' distances go through all."""
CLOUD, CANDIDATE, PAIR = 8, 9, 58
"""Numbers of a point of the cloud, of a candidate, of a pair."""
FAR_M = 0.3
"""Distances are cut here; there is no region as far as this."""
BESIDE_PAD_M = 0.015
"""From a pad's surface to the middle of its finger."""
ALONG_FINGER_M = (0.0, -0.03, -0.06)
BEHIND_M = (-0.09, -0.13, -0.18, -0.24)
"""Marks on the gripper, along its approach axis from the TCP: on both fingers; on the palm, the wrist, the forearm."""
WRIST_M = (0.15, 0.30)
_RIGHT = SIDES.index("right")


def cloud_in_gripper(
    seen: Mapping[str, Tensor], T_obj_ee: Float32[Tensor, "n c 4 4"]
) -> Float32[Tensor, "n c p 8"]:
    """The first points of the cloud in each gripper's frame: place, normal, whether the receiver wants it, distance from
    the approach axis.

    Args:
        seen: of `observe`.
        T_obj_ee: candidates.
    """
    R = T_obj_ee[..., :3, :3]
    points = seen["cloud"][:, None, :POINTS] - T_obj_ee[..., None, :3, 3]
    p = 10 * (points @ R)
    normals = seen["normals"][:, None, :POINTS] @ R
    region = seen["region"][:, None, :POINTS, None].float().expand(*p.shape[:3], 1)
    return torch.cat([p, normals, region, p[..., :2].norm(dim=-1, keepdim=True)], -1)


def of_candidate(
    seen: Mapping[str, Tensor], T_obj_ee: Float32[Tensor, "n c 4 4"], pick: Int64[Tensor, "n c"]
) -> Float32[Tensor, "n c 9"]:
    """Six marks' distances to the region, whether there is a region, opening, score.

    Args:
        seen: of `observe`.
        T_obj_ee: candidates.
        pick: which of `candidates` they are.
    """
    opening, score = seen["opening_m"].gather(1, pick), seen["score"].gather(1, pick)
    marks = _marks(opening)[..., : 2 * len(ALONG_FINGER_M), :]
    at = marks @ T_obj_ee[..., :3, :3].mT + T_obj_ee[..., None, :3, 3]
    n, c, m = at.shape[:3]
    apart = torch.cdist(at.reshape(n, c * m, 3), seen["cloud"])
    apart = torch.where(seen["region"][:, None], apart, FAR_M).amin(-1).clamp(max=FAR_M)
    wanted = seen["region"].any(1).float()[:, None].expand(n, c)
    return torch.cat([10 * apart.view(n, c, m), torch.stack([wanted, 20 * opening, score], -1)], -1)


def of_pair(
    seen: Mapping[str, Tensor],
    T_obj_ee: Float32[Tensor, "n k 4 4"],
    T_world_ee: Float32[Tensor, "n k 4 4"],
    opening: Float32[Tensor, "n k"],
) -> Float32[Tensor, "n k 58"]:
    """Where the arm goes; gripper, object and region against the estimated hand.

    Args:
        seen: of `observe`.
        T_obj_ee: the grasp of each pair.
        T_world_ee: its handover pose.
        opening: gap between the pads on the object, m.
    """
    n, k = T_world_ee.shape[:2]
    p, R = T_world_ee[..., :3, 3], T_world_ee[..., :3, :3]
    x, z = R[..., 0], R[..., 2]
    normal, finger = seen["palm_normal"].float(), seen["wrist_to_middle"].float()
    palm, ball = seen["palm_point"].float(), seen["ball_center"].float()
    thumb = torch.linalg.cross(normal, finger)
    thumb = torch.where((seen["side"] == _RIGHT)[:, None], -thumb, thumb)
    of_palm = torch.stack([thumb, finger, normal], -1)  # nearly orthonormal

    def in_palm(v: Tensor) -> Tensor:
        return v @ of_palm

    grasp = T_obj_ee[..., :3, :3]
    R_world_obj = R @ grasp.mT
    at = p - (R_world_obj @ T_obj_ee[..., :3, 3:])[..., 0]
    # all poses of a trial in one product: a thousand products of 3 x 3 matrices cost ten times as much
    turned = seen["cloud"][:, :POINTS] @ R_world_obj.permute(0, 3, 1, 2).reshape(n, 3, 3 * k)
    world = turned.view(n, -1, k, 3).transpose(1, 2) + at[..., None, :]
    _, y, along = _marks(opening).unbind(-1)
    marks = p[..., None, :] + y[..., None] * R[..., None, :, 1] + along[..., None] * z[..., None, :]
    hand = seen["hand"].float()
    to_hand = (
        torch.cdist(torch.cat([world, marks], 2).view(n, -1, 3), hand)
        .view(n, k, -1, hand.shape[1])
        .amin(-1)
    )
    gap, near = to_hand[..., :POINTS], to_hand[..., POINTS:].clamp(max=FAR_M)
    to_ball = (world - ball[:, None, None]).norm(dim=-1)
    region = torch.where(seen["region"][:, None, :POINTS], to_ball, FAR_M)
    lowest = torch.stack([world[..., 2].amin(-1), marks[..., 2].amin(-1)], -1)
    flat = p[..., :2].norm(dim=-1).clamp(min=1e-6)
    c, s = p[..., 0] / flat, p[..., 1] / flat

    def about_robot(v: Tensor) -> Tensor:
        return torch.stack(
            [c * v[..., 0] + s * v[..., 1], c * v[..., 1] - s * v[..., 0], v[..., 2]], -1
        )

    wrist = []
    for back in WRIST_M:
        w = p - back * z
        length = w.norm(dim=-1)
        side = w[..., :2].norm(dim=-1)
        wrist += [length, side, w[..., 2], torch.atan2(w[..., 1], w[..., 0])]
    each = torch.cat([palm * 3, normal, finger], -1)[:, None].expand(n, k, 9)
    return torch.cat(
        [
            p * 3, x, z, about_robot(x), about_robot(z), torch.atan2(s, c)[..., None], 2 * torch.stack(wrist, -1),
            5 * in_palm(p - palm[:, None]), in_palm(z), in_palm(R[..., 1]).abs(),
            20 * gap.amin(-1, keepdim=True), 20 * gap.topk(8, largest=False).values.mean(-1, keepdim=True),
            10 * to_ball.amin(-1, keepdim=True), 10 * region.amin(-1, keepdim=True), 10 * lowest, 10 * near, each,
        ], -1,
    )  # fmt: skip


def hidden(
    cloud: Tensor, candidate: Tensor, pair: Tensor, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The features of some trials as if their region were not seen.

    Args:
        cloud: (n, c, p, 8) of `cloud_in_gripper`.
        candidate: (n, c, 9).
        pair: (n, k, 58).
        rows: (n,) bool, of which trials.
    """
    marks = 2 * len(ALONG_FINGER_M)
    cloud, candidate, pair = cloud.clone(), candidate.clone(), pair.clone()
    cloud[rows, ..., 6] = 0.0
    candidate[rows, ..., :marks], candidate[rows, ..., marks] = 10 * FAR_M, 0.0
    pair[rows, ..., REGION_TO_BALL] = 10 * FAR_M
    return cloud, candidate, pair


REGION_TO_BALL = 3 + 4 * 3 + 1 + 4 * len(WRIST_M) + 9 + 3
"""Place of the region's distance to the receiver's ball among the numbers of a pair."""


@lru_cache(maxsize=1)
def _form() -> tuple[Tensor, Tensor]:
    """Sides (M,) and places (M,) of the marks along the closing and the approach axis."""
    fingers = [(side, z) for z in ALONG_FINGER_M for side in (-1.0, 1.0)]
    rows = torch.tensor(fingers + [(0.0, z) for z in BEHIND_M], dtype=torch.float32, device="cpu")
    return rows[:, 0], rows[:, 1]


def _marks(opening: Tensor) -> Tensor:
    """(..., M, 3) marks on a gripper of this opening, frame ee."""
    side, along = (x.to(opening.device) for x in _form())
    y = side * (opening[..., None] / 2 + BESIDE_PAD_M)
    return torch.stack([torch.zeros_like(y), y, along.expand_as(y)], -1)
