"""A bound for methods that see: of many grasps and handover poses the pair that succeeds under most of 16 drawn errors.

As the oracle it proposes pairs in rounds and asks the evaluator, but in the world that it believes. A pair that succeeds there is
judged again with the object and the hand moved by each of the drawn errors. The first pair that succeeds under all of them is
taken, else the one that does under most. It knows how large the errors are, not what they are. It bounds what knowledge of
one's own errors brings; it is no upper bound of success.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float32
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.validate import integer
from r2h_batch.config import ObjectErrors
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.object_errors import taken_grasps
from r2h_batch.methods.candidates import check_candidates
from r2h_batch.methods.oracle import Fan, how_far
from r2h_batch.observe.known import known_moments
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.noise import PredictorNoise, estimated_hand
from r2h_batch.types import Predictions, Trials

TITLE, STAND_IN = "Robust search", "the judge"

ROUNDS = 64
"""Proposals a trial gets at most; as the oracle's."""
DRAWS = 16
MOST_DRAWS = 256


@dataclass(frozen=True)
class Sizes:
    """Standard deviations of the errors that a search reckons with.

    Attributes:
        object: of the object's pose; its seed is not used.
        hand: of the target hand; the rest is not used.
    """

    object: ObjectErrors
    hand: PredictorNoise


def predict(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    evaluator: Evaluator | None = None,
    sizes: Sizes | None = None,
    T_world_obj: Float32[Tensor, "n 4 4"] | None = None,
    draws: int = DRAWS,
    rounds: int = ROUNDS,
) -> Predictions:
    """For each trial the proposal that succeeds under most drawn errors; drawn by (seed, trial id).

    Args:
        trials: B trials.
        scene: as the evaluator's.
        seed: of proposals and errors.
        evaluator: the judge; None: one of the scene.
        sizes: of the errors; None: the evaluator's `object_errors`, and an exact hand.
        T_world_obj: (B, 4, 4) where the objects rest when a trial begins on the table, m, as it believes; None: where they do.
        draws: errors under which a proposal is judged; 0: it must succeed as believed, as the oracle's.
        rounds: proposals of a trial at most.
    """
    draws = integer(0, MOST_DRAWS)("draws", draws)
    if evaluator is None:
        evaluator = Evaluator(scene.benchmark, scene.config, device=scene.device)
    if sizes is None:
        sizes = Sizes(evaluator.config.object_errors, PredictorNoise().scaled(0.0))
    check_candidates(scene, trials.object_index)
    evaluator = evaluator.kinematic
    n, home = len(trials), trials.trial_id.device
    trials = trials.to(scene.device)
    bare = evaluator
    if evaluator.scene.hand_room_m:  # it is for errors that are not drawn
        bare = evaluator.in_scene(Scene(scene.benchmark, scene.device, config=scene.config))
    if T_world_obj is not None:
        for judge in (evaluator, bare):
            known_moments(judge.scene).tell(trials, T_world_obj.to(scene.device))
    fan = Fan(trials, evaluator, seed)
    best = torch.full((n,), -torch.inf, dtype=torch.float64, device=scene.device)
    T_obj_ee, T_world_ee = (
        torch.eye(4, dtype=torch.float32, device=scene.device).repeat(n, 1, 1) for _ in range(2)
    )
    todo = torch.arange(n, dtype=torch.int64, device=scene.device)
    for turn in range(rounds):
        if not len(todo):
            break
        grasp, pose = (T.to(scene.device) for T in fan.proposals(todo.cpu().numpy(), turn))
        scores = evaluator.score(grasp, pose, trials[todo])
        value, solved = how_far(scores), torch.nonzero(scores.success)[:, 0]
        if len(solved):
            held = holding(
                bare, trials[todo[solved]], grasp[solved], pose[solved], sizes, draws, seed
            )
            # beyond every failure
            value[solved] += held.double()
        better = value > best[todo]
        rows = todo[better]
        best[rows], T_obj_ee[rows], T_world_ee[rows] = value[better], grasp[better], pose[better]
        done = torch.zeros(len(todo), dtype=torch.bool, device=scene.device)
        if len(solved):
            done[solved] = held == draws
        todo = todo[~done]
    return Predictions(trials.trial_id, T_obj_ee, T_world_ee, method="robust").to(home)


def holding(
    evaluator: Evaluator,
    trials: Trials,
    T_obj_ee: Tensor,
    T_world_ee: Tensor,
    sizes: Sizes,
    draws: int,
    seed: int,
) -> Tensor:
    """(B,) the number of drawn errors under which each pair succeeds.

    Args:
        evaluator: without errors of its own.
        trials: B trials as they are believed to be.
        T_obj_ee: (B, 4, 4) float32 grasps, m.
        T_world_ee: (B, 4, 4) float32 handover poses, m.
        sizes: of the errors.
        draws: number of errors.
        seed: of the errors.
    """
    known = known_moments(evaluator.scene)
    resting = known.of(trials) if "pick" in evaluator.benchmark.asks else None
    held = torch.zeros(len(trials), dtype=torch.int64, device=T_obj_ee.device)
    grasps: list[Tensor] = []
    hands: list[Tensor] = []
    for k in range(draws):
        # no key that errors of a judge or of an estimator are drawn by
        own = int(rng.key_of(f"robust {seed} {k}")[0])
        grasp = taken_grasps(
            replace(sizes.object, seed=own), evaluator.scene.objects, T_obj_ee, trials
        )
        hand = estimated_hand(
            evaluator.scene, trials.trial_id, trials.hand_index, trials.T_world_hand, seed=own, noise=sizes.hand
        )  # fmt: skip
        grasps.append(grasp)
        hands.append(hand)
        if resting is not None:  # the gripper goes where it was told, and the object is elsewhere
            moved = replace(trials, T_world_hand=hand)
            T_obj_moved = se3.matmul(T_obj_ee.double(), se3.inverse(grasp.double()))
            known.tell(moved, se3.matmul(resting.double(), T_obj_moved).float())
            held += evaluator.score(grasp, T_world_ee, moved).success
    if resting is not None:  # a draw may leave the hand where it was
        known.tell(trials, resting)
    elif draws:  # all at once: a call for few rows costs as much as for many
        every = torch.arange(len(trials), dtype=torch.int64, device=T_obj_ee.device)
        rows = every.repeat(draws)
        moved = replace(trials[rows], T_world_hand=torch.cat(hands))
        scores = evaluator.score(torch.cat(grasps), T_world_ee[rows], moved)
        held += scores.success.reshape(draws, -1).sum(0)
    return held
