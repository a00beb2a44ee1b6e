"""Whether forearm and wrist of a receiver are within their joint ranges, with the hand somewhere else.

Angles are those of `kernels.judge.reception.arm_angles`, ranges those of `within_ranges` there: clinical
norms of the AAOS.
"""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from r2h_batch.base import se3

ELBOW_DEG, TURN_DEG = 150.0, 80.0
FLEXION_DEG, EXTENSION_DEG = 80.0, 70.0
ULNAR_DEG, RADIAL_DEG = 30.0, 20.0


def lower_arm_angles(
    shoulder: Float64[Tensor, "b 3"],
    elbow: Float64[Tensor, "b 3"],
    wrist: Float64[Tensor, "b 3"],
    along: Float64[Tensor, "b 3"],
    normal: Float64[Tensor, "b 3"],
    outwards: Float64[Tensor, " b"],
) -> Float64[Tensor, "b 4"]:
    """Angles in degrees: elbow, forearm (+ supinated), wrist flexion, ulnar deviation.

    Args:
        shoulder: world, m.
        elbow: world, m.
        wrist: world, m.
        along: where the hand points, from the wrist to the middle knuckle, at right angles to `normal`; world, unit.
        normal: where the palm faces, world, unit.
        outwards: -1 of right arms, 1 of left ones.
    """
    u, f = _unit(elbow - shoulder), _unit(wrist - elbow)
    t = _unit(se3.dot(u, f)[:, None] * f - u)
    i = -outwards[:, None] * se3.cross(t, f)
    n_f = se3.dot(normal, f).clamp(-1.0, 1.0)
    turn = torch.atan2(se3.dot(normal, t), se3.dot(normal, i))
    aside = turn.cos()[:, None] * t - turn.sin()[:, None] * i
    forwards = _unit(f - n_f[:, None] * normal)
    deviation = torch.atan2(-se3.dot(along, aside), se3.dot(along, forwards))
    angles = [se3.dot(u, f).clamp(-1.0, 1.0).acos(), turn, -n_f.asin(), deviation]
    return torch.rad2deg(torch.stack(angles, 1))


def within_ranges(angles_deg: Float64[Tensor, "b 4"]) -> Bool[Tensor, " b"]:
    """Whether `lower_arm_angles` are all within their ranges."""
    elbow, turn, flexion, deviation = angles_deg.unbind(1)
    forearm = (elbow <= ELBOW_DEG) & (turn.abs() <= TURN_DEG)
    bent = (flexion <= FLEXION_DEG) & (flexion >= -EXTENSION_DEG)
    return forearm & bent & (deviation <= ULNAR_DEG) & (deviation >= -RADIAL_DEG)


def _unit(a: Tensor) -> Tensor:
    return a / se3.dot(a, a).sqrt().clamp(min=1e-12)[:, None]
