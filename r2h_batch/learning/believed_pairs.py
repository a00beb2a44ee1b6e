"""Labelled pairs in the world that a method that sees believes: candidates on the solid that the images show, true verdicts."""

from dataclasses import replace

import torch
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.errors import UsageError
from r2h_batch.learning.pairs import Pairs, pairs_at_random
from r2h_batch.methods.believed import believed, known_before, noise_left
from r2h_batch.methods.ranker import features
from r2h_batch.methods.ranker.observe import observe
from r2h_batch.observe.seen import Observation
from r2h_batch.observe.sees import Sees
from r2h_batch.training import reward
from r2h_batch.types import Trials

POSES = 4
"""Pairs of one candidate."""


def believed_pairs(
    pairs: Pairs, sees: Sees, seen: Observation, trials: Trials, T_world_obj: Tensor, *, count: int
) -> dict[str, Tensor]:
    """An item as `Pairs` describes it, of the trials in which there is something to take hold of.

    Frame obj is that of the believed object. Nothing is known of parts, and of regions what `seen` was told. Verdicts
    are those of the true object and person.

    Args:
        pairs: whose trials they are.
        sees: how they were looked at.
        seen: what was seen of N trials.
        trials: these.
        T_world_obj: (N, 4, 4) where their objects lie in truth, m.
        count: pairs of each trial, a multiple of `POSES`.

    Returns:
        The tensors; `row` (M,): which of the N trials they are of; `T_world_obj` (M, 4, 4): where objects are believed to lie.

    Raises:
        UsageError: in none of the trials there is something to take hold of.
    """
    evaluator, noise = pairs.evaluator, noise_left(sees.noise)
    with torch.no_grad(), evaluator.working():
        world = believed(
            seen, *known_before(pairs.benchmark), replace(evaluator.config, receiver="hand"), noise,
            holds=False, seed=pairs.seed,
        )  # fmt: skip
        if world is None:
            raise UsageError(
                "the gripper can hold nothing of what was seen in these trials; take more --trials"
            )
        see = replace(features.SEE, noise=noise)
        told, middle = observe(world.trials, world.scene, see, seed=pairs.seed)
        pick, T_world_ee = pairs_at_random(
            pairs.seed, world.trials.trial_id, told, middle, pairs=count, poses=POSES
        )
        grasp = told["candidates"][
            torch.arange(len(pick), dtype=torch.int64, device="cpu")[:, None], pick
        ]
        T_true_believed = se3.matmul(
            se3.inverse(T_world_obj[world.row].double()), world.T_world_obj
        )
        true = se3.matmul(T_true_believed[:, None].expand_as(grasp), grasp.double()).float()
        own = trials[world.row]
        scores = evaluator.kinematic.score(true, T_world_ee, own, stages="pose")
        margin = torch.where(scores.evaluated, scores.margin, torch.nan)
    n, k = pick.shape
    return {
        "row": world.row, "T_world_obj": world.T_world_obj, **told, "pick": pick, "T_obj_ee": grasp, "T_world_ee": T_world_ee,
        "success": scores.success.view(n, k), "labels": reward.labels(scores).view(n, k, -1), "margin": margin.view(n, k, -1),
    }  # fmt: skip
