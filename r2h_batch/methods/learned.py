"""Learned: of random pairs of candidate and handover pose the one that a network likes best, trained on verdicts.

A second round, if one is asked for, looks near the best pairs. The labels were the evaluator's, of new instances.

It sees what Handover-VA and Contact-Handover see: cloud, candidates, estimated hand, and the receiver's region with misplaced
borders. It asks no judge, and solves no IK.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from r2h_batch.base import rng, se3
from r2h_batch.methods.batches import answers
from r2h_batch.methods.candidates import check_candidates
from r2h_batch.methods.from_table import first_picked
from r2h_batch.methods.placing import check_choice
from r2h_batch.methods.predictors import Observations, PredictorNoise
from r2h_batch.methods.ranker.features import SEE, SPREAD
from r2h_batch.methods.ranker.network import Ranker, about_weights, read_weights
from r2h_batch.methods.ranker.observe import observe
from r2h_batch.methods.ranker.search import liked, scored_by
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Predictions, Trials

TITLE, STAND_IN = "Learned", "ranker, oracle labels"

FIRST, SECOND, TOP = 384, 0, 8
"""Pairs at random; pairs near the best; how many count as the best. A second round is no better on training trials."""
WEIGHTS = "ranker.safetensors"

Region = Literal["seen", "hidden"]
"""Whether the method is told which part the receiver wants; hidden: it does not know S1 from S0 either."""

PER_CANDIDATE = ("candidates", "opening_m", "score", "exists")


def predict(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    noise: PredictorNoise | None = None,
    seen: Observations | None = None,
    T_world_obj: Float32[Tensor, "n 4 4"] | None = None,
    weights: str = "",
    region: Region = "seen",
    first: int = FIRST,
    second: int = SECOND,
) -> Predictions:
    """One grasp and handover pose a trial.

    Args:
        trials: N trials.
        scene: objects, hands and robot: `Evaluator.scene`.
        seed: key of the draws; a row depends on seed and trial id alone.
        noise: errors of what the method sees; None: `PredictorNoise()`.
        seen: answers of your own networks, in place of the stand-ins.
        T_world_obj: (N, 4, 4) where the objects rest when a trial begins on the table, m; the method then takes the best grasp
            that the arm can pick there. None: a trial begins with the object in the gripper.
        weights: a file that `r2h-batch train rank` wrote; empty: the shipped weights.
        region: `seen`, or `hidden`: the receiver's region is not told.
        first: pairs that are drawn at random.
        second: pairs near the best of them; 0: none.

    Returns:
        `T_obj_ee` (N, 4, 4) and `T_world_ee` (N, 4, 4), m.
    """
    check_choice("region", region, Region)
    check_candidates(scene, trials.object_index)
    net = _net(weights)
    key = rng.key_of(f"learned {seed}")
    see = replace(SEE, noise=noise, spread=_spread(weights))

    def choose(part: Trials, rows_of: slice) -> tuple[Tensor, Tensor]:
        # each trial alone: torch's sums have other last bits in other shapes
        ranked = [_ranked(part[n : n + 1]) for n in range(len(part))]
        usable = torch.tensor(
            [len(grasps) for grasps, _ in ranked], dtype=torch.int64, device=scene.device
        )
        grasps, poses = (pad_sequence(list(x), batch_first=True) for x in zip(*ranked, strict=True))
        if T_world_obj is None:
            return grasps[:, 0], poses[:, 0]
        order = torch.arange(grasps.shape[1], dtype=torch.int64, device=scene.device)
        place, T_obj_ee, _ = first_picked(
            scene, part, T_world_obj[rows_of], grasps, order.expand(len(part), -1), usable
        )
        row = torch.arange(len(part), dtype=torch.int64, device=scene.device)
        # the object stays where it was held out when its grasp is backed out
        T_grasp_ee = se3.matmul(se3.inverse(grasps[row, place].double()), T_obj_ee.double())
        return T_obj_ee, se3.matmul(poses[row, place].double(), T_grasp_ee).float()

    def _ranked(trial: Trials) -> tuple[Tensor, Tensor]:
        """(C, 4, 4) candidates of a trial that pairs were drawn of, and the pose of each that the network likes best; the best
        pairs first."""
        told, middle = observe(trial, scene, see, seed=seed, seen=seen, region=region == "seen")
        count = int(told["exists"].sum())
        own = {k: v[:, :count] if k in PER_CANDIDATE else v for k, v in told.items()}
        pick, T, good = liked(
            own, middle, trial.trial_id, scored_by(net), key, first=first, second=second, top=TOP
        )
        order = good[0].argsort(descending=True, stable=True)
        _, first_pair = np.unique(pick[0, order].cpu().numpy(), return_index=True)
        best = order[torch.from_numpy(np.sort(first_pair)).to(order.device)]
        return own["candidates"][0, pick[0, best]], T[0, best]

    return answers(trials, scene, "learned", choose)


def trained_on(weights: str = "", **_: object) -> list[str]:
    """Names of the objects that a ranker learned from.

    Args:
        weights: as of `predict`.
    """
    with weights_file(weights) as path:
        told = about_weights(path).get("trained_on")
    objects = told.get("objects", []) if isinstance(told, dict) else []
    return [str(name) for name in objects]


TRAINED_ON = trained_on
"""A sweep writes it beside the method, and compares it with the judged objects."""


def _spread(weights: str) -> bool:
    """Whether a ranker learned from clouds that are spread over the object; earlier ones learned from one piece of it."""
    with weights_file(weights) as path:
        return about_weights(path).get("cloud") == SPREAD


def _net(weights: str) -> Ranker:
    """The ranker of a file; empty: the shipped one."""
    with weights_file(weights) as path:
        return read_weights(path)


@contextmanager
def weights_file(weights: str) -> Iterator[Path]:
    """A file of weights.

    Args:
        weights: its path; empty: the weights that ship.
    """
    if weights:
        yield Path(weights).absolute()
    else:
        with resources.as_file(resources.files("r2h_batch.assets.ranker") / WEIGHTS) as path:
            yield path
