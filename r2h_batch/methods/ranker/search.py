"""The pairs that a ranker likes best: proposals at random, then more near the best of them."""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from r2h_batch.base import rng, twist
from r2h_batch.methods.ranker.features import cloud_in_gripper, of_candidate, of_pair
from r2h_batch.methods.ranker.network import Ranker
from r2h_batch.methods.ranker.proposals import NUMBERS, propose

NEAR_M, NEAR_RAD = 0.02, 0.25
"""How far the second round goes from a pose, in each direction."""
TOGETHER = 8
"""Trials whose pairs are ranked together: their distances stay in a core's cache."""
NEEDS = (
    *(
        "cloud",
        "normals",
        "region",
        "hand",
        "palm_point",
        "palm_normal",
        "wrist_to_middle",
        "ball_center",
        "side",
    ),
    *("candidates", "opening_m", "score"),
)
"""Tensors that the features are made of."""
_FIRST, _SECOND = 2, 3  # purposes of the random counters; 0, 1: the stream's pairs

Score = Callable[[Mapping[str, Tensor], Tensor, Tensor, Tensor], Tensor]
"""(what is seen, pick (N, K), T_obj_ee, T_world_ee (N, K, 4, 4)) -> how good each pair is (N, K)."""


def scored_by(net: Ranker) -> Score:
    """The network's logit of success of each pair.

    Args:
        net: in evaluation mode.
    """

    def score(
        seen: Mapping[str, Tensor], pick: Tensor, T_obj_ee: Tensor, T_world_ee: Tensor
    ) -> Tensor:
        with torch.no_grad():
            found = []
            for rows in torch.arange(len(pick), dtype=torch.int64, device="cpu").split(TOGETHER):
                own = {k: seen[k][rows] for k in NEEDS}
                found.append(_logits(net, own, pick[rows], T_obj_ee[rows], T_world_ee[rows]))
        return torch.cat(found)

    return score


def _logits(
    net: Ranker, seen: Mapping[str, Tensor], pick: Tensor, T_obj_ee: Tensor, T_world_ee: Tensor
) -> Tensor:
    """(N, K) logits of success; each candidate's cloud goes through the network once."""
    every = seen["candidates"]
    n, c = every.shape[:2]
    own = torch.arange(c, dtype=torch.int64, device="cpu").expand(n, -1)
    code = net.code(cloud_in_gripper(seen, every))
    numbers = of_candidate(seen, every, own)

    def picked(x: Tensor) -> Tensor:
        return x.gather(1, pick[..., None].expand(-1, -1, x.shape[-1]))

    pair = of_pair(seen, T_obj_ee, T_world_ee, seen["opening_m"].gather(1, pick))
    found: Tensor = net(picked(code), picked(numbers), pair)[..., 0]
    return found


def liked(
    seen: Mapping[str, Tensor],
    middle: Float32[Tensor, "n 3"],
    ids: Tensor,
    score: Score,
    key: tuple[int, int],
    *,
    first: int,
    second: int,
    top: int,
) -> tuple[Int64[Tensor, "n k"], Float32[Tensor, "n k 4 4"], Float32[Tensor, "n k"]]:
    """All pairs that were tried: which candidate, T_world_ee, and how good they are; those of the first round first.

    Args:
        seen: of `observe`.
        middle: of `observe`.
        ids: (N,) trial ids; a row depends on key and id alone.
        score: what ranks the pairs.
        key: of the draws.
        first: pairs drawn at random.
        second: pairs drawn near the best of them; 0: none.
        top: how many count as the best.
    """
    number = ids.cpu().numpy()
    n = len(number)

    def uniform(count: int, purpose: int) -> Tensor:
        u = rng.uniforms(key, number, count, purpose=purpose)
        return torch.from_numpy(np.ascontiguousarray(u.T))

    u = uniform(first * (NUMBERS + 1), _FIRST).view(n, first, NUMBERS + 1)
    count = seen["exists"].sum(1, keepdim=True)
    pick = (u[..., NUMBERS] * count).long()
    rows = torch.arange(n, dtype=torch.int64, device="cpu")[:, None]
    grasps = seen["candidates"]
    T = propose(
        middle, seen["ball_center"], seen["palm_normal"], grasps[rows, pick], u[..., :NUMBERS]
    )
    good = score(seen, pick, grasps[rows, pick], T)
    if second:
        best = good.topk(min(top, first), dim=1).indices
        source = best[:, torch.arange(second, dtype=torch.int64, device="cpu") % best.shape[1]]
        v = 2 * uniform(second * 6, _SECOND).view(n, second, 6) - 1
        moved = v * v.new_tensor([NEAR_M] * 3 + [NEAR_RAD] * 3)
        near = twist.retract(T[rows, source].double(), moved).float()
        again = pick[rows, source]
        good = torch.cat([good, score(seen, again, grasps[rows, again], near)], 1)
        pick, T = torch.cat([pick, again], 1), torch.cat([T, near], 1)
    return pick, T, good
